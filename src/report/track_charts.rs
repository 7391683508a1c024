//! Curves of a tracked session over time, with 95 % bands.

use maud::Markup;
use nalgebra::Vector3;

use super::chart::{Chart, Dots};
use super::curves::Curve;
use super::page::gallery;
use super::track::TrackReport;
use super::walk::BAND;
use crate::body::{Joint, Placement};

/// Phase, root, heights of joints, and how many points each frame had.
pub(super) fn curves(report: &TrackReport, placements: &[Placement]) -> Markup {
    let joints = [(Joint::LAnkle, "ankles"), (Joint::LKnee, "knees"), (Joint::LWrist, "wrists")];
    let mut figures = vec![phase(report), root(report)];
    figures.extend(joints.map(|(left, name)| heights(report, placements, left, name)));
    figures.extend([points(report), distances(report)]);
    gallery(&figures)
}

/// One value per frame over time; bands are standard deviations.
fn series(report: &TrackReport, label: &str, colour: usize, value: &dyn Fn(usize) -> f64, sigma: &dyn Fn(usize) -> Option<f64>) -> Curve {
    let points = report.observations.iter().enumerate().map(|(t, o)| [o.time_s, value(t)]).collect();
    let bands: Vec<f64> = (0..report.observations.len()).map(|t| BAND * sigma(t).unwrap_or(f64::NAN)).collect();
    let known = bands.iter().any(|b| b.is_finite());
    Curve { label: label.into(), points, dashed: false, colour, band: if known { bands } else { Vec::new() } }
}

fn over_time(title: &str, y_label: &str, curves: Vec<Curve>) -> Chart {
    let strings = |s: &str| s.to_string();
    Chart { title: strings(title), x_label: "time (s)".into(), y_label: strings(y_label), curves, ..Chart::default() }
}

fn phase(report: &TrackReport) -> Markup {
    let carriers = &report.fit.state.carriers;
    let sigma = |t: usize| Some(report.fit.uncertainty.as_ref()?.frames.get(t)?.local[6]);
    let value = |t: usize| carriers.get(t).map_or(f64::NAN, |c| c.phase);
    over_time("Phase", "cycles", vec![series(report, "phase with 95 % band", 0, &value, &sigma)]).figure()
}

fn root(report: &TrackReport) -> Markup {
    let carriers = &report.fit.state.carriers;
    let start = carriers.first().map_or_else(Vector3::zeros, |c| c.position);
    let curves = ["x", "y", "z"].iter().enumerate().map(|(k, name)| {
        let sigma = |t: usize| Some(report.fit.uncertainty.as_ref()?.frames.get(t)?.local[3 + k]);
        let value = |t: usize| carriers.get(t).map_or(f64::NAN, |c| c.position[k] - start[k]);
        series(report, name, 2 + k, &value, &sigma)
    });
    let chart = over_time("Way of the root", "m since the first frame", curves.collect());
    Chart { caption: "In the rig's world, without bob and sway, with 95 % bands.".into(), ..chart }.figure()
}

/// Height of a joint of both sides.
fn heights(report: &TrackReport, placements: &[Placement], left: Joint, name: &str) -> Markup {
    let up = report.rig.up.direction();
    let curves: Vec<Curve> = [(left, "left"), (left.mirror(), "right")]
        .into_iter()
        .enumerate()
        .map(|(side, (joint, label))| {
            let sigma = |t: usize| Some(report.fit.uncertainty.as_ref()?.frames.get(t)?.joints_m[joint as usize].dot(&up).abs());
            let value = |t: usize| placements.get(t).map_or(f64::NAN, |p| p.position(joint).dot(&up));
            series(report, label, side, &value, &sigma)
        })
        .collect();
    let strikes = report.walk.iter().flat_map(|walk| {
        [0, 1].into_iter().flat_map(move |foot| walk.filmed.feet[foot].strikes_s.iter().map(move |t| (t + walk.start_s, foot)))
    });
    let marks = if left == Joint::LAnkle { strikes.collect() } else { Vec::new() };
    let dotted = if marks.is_empty() { "" } else { "; dotted: heel strikes" };
    let chart = over_time(&format!("Height of the {name}"), "m", curves);
    Chart { marks, caption: format!("With 95 % bands{dotted}."), ..chart }.figure()
}

fn dots(report: &TrackReport, label: &str, colour: usize, value: &dyn Fn(usize) -> f64) -> Dots {
    let points = report.observations.iter().enumerate().map(|(t, o)| [o.time_s, value(t)]).collect();
    Dots { label: label.into(), points, bars: Vec::new(), colour, radius: 2.4 }
}

fn points(report: &TrackReport) -> Markup {
    let seen = |t: usize| report.observations[t].cloud.points.len() as f64;
    let top = (0..report.observations.len()).map(seen).fold(1.0, f64::max);
    let chart = over_time("Cloud points per frame", "points", Vec::new());
    Chart { dots: vec![dots(report, "", 2, &seen)], y_range: Some([0.0, 1.06 * top]), ..chart }.figure()
}

fn distances(report: &TrackReport) -> Markup {
    let rms = |t: usize| {
        let fitness = &report.fit.frames[t.min(report.fit.frames.len().saturating_sub(1))];
        if fitness.inliers > 0 { 1e3 * (fitness.inlier_square / fitness.inliers as f64).sqrt() } else { f64::NAN }
    };
    let top = (0..report.observations.len()).map(rms).filter(|v| v.is_finite()).fold(1.0, f64::max);
    let chart = over_time("Distance of the points to the skin", "r.m.s., mm", Vec::new());
    Chart { dots: vec![dots(report, "", 3, &rms)], y_range: Some([0.0, 1.06 * top]), ..chart }.figure()
}

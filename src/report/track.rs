//! The report of a tracked session: verdict, pictures with the body, gait table, curves with their bands, style, and what was
//! not seen.

use image::{GrayImage, RgbImage};
use maud::{Markup, html};
use nalgebra::Vector3;

use super::page::{Grade, Section, Verdict, facts, page, picture, png_uri, table, tiles};
use super::walk::Walk;
use super::{CloudDot, ReportError, cloud_and_body, person, person_depth, style_charts, track_charts, view3d, walk};
use crate::body::{Joint, NODES, Placement, PosedSurface, Surface, place};
use crate::fit::contest::runner_up;
use crate::fit::{Fit, Observation};
use crate::io::joints_csv;
use crate::motion_model::Model;
use crate::phantom::{self, DepthMap};
use crate::rig::Rig;
use crate::style::Style;

/// Costs of the two half-cycle hypotheses closer than this leave open which leg is which.
pub const UNDECIDED: f64 = 1.3;
/// A weight is known when its standard deviation is below this part of the population's.
pub const KNOWN: f64 = 0.5;
/// Fewer inlying points than this leave a frame to its neighbours.
const FEW_POINTS: usize = 40;
/// More such frames than this part of all are worth a look.
const UNSEEN_SHARE: f64 = 0.2;
/// Skin farther from the points than this is another body, or another motion, metres.
const FAR_M: f64 = 0.025;

/// Everything a page tells of one session.
pub struct TrackReport<'a> {
    /// As given on the command line.
    pub session: &'a str,
    pub rig: &'a Rig,
    pub fps: f64,
    pub model: &'a Model,
    pub model_name: &'a str,
    pub model_hash: &'a str,
    /// Names of all models that were given.
    pub given: &'a [&'a str],
    pub fit: &'a Fit,
    pub observations: &'a [Observation],
    /// Index of a frame, and the pictures of all cameras.
    pub pictures: &'a [(usize, Vec<GrayImage>)],
    /// A frame's number and its measured depths.
    pub depth: Option<(usize, &'a DepthMap)>,
    pub style: &'a Style,
    pub walk: Option<&'a Walk>,
    /// Further options by name.
    pub options: &'a [(&'a str, String)],
}

impl TrackReport<'_> {
    /// The whole page.
    pub fn html(&self) -> Result<String, ReportError> {
        let offsets = self.fit.shape().offsets();
        let placements: Vec<Placement> = self.fit.poses.iter().map(|pose| place(&offsets, pose)).collect();
        let mut sections =
            vec![Section::new("Pictures", self.overlays(&placements)?), Section::new("Points and depth", self.clouds(&placements)?)];
        if let Some(walk) = self.walk {
            sections.push(Section::new("Gait", walk::section(walk)));
        }
        sections.push(Section::new("Curves", track_charts::curves(self, &placements)));
        sections.push(Section::new("Style", style_charts::section(self.model, self.style, &self.fit.weight_uncertainty())));
        sections.push(Section::new("What was not seen", self.unseen()));
        sections.push(Section::new("What was done", self.facts()));
        Ok(page("muybridge track", self.session, &self.verdict(), &sections))
    }

    /// Frames whose points say little.
    fn left_to_neighbours(&self) -> Vec<usize> {
        let few = |(t, o): (usize, &Observation)| (self.fit.frames.get(t)?.inliers < FEW_POINTS).then_some(o.number);
        self.observations.iter().enumerate().filter_map(few).collect()
    }

    fn verdict(&self) -> Verdict {
        let fit = self.fit;
        let known = fit.weight_uncertainty().iter().filter(|u| **u < KNOWN).count();
        let moves = if self.model.activity.is_cyclic() {
            format!("{} at {:.2} m/s and {:.2} cycles/s", self.model.activity, fit.speed_m_s, fit.cadence_hz)
        } else {
            format!("{} of {:.2} m", self.model.activity, fit.parameter(self.model.activity))
        };
        let sentence = format!(
            "{} frames of {moves}; stature {:.2} m; the skin lies {:.1} mm (r.m.s.) from the points; {known} of {} style weights known to half the population's spread.",
            fit.poses.len(),
            fit.shape().stature_m,
            1e3 * fit.rms_m(),
            fit.state.weights.len(),
        );
        let notes = self.doubts();
        let grade = if notes.is_empty() { Grade::Good } else { Grade::Look };
        Verdict { grade, sentence, notes }
    }

    fn doubts(&self) -> Vec<String> {
        let (fit, mut notes) = (self.fit, Vec::new());
        let [best, other] = fit.half_cycles();
        if other < UNDECIDED * best {
            notes.push(format!(
                "Left and right may be exchanged: with the legs swapped the cost is {other:.0} against {best:.0}. Look at the pictures."
            ));
        }
        if let Some(second) = runner_up(&fit.candidates) {
            let [best, other] = [fit.model, second].map(|k| fit.candidates[k].costs[0]);
            if other < UNDECIDED * best {
                notes.push(format!(
                    "The model may be the wrong one: {} costs {other:.0} against {best:.0} for {}. Name the right one.",
                    self.given[second], self.model_name
                ));
            }
        }
        let few = self.left_to_neighbours();
        if few.len() as f64 > UNSEEN_SHARE * self.observations.len() as f64 {
            notes.push(format!(
                "{} of {} frames have fewer than {FEW_POINTS} points and follow their neighbours.",
                few.len(),
                self.observations.len()
            ));
        }
        if fit.rms_m() > FAR_M {
            notes.push(format!("The body lies {:.0} mm from the points: wide clothes, or a motion unlike the model's.", 1e3 * fit.rms_m()));
        }
        if fit.uncertainty.is_none() {
            notes.push("The equations are singular: nothing is known about the uncertainty.".into());
        }
        if self.model.synthetic {
            notes.push("The model is synthetic; for figures that mean something build one from motion capture.".into());
        }
        notes
    }

    fn overlays(&self, placements: &[Placement]) -> Result<Markup, ReportError> {
        let (surface, offsets) = (Surface::new(self.fit.shape()), self.fit.shape().offsets());
        let shown: Vec<_> = self.pictures.iter().filter(|(t, _)| *t < placements.len()).collect();
        let mut cameras = Vec::new();
        for (k, camera) in self.rig.cameras.iter().enumerate() {
            let bodies: Vec<&[Vector3<f64>; NODES]> = shown.iter().map(|(t, _)| &placements[*t].positions).collect();
            let mut figures = Vec::new();
            for ((t, views), part) in shown.iter().zip(person::crops(camera, &bodies)) {
                let (Some(view), o) = (views.get(k), &self.observations[*t]) else { continue };
                let mask = phantom::silhouette(&surface, &offsets, &placements[*t], camera);
                let caption = format!("frame {}, {:.2} s", o.number, o.time_s);
                figures.push(person::figure(view, camera, &placements[*t].positions, &mask, part, &caption)?);
            }
            cameras.push((camera.name.as_str(), figures));
        }
        Ok(html! {
            p.soft { "The fitted skeleton (left blue, right orange) and the outline of the fitted body (yellow) on the footage." }
            @for (name, figures) in &cameras {
                h3 { (name) }
                (tiles(figures))
            }
        })
    }

    fn clouds(&self, placements: &[Placement]) -> Result<Markup, ReportError> {
        let surface = Surface::new(self.fit.shape());
        let mut figures = Vec::new();
        if let (Some(placement), Some(o)) = (placements.get(placements.len() / 2), self.observations.get(placements.len() / 2)) {
            let skin = PosedSurface::new(&surface, placement);
            let dot = |x: Vector3<f64>| CloudDot { x, distance_m: skin.distance(&x) };
            let dots: Vec<CloudDot> = o.cloud.points.iter().map(|p| dot(p.position)).collect();
            let caption = format!("Frame {}: {} points, coloured by their distance to the fitted skin.", o.number, dots.len());
            let title = format!("Cloud and body, frame {}", o.number);
            figures.push(picture(&png_uri(&cloud_and_body(&dots, &placement.positions, self.rig.up, &title)?)?, &caption));
        }
        if let Some((number, depth)) = self.depth {
            let caption = format!("Frame {number}: depths measured by three-view correlation; grey where views did not agree.");
            figures.push(picture(&png_uri(&person_depth(depth, &format!("Measured depth, frame {number}"))?)?, &caption));
        }
        let viewpoint = self.rig.cameras.iter().map(|c| c.centre()).sum::<Vector3<f64>>() / self.rig.cameras.len().max(1) as f64;
        let middle = placements.get(placements.len() / 2).map_or_else(Vector3::zeros, |p| p.positions[0]);
        let instant = |t: usize| {
            let o = &self.observations[t];
            let points = o.cloud.points.iter().map(|p| p.position).collect();
            view3d::Instant { label: format!("{} ({:.2} s)", o.number, o.time_s), placement: &placements[t], points }
        };
        let instants = view3d::shown(placements.len().min(self.observations.len())).into_iter().map(instant).collect();
        let view = view3d::View { shape: self.fit.shape(), up: self.rig.up, towards_viewer: viewpoint - middle, instants };
        Ok(html! {
            div.gallery.halves { @for figure in &figures { (figure) } }
            (view3d::view(&view))
        })
    }

    fn unseen(&self) -> Markup {
        let unknown: Vec<String> = self
            .fit
            .weight_uncertainty()
            .iter()
            .enumerate()
            .filter(|(_, u)| u.is_nan() || **u >= KNOWN)
            .map(|(i, _)| (i + 1).to_string())
            .collect();
        let empty: Vec<String> = self.observations.iter().filter(|o| o.cloud.points.is_empty()).map(|o| o.number.to_string()).collect();
        let few: Vec<String> = self.left_to_neighbours().iter().map(usize::to_string).collect();
        let list = |items: &[String], none: &str| if items.is_empty() { none.to_string() } else { items.join(", ") };
        html! {
            (facts(&[
                ("style weights that the footage did not tell", list(&unknown, "none")),
                ("frames without any point", list(&empty, "none")),
                ("frames with too few points, mostly from their neighbours", list(&few, "none")),
                ("frame numbers that are missing in the footage", list(&self.missing(), "none")),
            ]))
            @if let Some(rows) = self.least_sure() {
                p { "Joints whose position is least sure, mean standard deviation over all frames:" }
                (table(&["joint", "mm"], &rows, 1))
            }
        }
    }

    fn missing(&self) -> Vec<String> {
        self.observations.windows(2).flat_map(|w| w[0].number + 1..w[1].number).map(|n| n.to_string()).collect()
    }

    /// The five joints with the largest mean standard deviation.
    fn least_sure(&self) -> Option<Vec<Vec<String>>> {
        let frames = &self.fit.uncertainty.as_ref()?.frames;
        let mean = |joint: Joint| frames.iter().map(|f| f.joints_m[joint as usize].norm()).sum::<f64>() / frames.len().max(1) as f64;
        let mut joints: Vec<(&str, f64)> = joints_csv::columns().map(|(joint, name)| (name, mean(joint))).collect();
        joints.sort_by(|a, b| b.1.total_cmp(&a.1));
        Some(joints[..5].iter().map(|(name, m)| vec![name.to_string(), format!("{:.1}", 1e3 * m)]).collect())
    }

    /// Every model with its costs, best first.
    fn candidates(&self) -> String {
        let mut all: Vec<_> = self.given.iter().zip(&self.fit.candidates).collect();
        all.sort_by(|a, b| a.1.costs[0].total_cmp(&b.1.costs[0]));
        let each: Vec<String> = all.iter().map(|(name, costs)| format!("{name} {costs}")).collect();
        each.join(", ")
    }

    fn facts(&self) -> Markup {
        let (fit, shape) = (self.fit, self.fit.shape());
        let sigma = shape.stature_m * fit.shared_variance(fit.state.layout().stature()).sqrt();
        let cameras: Vec<String> = self.rig.cameras.iter().map(|c| format!("{} {}x{}", c.name, c.size_px[0], c.size_px[1])).collect();
        let points: usize = self.observations.iter().map(|o| o.cloud.points.len()).sum();
        let used: usize = fit.frames.iter().map(|f| f.inliers).sum();
        let mut rows = vec![
            ("session", self.session.to_string()),
            ("cameras", cameras.join(", ")),
            ("frames", format!("{} at {} frames/s", self.observations.len(), self.fps)),
            ("cloud points", format!("{points}, of which the last stage of the fit took a share and {used} lie at the body")),
            (
                "model",
                format!(
                    "{}: {}, {} cycles of {} subjects",
                    self.model_name,
                    self.model.activity,
                    self.model.members.len(),
                    self.model.subjects().len()
                ),
            ),
            ("model's hash", self.model_hash.to_string()),
            ("models that competed, with their costs and those of the other half-cycle", self.candidates()),
            (
                "body",
                format!("stature {:.3} m (standard deviation {sigma:.3}), hip joints at {:.3} m", shape.stature_m, shape.hip_height_m()),
            ),
            (
                "leaves the model",
                if fit.state.deviations.is_empty() {
                    "no".into()
                } else {
                    "yes, single joints turn against it where that explains left-out points better".into()
                },
            ),
            ("iterations", fit.iterations.to_string()),
        ];
        rows.extend(self.options.iter().cloned());
        rows.push(("version", concat!("muybridge ", env!("CARGO_PKG_VERSION")).to_string()));
        html! {
            (facts(&rows))
            p.small.soft { "Numbers beside this page: gait.csv, angles_cycle.csv, joints.csv, uncertainty.csv, fit.json, style.json." }
        }
    }
}

/// The person in the middle frame of the strip, small, for a study's table.
pub fn thumbnail(report: &TrackReport) -> Result<Option<RgbImage>, ReportError> {
    let fit = report.fit;
    let (Some((t, views)), Some(camera)) = (report.pictures.get(report.pictures.len() / 2), report.rig.cameras.first()) else {
        return Ok(None);
    };
    let (Some(view), Some(pose)) = (views.first(), fit.poses.get(*t)) else { return Ok(None) };
    let (surface, offsets) = (Surface::new(fit.shape()), fit.shape().offsets());
    let placement = place(&offsets, pose);
    let mask = phantom::silhouette(&surface, &offsets, &placement, camera);
    let drawn = super::overlay(view, camera, &placement.positions, Some(&mask))?;
    Ok(Some(image::imageops::thumbnail(&drawn, 224, 224 * drawn.height() / drawn.width().max(1))))
}

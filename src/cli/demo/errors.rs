//! Errors of everything that was recovered and generated.

use anyhow::{Result, bail};
use muybridge::body::{Joint, Length, Pose, PosedSurface, Shape, Surface, place};
use muybridge::math::rotation::exp;
use muybridge::motion::Synthesis;
use muybridge::motion_model::synthetic::REPEATS;
use muybridge::motion_model::{Cycle, Detail, Model, SAMPLES};
use muybridge::phantom::truth::{ANGLES, JointErrors, Positions, distance_to_skin, joint_errors};
use muybridge::style::{Metric, Population, Style};
use nalgebra::{DVector, Vector3};
use rayon::prelude::*;

use super::table::Row;
use super::{Generated, SPEED_M_S, Truth, at_speed};
use crate::cli::track::{NamedModel, Tracked};

/// Points of one frame whose distance to the skin is measured.
const POINTS: usize = 2000;
/// A point farther from the skin is none of the body's, metres.
const OFF_BODY_M: f64 = 0.05;

/// What errors are set beside; [`NOTES`] says what they are.
const MODEL: &str = "model alone";
const TRUE_STYLE: &str = "true style";
const UNCHANGED: &str = "unchanged";
const AVERAGE: &str = "average person";

/// What the table's words mean.
pub const NOTES: &str = "
Angles are included angles at joint centres, means of both sides; joints at new speeds: pelvis moved together.
model alone: the true cycle as the model's components show it; true style: generated from the true cycle;
unchanged: the recovered motion replayed as filmed; average person: mean of the database's people at that speed.
";

pub fn rows(truth: &Truth, model: &NamedModel, tracked: &Tracked, generated: &[Generated]) -> Result<Vec<Row>> {
    let mut rows = cloud_rows(truth, tracked)?;
    rows.extend(joint_rows(truth, &model.model, tracked));
    rows.extend(motion_rows(truth, tracked));
    rows.extend(weight_rows(truth, &model.model, &tracked.style));
    rows.extend(speed_rows(truth, model, &tracked.style, generated)?);
    Ok(rows)
}

fn cloud_rows(truth: &Truth, tracked: &Tracked) -> Result<Vec<Row>> {
    let shape = truth.subject.shape();
    let (surface, offsets) = (Surface::new(&shape), shape.offsets());
    let frames: Vec<_> = tracked.observations.iter().zip(&truth.poses).collect();
    let distances: Vec<Vec<f64>> = frames
        .par_iter()
        .map(|(seen, pose)| {
            let skin = PosedSurface::new(&surface, &place(&offsets, pose));
            let points = &seen.cloud.points;
            points.iter().step_by(points.len().div_ceil(POINTS).max(1)).map(|p| distance_to_skin(&skin, &p.position)).collect()
        })
        .collect();
    let mut all = distances.concat();
    all.sort_by(f64::total_cmp);
    let Some(median) = all.get(all.len() / 2) else { bail!("the clouds of the demo are empty") };
    let off = all.iter().filter(|d| **d > OFF_BODY_M).count() as f64 / all.len() as f64;
    let count = tracked.observations.iter().map(|o| o.cloud.points.len()).sum::<usize>() / tracked.observations.len().max(1);
    Ok(vec![
        Row::new("cloud to true skin, median", 1e3 * median, "mm").beside("points per frame", count as f64),
        Row::new("cloud points over 50 mm off the body", 100.0 * off, "%"),
    ])
}

fn joint_rows(truth: &Truth, model: &Model, tracked: &Tracked) -> Vec<Row> {
    let positions = |poses: &[Pose], offsets: &Positions| -> Vec<Positions> { poses.iter().map(|p| place(offsets, p).positions).collect() };
    let found = positions(&tracked.fit.poses, &tracked.fit.shape().offsets());
    let errors = joint_errors(&found, &positions(&truth.poses, &truth.subject.shape().offsets()));
    let shown = model.cycle(own_weights(model, &truth.cycle).as_slice(), "", SPEED_M_S, 1.0, 1.0);
    let least = against(truth, &shown, &truth.cycle);
    let mut rows = vec![
        Row::new("joints, absolute", 1e3 * errors.absolute_m, "mm"),
        Row::new("joints, pelvis moved together", 1e3 * errors.root_relative_m, "mm").beside(MODEL, 1e3 * least.root_relative_m),
    ];
    for (k, (name, _)) in ANGLES.iter().enumerate() {
        rows.push(Row::new(format!("{name} angle"), errors.angles[k].to_degrees(), "deg").beside(MODEL, least.angles[k].to_degrees()));
    }
    rows.push(Row::new("legs, error with sides exchanged over own", errors.swapped_over_straight, ""));
    rows
}

/// The true weights: all that the model holds.
fn own_weights(model: &Model, cycle: &Cycle) -> DVector<f64> {
    model.project(&model.vector_of(cycle))
}

fn motion_rows(truth: &Truth, tracked: &Tracked) -> Vec<Row> {
    let (fit, shape) = (&tracked.fit, truth.subject.shape());
    let wrapped = |d: f64| (d + 0.5).rem_euclid(1.0) - 0.5;
    let phases = fit.state.carriers.iter().zip(&truth.phases).map(|(found, phase)| wrapped(found.phase - phase).abs());
    let phase = phases.sum::<f64>() / truth.phases.len() as f64;
    let frequency_hz = 1.0 / truth.cycle.duration_s;
    vec![
        Row::new("phase", phase, "cycle"),
        Row::new("speed", 100.0 * (fit.speed_m_s / SPEED_M_S - 1.0).abs(), "%").beside("true m/s", SPEED_M_S),
        Row::new("cadence", 100.0 * (fit.cadence_hz / frequency_hz - 1.0).abs(), "%").beside("true cycles/s", frequency_hz),
        size_row("height", height_m, fit.shape(), &shape),
        size_row("hip height", Shape::hip_height_m, fit.shape(), &shape),
    ]
}

fn size_row(quantity: &str, size_m: fn(&Shape) -> f64, found: &Shape, truth: &Shape) -> Row {
    Row::new(quantity, 1e3 * (size_m(found) - size_m(truth)).abs(), "mm").beside("true mm", 1e3 * size_m(truth))
}

/// Crown above the floor when standing.
fn height_m(shape: &Shape) -> f64 {
    let crown = Joint::Skullbase.end_site().unwrap_or_default() * shape.stature_m * shape.lengths[Length::Head as usize];
    let up_to = std::iter::successors(Some(Joint::Skullbase), |joint| joint.parent());
    up_to.map(|joint| shape.offsets()[joint as usize].y).sum::<f64>() + crown.y
}

/// Distances of equation (6) of the style paper.
fn weight_rows(truth: &Truth, model: &Model, style: &Style) -> Vec<Row> {
    let population = Population::new(model, style.weights.len());
    let weights = |cycle: &Cycle| own_weights(model, cycle).rows(0, population.components()).into_owned();
    let distance = |a: &DVector<f64>, b: &DVector<f64>| Metric::Paper.distance(&population.eigenvalues, a, b);
    let own = weights(&truth.cycle);
    let from = |found: &[f64]| distance(&DVector::from_column_slice(found), &own);
    let repeats: Vec<_> = (0..REPEATS).map(|r| weights(&truth.subject.cycle(SPEED_M_S, r))).collect();
    let pairs: Vec<f64> =
        (0..repeats.len()).flat_map(|i| (0..i).map(move |k| (i, k))).map(|(i, k)| distance(&repeats[i], &repeats[k])).collect();
    let people: Vec<f64> = population.distances(&own, SPEED_M_S, Metric::Paper);
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let found = Row::new("weights, equation (6)", from(&style.weights), "");
    let expected = style.expected.iter().map(|expected| Row::new("the same, expected of recordings", from(&expected.weights), ""));
    [found.beside("between own cycles", mean(&pairs)).beside("to other people", mean(&people))].into_iter().chain(expected).collect()
}

/// The generated cycles against the subject's own true motion at those speeds, on the true body.
fn speed_rows(truth: &Truth, model: &NamedModel, own: &Style, generated: &[Generated]) -> Result<Vec<Row>> {
    let Some(true_style) = Style::of_cycles(&model.model, &model.hash, std::slice::from_ref(&truth.cycle)) else {
        bail!("the filmed person has no cycle");
    };
    let mut rows = Vec::new();
    for motion in generated {
        let speed_m_s = motion.kmh / 3.6;
        let wanted = truth.subject.mean_cycle(speed_m_s);
        let error = |weights: &[f64], detail: Option<&Detail>| {
            against(truth, &model.model.cycle_with(weights, detail, speed_m_s, 1.0, 1.0), &wanted)
        };
        let error_of = |s: &Synthesis| error(s.weights.as_slice(), s.detail.as_ref());
        let cadence = |frequency_hz: f64| 100.0 * (frequency_hz * wanted.duration_s - 1.0).abs();
        let from_truth = at_speed(model, &true_style, speed_m_s)?;
        let made = error_of(&motion.synthesis);
        let beside = [
            (TRUE_STYLE, error_of(&from_truth)),
            (UNCHANGED, error(&own.weights, own.detail.as_ref())),
            (AVERAGE, error(average_person(&model.model, own.weights.len(), speed_m_s).as_slice(), None)),
        ];
        let row = |what: &str, unit, of: &dyn Fn(&JointErrors) -> f64| Row {
            quantity: format!("at {} km/h, {what}", motion.kmh),
            value: of(&made),
            unit,
            beside: beside.iter().map(|(name, errors)| (*name, of(errors))).collect(),
        };
        rows.push(row("angles", "deg", &|e| e.angle().to_degrees()));
        rows.push(row("joints", "mm", &|e| 1e3 * e.root_relative_m));
        let name = format!("at {} km/h, cadence", motion.kmh);
        rows.push(Row::new(name, cadence(motion.synthesis.frequency_hz), "%").beside(TRUE_STYLE, cadence(from_truth.frequency_hz)));
    }
    Ok(rows)
}

/// Mean of the database's people at a speed.
fn average_person(model: &Model, components: usize, speed_m_s: f64) -> DVector<f64> {
    let population = Population::new(model, components);
    let sum: DVector<f64> = population.curves.iter().map(|c| population.extended(c, speed_m_s)).sum();
    sum / population.curves.len() as f64
}

/// Both cycles on the true body, sample by sample from the right heel strike.
fn against(truth: &Truth, found: &Cycle, wanted: &Cycle) -> JointErrors {
    let offsets = truth.subject.shape().offsets();
    let placed = |cycle: &Cycle| -> Vec<Positions> {
        let pose = |k: usize| Pose { root: Vector3::zeros(), world_from_root: exp(&cycle.root[k].rotation), joints: cycle.joints[k] };
        (0..SAMPLES).map(|k| place(&offsets, &pose(k)).positions).collect()
    };
    joint_errors(&placed(found), &placed(wanted))
}

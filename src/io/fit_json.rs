//! `fit.json`: how a fit went, frame by frame, and how sure it is.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use super::write_atomic;
use crate::body::Length;
use crate::fit::state::{HELD, LOCAL};
use crate::fit::{Fit, Observation, weighing::total};
use crate::motion_model::Activity;

/// A model as it is named in reports.
#[derive(Clone, Debug, Serialize)]
pub struct ModelName {
    pub model: String,
    pub model_hash: String,
    pub activity: Activity,
}

/// Fewer inlying points than this leave a frame to its neighbours.
const FEW_POINTS: usize = 40;

#[derive(Serialize)]
struct FitReport<'a> {
    software: &'static str,
    #[serde(flatten)]
    model: &'a ModelName,
    /// What every model cost, on few frames and with priors, where several were given.
    candidates: Vec<CandidateReport<'a>>,
    components: usize,
    iterations: u64,
    /// Robust cost, without priors.
    cost: f64,
    /// Robust costs of the chosen solution and of the one half a cycle away when they were compared.
    hypothesis_costs: [f64; 2],
    rms_distance_m: f64,
    points: usize,
    points_used: usize,
    effective_measurements: f64,
    /// Misfit of the body's skin beyond the points' own noise, and what a cloud point and a silhouette ray are worth as
    /// parts of an independent measurement: what the standard deviations here rest on.
    skin_misfit_m: Option<f64>,
    information_per_point: Option<f64>,
    information_per_ray: Option<f64>,
    /// Whether single joints left the motion model, and by how much all the time, degrees, by joint.
    leaves_model: bool,
    posture_deg: BTreeMap<&'static str, [f64; 3]>,
    speed_m_s: f64,
    cadence_hz: f64,
    hip_height_m: f64,
    stature_m: f64,
    stature_sigma_m: f64,
    /// Factors on the template, by limb, with their standard deviations.
    lengths: BTreeMap<String, [f64; 2]>,
    widths: BTreeMap<String, [f64; 2]>,
    /// Standard deviation of each weight over the population's; near 1 the footage said nothing about it.
    weight_uncertainty: Vec<f64>,
    frames: Vec<FrameReport>,
}

#[derive(Serialize)]
struct CandidateReport<'a> {
    #[serde(flatten)]
    model: &'a ModelName,
    /// Of its better half-cycle and of the other one.
    costs: [f64; 2],
}

#[derive(Serialize)]
struct FrameReport {
    frame: usize,
    time_s: f64,
    status: &'static str,
    points: usize,
    points_used: usize,
    rms_distance_m: Option<f64>,
    phase: f64,
    phase_sigma: f64,
    position_sigma_m: f64,
    heading_sigma_deg: f64,
}

/// Writes the report of `fit`, for which these models were given.
pub fn write(path: &Path, fit: &Fit, observations: &[Observation], models: &[ModelName]) -> std::io::Result<()> {
    let sum = total(&fit.frames);
    let layout = fit.state.layout();
    let sigma = |i: usize| fit.shared_variance(i).sqrt();
    let limbs = |values: &[f64], index: &dyn Fn(Length) -> usize| {
        Length::ALL.iter().map(|l| (format!("{l:?}").to_lowercase(), [values[*l as usize], sigma(index(*l))])).collect()
    };
    let shape = fit.shape();
    let report = FitReport {
        software: concat!("muybridge ", env!("CARGO_PKG_VERSION")),
        model: &models[fit.model],
        candidates: models.iter().zip(&fit.candidates).map(|(model, c)| CandidateReport { model, costs: c.costs }).collect(),
        components: fit.state.weights.len(),
        iterations: fit.iterations,
        cost: sum.cost,
        hypothesis_costs: fit.half_cycles(),
        rms_distance_m: fit.rms_m(),
        points: observations.iter().map(|o| o.cloud.points.len()).sum(),
        points_used: sum.inliers,
        effective_measurements: sum.effective,
        skin_misfit_m: fit.uncertainty.as_ref().map(|u| u.misfit_m),
        information_per_point: fit.uncertainty.as_ref().map(|u| u.shares[0]),
        information_per_ray: fit.uncertainty.as_ref().map(|u| u.shares[1]),
        leaves_model: !fit.state.deviations.is_empty(),
        posture_deg: HELD.iter().zip(&fit.state.posture).map(|(j, turn)| (j.name(), (*turn).map(f64::to_degrees).into())).collect(),
        speed_m_s: fit.speed_m_s,
        cadence_hz: fit.cadence_hz,
        hip_height_m: shape.hip_height_m(),
        stature_m: shape.stature_m,
        stature_sigma_m: shape.stature_m * sigma(layout.stature()),
        lengths: limbs(&shape.lengths, &|l| layout.length(l)),
        widths: limbs(&shape.widths, &|l| layout.width(l)),
        weight_uncertainty: fit.weight_uncertainty(),
        frames: observations.iter().enumerate().map(|(t, o)| frame_report(fit, o, t)).collect(),
    };
    let mut text = serde_json::to_string_pretty(&report)?;
    text.push('\n');
    write_atomic(path, text.as_bytes())
}

fn frame_report(fit: &Fit, observation: &Observation, t: usize) -> FrameReport {
    let fitness = &fit.frames[t];
    let sigmas = fit.uncertainty.as_ref().map_or([f64::NAN; LOCAL], |u| u.frames[t].local);
    let status = match (observation.cloud.points.len(), fitness.inliers) {
        (0, _) => "no cloud, from its neighbours",
        (_, n) if n < FEW_POINTS => "few points, mostly from its neighbours",
        _ => "fitted",
    };
    let norm = |v: &[f64]| v.iter().map(|s| s * s).sum::<f64>().sqrt();
    FrameReport {
        frame: observation.number,
        time_s: observation.time_s,
        status,
        points: observation.cloud.points.len(),
        points_used: fitness.inliers,
        rms_distance_m: (fitness.inliers > 0).then(|| (fitness.inlier_square / fitness.inliers as f64).sqrt()),
        phase: fit.state.carriers[t].phase,
        phase_sigma: sigmas[6],
        position_sigma_m: norm(&sigmas[3..6]),
        heading_sigma_deg: norm(&sigmas[..3]).to_degrees(),
    }
}

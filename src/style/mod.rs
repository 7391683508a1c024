//! A person's style: weights in a motion model at one parameter, and the same person's weights at another.
//!
//! Style paper §4, equations 4 to 8. `distance` holds (6) and (7), `curves` the database subjects over the parameter,
//! `extrapolate` (8), `validate` the cross-validation of §5.2.

pub mod curves;
pub mod distance;
pub mod extrapolate;
pub mod space;
pub mod validate;

pub use curves::Population;
pub use distance::Metric;
pub use extrapolate::{Extrapolation, StyleError, extrapolate};

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use crate::body::Shape;
use crate::motion_model::{Activity, Cycle, Model};

/// A database subject and the distance to it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Neighbour {
    pub subject: String,
    /// Equation (6).
    pub distance: f64,
    /// √(Σ (Δα_i)²/λ_i).
    #[serde(default)]
    pub mahalanobis: f64,
    /// The largest distance (6) of the subject's own cycles to its curve, and whether this person is within it.
    #[serde(default)]
    pub own_spread: f64,
    #[serde(default)]
    pub inside: bool,
}

/// One person's style as observed once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Style {
    pub activity: Activity,
    /// Hash of the model that the weights belong to.
    pub model_hash: String,
    /// Observed speed in m/s, for jumps the length in m.
    pub parameter: f64,
    pub hip_height_m: f64,
    /// α of equation (2).
    pub weights: Vec<f64>,
    /// Covariance of the weights, rows, where the observation gave one.
    pub covariance: Option<Vec<Vec<f64>>>,
    /// Observed cycle frequency over the model's law at this parameter.
    pub cadence_factor: f64,
    /// Database subjects that move at this parameter, nearest first.
    pub neighbours: Vec<Neighbour>,
    /// Body size where the observation gave one.
    pub shape: Option<Shape>,
}

impl Style {
    /// From weights that were observed at `parameter` with cycles of `frequency_hz`.
    pub fn of_weights(
        model: &Model,
        model_hash: &str,
        weights: &DVector<f64>,
        parameter: f64,
        hip_height_m: f64,
        frequency_hz: f64,
    ) -> Style {
        let population = Population::new(model, weights.len());
        let neighbours = population.neighbours(model, weights, parameter);
        Style {
            activity: model.activity,
            model_hash: model_hash.to_string(),
            parameter,
            hip_height_m,
            weights: weights.iter().copied().collect(),
            covariance: None,
            cadence_factor: frequency_hz / model.cadence().frequency_hz(parameter, hip_height_m),
            neighbours,
            shape: None,
        }
    }

    /// The mean of one person's recorded cycles; `None` without cycles.
    pub fn of_cycles(model: &Model, model_hash: &str, cycles: &[Cycle]) -> Option<Style> {
        let n = cycles.len() as f64;
        let mean = |f: fn(&Cycle) -> f64| cycles.iter().map(f).sum::<f64>() / n;
        let first = cycles.first()?;
        let weights = cycles.iter().map(|c| model.project(&model.vector_of(c))).sum::<DVector<f64>>() / n;
        let frequency_hz = 1.0 / mean(|c| c.duration_s);
        Some(Style::of_weights(model, model_hash, &weights, mean(|c| c.parameter), first.hip_height_m, frequency_hz))
    }
}

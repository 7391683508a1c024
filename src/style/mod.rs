//! A person's style: weights in a motion model at one parameter, and the same person's weights at another.
//!
//! Style paper §4, equations 4 to 8. `distance` holds (6) and (7), `curves` the database subjects over the parameter,
//! `extrapolate` (8), `transfer` the default that keeps the own motion, `validate` the cross-validation of §5.2.

pub mod angles;
pub mod curves;
pub mod distance;
pub mod errors;
pub mod extrapolate;
pub mod identity;
pub mod nearest;
pub mod space;
pub mod transfer;
pub mod validate;

pub use curves::Population;
pub use distance::Metric;
pub use extrapolate::{Extrapolation, StyleError, extrapolate};
pub use identity::Recognised;
pub use nearest::Nearest;
pub use transfer::transfer;

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use crate::body::Shape;
use crate::motion_model::{Activity, Cycle, Departure, Detail, Member, Model};
use curves::{Knot, knots, mean_root, mean_vector};

/// How the weights at another parameter are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// The own motion kept, see [`transfer`].
    Default,
    /// Equations (6) to (8), or with another distance in place of (6).
    Paper(Metric),
}

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
    /// Natural logarithm of how much better this subject explains the motion than somebody drawn from the population
    /// ([`identity`]); above 0 the person is rather this one than a stranger.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub log_odds: Option<f64>,
}

/// The weights that recordings of a person in the database's manner are expected to have, see [`identity`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Expected {
    pub weights: Vec<f64>,
    /// Rows.
    pub covariance: Vec<Vec<f64>>,
}

impl From<Recognised> for Expected {
    fn from(found: Recognised) -> Expected {
        let covariance = found.covariance.row_iter().map(|row| row.iter().copied().collect()).collect();
        Expected { weights: found.weights.as_slice().to_vec(), covariance }
    }
}

/// How large somebody is and how fast the observed motion went.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Speed in m/s, for jumps the length in m.
    pub parameter: f64,
    pub hip_height_m: f64,
    /// Cycles per second.
    pub frequency_hz: f64,
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
    /// Of a tracked motion. `weights` describe the motion, with all that the tracked skeleton and the recorded ones do not
    /// share; these are the person's among the recorded, and what the neighbours' distances are measured from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<Expected>,
    /// Database subjects that move at this parameter, nearest first.
    pub neighbours: Vec<Neighbour>,
    /// Body size where the observation gave one.
    pub shape: Option<Shape>,
    /// What of a tracked motion the weights do not hold.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub departure: Option<Departure>,
    /// The same sample by sample, or of a recorded motion; files do not keep it.
    #[serde(skip)]
    pub detail: Option<Detail>,
    /// The same person at other parameters.
    #[serde(default)]
    pub also: Vec<Observation>,
}

/// One person's motion at one parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Observation {
    /// Speed in m/s, for jumps the length in m.
    pub parameter: f64,
    pub weights: Vec<f64>,
    pub covariance: Option<Vec<Vec<f64>>>,
    pub cadence_factor: f64,
    #[serde(skip)]
    pub detail: Option<Detail>,
}

impl Observation {
    /// The mean of recorded cycles of one person.
    pub fn of_knot(model: &Model, knot: &Knot) -> Observation {
        let mean = |f: fn(&Member) -> f64| knot.members.iter().map(|m| f(m)).sum::<f64>() / knot.members.len() as f64;
        let (vector, root) = (mean_vector(knot), mean_root(knot));
        let weights = model.project(&vector);
        let detail = Detail { vector: vector - model.vector(weights.as_slice()), root: root - model.root(weights.as_slice()) };
        let law_hz = model.cadence().frequency_hz(knot.parameter, mean(|m| m.hip_height_m));
        Observation {
            parameter: knot.parameter,
            weights: weights.as_slice().to_vec(),
            covariance: None,
            cadence_factor: 1.0 / (mean(|m| m.duration_s) * law_hz),
            detail: Some(detail),
        }
    }

    /// Whether it holds `wanted` finite weights.
    fn check(&self, wanted: usize) -> Result<(), StyleError> {
        let found = self.weights.len();
        if found < wanted {
            return Err(StyleError::Weights { found, wanted });
        }
        let finite = self.parameter.is_finite() && self.weights.iter().all(|w| w.is_finite());
        if finite { Ok(()) } else { Err(StyleError::NotFinite) }
    }

    /// Variance of weight `i`, 0 where the observation gave none.
    fn variance(&self, i: usize) -> f64 {
        let entry = self.covariance.as_ref().and_then(|c| c.get(i)?.get(i).copied());
        entry.filter(|v| v.is_finite() && *v > 0.0).unwrap_or(0.0)
    }
}

impl Style {
    /// Weights of this person at `parameter` (m/s or m); `population` comes from the model of the style.
    pub fn at(&self, population: &Population, method: Method, parameter: f64) -> Result<Extrapolation, StyleError> {
        match method {
            Method::Default => transfer(population, &self.observations(), parameter),
            Method::Paper(metric) => extrapolate(population, metric, &self.weights, self.parameter, parameter),
        }
    }

    /// With what of a tracked motion the weights do not hold.
    pub fn departing(self, departure: Option<Departure>) -> Style {
        Style { detail: departure.as_ref().map(Departure::detail), departure, ..self }
    }

    fn recognise(&self, model: &Model, population: &Population) -> Option<Recognised> {
        let mut vector = model.vector(&self.weights);
        if let Some(detail) = &self.detail {
            vector += &detail.vector;
        }
        identity::recognise(population, model, &vector, self.parameter)
    }

    /// Where the person is among the database's subjects, with the covariance of that.
    pub fn place(&self) -> (&[f64], Option<&Vec<Vec<f64>>>) {
        match &self.expected {
            Some(expected) => (&expected.weights, Some(&expected.covariance)),
            None => (&self.weights, self.covariance.as_ref()),
        }
    }

    /// The subject that explains the motion best, with its log odds against a stranger.
    pub fn likeliest(&self) -> Option<(&str, f64)> {
        let known = self.neighbours.iter().filter_map(|n| Some((n.subject.as_str(), n.log_odds?)));
        known.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// With what was seen of the same person at other times; the first observation stays the main one.
    pub fn and(mut self, other: Style) -> Style {
        self.also.extend(other.observations());
        self
    }

    /// All that was seen of the person.
    pub fn observations(&self) -> Vec<Observation> {
        let first = Observation {
            parameter: self.parameter,
            weights: self.weights.clone(),
            covariance: self.covariance.clone(),
            cadence_factor: self.cadence_factor,
            detail: self.detail.clone(),
        };
        [first].into_iter().chain(self.also.iter().cloned()).collect()
    }

    /// Cycle frequency over the model's law, as observed nearest to `parameter`.
    pub fn cadence_factor_at(&self, parameter: f64) -> f64 {
        let mut nearest = (self.parameter, self.cadence_factor);
        for seen in &self.also {
            if (seen.parameter - parameter).abs() < (nearest.0 - parameter).abs() {
                nearest = (seen.parameter, seen.cadence_factor);
            }
        }
        nearest.1
    }

    /// From weights that were observed.
    pub fn of_weights(model: &Model, model_hash: &str, weights: &DVector<f64>, pace: Pace) -> Style {
        let population = Population::new(model, weights.len());
        Style::alone(model, model_hash, weights, pace).among(model, &population, weights, None)
    }

    /// The same of a tracked motion, with what of it the weights do not hold: with the odds that this is one of the database's
    /// subjects, the expected weights, and distances from these.
    pub fn of_tracked(model: &Model, model_hash: &str, weights: &DVector<f64>, pace: Pace, departure: Option<Departure>) -> Style {
        let style = Style::alone(model, model_hash, weights, pace).departing(departure);
        let population = Population::new(model, weights.len());
        let found = style.recognise(model, &population);
        let place = found.as_ref().map_or(weights, |f| &f.weights);
        let style = style.among(model, &population, place, found.as_ref());
        Style { expected: found.map(Expected::from), ..style }
    }

    /// Without anybody beside it.
    fn alone(model: &Model, model_hash: &str, weights: &DVector<f64>, pace: Pace) -> Style {
        Style {
            activity: model.activity,
            model_hash: model_hash.to_string(),
            parameter: pace.parameter,
            hip_height_m: pace.hip_height_m,
            weights: weights.iter().copied().collect(),
            covariance: None,
            cadence_factor: pace.frequency_hz / model.cadence().frequency_hz(pace.parameter, pace.hip_height_m),
            expected: None,
            neighbours: Vec::new(),
            shape: None,
            departure: None,
            detail: None,
            also: Vec::new(),
        }
    }

    /// With the database's subjects by their distance from `place`, and the odds of those that were recognised.
    fn among(self, model: &Model, population: &Population, place: &DVector<f64>, found: Option<&Recognised>) -> Style {
        let mut neighbours = population.neighbours(model, place, self.parameter);
        for (subject, odds) in found.iter().flat_map(|f| &f.odds) {
            let neighbour = neighbours.iter_mut().find(|n| n.subject == *subject);
            neighbour.into_iter().for_each(|n| n.log_odds = Some(*odds));
        }
        Style { neighbours, ..self }
    }

    /// One person's recorded cycles: the mean at the parameter with the most of them, the means at the others beside it;
    /// `None` without cycles.
    pub fn of_cycles(model: &Model, model_hash: &str, cycles: &[Cycle]) -> Option<Style> {
        let members: Vec<Member> = cycles.iter().map(|c| model.member_of(c)).collect();
        let knots = knots(&members);
        let main = (0..knots.len()).max_by_key(|&k| (knots[k].members.len(), std::cmp::Reverse(k)))?;
        let mut also: Vec<Observation> = knots.iter().map(|k| Observation::of_knot(model, k)).collect();
        let first = also.remove(main);
        let weights = DVector::from_vec(first.weights);
        let n = cycles.len() as f64;
        let hip_height_m = cycles.iter().map(|c| c.hip_height_m).sum::<f64>() / n;
        let frequency_hz = first.cadence_factor * model.cadence().frequency_hz(first.parameter, hip_height_m);
        let pace = Pace { parameter: first.parameter, hip_height_m, frequency_hz };
        let style = Style { detail: first.detail, also, ..Style::alone(model, model_hash, &weights, pace) };
        let population = Population::new(model, weights.len());
        let found = style.recognise(model, &population);
        Some(style.among(model, &population, &weights, found.as_ref()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{DOF, Joint};
    use crate::motion_model::synthetic;

    #[test]
    fn what_tracking_saw_beside_the_weights_goes_on_at_other_speeds() {
        let people = |s: u64| [0.9, 1.2, 1.5].map(|v| synthetic::subject(Activity::Walking, s).mean_cycle(v));
        let model = Model::build(Activity::Walking, true, &(1..=6).flat_map(people).collect::<Vec<_>>()).unwrap();
        let weights = model.project(&model.vector_of(&people(1000)[1])).rows(0, 5).into_owned();
        let bent = Departure { turns: [("l_knee".to_string(), vec![[0.1, 0.0, 0.0]])].into(), root_height: -0.02 };
        let plain = Style::of_weights(&model, "", &weights, Pace { parameter: 1.2, hip_height_m: 0.9, frequency_hz: 0.95 });
        let style = plain.clone().departing(Some(bent.clone()));
        let population = Population::new(&model, 5);
        let knee = 3 * (Joint::LKnee as usize - 1);
        for parameter in [0.9, 1.2, 1.5] {
            let at = |s: &Style| s.at(&population, Method::Default, parameter).unwrap();
            let (with, without) = (at(&style), at(&plain));
            assert!(without.detail.is_none() && with.weights == without.weights);
            let kept = with.detail.clone().unwrap().vector[knee] / 0.1;
            assert!(if parameter == 1.2 { (kept - 1.0).abs() < 1e-4 } else { (0.5..1.3).contains(&kept) }, "{parameter}: {kept}");
            let cycle = |found: &Extrapolation| model.cycle_with(found.weights.as_slice(), found.detail.as_ref(), parameter, 0.9, 1.0);
            let change = model.vector_of(&cycle(&with)) - model.vector_of(&cycle(&without));
            for (i, v) in change.iter().enumerate() {
                let wanted = if i % DOF == knee { 0.1 * kept } else { 0.0 };
                assert!((v - wanted).abs() < 1e-9, "{i}: {v}");
            }
            let lower = cycle(&with).root[50].position.y - cycle(&without).root[50].position.y;
            assert!((lower + 0.02 * kept).abs() < 1e-9);
        }
        let paper = style.at(&population, Method::Paper(Metric::Paper), 1.5).unwrap();
        assert!(paper.detail.is_none());
    }
}

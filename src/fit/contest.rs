//! Which motion model the footage shows: the one with the largest evidence.
//!
//! On frames [`APART_S`] apart every model gets its best start and the one half a cycle away, as in the fit itself: the mean motion
//! placed and turned, then ten weights. With θ the unknowns there, P the precision that data and priors give the weights α, other
//! unknowns eliminated, and Λ their variances in the database,
//!   −ln p(data | model) ≈ E_data(θ) + E_prior(θ) + ½ ln det(Λ P),                                                  (1)
//! Laplace's approximation but for what all models have in common; E_data is the robust cost. So a model pays for people unlike
//! its own and for weights that the data need to know well, whatever their number. A model whose mean motion is far behind another's
//! (factor [`HOPELESS`]) is judged by that: its cost is a bound, no weights are sought.
//! Departure: the paper is told what the person does.
//! Fails when: the person does two things in one sequence.
//! Checked against phantoms that walk, run and jump, and recorded walks and a run.

use nalgebra::DMatrix;

use super::curve::Curve;
use super::problem::{Frame, Known, Problem, Settings};
use super::start::{self, Track};
use super::state::State;
use super::weighing::total;
use super::{Checkpoints, PointResidual, ROUGH_M, Run, SEARCH_M, SETTINGS, STEADY_PHASE, STYLED, pair};
use crate::math::arrow::ArrowProblem;
use crate::motion_model::Model;

/// Seconds between the frames that decide; a stride of a fast run is seen six times, and nothing is gained by more.
const APART_S: f64 = 0.1;
/// Mean motions that cost so many times the best one's are out.
const HOPELESS: f64 = 2.0;

/// How one model did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Equation (1) of the better half-cycle and of the other one.
    pub costs: [f64; 2],
}

/// Place of the candidate that costs least; the first of none.
pub fn best(candidates: &[Candidate]) -> usize {
    (0..candidates.len()).min_by(|a, b| candidates[*a].costs[0].total_cmp(&candidates[*b].costs[0])).unwrap_or(0)
}

/// Place of the candidate that costs least after the [`best`] one, where there is one.
pub fn runner_up(candidates: &[Candidate]) -> Option<usize> {
    let best = best(candidates);
    let others = (0..candidates.len()).filter(|k| *k != best);
    others.min_by(|a, b| candidates[*a].costs[0].total_cmp(&candidates[*b].costs[0]))
}

/// Equation (1) of every model on some of the frames.
pub(super) fn contest(models: &[&Model], track: &Track, frames: &[Frame], known: &Known) -> Vec<Candidate> {
    let some = apart(frames);
    let track = track.at(&some);
    let frames: Vec<Frame> = some.iter().map(|t| frames[*t].clone()).collect();
    let mut run = Run { known: *known, residual: PointResidual::Distance, iterations: 0, checkpoints: &Checkpoints::NONE, stages: 0 };
    let search = Settings { model_m: SEARCH_M, ..SETTINGS };
    let rough = Settings { model_m: ROUGH_M, phase_acceleration: STEADY_PHASE, ..SETTINGS };
    let placed: Vec<Vec<(f64, State)>> = models
        .iter()
        .map(|model| {
            let mean = Curve::new(model, 0);
            let found = start::hypotheses(&track, &frames, &mean, model, &search, known);
            let halves = pair(&found).into_iter().map(|h| {
                let state = run.placed(h.state.clone(), &frames, &mean);
                (cost(&mean, &frames, &rough, known, &state), state)
            });
            halves.collect()
        })
        .collect();
    let least = placed.iter().flatten().map(|half| half.0).fold(f64::INFINITY, f64::min);
    let of_model = |(model, halves): (&&Model, Vec<(f64, State)>)| {
        let ten = Curve::new(model, 10);
        let costs = halves.into_iter().map(|(placed, state)| {
            if placed > HOPELESS * least {
                return placed;
            }
            cost(&ten, &frames, &rough, known, &run.styled(state, &frames, &ten))
        });
        let costs: Vec<f64> = costs.collect();
        let (a, b) = (costs[0], costs[costs.len() - 1]);
        Candidate { costs: [a.min(b), a.max(b)] }
    };
    models.iter().zip(placed).map(of_model).collect()
}

/// Frames at least [`APART_S`] apart, but never fewer than a start needs.
fn apart(frames: &[Frame]) -> Vec<usize> {
    let mut chosen: Vec<usize> = Vec::new();
    for (t, frame) in frames.iter().enumerate() {
        if chosen.last().is_none_or(|last| frame.time_s - frames[*last].time_s > APART_S - 1e-6) {
            chosen.push(t);
        }
    }
    if chosen.len() < start::FEWEST_FRAMES { (0..frames.len()).collect() } else { chosen }
}

/// Equation (1) at a state.
fn cost(curve: &Curve, frames: &[Frame], settings: &Settings, known: &Known, state: &State) -> f64 {
    let problem = Problem::new(curve, frames, settings, STYLED, known, state);
    let covariance = problem.linearise(state).shared_covariance();
    let weights = curve.components();
    let occam = covariance.map_or(0.0, |c| {
        let scale = |i: usize| curve.eigenvalues[i].sqrt();
        let relative = DMatrix::from_fn(weights, weights, |i, j| c[(i, j)] / (scale(i) * scale(j)));
        -0.5 * relative.determinant().ln()
    });
    total(&problem.fitness).cost + problem.prior_cost(state) + occam
}

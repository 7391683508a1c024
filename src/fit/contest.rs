//! The rough start: which motion model the footage shows, which half of the cycle, and where.
//!
//! On frames [`APART_S`] apart every model gets its best start and the one half a cycle away: the mean motion placed and turned,
//! then ten weights; the one with the largest evidence is chosen. With θ the unknowns there, P the precision that data and
//! priors give the weights α, other unknowns eliminated, and Λ their variances in the database,
//!   −ln p(data | model) ≈ E_data(θ) + E_prior(θ) + ½ ln det(Λ P),                                                  (1)
//! Laplace's approximation but for what all models have in common; E_data is the robust cost. So a model pays for people unlike
//! its own and for weights that the data need to know well, whatever their number. A model whose mean motion is far behind another's
//! (factor [`HOPELESS`]) is judged by that: its cost is a bound, no weights are sought.
//! Departure: the paper is told what the person does.
//! Fails when: the person does two things in one sequence.
//! Checked against phantoms that walk, run and jump, and recorded walks and a run.

use std::fmt;

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::curve::Curve;
use super::problem::{Frame, Free, Known, Problem, Settings};
use super::start::{self, Hypothesis, Track};
use super::state::State;
use super::weighing::total;
use super::{PLACED, ROUGHLY_M, Run, SETTINGS, STYLED, Stage, TURNED};
use crate::math::arrow::ArrowProblem;
use crate::motion_model::Model;

/// Seconds between the frames that decide; a stride of a fast run is seen six times, and nothing is gained by more.
const APART_S: f64 = 0.1;
/// Fewer frames are looked at all.
const FEWEST_FRAMES: usize = 12;
/// Steadiness of the phase while the start is still rough.
const STEADY_PHASE: f64 = 0.3;
/// Difference between skins in the search for a start, and once weights are found roughly, metres.
const SEARCH_M: f64 = 0.06;
const ROUGH_M: f64 = 0.04;
/// Mean motions that cost so many times the best one's are out.
const HOPELESS: f64 = 2.0;

/// How one model did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Equation (1) of the better half-cycle and of the other one.
    pub costs: [f64; 2],
}

impl fmt::Display for Candidate {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{:.0} ({:.0})", self.costs[0], self.costs[1])
    }
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

/// The best start of the model that explains the frames best, on these frames, and how all did.
pub(super) fn contest(models: &[&Model], track: &Track, frames: &[Frame], known: &Known) -> (State, Vec<Candidate>) {
    let search = rough(SEARCH_M);
    let begin = |model: &&Model| -> Vec<(f64, State)> {
        let mean = Curve::new(model, 0);
        let found = start::hypotheses(track, frames, &mean, model, &search, known);
        let placed = |h: &Hypothesis| {
            let state = placed(known, h.state.clone(), frames, &mean);
            (cost(&mean, frames, known, &state), state)
        };
        pair(&found).into_par_iter().map(placed).collect()
    };
    let begun: Vec<_> = models.par_iter().map(begin).collect();
    let least = begun.iter().flatten().map(|half| half.0).fold(f64::INFINITY, f64::min);
    let finish = |(model, halves): (&&Model, Vec<(f64, State)>)| -> Vec<(f64, State)> {
        let ten = Curve::new(model, 10);
        let styled = |(placed, state): (f64, State)| {
            if placed > HOPELESS * least {
                return (placed, state);
            }
            let state = styled(known, state, frames, &ten);
            (cost(&ten, frames, known, &state), state)
        };
        let mut halves: Vec<_> = halves.into_par_iter().map(styled).collect();
        halves.sort_by(|a, b| a.0.total_cmp(&b.0));
        halves
    };
    let mut done: Vec<_> = models.par_iter().zip(begun).map(finish).collect();
    let candidates: Vec<Candidate> = done.iter().map(|halves| Candidate { costs: [halves[0].0, halves[halves.len() - 1].0] }).collect();
    (done.swap_remove(best(&candidates)).swap_remove(0).1, candidates)
}

/// The best hypothesis and the best one about half a cycle from it, which for a jump is another timing.
fn pair(found: &[Hypothesis]) -> Vec<&Hypothesis> {
    let Some(best) = found.first() else { return Vec::new() };
    let middle = |h: &Hypothesis| h.state.carriers[h.state.carriers.len() / 2].phase;
    let opposite = found.iter().skip(1).find(|h| ((middle(h) - middle(best) - 0.5).rem_euclid(1.0) - 0.5).abs() > 0.3);
    std::iter::once(best).chain(opposite).collect()
}

/// Settings where skins may be `model_m` apart.
fn rough(model_m: f64) -> Settings {
    Settings { model_m, phase_acceleration: STEADY_PHASE, at_skin: false, ..SETTINGS }
}

/// The first rough stages: the mean motion, placed and turned.
fn placed(known: &Known, state: State, frames: &[Frame], mean: &Curve) -> State {
    let mut run = Run::rough(known);
    let state = run.stage(state, frames, mean, &stage(PLACED, 0.08, 4));
    run.stage(state, frames, mean, &stage(TURNED, 0.06, 6))
}

/// The last rough stage: the weights of `ten`, stature and widths.
fn styled(known: &Known, state: State, frames: &[Frame], ten: &Curve) -> State {
    let state = State { weights: vec![0.0; ten.components()], ..state };
    Run::rough(known).stage(state, frames, ten, &stage(STYLED, ROUGH_M, 8))
}

fn stage(free: Free, model_m: f64, most_rounds: usize) -> Stage {
    Stage { free, settings: rough(model_m), most_rounds, still_m: ROUGHLY_M }
}

/// Frames at least [`APART_S`] apart, the first and the last among them; all where that leaves fewer than [`FEWEST_FRAMES`].
pub(super) fn apart(times_s: &[f64]) -> Vec<usize> {
    let mut chosen = vec![0];
    for t in 1..times_s.len() {
        // Half a millisecond: times are sums of rounded frame times.
        if times_s[t] - times_s[chosen[chosen.len() - 1]] > APART_S - 5e-4 || t + 1 == times_s.len() {
            chosen.push(t);
        }
    }
    if chosen.len() < FEWEST_FRAMES { (0..times_s.len()).collect() } else { chosen }
}

/// Equation (1) at a state.
fn cost(curve: &Curve, frames: &[Frame], known: &Known, state: &State) -> f64 {
    let settings = rough(ROUGH_M);
    let problem = Problem::new(curve, frames, &settings, STYLED, known, state);
    let covariance = problem.linearise(state).shared_covariance();
    let weights = curve.components();
    let occam = covariance.map_or(0.0, |c| {
        let scale = |i: usize| curve.eigenvalues[i].sqrt();
        let relative = DMatrix::from_fn(weights, weights, |i, j| c[(i, j)] / (scale(i) * scale(j)));
        -0.5 * relative.determinant().ln()
    });
    total(&problem.fitness).cost + problem.prior_cost(state) + occam
}

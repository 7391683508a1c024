//! Where to begin, without clicks: track, heading and stature from the clouds, cadence and phase by search.
//!
//! The median point of each cloud, pushed half a body's depth away from the cameras, follows a parabola over time; its
//! velocity is the heading, and the cadence is that of the model's members at the nearest normalised speed v/H. Cadences
//! around it times twenty phases are scored by the robust cost of the mean motion, all on a third of the frames and the best
//! quarter on all; the solution half a cycle away, with the legs swapped, is always kept as a second hypothesis.
//! Fails when: the person turns by more than about 60 degrees, or is seen from the waist up only.

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::FitError;
use super::curve::Curve;
use super::people::Person;
use super::problem::{Frame, Known, Settings};
use super::state::{Carrier, Posture, State};
use super::weighing::{fitness, total};
use crate::body::Shape;
use crate::math::order::quantile;
use crate::motion_model::Model;

/// Clouds with fewer points say nothing about where the person is.
const FEWEST_POINTS: usize = 60;
/// A path of fewer frames has no speed.
pub const FEWEST_FRAMES: usize = 5;
/// From the front of the body to its middle.
const HALF_DEPTH_M: f64 = 0.09;
/// A floor farther than this from the lowest points is not the one that the person walks on.
const STANDING_ON_M: f64 = 0.2;
/// Slower than this the path has no heading and all directions are tried.
const STANDING_M_S: f64 = 0.25;
const CADENCES: [f64; 5] = [0.8, 0.9, 1.0, 1.1, 1.2];
const PHASES: usize = 20;
const HEADINGS: usize = 8;
/// Frames of the search.
const SEARCH_FRAMES: usize = 18;
/// One in so many is looked at first, and then all of them by one hypothesis in so many.
const FIRST: usize = 3;
const FINALISTS: usize = 4;

/// The person's track through the sequence.
#[derive(Clone, Debug)]
pub struct Track {
    pub stature_m: f64,
    /// Height of the floor along the up axis, metres.
    pub floor_m: f64,
    /// Carrier positions per frame.
    positions: Vec<Vector3<f64>>,
    /// Horizontal velocity, m/s.
    velocity: Vector3<f64>,
    up: Vector3<f64>,
}

impl Track {
    /// The track on some of its frames.
    pub fn at(&self, frames: &[usize]) -> Track {
        Track { positions: frames.iter().map(|t| self.positions[*t]).collect(), ..self.clone() }
    }
}

/// A start for the solver.
#[derive(Clone, Debug)]
pub struct Hypothesis {
    pub state: State,
    /// Phase at the first frame and cycles per second.
    pub phase: f64,
    pub cadence_hz: f64,
}

/// Track, heading and stature from the clouds.
pub fn track(people: &[Person], viewpoint: &Vector3<f64>, up: &Vector3<f64>, floor_m: Option<f64>) -> Result<Track, FitError> {
    let seen: Vec<&Person> = people.iter().filter(|p| p.points().len() >= FEWEST_POINTS).collect();
    let nobody = || FitError::NobodySeen { frames: people.len(), with_person: seen.len(), points: FEWEST_POINTS };
    if seen.len() < FEWEST_FRAMES {
        return Err(nobody());
    }
    let (lowest, top) = extent(&seen, up).ok_or_else(nobody)?;
    let floor = floor_m.filter(|floor| (floor - lowest).abs() < STANDING_ON_M).unwrap_or(lowest);
    let stature = (top - floor).clamp(1.2, 2.1);
    let horizontal = |v: Vector3<f64>| v - up * v.dot(up);
    let deeper = |x: Vector3<f64>| horizontal(x) + horizontal(x - viewpoint).normalize() * HALF_DEPTH_M;
    let places: Vec<Vector3<f64>> = seen.iter().filter_map(|p| median(p)).map(deeper).collect();
    let middle = seen.iter().map(|p| p.time_s()).sum::<f64>() / seen.len() as f64;
    let times: Vec<f64> = seen.iter().map(|p| p.time_s() - middle).collect();
    let coefficients = parabola(&times, &places).ok_or_else(nobody)?;
    let hip = up * (floor + Shape::template(stature).hip_height_m());
    let at = |t: f64| coefficients[0] + coefficients[1] * t + coefficients[2] * t * t + hip;
    Ok(Track {
        stature_m: stature,
        floor_m: floor,
        positions: people.iter().map(|p| at(p.time_s() - middle)).collect(),
        velocity: coefficients[1],
        up: *up,
    })
}

/// Heights of the lowest and highest point: quantiles of each cloud against stray points, then medians over the frames.
fn extent(seen: &[&Person], up: &Vector3<f64>) -> Option<(f64, f64)> {
    let middle = |q: f64| {
        let of_cloud = |p: &&Person| quantile(p.points().map(|p| p.position.dot(up)).collect(), q);
        quantile(seen.iter().filter_map(of_cloud).collect(), 0.5)
    };
    Some((middle(0.003)?, middle(0.997)?))
}

fn median(person: &Person) -> Option<Vector3<f64>> {
    let along = |axis: usize| quantile(person.points().map(|p| p.position[axis]).collect(), 0.5);
    Some(Vector3::new(along(0)?, along(1)?, along(2)?))
}

/// Least-squares parabola through points over time, twice reweighted against outliers; `None` if singular.
fn parabola(times: &[f64], points: &[Vector3<f64>]) -> Option<[Vector3<f64>; 3]> {
    let mut weights = vec![1.0; times.len()];
    let mut coefficients = [Vector3::zeros(); 3];
    for _ in 0..4 {
        let a = DMatrix::from_fn(times.len(), 3, |i, k| weights[i] * times[i].powi(k as i32));
        let factor = a.tr_mul(&a).cholesky()?;
        for axis in 0..3 {
            let b = DVector::from_fn(times.len(), |i, _| weights[i] * points[i][axis]);
            let c = factor.solve(&a.tr_mul(&b));
            (0..3).for_each(|k| coefficients[k][axis] = c[k]);
        }
        for ((w, t), p) in weights.iter_mut().zip(times).zip(points) {
            let miss = (coefficients[0] + coefficients[1] * *t + coefficients[2] * (t * t) - p).norm();
            *w = 1.0 / (1.0 + (miss / 0.15).powi(2)).sqrt();
        }
    }
    Some(coefficients)
}

/// Duration-weighted cadence of the members nearest in normalised speed v/H, cycles per second.
fn expected_cadence(model: &Model, speed: f64, hip_height: f64) -> f64 {
    let mut members: Vec<(f64, f64)> =
        model.members.iter().map(|m| ((m.parameter / m.hip_height_m - speed / hip_height).abs(), 1.0 / m.duration_s)).collect();
    members.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let near = &members[..members.len().min(8)];
    if near.is_empty() { 1.0 } else { near.iter().map(|m| m.1).sum::<f64>() / near.len() as f64 }
}

/// Starts, the likeliest first.
pub fn hypotheses(track: &Track, frames: &[Frame], curve: &Curve, model: &Model, settings: &Settings, known: &Known) -> Vec<Hypothesis> {
    let hip_height = Shape::template(track.stature_m).hip_height_m();
    let cyclic = curve.is_cyclic();
    let cadence = if cyclic {
        expected_cadence(model, track.velocity.norm(), hip_height)
    } else {
        model.members.len() as f64 / model.members.iter().map(|m| m.duration_s).sum::<f64>().max(0.1)
    };
    let headings: Vec<Vector3<f64>> = if track.velocity.norm() > STANDING_M_S {
        vec![track.velocity.normalize()]
    } else {
        (0..HEADINGS)
            .map(|i| Rotation3::new(track.up * (std::f64::consts::TAU * i as f64 / HEADINGS as f64)) * any_horizontal(&track.up))
            .collect()
    };
    let chosen: Vec<usize> = (0..frames.len()).step_by(frames.len().div_ceil(SEARCH_FRAMES)).collect();
    let searched: Vec<Frame> = chosen.iter().map(|t| frames[*t].half()).collect();
    let first: Vec<Frame> = searched.iter().step_by(FIRST).cloned().collect();
    let last = frames.last().map_or(0.0, |f| f.time_s) - frames.first().map_or(0.0, |f| f.time_s);
    let mut grid = Vec::new();
    for heading in &headings {
        for factor in CADENCES {
            for step in 0..PHASES {
                let hz = cadence * factor;
                // A jump may begin anywhere such that it ends near the end of the sequence or begins near its start.
                let phase = if cyclic { step as f64 / PHASES as f64 } else { -(last * hz - 0.5).max(0.2) * step as f64 / PHASES as f64 };
                grid.push((*heading, hz, phase));
            }
        }
    }
    let begin = |(heading, hz, phase): &(Vector3<f64>, f64, f64)| {
        let state = state_of(track, frames, curve, heading, *hz, *phase);
        Hypothesis { state, phase: *phase, cadence_hz: *hz }
    };
    let cost = |Hypothesis { state, .. }: &Hypothesis, step: usize| {
        let carriers = chosen.iter().step_by(step).map(|t| state.carriers[*t].clone()).collect();
        let searched = if step == 1 { &searched } else { &first };
        total(&fitness(curve, searched, settings, known, &State { carriers, ..state.clone() })).cost
    };
    let mut found: Vec<(f64, Hypothesis)> = grid.par_iter().map(begin).map(|h| (cost(&h, FIRST), h)).collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    let finalists = found.len().div_ceil(FINALISTS);
    found[..finalists].par_iter_mut().for_each(|(of_all, h)| *of_all = cost(h, 1));
    found[..finalists].sort_by(|a, b| a.0.total_cmp(&b.0));
    found.into_iter().map(|(_, h)| h).collect()
}

fn any_horizontal(up: &Vector3<f64>) -> Vector3<f64> {
    let helper = if up.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
    (helper - up * up.dot(&helper)).normalize()
}

fn state_of(track: &Track, frames: &[Frame], curve: &Curve, heading: &Vector3<f64>, cadence: f64, phase: f64) -> State {
    let left = track.up.cross(heading);
    let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[left, track.up, *heading]));
    let world_from_carrier = UnitQuaternion::from_rotation_matrix(&axes);
    let begin = frames.first().map_or(0.0, |f| f.time_s);
    let standing = track.positions.first().copied().unwrap_or_default();
    let carriers = frames.iter().zip(&track.positions).map(|(frame, position)| Carrier {
        position: if curve.is_cyclic() { *position } else { standing },
        world_from_carrier,
        phase: phase + cadence * (frame.time_s - begin),
    });
    State {
        carriers: carriers.collect(),
        weights: vec![0.0; curve.components()],
        shape: Shape::template(track.stature_m),
        posture: Posture::default(),
        deviations: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parabola_ignores_a_few_wild_points() {
        let times: Vec<f64> = (0..30).map(|i| i as f64 / 30.0 - 0.5).collect();
        let truth = [Vector3::new(1.0, 3.0, 0.0), Vector3::new(1.4, -0.2, 0.0), Vector3::new(0.1, 0.05, 0.0)];
        let mut points: Vec<_> = times.iter().map(|t| truth[0] + truth[1] * *t + truth[2] * (t * t)).collect();
        points[7] += Vector3::new(0.0, 2.0, 0.0);
        let found = parabola(&times, &points).unwrap();
        assert!((found[1] - truth[1]).norm() < 0.05, "{found:?}");
    }
}

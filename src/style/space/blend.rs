//! Shape played at its timing: any vector of the space as a motion.

use nalgebra::{DVector, UnitQuaternion, Vector3};

use super::example::{CURVES, Example, PROGRESS, Posture};
use super::interpolate::at;
use crate::body::{BALL_JOINTS, Clip, DOF, NODES, Pose};
use crate::math::rotation::exp;
use crate::motion_model::RootSample;

/// A shape vector and a timing vector of one space.
#[derive(Clone, Debug, PartialEq)]
pub struct Vectors {
    /// Curves at the reference's knots, index `knot·84 + curve`, and last the stride over the hip height.
    pub shape: DVector<f64>,
    /// Seconds from the start to the knots 1, 2, …, once or for each curve, index `curve·intervals + knot − 1`.
    pub timing: DVector<f64>,
}

impl Vectors {
    /// `self` + `shape`·`other`'s shape + `timing`·`other`'s timing.
    pub fn plus(&self, other: &Vectors, shape: f64, timing: f64) -> Vectors {
        Vectors { shape: &self.shape + &other.shape * shape, timing: &self.timing + &other.timing * timing }
    }

    pub fn minus(&self, other: &Vectors) -> Vectors {
        self.plus(other, -1.0, -1.0)
    }

    /// Σ w x of vectors of one space; `zero` gives the lengths.
    pub fn sum<'a>(zero: &Vectors, terms: impl Iterator<Item = (f64, &'a Vectors)>) -> Vectors {
        let mut sum = Vectors { shape: zero.shape.map(|_| 0.0), timing: zero.timing.map(|_| 0.0) };
        for (weight, x) in terms {
            sum.shape.axpy(weight, &x.shape, 1.0);
            sum.timing.axpy(weight, &x.timing, 1.0);
        }
        sum
    }
}

/// How the numbers of a space's vectors are laid out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    /// Intervals between knots; a cycle has as many knots, an open motion one more.
    pub intervals: usize,
    pub cyclic: bool,
    /// One timing for each curve, or one for all.
    pub per_curve: bool,
}

impl Layout {
    pub fn knots(&self) -> usize {
        self.intervals + usize::from(!self.cyclic)
    }

    pub fn shape_len(&self) -> usize {
        self.knots() * CURVES + 1
    }

    pub fn timing_len(&self) -> usize {
        self.intervals * if self.per_curve { CURVES } else { 1 }
    }
}

/// No interval of a played motion is shorter than this part of the mean motion's: an extreme caricature's clock goes slowly where
/// it would stand still or run backwards, and the others are not touched.
const SHORTEST: f64 = 0.2;

/// Timing with every interval at least [`SHORTEST`] times that of `mean`; the curves of a cycle end together.
pub fn increasing(layout: &Layout, mean: &DVector<f64>, timing: &DVector<f64>) -> DVector<f64> {
    let n = layout.intervals;
    let mut result = timing.clone();
    for curve in 0..timing.len() / n {
        let (mut before, mut mean_before, mut sum) = (0.0, 0.0, 0.0);
        for k in curve * n..(curve + 1) * n {
            let shortest = SHORTEST * (mean[k] - mean_before);
            sum += f64::max(timing[k] - before, shortest);
            (before, mean_before) = (timing[k], mean[k]);
            result[k] = sum;
        }
    }
    if layout.per_curve {
        let end = (0..CURVES).map(|c| result[c * n + n - 1]).fold(0.0, f64::max);
        for curve in 0..CURVES {
            let factor = end / result[curve * n + n - 1];
            result.rows_mut(curve * n, n).scale_mut(factor);
        }
    }
    result
}

/// One motion of the space, worked out: what it costs to ask for a posture depends neither on the number of examples nor on how
/// the motion was mixed.
#[derive(Clone, Debug)]
pub struct Blend {
    layout: Layout,
    mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
    shape: DVector<f64>,
    /// Knot times from 0 to the duration, one list or one per curve.
    times: Vec<Vec<f64>>,
    stride: f64,
}

impl Blend {
    /// `mean_timing` is the space's, which bounds the intervals from below (see [`increasing`]).
    pub fn new(layout: Layout, mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS], mean_timing: &DVector<f64>, vectors: &Vectors) -> Blend {
        let timing = increasing(&layout, mean_timing, &vectors.timing);
        let times = timing.as_slice().chunks(layout.intervals).map(|c| std::iter::once(0.0).chain(c.iter().copied()).collect()).collect();
        let stride = if layout.cyclic { vectors.shape[vectors.shape.len() - 1] } else { 0.0 };
        Blend { layout, mean_rotations, shape: vectors.shape.clone(), times, stride }
    }

    /// The same space's motion with other vectors.
    pub fn with(&self, mean_timing: &DVector<f64>, vectors: &Vectors) -> Blend {
        Blend::new(self.layout, self.mean_rotations, mean_timing, vectors)
    }

    /// Seconds of one cycle, or of the whole motion.
    pub fn duration_s(&self) -> f64 {
        self.times[0][self.layout.intervals]
    }

    /// Cycles (motions) per second.
    pub fn frequency_hz(&self) -> f64 {
        1.0 / self.duration_s()
    }

    pub fn is_cyclic(&self) -> bool {
        self.layout.cyclic
    }

    /// Mean speed of a body of hip height `hip_height_m` over its cycle; an open motion carries its way in the root.
    pub fn speed_m_s(&self, hip_height_m: f64) -> f64 {
        self.stride * hip_height_m / self.duration_s()
    }

    /// Joints and root at `phase`, the part of the duration that is over: 0 is the start, 1 the end; a cycle wraps, an open motion
    /// is held at its ends. The root's progress is the deviation from uniform motion at [`Blend::speed_m_s`].
    pub fn posture(&self, phase: f64) -> Posture {
        let part = self.wrapped(phase);
        let time = part * self.duration_s();
        let mut curves = [0.0; CURVES];
        let mut shared = at(&self.times[0], self.layout.cyclic, time);
        for (curve, value) in curves.iter_mut().enumerate() {
            if let Some(own) = self.times.get(curve).filter(|_| curve > 0) {
                shared = at(own, self.layout.cyclic, time);
            }
            let (samples, weights, wraps) = &shared;
            let gain = if curve == PROGRESS { self.stride } else { 0.0 };
            *value = (0..4).map(|i| weights[i] * (self.curve(samples[i], curve) + gain * wraps[i])).sum();
        }
        let vector = |first: usize| Vector3::new(curves[first], curves[first + 1], curves[first + 2]);
        let joints = std::array::from_fn(|j| self.mean_rotations[j] * exp(&vector(3 * j)));
        let position = vector(DOF + 3) - Vector3::new(0.0, 0.0, self.stride * part);
        (joints, RootSample { rotation: vector(DOF), position })
    }

    /// Shape's own phase, 0 to 1 over the reference's knots, at the part `phase` of the duration (of the first curve where each has
    /// its own times).
    pub fn shape_phase(&self, phase: f64) -> f64 {
        along(&self.times[0], &self.uniform(), self.wrapped(phase) * self.duration_s())
    }

    /// The part of the duration at which the shape's own phase is `shape_phase`: the inverse of [`Blend::shape_phase`].
    pub fn time_phase(&self, shape_phase: f64) -> f64 {
        along(&self.uniform(), &self.times[0], self.wrapped(shape_phase)) / self.duration_s()
    }

    fn uniform(&self) -> Vec<f64> {
        (0..=self.layout.intervals).map(|k| k as f64 / self.layout.intervals as f64).collect()
    }

    fn wrapped(&self, phase: f64) -> f64 {
        if self.layout.cyclic { phase.rem_euclid(1.0) } else { phase.clamp(0.0, 1.0) }
    }

    fn curve(&self, knot: usize, curve: usize) -> f64 {
        self.shape[knot * CURVES + curve]
    }

    /// Plays a body with these offsets at `fps` from the start: `cycles` of a gait along +z, an open motion once.
    pub fn clip(&self, offsets: &[Vector3<f64>; NODES], hip_height_m: f64, fps: f64, cycles: usize) -> Clip {
        let seconds = self.duration_s() * if self.layout.cyclic { cycles as f64 } else { 1.0 };
        let frames = (seconds * fps).round() as usize + 1;
        let poses = (0..frames).map(|frame| {
            let time_s = frame as f64 / fps;
            let (joints, root) = self.posture(time_s * self.frequency_hz());
            let p = root.position;
            let at = Vector3::new(p.x, 1.0 + p.y, p.z) * hip_height_m + Vector3::new(0.0, 0.0, self.speed_m_s(hip_height_m) * time_s);
            Pose { root: at, world_from_root: exp(&root.rotation), joints }
        });
        Clip { fps, poses: poses.collect(), offsets: *offsets, hip_height_m }
    }

    /// `samples` postures at equal steps of time, to be given to a space again.
    pub fn example(&self, name: &str, hip_height_m: f64, samples: usize) -> Example {
        let last = if self.layout.cyclic { samples } else { samples - 1 } as f64;
        Example {
            name: name.into(),
            source: "made from a space".into(),
            cyclic: self.layout.cyclic,
            duration_s: self.duration_s(),
            stride: self.stride,
            hip_height_m,
            postures: (0..samples).map(|k| self.posture(k as f64 / last)).collect(),
        }
    }
}

/// The piecewise linear curve from increasing `x` to `y`.
fn along(x: &[f64], y: &[f64], at: f64) -> f64 {
    let i = x.partition_point(|&knot| knot <= at).clamp(1, x.len() - 1);
    let part = ((at - x[i - 1]) / (x[i] - x[i - 1])).clamp(0.0, 1.0);
    y[i - 1] + (y[i] - y[i - 1]) * part
}

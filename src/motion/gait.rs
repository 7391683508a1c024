//! One person's gait at every speed, ready to be played: whole cycles at equal steps of speed.
//!
//! The cycles of a style change with speed by splines that begin and end where database subjects do, so they may step. Here
//! they are the control points of a uniform cubic B-spline over speed, which has two continuous derivatives, gives straight lines
//! back and is level at the slowest and fastest speed; within a cycle runs the Catmull-Rom spline through the samples:
//!   c(v, μ) = Σ_k B_k(v) Σ_j C_j(μ) c_{k,j}                                                                        (1)
//! A step costs 16 products per channel, however many cycles or components the model has.
//!
//! Below the slowest cycle v0 the person comes to a stand, with r = v/v0:
//!   posture = stand + a (cycle at v0 − stand),   a = 2r − r²,   f = f0 r/a = f0/(2 − r)                            (2)
//! so a·f goes with v and stance feet keep up with the floor; both a and c(v) are smooth at r = 1. Above the fastest
//! cycle its steps keep their length and come more often. The stand has straight legs and the cycle's mean for the rest.
//!
//! Changes are further cycles of the same channels that are added in any amount while it plays: an attribute, a caricature.
//! Each costs 4 products more per channel, from however many examples it was learnt.
//! Checked against the model's own postures, differences of speed, and the floor under a standing person.

use nalgebra::{DVector, UnitQuaternion, Vector3};

use super::playback::{Synthesis, synthesize};
use crate::body::{BALL_JOINTS, DOF, Joint, NODES, Pose, place};
use crate::math::rotation::{exp, log};
use crate::motion_model::{Activity, Model, ROOT_CHANNELS, SAMPLES};
use crate::style::space::{Blend, live};
use crate::style::{Method, Population, Style, StyleError};

/// Joint coordinates and root channels of one sample.
pub const CHANNELS: usize = DOF + ROOT_CHANNELS;
/// Distance of the cycles in speed, m/s. Wider flattens a person's change with speed, narrower lets steps of the style
/// through: (1) spreads one over four of them.
const STEP_M_S: f64 = 0.1;
const LEG: [Joint; 8] =
    [Joint::LHip, Joint::LKnee, Joint::LAnkle, Joint::LMidtarsal, Joint::RHip, Joint::RKnee, Joint::RAnkle, Joint::RMidtarsal];

/// One person's walking or running over speed.
#[derive(Clone, Debug)]
pub struct Gait {
    pub activity: Activity,
    pub hip_height_m: f64,
    mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
    slowest_m_s: f64,
    step_m_s: f64,
    /// Per speed SAMPLES rows of [`CHANNELS`], and the cycles per second.
    cycles: Vec<Vec<f64>>,
    frequencies_hz: Vec<f64>,
    stand: [f64; CHANNELS],
    start_phase: f64,
    changes: Vec<Change>,
}

/// What can be mixed in while a gait plays: an attribute, a caricature.
#[derive(Clone, Debug)]
pub struct Change {
    /// SAMPLES rows of [`CHANNELS`] (radians and hip heights) that are added.
    pub rows: Vec<f64>,
    /// Natural logarithm of how many times longer the stride becomes; fewer cycles per second then keep the speed.
    pub log_stride: f64,
}

/// A posture against the carrier: see [`RootSample`](crate::motion_model::RootSample), the root's rotation as such.
#[derive(Clone, Debug)]
pub struct Posture {
    pub joints: [UnitQuaternion<f64>; BALL_JOINTS],
    pub carrier_from_root: UnitQuaternion<f64>,
    /// In hip heights.
    pub root: Vector3<f64>,
}

impl Gait {
    /// From syntheses at equal steps of speed, slowest first, at least two, all for one body with these `offsets`; `None`
    /// otherwise, or for jumps.
    pub fn new(model: &Model, knots: &[Synthesis], offsets: &[Vector3<f64>; NODES]) -> Option<Gait> {
        let (first, last) = (knots.first()?, knots.last()?);
        let step_m_s = (last.parameter - first.parameter) / (knots.len() - 1) as f64;
        let even = |w: &[Synthesis]| (w[1].parameter - w[0].parameter - step_m_s).abs() < 1e-9;
        if !(step_m_s > 0.0 && first.parameter > 0.0 && knots.windows(2).all(even) && model.activity.is_cyclic()) {
            return None;
        }
        let mut gait = Gait {
            activity: model.activity,
            hip_height_m: first.hip_height_m,
            mean_rotations: model.mean_rotations,
            slowest_m_s: first.parameter,
            step_m_s,
            cycles: knots.iter().map(|s| cycle(model, s)).collect(),
            frequencies_hz: knots.iter().map(|s| s.frequency_hz).collect(),
            stand: [0.0; CHANNELS],
            start_phase: 0.0,
            changes: Vec::new(),
        };
        gait.stand = gait.standing(offsets);
        gait.start_phase = gait.feet_together(offsets);
        Some(gait)
    }

    /// The gait of `style` over the speeds of its model for a body with `hip_height_m`, and what [`synthesize`] noticed first.
    pub fn of_style(
        model: &Model,
        population: &Population,
        method: Method,
        style: &Style,
        hip_height_m: f64,
        offsets: &[Vector3<f64>; NODES],
    ) -> Result<Option<(Gait, Option<String>)>, StyleError> {
        let speeds = speeds(model, hip_height_m / style.hip_height_m);
        let knots = speeds.into_iter().map(|v| synthesize(model, population, method, style, v, hip_height_m));
        let knots = knots.collect::<Result<Vec<Synthesis>, StyleError>>()?;
        let noticed = knots.iter().filter(|s| s.notice.is_some()).count();
        let first = knots.iter().find_map(|s| s.notice.as_deref());
        let notice = first.map(|n| format!("{noticed} of {} speeds of {}: {n}", knots.len(), model.activity));
        Ok(Gait::new(model, &knots, offsets).map(|gait| (gait, notice)))
    }

    /// One speed only, with a little room to both sides; `None` for jumps.
    pub fn steady(model: &Model, synthesis: &Synthesis, offsets: &[Vector3<f64>; NODES]) -> Option<Gait> {
        let at = |factor: f64| Synthesis { parameter: synthesis.parameter * factor, ..synthesis.clone() };
        Gait::new(model, &[at(1.0 - 1e-3), at(1.0 + 1e-3)], offsets)
    }

    /// The gait of nobody in particular: the mean of the database's subjects at every speed.
    pub fn typical(model: &Model, population: &Population, hip_height_m: f64, offsets: &[Vector3<f64>; NODES]) -> Option<Gait> {
        let heights: f64 = model.members.iter().map(|m| m.hip_height_m).sum();
        let recorded_m = heights / model.members.len() as f64;
        let count = population.curves.len() as f64;
        let knot = |v: f64| {
            let at = v * recorded_m / hip_height_m;
            let weights = population.curves.iter().map(|c| population.extended(c, at)).sum::<DVector<f64>>() / count;
            let frequency_hz = model.cadence().frequency_hz(v, hip_height_m);
            Synthesis { weights, detail: None, sd: None, parameter: v, hip_height_m, frequency_hz, shares: Vec::new(), notice: None }
        };
        let knots: Vec<Synthesis> = speeds(model, hip_height_m / recorded_m).into_iter().map(knot).collect();
        Gait::new(model, &knots, offsets)
    }

    /// Slowest and fastest cycle, m/s.
    pub fn range_m_s(&self) -> (f64, f64) {
        (self.slowest_m_s, self.slowest_m_s + self.step_m_s * (self.cycles.len() - 1) as f64)
    }

    /// Phase at which to set out from a stand: the right foot swings past the left.
    pub fn start_phase(&self) -> f64 {
        self.start_phase
    }

    /// Adds a change that can be mixed in while it plays; returns its place in the amounts. `None` where its length is another.
    pub fn add_change(&mut self, change: Change) -> Option<usize> {
        (change.rows.len() == SAMPLES * CHANNELS).then(|| {
            self.changes.push(change);
            self.changes.len() - 1
        })
    }

    pub fn changes(&self) -> usize {
        self.changes.len()
    }

    /// What separates this person from `other` at a speed: a caricature.
    pub fn difference(&self, other: &Gait, speed_m_s: f64) -> Change {
        let cycle = |g: &Gait| g.mix(&g.speed_weights(speed_m_s));
        let mut own = cycle(self);
        for (sample, theirs) in cycle(other).chunks_exact(CHANNELS).enumerate() {
            let row = &mut own[sample * CHANNELS..][..CHANNELS];
            for (k, mean) in other.mean_rotations.iter().enumerate() {
                let here = log(&(self.mean_rotations[k].inverse() * mean * exp(&Vector3::from_column_slice(&theirs[3 * k..3 * k + 3]))));
                (0..3).for_each(|i| row[3 * k + i] -= here[i]);
            }
            (DOF..CHANNELS).for_each(|i| row[i] -= theirs[i]);
        }
        Change { rows: own, log_stride: (other.frequency_hz(speed_m_s) / self.frequency_hz(speed_m_s)).ln() }
    }

    /// What separates one motion of a space from another, see [`live::change`]: an attribute, made where labels are known.
    pub fn change(&self, from: &Blend, to: &Blend) -> Change {
        let stride = |b: &Blend| b.speed_m_s(1.0) * b.duration_s();
        let ratio = stride(to) / stride(from);
        let log_stride = if ratio.is_finite() && ratio > 0.0 { ratio.ln() } else { 0.0 };
        Change { rows: live::change(from, to, &self.mean_rotations, SAMPLES), log_stride }
    }

    /// Numbers that the gait holds; a posture reads 16 rows of them and 4 of every change.
    pub fn numbers(&self) -> usize {
        self.cycles.iter().chain(self.changes.iter().map(|c| &c.rows)).map(Vec::len).sum()
    }

    /// Cycles per second at a speed.
    pub fn frequency_hz(&self, speed_m_s: f64) -> f64 {
        let (slowest, fastest) = self.range_m_s();
        let inside = |v: f64| self.speed_weights(v).iter().map(|(k, w)| w * self.frequencies_hz[*k]).sum::<f64>();
        if speed_m_s < slowest {
            return inside(slowest) / (2.0 - (speed_m_s / slowest).max(0.0));
        }
        inside(speed_m_s) * (speed_m_s / fastest).max(1.0)
    }

    /// What the changes in the given amounts make of the cycles per second: strides e^(Σ amount · log_stride) times as long.
    pub fn cadence_factor(&self, amounts: impl Iterator<Item = f64>) -> f64 {
        self.changes.iter().zip(amounts).map(|(change, amount)| -amount * change.log_stride).sum::<f64>().exp()
    }

    /// Posture at a speed and phase, with the changes in the given amounts (missing ones are zero).
    pub fn posture(&self, speed_m_s: f64, phase: f64, amounts: impl Iterator<Item = f64>) -> Posture {
        let samples = phase_weights(phase);
        let mut c = [0.0; CHANNELS];
        for (k, w) in self.speed_weights(speed_m_s) {
            samples.iter().for_each(|(j, u)| add_row(&mut c, &self.cycles[k], *j, w * u));
        }
        for (change, amount) in self.changes.iter().zip(amounts).filter(|(_, amount)| *amount != 0.0) {
            samples.iter().for_each(|(j, u)| add_row(&mut c, &change.rows, *j, amount * u));
        }
        let r = (speed_m_s / self.slowest_m_s).clamp(0.0, 1.0);
        let a = r * (2.0 - r);
        if a < 1.0 {
            c.iter_mut().zip(&self.stand).for_each(|(c, s)| *c = s + a * (*c - s));
        }
        self.posture_of(&c)
    }

    fn posture_of(&self, c: &[f64; CHANNELS]) -> Posture {
        let vector = |i: usize| Vector3::new(c[i], c[i + 1], c[i + 2]);
        Posture {
            joints: std::array::from_fn(|j| self.mean_rotations[j] * exp(&vector(3 * j))),
            carrier_from_root: exp(&vector(DOF)),
            root: vector(DOF + 3),
        }
    }

    /// Places and weights B_k of (1); the control points are mirrored at the ends, so the curve comes to rest there.
    fn speed_weights(&self, speed_m_s: f64) -> [(usize, f64); 4] {
        let last = self.cycles.len() - 1;
        let u = ((speed_m_s - self.slowest_m_s) / self.step_m_s).clamp(0.0, last as f64);
        let i = (u as usize).min(last - 1);
        let t = u - i as f64;
        let (t2, t3) = (t * t, t * t * t);
        let b = [(1.0 - t).powi(3) / 6.0, (3.0 * t3 - 6.0 * t2 + 4.0) / 6.0, (3.0 * (t + t2 - t3) + 1.0) / 6.0, t3 / 6.0];
        let before = if i == 0 { 1 } else { i - 1 };
        let after = if i + 1 == last { last - 1 } else { i + 2 };
        [(before, b[0]), (i, b[1]), (i + 1, b[2]), (after, b[3])]
    }

    /// The whole cycle of weights over the speeds.
    fn mix(&self, weights: &[(usize, f64); 4]) -> Vec<f64> {
        (0..SAMPLES * CHANNELS).map(|i| weights.iter().map(|(k, w)| w * self.cycles[*k][i]).sum()).collect()
    }

    /// Straight legs under the hips, the slowest cycle's mean for the rest.
    fn standing(&self, offsets: &[Vector3<f64>; NODES]) -> [f64; CHANNELS] {
        let cycle = self.mix(&self.speed_weights(self.slowest_m_s));
        let mut c: [f64; CHANNELS] = std::array::from_fn(|i| cycle.iter().skip(i).step_by(CHANNELS).sum::<f64>() / SAMPLES as f64);
        let mut pose = self.pose_of(&c);
        for joint in LEG {
            pose.joints[joint as usize - 1] = UnitQuaternion::identity();
        }
        // The legs hang down from a pelvis that keeps its tilt.
        for hip in [Joint::LHip, Joint::RHip] {
            pose.joints[hip as usize - 1] = (pose.world_from_root * pose.joint(Joint::Sacroiliac)).inverse();
        }
        for joint in LEG {
            let k = joint as usize - 1;
            let v = log(&(self.mean_rotations[k].inverse() * pose.joints[k]));
            c[3 * k..3 * k + 3].copy_from_slice(v.as_slice());
        }
        let placed = place(offsets, &pose);
        let hips = 0.5 * (placed.position(Joint::LHip) + placed.position(Joint::RHip)) - pose.root;
        let root = -hips / self.hip_height_m;
        c[DOF + 3..].copy_from_slice(root.as_slice());
        c
    }

    /// Phase in the right foot's swing where the ankles stand side by side at the slowest speed.
    fn feet_together(&self, offsets: &[Vector3<f64>; NODES]) -> f64 {
        let cycle = self.mix(&self.speed_weights(self.slowest_m_s));
        let apart = |sample: &usize| {
            let row: [f64; CHANNELS] = std::array::from_fn(|i| cycle[sample * CHANNELS + i]);
            let placed = place(offsets, &self.pose_of(&row));
            (placed.position(Joint::RAnkle) - placed.position(Joint::LAnkle)).z.abs()
        };
        let closest = (SAMPLES / 2..SAMPLES).min_by(|a, b| apart(a).total_cmp(&apart(b)));
        closest.unwrap_or(0) as f64 / SAMPLES as f64
    }

    fn pose_of(&self, c: &[f64; CHANNELS]) -> Pose {
        let p = self.posture_of(c);
        Pose { root: p.root * self.hip_height_m, world_from_root: p.carrier_from_root, joints: p.joints }
    }
}

/// Equal steps over a model's speeds for a body `scale` times as large.
fn speeds(model: &Model, scale: f64) -> Vec<f64> {
    let (low, high) = model.parameter_range();
    let (low, high) = (low * scale, high.max(low + STEP_M_S) * scale);
    let steps = ((high - low) / STEP_M_S).ceil().max(1.0);
    (0..=steps as usize).map(|k| low + (high - low) * k as f64 / steps).collect()
}

/// The cycle of a synthesis as [`rows`].
fn cycle(model: &Model, synthesis: &Synthesis) -> Vec<f64> {
    let weights = synthesis.weights.as_slice();
    let (mut joints, mut root) = (model.vector(weights), model.root(weights));
    if let Some(detail) = &synthesis.detail {
        joints += &detail.vector;
        root += &detail.root;
    }
    rows(&joints, &root)
}

/// Joint coordinates and root channels side by side, one row per sample.
pub fn rows(joints: &DVector<f64>, root: &DVector<f64>) -> Vec<f64> {
    let joints = joints.as_slice().chunks_exact(DOF);
    joints.zip(root.as_slice().chunks_exact(ROOT_CHANNELS)).flat_map(|(j, r)| j.iter().chain(r).copied()).collect()
}

fn add_row(sum: &mut [f64; CHANNELS], rows: &[f64], sample: usize, weight: f64) {
    let row = &rows[sample * CHANNELS..][..CHANNELS];
    sum.iter_mut().zip(row).for_each(|(s, x)| *s += weight * x);
}

/// Places and weights C_j of (1).
fn phase_weights(phase: f64) -> [(usize, f64); 4] {
    let at = phase.rem_euclid(1.0) * SAMPLES as f64;
    let i = at as usize % SAMPLES;
    let t = at - at.floor();
    let (t2, t3) = (t * t, t * t * t);
    let c = [-t3 + 2.0 * t2 - t, 3.0 * t3 - 5.0 * t2 + 2.0, -3.0 * t3 + 4.0 * t2 + t, t3 - t2];
    std::array::from_fn(|k| ((i + SAMPLES + k - 1) % SAMPLES, 0.5 * c[k]))
}

/// Phase to add to `fast` so that its legs move most like those of `slow` at `speed_m_s`.
pub fn aligning_phase(slow: &Gait, fast: &Gait, speed_m_s: f64) -> f64 {
    let legs = |gait: &Gait, k: usize| {
        let posture = gait.posture(speed_m_s, k as f64 / SAMPLES as f64, std::iter::empty());
        LEG.map(|joint| posture.joints[joint as usize - 1])
    };
    let slows: Vec<_> = (0..SAMPLES).map(|k| legs(slow, k)).collect();
    let fasts: Vec<_> = (0..SAMPLES).map(|k| legs(fast, k)).collect();
    let misfit = |shift: usize| -> f64 {
        let pairs = (0..SAMPLES).flat_map(|k| slows[k].iter().zip(&fasts[(k + shift) % SAMPLES]));
        pairs.map(|(a, b)| a.angle_to(b).powi(2)).sum()
    };
    let best = (0..SAMPLES).min_by(|a, b| misfit(*a).total_cmp(&misfit(*b))).unwrap_or(0);
    let [before, at, after] = [SAMPLES - 1, 0, 1].map(|d| misfit((best + d) % SAMPLES));
    let bend = before - 2.0 * at + after;
    let part = if bend > 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    let shift = (best as f64 + part) / SAMPLES as f64;
    (shift + 0.5).rem_euclid(1.0) - 0.5
}

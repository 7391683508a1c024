//! A motion whose attributes and caricature are turned while it plays.
//!
//!   x = x̄ + κ (x_0 − x̄) + Σ_a c_a Δ_a,
//! with the attribute vectors Δ_a made beforehand: the examples are not needed any more. Turning a knob costs one pass over the
//! vectors per attribute, a posture costs four knots; neither depends on the number of examples. The clock keeps its place in the
//! shape when the timing changes, so that the body does not jump.

use nalgebra::UnitQuaternion;

use super::blend::{Blend, Vectors};
use super::example::{CURVES, Posture};
use super::manipulate::caricature;
use super::{Space, SpaceError, attributes, attributes::Method};
use crate::body::{BALL_JOINTS, DOF};
use crate::math::rotation::log;

/// What separates `to` from `from` at equal parts of their durations, for a player of another model to add in any amount: rows of
/// [`CURVES`] in the order of a motion model's channels (78 joint coordinates about its `mean_rotations`, root rotation, root
/// position), `samples` of them. An attribute live: `from` the mean and `to` the mean with one unit of it.
pub fn change(from: &Blend, to: &Blend, mean_rotations: &[UnitQuaternion<f64>; BALL_JOINTS], samples: usize) -> Vec<f64> {
    let mut rows = vec![0.0; samples * CURVES];
    for (k, row) in rows.chunks_exact_mut(CURVES).enumerate() {
        let phase = k as f64 / samples as f64;
        let ((a, root_a), (b, root_b)) = (from.posture(phase), to.posture(phase));
        for (j, mean) in mean_rotations.iter().enumerate() {
            let turned = log(&(mean.inverse() * b[j])) - log(&(mean.inverse() * a[j]));
            row[3 * j..3 * j + 3].copy_from_slice(turned.as_slice());
        }
        row[DOF..DOF + 3].copy_from_slice((root_b.rotation - root_a.rotation).as_slice());
        row[DOF + 3..].copy_from_slice((root_b.position - root_a.position).as_slice());
    }
    rows
}

pub struct Live {
    mean: Vectors,
    base: Vectors,
    /// Attribute vectors per unit of the label.
    directions: Vec<Vectors>,
    amounts: Vec<f64>,
    degree: f64,
    blend: Blend,
    /// Part of the duration that is over, 0 to 1.
    phase: f64,
}

impl Live {
    /// `base` with the knobs `attributes` (indices of the space's), each at 0, and degree 1. Each attribute's vector holds the others.
    pub fn new(space: &Space, base: &Vectors, knobs: &[usize]) -> Result<Live, SpaceError> {
        let directions: Result<Vec<Vectors>, SpaceError> =
            knobs.iter().map(|&a| attributes::direction(space, a, Method::Joint, knobs)).collect();
        Ok(Live {
            mean: space.mean(),
            base: base.clone(),
            directions: directions?,
            amounts: vec![0.0; knobs.len()],
            degree: 1.0,
            blend: space.play(base),
            phase: 0.0,
        })
    }

    /// Adds `amounts` (units of the labels, in the order of the knobs) to the caricature of degree `degree`.
    pub fn set(&mut self, amounts: &[f64], degree: f64) {
        if amounts == self.amounts && degree == self.degree {
            return;
        }
        (self.amounts, self.degree) = (amounts.to_vec(), degree);
        let exaggerated = caricature(&self.mean, &self.base, degree, degree);
        let vectors = self.directions.iter().zip(amounts).fold(exaggerated, |sum, (delta, amount)| sum.plus(delta, *amount, *amount));
        let at = self.blend.shape_phase(self.phase);
        self.blend = self.blend.with(&self.mean.timing, &vectors);
        self.phase = self.blend.time_phase(at);
    }

    /// Joints and root in the carrier `dt_s` seconds later; the carrier moves at [`Blend::speed_m_s`] of [`Live::blend`].
    pub fn next(&mut self, dt_s: f64) -> Posture {
        let phase = self.phase + dt_s * self.blend.frequency_hz();
        self.phase = if self.blend.is_cyclic() { phase.rem_euclid(1.0) } else { phase.clamp(0.0, 1.0) };
        self.blend.posture(self.phase)
    }

    /// What plays now.
    pub fn blend(&self) -> &Blend {
        &self.blend
    }

    /// The same at any phase (see [`Blend::posture`]).
    pub fn posture(&self, phase: f64) -> Posture {
        self.blend.posture(phase)
    }
}

//! Caricatures, and variations for crowds.
//!
//! Caricature of degree κ:  S' = S̄ + κ (S − S̄),  T' = T̄ + κ (T − T̄);  κ > 1 exaggerates what is one's own, κ < 1 plays it
//! down, 0 is the mean and κ < 0 the opposite.
//!
//! A crowd: eigenweights drawn with the examples' own covariance. With g_i ~ N(0, 1), Σ g_i (x_i − x̄)/√m has exactly the
//! covariance of the m examples x = (S, T), also between shape and timing; the eigenweights are read from it and none goes beyond
//! [`FARTHEST`] standard deviations.
//! Checked against the closed form of caricatures and the covariance of many draws.

use nalgebra::DVector;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Space, Vectors};
use crate::math::pca::{Pca, components};

/// Bound of every eigenweight of a variation, in standard deviations; beyond it lies what nobody did.
pub const FARTHEST: f64 = 2.0;
/// Part of the variance that varies; the rest is noise of single joints.
const VARIANCE: f64 = 0.95;

/// The caricature of `motion` with degrees of shape and timing.
pub fn caricature(mean: &Vectors, motion: &Vectors, shape: f64, timing: f64) -> Vectors {
    mean.plus(&motion.minus(mean), shape, timing)
}

/// The mean with eigenmotion `index` of shape or of timing added `amount` standard deviations of the examples; `None` where
/// the space has no such eigenmotion.
pub fn eigenmotion(space: &Space, shape: Option<usize>, timing: Option<usize>, amount: f64) -> Option<Vectors> {
    let along = |pca: &Pca, index: Option<usize>| match index {
        None => Some(pca.mean.clone()),
        Some(i) => (i < pca.basis.ncols()).then(|| &pca.mean + pca.basis.column(i) * (amount * pca.eigenvalues[i].sqrt())),
    };
    Some(Vectors { shape: along(&space.shape, shape)?, timing: along(&space.timing, timing)? })
}

/// `count` people about `motion`: `spread` times the deviations of the examples' covariance; the same seed gives the same people.
pub fn vary(space: &Space, motion: &Vectors, spread: f64, count: usize, seed: u64) -> Vec<Vectors> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mean = space.mean();
    let scale = 1.0 / (space.members.len() as f64).sqrt();
    (0..count)
        .map(|_| {
            let draws: Vec<f64> = space.members.iter().map(|_| normal(&mut rng) * scale).collect();
            let total: f64 = draws.iter().sum();
            let drawn = Vectors::sum(&mean, draws.iter().copied().zip(space.members.iter().map(|m| &m.vectors)));
            let drawn = drawn.plus(&mean, -total, -total);
            let within = Vectors { shape: bounded(&space.shape, &drawn.shape), timing: bounded(&space.timing, &drawn.timing) };
            motion.plus(&within, spread, spread)
        })
        .collect()
}

/// The part of `change` along the eigenmotions in use, each weight bounded.
fn bounded(pca: &Pca, change: &DVector<f64>) -> DVector<f64> {
    let count = components(&pca.eigenvalues, VARIANCE).min(pca.basis.ncols());
    let mut sum = DVector::zeros(change.len());
    for (column, eigenvalue) in pca.basis.column_iter().zip(&pca.eigenvalues).take(count) {
        let most = FARTHEST * eigenvalue.sqrt();
        sum.axpy(column.dot(change).clamp(-most, most), &column, 1.0);
    }
    sum
}

/// Box and Muller.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (1.0 - rng.random::<f64>(), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

//! The root from the feet: on the ground a sole neither sinks nor slides.
//!
//! Every sole point carries the weight w = c e^{−(y − y_min)/δ} with c the foot's contact window and y_min the lowest
//! supporting point. The root stands at −Σwy/Σw above the floor and moves by −Σw ẋ/Σw, ẋ relative to the root.

use nalgebra::Vector3;

use super::posture::{SOLE_POINTS, Soles};

/// Over which height a foot takes over from another, metres: smaller gives kinks at the change of support, larger
/// counts points in the air as standing.
const SOFTNESS_M: f64 = 0.006;

/// Height of the root over the floor at each sample, metres; `contact[i]` says which of the left and right foot carries.
/// `None` where neither does.
pub(super) fn heights(soles: &[Soles], contact: &[[f64; 2]]) -> Vec<Option<f64>> {
    let height = |(soles, contact): (&Soles, &[f64; 2])| {
        let weights = weights(soles, contact)?;
        let (sum, total) = fold(soles, &weights, |p| p.y);
        Some(-sum / total)
    };
    soles.iter().zip(contact).map(height).collect()
}

/// Steps of the root from each sample to the next (the last one to the first again), metres: what keeps the
/// supporting sole points where they are. `None` for a step on which no foot stands.
pub(super) fn steps(soles: &[Soles], contact: &[[f64; 2]]) -> Vec<Option<Vector3<f64>>> {
    let n = soles.len();
    let step = |i: usize| {
        let j = (i + 1) % n;
        let (a, b) = (weights(&soles[i], &contact[i])?, weights(&soles[j], &contact[j])?);
        let mut sum = Vector3::zeros();
        let mut total = 0.0;
        for s in 0..2 {
            for p in 0..SOLE_POINTS {
                let w = (a[s][p] * b[s][p]).sqrt();
                sum += (soles[i][s][p] - soles[j][s][p]) * w;
                total += w;
            }
        }
        (total > 0.0).then(|| sum / total)
    };
    (0..n).map(step).collect()
}

fn weights(soles: &Soles, contact: &[f64; 2]) -> Option<[[f64; SOLE_POINTS]; 2]> {
    let lowest = |s: usize| soles[s].iter().map(|p| p.y).fold(f64::INFINITY, f64::min);
    let reference = (0..2).filter(|&s| contact[s] > 0.0).map(lowest).fold(f64::INFINITY, f64::min);
    let weigh = |s: usize| soles[s].map(|p| contact[s] * (-(p.y - reference).max(0.0) / SOFTNESS_M).exp());
    reference.is_finite().then(|| [weigh(0), weigh(1)])
}

fn fold(soles: &Soles, weights: &[[f64; SOLE_POINTS]; 2], value: impl Fn(&Vector3<f64>) -> f64) -> (f64, f64) {
    let mut sums = (0.0, 0.0);
    for (points, weights) in soles.iter().zip(weights) {
        for (point, w) in points.iter().zip(weights) {
            sums = (sums.0 + w * value(point), sums.1 + w);
        }
    }
    sums
}

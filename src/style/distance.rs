//! Distance between motions and the weights that follow from it.
//!
//!   d_m(x, p) = √( Σ_i λ_i² (α_i^x − α_i^p)² / Σ_i λ_i² )                                                        (6)
//!   w_p = d_m(x, p)⁻¹ / Σ_q d_m(x, q)⁻¹                                                                          (7)
//! The paper calls (6) the normalized Mahalanobis distance, but multiplies by λ² where Mahalanobis divides by λ; the latter
//! is offered too. A distance of zero takes the whole weight.

use nalgebra::DVector;

/// Distances below this part of the largest count as zero.
const ZERO: f64 = 1e-9;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// Equation (6).
    Paper,
    /// √(Σ (Δα_i)²/λ_i).
    Mahalanobis,
}

impl Metric {
    /// Between weights of equal length; `eigenvalues` has at least that many λ.
    pub fn distance(self, eigenvalues: &[f64], a: &DVector<f64>, b: &DVector<f64>) -> f64 {
        let terms = eigenvalues.iter().zip(a.iter().zip(b)).map(|(l, (a, b))| (*l, (a - b).powi(2)));
        match self {
            Metric::Paper => {
                let (sum, norm) = terms.fold((0.0, 0.0), |(sum, norm), (l, d2)| (sum + l * l * d2, norm + l * l));
                (sum / norm).sqrt()
            }
            Metric::Mahalanobis => terms.map(|(l, d2)| d2 / l).sum::<f64>().sqrt(),
        }
    }
}

/// Equation (7).
pub fn inverse_distance_weights(distances: &[f64]) -> Vec<f64> {
    let largest = distances.iter().copied().fold(0.0, f64::max);
    let zero = |d: f64| d <= ZERO * largest;
    let inverse: Vec<f64> = if distances.iter().any(|&d| zero(d)) {
        distances.iter().map(|&d| if zero(d) { 1.0 } else { 0.0 }).collect()
    } else {
        distances.iter().map(|d| 1.0 / d).collect()
    };
    let sum: f64 = inverse.iter().sum();
    inverse.iter().map(|w| w / sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_by_hand() {
        let (a, b) = (DVector::from_vec(vec![1.0, 2.0]), DVector::from_vec(vec![4.0, -2.0]));
        let l = [3.0, 0.5, 0.1];
        let paper: f64 = (9.0 * 9.0 + 0.25 * 16.0) / 9.25;
        assert!((Metric::Paper.distance(&l, &a, &b) - paper.sqrt()).abs() < 1e-14);
        assert!((Metric::Mahalanobis.distance(&l, &a, &b) - (3.0f64 + 32.0).sqrt()).abs() < 1e-14);
    }

    #[test]
    fn weights_by_hand_and_at_zero_distance() {
        let w = inverse_distance_weights(&[1.0, 2.0, 4.0]);
        assert!((w[0] - 4.0 / 7.0).abs() < 1e-15 && (w[2] - 1.0 / 7.0).abs() < 1e-15);
        assert_eq!(inverse_distance_weights(&[0.0, 2.0]), [1.0, 0.0]);
        assert_eq!(inverse_distance_weights(&[0.0, 0.0]), [0.5, 0.5]);
    }
}

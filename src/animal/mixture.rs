//! Mixtures of Gaussians over colours, by expectation maximisation.
//!
//! r_ik = π_k N(x_i|μ_k,Σ_k)/Σ_l …;  N_k = Σ_i r_ik;  μ_k = Σ r x/N_k;  Σ_k = Σ r (x−μ)(x−μ)ᵀ/N_k + ε I;  π_k = N_k/N.
//! Start: seeded k-means++ centres and three rounds of k-means. ε = 4 grey² keeps flat colours from collapsing.
//! Stops when the mean log-likelihood gains less than 1e-5, or after 60 rounds. Checked against cv::ml::EM, and the
//! likelihood never falls.

use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Grey levels²: the noise of a camera.
const EPSILON: f64 = 4.0;
/// More samples than this add nothing to 5 colours.
const MOST_SAMPLES: usize = 2500;

#[derive(Clone, Debug)]
pub struct Component {
    pub weight: f64,
    pub mean: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

#[derive(Clone, Debug)]
pub struct Mixture {
    pub components: Vec<Component>,
    /// Cholesky-free evaluation: log weight and normaliser, mean and inverse covariance (upper triangle) in single precision.
    terms: Vec<([f32; 3], [f32; 6], f32)>,
}

impl Mixture {
    /// Fits up to `count` Gaussians; `None` for fewer samples than Gaussians.
    pub fn fit(samples: &[[f32; 3]], count: usize, seed: u64) -> Option<Mixture> {
        if count == 0 || samples.len() < count {
            return None;
        }
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let points = thinned(samples, &mut random);
        let mut components = start(&points, count, &mut random);
        let mut before = f64::NEG_INFINITY;
        for _ in 0..60 {
            let likelihood = round(&points, &mut components);
            if likelihood - before < 1e-5 {
                break;
            }
            before = likelihood;
        }
        Some(Mixture::of(components))
    }

    pub fn of(components: Vec<Component>) -> Mixture {
        let terms = components.iter().map(|c| {
            let inverse = c.covariance.try_inverse().unwrap_or_else(Matrix3::identity);
            let log = c.weight.max(1e-12).ln() - 0.5 * (c.covariance.determinant().ln() + 3.0 * std::f64::consts::TAU.ln());
            let i = |r: usize, k: usize| inverse[(r, k)] as f32;
            let mean = [c.mean.x as f32, c.mean.y as f32, c.mean.z as f32];
            (mean, [i(0, 0), i(1, 1), i(2, 2), 2.0 * i(0, 1), 2.0 * i(0, 2), 2.0 * i(1, 2)], log as f32)
        });
        Mixture { terms: terms.collect(), components }
    }

    /// log p(x).
    pub fn log_density(&self, x: [f32; 3]) -> f32 {
        let mut logs = [f32::NEG_INFINITY; 8];
        let mut top = f32::NEG_INFINITY;
        let mut sum = 0.0;
        for chunk in self.terms.chunks(8) {
            for (log, (mean, inverse, constant)) in logs.iter_mut().zip(chunk) {
                let [a, b, c] = [x[0] - mean[0], x[1] - mean[1], x[2] - mean[2]];
                let d = inverse[0] * a * a
                    + inverse[1] * b * b
                    + inverse[2] * c * c
                    + inverse[3] * a * b
                    + inverse[4] * a * c
                    + inverse[5] * b * c;
                *log = constant - 0.5 * d;
            }
            let best = logs[..chunk.len()].iter().copied().fold(top, f32::max);
            sum = sum * (top - best).exp() + logs[..chunk.len()].iter().map(|l| (l - best).exp()).sum::<f32>();
            top = best;
        }
        top + sum.ln()
    }
}

fn thinned(samples: &[[f32; 3]], random: &mut ChaCha8Rng) -> Vec<Vector3<f64>> {
    let vector = |s: &[f32; 3]| Vector3::new(f64::from(s[0]), f64::from(s[1]), f64::from(s[2]));
    if samples.len() <= MOST_SAMPLES {
        return samples.iter().map(vector).collect();
    }
    (0..MOST_SAMPLES).map(|_| vector(&samples[random.random_range(0..samples.len())])).collect()
}

/// k-means++ and three rounds of k-means.
fn start(points: &[Vector3<f64>], count: usize, random: &mut ChaCha8Rng) -> Vec<Component> {
    let mut centres = vec![points[random.random_range(0..points.len())]];
    while centres.len() < count {
        let distance: Vec<f64> = points.iter().map(|p| nearest(&centres, p).1).collect();
        let mut left = random.random::<f64>() * distance.iter().sum::<f64>();
        let next = distance
            .iter()
            .position(|d| {
                left -= d;
                left <= 0.0
            })
            .unwrap_or(points.len() - 1);
        centres.push(points[next]);
    }
    let mut own = Vec::new();
    for _ in 0..3 {
        own = points.iter().map(|p| nearest(&centres, p).0).collect();
        for (k, centre) in centres.iter_mut().enumerate() {
            let (sum, n) =
                points.iter().zip(&own).filter(|(_, o)| **o == k).fold((Vector3::zeros(), 0.0), |(s, n), (p, _)| (s + p, n + 1.0));
            if n > 0.0 {
                *centre = sum / n;
            }
        }
    }
    (0..count).map(|k| moments(points, |i| f64::from(u8::from(own[i] == k)), &centres[k])).collect()
}

fn nearest(centres: &[Vector3<f64>], p: &Vector3<f64>) -> (usize, f64) {
    let distances = centres.iter().map(|c| (c - p).norm_squared()).enumerate();
    distances.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, 0.0))
}

/// Weighted moments; `fallback` is the mean of a component without points.
fn moments(points: &[Vector3<f64>], weight: impl Fn(usize) -> f64, fallback: &Vector3<f64>) -> Component {
    let total: f64 = (0..points.len()).map(&weight).sum();
    if total < 1e-9 {
        return Component { weight: 1e-12, mean: *fallback, covariance: Matrix3::identity() * EPSILON };
    }
    let mean = points.iter().enumerate().map(|(i, p)| p * weight(i)).sum::<Vector3<f64>>() / total;
    let spread = points.iter().enumerate().map(|(i, p)| (p - mean) * (p - mean).transpose() * weight(i)).sum::<Matrix3<f64>>() / total;
    Component { weight: total / points.len() as f64, mean, covariance: spread + Matrix3::identity() * EPSILON }
}

/// One step of EM; the mean log-likelihood before it.
fn round(points: &[Vector3<f64>], components: &mut [Component]) -> f64 {
    let prepared: Vec<(Matrix3<f64>, f64)> = components
        .iter()
        .map(|c| {
            let inverse = c.covariance.try_inverse().unwrap_or_else(Matrix3::identity);
            (inverse, c.weight.max(1e-300).ln() - 0.5 * (c.covariance.determinant().ln() + 3.0 * std::f64::consts::TAU.ln()))
        })
        .collect();
    let mut shares = vec![0.0; points.len() * components.len()];
    let mut likelihood = 0.0;
    for (p, share) in points.iter().zip(shares.chunks_mut(components.len())) {
        for ((s, c), (inverse, constant)) in share.iter_mut().zip(components.iter()).zip(&prepared) {
            let d = p - c.mean;
            *s = constant - 0.5 * d.dot(&(inverse * d));
        }
        let top = share.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = share.iter().map(|s| (s - top).exp()).sum();
        share.iter_mut().for_each(|s| *s = (*s - top).exp() / sum);
        likelihood += top + sum.ln();
    }
    let count = components.len();
    for (k, c) in components.iter_mut().enumerate() {
        *c = moments(points, |i| shares[i * count + k], &c.mean);
    }
    likelihood / points.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{Mat, TermCriteria};
    use opencv::ml::{self, EM};
    use opencv::prelude::*;

    /// Three colours with their own spreads.
    fn colours(n: usize) -> Vec<[f32; 3]> {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mut normal = || (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0;
        (0..n)
            .map(|i| {
                let (centre, spread) =
                    [([40.0, 120.0, 130.0], 6.0), ([150.0, 100.0, 160.0], 11.0), ([210.0, 140.0, 90.0], 4.0)][[0, 0, 1, 1, 1, 2][i % 6]];
                let shared = normal() * spread;
                centre.map(|c: f32| c + 0.6 * shared + normal() * spread)
            })
            .collect()
    }

    #[test]
    fn agrees_with_opencvs_em() {
        let samples = colours(2400);
        let ours = Mixture::fit(&samples, 3, 1).unwrap();
        let flat: Vec<f32> = samples.iter().flatten().copied().collect();
        let data = Mat::new_rows_cols_with_data(2400, 3, &flat).unwrap().try_clone().unwrap();
        let mut em = EM::create().unwrap();
        em.set_clusters_number(3).unwrap();
        em.set_covariance_matrix_type(ml::EM_COV_MAT_GENERIC).unwrap();
        em.set_term_criteria(TermCriteria::new(3, 100, 1e-7).unwrap()).unwrap();
        let (mut log, mut labels, mut probabilities) = (Mat::default(), Mat::default(), Mat::default());
        assert!(em.train_em(&data, &mut log, &mut labels, &mut probabilities).unwrap());
        let (weights, means) = (em.get_weights().unwrap(), em.get_means().unwrap());
        for k in 0..3 {
            let theirs = Vector3::from_column_slice(means.at_row::<f64>(k).unwrap());
            let near = ours.components.iter().min_by(|a, b| (a.mean - theirs).norm().total_cmp(&(b.mean - theirs).norm())).unwrap();
            assert!((near.mean - theirs).norm() < 0.3 && (near.weight - weights.data_typed::<f64>().unwrap()[k as usize]).abs() < 0.01);
        }
        // Evaluation with OpenCV's own parameters against its predict.
        let mut covariances = opencv::core::Vector::<Mat>::new();
        em.get_covs(&mut covariances).unwrap();
        let copied = (0..3).map(|k| Component {
            weight: weights.data_typed::<f64>().unwrap()[k],
            mean: Vector3::from_column_slice(means.at_row::<f64>(k as i32).unwrap()),
            covariance: Matrix3::from_row_slice(covariances.get(k).unwrap().data_typed::<f64>().unwrap()),
        });
        let copied = Mixture::of(copied.collect());
        for sample in samples.iter().step_by(97) {
            let row = Mat::from_slice(sample.as_slice()).unwrap().try_clone().unwrap();
            let theirs = em.predict2(&row, &mut Mat::default()).unwrap()[0];
            assert!((f64::from(copied.log_density(*sample)) - theirs).abs() < 1e-2, "{theirs} {}", copied.log_density(*sample));
        }
    }

    #[test]
    fn likelihood_never_falls() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let points = thinned(&colours(600), &mut random);
        let mut components = start(&points, 5, &mut random);
        let values: Vec<f64> = (0..25).map(|_| round(&points, &mut components)).collect();
        // ε is not part of the likelihood: it may cost a little near the optimum.
        assert!(values.windows(2).all(|w| w[1] > w[0] - 1e-3) && values[24] > values[0] + 0.01, "{values:?}");
    }

    #[test]
    fn too_few_samples_and_flat_colours() {
        assert!(Mixture::fit(&colours(2), 3, 0).is_none());
        let flat = Mixture::fit(&vec![[9.0, 9.0, 9.0]; 50], 3, 0).unwrap();
        assert!(flat.log_density([9.0; 3]) > flat.log_density([30.0; 3]) + 20.0);
    }
}

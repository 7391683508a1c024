//! Postures from weights that change all the time: a model's tables laid out for that, in single precision.
//!
//! The mathematics of [`Model::posture`] with every sample's rows of all components side by side, joints by axis, so that one
//! posture reads two runs of memory and all joints turn at once:
//!   v = (1−u) Σ_i α_i Θ_i,before + u Σ_i α_i Θ_i,after,   q_j = mean_j (cos h, v_j sin h / 2h),   h = |v_j|/2           (1)
//! with the series of cos and sin(h)/h. Departure: single precision, within 2e-6 rad and hip heights of the model's own.
//! AVX2 where the processor has it; elsewhere the same code in narrower registers, and the same bytes.
//! Checked against [`Model::posture`] at any phase, within and beyond half a turn.

// Indexed loops of fixed length are what the compiler turns into vectors.
#![allow(clippy::needless_range_loop)]

use nalgebra::{DMatrix, Quaternion, UnitQuaternion, Vector3};

use super::cycle::{Activity, ROOT_CHANNELS, RootSample, SAMPLES, neighbours};
use super::model::{Detail, FADING, Model, SERIES};
use crate::body::{BALL_JOINTS, DOF};
use crate::math::rotation::exp;

/// Joints in whole registers.
const PLACES: usize = 32;
/// x, y and z of all joints, root channels.
const ROW: usize = 3 * PLACES + 8;
/// Terms of the series: at half a turn the next one is 1e-9.
const TERMS: usize = 8;

/// Tables of a model and of a person's own detail.
#[derive(Clone, Debug)]
pub struct Postures {
    activity: Activity,
    /// Rows of the mean and of every component, sample by sample.
    rows: Vec<[f32; ROW]>,
    /// Mean, then the components.
    per_sample: usize,
    /// w, x, y, z of the mean rotations.
    means: [[f32; PLACES]; 4],
    /// The same, for turns beyond half a turn.
    mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
}

impl Postures {
    /// The first `count` components of `model`, with what a person's weights do not hold.
    pub fn new(model: &Model, count: usize, detail: Option<&Detail>) -> Postures {
        let count = count.min(model.basis.ncols());
        let (mut joints, mut root) = (model.mean.clone(), model.root_mean.clone());
        if let Some(detail) = detail {
            joints += &detail.vector;
            root += &detail.root;
        }
        let row = |sample: usize, k: usize| match k {
            0 => row(sample, joints.as_slice(), root.as_slice()),
            k => row(sample, column(&model.basis, k - 1), column(&model.root_basis, k - 1)),
        };
        let rows = (0..SAMPLES).flat_map(|sample| (0..=count).map(move |k| (sample, k))).map(|(sample, k)| row(sample, k)).collect();
        let mut means = [[1.0, 0.0, 0.0, 0.0].map(|v| v as f32); PLACES];
        for (mean, q) in means.iter_mut().zip(&model.mean_rotations) {
            *mean = [q.w, q.i, q.j, q.k].map(|v| v as f32);
        }
        let means = std::array::from_fn(|axis| means.map(|q| q[axis]));
        Postures { activity: model.activity, rows, per_sample: 1 + count, means, mean_rotations: model.mean_rotations }
    }

    /// As [`Model::posture`]: fewer weights than components leave the rest zero, further ones are not used.
    pub fn at(&self, weights: &[f64], phase: f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.at_avx2(weights, phase) };
        }
        self.at_any(weights, phase)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn at_avx2(&self, weights: &[f64], phase: f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample) {
        self.at_any(weights, phase)
    }

    #[inline(always)]
    fn at_any(&self, weights: &[f64], phase: f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample) {
        let (before, after, part) = neighbours(self.activity, phase);
        let rows = |sample: usize| &self.rows[sample * self.per_sample..][..self.per_sample];
        let (before, after) = (rows(before), rows(after));
        let (u, v) = ((1.0 - part) as f32, part as f32);
        let mut row = [0.0; ROW];
        for i in 0..ROW {
            row[i] = u * before[0][i] + v * after[0][i];
        }
        for ((weight, a), b) in weights.iter().zip(&before[1..]).zip(&after[1..]) {
            let (of_a, of_b) = (*weight as f32 * u, *weight as f32 * v);
            for i in 0..ROW {
                row[i] += of_a * a[i] + of_b * b[i];
            }
        }
        let mut h2 = [0.0; PLACES];
        let (mut cos, mut sinc) = ([SERIES.0[TERMS - 1] as f32; PLACES], [SERIES.1[TERMS - 1] as f32; PLACES]);
        for j in 0..PLACES {
            let (x, y, z) = (row[j], row[PLACES + j], row[2 * PLACES + j]);
            h2[j] = 0.25 * (x * x + y * y + z * z);
        }
        for k in (0..TERMS - 1).rev() {
            for j in 0..PLACES {
                cos[j] = cos[j] * h2[j] + SERIES.0[k] as f32;
                sinc[j] = sinc[j] * h2[j] + SERIES.1[k] as f32;
            }
        }
        let mut quaternions = [[0.0; PLACES]; 4];
        for j in 0..PLACES {
            let half = 0.5 * sinc[j];
            let (w, x, y, z) = (cos[j], half * row[j], half * row[PLACES + j], half * row[2 * PLACES + j]);
            let [mw, mx, my, mz] = [self.means[0][j], self.means[1][j], self.means[2][j], self.means[3][j]];
            quaternions[0][j] = mw * w - mx * x - my * y - mz * z;
            quaternions[1][j] = mw * x + mx * w + my * z - mz * y;
            quaternions[2][j] = mw * y - mx * z + my * w + mz * x;
            quaternions[3][j] = mw * z + mx * y - my * x + mz * w;
        }
        let mut joints = std::array::from_fn(|j| {
            let [w, x, y, z] = [0, 1, 2, 3].map(|axis: usize| f64::from(quaternions[axis][j]));
            UnitQuaternion::new_unchecked(Quaternion::new(w, x, y, z))
        });
        if h2.iter().any(|h2| *h2 > (0.25 * FADING) as f32) {
            self.turn_far(&row, &h2, &mut joints);
        }
        let channel = |k: usize| f64::from(row[3 * PLACES + k]);
        let (rotation, position) = (Vector3::from_fn(|k, _| channel(k)), Vector3::from_fn(|k, _| channel(3 + k)));
        (joints, RootSample { rotation, position })
    }

    /// The closed form for joints whose series fade.
    #[cold]
    fn turn_far(&self, row: &[f32; ROW], h2: &[f32; PLACES], joints: &mut [UnitQuaternion<f64>; BALL_JOINTS]) {
        for (j, joint) in joints.iter_mut().enumerate().filter(|(j, _)| h2[*j] > (0.25 * FADING) as f32) {
            *joint = self.mean_rotations[j] * exp(&Vector3::new(row[j], row[PLACES + j], row[2 * PLACES + j]).map(f64::from));
        }
    }
}

fn column(matrix: &DMatrix<f64>, k: usize) -> &[f64] {
    &matrix.as_slice()[k * matrix.nrows()..][..matrix.nrows()]
}

/// One sample of a motion vector and of root channels.
fn row(sample: usize, joints: &[f64], root: &[f64]) -> [f32; ROW] {
    let mut row = [0.0; ROW];
    for (k, v) in joints[sample * DOF..][..DOF].iter().enumerate() {
        row[k % 3 * PLACES + k / 3] = *v as f32;
    }
    for (k, v) in root[sample * ROOT_CHANNELS..][..ROOT_CHANNELS].iter().enumerate() {
        row[3 * PLACES + k] = *v as f32;
    }
    row
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::synthetic;
    use nalgebra::DVector;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn model(activity: Activity) -> Model {
        let cycles: Vec<_> = (1..=6).flat_map(|seed| [0.9, 1.4].map(|v| synthetic::subject(activity, seed).cycle(v, 0))).collect();
        Model::build(activity, true, &cycles).unwrap()
    }

    #[test]
    fn postures_are_the_models_own_in_single_precision() {
        for activity in [Activity::Walking, Activity::Jumping] {
            let model = model(activity);
            let mut random = ChaCha8Rng::seed_from_u64(3);
            let mut detail = Detail { vector: DVector::zeros(SAMPLES * DOF), root: DVector::zeros(SAMPLES * ROOT_CHANNELS) };
            detail.vector.iter_mut().chain(detail.root.iter_mut()).for_each(|v| *v = 0.2 * random.random::<f64>());
            let postures = Postures::new(&model, 7, Some(&detail));
            let mut beyond = 0;
            for round in 0..400 {
                // Three standard deviations, and now and then weights that no person has.
                let size = if round % 4 == 0 { 60.0 } else { 3.0 };
                let count = 5 + round % 5;
                let weights: Vec<f64> =
                    (0..count).map(|i| size * model.eigenvalues[i].sqrt() * (2.0 * random.random::<f64>() - 1.0)).collect();
                let phase = 3.0 * random.random::<f64>() - 1.0;
                let (joints, root) = postures.at(&weights, phase);
                let used = &weights[..count.min(7)];
                let (wanted, wanted_root) = model.posture_with(used, Some(&detail), phase);
                for (j, (found, wanted)) in joints.iter().zip(&wanted).enumerate() {
                    let turned = (model.mean_rotations[j].inverse() * wanted).angle();
                    beyond += usize::from(size > 3.0 && turned > 2.0);
                    let bound = if size > 3.0 { 4e-5 } else { 2e-6 };
                    assert!(found.angle_to(wanted) < bound, "joint {j}: {}", found.angle_to(wanted));
                    assert!((found.norm() - 1.0).abs() < 1e-6);
                }
                let far = (root.rotation - wanted_root.rotation).norm() + (root.position - wanted_root.position).norm();
                assert!(far < if size > 3.0 { 4e-5 } else { 2e-6 }, "root: {far}");
            }
            assert!(beyond > 20, "{beyond} joints turned far");
        }
    }

    #[test]
    fn every_processor_gives_the_same_bytes() {
        let model = model(Activity::Walking);
        let postures = Postures::new(&model, usize::MAX, None);
        let weights = model.member_weights(&model.members[3]);
        for k in 0..250 {
            let phase = 0.618 * f64::from(k);
            let (joints, root) = postures.at(weights.as_slice(), phase);
            let (plain, plain_root) = postures.at_any(weights.as_slice(), phase);
            assert_eq!(root, plain_root);
            assert!(joints.iter().zip(&plain).all(|(a, b)| a.coords == b.coords));
        }
    }
}

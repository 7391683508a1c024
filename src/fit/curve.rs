//! The motion model as a smooth function of phase, with the derivatives that the fit needs.
//!
//! c(μ, α) = c_0(μ) + Σ α_i c_i(μ) for 78 joint coordinates and 6 root channels, between the N samples by the cubic
//! Hermite spline with central-difference slopes (Catmull–Rom): it passes through the samples and has a continuous
//! derivative, where the paper's linear interpolation has kinks that stall the solver.
//! Checked against central differences.

use nalgebra::{DMatrix, DVector, UnitQuaternion, Vector3};

use crate::body::{BALL_JOINTS, DOF};
use crate::motion_model::{Model, ROOT_CHANNELS, SAMPLES};

/// Joint coordinates, then root channels.
pub const CHANNELS: usize = DOF + ROOT_CHANNELS;

/// Mean and leading components of a model.
#[derive(Clone, Debug)]
pub struct Curve {
    /// One row of [`CHANNELS`] per sample, one column per function: mean, then components.
    functions: Vec<DMatrix<f64>>,
    pub mean_rotations: [UnitQuaternion<f64>; BALL_JOINTS],
    /// λ_i of the components held.
    pub eigenvalues: Vec<f64>,
    cyclic: bool,
}

/// Channel values at one phase.
#[derive(Clone, Debug)]
pub struct CurveSample {
    pub value: DVector<f64>,
    /// Derivative for the phase.
    pub slope: DVector<f64>,
    /// c_i(μ) as columns.
    pub components: DMatrix<f64>,
}

impl CurveSample {
    /// Coordinates of ball joint `k` (index `joint as usize - 1`) in a channel vector or column.
    pub fn joint(channels: &[f64], k: usize) -> Vector3<f64> {
        Vector3::new(channels[3 * k], channels[3 * k + 1], channels[3 * k + 2])
    }

    pub fn root_rotation(channels: &[f64]) -> Vector3<f64> {
        CurveSample::joint(channels, BALL_JOINTS)
    }

    pub fn root_position(channels: &[f64]) -> Vector3<f64> {
        CurveSample::joint(channels, BALL_JOINTS + 1)
    }
}

impl Curve {
    /// The first `components` components of `model` (at most those it holds).
    pub fn new(model: &Model, components: usize) -> Curve {
        let components = components.min(model.basis.ncols());
        let functions = (0..=components).map(|i| {
            DMatrix::from_fn(CHANNELS, SAMPLES, |channel, sample| {
                if channel < DOF {
                    let index = sample * DOF + channel;
                    if i == 0 { model.mean[index] } else { model.basis[(index, i - 1)] }
                } else {
                    let index = sample * ROOT_CHANNELS + channel - DOF;
                    if i == 0 { model.root_mean[index] } else { model.root_basis[(index, i - 1)] }
                }
            })
        });
        Curve {
            functions: functions.collect(),
            mean_rotations: model.mean_rotations,
            eigenvalues: model.eigenvalues[..components].to_vec(),
            cyclic: model.activity.is_cyclic(),
        }
    }

    pub fn components(&self) -> usize {
        self.eigenvalues.len()
    }

    pub fn is_cyclic(&self) -> bool {
        self.cyclic
    }

    /// The samples about `phase`, which wraps for cycles and stops at the ends of a jump, and the place between the middle two.
    fn neighbours(&self, phase: f64) -> ([usize; 4], f64) {
        let at =
            if self.cyclic { phase.rem_euclid(1.0) * SAMPLES as f64 } else { (phase * SAMPLES as f64).clamp(0.0, (SAMPLES - 1) as f64) };
        let first = at.floor();
        let u = at - first;
        let neighbours = [-1, 0, 1, 2].map(|k| {
            let index = first as i64 + k;
            if self.cyclic { index.rem_euclid(SAMPLES as i64) as usize } else { index.clamp(0, SAMPLES as i64 - 1) as usize }
        });
        (neighbours, u)
    }

    /// The values of [`sample`](Self::sample) alone.
    pub fn value(&self, phase: f64, weights: &[f64]) -> DVector<f64> {
        let (neighbours, u) = self.neighbours(phase);
        let blend = catmull_rom(u).0;
        let mut value = DVector::zeros(CHANNELS);
        for (function, alpha) in self.functions.iter().zip(std::iter::once(&1.0).chain(weights)) {
            for (column, w) in neighbours.iter().zip(blend) {
                value.axpy(alpha * w, &function.column(*column), 1.0);
            }
        }
        value
    }

    /// Values, slopes and components at `phase`.
    pub fn sample(&self, phase: f64, weights: &[f64]) -> CurveSample {
        let (neighbours, u) = self.neighbours(phase);
        let (value_weights, slope_weights) = catmull_rom(u);
        let blend = |function: &DMatrix<f64>, w: &[f64; 4]| {
            let mut sum = DVector::zeros(CHANNELS);
            for (column, w) in neighbours.iter().zip(w) {
                sum.axpy(*w, &function.column(*column), 1.0);
            }
            sum
        };
        let mut value = blend(&self.functions[0], &value_weights);
        let mut slope = blend(&self.functions[0], &slope_weights);
        let mut components = DMatrix::zeros(CHANNELS, self.components());
        for (i, alpha) in weights.iter().enumerate().take(self.components()) {
            let component = blend(&self.functions[i + 1], &value_weights);
            value.axpy(*alpha, &component, 1.0);
            slope.axpy(*alpha, &blend(&self.functions[i + 1], &slope_weights), 1.0);
            components.set_column(i, &component);
        }
        CurveSample { value, slope: slope * SAMPLES as f64, components }
    }
}

/// Weights of the four neighbours at fraction `u` between the middle two, and their derivatives for u.
fn catmull_rom(u: f64) -> ([f64; 4], [f64; 4]) {
    let (u2, u3) = (u * u, u * u * u);
    let value = [0.5 * (-u3 + 2.0 * u2 - u), 0.5 * (3.0 * u3 - 5.0 * u2 + 2.0), 0.5 * (-3.0 * u3 + 4.0 * u2 + u), 0.5 * (u3 - u2)];
    let slope =
        [0.5 * (-3.0 * u2 + 4.0 * u - 1.0), 0.5 * (9.0 * u2 - 10.0 * u), 0.5 * (-9.0 * u2 + 8.0 * u + 1.0), 0.5 * (3.0 * u2 - 2.0 * u)];
    (value, slope)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::motion_model::Activity;

    /// A small made-up model: two harmonics per channel, `components` orthonormal random-like components.
    pub fn made_up_model(components: usize) -> Model {
        let wave = |a: f64, b: f64, size: usize, per_sample: usize| {
            DVector::from_fn(size, |index, _| {
                let (sample, channel) = (index / per_sample, (index % per_sample) as f64);
                let phase = std::f64::consts::TAU * sample as f64 / SAMPLES as f64;
                (a * (channel + 1.0)).sin() * (phase + b * channel).cos() + 0.5 * (b * channel).cos() * (2.0 * phase + a).sin()
            })
        };
        let scaled: Vec<_> = (0..components).map(|i| wave(0.7 + 0.31 * i as f64, 1.3 + 0.17 * i as f64, SAMPLES * DOF, DOF)).collect();
        let basis = DMatrix::from_columns(&scaled).qr().q();
        let root: Vec<_> =
            (0..components).map(|i| wave(0.4 + 0.2 * i as f64, 0.9, SAMPLES * ROOT_CHANNELS, ROOT_CHANNELS) * 0.002).collect();
        Model {
            activity: Activity::Walking,
            synthetic: true,
            mean_rotations: std::array::from_fn(|k| UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.02 * k as f64, -0.05))),
            mean: wave(0.9, 0.4, SAMPLES * DOF, DOF) * 0.2,
            basis,
            eigenvalues: (0..components).map(|i| 40.0 / (1.0 + i as f64)).collect(),
            root_mean: wave(0.5, 0.6, SAMPLES * ROOT_CHANNELS, ROOT_CHANNELS) * 0.03,
            root_basis: DMatrix::from_columns(&root),
            members: Vec::new(),
        }
    }

    #[test]
    fn passes_through_the_samples_and_has_the_stated_slope() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let weights = [2.0, -1.0, 0.5];
        let at_sample = curve.sample(0.37 + 2.0, &weights);
        let expected = model.mean[37 * DOF + 11] + (0..3).map(|i| weights[i] * model.basis[(37 * DOF + 11, i)]).sum::<f64>();
        assert!((at_sample.value[11] - expected).abs() < 1e-9);
        assert!((curve.value(0.237, &weights) - curve.sample(0.237, &weights).value).amax() < 1e-14);
        for phase in [0.003, 0.4567, 0.9991, -0.3] {
            let numeric = (curve.sample(phase + 1e-6, &weights).value - curve.sample(phase - 1e-6, &weights).value) / 2e-6;
            assert!((numeric - curve.sample(phase, &weights).slope).amax() < 1e-4, "{phase}");
        }
    }
}

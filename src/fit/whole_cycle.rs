//! The fitted person's whole cycle, of which short footage shows a part: a steady walk at the fitted weights, posture, speed
//! and cadence, and the angles of the legs with their standard deviations.
//!
//! With q = q̄ exp(v(μ, α)) exp(c) of a joint (state, equation (1)), A(q) its flexion and Σ the covariance of α and c,
//!   σ² = J Σ Jᵀ,  J = [∂A/∂v · ∂v/∂α, ∂A/∂c].                                                                    (1)
//! Turns from frame to frame are not in it. Checked against samples drawn from Σ.

use nalgebra::{DVector, UnitQuaternion, Vector3};

use super::Fit;
use super::curve::CurveSample;
use super::state::{Carrier, HELD, State};
use crate::body::{Clip, Pose};
use crate::math::rotation::exp;
use crate::motion_model::gait::{LEGS, PERCENTS, flexion};

/// Angles of hip, knee and ankle over a cycle from the foot's own heel strike, with standard deviations (NaN where the fit
/// does not know them), radians.
#[derive(Clone, Debug)]
pub struct LegAngles {
    pub angles: [[f64; PERCENTS]; 3],
    pub sigmas: [[f64; PERCENTS]; 3],
}

/// `cycles` cycles straight along +z in a y-up world, phase 0 first; `None` for jumps and for fits that stand still.
pub fn steady(fit: &Fit, fps: f64, cycles: f64) -> Option<Clip> {
    let moves = fit.curve.is_cyclic() && fit.cadence_hz > 0.05 && fit.speed_m_s.is_finite() && fps > 0.0;
    let frames = if moves { (cycles / fit.cadence_hz * fps) as usize } else { return None };
    let hip_height_m = fit.shape().hip_height_m();
    let carriers = (0..frames).map(|frame| {
        let time_s = frame as f64 / fps;
        Carrier {
            position: Vector3::new(0.0, hip_height_m, fit.speed_m_s * time_s),
            world_from_carrier: UnitQuaternion::identity(),
            phase: fit.cadence_hz * time_s,
        }
    });
    let state = State { carriers: carriers.collect(), deviations: Vec::new(), ..fit.state.clone() };
    let poses: Vec<Pose> = (0..frames).map(|frame| state.pose(&fit.curve, frame)).collect();
    Some(Clip { fps, poses, offsets: fit.shape().offsets(), hip_height_m })
}

/// Angles of the left (0) or right (1) leg from phase `strike` on.
pub fn leg_angles(fit: &Fit, foot: usize, strike: f64) -> LegAngles {
    let mut found = LegAngles { angles: [[0.0; PERCENTS]; 3], sigmas: [[f64::NAN; PERCENTS]; 3] };
    for k in 0..PERCENTS {
        let sample = fit.curve.sample(strike + k as f64 / (PERCENTS - 1) as f64, &fit.state.weights);
        for j in 0..3 {
            (found.angles[j][k], found.sigmas[j][k]) = angle(fit, &sample, foot, j);
        }
    }
    found
}

/// Equation (1) at one phase.
fn angle(fit: &Fit, sample: &CurveSample, foot: usize, j: usize) -> (f64, f64) {
    let node = LEGS[foot][j] as usize - 1;
    let posture = HELD.iter().position(|d| *d == LEGS[foot][j]);
    let v = CurveSample::joint(sample.value.as_slice(), node);
    let c = posture.map_or(Vector3::zeros(), |k| fit.state.posture[k]);
    let of = |v: Vector3<f64>, c: Vector3<f64>| flexion(&(fit.curve.mean_rotations[node] * exp(&v) * exp(&c)), j);
    let Some(uncertainty) = &fit.uncertainty else { return (of(v, c), f64::NAN) };
    const H: f64 = 1e-5;
    let slope = |d: &dyn Fn(Vector3<f64>) -> f64| {
        Vector3::from_fn(|axis, _| {
            let step = Vector3::ith(axis, H);
            (d(step) - d(-step)) / (2.0 * H)
        })
    };
    let by_v = slope(&|step| of(v + step, c));
    let by_c = slope(&|step| of(v, c + step));
    let layout = fit.state.layout();
    let mut row = DVector::zeros(uncertainty.shared.nrows());
    for i in 0..layout.weights {
        row[i] = by_v.dot(&CurveSample::joint(sample.components.column(i).as_slice(), node));
    }
    if let Some(k) = posture.filter(|k| layout.posture(*k) + 3 <= row.len()) {
        row.rows_mut(layout.posture(k), 3).copy_from(&by_c);
    }
    (of(v, c), (&uncertainty.shared * &row).dot(&row).max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::fit::curve::{Curve, tests::made_up_model};
    use crate::fit::uncertainty::Uncertainty;
    use nalgebra::DMatrix;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn made_up(random: &mut ChaCha8Rng) -> Fit {
        let curve = Curve::new(&made_up_model(3), 3);
        let posture = std::array::from_fn(|_| Vector3::from_fn(|_, _| 0.2 * (random.random::<f64>() - 0.5)));
        let state =
            State { carriers: Vec::new(), weights: vec![1.0, -0.5, 0.3], shape: Shape::template(1.7), posture, deviations: Vec::new() };
        let size = state.layout().shared();
        let root = DMatrix::from_fn(size, size, |_, _| 0.01 * (random.random::<f64>() - 0.5));
        let shared = &root * root.transpose();
        let uncertainty = Some(Uncertainty { shared, frames: Vec::new(), shares: [1.0; 2], misfit_m: 0.002 });
        Fit {
            state,
            poses: Vec::new(),
            curve,
            uncertainty,
            frames: Vec::new(),
            model: 0,
            candidates: Vec::new(),
            iterations: 0,
            speed_m_s: 1.2,
            cadence_hz: 0.9,
            up: Vector3::z(),
        }
    }

    #[test]
    fn sigmas_are_those_of_samples() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let fit = made_up(&mut random);
        let covariance = &fit.uncertainty.as_ref().unwrap().shared;
        let root = covariance.clone().cholesky().unwrap().l();
        let mut normal = || {
            let (a, b) = (random.random::<f64>().max(1e-12), random.random::<f64>());
            (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
        };
        let sample = fit.curve.sample(0.37, &fit.state.weights);
        const DRAWS: usize = 1500;
        let (mut sums, mut squares) = ([0.0; 3], [0.0; 3]);
        for _ in 0..DRAWS {
            let z = &root * DVector::from_fn(root.nrows(), |_, _| normal());
            let moved = Fit { state: fit.state.moved(&[], z.as_slice()), uncertainty: None, ..fit.clone() };
            let there = moved.curve.sample(0.37, &moved.state.weights);
            for j in 0..3 {
                let change = angle(&moved, &there, 1, j).0 - angle(&fit, &sample, 1, j).0;
                sums[j] += change;
                squares[j] += change * change;
            }
        }
        for j in 0..3 {
            let (value, sigma) = angle(&fit, &sample, 1, j);
            let mean = sums[j] / DRAWS as f64;
            let shown = (squares[j] / DRAWS as f64 - mean * mean).sqrt();
            // 1500 draws know a standard deviation to 2 %.
            assert!(sigma > 1e-3 && (shown / sigma - 1.0).abs() < 0.07, "{j}: {shown} {sigma} {value}");
            assert!((leg_angles(&fit, 1, 0.37).sigmas[j][0] - sigma).abs() < 1e-12);
        }
    }

    #[test]
    fn the_steady_walk_has_the_fits_speed_and_cadence() {
        let fit = made_up(&mut ChaCha8Rng::seed_from_u64(6));
        let clip = steady(&fit, 90.0, 3.0).unwrap();
        assert_eq!(clip.poses.len(), 300);
        let cycle = clip.poses[100].root - clip.poses[0].root;
        assert!((cycle - Vector3::z() * (1.2 / 0.9)).norm() < 1e-9, "{cycle}");
        assert!(clip.poses[100].joints[4].angle_to(&clip.poses[0].joints[4]) < 1e-7);
        assert!(steady(&Fit { cadence_hz: 0.0, ..fit }, 90.0, 3.0).is_none());
    }
}

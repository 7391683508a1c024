//! The tracked person's own motion beside the weights: what posture, turns of single joints and lean of the carrier add, as
//! a function of the phase.
//!
//! With r_t the tracked coordinates of frame t at phase μ_t (joints about the model's mean rotations, root against its way)
//! less those of the model itself at the fitted weights, the series r(μ) = Σ a_k f_k(μ) of [`Departure`] has
//!   a = (Σ_t f(μ_t) f(μ_t)ᵀ + n ρ D)⁻¹ Σ_t f(μ_t) r_t,   D = diag(0, 1, 1, …),                                    (1)
//! so phases that were not seen keep to the person's mean difference.
//! The height: in gaits the lowest ankle stands on the floor, which gives the root's height over it.
//! Fails when: the person stands, or jumps (what comes once has no mean); then there is nothing to add.
//! Checked against fits that depart from their model in a known way.

use nalgebra::{DMatrix, Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::Fit;
use super::curve::{Curve, CurveSample};
use super::state::DEVIATING;
use crate::body::{Joint, place};
use crate::math::rotation::log;
use crate::motion_model::Model;
use crate::motion_model::departure::{Departure, harmonics};

/// Functions of the series: constant and three harmonics; a fourth changes nothing on recorded runners and walkers.
const FUNCTIONS: usize = 7;
/// ρ of (1).
const RIDGE: f64 = 0.02;
/// Frames to both sides between which the way is measured.
const REACH: usize = 4;
/// Fewer frames are none to tell a person's own motion from.
const FEWEST: usize = 2 * FUNCTIONS;

/// What the fit holds of the person's motion beside its weights in `model`, with which it was made; `None` for jumps and where
/// the person does not move on.
pub fn departure(fit: &Fit, model: &Model) -> Option<Departure> {
    let frames = fit.poses.len();
    if !fit.curve.is_cyclic() || frames < FEWEST {
        return None;
    }
    let curve = Curve::new(model, fit.state.weights.len());
    let joints = Joint::ALL;
    let mut residuals = DMatrix::zeros(frames, 3 * joints.len());
    let mut functions = DMatrix::zeros(frames, FUNCTIONS);
    let mut heights = 0.0;
    let floor = floor_m(fit);
    let hip_height_m = fit.shape().hip_height_m();
    for (t, (pose, carrier)) in fit.poses.iter().zip(&fit.state.carriers).enumerate() {
        let sample = curve.sample(carrier.phase, &fit.state.weights);
        let value = sample.value.as_slice();
        for (k, joint) in joints.iter().enumerate() {
            let r = match *joint as usize {
                0 => log(&(upright(fit, t)?.inverse() * pose.world_from_root)) - CurveSample::root_rotation(value),
                j => log(&(curve.mean_rotations[j - 1].inverse() * pose.joints[j - 1])) - CurveSample::joint(value, j - 1),
            };
            (0..3).for_each(|axis| residuals[(t, 3 * k + axis)] = r[axis]);
        }
        functions.row_mut(t).iter_mut().zip(harmonics(carrier.phase, FUNCTIONS)).for_each(|(f, h)| *f = h);
        heights += (pose.root.dot(&fit.up) - floor) / hip_height_m - 1.0 - CurveSample::root_position(value).y;
    }
    let mut normal = functions.tr_mul(&functions);
    (1..FUNCTIONS).for_each(|k| normal[(k, k)] += RIDGE * frames as f64);
    let series = normal.cholesky()?.solve(&functions.tr_mul(&residuals));
    // The other joints follow the model but for a constant.
    let functions = |joint: Joint| if joint == Joint::Root || DEVIATING.contains(&joint) { FUNCTIONS } else { 1 };
    let of_joint = |k: usize| (0..functions(joints[k])).map(|f| [0, 1, 2].map(|axis| series[(f, 3 * k + axis)])).collect();
    let turns = joints.iter().enumerate().map(|(k, joint)| (joint.name().to_string(), of_joint(k)));
    Some(Departure { turns: turns.collect(), root_height: heights / frames as f64 })
}

/// Axes x left, y up, z along the way at frame `t`; `None` where there is no way.
fn upright(fit: &Fit, t: usize) -> Option<UnitQuaternion<f64>> {
    let carriers = &fit.state.carriers;
    let (before, after) = (t.saturating_sub(REACH), (t + REACH).min(carriers.len() - 1));
    let way = carriers[after].position - carriers[before].position;
    let forward = (way - fit.up * way.dot(&fit.up)).try_normalize(1e-3)?;
    let axes = Matrix3::from_columns(&[fit.up.cross(&forward), fit.up, forward]);
    Some(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)))
}

/// Height of the floor under the lowest ankle, as cycles of recordings have it: standing, the hip joints are at the hip height.
fn floor_m(fit: &Fit) -> f64 {
    let offsets = fit.shape().offsets();
    let leg_m = offsets[Joint::RKnee as usize].norm() + offsets[Joint::RAnkle as usize].norm();
    let ankles = fit.poses.iter().flat_map(|pose| {
        let placed = place(&offsets, pose);
        [Joint::LAnkle, Joint::RAnkle].map(|j| placed.position(j))
    });
    let lowest = ankles.map(|x: Vector3<f64>| x.dot(&fit.up)).fold(f64::INFINITY, f64::min);
    lowest - (fit.shape().hip_height_m() - leg_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::fit::curve::{Curve, tests::made_up_model};
    use crate::fit::state::{Carrier, Posture, State, Turns};
    use crate::math::rotation::exp;
    use crate::motion_model::{Activity, SAMPLES};

    /// A walk along x of a z-up world whose left knee and root depart from the model.
    fn fit(cycles: f64, knee: impl Fn(f64) -> Vector3<f64>, lean: Vector3<f64>) -> Fit {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let (up, shape) = (Vector3::z(), Shape::template(1.7));
        let along = Matrix3::from_columns(&[Vector3::y(), Vector3::z(), Vector3::x()]);
        let carrier = |t: usize| Carrier {
            position: Vector3::new(0.02 * t as f64, 0.3, 0.9),
            world_from_carrier: UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(along)) * exp(&lean),
            phase: 0.2 + cycles * t as f64 / 100.0,
        };
        let carriers: Vec<Carrier> = (0..100).map(carrier).collect();
        let turns =
            |c: &Carrier| -> Turns { std::array::from_fn(|k| if DEVIATING[k] == Joint::LKnee { knee(c.phase) } else { Vector3::zeros() }) };
        let deviations = carriers.iter().map(turns).collect();
        let weights = vec![1.0, -0.5, 0.3];
        let state = State { carriers, weights, shape, posture: Posture::default(), deviations };
        let poses = (0..100).map(|t| state.pose(&curve, t)).collect();
        Fit {
            state,
            poses,
            curve,
            uncertainty: None,
            frames: Vec::new(),
            model: 0,
            candidates: Vec::new(),
            iterations: 0,
            speed_m_s: 1.2,
            cadence_hz: 1.0,
            up,
        }
    }

    #[test]
    fn a_known_departure_comes_back_over_the_whole_cycle() {
        let knee = |phase: f64| Vector3::new(0.08 + 0.05 * (std::f64::consts::TAU * phase).cos(), 0.0, 0.0);
        let (fit, model) = (fit(1.3, knee, Vector3::new(0.1, 0.0, 0.0)), made_up_model(3));
        let departure = departure(&fit, &model).unwrap();
        let detail = departure.detail();
        for sample in (0..SAMPLES).step_by(7) {
            let phase = sample as f64 / SAMPLES as f64;
            let (joints, root) = model.posture_with(&fit.state.weights, Some(&detail), phase);
            let (bare, still) = model.posture(&fit.state.weights, phase);
            let off = (bare[Joint::LKnee as usize - 1].inverse() * joints[Joint::LKnee as usize - 1]).angle();
            assert!((off - knee(phase).x.abs()).abs() < 0.006, "{phase}: {off} {}", knee(phase).x);
            assert!(bare[Joint::RHip as usize - 1].angle_to(&joints[Joint::RHip as usize - 1]) < 1e-6);
            // The lean of the carrier is the person's: it stands before the model's own turn of the root.
            let wanted = exp(&Vector3::new(0.1, 0.0, 0.0)) * exp(&still.rotation);
            assert!(exp(&root.rotation).angle_to(&wanted) < 0.02, "{phase}: {}", exp(&root.rotation).angle_to(&wanted));
        }
        // Weights and departure together are the tracked postures.
        for (pose, carrier) in fit.poses.iter().zip(&fit.state.carriers).step_by(9) {
            let (joints, _) = model.posture_with(&fit.state.weights, Some(&detail), carrier.phase);
            assert!(joints.iter().zip(&pose.joints).all(|(a, b)| a.angle_to(b) < 0.01));
        }
    }

    #[test]
    fn phases_that_were_not_seen_keep_to_the_mean_difference() {
        let fit = fit(0.55, |_| Vector3::new(0.1, 0.0, 0.0), Vector3::zeros());
        let detail = departure(&fit, &made_up_model(3)).unwrap().detail();
        let knee = 3 * (Joint::LKnee as usize - 1);
        let turned: Vec<f64> = (0..SAMPLES)
            .map(|k| detail.vector.as_slice()[k * crate::body::DOF + knee..][..3].iter().map(|v| v * v).sum::<f64>().sqrt())
            .collect();
        assert!(turned.iter().all(|v| (0.05..0.2).contains(v)), "{turned:?}");
    }

    #[test]
    fn who_stands_or_jumps_has_no_own_motion() {
        let mut still = fit(1.0, |_| Vector3::zeros(), Vector3::zeros());
        still.state.carriers.iter_mut().for_each(|c| c.position.x = 0.0);
        assert_eq!(departure(&still, &made_up_model(3)), None);
        let jump = Fit { curve: Curve::new(&Model { activity: Activity::Jumping, ..made_up_model(3) }, 3), ..still };
        assert_eq!(departure(&jump, &made_up_model(3)), None);
    }
}

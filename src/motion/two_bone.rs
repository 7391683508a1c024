//! Two-bone inverse kinematics of a leg in closed form.
//!
//! The knee bends by Δ about its own flexion axis (x of the thigh) until the ankle is at the wanted distance d from the hip:
//! with thigh vector a, shank vector b and w = q_knee b,
//!   |a + R_x(Δ) w|² = d²   ⇔   A cos Δ + B sin Δ = (d² − |a|² − |b|²)/2 − a_x w_x                                   (1)
//!   A = a_y w_y + a_z w_z,   B = a_z w_y − a_y w_z,   Δ = φ0 ± acos(·/√(A²+B²)),   φ0 = atan2(B, A)
//! on the side of the straight leg (Δ = φ0) where the knee is already. Then the hip turns by the shortest rotation that
//! carries the ankle onto the target, and the ankle keeps the foot's wanted rotation in the world. So the pose changes as
//! little as the target asks, and not at all where the ankle is on it.
//! A target out of reach is met in direction only.
//! Checked against forward kinematics at random poses and targets.

use nalgebra::{UnitQuaternion, Vector3};

use crate::body::{Joint, NODES, Pose, place};
use crate::math::rotation::{between, exp};

/// Hip, knee and ankle of one side.
pub const LEGS: [[Joint; 3]; 2] = [[Joint::LHip, Joint::LKnee, Joint::LAnkle], [Joint::RHip, Joint::RKnee, Joint::RAnkle]];

/// Moves the ankle of `leg` to `ankle_in_world` with the foot turned to `world_from_foot`; true where it gets there.
pub fn reach(
    pose: &mut Pose,
    offsets: &[Vector3<f64>; NODES],
    leg: [Joint; 3],
    ankle_in_world: &Vector3<f64>,
    world_from_foot: &UnitQuaternion<f64>,
) -> bool {
    let [hip, knee, ankle] = leg;
    let placed = place(offsets, pose);
    let world_from_thigh = placed.world_from_node[hip as usize];
    let wanted = ankle_in_world - placed.position(hip);
    let (thigh, shank) = (offsets[knee as usize], offsets[ankle as usize]);
    let (bend, met) = knee_bend(&thigh, &(pose.joint(knee) * shank), wanted.norm());
    let thigh_from_shank = exp(&Vector3::new(bend, 0.0, 0.0)) * pose.joint(knee);
    let now = world_from_thigh * (thigh + thigh_from_shank * shank);
    let world_from_pelvis = world_from_thigh * pose.joint(hip).inverse();
    let world_from_thigh = between(&now, &wanted) * world_from_thigh;
    pose.joints[hip as usize - 1] = world_from_pelvis.inverse() * world_from_thigh;
    pose.joints[knee as usize - 1] = thigh_from_shank;
    pose.joints[ankle as usize - 1] = (world_from_thigh * thigh_from_shank).inverse() * world_from_foot;
    met
}

/// Δ of (1), and whether the distance can be reached.
fn knee_bend(a: &Vector3<f64>, w: &Vector3<f64>, distance_m: f64) -> (f64, bool) {
    let (cos_part, sin_part) = (a.y * w.y + a.z * w.z, a.z * w.y - a.y * w.z);
    let wanted = 0.5 * (distance_m * distance_m - a.norm_squared() - w.norm_squared()) - a.x * w.x;
    let straight = sin_part.atan2(cos_part);
    let share = wanted / cos_part.hypot(sin_part);
    let away = share.clamp(-1.0, 1.0).acos();
    let bend = if straight > 0.0 { straight - away } else { straight + away };
    (bend, share.abs() <= 1.0 + 1e-9)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random_pose(rng: &mut ChaCha8Rng) -> Pose {
        let mut vector = |size: f64| Vector3::from_fn(|_, _| size * (2.0 * rng.random::<f64>() - 1.0));
        let mut pose = Pose::rest(vector(2.0));
        pose.world_from_root = exp(&vector(1.0));
        pose.joints.iter_mut().for_each(|q| *q = exp(&vector(0.4)));
        for leg in LEGS {
            pose.joints[leg[1] as usize - 1] = exp(&(vector(0.1) + Vector3::new(0.7, 0.0, 0.0)));
        }
        pose
    }

    #[test]
    fn the_ankle_goes_where_it_is_wanted_and_nothing_else_moves() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let offsets = Shape::template(1.75).offsets();
        for case in 0..200 {
            let leg = LEGS[case % 2];
            let before = random_pose(&mut rng);
            let placed = place(&offsets, &before);
            let step = Vector3::from_fn(|_, _| 0.1 * (rng.random::<f64>() - 0.5));
            let target = placed.position(leg[2]) + step;
            let foot = exp(&Vector3::new(0.0, 0.2, 0.0)) * placed.world_from_node[leg[2] as usize];
            let mut pose = before.clone();
            assert!(reach(&mut pose, &offsets, leg, &target, &foot));
            let after = place(&offsets, &pose);
            assert!((after.position(leg[2]) - target).norm() < 1e-9, "case {case}");
            assert!(after.world_from_node[leg[2] as usize].angle_to(&foot) < 1e-7);
            // The knee only bends: its rotation against the old one is about x.
            let turn = crate::math::rotation::log(&(pose.joint(leg[1]) * before.joint(leg[1]).inverse()));
            assert!(turn.yz().norm() < 1e-9 && turn.x.abs() < 0.6, "{turn:?}");
            let still = |j: &Joint| !leg.contains(j) && *j != Joint::Root;
            assert!(Joint::ALL.into_iter().filter(still).all(|j| pose.joint(j) == before.joint(j)));
        }
    }

    #[test]
    fn a_met_target_changes_nothing_and_a_far_one_straightens_the_leg() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let offsets = Shape::template(1.75).offsets();
        let before = random_pose(&mut rng);
        let placed = place(&offsets, &before);
        let [hip, knee, ankle] = LEGS[1];
        let mut pose = before.clone();
        assert!(reach(&mut pose, &offsets, LEGS[1], &placed.position(ankle), &placed.world_from_node[ankle as usize]));
        assert!(pose.joints.iter().zip(&before.joints).all(|(a, b)| a.angle_to(b) < 1e-7));
        let far = placed.position(hip) + Vector3::new(0.3, -2.0, 0.1);
        assert!(!reach(&mut pose, &offsets, LEGS[1], &far, &placed.world_from_node[ankle as usize]));
        let after = place(&offsets, &pose);
        let leg = after.position(ankle) - after.position(hip);
        assert!(leg.angle(&(far - placed.position(hip))) < 1e-7, "direction");
        let bend = (after.position(ankle) - after.position(knee)).angle(&(after.position(knee) - after.position(hip)));
        assert!(bend < 0.12, "straight but for the knee's other axes: {bend}");
    }
}

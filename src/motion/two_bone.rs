//! Two-bone inverse kinematics of a leg in closed form.
//!
//! The knee bends by Δ about its own flexion axis (x of the thigh) until the ankle is at the wanted distance d from the hip:
//! with thigh vector a, shank vector b and w = q_knee b,
//!   |a + R_x(Δ) w|² = d²   ⇔   A cos Δ + B sin Δ = (d² − |a|² − |b|²)/2 − a_x w_x                                   (1)
//!   A = a_y w_y + a_z w_z,   B = a_z w_y − a_y w_z,   Δ = φ0 ± acos(·/√(A²+B²)),   φ0 = atan2(B, A)
//! on the side of the straight leg (Δ = φ0) where the knee is already. A nearly straight knee would have to bend by many
//! degrees for a millimetre, and pop; with J = ∂d/∂Δ it bends by
//!   Δ J²/(J² + λ²)                                                                                                 (2)
//! only (damped least squares), and the ankle's height gives way. Then the hip turns by the shortest rotation that carries the
//! ankle onto the target, in the horizontal always, and the ankle keeps the foot's wanted rotation in the world. So the pose
//! changes as little as the target asks, and not at all where the ankle is on it.
//! A target out of reach is met in direction only.
//! Checked against forward kinematics at random poses and targets.

use nalgebra::{UnitQuaternion, Vector3};

use crate::body::{Joint, NODES, Pose, place};
use crate::math::rotation::{between, exp};

/// Hip, knee and ankle of one side.
pub const LEGS: [[Joint; 3]; 2] = [[Joint::LHip, Joint::LKnee, Joint::LAnkle], [Joint::RHip, Joint::RKnee, Joint::RAnkle]];

/// Moves the ankle of `leg` to `ankle_in_world` with the foot turned to `world_from_foot`; `damping_m` is λ of (2), metres:
/// 0 bends the knee as far as it takes, infinity keeps it. True where the ankle gets there in the horizontal.
pub fn reach(
    pose: &mut Pose,
    offsets: &[Vector3<f64>; NODES],
    leg: [Joint; 3],
    ankle_in_world: &Vector3<f64>,
    world_from_foot: &UnitQuaternion<f64>,
    damping_m: f64,
) -> bool {
    let [hip, knee, ankle] = leg;
    let placed = place(offsets, pose);
    let world_from_thigh = placed.world_from_node[hip as usize];
    let wanted = ankle_in_world - placed.position(hip);
    let (thigh, shank) = (offsets[knee as usize], offsets[ankle as usize]);
    let bend = knee_bend(&thigh, &(pose.joint(knee) * shank), wanted.norm(), damping_m);
    let thigh_from_shank = exp(&Vector3::new(bend, 0.0, 0.0)) * pose.joint(knee);
    let now = world_from_thigh * (thigh + thigh_from_shank * shank);
    let (across, long) = (wanted.xz().norm_squared(), now.norm_squared());
    let met = across <= long;
    let wanted = if met { Vector3::new(wanted.x, (long - across).sqrt().copysign(wanted.y), wanted.z) } else { wanted };
    let world_from_pelvis = world_from_thigh * pose.joint(hip).inverse();
    let world_from_thigh = between(&now, &wanted) * world_from_thigh;
    pose.joints[hip as usize - 1] = world_from_pelvis.inverse() * world_from_thigh;
    pose.joints[knee as usize - 1] = thigh_from_shank;
    pose.joints[ankle as usize - 1] = (world_from_thigh * thigh_from_shank).inverse() * world_from_foot;
    met
}

/// Δ of (1), damped by (2); as straight as it gets where the distance is out of reach.
fn knee_bend(a: &Vector3<f64>, w: &Vector3<f64>, distance_m: f64, damping_m: f64) -> f64 {
    let (cos_part, sin_part) = (a.y * w.y + a.z * w.z, a.z * w.y - a.y * w.z);
    let wanted = 0.5 * (distance_m * distance_m - a.norm_squared() - w.norm_squared()) - a.x * w.x;
    let straight = sin_part.atan2(cos_part);
    let away = (wanted / cos_part.hypot(sin_part)).clamp(-1.0, 1.0).acos();
    let bend = if straight > 0.0 { straight - away } else { straight + away };
    let slope = sin_part / (a + w).norm();
    if damping_m > 0.0 { bend * slope * slope / (slope * slope + damping_m * damping_m) } else { bend }
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
        let mut met = 0;
        for case in 0..200 {
            let leg = LEGS[case % 2];
            let before = random_pose(&mut rng);
            let placed = place(&offsets, &before);
            let step = Vector3::from_fn(|_, _| 0.1 * (rng.random::<f64>() - 0.5));
            let target = placed.position(leg[2]) + step;
            let foot = exp(&Vector3::new(0.0, 0.2, 0.0)) * placed.world_from_node[leg[2] as usize];
            let length_m = offsets[leg[1] as usize].norm() + offsets[leg[2] as usize].norm();
            if (target - placed.position(leg[0])).norm() > 0.98 * length_m {
                continue;
            }
            met += 1;
            let mut pose = before.clone();
            assert!(reach(&mut pose, &offsets, leg, &target, &foot, 0.0));
            let after = place(&offsets, &pose);
            // The height is the root of a difference, so its error is that of the square root.
            assert!((after.position(leg[2]) - target).norm() < 1e-6, "case {case}");
            assert!(after.world_from_node[leg[2] as usize].angle_to(&foot) < 1e-7);
            // The knee only bends: its rotation against the old one is about x.
            let turn = crate::math::rotation::log(&(pose.joint(leg[1]) * before.joint(leg[1]).inverse()));
            assert!(turn.yz().norm() < 1e-9 && turn.x.abs() < 0.7, "{turn:?}");
            let still = |j: &Joint| !leg.contains(j) && *j != Joint::Root;
            assert!(Joint::ALL.into_iter().filter(still).all(|j| pose.joint(j) == before.joint(j)));
        }
        assert!(met > 150, "{met}");
    }

    #[test]
    fn a_damped_knee_bends_less_and_the_ankle_still_gets_there_in_the_horizontal() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let offsets = Shape::template(1.75).offsets();
        for case in 0..50 {
            let leg = LEGS[case % 2];
            let mut before = random_pose(&mut rng);
            before.world_from_root = exp(&Vector3::new(0.1, case as f64, 0.05));
            before.joints[Joint::Sacroiliac as usize - 1] = UnitQuaternion::identity();
            before.joints[leg[0] as usize - 1] = exp(&Vector3::new(-0.3, 0.0, 0.05));
            before.joints[leg[1] as usize - 1] = exp(&Vector3::new(0.15, 0.0, 0.0));
            let placed = place(&offsets, &before);
            // 5 mm nearer and 10 mm to the side: the exact knee bends by degrees for that.
            let leg_m = placed.position(leg[0]) - placed.position(leg[2]);
            let target = placed.position(leg[2]) + leg_m * (0.005 / leg_m.norm()) + Vector3::new(0.01, 0.0, 0.0);
            let bend = |damping_m: f64| {
                let mut pose = before.clone();
                assert!(reach(&mut pose, &offsets, leg, &target, &placed.world_from_node[leg[2] as usize], damping_m));
                let ankle = place(&offsets, &pose).position(leg[2]);
                assert!((ankle - target).xz().norm() < 1e-9 && (ankle - target).y.abs() < 0.012, "{damping_m}: {}", ankle - target);
                pose.joint(leg[1]).angle_to(before.joint(leg[1])).to_degrees()
            };
            let (exact, damped, kept) = (bend(0.0), bend(0.08), bend(f64::INFINITY));
            assert!(exact > 2.0 && damped < 0.7 * exact && damped > 0.05 * exact && kept < 1e-5, "{exact} {damped} {kept}");
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
        assert!(reach(&mut pose, &offsets, LEGS[1], &placed.position(ankle), &placed.world_from_node[ankle as usize], 0.08));
        assert!(pose.joints.iter().zip(&before.joints).all(|(a, b)| a.angle_to(b) < 1e-7));
        let far = placed.position(hip) + Vector3::new(1.2, -0.4, 0.3);
        assert!(!reach(&mut pose, &offsets, LEGS[1], &far, &placed.world_from_node[ankle as usize], 0.0));
        let after = place(&offsets, &pose);
        let leg = after.position(ankle) - after.position(hip);
        assert!(leg.angle(&(far - placed.position(hip))) < 1e-7, "direction");
        let bend = (after.position(ankle) - after.position(knee)).angle(&(after.position(knee) - after.position(hip)));
        assert!(bend < 0.12, "straight but for the knee's other axes: {bend}");
    }
}

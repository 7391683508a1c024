//! Pose and forward kinematics.
//!
//! world_from_node(k) = world_from_node(parent) · translate(offset_k) · parent_from_joint(k).
//! Checked against a hand-multiplied chain.

use nalgebra::{UnitQuaternion, Vector3};

use super::skeleton::{BALL_JOINTS, Joint, NODES};
use crate::math::rotation::{exp, log};

/// Root placement and joint rotations of one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct Pose {
    /// Position of the root in the world, metres.
    pub root: Vector3<f64>,
    pub world_from_root: UnitQuaternion<f64>,
    /// `parent_from_joint` of the ball joints; index `joint as usize - 1`.
    pub joints: [UnitQuaternion<f64>; BALL_JOINTS],
}

impl Pose {
    /// Standing at rest with the root at `root`.
    pub fn rest(root: Vector3<f64>) -> Pose {
        Pose { root, world_from_root: UnitQuaternion::identity(), joints: [UnitQuaternion::identity(); BALL_JOINTS] }
    }

    /// The pose at `part` of the way to `other`: slerp for rotations, linear for the root.
    pub fn towards(&self, other: &Pose, part: f64) -> Pose {
        let turn = |a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>| a * exp(&(log(&(a.inverse() * b)) * part));
        Pose {
            root: self.root.lerp(&other.root, part),
            world_from_root: turn(&self.world_from_root, &other.world_from_root),
            joints: std::array::from_fn(|k| turn(&self.joints[k], &other.joints[k])),
        }
    }

    /// Rotation of a ball joint. Panics for the root, whose rotation is `world_from_root`.
    pub fn joint(&self, joint: Joint) -> &UnitQuaternion<f64> {
        &self.joints[joint as usize - 1]
    }
}

/// Where every node is in the world; arrays indexed by `joint as usize`.
#[derive(Clone, Debug)]
pub struct Placement {
    pub positions: [Vector3<f64>; NODES],
    pub world_from_node: [UnitQuaternion<f64>; NODES],
}

impl Placement {
    pub fn position(&self, joint: Joint) -> Vector3<f64> {
        self.positions[joint as usize]
    }
}

/// Forward kinematics; `offsets` from [`Shape::offsets`](super::Shape::offsets) (the root's is not used).
pub fn place(offsets: &[Vector3<f64>; NODES], pose: &Pose) -> Placement {
    let mut placement = Placement { positions: [pose.root; NODES], world_from_node: [pose.world_from_root; NODES] };
    for joint in Joint::ALL {
        if let Some(parent) = joint.parent() {
            let (k, p) = (joint as usize, parent as usize);
            let world_from_parent = placement.world_from_node[p];
            placement.positions[k] = placement.positions[p] + world_from_parent * offsets[k];
            placement.world_from_node[k] = world_from_parent * pose.joints[k - 1];
        }
    }
    placement
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;

    #[test]
    fn knee_and_hip_flexion_move_the_ankle_as_by_hand() {
        let shape = Shape::template(1.7);
        let offsets = shape.offsets();
        let mut pose = Pose::rest(Vector3::new(1.0, 0.9, -2.0));
        pose.world_from_root = exp(&Vector3::new(0.0, 0.7, 0.0));
        pose.joints[Joint::LHip as usize - 1] = exp(&Vector3::new(-0.5, 0.0, 0.0));
        pose.joints[Joint::LKnee as usize - 1] = exp(&Vector3::new(0.9, 0.0, 0.0));
        let thigh = 1.7 * 0.245;
        let shank = 1.7 * 0.246;
        // Flexed hip carries the thigh forward, flexed knee the shank back.
        let in_body = offsets[Joint::LHip as usize]
            + Vector3::new(0.0, -thigh * 0.5f64.cos() - shank * 0.4f64.cos(), thigh * 0.5f64.sin() - shank * 0.4f64.sin());
        let expected = pose.root + pose.world_from_root * in_body;
        assert!((place(&offsets, &pose).position(Joint::LAnkle) - expected).norm() < 1e-12);
    }
}

//! A recorded or generated motion: poses at a constant rate in a y-up world, with the size of the mover.

use nalgebra::Vector3;

use super::pose::{Placement, Pose, place};
use super::skeleton::{Joint, NODES};

/// Poses at `fps` in a y-up world in metres, the floor at y = 0.
#[derive(Clone, Debug)]
pub struct Clip {
    pub fps: f64,
    pub poses: Vec<Pose>,
    /// Offsets of the mover's nodes from their parents at rest, metres (see [`Shape::offsets`](super::Shape::offsets)).
    pub offsets: [Vector3<f64>; NODES],
    /// Height of the hip joints above the floor when standing, metres.
    pub hip_height_m: f64,
}

impl Clip {
    /// Forward kinematics of one pose with this clip's offsets.
    pub fn place(&self, pose: &Pose) -> Placement {
        place(&self.offsets, pose)
    }

    /// Hip to ankle along the straight leg, metres; the mean of both sides.
    pub fn leg_m(&self) -> f64 {
        use Joint::*;
        0.5 * [LKnee, LAnkle, RKnee, RAnkle].map(|j| self.offsets[j as usize].norm()).iter().sum::<f64>()
    }

    /// World height of the lowest point of both soles, metres.
    pub fn sole_height(&self, pose: &Pose) -> f64 {
        let placed = self.place(pose);
        let points = [Joint::LAnkle, Joint::RAnkle].into_iter().flat_map(|ankle| self.sole_points(&placed, ankle));
        points.map(|p| p.y).fold(f64::INFINITY, f64::min)
    }

    /// Heel, ball and toe tip under the foot of `ankle` (LAnkle or RAnkle) in the world, metres: on the floor for flat feet
    /// whose ankles stand `hip_height_m − leg_m` above it.
    pub fn sole_points(&self, placed: &Placement, ankle: Joint) -> [Vector3<f64>; 3] {
        let ball = if ankle == Joint::LAnkle { Joint::LMidtarsal } else { Joint::RMidtarsal };
        let ankle_height = self.hip_height_m - self.leg_m();
        let to_ball = self.offsets[ball as usize];
        let ball_height = ankle_height + to_ball.y;
        let toes = self.end_site(ball).map_or(0.0, |end| end.z);
        let under = |joint: Joint, point: Vector3<f64>| placed.position(joint) + placed.world_from_node[joint as usize] * point;
        [
            under(ankle, Vector3::new(0.0, -ankle_height, -0.5 * to_ball.z)),
            under(ball, Vector3::new(0.0, -ball_height, 0.0)),
            under(ball, Vector3::new(0.0, -ball_height, toes)),
        ]
    }

    /// [`Joint::end_site`] in metres, scaled like the segment before it.
    pub fn end_site(&self, joint: Joint) -> Option<Vector3<f64>> {
        let template = joint.rest_position() - joint.parent()?.rest_position();
        Some(joint.end_site()? * (self.offsets[joint as usize].norm() / template.norm()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::math::rotation::exp;

    fn standing() -> Clip {
        let shape = Shape::template(1.8);
        let offsets = shape.offsets();
        Clip { fps: 30.0, poses: vec![Pose::rest(offsets[0])], offsets, hip_height_m: shape.hip_height_m() }
    }

    #[test]
    fn soles_stand_on_the_floor_and_the_toe_points_down_with_the_foot() {
        let clip = standing();
        assert!((clip.leg_m() - 1.8 * 0.491).abs() < 1e-12);
        assert!(clip.sole_height(&clip.poses[0]).abs() < 1e-12);
        let mut pose = clip.poses[0].clone();
        pose.joints[Joint::LAnkle as usize - 1] = exp(&Vector3::new(0.5, 0.0, 0.0));
        // The tip is 0.112 statures before the ankle and 0.039 below it.
        let tip = -0.039 * 0.5f64.cos() - 0.112 * 0.5f64.sin();
        assert!((clip.sole_height(&pose) - 1.8 * (0.039 + tip)).abs() < 1e-12);
    }
}

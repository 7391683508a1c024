//! How far a cycle lies from another one, in degrees and millimetres, as `validate` measures it.
//!
//! Degrees: root mean square over samples and the angles that the recordings hold ([`Angles`]). Millimetres: root mean square
//! distance of [`JOINTS`] on the template body, pelvis on pelvis. Checked against turns by a known angle.

use nalgebra::{UnitQuaternion, Vector3};

use super::angles::{Angles, wrapped};
use crate::body::{BALL_JOINTS, Joint, NODES, Pose, Shape, place};
use crate::motion_model::{Cycle, Model, SAMPLES};

/// Whose positions are compared.
pub const JOINTS: [Joint; 14] = [
    Joint::LHip,
    Joint::LKnee,
    Joint::LAnkle,
    Joint::LMidtarsal,
    Joint::RHip,
    Joint::RKnee,
    Joint::RAnkle,
    Joint::RMidtarsal,
    Joint::LShoulder,
    Joint::LElbow,
    Joint::LWrist,
    Joint::RShoulder,
    Joint::RElbow,
    Joint::RWrist,
];

/// Hip height of the template as a part of stature.
pub const HIP_OF_STATURE: f64 = 0.53;

/// Measures cycles of one person.
pub struct Ruler {
    angles: Angles,
    offsets: [Vector3<f64>; NODES],
}

/// Difference of two cycles.
#[derive(Clone, Debug, PartialEq)]
pub struct Errors {
    /// Root mean squares, radians and metres.
    pub angle_rad: f64,
    pub position_m: f64,
    /// Root mean square and mean of every angle in the order of [`Ruler::names`], radians.
    pub by_angle: Vec<(f64, f64)>,
}

impl Ruler {
    /// With the angles that the recordings of `model` hold, for a body whose hip joints stand at `hip_height_m`.
    pub fn new(model: &Model, hip_height_m: f64) -> Ruler {
        Ruler { angles: Angles::of_recordings(model), offsets: Shape::template(hip_height_m / HIP_OF_STATURE).offsets() }
    }

    pub fn names(&self) -> Vec<&str> {
        self.angles.names()
    }

    pub fn errors(&self, found: &Cycle, wanted: &Cycle) -> Errors {
        let off = (self.angles.of(found) - self.angles.of(wanted)).map(wrapped);
        let count = self.names().len();
        let of_angle = |i: usize| {
            let own = || off.iter().skip(i).step_by(count);
            let mean = |sum: f64| sum / SAMPLES as f64;
            (mean(own().map(|v| v * v).sum()).sqrt(), mean(own().sum()))
        };
        let apart: Vec<f64> =
            positions(found, &self.offsets).iter().zip(positions(wanted, &self.offsets)).map(|(a, b)| (a - b).norm_squared()).collect();
        Errors {
            angle_rad: (off.norm_squared() / off.len() as f64).sqrt(),
            position_m: (apart.iter().sum::<f64>() / apart.len() as f64).sqrt(),
            by_angle: (0..count).map(of_angle).collect(),
        }
    }
}

/// Positions of [`JOINTS`] in the pelvis, metres, sample by sample.
pub fn positions(cycle: &Cycle, offsets: &[Vector3<f64>; NODES]) -> Vec<Vector3<f64>> {
    let placed = |joints: &[UnitQuaternion<f64>; BALL_JOINTS]| {
        let pose = Pose { root: Vector3::zeros(), world_from_root: UnitQuaternion::identity(), joints: *joints };
        let placement = place(offsets, &pose);
        JOINTS.map(|j| placement.position(j))
    };
    cycle.joints.iter().flat_map(placed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rotation::exp;
    use crate::motion_model::{Activity, synthetic};

    #[test]
    fn a_turned_knee_is_off_by_its_angle_and_the_shank_it_carries() {
        let cycles = [1, 2, 3].map(|s| synthetic::subject(Activity::Walking, s).cycle(1.2, 0));
        let model = Model::build(Activity::Walking, true, &cycles).unwrap();
        let ruler = Ruler::new(&model, 0.9);
        let mut turned = cycles[0].clone();
        let turn = 0.05f64;
        for joints in &mut turned.joints {
            let knee = &mut joints[Joint::LKnee as usize - 1];
            *knee *= exp(&Vector3::new(turn, 0.0, 0.0));
        }
        let errors = ruler.errors(&turned, &cycles[0]);
        let names = ruler.names();
        let at = names.iter().position(|n| *n == "l_knee x").unwrap();
        assert!((errors.by_angle[at].0 - turn).abs() < 1e-3 && (errors.by_angle[at].1 - turn).abs() < 1e-3, "{:?}", errors.by_angle[at]);
        assert!((errors.angle_rad - turn / (names.len() as f64).sqrt()).abs() < 1e-3 * turn.max(1.0));
        // Ankle and midtarsal joint of one side go on circles about the knee.
        let offsets = ruler.offsets;
        let ankle = offsets[Joint::LAnkle as usize].norm() * turn;
        assert!(errors.position_m > ankle / 14f64.sqrt() && errors.position_m < 2.0 * ankle / 14f64.sqrt(), "{}", errors.position_m);
        assert_eq!(ruler.errors(&turned, &turned).position_m, 0.0);
    }
}

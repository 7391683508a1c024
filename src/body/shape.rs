//! The size of one person: stature, segment lengths and limb widths.
//!
//! Lengths and widths are factors on the anthropometric template, left and right the same.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::skeleton::{Joint, NODES};

/// Segments that share one length factor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[repr(usize)]
pub enum Length {
    Pelvis,
    Thigh,
    Shank,
    Foot,
    Trunk,
    Head,
    Shoulders,
    UpperArm,
    Forearm,
    Hand,
}

impl Length {
    pub const COUNT: usize = 10;
    pub const ALL: [Length; Length::COUNT] = [
        Length::Pelvis,
        Length::Thigh,
        Length::Shank,
        Length::Foot,
        Length::Trunk,
        Length::Head,
        Length::Shoulders,
        Length::UpperArm,
        Length::Forearm,
        Length::Hand,
    ];

    /// The group that scales the segment from `joint`'s parent to `joint`.
    pub fn above(joint: Joint) -> Length {
        use Joint::*;
        match joint {
            Root | Sacroiliac | LHip | RHip => Length::Pelvis,
            LKnee | RKnee => Length::Thigh,
            LAnkle | RAnkle => Length::Shank,
            LMidtarsal | RMidtarsal => Length::Foot,
            Vl5 | Vl1 | Vt10 | Vt5 | Vt1 => Length::Trunk,
            Vc4 | Skullbase => Length::Head,
            LSternoclavicular | RSternoclavicular | LAcromioclavicular | RAcromioclavicular | LShoulder | RShoulder => Length::Shoulders,
            LElbow | RElbow => Length::UpperArm,
            LWrist | RWrist => Length::Forearm,
        }
    }

    /// The group that scales what hangs on `joint` itself.
    pub fn of(joint: Joint) -> Length {
        use Joint::*;
        match joint {
            Root | Sacroiliac => Length::Pelvis,
            LHip | RHip => Length::Thigh,
            LKnee | RKnee => Length::Shank,
            LAnkle | RAnkle | LMidtarsal | RMidtarsal => Length::Foot,
            Vl5 | Vl1 | Vt10 | Vt5 | Vt1 => Length::Trunk,
            Vc4 | Skullbase => Length::Head,
            LSternoclavicular | RSternoclavicular | LAcromioclavicular | RAcromioclavicular => Length::Shoulders,
            LShoulder | RShoulder => Length::UpperArm,
            LElbow | RElbow => Length::Forearm,
            LWrist | RWrist => Length::Hand,
        }
    }
}

/// Stature in metres, and factors on the template's segment lengths ([`Length`]) and widths, by the same groups.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    pub stature_m: f64,
    pub lengths: [f64; Length::COUNT],
    pub widths: [f64; Length::COUNT],
}

impl Shape {
    /// The template at a stature in metres.
    pub fn template(stature_m: f64) -> Shape {
        Shape { stature_m, lengths: [1.0; Length::COUNT], widths: [1.0; Length::COUNT] }
    }

    /// Offset of every node from its parent at rest, in metres in the body frame; the root's is its position above the
    /// floor point between the feet.
    pub fn offsets(&self) -> [Vector3<f64>; NODES] {
        Joint::ALL.map(|joint| {
            let from_parent = joint.rest_position() - joint.parent().map_or(Vector3::zeros(), Joint::rest_position);
            if joint == Joint::Root {
                return Vector3::new(0.0, self.root_height_m(), 0.0);
            }
            from_parent * self.stature_m * self.lengths[Length::above(joint) as usize]
        })
    }

    /// Height of the hip joints above the floor when standing, metres: the one normaliser H of lengths.
    pub fn hip_height_m(&self) -> f64 {
        let [hip, knee, ankle] = [Joint::LHip, Joint::LKnee, Joint::LAnkle].map(|j| j.rest_position().y);
        let l = |g: Length| self.lengths[g as usize];
        self.stature_m * ((hip - knee) * l(Length::Thigh) + (knee - ankle) * l(Length::Shank) + ankle * l(Length::Foot))
    }

    fn root_height_m(&self) -> f64 {
        let rise = Joint::Root.rest_position().y - Joint::LHip.rest_position().y;
        self.hip_height_m() + self.stature_m * rise * self.lengths[Length::Pelvis as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_of_the_template_add_up_to_rest_positions() {
        let shape = Shape::template(1.8);
        let offsets = shape.offsets();
        for joint in Joint::ALL {
            let mut sum = Vector3::zeros();
            let mut at = Some(joint);
            while let Some(j) = at {
                sum += offsets[j as usize];
                at = j.parent();
            }
            assert!((sum - 1.8 * joint.rest_position()).norm() < 1e-12, "{}", joint.name());
        }
        assert!((shape.hip_height_m() - 0.53 * 1.8).abs() < 1e-12);
    }
}

//! The H-Anim hierarchy: a root and 26 ball joints, 78 rotational degrees of freedom.
//!
//! Rest pose: standing, arms hanging, feet forward; all joint frames parallel to the body frame (x left, y up, z forward).
//! Rest positions are fractions of stature: heights after Drillis and Contini as in Winter (2009), limb lengths between
//! joint centres after de Leva (1996), who measures to joint centres where Winter measures to bony landmarks.

use nalgebra::Vector3;

/// Ball joints below the root.
pub const BALL_JOINTS: usize = 26;
/// The root and the ball joints.
pub const NODES: usize = BALL_JOINTS + 1;
/// Rotational degrees of freedom of the ball joints.
pub const DOF: usize = 3 * BALL_JOINTS;

/// A node of the hierarchy, parents before children; `joint as usize` indexes per-node arrays,
/// `joint as usize - 1` the ball joints of a [`Pose`](super::Pose).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(usize)]
pub enum Joint {
    Root,
    Sacroiliac,
    LHip,
    LKnee,
    LAnkle,
    LMidtarsal,
    RHip,
    RKnee,
    RAnkle,
    RMidtarsal,
    Vl5,
    Vl1,
    Vt10,
    Vt5,
    Vt1,
    Vc4,
    Skullbase,
    LSternoclavicular,
    LAcromioclavicular,
    LShoulder,
    LElbow,
    LWrist,
    RSternoclavicular,
    RAcromioclavicular,
    RShoulder,
    RElbow,
    RWrist,
}

use Joint::*;

impl Joint {
    pub const ALL: [Joint; NODES] = [
        Root,
        Sacroiliac,
        LHip,
        LKnee,
        LAnkle,
        LMidtarsal,
        RHip,
        RKnee,
        RAnkle,
        RMidtarsal,
        Vl5,
        Vl1,
        Vt10,
        Vt5,
        Vt1,
        Vc4,
        Skullbase,
        LSternoclavicular,
        LAcromioclavicular,
        LShoulder,
        LElbow,
        LWrist,
        RSternoclavicular,
        RAcromioclavicular,
        RShoulder,
        RElbow,
        RWrist,
    ];

    pub fn parent(self) -> Option<Joint> {
        Some(match self {
            Root => return None,
            Sacroiliac | Vl5 => Root,
            LHip | RHip => Sacroiliac,
            LKnee => LHip,
            LAnkle => LKnee,
            LMidtarsal => LAnkle,
            RKnee => RHip,
            RAnkle => RKnee,
            RMidtarsal => RAnkle,
            Vl1 => Vl5,
            Vt10 => Vl1,
            Vt5 => Vt10,
            Vt1 => Vt5,
            Vc4 => Vt1,
            Skullbase => Vc4,
            LSternoclavicular | RSternoclavicular => Vt1,
            LAcromioclavicular => LSternoclavicular,
            LShoulder => LAcromioclavicular,
            LElbow => LShoulder,
            LWrist => LElbow,
            RAcromioclavicular => RSternoclavicular,
            RShoulder => RAcromioclavicular,
            RElbow => RShoulder,
            RWrist => RElbow,
        })
    }

    /// The H-Anim name.
    pub fn name(self) -> &'static str {
        match self {
            Root => "humanoid_root",
            Sacroiliac => "sacroiliac",
            LHip => "l_hip",
            LKnee => "l_knee",
            LAnkle => "l_ankle",
            LMidtarsal => "l_midtarsal",
            RHip => "r_hip",
            RKnee => "r_knee",
            RAnkle => "r_ankle",
            RMidtarsal => "r_midtarsal",
            Vl5 => "vl5",
            Vl1 => "vl1",
            Vt10 => "vt10",
            Vt5 => "vt5",
            Vt1 => "vt1",
            Vc4 => "vc4",
            Skullbase => "skullbase",
            LSternoclavicular => "l_sternoclavicular",
            LAcromioclavicular => "l_acromioclavicular",
            LShoulder => "l_shoulder",
            LElbow => "l_elbow",
            LWrist => "l_wrist",
            RSternoclavicular => "r_sternoclavicular",
            RAcromioclavicular => "r_acromioclavicular",
            RShoulder => "r_shoulder",
            RElbow => "r_elbow",
            RWrist => "r_wrist",
        }
    }

    /// The same joint on the other side; joints of the middle are their own mirror images.
    pub fn mirror(self) -> Joint {
        let name = self.name();
        let other = match name.split_at(2) {
            ("l_", rest) => format!("r_{rest}"),
            ("r_", rest) => format!("l_{rest}"),
            _ => return self,
        };
        Joint::ALL.into_iter().find(|j| j.name() == other).unwrap_or(self)
    }

    /// Position at rest in the body frame, floor at y = 0, as fractions of stature.
    pub fn rest_position(self) -> Vector3<f64> {
        let (x, y, z) = match self {
            Root | Sacroiliac => (0.0, 0.5365, 0.0),
            LHip | RHip => (0.057, 0.530, 0.0),
            LKnee | RKnee => (0.057, 0.285, 0.0),
            LAnkle | RAnkle => (0.057, 0.039, 0.0),
            LMidtarsal | RMidtarsal => (0.057, 0.020, 0.050),
            Vl5 => (0.0, 0.570, -0.005),
            Vl1 => (0.0, 0.625, -0.010),
            Vt10 => (0.0, 0.670, -0.015),
            Vt5 => (0.0, 0.740, -0.020),
            Vt1 => (0.0, 0.835, -0.015),
            Vc4 => (0.0, 0.875, -0.005),
            Skullbase => (0.0, 0.910, 0.005),
            LSternoclavicular | RSternoclavicular => (0.015, 0.815, 0.020),
            LAcromioclavicular | RAcromioclavicular => (0.090, 0.825, -0.005),
            LShoulder | RShoulder => (0.105, 0.808, 0.0),
            LElbow | RElbow => (0.105, 0.646, 0.0),
            LWrist | RWrist => (0.105, 0.492, 0.0),
        };
        Vector3::new(if self.name().starts_with("r_") { -x } else { x }, y, z)
    }

    /// Where the last segment of a chain ends at rest (crown, toe tip, finger tip), relative to this joint, as fractions
    /// of stature; `None` for joints with children.
    pub fn end_site(self) -> Option<Vector3<f64>> {
        match self {
            LMidtarsal | RMidtarsal => Some(Vector3::new(0.0, -0.010, 0.062)),
            Skullbase => Some(Vector3::new(0.0, 0.090, 0.0)),
            LWrist | RWrist => Some(Vector3::new(0.0, -0.108, 0.0)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hierarchy_is_ordered_and_has_78_degrees_of_freedom() {
        assert_eq!(DOF, 78);
        for (i, joint) in Joint::ALL.into_iter().enumerate() {
            assert_eq!(joint as usize, i);
            assert!(joint.parent().is_none_or(|p| (p as usize) < i));
            assert_eq!(joint.mirror().mirror(), joint);
        }
        assert_eq!(LElbow.mirror(), RElbow);
        assert_eq!(Vt1.mirror(), Vt1);
    }
}

//! From anatomical angles to joint rotations, and from leg rotations to where the soles are.
//!
//! Signs, with the body's x left, y up, z forward: flexion of hip and elbow, and of the shoulder (arm forward) turn by −x,
//! of the knee by +x, dorsiflexion by −x; rotations about y and z have opposite signs on the two sides.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::variation::{Channel, TRACKS, track};
use crate::body::{BALL_JOINTS, Joint, NODES};
use crate::math::rotation::{exp, log};

/// Share of the trunk's bending that each joint of the spine takes, from the pelvis up.
const SPINE: [(Joint, f64); 5] = [(Joint::Vl5, 0.20), (Joint::Vl1, 0.25), (Joint::Vt10, 0.25), (Joint::Vt5, 0.20), (Joint::Vt1, 0.10)];
/// Heel behind the ankle; heel, ball and toe tip of the sole under their joints: fractions of stature.
pub(super) const HEEL_BACK: f64 = 0.040;
const ANKLE_HEIGHT: f64 = 0.039;
const BALL_HEIGHT: f64 = 0.020;
const TOE_FORWARD: f64 = 0.055;
/// From the heel to the toe tip of a flat foot.
pub(super) const FOOT_LENGTH: f64 = HEEL_BACK + 0.050 + TOE_FORWARD;
/// Lowest points of a foot: heel, ball, toe tip.
pub(super) const SOLE_POINTS: usize = 3;
/// The sole points of a foot relative to the root, metres.
pub(super) type Sole = [Vector3<f64>; SOLE_POINTS];
/// Of both feet, left first.
pub(super) type Soles = [Sole; 2];

/// Angles of one side, radians.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Side {
    /// Hip joint relative to the root in the carrier, metres.
    pub hip: Vector3<f64>,
    pub hip_flexion: f64,
    /// Rotation of the whole leg about the body's forward axis against the vertical: positive carries the foot to the left.
    pub leg_lateral: f64,
    pub knee: f64,
    pub ankle: f64,
    pub toe_out: f64,
    pub toe: f64,
    pub shoulder: f64,
    pub shoulder_abduction: f64,
    pub elbow: f64,
}

/// Anatomical angles of one instant, radians. Pelvis and thorax are given against the carrier, so that the spine
/// counter-rotates by itself.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Angles {
    pub sides: [Side; 2],
    pub tilt: f64,
    pub list: f64,
    pub yaw: f64,
    pub lean: f64,
    pub bend: f64,
    pub torsion: f64,
}

impl Angles {
    /// From one sample of the tracks; toe and lateral position of the legs are left at rest.
    pub fn from_tracks(deg: &[f64; TRACKS], offsets: &[Vector3<f64>; NODES]) -> Angles {
        let get = |channel, side| deg[track(channel, side)].to_radians();
        let side = |s| Side {
            hip_flexion: get(Channel::HipFlexion, s),
            knee: above_zero(get(Channel::Knee, s), 3f64.to_radians()),
            ankle: get(Channel::Ankle, s),
            toe_out: -get(Channel::HipRotation, s),
            shoulder: get(Channel::Shoulder, s),
            shoulder_abduction: get(Channel::ShoulderAbduction, s),
            elbow: above_zero(get(Channel::Elbow, s), 5f64.to_radians()),
            ..Side::default()
        };
        let mut angles = Angles {
            sides: [side(0), side(1)],
            tilt: get(Channel::Tilt, 0),
            list: get(Channel::List, 0),
            yaw: get(Channel::Yaw, 0),
            lean: get(Channel::Lean, 0),
            bend: get(Channel::Bend, 0),
            torsion: get(Channel::Torsion, 0),
        };
        let carrier_from_root = angles.carrier_from_root();
        for (side, names) in angles.sides.iter_mut().zip(&SIDES) {
            side.hip = carrier_from_root * (offsets[Joint::Sacroiliac as usize] + offsets[names.hip as usize]);
        }
        angles
    }

    pub fn carrier_from_root(&self) -> UnitQuaternion<f64> {
        yaw(self.yaw) * list(self.list) * pitch(self.tilt)
    }

    pub fn joints(&self) -> [UnitQuaternion<f64>; BALL_JOINTS] {
        let mut joints = [UnitQuaternion::identity(); BALL_JOINTS];
        let mut set = |joint: Joint, rotation| joints[joint as usize - 1] = rotation;
        let carrier_from_thorax = yaw(self.torsion) * list(self.bend) * pitch(self.lean);
        let spine = log(&(self.carrier_from_root().inverse() * carrier_from_thorax));
        for (joint, share) in SPINE {
            set(joint, exp(&(spine * share)));
        }
        // The head looks ahead: it takes little of the trunk's turning and leaning.
        let carrier_from_head = yaw(0.3 * self.torsion) * list(0.3 * self.bend) * pitch(0.3 * self.lean);
        let neck = exp(&(log(&(carrier_from_thorax.inverse() * carrier_from_head)) * 0.5));
        set(Joint::Vc4, neck);
        set(Joint::Skullbase, neck);
        for (s, names) in SIDES.iter().enumerate() {
            let leg = self.leg(s);
            set(names.hip, leg[0]);
            set(names.knee, leg[1]);
            set(names.ankle, leg[2]);
            set(names.midtarsal, leg[3]);
            let side = &self.sides[s];
            let sign = if s == 0 { 1.0 } else { -1.0 };
            set(names.clavicle, yaw(-sign * 0.1 * side.shoulder));
            set(names.shoulder, pitch(-side.shoulder) * list(sign * side.shoulder_abduction) * yaw(-sign * 0.25 * side.elbow));
            set(names.elbow, pitch(-side.elbow));
            set(names.wrist, pitch(-0.1 * side.elbow));
        }
        joints
    }

    /// Rotations of hip, knee, ankle and midtarsal joint of one side.
    fn leg(&self, s: usize) -> [UnitQuaternion<f64>; 4] {
        let side = &self.sides[s];
        let sign = if s == 0 { 1.0 } else { -1.0 };
        let carrier_from_thigh = list(side.leg_lateral) * pitch(self.tilt - side.hip_flexion);
        let hip = self.carrier_from_root().inverse() * carrier_from_thigh;
        let ankle = list(-side.leg_lateral) * yaw(sign * side.toe_out) * pitch(-side.ankle);
        [hip, pitch(side.knee), ankle, pitch(-side.toe)]
    }

    /// Sole points of one side relative to the root.
    pub fn sole(&self, s: usize, offsets: &[Vector3<f64>; NODES], stature_m: f64) -> Sole {
        self.lower_leg(s).sole(offsets, stature_m)
    }

    /// Pitch of the foot of one side, toes up positive.
    pub fn foot_pitch(&self, s: usize) -> f64 {
        self.lower_leg(s).foot_pitch()
    }

    /// One leg from the knee down. The leg is flat up to the ankle, so angles add up.
    pub fn lower_leg(&self, s: usize) -> LowerLeg {
        let side = self.sides[s];
        let sign = if s == 0 { 1.0 } else { -1.0 };
        let thigh = self.tilt - side.hip_flexion;
        let (tilted, shank) = (list(side.leg_lateral), pitch(thigh + side.knee));
        LowerLeg { side, names: &SIDES[s], thigh, tilted, shank, out: yaw(sign * side.toe_out), ankle: pitch(-side.ankle) }
    }
}

/// A leg's turns, of which many soles can be made.
pub(super) struct LowerLeg {
    side: Side,
    names: &'static SideJoints,
    /// Angle against the vertical, radians.
    thigh: f64,
    /// The leg's plane against the vertical, and the shank in it.
    tilted: UnitQuaternion<f64>,
    shank: UnitQuaternion<f64>,
    /// Of the foot against the plane.
    out: UnitQuaternion<f64>,
    ankle: UnitQuaternion<f64>,
}

impl LowerLeg {
    /// Puts the plane elsewhere, see [`Side::leg_lateral`].
    pub fn tilt(&mut self, leg_lateral: f64) {
        self.tilted = list(leg_lateral);
    }

    /// Sole points relative to the root.
    pub fn sole(&self, offsets: &[Vector3<f64>; NODES], stature_m: f64) -> Sole {
        let bone = |length: f64, angle: f64| {
            let (sin, cos) = angle.sin_cos();
            Vector3::new(0.0, -length * cos, -length * sin)
        };
        let (knee, ankle) = (-offsets[self.names.knee as usize].y, -offsets[self.names.ankle as usize].y);
        let at_ankle = self.side.hip + self.tilted * (bone(knee, self.thigh) + bone(ankle, self.thigh + self.side.knee));
        let rotation = self.carrier_from_foot();
        let at_ball = at_ankle + rotation * offsets[self.names.midtarsal as usize];
        [
            at_ankle + rotation * (Vector3::new(0.0, -ANKLE_HEIGHT, -HEEL_BACK) * stature_m),
            at_ball + rotation * (Vector3::new(0.0, -BALL_HEIGHT, 0.0) * stature_m),
            at_ball + rotation * (pitch(-self.side.toe) * (Vector3::new(0.0, -BALL_HEIGHT, TOE_FORWARD) * stature_m)),
        ]
    }

    fn carrier_from_foot(&self) -> UnitQuaternion<f64> {
        self.tilted * self.shank * self.tilted.inverse() * self.out * self.ankle
    }

    /// Toes up positive.
    pub fn foot_pitch(&self) -> f64 {
        (self.carrier_from_foot() * Vector3::z()).y.asin()
    }
}

/// Where the sole of a foot with its ankle at the origin is, metres.
pub(super) struct SoleAtOrigin {
    pub lowest: f64,
    pub heel_z: f64,
    pub toe_z: f64,
}

/// Sole of a foot at `foot_pitch` (toes up positive) with the toes bent up by `toe`.
pub(super) fn sole_at_origin(foot_pitch: f64, toe: f64, stature_m: f64) -> SoleAtOrigin {
    let rotation = pitch(-foot_pitch);
    let ball_joint = rotation * (Joint::LMidtarsal.rest_position() - Joint::LAnkle.rest_position());
    let [heel, ball, tip] = [
        rotation * Vector3::new(0.0, -ANKLE_HEIGHT, -HEEL_BACK),
        ball_joint + rotation * Vector3::new(0.0, -BALL_HEIGHT, 0.0),
        ball_joint + rotation * pitch(-toe) * Vector3::new(0.0, -BALL_HEIGHT, TOE_FORWARD),
    ]
    .map(|p| p * stature_m);
    SoleAtOrigin { lowest: heel.y.min(ball.y).min(tip.y), heel_z: heel.z, toe_z: tip.z }
}

struct SideJoints {
    hip: Joint,
    knee: Joint,
    ankle: Joint,
    midtarsal: Joint,
    clavicle: Joint,
    shoulder: Joint,
    elbow: Joint,
    wrist: Joint,
}

const SIDES: [SideJoints; 2] = [
    SideJoints {
        hip: Joint::LHip,
        knee: Joint::LKnee,
        ankle: Joint::LAnkle,
        midtarsal: Joint::LMidtarsal,
        clavicle: Joint::LSternoclavicular,
        shoulder: Joint::LShoulder,
        elbow: Joint::LElbow,
        wrist: Joint::LWrist,
    },
    SideJoints {
        hip: Joint::RHip,
        knee: Joint::RKnee,
        ankle: Joint::RAnkle,
        midtarsal: Joint::RMidtarsal,
        clavicle: Joint::RSternoclavicular,
        shoulder: Joint::RShoulder,
        elbow: Joint::RElbow,
        wrist: Joint::RWrist,
    },
];

fn pitch(angle: f64) -> UnitQuaternion<f64> {
    about(angle, |s| [s, 0.0, 0.0])
}

fn yaw(angle: f64) -> UnitQuaternion<f64> {
    about(angle, |s| [0.0, s, 0.0])
}

fn list(angle: f64) -> UnitQuaternion<f64> {
    about(angle, |s| [0.0, 0.0, s])
}

fn about(angle: f64, axis: impl Fn(f64) -> [f64; 3]) -> UnitQuaternion<f64> {
    let (sin, cos) = (0.5 * angle).sin_cos();
    let [x, y, z] = axis(sin);
    UnitQuaternion::new_unchecked(Quaternion::new(cos, x, y, z))
}

/// Smooth maximum of `x` and 0 that rounds the corner over about `corner`: knees and elbows do not bend backwards.
pub(super) fn above_zero(x: f64, corner: f64) -> f64 {
    0.5 * (x + (x * x + corner * corner).sqrt())
}

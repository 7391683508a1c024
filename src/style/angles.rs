//! Joint angles of cycles under the names that the recordings themselves use, for errors in degrees.
//!
//! Recordings of OpenSim's models hold Z-X-Y angles of pelvis, hips, lumbar spine and shoulders and angles about fixed axes
//! of knees, ankles, elbows and forearms (axes of gait2392, Hamner's and Rajagopal's models; left axes mirrored). They are
//! known by their postures: in every cycle these few angles give the rotations back exactly. Of other recordings the angles
//! are the coordinates of each moving joint's rotation vector about its mean, and of the pelvis against the heading.
//! Angles that stay still in all recordings are locked there and left out.
//! Checked against the columns of a recorded MOT file.

use std::f64::consts::{PI, TAU};

use nalgebra::{DVector, Matrix3, UnitQuaternion, Vector3};

use crate::body::{BALL_JOINTS, Joint};
use crate::math::rotation::{exp, log};
use crate::motion_model::{Cycle, Model, SAMPLES};

/// An angle that varies less than this over all recordings is locked, radians.
const STILL_RAD: f64 = 0.003;
/// How far a posture may lie from its OpenSim angles (rounding and resampling), radians.
const EXACT_RAD: f64 = 0.002;

/// Axes in body coordinates (x left, y up, z forward) of the right side.
const ANKLE: Vector3<f64> = Vector3::new(-0.979126, -0.174022, -0.105014);
const SUBTALAR: Vector3<f64> = Vector3::new(0.120949, 0.604747, 0.787180);
const TOES: Vector3<f64> = Vector3::new(-0.813936, 0.0, -0.580954);
const ELBOW: Vector3<f64> = Vector3::new(-0.973862, 0.022269, 0.226047);
const PRONATION: Vector3<f64> = Vector3::new(-0.001952, 0.998406, 0.056398);

/// How a rotation becomes angles.
#[derive(Clone, Debug)]
enum Kind {
    /// Rotations about Z (right), X (forward) and Y (up), the latter two mirrored on the left by -1.
    Zxy(f64),
    /// About one fixed axis, or two.
    Hinges(Vec<Vector3<f64>>),
    /// Rotation vector about a mean.
    Vector(UnitQuaternion<f64>),
}

/// The angles of one joint, or of the pelvis against the heading.
#[derive(Clone, Debug)]
struct Group {
    joint: Option<Joint>,
    names: Vec<String>,
    kind: Kind,
    /// Which of the names vary.
    kept: Vec<bool>,
}

/// Which angles a model's recordings hold.
#[derive(Clone, Debug)]
pub struct Angles {
    groups: Vec<Group>,
}

impl Angles {
    /// Those that vary over the members of a model.
    pub fn of_recordings(model: &Model) -> Angles {
        let cycles: Vec<Cycle> = model.members.iter().map(|m| model.cycle_of(m)).collect();
        let opensim = opensim();
        let known = |joint: usize| opensim.iter().any(|g| g.joint.is_some_and(|j| j as usize - 1 == joint));
        let moves = |joint: usize| {
            let first = cycles.first().and_then(|c| c.joints.first()).map(|q| q[joint]).unwrap_or_default();
            cycles.iter().flat_map(|c| &c.joints).any(|q| q[joint].angle_to(&first) > STILL_RAD)
        };
        let exact = |g: &Group| cycles.iter().all(|c| (0..SAMPLES).all(|k| g.missed(&g.rotation(c, k)) < EXACT_RAD));
        let held = (0..BALL_JOINTS).all(|j| known(j) || !moves(j)) && opensim.iter().all(exact);
        let mut groups = if held { opensim } else { vectors(model) };
        groups.iter_mut().for_each(|g| g.keep_moving(&cycles));
        Angles { groups }
    }

    pub fn names(&self) -> Vec<&str> {
        self.groups.iter().flat_map(|g| g.names.iter().zip(&g.kept).filter(|k| *k.1).map(|n| n.0.as_str())).collect()
    }

    /// Radians, index `sample * names + name`.
    pub fn of(&self, cycle: &Cycle) -> DVector<f64> {
        let one = |k: usize| self.groups.iter().flat_map(move |g| g.kept_angles(cycle, k));
        DVector::from_iterator(SAMPLES * self.names().len(), (0..SAMPLES).flat_map(one))
    }

    /// Mean over cycles; angles may lie on both sides of the wrap. `None` without cycles.
    pub fn mean(&self, cycles: &[Cycle]) -> Option<DVector<f64>> {
        let all: Vec<DVector<f64>> = cycles.iter().map(|c| self.of(c)).collect();
        let first = all.first()?;
        let off = all.iter().map(|a| (a - first).map(wrapped)).sum::<DVector<f64>>();
        Some(first + off / all.len() as f64)
    }
}

/// An angle between -pi and pi.
pub fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

impl Group {
    fn new(joint: Option<Joint>, names: &[&str], end: &str, kind: Kind) -> Group {
        Group { joint, names: names.iter().map(|n| format!("{n}{end}")).collect(), kind, kept: vec![true; names.len()] }
    }

    fn rotation(&self, cycle: &Cycle, sample: usize) -> UnitQuaternion<f64> {
        self.joint.map_or_else(|| exp(&cycle.root[sample].rotation), |j| cycle.joints[sample][j as usize - 1])
    }

    fn angles(&self, q: &UnitQuaternion<f64>) -> Vec<f64> {
        match &self.kind {
            Kind::Zxy(mirror) => {
                let [z, x, y] = zxy(q);
                vec![z, mirror * x, mirror * y]
            }
            Kind::Vector(mean) => log(&(mean.inverse() * q)).as_slice().to_vec(),
            Kind::Hinges(axes) => match axes[..] {
                // The first turn carries the second axis to where q has it.
                [a, b] => {
                    let first = turn_about(&a, &b, &(q * b));
                    vec![first, log(&(exp(&(a * -first)) * q)).dot(&b)]
                }
                _ => axes.iter().map(|a| log(q).dot(a)).collect(),
            },
        }
    }

    /// Angle between `q` and the rotation that its angles stand for.
    fn missed(&self, q: &UnitQuaternion<f64>) -> f64 {
        let Kind::Hinges(axes) = &self.kind else { return 0.0 };
        let back = axes.iter().zip(self.angles(q)).fold(UnitQuaternion::identity(), |all, (axis, angle)| all * exp(&(axis * angle)));
        back.angle_to(q)
    }

    fn kept_angles(&self, cycle: &Cycle, sample: usize) -> Vec<f64> {
        let angles = self.angles(&self.rotation(cycle, sample));
        angles.into_iter().zip(&self.kept).filter(|k| *k.1).map(|a| a.0).collect()
    }

    fn keep_moving(&mut self, cycles: &[Cycle]) {
        let all: Vec<Vec<f64>> =
            cycles.iter().flat_map(|c| (0..SAMPLES).map(move |k| (c, k))).map(|(c, k)| self.angles(&self.rotation(c, k))).collect();
        self.kept = (0..self.names.len()).map(|i| all.iter().any(|a| wrapped(a[i] - all[0][i]).abs() > STILL_RAD)).collect();
    }
}

/// Groups of OpenSim's coordinates.
fn opensim() -> Vec<Group> {
    use Joint::*;
    let mut groups = vec![Group::new(None, &["pelvis_tilt", "pelvis_list", "pelvis_rotation"], "", Kind::Zxy(1.0))];
    groups.push(Group::new(Some(Vl5), &["lumbar_extension", "lumbar_bending", "lumbar_rotation"], "", Kind::Zxy(1.0)));
    for (end, mirror, [hip, knee, ankle, ball, shoulder, elbow, wrist]) in [
        ("_r", 1.0, [RHip, RKnee, RAnkle, RMidtarsal, RShoulder, RElbow, RWrist]),
        ("_l", -1.0, [LHip, LKnee, LAnkle, LMidtarsal, LShoulder, LElbow, LWrist]),
    ] {
        // Mirrored are OpenSim's X and Y, our z and y.
        let hinges =
            |axes: &[Vector3<f64>]| Kind::Hinges(axes.iter().map(|a| Vector3::new(a.x, mirror * a.y, mirror * a.z).normalize()).collect());
        groups.push(Group::new(Some(hip), &["hip_flexion", "hip_adduction", "hip_rotation"], end, Kind::Zxy(mirror)));
        groups.push(Group::new(Some(knee), &["knee_angle"], end, hinges(&[Vector3::x()])));
        groups.push(Group::new(Some(ankle), &["ankle_angle", "subtalar_angle"], end, hinges(&[ANKLE, SUBTALAR])));
        groups.push(Group::new(Some(ball), &["mtp_angle"], end, hinges(&[TOES])));
        groups.push(Group::new(Some(shoulder), &["arm_flex", "arm_add", "arm_rot"], end, Kind::Zxy(mirror)));
        groups.push(Group::new(Some(elbow), &["elbow_flex"], end, hinges(&[ELBOW])));
        groups.push(Group::new(Some(wrist), &["pro_sup", "wrist_flex"], end, hinges(&[PRONATION, -Vector3::x()])));
    }
    groups
}

/// Rotation vectors about the model's mean rotations.
fn vectors(model: &Model) -> Vec<Group> {
    let axes = |name: &str| ["x", "y", "z"].map(|a| format!("{name} {a}"));
    let group = |joint: Option<Joint>, mean: UnitQuaternion<f64>| {
        let names = axes(joint.map_or("pelvis", Joint::name));
        Group { joint, names: names.into(), kind: Kind::Vector(mean), kept: vec![true; 3] }
    };
    let joints = Joint::ALL[1..].iter().zip(&model.mean_rotations).map(|(j, mean)| group(Some(*j), *mean));
    [group(None, UnitQuaternion::identity())].into_iter().chain(joints).collect()
}

/// Angles of R = R_Z R_X R_Y in OpenSim's axes: X forward, Y up, Z right, ours z, y and -x.
fn zxy(q: &UnitQuaternion<f64>) -> [f64; 3] {
    let theirs_from_ours = Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0);
    let m = theirs_from_ours * q.to_rotation_matrix().matrix() * theirs_from_ours.transpose();
    [(-m[(0, 1)]).atan2(m[(1, 1)]), m[(2, 1)].clamp(-1.0, 1.0).asin(), (-m[(2, 0)]).atan2(m[(2, 2)])]
}

/// Angle about a unit axis that carries `from` over `to` as seen along it.
fn turn_about(axis: &Vector3<f64>, from: &Vector3<f64>, to: &Vector3<f64>) -> f64 {
    let (a, b) = (from - axis * axis.dot(from), to - axis * axis.dot(to));
    axis.dot(&a.cross(&b)).atan2(a.dot(&b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::{Activity, RootSample, synthetic};

    /// A cycle of two postures whose OpenSim angles are `angles(name)`.
    fn cycle(angles: impl Fn(&str, usize) -> f64) -> Cycle {
        let mut cycle = synthetic::subject(Activity::Walking, 1).cycle(1.2, 0);
        for k in 0..SAMPLES {
            cycle.joints[k] = [UnitQuaternion::identity(); BALL_JOINTS];
            for g in opensim() {
                let turns: Vec<f64> = g.names.iter().map(|n| angles(n, k)).collect();
                let q = match &g.kind {
                    Kind::Zxy(mirror) => {
                        let m = *mirror;
                        let [z, x, y] =
                            [-Vector3::x() * turns[0], Vector3::z() * m * turns[1], Vector3::y() * m * turns[2]].map(|v| exp(&v));
                        z * x * y
                    }
                    Kind::Hinges(axes) => axes.iter().zip(&turns).fold(UnitQuaternion::identity(), |q, (a, t)| q * exp(&(a * *t))),
                    Kind::Vector(_) => unreachable!("opensim has none"),
                };
                match g.joint {
                    Some(j) => cycle.joints[k][j as usize - 1] = q,
                    None => cycle.root[k] = RootSample { rotation: log(&q), position: Vector3::zeros() },
                }
            }
        }
        cycle
    }

    fn swing(name: &str, k: usize) -> f64 {
        let size = name.bytes().map(usize::from).sum::<usize>() % 7;
        if name.starts_with("mtp") { 0.3 } else { 0.1 * size as f64 + 0.4 * (k as f64 / 16.0 + size as f64).sin() }
    }

    #[test]
    fn opensims_angles_come_back_under_their_names_without_the_locked() {
        let cycles = [1.0, 1.1].map(|gain| cycle(|n, k| if n.starts_with("mtp") { swing(n, k) } else { gain * swing(n, k) }));
        let model = Model::build(Activity::Walking, false, &cycles).unwrap();
        let angles = Angles::of_recordings(&model);
        let names = angles.names();
        assert!(names.len() == 30 && names[3] == "lumbar_extension" && !names.contains(&"mtp_angle_r"), "{names:?}");
        let found = angles.of(&cycles[1]);
        for k in 0..SAMPLES {
            for (i, name) in names.iter().enumerate() {
                let wanted = 1.1 * swing(name, k);
                assert!((found[k * names.len() + i] - wanted).abs() < 1e-9, "{name} {k}: {} {wanted}", found[k * names.len() + i]);
            }
        }
    }

    #[test]
    fn other_recordings_have_rotation_vectors_of_what_moves() {
        let cycles = [1, 2].map(|s| synthetic::subject(Activity::Walking, s).cycle(1.2, 0));
        let model = Model::build(Activity::Walking, true, &cycles).unwrap();
        let angles = Angles::of_recordings(&model);
        assert!(angles.names().contains(&"l_knee x") && !angles.names().iter().any(|n| n.starts_with("lumbar")), "{:?}", angles.names());
        let (a, b) = (angles.of(&cycles[0]), angles.of(&cycles[1]));
        assert!((a - b).amax() > 0.02);
    }

    #[test]
    fn means_cross_the_wrap() {
        let cycles = [3.1, -3.1].map(|a| cycle(move |n, k| if n == "hip_rotation_r" { a + 0.01 * (k % 2) as f64 } else { swing(n, k) }));
        let model = Model::build(Activity::Walking, false, &cycles).unwrap();
        let angles = Angles::of_recordings(&model);
        let at = angles.names().iter().position(|n| *n == "hip_rotation_r").unwrap();
        assert!(wrapped(angles.mean(&cycles).unwrap()[at] - PI).abs() < 1e-6);
    }
}

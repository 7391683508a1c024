//! Joint angles as MOT with the 39 coordinates of Rajagopal's model, degrees and metres.
//!
//! From our 78 DOF (mirror images on the left), with the axes of the [reader](crate::io::mot):
//!
//! | coordinates | from |
//! |---|---|
//! | `pelvis_tilt, _list, _rotation` | world_from_sacroiliac, body-fixed Z X Y |
//! | `pelvis_tx, _ty, _tz` | the pelvis' origin, 0.039 of stature before and 0.037 above the hip joints |
//! | `hip_flexion, _adduction, _rotation` | the hip, Z X Y |
//! | `knee_angle` = `knee_angle_beta` | the knee about Z, flexion positive |
//! | `ankle_angle, subtalar_angle` | shank to foot, the model's two axes |
//! | `mtp_angle` | foot to toes, one axis |
//! | `lumbar_extension, _bending, _rotation` | pelvis to vt1: vl5, vl1, vt10, vt5 and vt1 together, Z X Y |
//! | `arm_flex, _add, _rot` | vt1 to upper arm: clavicle and shoulder together, Z X Y |
//! | `elbow_flex` | the elbow about the model's axis, the upper arm turned so that the forearm's direction stays |
//! | `pro_sup, wrist_flex, wrist_dev` | what the elbow leaves, and the wrist |
//!
//! Where a joint has fewer coordinates than three, they minimise the angle between the segment that they carry and ours, given what the
//! joints above made of theirs, so that errors do not add up. What is lost: bending within the trunk, shrugging shoulders'
//! shifts, the head and neck, and at knees, ankles, toes and elbows all but the listed axes.
//! Checked by the reader: OpenSim's own angles survive, and whatever the model can express comes back.

use std::fmt::Write;
use std::path::Path;

use nalgebra::{DMatrix, DVector, Matrix4, SMatrix, SVector, UnitQuaternion, Vector3, Vector4};

use super::super::mot::{ANKLE, ELBOW, HIP_FORWARD, HIP_UP, PRONATION, SUBTALAR, TOES, X, Y, Z, ours};
use super::{ExchangeError, opensim_from_clip};
use crate::body::{Clip, Joint, Pose};
use crate::math::euler::{self, Order};
use crate::math::rotation::{exp, log};

/// Columns after `time`; the first six, then those of the right leg, the left leg, the trunk, the right and the left arm.
pub const COORDINATES: [&str; 39] = [
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "pelvis_tx",
    "pelvis_ty",
    "pelvis_tz",
    "hip_flexion_r",
    "hip_adduction_r",
    "hip_rotation_r",
    "knee_angle_r",
    "knee_angle_r_beta",
    "ankle_angle_r",
    "subtalar_angle_r",
    "mtp_angle_r",
    "hip_flexion_l",
    "hip_adduction_l",
    "hip_rotation_l",
    "knee_angle_l",
    "knee_angle_l_beta",
    "ankle_angle_l",
    "subtalar_angle_l",
    "mtp_angle_l",
    "lumbar_extension",
    "lumbar_bending",
    "lumbar_rotation",
    "arm_flex_r",
    "arm_add_r",
    "arm_rot_r",
    "elbow_flex_r",
    "pro_sup_r",
    "wrist_flex_r",
    "wrist_dev_r",
    "arm_flex_l",
    "arm_add_l",
    "arm_rot_l",
    "elbow_flex_l",
    "pro_sup_l",
    "wrist_flex_l",
    "wrist_dev_l",
];

/// Writes the clip's angles, time from 0.
pub fn write(path: &Path, clip: &Clip) -> Result<(), ExchangeError> {
    super::write(path, text_of(clip).as_bytes())
}

fn text_of(clip: &Clip) -> String {
    let mut text = format!("Coordinates\nversion=1\nnRows={}\nnColumns={}\ninDegrees=yes\n\n", clip.poses.len(), 1 + COORDINATES.len());
    text += "Units are S.I. units (seconds, metres); angles in degrees.\n\nendheader\ntime";
    COORDINATES.iter().for_each(|name| text.extend(["\t", name]));
    text.push('\n');
    let mut before = [0.0; 39];
    for (k, pose) in clip.poses.iter().enumerate() {
        before = coordinates(clip, pose, &before);
        // Writing to a String cannot fail.
        let _ = write!(text, "{:.6}", k as f64 / clip.fps);
        for (name, value) in COORDINATES.iter().zip(before) {
            let _ = write!(text, "\t{:.6}", if is_length(name) { value } else { value.to_degrees() });
        }
        text.push('\n');
    }
    text
}

fn is_length(name: &str) -> bool {
    ["pelvis_tx", "pelvis_ty", "pelvis_tz"].contains(&name)
}

/// Radians and metres, in the order of [`COORDINATES`]; `before` are the frame's before, for smooth curves.
pub fn coordinates(clip: &Clip, pose: &Pose, before: &[f64; 39]) -> [f64; 39] {
    use Joint::*;
    let placed = clip.place(pose);
    let world = |joint: Joint| placed.world_from_node[joint as usize];
    let (pelvis, trunk) = (world(Sacroiliac), world(Vt1));
    let mut found = Found { values: Vec::with_capacity(39), before };
    found.three(&pelvis, 1.0);
    let stature = clip.hip_height_m / LHip.rest_position().y;
    let hips = 0.5 * (placed.position(LHip) + placed.position(RHip));
    let origin = opensim_from_clip() * (hips - pelvis * Vector3::new(0.0, HIP_UP, HIP_FORWARD) * stature);
    found.values.extend(origin.iter());
    for (mirror, [hip, knee, ankle, ball]) in [(1.0, [RHip, RKnee, RAnkle, RMidtarsal]), (-1.0, [LHip, LKnee, LAnkle, LMidtarsal])] {
        let side = |axis| mirrored(axis, mirror);
        found.three(&(pelvis.inverse() * world(hip)), mirror);
        let shank = found.hinges(&world(hip), &world(knee), &[side([0.0, 0.0, -1.0])]);
        found.repeat();
        let foot = found.hinges(&shank, &world(ankle), &[side(ANKLE), side(SUBTALAR)]);
        found.hinges(&foot, &world(ball), &[side(TOES)]);
    }
    found.three(&(pelvis.inverse() * trunk), 1.0);
    for (mirror, [shoulder, elbow, wrist]) in [(1.0, [RShoulder, RElbow, RWrist]), (-1.0, [LShoulder, LElbow, LWrist])] {
        let side = |axis| mirrored(axis, mirror);
        let forearm = found.arm(&trunk, &world(shoulder), &world(elbow), mirror);
        // Palms in is 90 degrees of pronation.
        let palm_in = exp(&(side(PRONATION) * std::f64::consts::FRAC_PI_2));
        found.hinges(&(forearm * palm_in.inverse()), &world(wrist), &[side(PRONATION), side(Z), side(X)]);
    }
    std::array::from_fn(|k| found.values[k])
}

/// An axis of the right side's in our axes, for one side.
fn mirrored([x, y, z]: [f64; 3], mirror: f64) -> Vector3<f64> {
    ours([mirror * x, mirror * y, z]).normalize()
}

/// Coordinates so far.
struct Found<'a> {
    values: Vec<f64>,
    before: &'a [f64; 39],
}

impl Found<'_> {
    /// Z X Y of a rotation; left sides have x and y mirrored.
    fn three(&mut self, rotation: &UnitQuaternion<f64>, mirror: f64) {
        let axes = UnitQuaternion::from_rotation_matrix(&opensim_from_clip());
        let at = self.values.len();
        let before = [self.before[at], mirror * self.before[at + 1], mirror * self.before[at + 2]];
        let [z, x, y] = euler::near(&(axes * rotation * axes.inverse()), Order::ZXY, &before);
        self.values.extend([z, mirror * x, mirror * y]);
    }

    /// Angles about body-fixed axes that carry `parent` nearest to `wanted`; where that leads.
    fn hinges(&mut self, parent: &UnitQuaternion<f64>, wanted: &UnitQuaternion<f64>, axes: &[Vector3<f64>]) -> UnitQuaternion<f64> {
        let at = self.values.len();
        let angles = nearest(&(parent.inverse() * wanted), axes, &self.before[at..at + axes.len()]);
        self.values.extend(&angles);
        parent * product(axes, &angles)
    }

    /// The upper arm's three angles and the elbow's, four for the directions of two segments: elbow and wrist come where ours are,
    /// by a few Gauss-Newton steps. The model's elbow bends about an axis 13 degrees off ours, so the upper arm turns about
    /// itself; its own turn decides where the arm is straight. Returns the forearm.
    fn arm(
        &mut self,
        trunk: &UnitQuaternion<f64>,
        upper: &UnitQuaternion<f64>,
        lower: &UnitQuaternion<f64>,
        mirror: f64,
    ) -> UnitQuaternion<f64> {
        /// Weight of the upper arm's own rotation against the directions.
        const OWN: f64 = 0.05;
        const STEPS: usize = 10;
        let at = self.values.len();
        self.three(&(trunk.inverse() * upper), mirror);
        self.hinges(upper, lower, &[mirrored(ELBOW, mirror)]);
        let axes = [mirrored(Z, mirror), mirrored(X, mirror), mirrored(Y, mirror), mirrored(ELBOW, mirror)];
        let mut angles = Vector4::from_iterator(self.values.drain(at..));
        let residual = |angles: &Vector4<f64>| -> SVector<f64, 9> {
            let turned = trunk * product(&axes[..3], &angles.as_slice()[..3]);
            let own = log(&(turned.inverse() * upper)) * OWN;
            let along_upper = upper * Vector3::y() - turned * Vector3::y();
            let along_lower = lower * Vector3::y() - turned * exp(&(axes[3] * angles[3])) * Vector3::y();
            SVector::from_iterator([own, along_upper, along_lower].iter().flat_map(|v| v.iter().copied()))
        };
        for _ in 0..STEPS {
            const H: f64 = 1e-5;
            let slope = |k: usize| (residual(&(angles + Vector4::ith(k, H))) - residual(&(angles - Vector4::ith(k, H)))) / (2.0 * H);
            let jacobian = SMatrix::<f64, 9, 4>::from_columns(&[slope(0), slope(1), slope(2), slope(3)]);
            let normal = jacobian.transpose() * jacobian + Matrix4::identity() * 1e-9;
            let Some(step) = normal.cholesky().map(|c| c.solve(&(jacobian.transpose() * -residual(&angles)))) else { break };
            angles += step.map(|s| s.clamp(-0.5, 0.5));
        }
        self.values.extend(angles.iter());
        trunk * product(&axes, angles.as_slice())
    }

    fn repeat(&mut self) {
        self.values.extend(self.values.last().copied());
    }
}

fn product(axes: &[Vector3<f64>], angles: &[f64]) -> UnitQuaternion<f64> {
    axes.iter().zip(angles).fold(UnitQuaternion::identity(), |all, (axis, angle)| all * exp(&(axis * *angle)))
}

/// Gauss-Newton on r = log(P⁻¹ wanted), P the product: J^T r = 0 holds exactly at the least |r|, since r is an eigenvector of
/// the logarithm's derivative.
fn nearest(wanted: &UnitQuaternion<f64>, axes: &[Vector3<f64>], start: &[f64]) -> Vec<f64> {
    const STEPS: usize = 50;
    let mut angles = start.to_vec();
    for _ in 0..STEPS {
        let rest = log(&(product(axes, &angles).inverse() * wanted));
        let column = |k: usize| product(&axes[k + 1..], &angles[k + 1..]).inverse() * axes[k];
        let jacobian = DMatrix::from_fn(3, axes.len(), |row, k| column(k)[row]);
        let normal = jacobian.transpose() * &jacobian + DMatrix::identity(axes.len(), axes.len()) * 1e-9;
        let slope = jacobian.transpose() * DVector::from_column_slice(rest.as_slice());
        let Some(step) = normal.cholesky().map(|c| c.solve(&slope)) else { break };
        angles.iter_mut().zip(step.iter()).for_each(|(angle, step)| *angle += step.clamp(-1.0, 1.0));
        if step.amax() < 1e-12 {
            break;
        }
    }
    angles
}

#[cfg(test)]
pub(in crate::io) mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::io::mot;

    /// One and a half seconds of the synthetic database's first walker.
    pub fn walk() -> Clip {
        use crate::motion::{Length, play_cycle};
        use crate::motion_model::{Activity, synthetic};
        let cycle = synthetic::subject(Activity::Walking, 0).cycle(1.4, 0);
        let mut clip = play_cycle(&cycle, &Shape::template(1.7).offsets(), 60.0, Length::Seconds(1.5));
        clip.poses.truncate(90);
        clip
    }

    fn back(clip: &Clip) -> Clip {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("angles.mot");
        write(&path, clip).unwrap();
        let (back, notices) = mot::read(&path).unwrap();
        assert!(notices.is_empty() && back.poses.len() == clip.poses.len(), "{notices:?}");
        back
    }

    /// Largest angle between world rotations over the frames, degrees.
    fn apart(a: &Clip, b: &Clip, joint: Joint) -> f64 {
        let turn = |clip: &Clip, pose: &Pose| clip.place(pose).world_from_node[joint as usize];
        a.poses.iter().zip(&b.poses).map(|(p, q)| turn(a, p).angle_to(&turn(b, q)).to_degrees()).fold(0.0, f64::max)
    }

    #[test]
    fn what_the_model_can_hold_comes_back() {
        // Every coordinate moves on its own, as far as bodies go.
        let mut text = text_of(&walk());
        let body = text.find("\n0.000000").unwrap() + 1;
        let columns = |k: usize| -> Vec<f64> {
            let value = |(c, name): (usize, &&str)| match *name {
                "pelvis_tx" => 0.02 * k as f64,
                "pelvis_ty" => 0.95,
                "pelvis_tz" => 0.1,
                "pelvis_rotation" => 8.0 * k as f64,
                n if n.starts_with("knee") => 60.0 - 40.0 * (0.4 * k as f64 + f64::from(n.contains("_l"))).cos(),
                _ => 25.0 * (0.31 * k as f64 + c as f64).sin(),
            };
            COORDINATES.iter().enumerate().map(value).collect()
        };
        text.truncate(body);
        let rows: Vec<Vec<f64>> = (0..90).map(columns).collect();
        for (k, row) in rows.iter().enumerate() {
            let words: Vec<String> = row.iter().map(|v| format!("{v:.9}")).collect();
            text += &format!("{:.6}\t{}\n", k as f64 / 60.0, words.join("\t"));
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mot");
        std::fs::write(&path, &text).unwrap();
        let clip = mot::read(&path).unwrap().0;
        let mut before = [0.0; 39];
        for (k, (pose, row)) in clip.poses.iter().zip(&rows).enumerate() {
            before = coordinates(&clip, pose, &before);
            for ((name, found), wanted) in COORDINATES.iter().zip(before).zip(row) {
                let found = if is_length(name) { found } else { found.to_degrees() };
                assert!((found - wanted).abs() < 1e-6, "row {k} {name}: {found} for {wanted}");
            }
        }
    }

    /// Residuals of a synthetic walk, whose joints move about all axes: what 39 coordinates cannot hold.
    #[test]
    fn a_walk_loses_little() {
        use Joint::*;
        let clip = walk();
        let back = back(&clip);
        for (joint, most_deg) in [
            (Sacroiliac, 1e-4),
            (LHip, 1e-4),
            (RHip, 1e-4),
            (LKnee, 1e-4),
            (RKnee, 1e-4),
            (LAnkle, 10.0),
            (RAnkle, 10.0),
            (Vt1, 1e-4),
            // About themselves; their directions are held below.
            (LShoulder, 45.0),
            (RShoulder, 45.0),
            (LWrist, 1e-4),
            (RWrist, 1e-4),
        ] {
            let found = apart(&clip, &back, joint);
            println!("{}: {found:.5} degrees", joint.name());
            assert!(found < most_deg, "{}: {found} degrees", joint.name());
        }
        for joint in [LShoulder, RShoulder, LElbow, RElbow, LAnkle, RAnkle] {
            let down = if matches!(joint, LAnkle | RAnkle) { Vector3::z() } else { -Vector3::y() };
            let along = |clip: &Clip, pose: &Pose| clip.place(pose).world_from_node[joint as usize] * down;
            let off =
                clip.poses.iter().zip(&back.poses).map(|(p, q)| along(&clip, p).angle(&along(&back, q)).to_degrees()).fold(0.0, f64::max);
            println!("direction of the segment below {}: {off:.3} degrees", joint.name());
            assert!(off < if down.z > 0.0 { 8.0 } else { 1.0 }, "{}: {off} degrees", joint.name());
        }
        let pelvis = |clip: &Clip, pose: &Pose| clip.place(pose).position(Root);
        let off = clip.poses.iter().zip(&back.poses).map(|(p, q)| (pelvis(&clip, p) - pelvis(&back, q)).norm()).fold(0.0, f64::max);
        println!("root: {:.2} mm, stature {:.3} of {:.3}", 1e3 * off, back.hip_height_m, clip.hip_height_m);
        assert!(off < 0.005, "{off}");
    }

    #[test]
    fn the_least_angle_is_the_least() {
        let axes = [mirrored(ANKLE, 1.0), mirrored(SUBTALAR, 1.0)];
        let wanted = exp(&Vector3::new(0.4, -0.3, 0.5));
        let angles = nearest(&wanted, &axes, &[0.0, 0.0]);
        let off = |a: f64, b: f64| product(&axes, &[a, b]).angle_to(&wanted);
        let least = off(angles[0], angles[1]);
        let brute =
            (0..400).flat_map(|i| (0..400).map(move |j| (i, j))).map(|(i, j)| off(0.01 * f64::from(i) - 2.0, 0.01 * f64::from(j) - 2.0));
        let brute = brute.fold(f64::INFINITY, f64::min);
        assert!(least > 0.1 && least <= brute && brute < least + 1e-3, "{least} {brute}");
    }

    #[test]
    fn opensims_own_angles_survive() {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap/hamner-running/subject01/ik/Run_3.mot");
        if !data.is_file() {
            println!("skipped: no {}", data.display());
            return;
        }
        let clip = mot::read(&data).unwrap().0;
        let (theirs, ours): (String, String) = (std::fs::read_to_string(&data).unwrap(), text_of(&clip));
        let table = |text: &str| -> (Vec<String>, Vec<Vec<f64>>) {
            let lines: Vec<&str> = text.lines().skip_while(|l| l.trim() != "endheader").skip(1).filter(|l| !l.trim().is_empty()).collect();
            let names = lines[0].split_whitespace().map(String::from).collect();
            (names, lines[1..].iter().map(|l| l.split_whitespace().map(|w| w.parse().unwrap()).collect()).collect())
        };
        let (their_names, their_rows) = table(&theirs);
        let (our_names, our_rows) = table(&ours);
        assert_eq!((our_names.len(), our_rows.len()), (40, their_rows.len()));
        for (c, name) in their_names.iter().enumerate().skip(1) {
            let k = our_names.iter().position(|n| n == name).unwrap_or_else(|| panic!("{name}"));
            // Knees bend to the negative side in that model.
            let sign = if name.starts_with("knee") { -1.0 } else { 1.0 };
            let off = our_rows.iter().zip(&their_rows).map(|(a, b)| (a[k] - sign * b[c]).abs()).fold(0.0, f64::max);
            assert!(off < 1e-4, "{name}: {off}");
        }
    }

    #[test]
    fn the_header_is_opensims() {
        let text = text_of(&walk());
        assert!(
            text.starts_with("Coordinates\nversion=1\nnRows=90\nnColumns=40\ninDegrees=yes\n")
                && text.contains("\nendheader\ntime\tpelvis_tilt\t")
        );
    }
}

//! OpenSim joint angles (MOT, STO), read straight onto the 78 DOF.
//!
//! Coordinates and axes are those of the gait2392, Hamner and Rajagopal models (axes X forward, Y up, Z right; pelvis Z-X-Y
//! body-fixed; the axes below are the models' own, read from a scaled Hamner model; left axes are the right ones with x and
//! y negated). Lumbar angles go to vl5, pronation to the wrist, less the 90 degrees between the models' palms forward and ours in.
//! Knee flexion is positive in Rajagopal's model and negative in the older ones: the mean sign decides.
//! The file knows no lengths: stature is such that the template's soles reach the models' floor, y = 0.
//! Checked by forward kinematics of the scaled model, normative gait curves and the sign of every angle on real data.

use std::path::{Path, PathBuf};

use nalgebra::{UnitQuaternion, Vector3};

use super::mapping::tidy_fps;
use crate::body::{Clip, Joint, Pose, Shape};
use crate::math::order::quantile;
use crate::math::rotation::exp;

#[derive(Debug, thiserror::Error)]
pub enum MotError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path}:{line}: {what}")]
    Syntax { path: PathBuf, line: usize, what: String },
    #[error("{path}: no column {columns}; write joint angles of a gait2392, Hamner or Rajagopal model")]
    Columns { path: PathBuf, columns: String },
    #[error("{path}: {what}")]
    Content { path: PathBuf, what: String },
}

/// Line (from 1) and what is wrong there.
type Fault = (usize, String);

/// A table of columns over time.
struct Table {
    names: Vec<String>,
    /// Without the rows that repeat a time stamp.
    rows: Vec<Vec<f64>>,
    repeated: usize,
    degrees: bool,
}

/// Without these a motion cannot be placed; other coordinates are zero where absent.
const REQUIRED: [&str; 10] = [
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "pelvis_tx",
    "pelvis_ty",
    "pelvis_tz",
    "hip_flexion_r",
    "hip_flexion_l",
    "knee_angle_r",
    "knee_angle_l",
];

/// Template hip joints from the pelvis' origin, fractions of stature: gait2392's -70.7 and -66.1 mm in a man of 1.80 m.
pub(super) const HIP_FORWARD: f64 = -0.0393;
pub(super) const HIP_UP: f64 = -0.0367;

/// Reads a `.mot` or `.sto`; with the clip come notices, one sentence each.
pub fn read(path: &Path) -> Result<(Clip, Vec<String>), MotError> {
    let bytes = std::fs::read(path).map_err(|cause| MotError::Read { path: path.into(), cause })?;
    let (table, mut notices) =
        parse(&String::from_utf8_lossy(&bytes)).map_err(|(line, what)| MotError::Syntax { path: path.into(), line, what })?;
    let missing: Vec<&str> = REQUIRED.into_iter().filter(|n| table.column(n).is_none()).collect();
    if !missing.is_empty() {
        return Err(MotError::Columns { path: path.into(), columns: missing.join(", ") });
    }
    if table.repeated > 0 {
        notices.push(format!("dropped {} rows that repeat a time stamp", table.repeated));
    }
    let content = |what: String| MotError::Content { path: path.into(), what };
    let fps = frame_rate(&table).map_err(content)?;
    let clip = clip_of(&table, fps).map_err(|what| MotError::Content { path: path.into(), what })?;
    Ok((clip, notices))
}

impl Table {
    fn column(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|n| n == name)
    }

    fn mean(&self, name: &str) -> f64 {
        let Some(column) = self.column(name) else { return 0.0 };
        self.rows.iter().map(|r| r[column]).sum::<f64>() / self.rows.len() as f64
    }
}

fn parse(text: &str) -> Result<(Table, Vec<String>), Fault> {
    let mut lines = text.lines().enumerate().map(|(i, l)| (i + 1, l.trim()));
    let (mut declared, mut degrees, mut simm, mut header_end) = (None, None, false, 0);
    for (line, text) in lines.by_ref() {
        header_end = line;
        let lower = text.to_ascii_lowercase();
        if lower == "endheader" {
            break;
        }
        simm |= lower.contains("simm motion file") || lower.starts_with("datacolumns");
        match lower.split_once(['=', ' ']).map(|(k, v)| (k.trim(), v.trim_matches(['=', ' ']))) {
            Some(("nrows" | "datarows", value)) => declared = value.parse::<usize>().ok().map(|n| (line, n)),
            Some(("indegrees", value)) => degrees = Some(value == "yes"),
            _ => {}
        }
    }
    let mut lines = lines.filter(|(_, l)| !l.is_empty());
    let (names_line, names) = lines.next().ok_or((header_end, "no column names after 'endheader'; the file is cut short".to_string()))?;
    let names: Vec<String> = names.split_whitespace().map(coordinate).collect();
    if names.first().map(String::as_str) != Some("time") {
        return Err((names_line, "the first column must be 'time'".into()));
    }
    let all = lines.map(|(line, text)| parse_row(&names, line, text)).collect::<Result<Vec<_>, _>>()?;
    if let Some((line, n)) = declared.filter(|&(_, n)| n != all.len()) {
        return Err((line, format!("{n} rows are declared but {} follow; correct the number or copy the file again", all.len())));
    }
    let mut notices = Vec::new();
    if degrees.is_none() && !simm {
        notices.push("the header does not say inDegrees; angles taken as degrees".to_string());
    }
    let (rows, repeated) = without_repeats(all)?;
    Ok((Table { names, rows, repeated, degrees: degrees.unwrap_or(true) }, notices))
}

/// `hip_flexion_r` of `/jointset/hip_r/hip_flexion_r/value`.
fn coordinate(name: &str) -> String {
    name.strip_suffix("/value").and_then(|n| n.rsplit('/').next()).unwrap_or(name).to_string()
}

/// The line number and the values.
fn parse_row(names: &[String], line: usize, text: &str) -> Result<(usize, Vec<f64>), Fault> {
    let words: Vec<&str> = text.split_whitespace().collect();
    if words.len() != names.len() {
        return Err((line, format!("{} values where the table has {} columns; the line is cut", words.len(), names.len())));
    }
    let value = |(word, name): (&&str, &String)| match word.parse::<f64>() {
        Ok(v) if v.is_finite() => Ok(v),
        Ok(_) => Err((line, format!("column {name} holds {word}; fill the gap or cut the trial before it"))),
        Err(_) => Err((line, format!("column {name} holds '{}', which is not a number", word.chars().take(40).collect::<String>()))),
    };
    Ok((line, words.iter().zip(names).map(value).collect::<Result<_, _>>()?))
}

fn without_repeats(all: Vec<(usize, Vec<f64>)>) -> Result<(Vec<Vec<f64>>, usize), Fault> {
    let mut rows: Vec<Vec<f64>> = Vec::with_capacity(all.len());
    let mut repeated = 0;
    for (line, row) in all {
        match rows.last().map(|last| row[0] - last[0]) {
            Some(step) if step < 0.0 => return Err((line, format!("time runs back to {} s; sort the rows", row[0]))),
            Some(step) if step < 1e-9 => repeated += 1,
            _ => rows.push(row),
        }
    }
    Ok((rows, repeated))
}

fn frame_rate(table: &Table) -> Result<f64, String> {
    let [first, .., last] = &table.rows[..] else { return Err("fewer than two rows; a motion needs more".into()) };
    let mean = (last[0] - first[0]) / (table.rows.len() - 1) as f64;
    for pair in table.rows.windows(2) {
        let step = pair[1][0] - pair[0][0];
        if (step - mean).abs() > 0.2 * mean {
            return Err(format!(
                "the time step after {} s is {step:.5} s where the mean is {mean:.5} s; resample at a constant rate",
                pair[0][0]
            ));
        }
    }
    Ok(tidy_fps(1.0 / mean))
}

fn clip_of(table: &Table, fps: f64) -> Result<Clip, String> {
    let angle = if table.degrees { 1f64.to_radians() } else { 1.0 };
    let knee_sign = if table.mean("knee_angle_r") + table.mean("knee_angle_l") < 0.0 { -1.0 } else { 1.0 };
    let origins: Vec<Vector3<f64>> = table.rows.iter().map(|row| pelvis_origin(&Row { table, row, angle })).collect();
    let mut poses: Vec<Pose> = table.rows.iter().map(|row| pose_of(&Row { table, row, angle }, knee_sign)).collect();
    let stature = stature_of(&poses, &origins)?;
    let shape = Shape::template(stature);
    for (pose, origin) in poses.iter_mut().zip(&origins) {
        pose.root = origin + pose.world_from_root * root_from_origin(stature);
    }
    Ok(Clip { fps, poses, offsets: shape.offsets(), hip_height_m: shape.hip_height_m() })
}

/// One row of the table.
struct Row<'a> {
    table: &'a Table,
    row: &'a [f64],
    /// Radians per unit of angle.
    angle: f64,
}

impl Row<'_> {
    fn value(&self, name: &str) -> f64 {
        self.table.column(name).and_then(|c| self.row.get(c)).copied().unwrap_or(0.0)
    }

    /// Rotation about an axis of OpenSim's by a coordinate, in our axes.
    fn turn(&self, axis: [f64; 3], name: &str) -> UnitQuaternion<f64> {
        exp(&(ours(axis).normalize() * self.value(name) * self.angle))
    }
}

/// OpenSim's X forward, Y up, Z right as ours: x left, y up, z forward.
pub(super) fn ours([x, y, z]: [f64; 3]) -> Vector3<f64> {
    Vector3::new(-z, y, x)
}

fn pelvis_origin(row: &Row) -> Vector3<f64> {
    ours(["pelvis_tx", "pelvis_ty", "pelvis_tz"].map(|n| row.value(n)))
}

/// Our root from the pelvis' origin in body axes.
fn root_from_origin(stature: f64) -> Vector3<f64> {
    let rise = Joint::Root.rest_position().y - Joint::LHip.rest_position().y;
    stature * Vector3::new(0.0, HIP_UP + rise, HIP_FORWARD)
}

pub(super) const X: [f64; 3] = [1.0, 0.0, 0.0];
pub(super) const Y: [f64; 3] = [0.0, 1.0, 0.0];
pub(super) const Z: [f64; 3] = [0.0, 0.0, 1.0];
pub(super) const ANKLE: [f64; 3] = [-0.105014, -0.174022, 0.979126];
pub(super) const SUBTALAR: [f64; 3] = [0.787180, 0.604747, -0.120949];
pub(super) const TOES: [f64; 3] = [-0.580954, 0.0, 0.813936];
pub(super) const ELBOW: [f64; 3] = [0.226047, 0.022269, 0.973862];
pub(super) const PRONATION: [f64; 3] = [0.056398, 0.998406, 0.001952];

/// Everything but the root's position.
fn pose_of(row: &Row, knee_sign: f64) -> Pose {
    use Joint::*;
    let mut pose = Pose::rest(Vector3::zeros());
    pose.world_from_root = row.turn(Z, "pelvis_tilt") * row.turn(X, "pelvis_list") * row.turn(Y, "pelvis_rotation");
    let mut set = |joint: Joint, rotation: UnitQuaternion<f64>| pose.joints[joint as usize - 1] = rotation;
    set(Vl5, row.turn(Z, "lumbar_extension") * row.turn(X, "lumbar_bending") * row.turn(Y, "lumbar_rotation"));
    for (side, mirror, [hip, knee, ankle, ball, shoulder, elbow, wrist]) in [
        ("r", 1.0, [RHip, RKnee, RAnkle, RMidtarsal, RShoulder, RElbow, RWrist]),
        ("l", -1.0, [LHip, LKnee, LAnkle, LMidtarsal, LShoulder, LElbow, LWrist]),
    ] {
        let turn = |[x, y, z]: [f64; 3], name: &str| row.turn([mirror * x, mirror * y, z], &format!("{name}_{side}"));
        set(hip, turn(Z, "hip_flexion") * turn(X, "hip_adduction") * turn(Y, "hip_rotation"));
        set(knee, turn([0.0, 0.0, -knee_sign], "knee_angle"));
        set(ankle, turn(ANKLE, "ankle_angle") * turn(SUBTALAR, "subtalar_angle"));
        set(ball, turn(TOES, "mtp_angle"));
        set(shoulder, turn(Z, "arm_flex") * turn(X, "arm_add") * turn(Y, "arm_rot"));
        set(elbow, turn(ELBOW, "elbow_flex"));
        let [x, y, z] = PRONATION;
        let palm_in = row.table.column(&format!("pro_sup_{side}")).map_or(0.0, |_| std::f64::consts::FRAC_PI_2);
        let neutral = exp(&(ours([mirror * x, mirror * y, z]).normalize() * -palm_in));
        set(wrist, turn(PRONATION, "pro_sup") * neutral * turn(Z, "wrist_flex") * turn(X, "wrist_dev"));
    }
    pose
}

/// The stature whose soles reach y = 0 when the pelvis is where the file says: the lower fifth over the frames of
/// pelvis height / (height above the sole per metre of stature), since flight makes the ratio larger.
fn stature_of(poses: &[Pose], origins: &[Vector3<f64>]) -> Result<f64, String> {
    let unit = Shape::template(1.0);
    let clip = Clip { fps: 1.0, poses: Vec::new(), offsets: unit.offsets(), hip_height_m: unit.hip_height_m() };
    let ratio = |(pose, origin): (&Pose, &Vector3<f64>)| {
        let mut placed = pose.clone();
        placed.root = pose.world_from_root * root_from_origin(1.0);
        origin.y / -clip.sole_height(&placed)
    };
    let stature = quantile(poses.iter().zip(origins).map(ratio).collect(), 0.2).unwrap_or(0.0);
    if (0.8..2.5).contains(&stature) {
        return Ok(stature);
    }
    Err(format!("pelvis_ty implies a stature of {stature:.2} m; it must be the pelvis' height in metres above the floor y = 0"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rotation::log;

    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/mocap").join(name)
    }

    fn degrees(q: &UnitQuaternion<f64>) -> Vector3<f64> {
        log(q) * 180.0 / std::f64::consts::PI
    }

    fn clip_from(text: &str) -> Clip {
        let (table, _) = parse(text).unwrap();
        clip_of(&table, frame_rate(&table).unwrap()).unwrap()
    }

    #[test]
    fn bent_joints_of_the_fixture_arrive_bent() {
        let (clip, notices) = read(&fixture("tiny.mot")).unwrap();
        assert!(notices.is_empty());
        assert_eq!((clip.fps, clip.poses.len()), (100.0, 4));
        // Standing straight, the soles are on the floor and the pelvis' origin 0.95 m above it.
        assert!(clip.sole_height(&clip.poses[0]).abs() < 1e-9);
        let stature = 0.95 / (0.530 - HIP_UP);
        assert!((clip.hip_height_m - 0.530 * stature).abs() < 1e-9);
        let is = |frame: usize, joint: Joint, expected: [f64; 3]| {
            let rotation = degrees(clip.poses[frame].joint(joint));
            assert!((rotation - Vector3::from(expected)).norm() < 1e-4, "frame {frame} {}: {rotation:?}", joint.name());
        };
        use Joint::*;
        for joint in Joint::ALL.into_iter().skip(1) {
            is(0, joint, [0.0; 3]);
        }
        is(1, LHip, [-30.0, 0.0, 0.0]);
        is(1, LKnee, [60.0, 0.0, 0.0]);
        // Leaning forward, the right arm forward, turned to the left with the world's X now to the person's right.
        is(2, Vl5, [10.0, 0.0, 0.0]);
        is(2, RShoulder, [-20.0, 0.0, 0.0]);
        assert!((degrees(&clip.poses[2].world_from_root) - Vector3::new(0.0, 90.0, 0.0)).norm() < 1e-6);
        assert!((clip.poses[2].root.z - clip.poses[2].root.z.max(0.1)).abs() < 1e-9 && clip.poses[2].root.x.abs() > 0.01);
        // Abduction: away from the body on both sides.
        is(3, LShoulder, [0.0, 0.0, 20.0]);
        is(3, RShoulder, [0.0, 0.0, -20.0]);
        is(3, LHip, [0.0, 0.0, 15.0]);
        assert!(degrees(clip.poses[3].joint(LAnkle)).x < -19.0, "dorsiflexion lifts the toes");
    }

    #[test]
    fn knee_sign_and_radians_follow_the_file() {
        let text = std::fs::read_to_string(fixture("tiny.mot")).unwrap();
        let expected = clip_from(&text);
        let (head, body) = text.split_at(text.find("\n0.000000").unwrap() + 1);
        let converted = |convert: &dyn Fn(&str, f64) -> f64| -> String {
            let names: Vec<&str> = head.lines().last().unwrap().split('\t').collect();
            let row = |l: &str| l.split('\t').zip(&names).map(|(w, n)| convert(n, w.parse().unwrap()).to_string()).collect::<Vec<_>>();
            body.lines().map(|l| row(l).join("\t") + "\n").collect()
        };
        let old_knee = head.to_string() + &converted(&|n, v| if n.starts_with("knee") { -v } else { v });
        let length = |n: &str| n == "time" || n.starts_with("pelvis_t") && n != "pelvis_tilt";
        let radians = head.replace("inDegrees=yes", "inDegrees=no") + &converted(&|n, v| if length(n) { v } else { v.to_radians() });
        let simm = head.replace("inDegrees=yes", "# SIMM Motion File Header:\ndatacolumns 28") + body;
        let states = text.replace("hip_flexion_l", "/jointset/hip_l/hip_flexion_l/value");
        for (what, text) in [("knee", old_knee), ("radians", radians), ("simm", simm), ("states", states)] {
            let clip = clip_from(&text);
            for (a, b) in clip.poses.iter().zip(&expected.poses) {
                let largest = a.joints.iter().zip(&b.joints).map(|(a, b)| a.angle_to(b)).fold(0.0, f64::max);
                assert!(largest < 1e-7 && (a.root - b.root).norm() < 1e-7, "{what}: {largest}");
            }
        }
    }

    #[test]
    fn faults_are_named_with_row_and_column() {
        let good = std::fs::read_to_string(fixture("tiny.mot")).unwrap();
        for (bad, line, phrase) in [
            (good.replace("nRows=4", "nRows=5"), 3, "5 rows are declared but 4 follow"),
            (good.replace("60.000000", "NaN"), 10, "column knee_angle_l holds NaN"),
            (good.replace("60.000000", "sixty"), 10, "column knee_angle_l holds 'sixty'"),
            (good.replace("\t60.000000", ""), 10, "27 values where the table has 28 columns"),
            (good.replace("0.020000\t", "0.005000\t"), 11, "time runs back"),
            (good.replace("time\t", "t\t"), 8, "first column must be 'time'"),
            (good.replace("endheader", "end"), 12, "no column names after 'endheader'"),
        ] {
            let (at, what) = parse(&bad).map(|_| ()).unwrap_err();
            assert!(at == line && what.contains(phrase), "{at} instead of {line}: {what}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.sto");
        for (bad, phrase) in [
            (good.replace("knee_angle_l", "knee_l"), "no column knee_angle_l;"),
            (good.replace("0.950000", "0.000000"), "pelvis_ty implies a stature"),
            (good.replace("0.030000\t", "0.060000\t"), "resample at a constant rate"),
        ] {
            std::fs::write(&path, bad).unwrap();
            let error = read(&path).map(|_| ()).unwrap_err().to_string();
            assert!(error.contains(phrase), "{error}");
        }
        std::fs::write(&path, good.replace("0.030000\t", "0.020000\t")).unwrap();
        let (clip, notices) = read(&path).unwrap();
        assert_eq!((clip.poses.len(), notices.len()), (3, 1));
    }

    /// Marker names and positions per frame in our axes, metres.
    fn markers(path: &Path) -> (Vec<String>, Vec<Vec<Vector3<f64>>>) {
        let text = std::fs::read_to_string(path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let names = lines[3].split('\t').skip(2).filter(|w| !w.trim().is_empty()).map(str::to_string).collect();
        let row = |line: &str| {
            let values: Vec<f64> = line.split('\t').skip(2).map(|w| w.trim().parse().unwrap_or(f64::NAN)).collect();
            values.chunks_exact(3).map(|c| ours([c[0], c[1], c[2]]) / 1000.0).collect()
        };
        let is_row = |l: &&&str| l.split('\t').next().is_some_and(|w| w.trim().parse::<u32>().is_ok());
        (names, lines[5..].iter().filter(is_row).map(|l| row(l)).collect())
    }

    /// The runners' own markers are the truth that no angle convention can bend: elbows and ankles lie between theirs.
    #[test]
    fn joints_lie_between_the_runners_markers() {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap/hamner-running");
        if !data.is_dir() {
            println!("skipped: no ../shared/data/mocap/hamner-running");
            return;
        }
        for (trial, pairs) in [
            ("subject01/{}/Run_3", vec![("RLEL", "RMEL", Joint::RElbow), ("LLEL", "LMEL", Joint::LElbow)]),
            (
                "subject03/{}/Run_4",
                vec![("RLEL", "RMEL", Joint::RElbow), ("LLEL", "LMEL", Joint::LElbow), ("RLMAL", "RMMAL", Joint::RAnkle)],
            ),
        ] {
            let (clip, _) = read(&data.join(trial.replace("{}", "ik") + ".mot")).unwrap();
            let (names, frames) = markers(&data.join(trial.replace("{}", "expData") + ".trc"));
            assert_eq!(clip.poses.len(), frames.len());
            for (outer, inner, joint) in pairs {
                let at = |name: &str| names.iter().position(|n| n == name).unwrap();
                let off = |(pose, markers): (&Pose, &Vec<Vector3<f64>>)| {
                    clip.place(pose).position(joint) - 0.5 * (markers[at(outer)] + markers[at(inner)])
                };
                let errors: Vec<Vector3<f64>> = clip.poses.iter().zip(&frames).map(off).filter(|e| e.x.is_finite()).collect();
                assert!(errors.len() > 300);
                let mean = errors.iter().sum::<Vector3<f64>>() / errors.len() as f64;
                let spread = (errors.iter().map(|e| (e - mean).norm_squared()).sum::<f64>() / errors.len() as f64).sqrt();
                println!("{trial} {}: mean {:.0} mm, spread {:.0} mm", joint.name(), 1e3 * mean.norm(), 1e3 * spread);
                // The elbow swings through more than 300 mm, the ankle through more than 800.
                assert!(mean.norm() < 0.045 && spread < 0.025, "{trial} {}: {mean:?} {spread}", joint.name());
            }
        }
    }
}

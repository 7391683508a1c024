//! Acclaim skeleton (ASF) and motion (AMC).
//!
//! A bone with axis rotation C and motion M (its degrees of freedom in the listed order, first applied first) has
//!   world_from_bone = world_from_parent · C M C⁻¹,                                                   (1)
//! identity at the zero pose, and ends at start + world_from_bone · direction · length. A [`RecordedJoint`] is a bone, placed at
//! its start. Units: `length 0.45` means 1/0.45 inch per unit. AMC holds no frame rate; CMU's is 120 Hz. A root offset other than zero is refused.
//! Checked against an independent forward kinematics and the same trials as BVH.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use nalgebra::{UnitQuaternion, Vector3};

use super::mapping::{RecordedFrame, RecordedJoint, Recording};

/// Frame rate of CMU's recordings, Hz.
const FPS: f64 = 120.0;
const METRES_PER_INCH: f64 = 0.0254;

/// Bones that may come with each degree of freedom: every frame places all bones, but holds the freedoms' values only.
const MOST_STILL: usize = 16;

#[derive(Debug, thiserror::Error)]
pub enum AsfAmcError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path}:{line}: {what}")]
    Syntax { path: PathBuf, line: usize, what: String },
    #[error("{amc}: no skeleton found beside it; put {wanted} there")]
    NoSkeleton { amc: PathBuf, wanted: String },
}

/// Line (from 1) and what is wrong there.
type Fault = (usize, String);

/// Reads `amc` with its skeleton: `07.asf` for `07_02.amc`, else `07_02.asf`, else the only `.asf` in the folder.
pub fn read(amc: &Path) -> Result<Recording, AsfAmcError> {
    let asf = skeleton_beside(amc)?;
    let skeleton = parse_asf(&text(&asf)?).map_err(at(&asf))?;
    let frames = parse_amc(&text(amc)?, &skeleton).map_err(at(amc))?;
    let joints = skeleton.recorded_joints();
    Ok(Recording { fps: FPS, metres_per_unit: Some(skeleton.metres_per_unit), joints, frames })
}

fn at(path: &Path) -> impl Fn(Fault) -> AsfAmcError {
    move |(line, what)| AsfAmcError::Syntax { path: path.into(), line, what }
}

fn text(path: &Path) -> Result<String, AsfAmcError> {
    let bytes = std::fs::read(path).map_err(|cause| AsfAmcError::Read { path: path.into(), cause })?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

fn skeleton_beside(amc: &Path) -> Result<PathBuf, AsfAmcError> {
    let stem = amc.file_stem().unwrap_or_default().to_string_lossy();
    let subject = stem.split('_').next().unwrap_or_default().to_string();
    for name in [&subject, &*stem] {
        for extension in ["asf", "ASF"] {
            let path = amc.with_file_name(format!("{name}.{extension}"));
            if path.is_file() {
                return Ok(path);
            }
        }
    }
    let folder = amc.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let entries = std::fs::read_dir(folder).map_err(|cause| AsfAmcError::Read { path: folder.into(), cause })?;
    let is_asf = |p: &PathBuf| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("asf"));
    let found: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(is_asf).collect();
    match <[PathBuf; 1]>::try_from(found) {
        Ok([only]) => Ok(only),
        Err(_) => Err(AsfAmcError::NoSkeleton { amc: amc.into(), wanted: format!("{subject}.asf") }),
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Freedom {
    Translation(usize),
    Rotation(usize),
    Length,
}

struct Bone {
    name: String,
    parent: Option<usize>,
    /// From start to end at the zero pose.
    vector: Vector3<f64>,
    axis: UnitQuaternion<f64>,
    freedoms: Vec<Freedom>,
}

struct Skeleton {
    /// The root first, parents before children.
    bones: Vec<Bone>,
    /// Order in which the root's rotations are applied.
    root_order: Vec<usize>,
    metres_per_unit: f64,
    degrees: bool,
}

impl Skeleton {
    fn recorded_joints(&self) -> Vec<RecordedJoint> {
        let leaf = |i: usize| self.bones.iter().all(|b| b.parent != Some(i));
        let joint = |(i, bone): (usize, &Bone)| RecordedJoint {
            name: bone.name.clone(),
            parent: bone.parent,
            offset: bone.parent.map_or(Vector3::zeros(), |p| self.bones[p].vector),
            end: leaf(i).then_some(bone.vector),
        };
        self.bones.iter().enumerate().map(joint).collect()
    }
}

fn number(word: &str, line: usize) -> Result<f64, Fault> {
    match word.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) => Err((line, format!("'{word}' is not a finite number; cut the recording there or fill the gap"))),
        Err(_) => Err((line, format!("'{}' is not a number", word.chars().take(40).collect::<String>()))),
    }
}

fn three(words: &[&str], line: usize) -> Result<Vector3<f64>, Fault> {
    match words {
        [x, y, z, ..] => Ok(Vector3::new(number(x, line)?, number(y, line)?, number(z, line)?)),
        _ => Err((line, "three numbers belong here".into())),
    }
}

/// `XYZ` as axes, first applied first.
fn axis_order(word: &str, line: usize) -> Result<Vec<usize>, Fault> {
    let axis = |c: char| "XYZ".find(c.to_ascii_uppercase());
    let order: Option<Vec<usize>> = word.chars().map(axis).collect();
    order.filter(|o| o.len() == 3).ok_or((line, format!("'{word}' is no order of axes such as XYZ")))
}

/// Rotations about the fixed axes in `order`, first applied first.
fn in_order(order: &[usize], angles: &Vector3<f64>) -> UnitQuaternion<f64> {
    order.iter().fold(UnitQuaternion::identity(), |q, &axis| UnitQuaternion::from_axis_angle(&Vector3::ith_axis(axis), angles[axis]) * q)
}

fn freedom(word: &str, line: usize) -> Result<Freedom, Fault> {
    Ok(match word.to_ascii_lowercase().as_str() {
        "tx" => Freedom::Translation(0),
        "ty" => Freedom::Translation(1),
        "tz" => Freedom::Translation(2),
        "rx" => Freedom::Rotation(0),
        "ry" => Freedom::Rotation(1),
        "rz" => Freedom::Rotation(2),
        "l" => Freedom::Length,
        _ => return Err((line, format!("'{word}' is no degree of freedom (tx ty tz rx ry rz l)"))),
    })
}

/// Lines without comments and blanks, with their numbers.
fn lines(text: &str) -> impl Iterator<Item = (usize, Vec<&str>)> {
    text.lines()
        .enumerate()
        .map(|(i, l)| (i + 1, l.split('#').next().unwrap_or_default().split_whitespace().collect::<Vec<_>>()))
        .filter(|(_, words)| !words.is_empty())
}

/// A bone as it stands in `:bonedata`.
struct BoneText {
    line: usize,
    name: String,
    direction: Vector3<f64>,
    length: f64,
    axis: Vector3<f64>,
    order: Vec<usize>,
    freedoms: Vec<Freedom>,
}

fn parse_asf(text: &str) -> Result<Skeleton, Fault> {
    let mut section = String::new();
    let (mut degrees, mut metres_per_unit) = (true, METRES_PER_INCH);
    let (mut root_freedoms, mut root_order) = (Vec::new(), vec![0, 1, 2]);
    let mut bones: Vec<BoneText> = Vec::new();
    let mut children: Vec<(usize, String, Vec<String>)> = Vec::new();
    let mut last_line = 0;
    for (line, words) in lines(text) {
        last_line = line;
        if let Some(name) = words[0].strip_prefix(':') {
            section = name.to_ascii_lowercase();
            continue;
        }
        let key = words[0].to_ascii_lowercase();
        match (section.as_str(), key.as_str(), &words[1..]) {
            ("units", "length", [value, ..]) => metres_per_unit = METRES_PER_INCH / positive(value, line)?,
            ("units", "angle", [unit, ..]) => degrees = !unit.to_ascii_lowercase().starts_with("rad"),
            ("root", "order", order) => root_freedoms = order.iter().map(|w| freedom(w, line)).collect::<Result<_, _>>()?,
            ("root", "axis", [order, ..]) => root_order = axis_order(order, line)?,
            ("root", "position" | "orientation", values) if three(values, line)?.norm() > 0.0 => {
                return Err((line, format!("a root {key} other than 0 0 0 is not supported")));
            }
            ("bonedata", "begin", _) => bones.push(BoneText::new(line)),
            ("bonedata", _, values) => {
                let bone = bones.last_mut().ok_or((line, "'begin' is missing before this bone".to_string()))?;
                bone.read(&key, values, line)?;
            }
            ("hierarchy", "begin" | "end", _) => {}
            ("hierarchy", _, below) => children.push((line, words[0].to_string(), below.iter().map(|w| w.to_string()).collect())),
            _ => {}
        }
    }
    if children.is_empty() {
        return Err((last_line, "the :hierarchy part is missing; the file is cut short".into()));
    }
    let root =
        Bone { name: "root".into(), parent: None, vector: Vector3::zeros(), axis: UnitQuaternion::identity(), freedoms: root_freedoms };
    let bones = assemble(root, &bones, &children, degrees)?;
    let freedoms = bones.iter().map(|b| b.freedoms.len()).sum::<usize>();
    if bones.len() > MOST_STILL * (freedoms + 1) {
        let what = format!("{} bones with only {freedoms} degrees of freedom in all are no skeleton of a recording", bones.len());
        return Err((last_line, what));
    }
    Ok(Skeleton { bones, root_order, metres_per_unit, degrees })
}

fn positive(word: &str, line: usize) -> Result<f64, Fault> {
    number(word, line).and_then(|v| if v > 0.0 { Ok(v) } else { Err((line, format!("'{word}' must be positive"))) })
}

impl BoneText {
    fn new(line: usize) -> BoneText {
        let (direction, axis) = (Vector3::zeros(), Vector3::zeros());
        BoneText { line, name: String::new(), direction, length: 0.0, axis, order: vec![0, 1, 2], freedoms: Vec::new() }
    }

    fn read(&mut self, key: &str, values: &[&str], line: usize) -> Result<(), Fault> {
        match (key, values) {
            ("name", [name, ..]) => self.name = name.to_string(),
            ("direction", values) => self.direction = three(values, line)?,
            ("length", [value, ..]) => self.length = number(value, line)?,
            ("axis", values) => {
                self.axis = three(values, line)?;
                self.order = axis_order(values.get(3).unwrap_or(&"XYZ"), line)?;
            }
            ("dof", values) => self.freedoms = values.iter().map(|w| freedom(w, line)).collect::<Result<_, _>>()?,
            ("name" | "length", []) => return Err((line, format!("'{key}' has no value"))),
            _ => {}
        }
        Ok(())
    }
}

/// Bones in hierarchical order.
fn assemble(root: Bone, texts: &[BoneText], children: &[(usize, String, Vec<String>)], degrees: bool) -> Result<Vec<Bone>, Fault> {
    let mut bones = vec![root];
    for (line, parent, below) in children {
        let parent = bones.iter().position(|b| b.name == *parent).ok_or((*line, format!("'{parent}' is not yet in the hierarchy")))?;
        for name in below {
            let text = texts.iter().find(|b| b.name == *name).ok_or((*line, format!("bone '{name}' is not in :bonedata")))?;
            if bones.iter().any(|b| b.name == *name) {
                return Err((*line, format!("bone '{name}' has two parents")));
            }
            let direction = text.direction.try_normalize(1e-12).ok_or((text.line, format!("bone '{name}' has no direction")))?;
            let angles = if degrees { text.axis.map(f64::to_radians) } else { text.axis };
            let axis = in_order(&text.order, &angles);
            let freedoms = text.freedoms.clone();
            bones.push(Bone { name: name.clone(), parent: Some(parent), vector: direction * text.length, axis, freedoms });
        }
    }
    Ok(bones)
}

fn parse_amc(text: &str, skeleton: &Skeleton) -> Result<Vec<RecordedFrame>, Fault> {
    let index: HashMap<&str, usize> = skeleton.bones.iter().enumerate().map(|(i, b)| (b.name.as_str(), i)).collect();
    let mut degrees = skeleton.degrees;
    let mut frames = Vec::new();
    let mut values: Vec<Option<Vec<f64>>> = Vec::new();
    let mut started = 0;
    for (line, words) in lines(text) {
        let key = words[0].to_ascii_lowercase();
        match (key.as_str(), &words[1..]) {
            (":degrees", _) => degrees = true,
            (":radians", _) => degrees = false,
            (other, _) if other.starts_with(':') => {}
            (_, []) if words[0].parse::<u64>().is_ok() => {
                if started > 0 {
                    frames.push(place(skeleton, &values, degrees, started)?);
                }
                values = vec![None; skeleton.bones.len()];
                started = line;
            }
            (_, numbers) => {
                let &bone = index.get(words[0]).ok_or((line, format!("bone '{}' is not in the skeleton", words[0])))?;
                let slot = values.get_mut(bone).ok_or((line, "a frame number belongs before the first bone".to_string()))?;
                let wanted = skeleton.bones[bone].freedoms.len();
                if numbers.len() != wanted || slot.is_some() {
                    let what = format!("'{}' has {} values here where the skeleton has {wanted}, once per frame", words[0], numbers.len());
                    return Err((line, what));
                }
                *slot = Some(numbers.iter().map(|w| number(w, line)).collect::<Result<_, _>>()?);
            }
        }
    }
    if started > 0 {
        frames.push(place(skeleton, &values, degrees, started)?);
    }
    Ok(frames)
}

/// Forward kinematics of one frame, equation (1).
fn place(skeleton: &Skeleton, values: &[Option<Vec<f64>>], degrees: bool, line: usize) -> Result<RecordedFrame, Fault> {
    let mut frame = RecordedFrame { positions: Vec::new(), rotations: Vec::new() };
    for (bone, values) in skeleton.bones.iter().zip(values) {
        let values = match values {
            Some(values) => values.as_slice(),
            None if bone.freedoms.is_empty() => &[],
            None => return Err((line, format!("the frame has no values for '{}'; the file is cut short", bone.name))),
        };
        let (mut moved, mut angles, mut order) = (Vector3::zeros(), Vector3::zeros(), Vec::new());
        for (freedom, &value) in bone.freedoms.iter().zip(values) {
            match freedom {
                Freedom::Translation(axis) => moved[*axis] = value,
                Freedom::Rotation(axis) => {
                    angles[*axis] = if degrees { value.to_radians() } else { value };
                    order.push(*axis);
                }
                Freedom::Length => {}
            }
        }
        let Some(p) = bone.parent else {
            frame.positions.push(moved);
            frame.rotations.push(in_order(&skeleton.root_order, &angles));
            continue;
        };
        let rotation = bone.axis * in_order(&order, &angles) * bone.axis.inverse();
        frame.positions.push(frame.positions[p] + frame.rotations[p] * skeleton.bones[p].vector);
        frame.rotations.push(frame.rotations[p] * rotation);
    }
    Ok(frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Joint;
    use crate::io::read_clip;
    use crate::math::rotation::{exp, log};

    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/mocap").join(name)
    }

    #[test]
    fn bent_joints_of_the_fixture_arrive_bent() {
        let clip = read_clip(&fixture("tiny_01.amc")).unwrap().clip;
        assert_eq!((clip.fps, clip.poses.len()), (120.0, 3));
        assert!((clip.leg_m() - (7.5 + 7.2) * 0.0254 / 0.45).abs() < 1e-9);
        let is = |frame: usize, joint: Joint, expected: [f64; 3]| {
            let degrees = log(clip.poses[frame].joint(joint)) * 180.0 / std::f64::consts::PI;
            assert!((degrees - Vector3::from(expected)).norm() < 1e-3, "frame {frame} {}: {degrees:?}", joint.name());
        };
        use Joint::*;
        is(0, LHip, [0.0, 0.0, 20.0]);
        is(0, RHip, [0.0, 0.0, -20.0]);
        is(0, LShoulder, [0.0, 0.0, 90.0]);
        is(0, LKnee, [0.0, 0.0, 0.0]);
        for frame in [0, 1, 2] {
            // Feet lean with the straddled leg: neutral against the shank.
            is(frame, LAnkle, [0.0, 0.0, 0.0]);
        }
        is(1, LHip, [0.0, 0.0, 0.0]);
        is(1, RHip, [0.0, 0.0, 0.0]);
        is(2, LHip, [-30.0, 0.0, 0.0]);
        is(2, LKnee, [60.0, 0.0, 0.0]);
        let turned = clip.poses[1].world_from_root.angle_to(&exp(&Vector3::new(0.0, std::f64::consts::FRAC_PI_2, 0.0)));
        assert!(turned < 1e-9);
    }

    /// Closed form: a bone with axis rotation Rz(20) turned by 60 degrees about its x moves its end in the plane it defines.
    #[test]
    fn a_bent_knee_carries_the_ankle_as_by_hand() {
        let recording = read(&fixture("tiny_01.amc")).unwrap();
        let at = |name: &str| recording.joints.iter().position(|j| j.name == name).unwrap();
        let frame = &recording.frames[2];
        let hip = frame.positions[at("lfemur")];
        let [thigh, shank] = [30f64.to_radians(), 30f64.to_radians()];
        let expected = Vector3::new(0.0, -7.5 * thigh.cos() - 7.2 * shank.cos(), 7.5 * thigh.sin() - 7.2 * shank.sin());
        assert!((frame.positions[at("lfoot")] - hip - expected).norm() < 1e-5);
    }

    #[test]
    fn faults_are_named_with_their_line() {
        let asf = std::fs::read_to_string(fixture("tiny.asf")).unwrap();
        let amc = std::fs::read_to_string(fixture("tiny_01.amc")).unwrap();
        let skeleton = parse_asf(&asf).unwrap();
        assert_eq!(parse_amc(&amc, &skeleton).unwrap().len(), 3);
        let line_of = |text: &str, needle: &str| text.lines().position(|l| l.contains(needle)).unwrap() + 1;
        for (bad, line, phrase) in [
            (asf.replace("length 0.45", "length -1"), line_of(&asf, "length 0.45"), "'-1' must be positive"),
            (asf.replace("length 7.2", "length long"), line_of(&asf, "length 7.2"), "'long' is not a number"),
            (asf.replace("axis 0 0 20 XYZ", "axis 0 0 20 XYW"), line_of(&asf, "axis 0 0 20 XYZ"), "no order of axes"),
            (asf.replace("dof ry", "dof by"), line_of(&asf, "dof ry"), "no degree of freedom"),
            (asf.replace("ltibia lfoot", "ltibia lhoof"), line_of(&asf, "ltibia lfoot"), "'lhoof' is not in :bonedata"),
            (asf.replace("    lfemur ltibia\n", ""), line_of(&asf, "ltibia lfoot") - 1, "'ltibia' is not yet"),
            (asf.replace("orientation 0 0 0", "orientation 0 9 0"), line_of(&asf, "orientation"), "not supported"),
            (asf.split(":hierarchy").next().unwrap().to_string(), line_of(&asf, ":hierarchy") - 1, ":hierarchy part is missing"),
        ] {
            let (at, what) = parse_asf(&bad).map(|_| ()).unwrap_err();
            assert!(at == line && what.contains(phrase), "{at} instead of {line}: {what}");
        }
        for (bad, line, phrase) in [
            (amc.replace("ltibia 60", "ltibia sixty"), line_of(&amc, "ltibia 60"), "'sixty' is not a number"),
            (amc.replace("ltibia 60", "ltibia inf"), line_of(&amc, "ltibia 60"), "not a finite number"),
            (amc.replace("ltibia 60", "ltibia 60 1"), line_of(&amc, "ltibia 60"), "2 values here where the skeleton has 1"),
            (amc.replace("ltibia 60\n", ""), line_of(&amc, "ltibia 60") - 3, "no values for 'ltibia'"),
            (amc.replacen("1\nroot", "root", 1), 4, "frame number belongs before"),
        ] {
            let (at, what) = parse_amc(&bad, &skeleton).map(|_| ()).unwrap_err();
            assert!(at == line && what.contains(phrase), "{at} instead of {line}: {what}");
        }
        let error = read_clip(&fixture("tiny_02.amc")).map(|_| ()).unwrap_err().to_string();
        assert!(error.ends_with("tiny_02.amc:10: bone 'rshin' is not in the skeleton"), "{error}");
    }

    #[test]
    fn a_missing_skeleton_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let amc = folder.path().join("07_02.amc");
        std::fs::copy(fixture("tiny_01.amc"), &amc).unwrap();
        assert!(read(&amc).map(|_| ()).unwrap_err().to_string().contains("put 07.asf there"));
        std::fs::copy(fixture("tiny.asf"), folder.path().join("whoever.asf")).unwrap();
        assert!(read(&amc).is_ok());
        std::fs::copy(fixture("tiny.asf"), folder.path().join("another.asf")).unwrap();
        assert!(matches!(read(&amc), Err(AsfAmcError::NoSkeleton { .. })));
    }
}

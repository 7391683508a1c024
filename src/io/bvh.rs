//! BioVision hierarchy (BVH), read and written.
//!
//! Rotation of a joint = product of its channels' rotations, left to right as listed; position channels replace the
//! offset. BVH names no unit: see [`mapping`](super::mapping). Read: any channel order, also per joint, CRLF, tabs, leaves
//! without end site. Written: y up, metres, degrees in ZXY or another order, H-Anim names, zero rotations = our rest pose, and a side-car JSON.
//! Checked against an independent reader's forward kinematics on 92 files of many tools.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use nalgebra::{Rotation3, UnitQuaternion, Vector3};

use super::mapping::{RecordedFrame, RecordedJoint, Recording, tidy_fps};
use super::sidecar::Sidecar;
use super::write_atomic;
use crate::body::{Clip, Joint, Pose};
use crate::math::euler::{self, Order};

#[derive(Debug, thiserror::Error)]
pub enum BvhError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path}:{line}: {what}")]
    Syntax { path: PathBuf, line: usize, what: String },
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
}

/// Reads a BVH file; unit unknown.
pub fn read(path: &Path) -> Result<Recording, BvhError> {
    let bytes = std::fs::read(path).map_err(|cause| BvhError::Read { path: path.into(), cause })?;
    let text = String::from_utf8_lossy(&bytes);
    parse(&text).map_err(|(line, what)| BvhError::Syntax { path: path.into(), line, what })
}

/// Joints that may come with each channel: every frame places all joints, but its line holds the channels only.
const MOST_STILL: usize = 16;

/// Line (from 1) and what is wrong there.
type Fault = (usize, String);

#[derive(Clone, Copy)]
enum Channel {
    Position(usize),
    Rotation(usize),
}

struct Hierarchy {
    joints: Vec<RecordedJoint>,
    channels: Vec<Vec<Channel>>,
}

fn parse(text: &str) -> Result<Recording, Fault> {
    // Files of old Macs end their lines with a lone carriage return.
    let unix = if text.contains('\n') { text.to_string() } else { text.replace('\r', "\n") };
    let lines: Vec<&str> = unix.lines().collect();
    let motion = lines.iter().position(|l| l.trim().eq_ignore_ascii_case("motion"));
    let end = motion.ok_or((lines.len(), "the MOTION part is missing; the file is cut short".to_string()))?;
    let hierarchy = parse_hierarchy(&lines[..end])?;
    let channels = hierarchy.channels.iter().map(Vec::len).sum::<usize>();
    if hierarchy.joints.len() > MOST_STILL * (channels + 1) {
        let what = format!("{} joints with only {channels} channels in all are no recording of a motion", hierarchy.joints.len());
        return Err((1, what));
    }
    let mut rest = lines.iter().enumerate().skip(end + 1).map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.is_empty());
    let (declared, declared_line) = header(rest.next(), "Frames", lines.len())?;
    let (frame_time, line) = header(rest.next(), "Frame Time", lines.len())?;
    if frame_time <= 0.0 {
        return Err((line, format!("frame time {frame_time} is not positive; write seconds per frame")));
    }
    let frames = rest.map(|(line, text)| parse_frame(&hierarchy, line, text)).collect::<Result<Vec<_>, _>>()?;
    if declared != frames.len() as f64 {
        let what = format!("{declared} frames are declared but {} follow; correct the number or copy the file again", frames.len());
        return Err((declared_line, what));
    }
    Ok(Recording { fps: tidy_fps(1.0 / frame_time), metres_per_unit: None, joints: hierarchy.joints, frames })
}

/// The number of a `key: number` line and the line it stands on.
fn header(line: Option<(usize, &str)>, key: &str, last: usize) -> Result<(f64, usize), Fault> {
    let (at, text) = line.ok_or((last, format!("'{key}:' is missing; the file is cut short")))?;
    match text.split_once(':') {
        Some((name, value)) if name.trim().eq_ignore_ascii_case(key) => Ok((number(value.trim(), at)?, at)),
        _ => Err((at, format!("found '{}' where '{key}:' belongs", excerpt(text)))),
    }
}

fn number(text: &str, line: usize) -> Result<f64, Fault> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) => Err((line, format!("'{text}' is not a finite number; cut the recording there or fill the gap"))),
        Err(_) => Err((line, format!("'{}' is not a number", excerpt(text)))),
    }
}

fn excerpt(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Words of the hierarchy with their lines; braces are words of their own.
struct Words<'a> {
    words: std::iter::Peekable<std::vec::IntoIter<(usize, &'a str)>>,
    last_line: usize,
}

impl<'a> Words<'a> {
    fn next(&mut self) -> Result<(usize, &'a str), Fault> {
        self.words.next().ok_or((self.last_line, "the hierarchy ends within a joint; a closing brace is missing".into()))
    }

    fn expect(&mut self, wanted: &str) -> Result<(), Fault> {
        let (line, word) = self.next()?;
        if word.eq_ignore_ascii_case(wanted) { Ok(()) } else { Err((line, format!("found '{}' where '{wanted}' belongs", excerpt(word)))) }
    }

    fn vector(&mut self) -> Result<Vector3<f64>, Fault> {
        let mut v = Vector3::zeros();
        for i in 0..3 {
            let (line, word) = self.next()?;
            v[i] = number(word, line)?;
        }
        Ok(v)
    }

    /// A joint's name (it may hold spaces) and the brace after it.
    fn name(&mut self) -> Result<String, Fault> {
        let mut name: Vec<&str> = Vec::new();
        loop {
            let (line, word) = self.next()?;
            match word {
                "{" if name.is_empty() => return Err((line, "a joint has no name".into())),
                "{" => return Ok(name.join(" ")),
                _ => name.push(word),
            }
        }
    }
}

fn parse_hierarchy(lines: &[&str]) -> Result<Hierarchy, Fault> {
    let spaced: Vec<String> = lines.iter().map(|l| l.replace('{', " { ").replace('}', " } ")).collect();
    let all: Vec<(usize, &str)> = spaced.iter().enumerate().flat_map(|(i, l)| l.split_whitespace().map(move |w| (i + 1, w))).collect();
    let mut words = Words { words: all.into_iter().peekable(), last_line: lines.len() };
    words.expect("HIERARCHY")?;
    words.expect("ROOT")?;
    let mut hierarchy = Hierarchy { joints: Vec::new(), channels: Vec::new() };
    let name = words.name()?;
    hierarchy.push(name, None);
    let mut open = vec![0];
    while let Some(&joint) = open.last() {
        let (line, word) = words.next()?;
        match word.to_ascii_uppercase().as_str() {
            "OFFSET" => hierarchy.joints[joint].offset = words.vector()?,
            "CHANNELS" => hierarchy.channels[joint] = parse_channels(&mut words)?,
            "JOINT" => {
                let name = words.name()?;
                open.push(hierarchy.push(name, Some(joint)));
            }
            "END" => {
                words.name()?;
                words.expect("OFFSET")?;
                hierarchy.joints[joint].end = Some(words.vector()?);
                words.expect("}")?;
            }
            "}" => {
                open.pop();
            }
            _ => return Err((line, format!("found '{}' where OFFSET, CHANNELS, JOINT, End Site or a brace belongs", excerpt(word)))),
        }
    }
    match words.words.next() {
        Some((line, word)) => Err((line, format!("found '{}' after the skeleton; only one ROOT can be read", excerpt(word)))),
        None => Ok(hierarchy),
    }
}

impl Hierarchy {
    fn push(&mut self, name: String, parent: Option<usize>) -> usize {
        self.joints.push(RecordedJoint { name, parent, offset: Vector3::zeros(), end: None });
        self.channels.push(Vec::new());
        self.joints.len() - 1
    }
}

fn parse_channels(words: &mut Words) -> Result<Vec<Channel>, Fault> {
    let (line, count) = words.next()?;
    let count: usize = count.parse().map_err(|_| (line, format!("'{}' is no number of channels", excerpt(count))))?;
    (0..count)
        .map(|_| {
            let (line, word) = words.next()?;
            Ok(match word.to_ascii_lowercase().as_str() {
                "xposition" => Channel::Position(0),
                "yposition" => Channel::Position(1),
                "zposition" => Channel::Position(2),
                "xrotation" => Channel::Rotation(0),
                "yrotation" => Channel::Rotation(1),
                "zrotation" => Channel::Rotation(2),
                _ => return Err((line, format!("'{}' is no channel; {count} are declared", excerpt(word)))),
            })
        })
        .collect()
}

fn parse_frame(hierarchy: &Hierarchy, line: usize, text: &str) -> Result<RecordedFrame, Fault> {
    let values = text.split_whitespace().map(|word| number(word, line)).collect::<Result<Vec<f64>, _>>()?;
    let wanted: usize = hierarchy.channels.iter().map(Vec::len).sum();
    if values.len() != wanted {
        return Err((line, format!("{} values where the hierarchy has {wanted} channels; the line is cut or wrapped", values.len())));
    }
    let mut values = values.into_iter();
    let mut frame = RecordedFrame { positions: Vec::new(), rotations: Vec::new() };
    for (joint, channels) in hierarchy.joints.iter().zip(&hierarchy.channels) {
        let mut position = joint.offset;
        let mut rotation = UnitQuaternion::identity();
        for (channel, value) in channels.iter().zip(values.by_ref()) {
            match channel {
                Channel::Position(axis) => position[*axis] = value,
                Channel::Rotation(axis) => {
                    let axis = Vector3::ith_axis(*axis);
                    rotation *= UnitQuaternion::from_axis_angle(&axis, value.to_radians());
                }
            }
        }
        if let Some(p) = joint.parent {
            position = frame.positions[p] + frame.rotations[p] * position;
            rotation = frame.rotations[p] * rotation;
        }
        frame.positions.push(position);
        frame.rotations.push(rotation);
    }
    Ok(frame)
}

/// Writes a clip and its side-car `path` with `.json`; `clip_from_rig` is the rotation from the rig's world, if any.
pub fn write_clip(path: &Path, clip: &Clip, clip_from_rig: Option<&Rotation3<f64>>) -> Result<(), BvhError> {
    write_clip_in(path, clip, clip_from_rig, Order::ZXY)
}

/// The same with the rotation channels in another order.
pub fn write_clip_in(path: &Path, clip: &Clip, clip_from_rig: Option<&Rotation3<f64>>, order: Order) -> Result<(), BvhError> {
    let write = |path: &Path, bytes: &[u8]| write_atomic(path, bytes).map_err(|cause| BvhError::Write { path: path.into(), cause });
    write(path, text_of(clip, order).as_bytes())?;
    write(&path.with_extension("json"), Sidecar::of_bvh(clip, clip_from_rig, order).to_json().as_bytes())
}

fn text_of(clip: &Clip, order: Order) -> String {
    let mut text = String::from("HIERARCHY\n");
    write_joint(&mut text, clip, order, Joint::Root, 0);
    // Writing to a String cannot fail.
    let _ = write!(text, "MOTION\nFrames: {}\nFrame Time: {:.8}\n", clip.poses.len(), 1.0 / clip.fps);
    let mut previous = vec![[0.0; 3]; Joint::ALL.len()];
    for pose in &clip.poses {
        write_frame(&mut text, pose, order, &mut previous);
    }
    text
}

/// Joints depth first, as the format wants them.
fn write_joint(text: &mut String, clip: &Clip, order: Order, joint: Joint, depth: usize) {
    let rotations = order.axes().map(|axis| ["Xrotation", "Yrotation", "Zrotation"][axis]).join(" ");
    let indent = "  ".repeat(depth);
    let vector = |v: Vector3<f64>| format!("{:.6} {:.6} {:.6}", v.x, v.y, v.z);
    let (kind, offset, channels) = match joint {
        Joint::Root => ("ROOT", Vector3::zeros(), "6 Xposition Yposition Zposition"),
        _ => ("JOINT", clip.offsets[joint as usize], "3"),
    };
    let _ = writeln!(text, "{indent}{kind} {}\n{indent}{{", joint.name());
    let _ = writeln!(text, "{indent}  OFFSET {}\n{indent}  CHANNELS {channels} {rotations}", vector(offset));
    for child in children(joint) {
        write_joint(text, clip, order, child, depth + 1);
    }
    if let Some(end) = clip.end_site(joint) {
        let _ = writeln!(text, "{indent}  End Site\n{indent}  {{\n{indent}    OFFSET {}\n{indent}  }}", vector(end));
    }
    let _ = writeln!(text, "{indent}}}");
}

fn children(joint: Joint) -> impl Iterator<Item = Joint> {
    Joint::ALL.into_iter().filter(move |j| j.parent() == Some(joint))
}

/// Nodes in the order in which [`write_joint`] names them.
fn depth_first(joint: Joint, order: &mut Vec<Joint>) {
    order.push(joint);
    for child in children(joint) {
        depth_first(child, order);
    }
}

fn write_frame(text: &mut String, pose: &Pose, order: Order, previous: &mut [[f64; 3]]) {
    let _ = write!(text, "{:.6} {:.6} {:.6}", pose.root.x, pose.root.y, pose.root.z);
    let mut joints = Vec::new();
    depth_first(Joint::Root, &mut joints);
    for joint in joints {
        let rotation = if joint == Joint::Root { &pose.world_from_root } else { pose.joint(joint) };
        let angles = euler::near(rotation, order, &previous[joint as usize]);
        previous[joint as usize] = angles;
        let [a, b, c] = angles.map(f64::to_degrees);
        let _ = write!(text, " {a:.6} {b:.6} {c:.6}");
    }
    text.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::io::read_clip;
    use crate::math::rotation::exp;
    use nalgebra::Matrix4;

    fn fixture(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/mocap").join(name)
    }

    /// Another way to read: one stream of words, homogeneous matrices by the textbook. Positions of the joints per frame.
    fn plain_reader(text: &str) -> Vec<Vec<Vector3<f64>>> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let num = |i: usize| words[i].parse::<f64>().unwrap();
        let motion = words.iter().position(|w| *w == "MOTION").unwrap();
        let (mut parents, mut offsets, mut channels) = (Vec::new(), Vec::new(), Vec::new());
        let mut open: Vec<Option<usize>> = Vec::new();
        for i in 0..motion {
            match words[i] {
                "ROOT" | "JOINT" => {
                    parents.push(open.last().copied().flatten());
                    offsets.push(Vector3::zeros());
                    channels.push(Vec::new());
                    open.push(Some(parents.len() - 1));
                }
                "End" => open.push(None),
                "OFFSET" => {
                    if let Some(j) = open.last().copied().flatten() {
                        offsets[j] = Vector3::new(num(i + 1), num(i + 2), num(i + 3));
                    }
                }
                "CHANNELS" => channels[parents.len() - 1] = words[i + 2..i + 2 + num(i + 1) as usize].to_vec(),
                "}" => {
                    open.pop();
                }
                _ => {}
            }
        }
        let count = num(motion + 2) as usize;
        let mut at = motion + 6;
        (0..count)
            .map(|_| {
                let mut world: Vec<Matrix4<f64>> = Vec::new();
                for j in 0..parents.len() {
                    let (mut shift, mut turn) = (offsets[j], Matrix4::identity());
                    for channel in &channels[j] {
                        let (v, a) = (num(at), num(at).to_radians());
                        at += 1;
                        let (s, c) = a.sin_cos();
                        match *channel {
                            "Xposition" => shift.x = v,
                            "Yposition" => shift.y = v,
                            "Zposition" => shift.z = v,
                            "Xrotation" => turn *= Matrix4::new(1., 0., 0., 0., 0., c, -s, 0., 0., s, c, 0., 0., 0., 0., 1.),
                            "Yrotation" => turn *= Matrix4::new(c, 0., s, 0., 0., 1., 0., 0., -s, 0., c, 0., 0., 0., 0., 1.),
                            _ => turn *= Matrix4::new(c, -s, 0., 0., s, c, 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.),
                        }
                    }
                    let local = Matrix4::new_translation(&shift) * turn;
                    world.push(parents[j].map_or(local, |p: usize| world[p] * local));
                }
                world.iter().map(|m| Vector3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)])).collect()
            })
            .collect()
    }

    fn assert_same_positions(path: &Path) {
        let recording = read(path).unwrap();
        let expected = plain_reader(&std::fs::read_to_string(path).unwrap());
        assert_eq!(recording.frames.len(), expected.len());
        for (frame, expected) in recording.frames.iter().zip(&expected) {
            for (ours, theirs) in frame.positions.iter().zip(expected) {
                assert!((ours - theirs).norm() < 1e-8 * (1.0 + theirs.norm()), "{}", path.display());
            }
        }
    }

    #[test]
    fn forward_kinematics_equals_a_plain_matrix_reader() {
        assert_same_positions(&fixture("tiny.bvh"));
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap");
        if !data.is_dir() {
            println!("skipped: no ../shared/data/mocap");
            return;
        }
        for name in [
            "cmu-bvh/09/09_01.bvh",
            "bandai-namco-1/data/dataset-1_walk_normal_002.bvh",
            "stylised-cmu-m21/content/walk.bvh",
            "parser-torture/bvh/pybvh/bvh_data/bvh_example.bvh",
            "parser-torture/bvh/pybvh/bvh_data/bvh_test2.bvh",
            "parser-torture/bvh/pybvh/tests/fixtures/rotation_first_root.bvh",
            "parser-torture/bvh/bvh-toolbox/source/walk01.bvh",
            "parser-torture/bvh/ganimator/Elephant/idle1.bvh",
        ] {
            assert_same_positions(&data.join(name));
        }
    }

    /// A person of odd proportions who turns twice about the vertical, bends sideways beyond 90 degrees and waves every joint.
    fn dancing() -> Clip {
        let mut shape = Shape::template(1.65);
        for (i, length) in shape.lengths.iter_mut().enumerate() {
            *length = 0.9 + 0.03 * i as f64;
        }
        let offsets = shape.offsets();
        let pose = |frame: usize| {
            let t = frame as f64 / 60.0;
            let mut pose = Pose::rest(offsets[0] + Vector3::new(t, 0.1 * (9.0 * t).sin(), -2.0 * t));
            pose.world_from_root = exp(&Vector3::new(0.0, 12.0 * t, 0.0)) * exp(&Vector3::new(1.9 * t, 0.0, 0.4));
            for (k, rotation) in pose.joints.iter_mut().enumerate() {
                let phase = 5.0 * t + k as f64;
                *rotation = exp(&Vector3::new(phase.sin(), 0.8 * (1.3 * phase).cos(), -0.5 * (0.7 * phase).sin()));
            }
            pose
        };
        Clip { fps: 60.0, poses: (0..61).map(pose).collect(), offsets, hip_height_m: shape.hip_height_m() }
    }

    #[test]
    fn a_written_clip_reads_back_here_and_elsewhere() {
        ["zxy", "xyz", "yxz"].into_iter().for_each(reads_back);
    }

    fn reads_back(order: &str) {
        let (clip, folder) = (dancing(), tempfile::tempdir().unwrap());
        let path = folder.path().join("new/dance.bvh");
        let order: Order = order.parse().unwrap();
        write_clip_in(&path, &clip, Some(&Rotation3::from_euler_angles(-1.5, 0.2, 0.0)), order).unwrap();
        let back = read_clip(&path).unwrap().clip;
        assert_eq!((back.fps, back.poses.len()), (clip.fps, clip.poses.len()));
        assert!((back.hip_height_m - clip.hip_height_m).abs() < 1e-12);
        let elsewhere = plain_reader(&std::fs::read_to_string(&path).unwrap());
        let mut joints = Vec::new();
        depth_first(Joint::Root, &mut joints);
        for ((pose, back_pose), read) in clip.poses.iter().zip(&back.poses).zip(&elsewhere) {
            let (placed, back_placed) = (clip.place(pose), back.place(back_pose));
            for (joint, elsewhere) in joints.iter().zip(read) {
                assert!((placed.position(*joint) - back_placed.position(*joint)).norm() < 1e-5, "{}", joint.name());
                assert!((placed.position(*joint) - elsewhere).norm() < 1e-5, "{}", joint.name());
            }
        }
        let sidecar = Sidecar::beside(&path).unwrap();
        assert_eq!((sidecar.length_unit.as_str(), sidecar.fps), ("m", 60.0));
        assert!(sidecar.rotation_order.starts_with(&order.name()));
        let rows = sidecar.file_from_rig_world.unwrap();
        assert!((rows[1][2] - Rotation3::from_euler_angles(-1.5, 0.2, 0.0)[(1, 2)]).abs() < 1e-12);
    }

    #[test]
    fn written_angles_do_not_jump_by_whole_turns() {
        let mut clip = dancing();
        for (i, pose) in clip.poses.iter_mut().enumerate() {
            pose.world_from_root = exp(&Vector3::new(0.0, 12.0 * i as f64 / 60.0, 0.0));
        }
        let text = text_of(&clip, Order::ZXY);
        let y = |line: &str| line.split(' ').nth(5).and_then(|w| w.parse::<f64>().ok());
        let turns: Vec<f64> = text.lines().skip_while(|l| !l.starts_with("Frame Time")).skip(1).filter_map(y).collect();
        assert_eq!(turns.len(), 61);
        assert!(turns.windows(2).all(|w| (w[1] - w[0] - 12f64.to_degrees() / 60.0).abs() < 1e-5), "{turns:?}");
    }

    #[test]
    fn faults_are_named_with_their_line() {
        let good = std::fs::read_to_string(fixture("tiny.bvh")).unwrap();
        assert!(parse(&good).is_ok());
        assert!(parse(&good.replace('\n', "\r\n")).is_ok());
        assert!(parse(&good.replace('\n', "\r")).is_ok());
        let line_of = |needle: &str| good.lines().position(|l| l.contains(needle)).unwrap() + 1;
        let last = good.lines().count();
        for (bad, line, phrase) in [
            (good.replace("OFFSET 9 -5 0", "OFFSET 9 x 0"), line_of("OFFSET 9 -5 0"), "'x' is not a number"),
            (good.replace("JOINT LeftLeg", "JOIN LeftLeg"), line_of("JOINT LeftLeg"), "found 'JOIN'"),
            (good.replace("3 Xrotation Yrotation", "3 Xrotation Yrot"), line_of("3 Xrotation Yrotation"), "'Yrot' is no channel"),
            (good.replace("Frames: 3", "Frames: 4"), line_of("Frames: 3"), "4 frames are declared but 3"),
            (good.replace("Frame Time: 0.0333333", "Frame Time: 0"), line_of("Frame Time"), "not positive"),
            (good.replace(" 12 0 0 90", " nan 0 0 90"), last, "'nan' is not a finite number"),
            (good.replace(" 12 0 0 90", " 12 0 90"), last, "65 values where the hierarchy has 66"),
            (good.replace("MOTION", "MOTIONS"), last, "MOTION part is missing"),
            (good.replace("HIERARCHY", "ROOT"), 1, "found 'ROOT' where 'HIERARCHY'"),
            (good.replacen("\t}\n}", "\t}", 1), line_of("MOTION") - 2, "closing brace"),
        ] {
            let (at, what) = parse(&bad).map(|_| ()).unwrap_err();
            assert_eq!(at, line, "{what}");
            assert!(what.contains(phrase), "{what}");
        }
        let error = read(&fixture("cut.bvh")).map(|_| ()).unwrap_err().to_string();
        assert!(error.ends_with("cut.bvh:128: 17 values where the hierarchy has 66 channels; the line is cut or wrapped"), "{error}");
    }
}

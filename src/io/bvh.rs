//! BioVision hierarchy (BVH), read and written.
//!
//! Rotation of a joint = product of its channels' rotations, left to right as listed; position channels replace the
//! offset. BVH names no unit: see [`mapping`](super::mapping). Read: any channel order, also per joint, CRLF, tabs, leaves
//! without end site. Written: y up, metres, ZXY degrees, H-Anim names, zero rotations = our rest pose, and a side-car JSON.
//! Checked against an independent reader's forward kinematics on 92 files of many tools.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use nalgebra::{Rotation3, UnitQuaternion, Vector3};

use super::mapping::{RecordedFrame, RecordedJoint, Recording, tidy_fps};
use super::sidecar::Sidecar;
use super::write_atomic;
use crate::body::{Clip, Joint, Pose};

#[derive(Debug, thiserror::Error)]
pub enum BvhError {
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{path}:{line}: {what}")]
    Syntax { path: PathBuf, line: usize, what: String },
    #[error("cannot write {path}: {source}")]
    Write { path: PathBuf, source: std::io::Error },
}

/// Reads a BVH file; unit unknown.
pub fn read(path: &Path) -> Result<Recording, BvhError> {
    let bytes = std::fs::read(path).map_err(|source| BvhError::Read { path: path.into(), source })?;
    let text = String::from_utf8_lossy(&bytes);
    parse(&text).map_err(|(line, what)| BvhError::Syntax { path: path.into(), line, what })
}

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
    let mut rest = lines.iter().enumerate().skip(end + 1).map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.is_empty());
    let (declared, declared_line) = header(rest.next(), "Frames", lines.len())?;
    let (frame_time, line) = header(rest.next(), "Frame Time", lines.len())?;
    if !(frame_time > 0.0) {
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
    let write = |path: &Path, bytes: &[u8]| write_atomic(path, bytes).map_err(|source| BvhError::Write { path: path.into(), source });
    write(path, text_of(clip).as_bytes())?;
    write(&path.with_extension("json"), Sidecar::of_bvh(clip, clip_from_rig).to_json().as_bytes())
}

fn text_of(clip: &Clip) -> String {
    let mut text = String::from("HIERARCHY\n");
    write_joint(&mut text, clip, Joint::Root, 0);
    // Writing to a String cannot fail.
    let _ = write!(text, "MOTION\nFrames: {}\nFrame Time: {:.8}\n", clip.poses.len(), 1.0 / clip.fps);
    let mut previous = vec![[0.0; 3]; Joint::ALL.len()];
    for pose in &clip.poses {
        write_frame(&mut text, pose, &mut previous);
    }
    text
}

/// Joints depth first, as the format wants them.
fn write_joint(text: &mut String, clip: &Clip, joint: Joint, depth: usize) {
    let indent = "  ".repeat(depth);
    let vector = |v: Vector3<f64>| format!("{:.6} {:.6} {:.6}", v.x, v.y, v.z);
    let (kind, offset, channels) = match joint {
        Joint::Root => ("ROOT", Vector3::zeros(), "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"),
        _ => ("JOINT", clip.offsets[joint as usize], "3 Zrotation Xrotation Yrotation"),
    };
    let _ = writeln!(text, "{indent}{kind} {}\n{indent}{{", joint.name());
    let _ = writeln!(text, "{indent}  OFFSET {}\n{indent}  CHANNELS {channels}", vector(offset));
    for child in children(joint) {
        write_joint(text, clip, child, depth + 1);
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

fn write_frame(text: &mut String, pose: &Pose, previous: &mut [[f64; 3]]) {
    let _ = write!(text, "{:.6} {:.6} {:.6}", pose.root.x, pose.root.y, pose.root.z);
    let mut order = Vec::new();
    depth_first(Joint::Root, &mut order);
    for joint in order {
        let rotation = if joint == Joint::Root { &pose.world_from_root } else { pose.joint(joint) };
        let angles = zxy_near(rotation, &previous[joint as usize]);
        previous[joint as usize] = angles;
        let [z, x, y] = angles.map(f64::to_degrees);
        let _ = write!(text, " {z:.6} {x:.6} {y:.6}");
    }
    text.push('\n');
}

/// Angles z, x, y of R = Rz Rx Ry, of the two solutions and their turns the one nearest to the frame before, so that curves
/// stay smooth in an editor.
fn zxy_near(rotation: &UnitQuaternion<f64>, previous: &[f64; 3]) -> [f64; 3] {
    use std::f64::consts::{PI, TAU};
    let r = rotation.to_rotation_matrix();
    let sin_x = r[(2, 1)].clamp(-1.0, 1.0);
    let main = if sin_x.abs() < 1.0 - 1e-12 {
        [(-r[(0, 1)]).atan2(r[(1, 1)]), sin_x.asin(), (-r[(2, 0)]).atan2(r[(2, 2)])]
    } else {
        // Gimbal lock: only z ± y is determined.
        [r[(1, 0)].atan2(r[(0, 0)]) - sin_x.signum() * previous[2], sin_x.asin(), previous[2]]
    };
    let other = [main[0] + PI, PI - main[1], main[2] + PI];
    let near = |angles: [f64; 3]| {
        let mut turned = angles;
        for (angle, before) in turned.iter_mut().zip(previous) {
            *angle -= TAU * ((*angle - before) / TAU).round();
        }
        turned
    };
    let distance = |a: &[f64; 3]| a.iter().zip(previous).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let (main, other) = (near(main), near(other));
    if distance(&main) <= distance(&other) { main } else { other }
}

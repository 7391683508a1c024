//! Recorded skeletons of any make, mapped onto the 78 DOF by joint names and rest pose.
//!
//! A source bone turned by G(t) since its zero pose turns ours by
//!   world_from_ours(t) = W G(t) B A,                                                                 (1)
//! W: the smallest rotation of the source's up axis onto y; B: source_from_body at rest (x left, y up, z forward,
//! snapped to the axes); A: the smallest rotation of our hanging limb onto the source's limb at rest, both in body axes,
//! so that thighs, shanks, arms and hands point exactly where the source's do. Feet keep their pitch: both skeletons rest on
//! flat soles however high their ankles sit; they lean with a straddled leg (CMU's rest pose) and turn to the source's toes. Pelvis, trunk, neck, head and clavicles: A = 1.
//!
//! Only limbs and head are found by name; pelvis, trunk, neck and clavicles follow from the hierarchy between them.
//! Skeletons whose zero pose is no standing person (bones along one axis) use their most upright frame instead; then
//! twists about the limbs carry that frame's few degrees.
//! Lengths: [`Shape::template`] with the source's own thigh, shank, upper arm and forearm; hips coincide with the
//! source's; the floor is put at y = 0 by the soles.
//! Checked against the sources' own forward kinematics, recordings present in two formats, and rendered footage's truth.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::body::{Clip, Joint, Length, NODES, Pose, Shape, place};
use crate::math::order::quantile;
use crate::math::rotation::between;

/// Faster hips are a broken recording, m/s: sprinters reach 12.
const BROKEN_SPEED: f64 = 15.0;
/// Faster hips deserve a look, m/s.
const DOUBTFUL_SPEED: f64 = 8.0;
/// Share of frames whose lowest sole lies below the floor put under a clip: of a sprint, feet are on the ground in 40 %.
const FLOOR_QUANTILE: f64 = 0.2;
/// Template leg (hip to ankle) and ankle height as fractions of stature.
const LEG: f64 = 0.491;

/// A joint of a recorded skeleton.
#[derive(Clone, Debug)]
pub struct RecordedJoint {
    pub name: String,
    /// Index of the parent, smaller than the joint's own.
    pub parent: Option<usize>,
    /// From the parent at the zero pose, source units.
    pub offset: Vector3<f64>,
    /// Where the bone ends if no joint follows, relative to this joint at the zero pose.
    pub end: Option<Vector3<f64>>,
}

/// World placement of every joint at one instant: positions in source units, rotations since the zero pose.
#[derive(Clone, Debug)]
pub struct RecordedFrame {
    pub positions: Vec<Vector3<f64>>,
    pub rotations: Vec<UnitQuaternion<f64>>,
}

/// What a motion file holds, before it is ours.
#[derive(Clone, Debug)]
pub struct Recording {
    pub fps: f64,
    /// `None` where the format does not say: then the leg length decides (see [`metres_per_unit`]).
    pub metres_per_unit: Option<f64>,
    pub joints: Vec<RecordedJoint>,
    pub frames: Vec<RecordedFrame>,
}

#[derive(Debug, thiserror::Error)]
pub enum MappingError {
    #[error("no joint found for {missing} among {names}; rename the joints after MotionBuilder, Mixamo, Daz, CMU or H-Anim")]
    Missing { missing: String, names: String },
    #[error("the recording has no frame")]
    Empty,
    #[error("the leg measures {leg:.3} units, which is no human size in m, cm, mm, inches or CMU units; give the scale in metres per unit")]
    Unit { leg: f64 },
    #[error("the leg measures {leg_m:.3} m, which is no human size; correct the file's unit of length")]
    Size { leg_m: f64 },
    #[error("the hips jump by {distance_m:.2} m from frame {frame} to the next (frames count from 0); cut the recording there")]
    RootJump { frame: usize, distance_m: f64 },
    #[error("left and right hip joints, or hips and shoulders, lie in one point at rest; the skeleton cannot be oriented")]
    NoBodyFrame,
}

/// Maps a recording onto our skeleton; with the clip come notices for the user, one sentence each.
pub fn clip_from_recording(recording: &Recording) -> Result<(Clip, Vec<String>), MappingError> {
    if recording.frames.is_empty() {
        return Err(MappingError::Empty);
    }
    if let Some(nodes) = own_skeleton(recording) {
        return own_clip(recording, &nodes).map(|clip| (clip, Vec::new()));
    }
    let anatomy = Anatomy::find(&recording.joints)?;
    let scale = metres_per_unit(recording, &anatomy)?;
    let mut notices = Vec::new();
    let first = first_frame(recording, &anatomy);
    if first > 0 {
        let which = if first == 1 { "frame 0".to_string() } else { format!("frames 0 to {}", first - 1) };
        notices.push(format!("dropped {which}: a rest pose and the jump from it into the motion"));
    }
    check_root(recording, first, &anatomy, scale, &mut notices)?;
    let frames = &recording.frames[first..];
    let rest = Rest::find(recording, frames, &anatomy, &mut notices)?;
    let shape = measured_shape(&rest.positions, &anatomy, scale);
    let ours_from_source = between(&rest.world_up, &Vector3::y());
    let alignments = alignments(&recording.joints, &anatomy, &rest);
    let offsets = shape.offsets();
    let poses = frames.iter().map(|frame| map_frame(frame, &anatomy, &rest, &alignments, &ours_from_source, scale, &offsets)).collect();
    let mut clip = Clip { fps: recording.fps, poses, offsets, hip_height_m: shape.hip_height_m() };
    if let Some(rise) = level_floor(&mut clip) {
        let degrees = rise.atan().to_degrees();
        notices.push(format!("levelled the recording's floor, which rises by {degrees:.1} degrees along the path"));
    }
    put_on_floor(&mut clip);
    Ok((clip, notices))
}

/// Takes the slope of the floor along the path out of the root's height, and returns it. Calibrated volumes tilt by a degree
/// (CMU's subjects 02, 07 and 08), 7 cm along a walk. Only for walks of 2 m and more: soles within 25 mm of one line.
fn level_floor(clip: &mut Clip) -> Option<f64> {
    let path = clip.poses.last()?.root - clip.poses.first()?.root;
    let along = Vector3::new(path.x, 0.0, path.z);
    let n = clip.poses.len() as f64;
    let points: Vec<(f64, f64)> = clip.poses.iter().map(|p| (p.root.dot(&along) / along.norm(), clip.sole_height(p))).collect();
    let (mx, my) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p.0 / n, y + p.1 / n));
    let (sxx, sxy) = points.iter().fold((0.0, 0.0), |(xx, xy), p| (xx + (p.0 - mx).powi(2), xy + (p.0 - mx) * (p.1 - my)));
    let rise = sxy / sxx;
    let rms = (points.iter().map(|p| (p.1 - my - rise * (p.0 - mx)).powi(2)).sum::<f64>() / n).sqrt();
    let plausible = along.norm() > 2.0 && rms < 0.025 && (0.3..2.5).contains(&rise.atan().to_degrees().abs());
    for (pose, point) in clip.poses.iter_mut().zip(&points).filter(|_| plausible) {
        pose.root.y -= rise * (point.0 - mx);
    }
    plausible.then_some(rise)
}

/// Moves the clip so that the floor under its soles is y = 0.
pub(crate) fn put_on_floor(clip: &mut Clip) {
    let soles: Vec<f64> = clip.poses.iter().map(|pose| clip.sole_height(pose)).collect();
    let floor = quantile(soles, FLOOR_QUANTILE).unwrap_or(0.0);
    for pose in &mut clip.poses {
        pose.root.y -= floor;
    }
}

/// Frame rates written with few digits (0.00833333 s) meant whole numbers; 23.976 stays.
pub(crate) fn tidy_fps(fps: f64) -> f64 {
    if (fps - fps.round()).abs() < 2e-4 * fps { fps.round() } else { fps }
}

/// Which source joint plays which part; indices into [`Recording::joints`].
struct Anatomy {
    /// Source joint of every node of ours, `None` where the node just follows its parent.
    of: [Option<usize>; NODES],
}

/// Sided names of limbs after the side's mark, the commonest meaning first: `LeftShoulder` is a clavicle where there is
/// a `LeftArm`, and `lhip` a thigh only where there is no `lfemur`.
const THIGH: &[&str] = &["upleg", "upperleg", "thigh", "femur", "hip"];
const SHANK: &[&str] = &["leg", "lowerleg", "shin", "tibia", "calf", "knee"];
const FOOT: &[&str] = &["foot", "ankle"];
const TOES: &[&str] = &["toebase", "toes", "toe0", "toe", "ball", "forefoot", "midtarsal"];
const UPPER_ARM: &[&str] = &["arm", "upperarm", "shldr", "humerus", "shoulder"];
const FOREARM: &[&str] = &["forearm", "lowerarm", "radius", "elbow"];
const HAND: &[&str] = &["hand", "wrist"];
const HEAD: &[&str] = &["head", "skullbase"];

impl Anatomy {
    fn find(joints: &[RecordedJoint]) -> Result<Anatomy, MappingError> {
        use Joint::*;
        let names: Vec<String> = joints.iter().map(|j| plain_name(&j.name)).collect();
        let mut of = [None; NODES];
        let mut missing = Vec::new();
        for (side, long, short, [hip, knee, ankle, toes, shoulder, elbow, wrist]) in [
            ("left", "left", "l", [LHip, LKnee, LAnkle, LMidtarsal, LShoulder, LElbow, LWrist]),
            ("right", "right", "r", [RHip, RKnee, RAnkle, RMidtarsal, RShoulder, RElbow, RWrist]),
        ] {
            let mut chain = |parts: [(Joint, &[&str], &str, bool); 3], last: Option<(Joint, &[&str])>| {
                let mut above = None;
                for (joint, part, what, required) in parts {
                    let found = sided(&names, long, short, part).filter(|&j| above.is_none_or(|a| is_above(joints, a, j)));
                    if found.is_none() && required {
                        missing.push(format!("{side} {what}"));
                    }
                    of[joint as usize] = found;
                    above = found.or(above);
                }
                if let Some((joint, part)) = last {
                    of[joint as usize] = sided(&names, long, short, part).filter(|&j| above.is_some_and(|a| is_above(joints, a, j)));
                }
            };
            chain([(hip, THIGH, "hip", true), (knee, SHANK, "knee", true), (ankle, FOOT, "ankle", true)], Some((toes, TOES)));
            chain([(shoulder, UPPER_ARM, "shoulder", true), (elbow, FOREARM, "elbow", true), (wrist, HAND, "wrist", false)], None);
        }
        let mut anatomy = Anatomy { of };
        if missing.is_empty() && !anatomy.find_trunk(joints, &names) {
            missing.push("spine".into());
        }
        if !missing.is_empty() {
            let names: Vec<&str> = joints.iter().map(|j| j.name.as_str()).collect();
            return Err(MappingError::Missing { missing: missing.join(", "), names: shortened(&names) });
        }
        anatomy.move_short_wrists(joints, &names);
        Ok(anatomy)
    }

    /// Pelvis, trunk, neck, head and clavicles from the hierarchy; false without a trunk joint above the pelvis.
    fn find_trunk(&mut self, joints: &[RecordedJoint], names: &[String]) -> bool {
        use Joint::*;
        let [Some(lh), Some(rh), Some(ls), Some(rs)] = [LHip, RHip, LShoulder, RShoulder].map(|j| self.of[j as usize]) else {
            return false;
        };
        let (Some(hips), Some(chest)) = (common_ancestor(joints, lh, rh), common_ancestor(joints, ls, rs)) else { return false };
        let Some(root) = common_ancestor(joints, hips, chest) else { return false };
        self.of[Root as usize] = Some(root);
        self.of[Sacroiliac as usize] = (hips != root).then_some(hips);
        let trunk = path(joints, root, chest);
        let ours: &[Joint] = match trunk.len() {
            0 => return false,
            1 => &[Vl5],
            2 => &[Vl5, Vt10],
            3 => &[Vl5, Vl1, Vt10],
            4 => &[Vl5, Vl1, Vt10, Vt5],
            _ => &[Vl5, Vl1, Vt10, Vt5, Vt1],
        };
        for (i, &joint) in ours.iter().enumerate() {
            // More than five: evenly, the last always.
            self.of[joint as usize] = trunk.get((i + 1) * trunk.len() / ours.len() - 1).copied();
        }
        for (shoulder, inner, outer) in [(ls, LSternoclavicular, LAcromioclavicular), (rs, RSternoclavicular, RAcromioclavicular)] {
            let between = path(joints, chest, shoulder);
            if let [first, .., _shoulder] = between[..] {
                self.of[inner as usize] = Some(first);
                self.of[outer as usize] = (between.len() > 2).then(|| between[between.len() - 2]);
            }
        }
        if let Some(head) = HEAD.iter().find_map(|part| names.iter().position(|n| n == part)).filter(|&h| is_above(joints, root, h)) {
            self.of[Skullbase as usize] = Some(head);
            let from = common_ancestor(joints, chest, head).unwrap_or(root);
            if let [neck, .., _head] = path(joints, from, head)[..] {
                self.of[Vc4 as usize] = Some(neck);
            }
        }
        true
    }

    /// CMU's forearm is two bones, and converters call the joint between them the hand: the wrist is the finger base.
    fn move_short_wrists(&mut self, joints: &[RecordedJoint], names: &[String]) {
        use Joint::*;
        for (long, short, elbow, wrist) in [("left", "l", LElbow, LWrist), ("right", "r", RElbow, RWrist)] {
            let (Some(e), Some(w)) = (self.of[elbow as usize], self.of[wrist as usize]) else { continue };
            let short_forearm = joints[w].offset.norm() < 0.8 * joints[e].offset.norm();
            if let Some(base) = sided(names, long, short, &["fingerbase"]).filter(|&b| short_forearm && joints[b].parent == Some(w)) {
                self.of[wrist as usize] = Some(base);
            }
        }
    }

    /// Source index of a node that [`Anatomy::find`] guarantees: limbs above wrist and toes, and the root.
    fn at(&self, joint: Joint) -> usize {
        self.of[joint as usize].unwrap_or(0)
    }

    fn middle(&self, positions: &[Vector3<f64>], a: Joint, b: Joint) -> Vector3<f64> {
        0.5 * (positions[self.at(a)] + positions[self.at(b)])
    }

    fn hips(&self, positions: &[Vector3<f64>]) -> Vector3<f64> {
        self.middle(positions, Joint::LHip, Joint::RHip)
    }

    fn up(&self, positions: &[Vector3<f64>]) -> Vector3<f64> {
        self.middle(positions, Joint::LShoulder, Joint::RShoulder) - self.hips(positions)
    }

    /// Length of the segment between two mapped joints, mean of both sides.
    fn length(&self, positions: &[Vector3<f64>], upper: Joint, lower: Joint) -> f64 {
        let one = |a: Joint, b: Joint| (positions[self.at(b)] - positions[self.at(a)]).norm();
        0.5 * (one(upper, lower) + one(upper.mirror(), lower.mirror()))
    }
}

/// Lower case letters and digits behind the last name space and behind a biped's prefix.
fn plain_name(name: &str) -> String {
    let last = name.rsplit([':', '|']).next().unwrap_or(name);
    let plain: String = last.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect();
    ["mixamorig", "bip001", "bip01"].iter().find_map(|p| plain.strip_prefix(p)).map(str::to_string).unwrap_or(plain)
}

fn sided(names: &[String], long: &str, short: &str, parts: &[&str]) -> Option<usize> {
    parts.iter().find_map(|part| {
        let forms = [format!("{long}{part}"), format!("{short}{part}"), format!("{part}{long}"), format!("{part}{short}")];
        forms.iter().find_map(|form| names.iter().position(|n| n == form))
    })
}

fn is_above(joints: &[RecordedJoint], above: usize, mut below: usize) -> bool {
    while let Some(parent) = joints[below].parent {
        if parent == above {
            return true;
        }
        below = parent;
    }
    false
}

fn common_ancestor(joints: &[RecordedJoint], a: usize, b: usize) -> Option<usize> {
    let mut at = Some(a);
    while let Some(j) = at {
        if j == b || is_above(joints, j, b) {
            return Some(j);
        }
        at = joints[j].parent;
    }
    None
}

/// Joints after `from` down to and with `to`.
fn path(joints: &[RecordedJoint], from: usize, to: usize) -> Vec<usize> {
    let mut path = Vec::new();
    let mut at = Some(to);
    while let Some(j) = at.filter(|&j| j != from) {
        path.push(j);
        at = joints[j].parent;
    }
    path.reverse();
    path
}

fn shortened(names: &[&str]) -> String {
    const SHOWN: usize = 24;
    let more = names.len().saturating_sub(SHOWN);
    let list = names[..names.len() - more].join(" ");
    if more > 0 { format!("{list} and {more} more") } else { list }
}

/// Positions of all joints at the zero pose, the root at the origin.
fn zero_positions(joints: &[RecordedJoint]) -> Vec<Vector3<f64>> {
    let mut positions: Vec<Vector3<f64>> = Vec::with_capacity(joints.len());
    for joint in joints {
        positions.push(joint.parent.map_or(Vector3::zeros(), |p| positions[p] + joint.offset));
    }
    positions
}

/// Metres per source unit: the file's own, else by the leg (hip to ankle): 0.4 to 1.3 m, 9 to 22 CMU units (0.45 inch⁻¹),
/// 22 to 45 inches, 45 to 130 cm, 400 to 1300 mm.
fn metres_per_unit(recording: &Recording, anatomy: &Anatomy) -> Result<f64, MappingError> {
    let rest = zero_positions(&recording.joints);
    let leg = anatomy.length(&rest, Joint::LHip, Joint::LKnee) + anatomy.length(&rest, Joint::LKnee, Joint::LAnkle);
    match recording.metres_per_unit {
        Some(scale) if (0.3..1.5).contains(&(scale * leg)) => Ok(scale),
        Some(scale) => Err(MappingError::Size { leg_m: scale * leg }),
        None => unit_of_leg(leg),
    }
}

fn unit_of_leg(leg: f64) -> Result<f64, MappingError> {
    match leg {
        0.4..1.3 => Ok(1.0),
        9.0..22.0 => Ok(0.0254 / 0.45),
        22.0..45.0 => Ok(0.0254),
        45.0..130.0 => Ok(0.01),
        400.0..1300.0 => Ok(0.001),
        _ => Err(MappingError::Unit { leg }),
    }
}

/// The first frame of the motion proper. Frame 0 is a rest pose put before it if the pose then jumps 2.5 times as far as 95 %
/// of all steps do; smoothed files blend over to the motion in a few frames, which go too.
fn first_frame(recording: &Recording, anatomy: &Anatomy) -> usize {
    let step = |pair: &[RecordedFrame]| {
        let angle = |&j: &usize| pair[0].rotations[j].angle_to(&pair[1].rotations[j]);
        anatomy.of.iter().flatten().map(angle).fold(0.0, f64::max)
    };
    let steps: Vec<f64> = recording.frames.windows(2).map(step).collect();
    let usual = quantile(steps.clone(), 0.95).unwrap_or(0.0);
    match steps.first() {
        Some(&first) if steps.len() > 20 && first > 10f64.to_radians() && first > 2.5 * usual => {
            steps.iter().take_while(|&&s| s > usual).count()
        }
        _ => 0,
    }
}

/// Hips that jump are an error; between frames that are dropped anyway only by more than half a metre.
fn check_root(recording: &Recording, first: usize, anatomy: &Anatomy, scale: f64, notices: &mut Vec<String>) -> Result<(), MappingError> {
    let (mut worst, mut doubtful): (Option<(usize, f64)>, _) = (None, None);
    for (frame, pair) in recording.frames.windows(2).enumerate().skip(first.min(1)) {
        let distance_m = scale * (anatomy.hips(&pair[1].positions) - anatomy.hips(&pair[0].positions)).norm();
        let (speed, kept) = (distance_m * recording.fps, frame >= first);
        let broken = speed > BROKEN_SPEED && distance_m > if kept { 0.1 } else { 0.5 };
        if broken && worst.is_none_or(|(_, d)| distance_m > d) {
            worst = Some((frame, distance_m));
        }
        if kept && speed > DOUBTFUL_SPEED && doubtful.is_none() {
            doubtful = Some((frame, speed));
        }
    }
    if let Some((frame, distance_m)) = worst {
        return Err(MappingError::RootJump { frame, distance_m });
    }
    if let Some((frame, speed)) = doubtful {
        notices.push(format!("the hips move at {speed:.1} m/s after frame {frame}: look at the recording there"));
    }
    Ok(())
}

/// The source's standing pose.
struct Rest {
    /// Positions of the joints at rest, and rotations of the bones since the zero pose.
    positions: Vec<Vector3<f64>>,
    rotations: Vec<UnitQuaternion<f64>>,
    source_from_body: UnitQuaternion<f64>,
    /// Up in the source's world, an axis.
    world_up: Vector3<f64>,
    /// True if this is the zero pose, on flat soles.
    flat_soles: bool,
}

impl Rest {
    fn find(recording: &Recording, frames: &[RecordedFrame], anatomy: &Anatomy, notices: &mut Vec<String>) -> Result<Rest, MappingError> {
        let up: Vector3<f64> = frames.iter().map(|f| anatomy.up(&f.positions).normalize()).sum();
        let world_up = nearest_axis(&up);
        let zero = zero_positions(&recording.joints);
        if uprightness(anatomy, &zero, &anatomy.up(&zero)) > 0.8 {
            let left = zero[anatomy.at(Joint::LHip)] - zero[anatomy.at(Joint::RHip)];
            let source_from_body = body_axes(&left, &anatomy.up(&zero), true)?;
            let rotations = vec![UnitQuaternion::identity(); zero.len()];
            return Ok(Rest { positions: zero, rotations, source_from_body, world_up, flat_soles: true });
        }
        let score = |f: &RecordedFrame| uprightness(anatomy, &f.positions, &world_up);
        let (best, frame) = frames.iter().enumerate().max_by(|a, b| score(a.1).total_cmp(&score(b.1))).ok_or(MappingError::Empty)?;
        notices.push(format!("the zero pose is no standing person; frame {best} serves as the rest pose"));
        let left = frame.positions[anatomy.at(Joint::LHip)] - frame.positions[anatomy.at(Joint::RHip)];
        let source_from_body = body_axes(&left, &world_up, false)?;
        let (positions, rotations) = (frame.positions.clone(), frame.rotations.clone());
        Ok(Rest { positions, rotations, source_from_body, world_up, flat_soles: false })
    }
}

/// Smallest cosine between `up` and trunk, thighs and shanks: 1 for a person standing straight, NaN never wins.
fn uprightness(anatomy: &Anatomy, positions: &[Vector3<f64>], up: &Vector3<f64>) -> f64 {
    use Joint::*;
    let cosine = |v: Vector3<f64>| v.dot(up) / (v.norm() * up.norm()).max(1e-12);
    [(LKnee, LHip), (LAnkle, LKnee), (RKnee, RHip), (RAnkle, RKnee)]
        .into_iter()
        .map(|(lower, upper)| cosine(positions[anatomy.at(upper)] - positions[anatomy.at(lower)]))
        .fold(cosine(anatomy.up(positions)), f64::min)
}

fn nearest_axis(v: &Vector3<f64>) -> Vector3<f64> {
    let axis = v.iamax();
    Vector3::ith(axis, 1f64.copysign(v[axis]))
}

/// source_from_body from the directions left and up in source axes; snapped to axes that lie within 25 degrees.
fn body_axes(left: &Vector3<f64>, up: &Vector3<f64>, snap: bool) -> Result<UnitQuaternion<f64>, MappingError> {
    let snapped = |v: Vector3<f64>| {
        let axis = nearest_axis(&v);
        if snap && v.normalize().dot(&axis) > 25f64.to_radians().cos() { axis } else { v.normalize() }
    };
    let up = snapped(*up);
    let left = snapped(left - up * left.dot(&up));
    let matrix = Matrix3::from_columns(&[left, up, left.cross(&up)]);
    let handed = matrix.determinant();
    if handed.is_nan() || handed < 0.5 {
        return Err(MappingError::NoBodyFrame);
    }
    Ok(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix)))
}

fn measured_shape(rest: &[Vector3<f64>], anatomy: &Anatomy, scale: f64) -> Shape {
    use Joint::*;
    let length = |a, b| scale * anatomy.length(rest, a, b);
    let (thigh, shank) = (length(LHip, LKnee), length(LKnee, LAnkle));
    let mut shape = Shape::template((thigh + shank) / LEG);
    let mut set = |group: Length, upper: Joint, lower: Joint, measured: f64| {
        let template = (lower.rest_position() - upper.rest_position()).norm() * shape.stature_m;
        shape.lengths[group as usize] = measured / template;
    };
    set(Length::Thigh, LHip, LKnee, thigh);
    set(Length::Shank, LKnee, LAnkle, shank);
    set(Length::UpperArm, LShoulder, LElbow, length(LShoulder, LElbow));
    if anatomy.of[LWrist as usize].is_some() && anatomy.of[RWrist as usize].is_some() {
        set(Length::Forearm, LElbow, LWrist, length(LElbow, LWrist));
    }
    shape
}

/// A of equation (1) for every node.
fn alignments(joints: &[RecordedJoint], anatomy: &Anatomy, rest: &Rest) -> [UnitQuaternion<f64>; NODES] {
    use Joint::*;
    let body_from_source = rest.source_from_body.inverse();
    // Poser and Daz figures bend knees and elbows a little at zero, and their recordings count angles from straight limbs:
    // measured on CMU trials that exist in both forms, 8 degrees in the knee and 17 in the elbow.
    let bent = joints.iter().any(|j| plain_name(&j.name).contains("shldr"));
    let mut of = [UnitQuaternion::identity(); NODES];
    for (upper, lower) in [(LHip, LKnee), (LKnee, LAnkle), (LShoulder, LElbow), (LElbow, LWrist)] {
        for (upper, lower) in [(upper, lower), (upper.mirror(), lower.mirror())] {
            let ours = lower.rest_position() - upper.rest_position();
            let source = match anatomy.of[lower as usize] {
                Some(lower) => Some(rest.positions[lower] - rest.positions[anatomy.at(upper)]),
                None => bone(joints, anatomy.at(upper), rest),
            };
            if let Some(source) = source.filter(|d| d.norm() > 0.0) {
                of[upper as usize] = between(&ours, &(body_from_source * source));
            }
        }
    }
    if bent {
        for (upper, lower) in [(LHip, LKnee), (LShoulder, LElbow), (RHip, RKnee), (RShoulder, RElbow)] {
            of[lower as usize] = of[upper as usize];
        }
    }
    for (elbow, wrist) in [(LElbow, LWrist), (RElbow, RWrist)] {
        let source = anatomy.of[wrist as usize].and_then(|w| bone(joints, w, rest));
        of[wrist as usize] = source.map_or(of[elbow as usize], |d| between(&-Vector3::y(), &(body_from_source * d)));
    }
    for (knee, ankle, ball) in [(LKnee, LAnkle, LMidtarsal), (RKnee, RAnkle, RMidtarsal)] {
        let a = anatomy.at(ankle);
        let source = anatomy.of[ball as usize].map(|b| rest.positions[b] - rest.positions[a]).or_else(|| bone(joints, a, rest));
        let shank = body_from_source * (rest.positions[a] - rest.positions[anatomy.at(knee)]);
        let foot = source.map_or(UnitQuaternion::identity(), |d| {
            let toes = body_from_source * d;
            if rest.flat_soles { flat_foot(&shank, &toes) } else { between(&(ball.rest_position() - ankle.rest_position()), &toes) }
        });
        of[ankle as usize] = foot;
        of[ball as usize] = foot;
    }
    of
}

/// Our foot, flat but leaning sideways with the shank, turned about its vertical until it points like the source's.
fn flat_foot(shank: &Vector3<f64>, toes: &Vector3<f64>) -> UnitQuaternion<f64> {
    let lean = between(&-Vector3::y(), &Vector3::new(shank.x, shank.y, 0.0));
    let toes = lean.inverse() * toes;
    let level = Vector3::new(toes.x, 0.0, toes.z);
    if level.norm() > 0.3 * toes.norm() { lean * between(&Vector3::z(), &level) } else { lean }
}

/// Direction of the bone that hangs on a joint at rest: to its end, or to the middle of its children but the thumb.
fn bone(joints: &[RecordedJoint], joint: usize, rest: &Rest) -> Option<Vector3<f64>> {
    if let Some(end) = joints[joint].end {
        return Some(rest.rotations[joint] * end).filter(|d| d.norm() > 0.0);
    }
    let children = joints.iter().enumerate().filter(|(_, j)| j.parent == Some(joint) && !plain_name(&j.name).contains("thumb"));
    let sum: Vector3<f64> = children.map(|(c, _)| rest.positions[c] - rest.positions[joint]).sum();
    Some(sum).filter(|d| d.norm() > 0.0)
}

/// Equation (1) for one frame.
fn map_frame(
    frame: &RecordedFrame,
    anatomy: &Anatomy,
    rest: &Rest,
    alignments: &[UnitQuaternion<f64>; NODES],
    ours_from_source: &UnitQuaternion<f64>,
    scale: f64,
    offsets: &[Vector3<f64>; NODES],
) -> Pose {
    let mut world_from_node = [UnitQuaternion::identity(); NODES];
    let mut pose = Pose::rest(Vector3::zeros());
    for joint in Joint::ALL {
        let k = joint as usize;
        let parent = joint.parent().map_or(UnitQuaternion::identity(), |p| world_from_node[p as usize]);
        world_from_node[k] = anatomy.of[k].map_or(parent, |j| {
            let since_rest = frame.rotations[j] * rest.rotations[j].inverse();
            ours_from_source * since_rest * rest.source_from_body * alignments[k]
        });
        match joint {
            Joint::Root => pose.world_from_root = world_from_node[k],
            _ => pose.joints[k - 1] = parent.inverse() * world_from_node[k],
        }
    }
    let placed = place(offsets, &pose);
    let our_hips = 0.5 * (placed.position(Joint::LHip) + placed.position(Joint::RHip));
    pose.root = ours_from_source * anatomy.hips(&frame.positions) * scale - our_hips;
    pose
}

/// Source index of every node if the recording is of our own skeleton, names and parents alike.
fn own_skeleton(recording: &Recording) -> Option<[usize; NODES]> {
    let mut nodes = [0; NODES];
    for joint in Joint::ALL {
        let at = recording.joints.iter().position(|j| j.name == joint.name())?;
        let parent = recording.joints[at].parent.map(|p| recording.joints[p].name.as_str());
        if parent != joint.parent().map(Joint::name) {
            return None;
        }
        nodes[joint as usize] = at;
    }
    Some(nodes)
}

/// Our own skeleton needs no mapping: the file's lengths, positions and floor are kept.
fn own_clip(recording: &Recording, nodes: &[usize; NODES]) -> Result<Clip, MappingError> {
    let length = |joint: Joint| recording.joints[nodes[joint as usize]].offset.norm();
    let leg = 0.5 * [Joint::LKnee, Joint::LAnkle, Joint::RKnee, Joint::RAnkle].map(length).iter().sum::<f64>();
    let scale = recording.metres_per_unit.map_or_else(|| unit_of_leg(leg), Ok)?;
    let mut offsets = nodes.map(|j| recording.joints[j].offset * scale);
    let hip_height_m = scale * leg * Joint::LHip.rest_position().y / LEG;
    offsets[0] = Vector3::new(0.0, hip_height_m - offsets[Joint::LHip as usize].y, 0.0);
    let pose = |frame: &RecordedFrame| {
        let rotation = |joint: Joint| frame.rotations[nodes[joint as usize]];
        let mut pose = Pose::rest(frame.positions[nodes[0]] * scale);
        pose.world_from_root = rotation(Joint::Root);
        for joint in Joint::ALL {
            if let Some(parent) = joint.parent() {
                pose.joints[joint as usize - 1] = rotation(parent).inverse() * rotation(joint);
            }
        }
        pose
    };
    Ok(Clip { fps: recording.fps, poses: recording.frames.iter().map(pose).collect(), offsets, hip_height_m })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::bvh;
    use crate::math::rotation::{exp, log};
    use std::path::Path;

    fn tiny() -> Recording {
        bvh::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/mocap/tiny.bvh")).unwrap()
    }

    fn assert_same(a: &Clip, b: &Clip, tolerance: f64) {
        assert_eq!(a.poses.len(), b.poses.len());
        for (x, y) in a.poses.iter().zip(&b.poses) {
            let (x, y) = (a.place(x), b.place(y));
            for joint in Joint::ALL {
                let distance = (x.position(joint) - y.position(joint)).norm();
                assert!(distance < tolerance, "{}: {distance}", joint.name());
            }
        }
    }

    #[test]
    fn a_t_pose_skeleton_bends_as_written() {
        let (clip, notices) = clip_from_recording(&tiny()).unwrap();
        assert!(notices.is_empty());
        let is = |frame: usize, joint: Joint, expected: [f64; 3]| {
            let degrees = log(clip.poses[frame].joint(joint)) * 180.0 / std::f64::consts::PI;
            assert!((degrees - Vector3::from(expected)).norm() < 1e-4, "frame {frame} {}: {degrees:?}", joint.name());
        };
        use Joint::*;
        is(0, LShoulder, [0.0, 0.0, 90.0]);
        is(0, RShoulder, [0.0, 0.0, -90.0]);
        for joint in Joint::ALL.into_iter().skip(1) {
            is(1, joint, [0.0; 3]);
        }
        is(2, LHip, [-30.0, 0.0, 0.0]);
        is(2, LKnee, [60.0, 0.0, 0.0]);
        is(2, LElbow, [-90.0, 0.0, 0.0]);
        let yaw = log(&clip.poses[2].world_from_root);
        assert!((yaw - Vector3::new(0.0, std::f64::consts::FRAC_PI_2, 0.0)).norm() < 1e-9);
        // Thigh 42 and shank 40 cm; the hips are 5 cm below the source's root; soles on the floor in the first frames.
        assert!((clip.leg_m() - 0.82).abs() < 1e-9);
        assert!(clip.sole_height(&clip.poses[1]).abs() < 1e-9);
        let step = clip.poses[2].root - clip.poses[1].root;
        assert!((step - Vector3::new(0.0, 0.0, 0.12)).norm() < 1e-9, "{step:?}");
    }

    #[test]
    fn the_worlds_up_axis_does_not_matter() {
        let (expected, _) = clip_from_recording(&tiny()).unwrap();
        for (turn, name) in [(Vector3::x(), "z up"), (-Vector3::x(), "-z up"), (Vector3::z(), "-x up")] {
            let world = exp(&(turn * std::f64::consts::FRAC_PI_2));
            let mut turned = tiny();
            for frame in &mut turned.frames {
                frame.positions.iter_mut().for_each(|p| *p = world * *p);
                frame.rotations.iter_mut().for_each(|r| *r = world * *r);
            }
            println!("{name}");
            assert_same(&clip_from_recording(&turned).unwrap().0, &expected, 1e-9);
        }
    }

    /// Bone frames turned at will, as in rigs whose zero pose lays all bones along x: the most upright frame serves.
    #[test]
    fn a_meaningless_zero_pose_keeps_all_limb_directions() {
        let mut odd = tiny();
        odd.frames.remove(0);
        let expected = clip_from_recording(&odd).unwrap().0;
        let old: Vec<UnitQuaternion<f64>> =
            (0..odd.joints.len()).map(|j| exp(&Vector3::new(1.5 * (j as f64).sin(), 2.0, 1.1 * j as f64))).collect();
        for j in 0..odd.joints.len() {
            if let Some(p) = odd.joints[j].parent {
                odd.joints[j].offset = old[p] * odd.joints[j].offset;
            }
            odd.joints[j].end = odd.joints[j].end.map(|e| old[j] * e);
        }
        for frame in &mut odd.frames {
            for (rotation, old) in frame.rotations.iter_mut().zip(&old) {
                *rotation *= old.inverse();
            }
        }
        let (clip, notices) = clip_from_recording(&odd).unwrap();
        assert!(notices[0].contains("frame 0 serves as the rest pose"), "{notices:?}");
        for (a, b) in clip.poses.iter().zip(&expected.poses) {
            let (a, b) = (clip.place(a), expected.place(b));
            for (upper, lower) in [(Joint::LHip, Joint::LKnee), (Joint::RKnee, Joint::RAnkle), (Joint::LElbow, Joint::LWrist)] {
                let direction = |p: &crate::body::Placement| (p.position(lower) - p.position(upper)).normalize();
                assert!((direction(&a) - direction(&b)).norm() < 1e-9, "{}", upper.name());
            }
        }
    }

    #[test]
    fn all_missing_joints_are_listed() {
        let mut recording = tiny();
        for joint in &mut recording.joints {
            if ["LeftLeg", "RightForeArm"].contains(&joint.name.as_str()) {
                joint.name.push_str("Mystery");
            }
        }
        let error = clip_from_recording(&recording).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("left knee, right elbow among Hips LeftUpLeg LeftLegMystery"), "{error}");
    }

    #[test]
    fn name_spaces_prefixes_and_sides_are_understood() {
        for (name, plain) in [("mixamorig:LeftUpLeg", "leftupleg"), ("Bip01 L Thigh", "lthigh"), ("l_hip", "lhip"), ("rig|Arm.L", "arml")] {
            assert_eq!(plain_name(name), plain);
        }
        let names: Vec<String> = ["leftshoulder", "leftarm", "upperlegr"].map(String::from).to_vec();
        assert_eq!(sided(&names, "left", "l", UPPER_ARM), Some(1));
        assert_eq!(sided(&names[..1], "left", "l", UPPER_ARM), Some(0));
        assert_eq!(sided(&names, "right", "r", THIGH), Some(2));
    }

    #[test]
    fn units_follow_the_leg() {
        let legs = [(0.85, 1.0), (14.8, 0.0254 / 0.45), (32.5, 0.0254), (82.2, 0.01), (840.0, 0.001)];
        for (leg, unit) in legs {
            assert_eq!(unit_of_leg(leg).unwrap(), unit);
        }
        assert!(unit_of_leg(3.0).is_err() && unit_of_leg(f64::NAN).is_err());
        let mut recording = tiny();
        recording.metres_per_unit = Some(0.011);
        assert!((clip_from_recording(&recording).unwrap().0.leg_m() - 0.902).abs() < 1e-9);
        recording.metres_per_unit = Some(1.0);
        assert!(matches!(clip_from_recording(&recording), Err(MappingError::Size { .. })));
    }

    /// A slow walk on the spot in 40 frames made of the fixture's last two.
    fn slow() -> Recording {
        let mut recording = tiny();
        let (standing, bent) = (recording.frames[1].clone(), recording.frames[2].clone());
        recording.frames = (0..40)
            .map(|i| {
                let s = 0.5 - 0.5 * (i as f64 / 10.0).cos();
                let rotations = standing.rotations.iter().zip(&bent.rotations).map(|(a, b)| a.slerp(b, s)).collect();
                let positions = standing.positions.iter().zip(&bent.positions).map(|(a, b)| a.lerp(b, s)).collect();
                RecordedFrame { positions, rotations }
            })
            .collect();
        recording
    }

    #[test]
    fn a_leading_rest_pose_is_dropped_and_a_jump_refused() {
        let (clean, notices) = clip_from_recording(&slow()).unwrap();
        assert!(notices.is_empty(), "{notices:?}");
        let mut led = slow();
        led.frames.insert(0, tiny().frames[0].clone());
        let (clip, notices) = clip_from_recording(&led).unwrap();
        assert!(notices[0].starts_with("dropped frame 0:"), "{notices:?}");
        assert_same(&clip, &clean, 1e-12);
        let mut jumping = slow();
        for frame in &mut jumping.frames[17..] {
            frame.positions.iter_mut().for_each(|p| p.x += 100.0);
        }
        let error = clip_from_recording(&jumping).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("jump by 1.0") && error.contains("from frame 16"), "{error}");
    }

    #[test]
    fn a_tilted_floor_is_levelled() {
        let mut recording = tiny();
        let standing = recording.frames[1].clone();
        recording.frames = (0..60)
            .map(|i| {
                let mut frame = standing.clone();
                let along = 5.0 * i as f64;
                frame.positions.iter_mut().for_each(|p| *p += Vector3::new(0.6 * along, along * 1.2f64.to_radians().tan(), 0.8 * along));
                frame
            })
            .collect();
        let (clip, notices) = clip_from_recording(&recording).unwrap();
        assert!(notices[0].contains("rises by 1.2 degrees"), "{notices:?}");
        for pose in &clip.poses {
            assert!(clip.sole_height(pose).abs() < 1e-9);
        }
    }
}

//! Inverse kinematics of a whole marker recording.
//!
//! Stature, segment lengths and marker offsets are learnt together with the poses of at most [`LEARNT_FRAMES`] frames spread
//! over the recording (equation (1) of `problem`, bordered by the shared unknowns); then the poses of all frames are found with
//! these held, in stretches of [`STRETCH`] frames that overlap by [`OVERLAP`], so that long recordings need no more memory per
//! frame. At most a few frames are lost by learning from a part: a person does not grow within a trial.
//! The forearm's twist is found at the elbow, whose frame the wrist's markers ride on, and given to the wrist as in OpenSim's
//! models; the trunk moves at vl5 alone, as there.
//! Fails when: a segment's markers are missing from the whole recording (it then keeps its mean posture), or fewer than three
//! markers of the pelvis are seen together.
//! Checked against known clips with noise, gaps and exchanged markers, and against OpenSim's inverse kinematics of two data
//! sets (tests/marker_ik.rs).

use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::problem::{Person, Problem, State};
use super::set::{MarkerSet, Match};
use super::{Markers, start};
use crate::body::{Clip, Joint, Pose, place};
use crate::math::arrow::{LmOptions, minimise};

/// More frames show no new side of shape and offsets, and cost time.
const LEARNT_FRAMES: usize = 80;
const STRETCH: usize = 150;
const OVERLAP: usize = 15;
/// Cauchy's c in standard deviations: first wide, so that far limbs are drawn in, then such that 3 cm begin to count less.
const WIDE: f64 = 20.0;
const NARROW: f64 = 3.0;
/// A longer time without a pelvis ends the part to use, seconds.
const LONGEST_GAP_S: f64 = 0.25;
/// Share of markers let go beyond which the names or the set are wrong.
const NO_BODY: f64 = 0.15;
/// A marker farther from its place is counted as let go, metres.
const LET_GO_M: f64 = 0.1;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum IkError {
    #[error("no frame shows the set's markers at different heights")]
    Empty,
    #[error("one frame is no motion; two with the pelvis in sight are the least")]
    OneFrame,
    #[error("the body does not stand along an axis of the file; the first frames of a recording must show a standing person")]
    Lying,
    #[error("the markers span a person of {size:.3} units, which is no human size in m, cm or mm; correct the file's unit of length")]
    Size { size: f64 },
    #[error(
        "no stretch of frames shows three markers of the pelvis where {set} puts them; correct the names or describe your set in markers.toml"
    )]
    NoPelvis { set: String },
    #[error(
        "{percent:.0} % of the markers are farther than {LET_GO_M} m from a body that fits the others: left and right or other names are exchanged, or {set} is not the set used"
    )]
    NoBody { percent: f64, set: String },
}

/// A recording's motion.
#[derive(Clone, Debug)]
pub struct Solved {
    /// In the recording's heading, y up, not yet put on the floor.
    pub clip: Clip,
    /// First frame of the recording in the clip.
    pub first_frame: usize,
    /// Root mean square distance of the markers to their places, metres, without those let go.
    pub rms_m: f64,
    /// Share of the seen markers that are farther than 0.1 m from their places: exchanged or broken ones.
    pub let_go: f64,
    /// Where each marker was found to ride, metres from its node; by match.
    pub offsets: Vec<Vector3<f64>>,
    pub notices: Vec<String>,
}

/// Finds body size, marker offsets and poses; `matches` as [`choose`](super::choose) gives them.
pub fn solve(markers: &Markers, set: &MarkerSet, matches: &[Match]) -> Result<Solved, IkError> {
    if markers.frames.len() < 2 {
        return Err(IkError::OneFrame);
    }
    let upright = start::upright(markers, set, matches)?;
    let person = Person::new(set, matches, upright.stature_m);
    let nominal = person.rest(0).offsets;
    let roots: Vec<_> = upright.frames.iter().map(|f| start::root(f, set, matches, &nominal)).collect();
    let gap = (LONGEST_GAP_S * markers.fps) as usize;
    let run = start::longest_run(&roots, gap).filter(|r| r.end() > r.start());
    let run = run.ok_or_else(|| IkError::NoPelvis { set: set.name.clone() })?;
    let (first_frame, frames, roots) = (*run.start(), &upright.frames[run.clone()], &roots[run]);
    let learnt = learn(&person, frames, roots, 1.0 / markers.fps);
    let state = all_frames(&person, frames, &learnt, 1.0 / markers.fps);
    let (rms_m, let_go) = misfit(&person, frames, &state);
    if let_go > NO_BODY {
        return Err(IkError::NoBody { percent: 100.0 * let_go, set: set.name.clone() });
    }
    let mut notices = upright.notices;
    if frames.len() < markers.frames.len() {
        let last = first_frame + frames.len() - 1;
        notices.push(format!("the pelvis is seen from frame {first_frame} to {last} of {}; the rest is left out", markers.frames.len()));
    }
    if let_go > 0.01 {
        notices.push(format!("{:.1} % of the markers are far from the body and were let go: look for exchanged names", 100.0 * let_go));
    }
    let poses = state.poses.iter().map(twist_at_wrists).collect();
    let clip = Clip { fps: markers.fps, poses, offsets: state.shape.offsets(), hip_height_m: state.shape.hip_height_m() };
    Ok(Solved { clip, first_frame, rms_m, let_go, offsets: state.offsets, notices })
}

type Frames = [Vec<Option<Vector3<f64>>>];

/// Shape, offsets and the poses of some frames; with them, which frames these are.
fn learn(person: &Person, frames: &Frames, roots: &[Option<Isometry3<f64>>], frame_s: f64) -> (State, usize) {
    let stride = frames.len().div_ceil(LEARNT_FRAMES);
    let mut state = person.rest(frames.len());
    start::fill_roots(&mut state.poses, roots);
    state.poses = state.poses.into_iter().step_by(stride).collect();
    let chosen: Vec<&[Option<Vector3<f64>>]> = frames.iter().step_by(stride).map(Vec::as_slice).collect();
    // First the poses alone, so that limbs far from rest do not stretch the body.
    for (cauchy, shared, max_iterations) in [(WIDE, false, 30), (WIDE, true, 30), (NARROW, true, 40)] {
        let problem = Problem { person, frames: chosen.clone(), step_s: frame_s * stride as f64, cauchy, shared };
        state = minimise(&problem, state, &LmOptions { max_iterations, relative_cost: 1e-5 }).0;
    }
    (state, stride)
}

/// Poses of all frames with shape and offsets held.
fn all_frames(person: &Person, frames: &Frames, learnt: &(State, usize), frame_s: f64) -> State {
    let (learnt, stride) = learnt;
    if *stride == 1 {
        return learnt.clone();
    }
    let last = learnt.poses.len() - 1;
    let between = |f: usize| {
        let part = (f % stride) as f64 / *stride as f64;
        learnt.poses[f / stride].towards(&learnt.poses[(f / stride + 1).min(last)], part)
    };
    let mut start = State { poses: (0..frames.len()).map(between).collect(), ..learnt.clone() };
    // The pelvis' own markers place a root better than frames far away.
    let roots: Vec<_> = frames.iter().map(|f| start::root(f, person.set, person.matches, &start.offsets)).collect();
    start::fill_roots(&mut start.poses, &roots);
    let stretch = |from: usize| -> Vec<Pose> {
        let (a, b) = (from.saturating_sub(OVERLAP), (from + STRETCH + OVERLAP).min(frames.len()));
        let part: Vec<&[Option<Vector3<f64>>]> = frames[a..b].iter().map(Vec::as_slice).collect();
        let mut state = State { poses: start.poses[a..b].to_vec(), ..start.clone() };
        for cauchy in [WIDE, NARROW] {
            let problem = Problem { person, frames: part.clone(), step_s: frame_s, cauchy, shared: false };
            state = minimise(&problem, state, &LmOptions { max_iterations: 30, relative_cost: 1e-5 }).0;
        }
        let end = (from + STRETCH).min(frames.len());
        state.poses[from - a..end - a].to_vec()
    };
    let froms: Vec<usize> = (0..frames.len()).step_by(STRETCH).collect();
    let poses: Vec<Vec<Pose>> = froms.into_par_iter().map(stretch).collect();
    State { poses: poses.into_iter().flatten().collect(), ..start }
}

/// R.m.s. distance of the markers held, share of those let go.
fn misfit(person: &Person, frames: &Frames, state: &State) -> (f64, f64) {
    let offsets = state.shape.offsets();
    let of_frame = |(frame, pose): (&Vec<Option<Vector3<f64>>>, &Pose)| {
        let placed = place(&offsets, pose);
        let distance = |(i, seen): (usize, &Option<Vector3<f64>>)| Some((person.position(state, &placed, i) - (*seen)?).norm());
        frame.iter().enumerate().filter_map(distance).collect::<Vec<f64>>()
    };
    let distances: Vec<f64> = frames.iter().zip(&state.poses).flat_map(of_frame).collect();
    let held: Vec<f64> = distances.iter().copied().filter(|d| *d <= LET_GO_M).collect();
    let rms_m = (held.iter().map(|d| d * d).sum::<f64>() / held.len().max(1) as f64).sqrt();
    (rms_m, 1.0 - held.len() as f64 / distances.len().max(1) as f64)
}

/// The same placement of all nodes but the elbows, with the twist about the forearm at the wrist.
fn twist_at_wrists(pose: &Pose) -> Pose {
    let mut moved = pose.clone();
    for (elbow, wrist) in [(Joint::LElbow, Joint::LWrist), (Joint::RElbow, Joint::RWrist)] {
        let (e, w) = (elbow as usize - 1, wrist as usize - 1);
        let q = pose.joints[e];
        let about_y = Quaternion::new(q.w, 0.0, q.j, 0.0);
        if about_y.norm() > 1e-9 {
            let twist = UnitQuaternion::new_normalize(about_y);
            moved.joints[e] = q * twist.inverse();
            moved.joints[w] = twist * pose.joints[w];
        }
    }
    moved
}

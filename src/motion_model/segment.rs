//! Cuts clips into gait cycles and jumps and resamples them to N = 100 postures (style paper §3.1, §3.2).
//!
//! Gait. Heel strikes are the maxima of the heel's position ahead of the root along the local heading (Zeni et al. 2008,
//! Gait & Posture 27(4)), which needs no floor and works on a treadmill, whose belt is added to the root's path first.
//! A cycle runs from one right strike to the next; a clip that holds more strides between left strikes gives these, rotated
//! so that phase 0 is the right strike within; a clip with no stride between strikes is cut where the feet are farthest behind.
//! The cycle's carrier follows the circular arc through the root's first and last
//! position whose turn Δψ is the change of the root's yaw between two equal phases:
//!   heading ψ(μ) = ψ0 + Δψ μ,   ψ0 = direction of the chord − Δψ/2,   arc length L = chord · (Δψ/2)/sin(Δψ/2)     (1)
//! so a turning walk has the path speed L/T, and what is left of the root is periodic. The small difference that remains
//! between the first and the last posture, e = log(q(0)⁻¹ q(1)), is spread over the cycle:
//!   q(μ) ← q(μ) exp((½ − μ) e).                                                                                  (2)
//!
//! Jumps. The longest flight of both feet gives take-off and landing; the start is where the counter-movement begins, the
//! end where the root has come to rest; the frames between are sampled at regular times, as in the paper.
//!
//! Limit: Zeni's maximum comes before the contact, by 0 to 3 % of the cycle in walking and 0 to 8 % in running, measured on
//! synthetic people whose contact is known; waiting for the heel to slow down or to stop sinking scatters more.
//! Fails when: the person walks backwards or sidewards, or the root's forward axis points up.
//! Checked against an analytic walker with known strikes and speed, and against the strides and speeds of recorded walks.

use std::ops::Range;

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::cadence::CadenceLaw;
use super::cycle::{Activity, Cycle, RootSample, SAMPLES};
use crate::body::{BALL_JOINTS, Clip, Joint, Pose, place};
use crate::math::order::quantile;
use crate::math::rotation::{exp, log};

/// Heel behind and below the ankle, as fractions of the hip height: enough to see the swing end at the heel.
const HEEL: (f64, f64) = (-0.06, -0.07);
/// A maximum counts when the signal rises and falls by this part of its range around it; less lets wiggles of a shaky
/// recording in, more loses short strides beside long ones.
const PEAK_DROP: f64 = 0.1;
/// Gaussian average over positions before events are read from them.
const SMOOTH_S: f64 = 0.015;
/// Somebody whose root goes at less than this part of the known speed is on a treadmill.
const ON_A_BELT: f64 = 0.4;
/// A clip whose root is slower than this is a treadmill's, or a stand, m/s.
const TRAVELS_M_S: f64 = 0.2;
/// Largest r.m.s. difference of the leg joints between the two ends of a cycle. Recorded steady cycles stay below 6 degrees,
/// first, last and turning ones lie at 12 to 20.
const MISMATCH_RAD: f64 = 0.21;
/// Durations of a cycle, seconds, and against the cadence law; a missed strike doubles it.
const DURATION_S: Range<f64> = 0.4..3.0;
const DURATION_OF_LAW: Range<f64> = 0.55..1.7;
/// Normalised speeds V = v/H in 1/s at which people walk, and at which they run.
const WALKING_V: Range<f64> = 0.35..2.8;
const RUNNING_V: Range<f64> = 1.5..9.0;
/// A stride that turns by more is a turn with its own steps, not walking in a bend.
const TURN_RAD: f64 = 1.2;
/// A flight lifts both ankles by this part of the hip height for at least [`FLIGHT_S`].
const FLIGHT_RISE: f64 = 0.05;
const FLIGHT_S: f64 = 0.1;
/// Vertical speed of the root that counts as moving, m/s, and how long it must rest to have settled.
const RESTS_M_S: f64 = 0.1;
const SETTLED_S: f64 = 0.2;

/// Speed over the floor, in hip heights per second, of somebody who stands; runs and hops in a row are faster.
const STANDS_V: f64 = 0.6;

/// What is known of a clip beforehand.
#[derive(Clone, Debug)]
pub struct Label {
    pub subject: String,
    /// Name of the file, for [`Cycle::source`].
    pub source: String,
    pub activity: Activity,
    /// Speed in m/s or jump length in m where it was measured otherwise; needed on a treadmill.
    pub parameter: Option<f64>,
    /// Part of the clip to use, seconds from its start.
    pub start_s: Option<f64>,
    pub end_s: Option<f64>,
}

/// Cycles of a clip, and for each stretch that was refused the reason.
#[derive(Clone, Debug, Default)]
pub struct Segments {
    pub cycles: Vec<Cycle>,
    pub rejected: Vec<String>,
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum SegmentError {
    #[error("has {frames} frames in the part to use ({seconds:.2} s), too few for a {activity}")]
    Short { frames: usize, seconds: f64, activity: &'static str },
    #[error("stands still ({speed_m_s:.2} m/s): if it is a treadmill's, give its speed as speed_m_s in subjects.csv")]
    Standing { speed_m_s: f64 },
    #[error("shows no whole stride ({strikes} right heel strikes)")]
    NoStride { strikes: usize },
    #[error("never has both feet in the air for {FLIGHT_S} s, so it is no jump")]
    NoFlight,
    #[error("has a hip height of {0} m; it must be positive")]
    HipHeight(f64),
}

/// Cuts `clip` into cycles (phase 0 is the right heel strike) or jumps. Stretches that are no steady cycle are listed, not
/// returned.
pub fn segment(clip: &Clip, label: &Label) -> Result<Segments, SegmentError> {
    if !(clip.hip_height_m > 0.0 && clip.hip_height_m.is_finite()) {
        return Err(SegmentError::HipHeight(clip.hip_height_m));
    }
    let frame = |time_s: f64| (time_s.max(0.0) * clip.fps).round() as usize;
    let end = label.end_s.map_or(clip.poses.len(), |t| (frame(t) + 1).min(clip.poses.len()));
    let start = label.start_s.map_or(0, frame).min(end);
    let track = Track::new(clip, start..end);
    let activity = if label.activity.is_cyclic() { "gait cycle" } else { "jump" };
    let seconds = track.poses.len() as f64 / clip.fps;
    if seconds < DURATION_S.start || track.poses.len() < 8 {
        return Err(SegmentError::Short { frames: track.poses.len(), seconds, activity });
    }
    if label.activity.is_cyclic() { gait(track, label) } else { jumps(&track, label) }
}

/// The clip over the ground: with the way that a treadmill's belt took from under the person, whose speed is given.
pub fn overground(clip: &Clip, speed_m_s: f64) -> Clip {
    let mut track = Track::new(clip, 0..clip.poses.len());
    if travel_speed(&track) < ON_A_BELT * speed_m_s {
        track.add_belt(speed_m_s);
    }
    Clip { poses: track.poses, ..clip.clone() }
}

/// A clip's poses with the positions that events are read from.
pub(super) struct Track {
    pub fps: f64,
    hip_height_m: f64,
    /// Length of the straight leg from hip joint to ankle, metres.
    leg_m: f64,
    /// Time of the first frame in the clip, seconds.
    start_s: f64,
    pub poses: Vec<Pose>,
    /// Right and left heel, right and left ankle.
    pub heels: [Vec<Vector3<f64>>; 2],
    ankles: [Vec<Vector3<f64>>; 2],
}

impl Track {
    pub fn new(clip: &Clip, frames: Range<usize>) -> Track {
        let poses = clip.poses[frames.clone()].to_vec();
        let heel = Vector3::new(0.0, HEEL.1, HEEL.0) * clip.hip_height_m;
        let mut track = Track {
            fps: clip.fps,
            hip_height_m: clip.hip_height_m,
            leg_m: clip.offsets[Joint::RKnee as usize].norm() + clip.offsets[Joint::RAnkle as usize].norm(),
            start_s: frames.start as f64 / clip.fps,
            heels: Default::default(),
            ankles: Default::default(),
            poses,
        };
        for pose in &track.poses {
            let placed = place(&clip.offsets, pose);
            for (side, joint) in [Joint::RAnkle, Joint::LAnkle].into_iter().enumerate() {
                track.ankles[side].push(placed.position(joint));
                track.heels[side].push(placed.position(joint) + placed.world_from_node[joint as usize] * heel);
            }
        }
        track
    }

    fn frames(&self, seconds: f64) -> usize {
        (seconds * self.fps).round() as usize
    }

    /// Pose between frames, `at` in frames; the ends are clamped.
    pub fn pose_at(&self, at: f64) -> Pose {
        let i = (at.max(0.0) as usize).min(self.poses.len() - 2);
        let part = (at - i as f64).clamp(0.0, 1.0);
        let (a, b) = (&self.poses[i], &self.poses[i + 1]);
        Pose {
            root: a.root.lerp(&b.root, part),
            world_from_root: slerp(&a.world_from_root, &b.world_from_root, part),
            joints: std::array::from_fn(|j| slerp(&a.joints[j], &b.joints[j], part)),
        }
    }

    /// Height of the floor between two frames, from the lowest ankle: standing, the hip joint is at H over it.
    fn floor_m(&self, frames: Range<usize>) -> f64 {
        let lowest = self.ankles.iter().flat_map(|side| &side[frames.clone()]).map(|p| p.y).fold(f64::INFINITY, f64::min);
        lowest - (self.hip_height_m - self.leg_m)
    }

    /// Adds the belt's way, so that a treadmill's clip travels like any other.
    fn add_belt(&mut self, speed_m_s: f64) {
        let facing: Vector2<f64> = self.poses.iter().map(facing).sum();
        let step = facing.normalize() * (speed_m_s / self.fps);
        for i in 0..self.poses.len() {
            let way = Vector3::new(step.x, 0.0, step.y) * i as f64;
            self.poses[i].root += way;
            self.heels.iter_mut().chain(&mut self.ankles).for_each(|side| side[i] += way);
        }
    }

    fn place_name(&self, label: &Label, from: f64, to: f64) -> String {
        let time = |frame: f64| self.start_s + frame / self.fps;
        format!("{} {:.2}-{:.2} s", label.source, time(from), time(to))
    }
}

/// The shorter way between two rotations.
fn slerp(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>, part: f64) -> UnitQuaternion<f64> {
    a * exp(&(log(&(a.inverse() * b)) * part))
}

/// Where the root points on the floor: (x, z) of unit length.
fn facing(pose: &Pose) -> Vector2<f64> {
    ground(&(pose.world_from_root * Vector3::z())).try_normalize(1e-9).unwrap_or(Vector2::y())
}

pub(super) fn ground(v: &Vector3<f64>) -> Vector2<f64> {
    Vector2::new(v.x, v.z)
}

/// Angle about +y that turns z into the ground direction (x, z).
fn yaw(direction: &Vector2<f64>) -> f64 {
    direction.x.atan2(direction.y)
}

fn wrapped(angle: f64) -> f64 {
    use std::f64::consts::PI;
    (angle + PI).rem_euclid(2.0 * PI) - PI
}

fn gait(mut track: Track, label: &Label) -> Result<Segments, SegmentError> {
    let speed_m_s = travel_speed(&track);
    match label.parameter {
        Some(belt) if speed_m_s < ON_A_BELT * belt => track.add_belt(belt),
        None if speed_m_s < TRAVELS_M_S => return Err(SegmentError::Standing { speed_m_s }),
        _ => {}
    }
    let mut segments = Segments::default();
    for stride in strides(&track)? {
        match gait_cycle(&track, &stride, label) {
            Ok(cycle) => segments.cycles.push(cycle),
            Err(reason) => segments.rejected.push(format!("{}: {reason}", track.place_name(label, stride.from, stride.to))),
        }
    }
    Ok(segments)
}

/// From one heel strike to the next of the same foot, in frames.
struct Stride {
    from: f64,
    to: f64,
    /// Where in it, 0 to 1, the right foot strikes.
    right_strike: f64,
}

/// The strides between right strikes, or where the clip holds more of them those between left strikes; without any of these
/// the strides from one farthest place behind to the next, which short recordings of a single stride need.
fn strides(track: &Track) -> Result<Vec<Stride>, SegmentError> {
    let ahead = [0, 1].map(|side| ahead(track, &track.heels[side]));
    let behind = ahead.each_ref().map(|a| maxima(&a.iter().map(|x| -x).collect::<Vec<_>>()));
    let [right, left] = ahead.map(|a| maxima(&a));
    let of_right: Vec<Stride> = right.windows(2).map(|w| Stride { from: w[0], to: w[1], right_strike: 0.0 }).collect();
    let around = |events: &[f64]| -> Vec<Stride> {
        let stride = |w: &[f64]| {
            let strike = right.iter().find(|&&r| r > w[0] && r < w[1])?;
            Some(Stride { from: w[0], to: w[1], right_strike: (strike - w[0]) / (w[1] - w[0]) })
        };
        events.windows(2).filter_map(stride).collect()
    };
    let most = |a: Vec<Stride>, b: Vec<Stride>| if b.len() > a.len() { b } else { a };
    let found = most(of_right, around(&left));
    let found = if found.is_empty() { most(around(&behind[0]), around(&behind[1])) } else { found };
    if found.is_empty() { Err(SegmentError::NoStride { strikes: right.len() }) } else { Ok(found) }
}

/// Median speed of the root over half seconds, m/s.
fn travel_speed(track: &Track) -> f64 {
    let step = track.frames(0.5).clamp(1, track.poses.len() - 1);
    let speeds = (0..track.poses.len() - step)
        .map(|i| ground(&(track.poses[i + step].root - track.poses[i].root)).norm() * track.fps / step as f64)
        .collect();
    quantile(speeds, 0.5).unwrap_or(0.0)
}

/// Heel strikes of the right (0) or left (1) foot in frames, with fractions.
pub(super) fn strikes(track: &Track, side: usize) -> Vec<f64> {
    maxima(&ahead(track, &track.heels[side]))
}

/// Frames, with fractions, at which a point of the foot is farthest behind the root (Zeni's toe-off, of a toe's tip).
pub(super) fn farthest_behind(track: &Track, points: &[Vector3<f64>]) -> Vec<f64> {
    let behind: Vec<f64> = ahead(track, points).iter().map(|x| -x).collect();
    maxima(&behind)
}

/// How far a point is ahead of the root along the heading of the second around, smoothed, metres.
fn ahead(track: &Track, points: &[Vector3<f64>]) -> Vec<f64> {
    let facings: Vec<Vector2<f64>> = track.poses.iter().map(facing).collect();
    let half = track.frames(0.5);
    let ahead: Vec<f64> = (0..facings.len())
        .map(|i| {
            let heading: Vector2<f64> = facings[i.saturating_sub(half)..(i + half + 1).min(facings.len())].iter().sum();
            let heading = heading.try_normalize(1e-9).unwrap_or(facings[i]);
            heading.dot(&ground(&(points[i] - track.poses[i].root)))
        })
        .collect();
    smooth(&ahead, SMOOTH_S * track.fps)
}

/// Gaussian average with `sigma` in samples; the ends average what there is.
fn smooth(x: &[f64], sigma: f64) -> Vec<f64> {
    let reach = (3.0 * sigma).ceil() as isize;
    let kernel: Vec<f64> = (-reach..=reach).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
    (0..x.len() as isize)
        .map(|i| {
            let (mut sum, mut weight) = (0.0, 0.0);
            for (k, w) in (-reach..=reach).zip(&kernel) {
                if let Some(value) = usize::try_from(i + k).ok().and_then(|j| x.get(j)) {
                    sum += w * value;
                    weight += w;
                }
            }
            sum / weight
        })
        .collect()
}

/// Places of the maxima that stand out by [`PEAK_DROP`] of the range, to parts of a sample by a parabola.
fn maxima(x: &[f64]) -> Vec<f64> {
    let [low, high] = [0.05, 0.95].map(|q| quantile(x.to_vec(), q).unwrap_or(0.0));
    let drop = PEAK_DROP * (high - low);
    // A maximum in the first frames is one when the signal still rose to it.
    let (mut found, mut rising, mut best) = (Vec::new(), true, 0);
    for i in 0..x.len() {
        if rising && x[i] > x[best] || !rising && x[i] < x[best] {
            best = i;
        } else if (x[best] - x[i]).abs() > drop {
            if rising && best > 1 {
                found.push(best);
            }
            rising = !rising;
            best = i;
        }
    }
    found.into_iter().map(|i| i as f64 + vertex(x[i - 1], x[i], x[i + 1])).collect()
}

/// Vertex of the parabola through three neighbours, between −½ and ½.
fn vertex(before: f64, at: f64, after: f64) -> f64 {
    let bend = before - 2.0 * at + after;
    if bend >= 0.0 { 0.0 } else { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) }
}

fn gait_cycle(track: &Track, stride: &Stride, label: &Label) -> Result<Cycle, String> {
    let &Stride { from, to, .. } = stride;
    let duration_s = (to - from) / track.fps;
    if !DURATION_S.contains(&duration_s) {
        return Err(format!("lasts {duration_s:.2} s, a heel strike is missing or false"));
    }
    let ends = [from, to].map(|at| track.pose_at(at));
    let mismatch = leg_mismatch(&ends[0], &ends[1]);
    if mismatch > MISMATCH_RAD {
        return Err(format!("not a steady cycle: the legs differ by {:.0} degrees between its ends", mismatch.to_degrees()));
    }
    let arc = Arc::through(&ends[0], &ends[1]);
    if arc.turn.abs() > TURN_RAD {
        return Err(format!("turns by {:.0} degrees", arc.turn.to_degrees().abs()));
    }
    let speed_m_s = arc.length_m / duration_s;
    let (name, range) = if label.activity == Activity::Walking { ("walking", WALKING_V) } else { ("running", RUNNING_V) };
    if !range.contains(&(speed_m_s / track.hip_height_m)) {
        return Err(format!("{speed_m_s:.2} m/s is not {name} for a hip height of {:.2} m", track.hip_height_m));
    }
    let law = CadenceLaw::prior(label.activity).frequency_hz(speed_m_s, track.hip_height_m);
    if !DURATION_OF_LAW.contains(&(duration_s * law)) {
        return Err(format!("lasts {duration_s:.2} s at {speed_m_s:.2} m/s, a heel strike is missing or false"));
    }
    let samples: Vec<(f64, Pose)> = (0..SAMPLES)
        .map(|k| (k as f64 / SAMPLES as f64 + stride.right_strike).fract())
        .map(|mu| (mu, track.pose_at(from + (to - from) * mu)))
        .collect();
    let floor_m = track.floor_m(from.round() as usize..(to.round() as usize + 1).min(track.poses.len()));
    Ok(Cycle {
        subject: label.subject.clone(),
        source: track.place_name(label, from, to),
        activity: label.activity,
        parameter: label.parameter.unwrap_or(speed_m_s),
        hip_height_m: track.hip_height_m,
        duration_s,
        joints: closed_joints(&ends, &samples),
        root: periodic_root(&ends, &samples, &arc, floor_m, track.hip_height_m),
    })
}

/// Root mean square angle between the leg joints of two postures.
fn leg_mismatch(first: &Pose, last: &Pose) -> f64 {
    use Joint::*;
    let squares = [LHip, LKnee, LAnkle, RHip, RKnee, RAnkle].map(|j| first.joint(j).angle_to(last.joint(j)).powi(2));
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

/// Equation (2): `samples` are phases of the stride and postures there.
fn closed_joints(ends: &[Pose; 2], samples: &[(f64, Pose)]) -> Vec<[UnitQuaternion<f64>; BALL_JOINTS]> {
    let drift: [Vector3<f64>; BALL_JOINTS] = std::array::from_fn(|j| log(&(ends[0].joints[j].inverse() * ends[1].joints[j])));
    samples.iter().map(|(mu, pose)| std::array::from_fn(|j| pose.joints[j] * exp(&(drift[j] * (0.5 - mu))))).collect()
}

/// The carrier's path of equation (1) on the floor; vectors are (x, z).
struct Arc {
    start: Vector2<f64>,
    heading: f64,
    turn: f64,
    length_m: f64,
}

impl Arc {
    fn through(first: &Pose, last: &Pose) -> Arc {
        let chord = ground(&(last.root - first.root));
        let turn = wrapped(yaw(&facing(last)) - yaw(&facing(first)));
        Arc { start: ground(&first.root), heading: yaw(&chord) - turn / 2.0, turn, length_m: chord.norm() / sinc(turn / 2.0) }
    }

    fn heading(&self, phase: f64) -> f64 {
        self.heading + self.turn * phase
    }

    fn position(&self, phase: f64) -> Vector2<f64> {
        let half_turn = self.turn * phase / 2.0;
        let (sin, cos) = (self.heading + half_turn).sin_cos();
        self.start + Vector2::new(sin, cos) * (self.length_m * phase * sinc(half_turn))
    }
}

fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-6 { 1.0 } else { x.sin() / x }
}

/// Root against the arc, closed like the joints; sway and progress have mean zero.
fn periodic_root(ends: &[Pose; 2], samples: &[(f64, Pose)], arc: &Arc, floor_m: f64, hip_height_m: f64) -> Vec<RootSample> {
    let in_carrier = |mu: f64, pose: &Pose| {
        let on_floor = arc.position(mu);
        let carrier = Vector3::new(on_floor.x, floor_m + hip_height_m, on_floor.y);
        let carrier_from_world = exp(&Vector3::new(0.0, -arc.heading(mu), 0.0));
        (carrier_from_world * pose.world_from_root, carrier_from_world * (pose.root - carrier) / hip_height_m)
    };
    let [first, last] = [in_carrier(0.0, &ends[0]), in_carrier(1.0, &ends[1])];
    let drift = log(&(first.0.inverse() * last.0));
    let rise = last.1 - first.1;
    let mut samples: Vec<RootSample> = samples
        .iter()
        .map(|(mu, pose)| {
            let (rotation, position) = in_carrier(*mu, pose);
            let part = 0.5 - mu;
            RootSample { rotation: log(&(rotation * exp(&(drift * part)))), position: position + rise * part }
        })
        .collect();
    let mut mean = samples.iter().map(|s| s.position).sum::<Vector3<f64>>() / SAMPLES as f64;
    mean.y = 0.0;
    samples.iter_mut().for_each(|s| s.position -= mean);
    samples
}

/// Frames of a jump's key events.
#[derive(Clone, Copy, Debug, PartialEq)]
struct JumpEvents {
    start: usize,
    take_off: usize,
    landing: usize,
    end: usize,
}

fn jumps(track: &Track, label: &Label) -> Result<Segments, SegmentError> {
    let flights = flights(track);
    if flights.is_empty() {
        return Err(SegmentError::NoFlight);
    }
    let mut segments = Segments::default();
    let mut free_from = 0;
    for flight in flights {
        let events = key_events(track, flight);
        let place = track.place_name(label, events.start as f64, events.end as f64);
        if events.start < free_from {
            segments.rejected.push(format!("{place}: begins before the jump before it has settled"));
            continue;
        }
        let moving = [events.start, events.end].map(|i| horizontal_speed(track, i)).into_iter().fold(0.0, f64::max);
        if moving > STANDS_V * track.hip_height_m {
            segments.rejected.push(format!("{place}: moves at {moving:.1} m/s at its ends, a jump begins and ends standing"));
            continue;
        }
        free_from = events.end;
        segments.cycles.push(jump(track, events, label));
    }
    Ok(segments)
}

/// Speed of the root over the floor around a frame, m/s.
fn horizontal_speed(track: &Track, frame: usize) -> f64 {
    let reach = track.frames(0.05).max(1);
    let (a, b) = (frame.saturating_sub(reach), (frame + reach).min(track.poses.len() - 1));
    ground(&(track.poses[b].root - track.poses[a].root)).norm() * track.fps / (b - a) as f64
}

/// Frames during which both ankles are up in the air.
fn flights(track: &Track) -> Vec<Range<usize>> {
    let lower: Vec<f64> = (0..track.poses.len()).map(|i| track.ankles[0][i].y.min(track.ankles[1][i].y)).collect();
    let ground_m = quantile(lower.clone(), 0.1).unwrap_or(0.0);
    let up = |i: usize| lower[i] > ground_m + FLIGHT_RISE * track.hip_height_m;
    let mut found = Vec::new();
    let mut i = 0;
    while i < lower.len() {
        let from = i;
        while i < lower.len() && up(i) {
            i += 1;
        }
        // A flight that touches the clip's ends has no take-off or no landing.
        if i - from >= track.frames(FLIGHT_S).max(1) && from > 0 && i < lower.len() {
            found.push(from..i);
        }
        i += 1;
    }
    found
}

fn key_events(track: &Track, flight: Range<usize>) -> JumpEvents {
    let height: Vec<f64> = smooth(&track.poses.iter().map(|p| p.root.y).collect::<Vec<_>>(), SMOOTH_S * track.fps);
    let last = height.len() - 1;
    let velocity = |i: usize| (height[(i + 1).min(last)] - height[i.saturating_sub(1)]) * track.fps / 2.0;
    let crouch_from = flight.start.saturating_sub(track.frames(1.0));
    let crouch = (crouch_from..=flight.start).min_by(|&a, &b| height[a].total_cmp(&height[b])).unwrap_or(flight.start);
    let mut start = (crouch_from..=crouch).min_by(|&a, &b| velocity(a).total_cmp(&velocity(b))).unwrap_or(crouch);
    while start > 0 && velocity(start) < -RESTS_M_S {
        start -= 1;
    }
    let calm = track.frames(SETTLED_S).max(1);
    // The squat after landing rests for a moment too: settled means up again, so search from the lowest point on.
    let squat_to = (flight.end + track.frames(0.6)).min(last);
    let squat = (flight.end..=squat_to).min_by(|&a, &b| height[a].total_cmp(&height[b])).unwrap_or(flight.end);
    let risen = (squat..=last).find(|&i| velocity(i) > RESTS_M_S).unwrap_or(squat);
    let end = (risen..=last).find(|&i| (i..=(i + calm).min(last)).all(|j| velocity(j).abs() < RESTS_M_S)).unwrap_or(last);
    JumpEvents { start, take_off: flight.start, landing: flight.end, end }
}

fn jump(track: &Track, events: JumpEvents, label: &Label) -> Cycle {
    let feet = |i: usize| ground(&((track.ankles[0][i] + track.ankles[1][i]) / 2.0));
    let leap = feet(events.landing) - feet(events.take_off);
    let length_m = (feet(events.end) - feet(events.start)).norm();
    let direction = if leap.norm() > 0.15 * track.hip_height_m { leap } else { facing(&track.poses[events.start]) };
    let heading = yaw(&direction);
    let (from, to) = (events.start as f64, events.end as f64);
    let poses: Vec<Pose> = (0..SAMPLES).map(|k| track.pose_at(from + (to - from) * k as f64 / (SAMPLES - 1) as f64)).collect();
    let h = track.hip_height_m;
    let floor_m = track.floor_m(events.start..events.take_off.max(events.start + 1));
    let carrier = Vector3::new(poses[0].root.x, floor_m + h, poses[0].root.z);
    let carrier_from_world = exp(&Vector3::new(0.0, -heading, 0.0));
    Cycle {
        subject: label.subject.clone(),
        source: track.place_name(label, from, to),
        activity: label.activity,
        parameter: label.parameter.unwrap_or(length_m),
        hip_height_m: h,
        duration_s: (to - from) / track.fps,
        joints: poses.iter().map(|p| p.joints).collect(),
        root: poses
            .iter()
            .map(|p| RootSample {
                rotation: log(&(carrier_from_world * p.world_from_root)),
                position: carrier_from_world * (p.root - carrier) / h,
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use std::f64::consts::TAU;

    const FPS: f64 = 100.0;
    const H: f64 = 0.9;
    const PERIOD_S: f64 = 1.13;
    /// Time of the first right strike.
    const STRIKE_S: f64 = 0.31;

    /// Stiff legs that swing like pendulums: the heel is farthest ahead where the hip is most flexed.
    fn walker(speed_m_s: f64, turn_per_s: f64, belt: bool) -> Clip {
        let offsets = Shape::template(H / 0.53).offsets();
        let mut on_floor = Vector2::new(3.0, -1.0);
        let poses = (0..420).map(|i| {
            let time_s = i as f64 / FPS;
            let heading = 0.4 + turn_per_s * time_s;
            let phase = (time_s - STRIKE_S) / PERIOD_S;
            let mut pose = Pose::rest(Vector3::new(on_floor.x, 0.93 + 0.02 * (2.0 * TAU * phase).cos(), on_floor.y));
            pose.world_from_root = exp(&Vector3::new(0.0, heading, 0.0)) * exp(&Vector3::new(0.05, 0.0, 0.04 * (TAU * phase).sin()));
            pose.joints[Joint::RHip as usize - 1] = exp(&Vector3::new(-0.4 * (TAU * phase).cos(), 0.0, 0.0));
            pose.joints[Joint::LHip as usize - 1] = exp(&Vector3::new(0.4 * (TAU * phase).cos(), 0.0, 0.0));
            if !belt {
                let middle = heading + turn_per_s / FPS / 2.0;
                on_floor += Vector2::new(middle.sin(), middle.cos()) * (speed_m_s / FPS);
            }
            pose
        });
        Clip { fps: FPS, poses: poses.collect(), offsets, hip_height_m: H }
    }

    fn label(parameter: Option<f64>) -> Label {
        Label { subject: "s".into(), source: "t".into(), activity: Activity::Walking, parameter, start_s: None, end_s: None }
    }

    #[test]
    fn finds_known_strikes_speed_and_postures_straight_turning_and_on_a_belt() {
        for (turn_per_s, belt) in [(0.0, false), (0.6, false), (0.0, true)] {
            let found = segment(&walker(1.3, turn_per_s, belt), &label(belt.then_some(1.3))).unwrap();
            assert_eq!(found.cycles.len(), 3, "{turn_per_s} {belt} {:?}", found.rejected);
            for cycle in &found.cycles {
                assert!((cycle.parameter - 1.3).abs() < 0.002, "{}", cycle.parameter);
                assert!((cycle.duration_s - PERIOD_S).abs() < 0.006, "{}", cycle.duration_s);
                for (k, (joints, root)) in cycle.joints.iter().zip(&cycle.root).enumerate() {
                    let phase = k as f64 / SAMPLES as f64;
                    let hip = log(&joints[Joint::RHip as usize - 1]);
                    assert!((hip - Vector3::new(-0.4 * (TAU * phase).cos(), 0.0, 0.0)).norm() < 0.01);
                    assert!((root.rotation - Vector3::new(0.05, 0.0, 0.04 * (TAU * phase).sin())).norm() < 0.005, "{root:?}");
                    assert!(root.position.x.abs() < 0.003 && root.position.z.abs() < 0.003, "{root:?}");
                }
                let bob = cycle.root[0].position.y - cycle.root[25].position.y;
                assert!((bob - 0.04 / H).abs() < 0.001, "{bob}");
            }
        }
    }

    #[test]
    fn strikes_do_not_depend_on_where_the_clip_begins() {
        let mut clip = walker(1.3, 0.0, false);
        clip.poses.drain(..20);
        let found = segment(&clip, &label(None)).unwrap();
        let first = found.cycles[0].source.clone();
        assert_eq!(first, format!("t {:.2}-{:.2} s", STRIKE_S - 0.2, STRIKE_S - 0.2 + PERIOD_S));
        let part = Label { start_s: Some(1.0), end_s: Some(2.8), ..label(None) };
        assert_eq!(segment(&walker(1.3, 0.0, false), &part).unwrap().cycles.len(), 1);
    }

    #[test]
    fn strides_between_left_strikes_begin_at_the_right_strike_too() {
        let mut clip = walker(1.3, 0.0, false);
        // Right strikes at 0.31 and 1.44 s, left ones at 0.875 and 2.005 s: without the first right one, one left stride is left.
        clip.poses = clip.poses[45..215].to_vec();
        let found = segment(&clip, &label(None)).unwrap();
        assert_eq!(found.cycles.len(), 1);
        for (k, joints) in found.cycles[0].joints.iter().enumerate() {
            let hip = log(&joints[Joint::RHip as usize - 1]).x;
            assert!((hip + 0.4 * (TAU * k as f64 / SAMPLES as f64).cos()).abs() < 0.01, "{k}");
        }
    }

    #[test]
    fn one_stride_without_two_equal_strikes_is_cut_where_the_foot_is_farthest_behind() {
        let mut clip = walker(1.3, 0.0, false);
        for (i, pose) in clip.poses.iter_mut().enumerate() {
            // A limp: the left strikes come at phase 0.35, not 0.5.
            let phase = (i as f64 / FPS - STRIKE_S) / PERIOD_S - 0.35;
            pose.joints[Joint::LHip as usize - 1] = exp(&Vector3::new(-0.4 * (TAU * phase).cos(), 0.0, 0.0));
        }
        // Phases 0.42 to 1.72: strikes at 1.0 and 1.35, but the right foot is behind at 0.5 and 1.5.
        clip.poses = clip.poses[78..226].to_vec();
        let found = segment(&clip, &label(None)).unwrap();
        assert_eq!(found.cycles.len(), 1);
        assert!((found.cycles[0].duration_s - PERIOD_S).abs() < 0.006);
        for (k, joints) in found.cycles[0].joints.iter().enumerate() {
            let hip = log(&joints[Joint::RHip as usize - 1]).x;
            assert!((hip + 0.4 * (TAU * k as f64 / SAMPLES as f64).cos()).abs() < 0.01, "{k}");
        }
    }

    #[test]
    fn closing_makes_the_ends_meet_half_way() {
        let mut clip = walker(1.3, 0.0, false);
        for (i, pose) in clip.poses.iter_mut().enumerate() {
            pose.joints[Joint::RKnee as usize - 1] = exp(&Vector3::new(0.05 * i as f64 / FPS, 0.0, 0.0));
        }
        let cycle = &segment(&clip, &label(None)).unwrap().cycles[0];
        let knee = |k: usize| log(&cycle.joints[k][Joint::RKnee as usize - 1]).x;
        let middle = 0.05 * (STRIKE_S + PERIOD_S / 2.0);
        (0..SAMPLES).for_each(|k| assert!((knee(k) - middle).abs() < 1e-3, "{k}"));
    }

    #[test]
    fn unsteady_cycles_and_useless_clips_are_refused() {
        let mut stumble = walker(1.3, 0.0, false);
        stumble.poses[150..].iter_mut().for_each(|p| p.joints[Joint::LKnee as usize - 1] = exp(&Vector3::new(1.0, 0.0, 0.0)));
        let found = segment(&stumble, &label(None)).unwrap();
        assert_eq!((found.cycles.len(), found.rejected.len()), (2, 1));
        assert!(found.rejected[0].contains("not a steady cycle"), "{:?}", found.rejected);
        let run = segment(&walker(3.0, 0.0, false), &label(None)).unwrap();
        assert!(run.cycles.is_empty() && run.rejected[0].contains("is not walking"), "{:?}", run.rejected);
        assert!(matches!(segment(&walker(1.3, 0.0, true), &label(None)), Err(SegmentError::Standing { .. })));
        let short = Clip { poses: walker(1.0, 0.0, false).poses[..20].to_vec(), ..walker(1.0, 0.0, false) };
        assert!(matches!(segment(&short, &label(None)), Err(SegmentError::Short { frames: 20, .. })));
        let mut still = jumper();
        still.poses.truncate(50);
        assert_eq!(segment(&still, &Label { activity: Activity::Jumping, ..label(None) }).unwrap_err(), SegmentError::NoFlight);
    }

    /// Stands, bends its knees for 0.4 s, flies 0.5 s over 0.9 m, bends them again and stands. Times of start, take-off,
    /// landing and rest: 0.5, 0.9, 1.4, 2.0 s.
    fn jumper() -> Clip {
        let offsets = Shape::template(H / 0.53).offsets();
        let leg = offsets[Joint::RKnee as usize].norm();
        let poses = (0..300).map(|i| {
            let t = i as f64 / FPS;
            let crouch =
                |from: f64, to: f64| if t > from && t < to { (std::f64::consts::PI * (t - from) / (to - from)).sin().powi(2) } else { 0.0 };
            let bend = 0.8 * crouch(0.5, 0.9) + 0.8 * crouch(1.4, 2.0);
            let flight = ((t - 0.9) / 0.5).clamp(0.0, 1.0);
            let up = 0.5 * 9.81 * 0.25 * flight * (1.0 - flight);
            let mut pose = Pose::rest(Vector3::new(0.9 * flight, 0.93 + up - 2.0 * leg * (1.0 - bend.cos()), 0.0));
            pose.world_from_root = exp(&Vector3::new(0.0, std::f64::consts::FRAC_PI_2, 0.0));
            for (hip, knee, ankle) in [(Joint::RHip, Joint::RKnee, Joint::RAnkle), (Joint::LHip, Joint::LKnee, Joint::LAnkle)] {
                pose.joints[hip as usize - 1] = exp(&Vector3::new(-bend, 0.0, 0.0));
                pose.joints[knee as usize - 1] = exp(&Vector3::new(2.0 * bend, 0.0, 0.0));
                pose.joints[ankle as usize - 1] = exp(&Vector3::new(-bend, 0.0, 0.0));
            }
            pose
        });
        Clip { fps: FPS, poses: poses.collect(), offsets, hip_height_m: H }
    }

    #[test]
    fn finds_a_jumps_events_and_length() {
        let clip = jumper();
        let track = Track::new(&clip, 0..clip.poses.len());
        let events = key_events(&track, flights(&track)[0].clone());
        for (found, known_s) in [(events.start, 0.5), (events.take_off, 0.9), (events.landing, 1.4), (events.end, 2.0)] {
            assert!((found as f64 / FPS - known_s).abs() < 0.06, "{events:?}");
        }
        let jump = &segment(&clip, &Label { activity: Activity::Jumping, ..label(None) }).unwrap().cycles[0];
        assert!((jump.parameter - 0.9).abs() < 1e-3, "{}", jump.parameter);
        let (first, last) = (&jump.root[0], &jump.root[SAMPLES - 1]);
        assert!(first.position.z.abs() < 1e-9 && (last.position.z * H - 0.9).abs() < 1e-3);
        assert!(last.position.x.abs() < 1e-9 && last.rotation.norm() < 1e-9);
        let rise = jump.root.iter().map(|s| s.position.y).fold(f64::MIN, f64::max) - first.position.y;
        assert!((rise * H - 9.81 * 0.25 / 8.0).abs() < 0.01, "{rise}");
    }
}

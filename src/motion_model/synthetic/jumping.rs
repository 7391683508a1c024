//! Parametric standing long jump: own curves with key events, legs by two-bone geometry.
//!
//! Events at fixed phases u: start, lowest point of the counter-movement, take-off, landing, lowest point after it, end.
//! Between them the root moves along cubics of continuous speed, in flight along a parabola under g. With length D, hip
//! height H and d = D/H: the root rises h = 0.07 H + 0.10 D after take-off, which gives the vertical speed √(2gh);
//! it leaves the toes `lead` ahead of the heels' mark and lands `lag` behind it, so that its range is D − lead − lag and
//! the feet, as the whole body, travel D. The feet are planted before and after, the heels rise in push-off and touch
//! first in landing, the legs follow from root and feet. Pelvis, trunk and arms are curves through the events.
//! Durations come from speeds and distances; those of the counter-movement and the recovery scale with √H.
//! Fails above about 2 m, where the legs are too short for the landing. Checked: gravity and range of the flight, feet on
//! the floor before and after.

use nalgebra::{Vector2, Vector3};

use super::posture::{Angles, FOOT_LENGTH, SoleAtOrigin, above_zero, sole_at_origin};
use super::variation::{Channel, TRACKS, Tracks, normal, phase};
use super::{GRAVITY, SyntheticSubject};
use crate::body::Joint;
use crate::math::curves::{Pchip, hermite, smooth_step};
use crate::math::rotation::log;
use crate::motion_model::cycle::{RootSample, SAMPLES};

/// d of the middle length of the database, about which a subject's own slope over length turns.
pub(super) const REFERENCE: f64 = 0.9;
/// Phases u of the events.
const LOWEST: f64 = 0.32;
const TAKE_OFF: f64 = 0.46;
const LANDING: f64 = 0.62;
const CAUGHT: f64 = 0.74;
/// Pitch of the feet at take-off and touch-down, radians.
const TOE_OFF_PITCH: f64 = -1.05;
const TOUCH_DOWN_PITCH: f64 = 0.20;
/// How far the toes bend, as in walking.
const TOE_LIMIT: f64 = 0.6;
/// Longest reach of a leg over the sum of its bones: nearer to 1 the knee snaps straight.
const LONGEST_REACH: f64 = 0.998;

/// What differs between jumpers besides their angles; factors on the population's values.
#[derive(Clone, Debug)]
pub(super) struct Habit {
    depth: f64,
    rise: f64,
    lead: f64,
    give: f64,
    pace: f64,
    tuck: f64,
    /// Feet apart, and left foot before the right one, in units of H.
    width: f64,
    stagger: f64,
}

impl Habit {
    pub(super) fn neutral() -> Habit {
        Habit { depth: 1.0, rise: 1.0, lead: 1.0, give: 1.0, pace: 1.0, tuck: 1.0, width: 0.20, stagger: 0.0 }
    }

    /// `spread` 1 for a person, less for one jump of a person.
    pub(super) fn varied(&self, spread: f64, rng: &mut rand_chacha::ChaCha12Rng) -> Habit {
        let mut factor = |sd: f64| (1.0 + spread * sd * normal(rng)).clamp(0.6, 1.5);
        Habit {
            depth: self.depth * factor(0.15),
            rise: self.rise * factor(0.10),
            lead: self.lead * factor(0.12),
            give: self.give * factor(0.15),
            pace: self.pace * factor(0.08),
            tuck: self.tuck * factor(0.20),
            width: self.width * factor(0.20),
            stagger: self.stagger + 0.02 * spread * normal(rng),
        }
    }
}

/// Population angle in degrees at phase u for relative length d.
pub(super) fn population(channel: Channel, u: f64, d: f64) -> f64 {
    let keys = |[start, lowest, off, flight, landing, caught, end]: [f64; 7]| {
        let middle = 0.5 * (TAKE_OFF + LANDING);
        let points =
            [(0.04, start), (LOWEST, lowest), (TAKE_OFF, off), (middle, flight), (LANDING, landing), (CAUGHT, caught), (0.96, end)];
        Pchip::open(&points).at(u)
    };
    match channel {
        Channel::Tilt => keys([2.0, 22.0 + 14.0 * d, 8.0, 8.0, 14.0 + 4.0 * d, 26.0 + 8.0 * d, 2.0]),
        Channel::Lean => keys([3.0, 38.0 + 14.0 * d, 14.0, 14.0, 22.0 + 6.0 * d, 40.0 + 8.0 * d, 3.0]),
        Channel::Shoulder => arm_swing(u, d),
        Channel::ShoulderAbduction => keys([7.0, 16.0, 12.0, 18.0, 22.0, 18.0, 7.0]),
        Channel::Elbow => keys([12.0, 20.0, 30.0, 38.0, 32.0, 28.0, 12.0]),
        Channel::HipRotation => -6.0,
        _ => 0.0,
    }
}

/// Arms go back while the body sinks, and swing up through take-off.
fn arm_swing(u: f64, d: f64) -> f64 {
    let back = -22.0 - 12.0 * d;
    let up = 95.0 + 25.0 * d;
    let points = [
        (0.03, 0.0),
        (0.10, 15.0),
        (0.27, back),
        (TAKE_OFF, 0.85 * up),
        (0.52, up),
        (LANDING, 55.0),
        (CAUGHT, 25.0),
        (0.85, -8.0),
        (0.96, 0.0),
    ];
    Pchip::open(&points).at(u)
}

/// Distances and times of one jump, metres and seconds.
struct Flight {
    length: f64,
    lead: f64,
    lag: f64,
    lowest: f64,
    take_off: f64,
    landing: f64,
    caught: f64,
    up_speed: f64,
    down_speed: f64,
    forward_speed: f64,
    /// Times of lowest, take-off, landing, caught, end.
    times: [f64; 5],
}

/// Heights are the root's against standing.
fn flight(subject: &SyntheticSubject, habit: &Habit, length: f64) -> Flight {
    let h = subject.hip_height_m;
    let lowest = -habit.depth * (0.15 * h + 0.07 * length);
    let take_off = 0.07 * h;
    let landing = -habit.give * (0.04 * h + 0.07 * length);
    let caught = landing - habit.give * (0.14 * h + 0.07 * length);
    let lead = habit.lead * (0.12 * h + 0.10 * length);
    let lag = habit.lead * (0.02 * h + 0.10 * length);
    let up_speed = (2.0 * GRAVITY * habit.rise * (0.07 * h + 0.10 * length)).sqrt();
    let down_speed = (up_speed * up_speed + 2.0 * GRAVITY * (take_off - landing)).sqrt();
    let flight_s = (up_speed + down_speed) / GRAVITY;
    let slow = habit.pace * h.sqrt();
    // A cubic that starts at rest and ends with speed v covers s without turning back in up to 3 s/v; landing likewise.
    let push_s = 1.8 * (take_off - lowest) / up_speed;
    let catch_s = 2.6 * (landing - caught) / down_speed;
    let lowest_s = 0.75 * slow;
    let off_s = lowest_s + push_s;
    let times = [lowest_s, off_s, off_s + flight_s, off_s + flight_s + catch_s, off_s + flight_s + catch_s + 0.85 * slow];
    let forward_speed = (length - lead - lag).max(0.0) / flight_s;
    Flight { length, lead, lag, lowest, take_off, landing, caught, up_speed, down_speed, forward_speed, times }
}

impl Flight {
    /// Root ahead of the start and above standing at time `s`.
    fn root(&self, s: f64) -> (f64, f64) {
        let [low, off, land, caught, end] = self.times;
        let start = 0.15 * low;
        let rest = caught + 0.85 * (end - caught);
        let touch = self.length - self.lag;
        // Long enough not to overshoot: see the cubics' limit above.
        let arrived = land + 2.5 * self.lag / self.forward_speed.max(0.3);
        let shift = 0.25 * self.lead;
        let ahead = match s {
            _ if s < low => shift * smooth_step(start, low, s),
            _ if s < off => hermite(&[low, shift, 0.0], &[off, self.lead, self.forward_speed], s),
            _ if s < land => self.lead + self.forward_speed * (s - off),
            _ => hermite(&[land, touch, self.forward_speed], &[arrived, self.length, 0.0], s.min(arrived)),
        };
        let up = match s {
            _ if s < low => self.lowest * smooth_step(start, low, s),
            _ if s < off => hermite(&[low, self.lowest, 0.0], &[off, self.take_off, self.up_speed], s),
            _ if s < land => self.take_off + (s - off) * (self.up_speed - 0.5 * GRAVITY * (s - off)),
            _ if s < caught => hermite(&[land, self.landing, -self.down_speed], &[caught, self.caught, 0.0], s),
            _ => self.caught * (1.0 - smooth_step(caught, rest, s)),
        };
        (ahead, up)
    }

    /// Event phase at time `s`.
    fn phase(&self, s: f64) -> f64 {
        let [low, off, land, caught, end] = self.times;
        let points = [(0.0, 0.0), (low, LOWEST), (off, TAKE_OFF), (land, LANDING), (caught, CAUGHT), (end, 1.0)];
        let right = points.iter().position(|p| p.0 >= s).unwrap_or(points.len() - 1).max(1);
        let (a, b) = (points[right - 1], points[right]);
        a.1 + (b.1 - a.1) * (s - a.0) / (b.0 - a.0)
    }

    /// Ankle (height, ahead of the start's ankle), pitch and toe bend of a foot at time `s`.
    fn foot(&self, subject: &SyntheticSubject, tuck: f64, s: f64) -> (Vector2<f64>, f64, f64) {
        let [low, off, land, _, _] = self.times;
        let planted = |pitch: f64, moved: f64| {
            let toe_bend = (-pitch).clamp(0.0, TOE_LIMIT);
            let SoleAtOrigin { lowest, heel_z, toe_z } = sole_at_origin(pitch, toe_bend, subject.stature_m);
            let ankle_back = (FOOT_LENGTH - super::posture::HEEL_BACK) * subject.stature_m;
            // The toe tip stays on its mark, or the heel while the toes are up.
            let ahead = if pitch > 0.0 { -super::posture::HEEL_BACK * subject.stature_m - heel_z } else { ankle_back - toe_z };
            (Vector2::new(-lowest, moved + ahead), pitch, toe_bend)
        };
        if s < off {
            return planted(TOE_OFF_PITCH * smooth_step(low + 0.35 * (off - low), off + 0.1 * (off - low), s) / toe_off_reached(), 0.0);
        }
        if s >= land {
            return planted(TOUCH_DOWN_PITCH * (1.0 - smooth_step(land, land + 0.08, s)), self.length);
        }
        let (from, to) = (self.foot(subject, tuck, off - 1e-9), self.foot(subject, tuck, land));
        let t = (s - off) / (land - off);
        let w = smooth_step(-0.1, 1.0, t).max(0.0);
        let w0 = smooth_step(-0.1, 1.0, 0.0);
        let w = (w - w0) / (1.0 - w0);
        let lift = tuck * (0.06 * subject.hip_height_m + 0.12 * self.length) * (std::f64::consts::PI * t).sin().powi(2);
        let pitch = from.1 + (to.1 - from.1) * smooth_step(0.1, 0.95, t);
        (from.0.lerp(&to.0, w) + Vector2::new(lift, 0.0), pitch, from.2 * (1.0 - smooth_step(0.0, 0.4, t)))
    }
}

fn toe_off_reached() -> f64 {
    smooth_step(0.35, 1.1, 1.0)
}

/// Postures, root and duration of one jump; `tracks` over the event phase.
pub(super) fn jump(subject: &SyntheticSubject, tracks: &Tracks, habit: &Habit, length: f64) -> (Vec<Angles>, Vec<RootSample>, f64) {
    let flight = flight(subject, habit, length);
    let duration_s = flight.times[4];
    let h = subject.hip_height_m;
    let at = |i: usize| {
        let s = phase(i) * duration_s;
        let (ahead, up) = flight.root(s);
        let root = Vector3::new(0.0, subject.offsets[Joint::Root as usize].y + up, ahead);
        let mut angles = Angles::from_tracks(&between(tracks, flight.phase(s)), &subject.offsets);
        for side in 0..2 {
            angles.sides[side].shoulder = angles.sides[side].shoulder.clamp(-1.3, 2.9);
            let foot = flight.foot(subject, habit.tuck, s);
            step_into(subject, &mut angles, side, &root, foot, habit);
        }
        let rotation = log(&angles.carrier_from_root());
        let position = Vector3::new(0.0, root.y / h - 1.0, root.z / h);
        (angles, RootSample { rotation, position })
    };
    let (angles, root) = (0..SAMPLES).map(at).unzip();
    (angles, root, duration_s)
}

/// Hip, knee and ankle of one side that put the ankle and the foot's pitch where `foot` says.
fn step_into(
    subject: &SyntheticSubject,
    angles: &mut Angles,
    side: usize,
    root: &Vector3<f64>,
    foot: (Vector2<f64>, f64, f64),
    habit: &Habit,
) {
    let (ankle, pitch, toe) = foot;
    let sign = if side == 0 { 1.0 } else { -1.0 };
    let hip = root + angles.sides[side].hip;
    let (thigh, shank) = (-subject.offsets[Joint::LKnee as usize].y, -subject.offsets[Joint::LAnkle as usize].y);
    let down = hip.y - ankle.x;
    let ahead = ankle.y + 0.5 * sign * habit.stagger * subject.hip_height_m - hip.z;
    let lateral = (0.5 * sign * habit.width * subject.hip_height_m - hip.x).atan2(down);
    let down = down / lateral.cos();
    let longest = LONGEST_REACH * (thigh + shank);
    let reach = longest - above_zero(longest - down.hypot(ahead).max(0.3 * longest), 0.02 * longest);
    let knee = ((reach * reach - thigh * thigh - shank * shank) / (2.0 * thigh * shank)).acos();
    let thigh_angle = ahead.atan2(down) + (shank * knee.sin()).atan2(thigh + shank * knee.cos());
    let leg = &mut angles.sides[side];
    leg.leg_lateral = lateral;
    leg.hip_flexion = thigh_angle + angles.tilt;
    leg.knee = knee;
    leg.ankle = pitch - thigh_angle + knee;
    leg.toe = toe;
}

/// Tracks at event phase `u`, linearly between samples, constant beyond the last.
fn between(tracks: &Tracks, u: f64) -> [f64; TRACKS] {
    let x = (u * SAMPLES as f64).clamp(0.0, (SAMPLES - 1) as f64);
    let i = (x as usize).min(SAMPLES - 2);
    let w = x - i as f64;
    std::array::from_fn(|k| tracks[i][k] * (1.0 - w) + tracks[i + 1][k] * w)
}

/// Times of take-off, landing and end of a subject's mean jump, seconds.
#[cfg(test)]
pub(super) fn events(subject: &SyntheticSubject, length: f64) -> [f64; 3] {
    let flight = flight(subject, &subject.habit, length);
    [flight.times[1], flight.times[2], flight.times[4]]
}

//! When a foot of a motion stands on the floor, and how it slides while it does.
//!
//! A sole is its heel, ball and toe tip p_i. What touches is the lowest of them, softly: w_i ∝ exp(−(y_i − y_min)/σ), so a
//! foot that rolls from heel to toe stands still at each moment where it touches, and the slide from one frame to the next is
//!   s = Σ_i w_i Δp_i                                                                                               (1)
//! Recorded feet are tilted against the template's by unknown angles: each point is moved along its foot's vertical so that
//! it is on the floor in the median of those frames in which it is slow. Who is under the floor is on it.
//! A foot stands where its lowest point is near the floor and (1) is slow against the person's travel.
//! Fails when: a sole is dragged over the floor as fast as the person goes; that is no stance.
//! Checked against soles that slide at known speeds and the durations of stance that are published for walking and running.

use std::ops::Range;

use nalgebra::Vector3;

use crate::body::{Clip, Joint, Placement};
use crate::math::order::quantile;

/// σ of the weights, metres. Smaller hands over from heel to ball within a frame, larger lets lifted heels count.
const TOUCH_M: f64 = 0.006;
/// A point this little over the lowest touches, metres.
const TOUCHES_M: f64 = 0.002;
/// Height over the floor, in hip heights: toes swing through little higher.
const NEAR: f64 = 0.025;
/// Speed of a standing sole: a part of the person's travel, and m/s on top. More takes feet that still land for standing.
const SLOW: (f64, f64) = (0.12, 0.1);
/// Gaps that are closed and contacts that are dropped as too short, seconds.
const GAP_S: f64 = 0.04;
const SHORTEST_S: f64 = 0.06;
/// Fewer slow frames say nothing about a point's height.
const FEW: usize = 5;
/// The person's speed is taken over this time, seconds.
const TRAVEL_S: f64 = 0.5;

/// A foot over the frames of a clip.
#[derive(Clone, Debug)]
pub struct FootTrack {
    pub ankle: Joint,
    pub ankles: Vec<Vector3<f64>>,
    /// Heel, ball and toe tip, see [`Clip::sole_points`], on the floor while they rest.
    pub soles: Vec<[Vector3<f64>; 3]>,
    /// How far they were moved down for that, metres.
    down_m: [f64; 3],
}

impl FootTrack {
    /// Of the foot of `ankle`, LAnkle or RAnkle.
    pub fn new(clip: &Clip, ankle: Joint) -> FootTrack {
        let mut track = FootTrack { ankle, ankles: Vec::new(), soles: Vec::new(), down_m: [0.0; 3] };
        let placed: Vec<Placement> = clip.poses.iter().map(|pose| clip.place(pose)).collect();
        track.ankles = placed.iter().map(|p| p.position(ankle)).collect();
        track.soles = placed.iter().map(|p| track.sole(clip, p)).collect();
        track.down_m = std::array::from_fn(|point| track.resting_height_m(clip, point));
        track.soles = placed.iter().map(|p| track.sole(clip, p)).collect();
        track
    }

    /// Heel, ball and toe tip of any pose, as in `soles`.
    pub fn sole(&self, clip: &Clip, placed: &Placement) -> [Vector3<f64>; 3] {
        let ball = if self.ankle == Joint::LAnkle { Joint::LMidtarsal } else { Joint::RMidtarsal };
        let up = [self.ankle, ball, ball].map(|joint| placed.world_from_node[joint as usize] * Vector3::y());
        let points = clip.sole_points(placed, self.ankle);
        std::array::from_fn(|i| points[i] - up[i] * self.down_m[i])
    }

    /// Median height of a point of the sole while it is slow; 0 where it hardly is.
    fn resting_height_m(&self, clip: &Clip, point: usize) -> f64 {
        let slow = |frame: usize| {
            let step = self.soles[frame + 1][point] - self.soles[frame][point];
            step.xz().norm() * clip.fps < slow_m_s(clip, frame)
        };
        let heights: Vec<f64> = (0..self.soles.len().saturating_sub(1)).filter(|k| slow(*k)).map(|k| self.soles[k][point].y).collect();
        if heights.len() < FEW { 0.0 } else { quantile(heights, 0.5).unwrap_or(0.0) }
    }

    /// Slide (1) from `frame` to the next, metres.
    pub fn slide(&self, frame: usize) -> Vector3<f64> {
        let (here, there) = (&self.soles[frame], &self.soles[frame + 1]);
        let (u, v) = (weights(here), weights(there));
        (0..3).map(|i| (there[i] - here[i]) * (0.5 * (u[i] + v[i]))).sum()
    }

    /// How far a point of the sole goes from where it touched first, while it is within 2 mm of the lowest; the largest
    /// over the frames of a contact, metres.
    pub fn drift_m(&self, contact: Range<usize>) -> f64 {
        let mut first: [Option<Vector3<f64>>; 3] = [None; 3];
        let mut largest: f64 = 0.0;
        for sole in &self.soles[contact] {
            let lowest = lowest_m(&heights_m(sole));
            for (first, p) in first.iter_mut().zip(sole) {
                *first = (p.y < lowest + TOUCHES_M).then(|| first.unwrap_or(*p));
                largest = largest.max(first.map_or(0.0, |f| (p - f).xz().norm()));
            }
        }
        largest
    }

    /// Frames in which the foot stands.
    pub fn contacts(&self, clip: &Clip) -> Vec<Range<usize>> {
        let frames = self.soles.len();
        if frames < 2 {
            return Vec::new();
        }
        let stands = |frame: usize| {
            let lowest = lowest_m(&heights_m(&self.soles[frame]));
            let speed = self.slide(frame.min(frames - 2)).xz().norm() * clip.fps;
            lowest < NEAR * clip.hip_height_m && speed < slow_m_s(clip, frame)
        };
        tidy((0..frames).map(stands).collect(), clip.fps)
    }
}

fn heights_m(sole: &[Vector3<f64>; 3]) -> [f64; 3] {
    sole.map(|p| p.y)
}

/// Height of the lowest point of a sole; the floor's if it is under that.
pub fn lowest_m(heights_m: &[f64; 3]) -> f64 {
    heights_m.iter().map(|y| y.max(0.0)).fold(f64::INFINITY, f64::min)
}

/// Weights w_i of the points of a sole.
fn weights(sole: &[Vector3<f64>; 3]) -> [f64; 3] {
    let lowest = lowest_m(&heights_m(sole));
    let raw = sole.map(|p| (-(p.y.max(0.0) - lowest) / TOUCH_M).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|w| w / sum)
}

/// Below which a sole stands: from the speed of the root over the floor around a frame.
fn slow_m_s(clip: &Clip, frame: usize) -> f64 {
    let half = (0.5 * TRAVEL_S * clip.fps) as usize + 1;
    let (from, to) = (frame.saturating_sub(half), (frame + half).min(clip.poses.len() - 1));
    let travel = (clip.poses[to].root - clip.poses[from].root).xz().norm() * clip.fps / (to - from).max(1) as f64;
    SLOW.0 * travel + SLOW.1
}

/// Runs of frames, short gaps closed, then short runs dropped.
fn tidy(mut stands: Vec<bool>, fps: f64) -> Vec<Range<usize>> {
    let gap = (GAP_S * fps).ceil() as usize;
    let shortest = (SHORTEST_S * fps).ceil() as usize;
    let closed: Vec<Range<usize>> = runs(&stands, false).into_iter().filter(|r| r.start > 0 && r.end < stands.len()).collect();
    closed.into_iter().filter(|r| r.len() <= gap).for_each(|r| stands[r].fill(true));
    runs(&stands, true).into_iter().filter(|r| r.len() >= shortest).collect()
}

fn runs(flags: &[bool], wanted: bool) -> Vec<Range<usize>> {
    let mut found: Vec<Range<usize>> = Vec::new();
    for i in (0..flags.len()).filter(|i| flags[*i] == wanted) {
        match found.last_mut() {
            Some(last) if last.end == i => last.end = i + 1,
            _ => found.push(i..i + 1),
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, Shape};
    use crate::motion::{Length, play_cycle};
    use crate::motion_model::{Activity, synthetic};

    #[test]
    fn a_sole_that_slides_slowly_stands_and_a_fast_one_does_not() {
        let shape = Shape::template(1.7);
        let offsets = shape.offsets();
        // A second at 0.05 m/s, then one at 1 m/s.
        let way = |t: f64| if t < 1.0 { 0.05 * t } else { 0.05 + (t - 1.0) };
        let poses = (0..=200).map(|k| Pose::rest(offsets[0] + Vector3::new(0.0, 0.0, way(f64::from(k) / 100.0)))).collect();
        let clip = Clip { fps: 100.0, poses, offsets, hip_height_m: shape.hip_height_m() };
        let foot = FootTrack::new(&clip, Joint::RAnkle);
        assert!((foot.slide(50) - Vector3::new(0.0, 0.0, 5e-4)).norm() < 1e-12);
        let contacts = foot.contacts(&clip);
        assert!(contacts.len() == 1 && contacts[0] == (0..100), "{contacts:?}");
        assert!((foot.drift_m(0..100) - 0.05 * 0.99).abs() < 1e-12);
    }

    #[test]
    fn stance_lasts_as_long_as_published() {
        // Stance of walking at a free speed is 58 to 62 % of the cycle, of running at 3 m/s 30 to 40 %; a foot counts as standing
        // a little less, as it lands and leaves with some speed.
        for (activity, speed, duty) in [(Activity::Walking, 1.2, 0.48..0.66), (Activity::Running, 3.0, 0.2..0.42)] {
            let subject = synthetic::subject(activity, 7);
            let cycle = subject.mean_cycle(speed);
            let clip = play_cycle(&cycle, &subject.shape().offsets(), 120.0, Length::Cycles(6));
            for ankle in [Joint::LAnkle, Joint::RAnkle] {
                let contacts = FootTrack::new(&clip, ankle).contacts(&clip);
                let share = contacts.iter().map(Range::len).sum::<usize>() as f64 / clip.poses.len() as f64;
                assert!((6..=7).contains(&contacts.len()) && duty.contains(&share), "{activity}: {contacts:?} {share}");
            }
        }
    }
}

//! Speed, bend of the path and manner over time, and the clip of a person who follows them.
//!
//! Speeds run straight between the given times. The player follows a ramp late by a fixed time; it is given what comes that
//! much later, so ramps are followed without delay and only their corners are rounded.

use super::player::{Eased, Gaits, Player, RESPONSE_S};
use crate::body::{Clip, NODES, Pose};
use nalgebra::Vector3;

/// The player's delay behind a ramp.
const DELAY_S: f64 = 2.0 * RESPONSE_S;

/// What is wanted at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    pub time_s: f64,
    pub speed_m_s: f64,
    /// Curvature of the path, 1/m, positive to the left.
    pub curvature: f64,
}

/// Speed and curvature over time, and the amounts of changes.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    waypoints: Vec<Waypoint>,
    amounts: Vec<Course>,
}

/// A number over time, straight between its points, the ends held.
#[derive(Clone, Debug, PartialEq)]
pub struct Course(Vec<(f64, f64)>);

impl Course {
    /// From (seconds, value) in order of time, at least one.
    pub fn new(points: Vec<(f64, f64)>) -> Result<Course, ProfileError> {
        if let Some(w) = points.windows(2).find(|w| w[1].0 <= w[0].0) {
            return Err(ProfileError::Backwards(w[1].0, w[0].0));
        }
        if points.is_empty() || points.iter().any(|p| !(p.0.is_finite() && p.1.is_finite())) {
            return Err(ProfileError::Empty);
        }
        Ok(Course(points))
    }

    /// The value at a time.
    pub fn at(&self, time_s: f64) -> f64 {
        let after = self.0.partition_point(|p| p.0 <= time_s);
        if after == 0 || after == self.0.len() {
            return self.0[after.saturating_sub(1)].1;
        }
        let (a, b) = (self.0[after - 1], self.0[after]);
        a.1 + (b.1 - a.1) * (time_s - a.0) / (b.0 - a.0)
    }
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum ProfileError {
    #[error("a speed profile needs at least two times, this has {0}")]
    TooFew(usize),
    #[error("the times of a speed profile must increase from 0, and {0} s follows {1} s")]
    Order(f64, f64),
    #[error("the speed at {time_s} s is {speed_m_s} m/s; speeds must be finite and not negative")]
    Speed { time_s: f64, speed_m_s: f64 },
    #[error("the bend at {time_s} s is not a finite number")]
    Bend { time_s: f64 },
    #[error("times must increase, and {0} s follows {1} s")]
    Backwards(f64, f64),
    #[error("a value over time needs at least one finite number")]
    Empty,
}

/// Where the player was in one frame of a clip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    pub time_s: f64,
    pub wanted_m_s: f64,
    pub speed_m_s: f64,
    /// Direction of the path: angle about +y from +z.
    pub heading: f64,
    /// Inward lean, positive to the left.
    pub lean: f64,
    /// Share of running, 0 to 1.
    pub running: f64,
    pub phase: f64,
}

impl Profile {
    /// From waypoints in order of time, the first at time 0.
    pub fn new(waypoints: Vec<Waypoint>) -> Result<Profile, ProfileError> {
        if waypoints.len() < 2 {
            return Err(ProfileError::TooFew(waypoints.len()));
        }
        let mut before = f64::NEG_INFINITY;
        for w in &waypoints {
            if !(w.time_s > before && w.time_s.is_finite()) || (before == f64::NEG_INFINITY && w.time_s != 0.0) {
                return Err(ProfileError::Order(w.time_s, before.max(0.0)));
            }
            if !(w.speed_m_s >= 0.0 && w.speed_m_s.is_finite()) {
                return Err(ProfileError::Speed { time_s: w.time_s, speed_m_s: w.speed_m_s });
            }
            if !w.curvature.is_finite() {
                return Err(ProfileError::Bend { time_s: w.time_s });
            }
            before = w.time_s;
        }
        Ok(Profile { waypoints, amounts: Vec::new() })
    }

    /// With amounts of the gaits' changes over time, in their order (see [`Gait::add_change`](super::Gait::add_change)).
    pub fn with_amounts(self, amounts: Vec<Course>) -> Profile {
        Profile { amounts, ..self }
    }

    /// One speed and bend for `seconds`.
    pub fn steady(speed_m_s: f64, curvature: f64, seconds: f64) -> Result<Profile, ProfileError> {
        Profile::new(vec![Waypoint { time_s: 0.0, speed_m_s, curvature }, Waypoint { time_s: seconds, speed_m_s, curvature }])
    }

    pub fn seconds(&self) -> f64 {
        self.waypoints[self.waypoints.len() - 1].time_s
    }

    pub fn mean_m_s(&self) -> f64 {
        let way = |w: &[Waypoint]| 0.5 * (w[0].speed_m_s + w[1].speed_m_s) * (w[1].time_s - w[0].time_s);
        self.waypoints.windows(2).map(way).sum::<f64>() / self.seconds()
    }

    pub fn fastest_m_s(&self) -> f64 {
        self.waypoints.iter().map(|w| w.speed_m_s).fold(0.0, f64::max)
    }

    /// Steepest change of speed, m/s².
    pub fn steepest_m_s2(&self) -> f64 {
        self.waypoints.windows(2).map(|w| ((w[1].speed_m_s - w[0].speed_m_s) / (w[1].time_s - w[0].time_s)).abs()).fold(0.0, f64::max)
    }

    /// Speed and curvature at a time, the ends held.
    pub fn at(&self, time_s: f64) -> (f64, f64) {
        let after = self.waypoints.partition_point(|w| w.time_s <= time_s).clamp(1, self.waypoints.len() - 1);
        let (a, b) = (&self.waypoints[after - 1], &self.waypoints[after]);
        let part = ((time_s - a.time_s) / (b.time_s - a.time_s)).clamp(0.0, 1.0);
        (a.speed_m_s + part * (b.speed_m_s - a.speed_m_s), a.curvature + part * (b.curvature - a.curvature))
    }
}

/// Plays `gaits` along `profile`; the steps are one per frame.
pub fn follow(gaits: &Gaits, profile: &Profile, offsets: &[Vector3<f64>; NODES], fps: f64) -> (Clip, Vec<Step>) {
    let (speed, curvature) = profile.at(0.0);
    let mut player = Player::new(gaits, speed, curvature);
    for (amount, course) in player.amounts.iter_mut().zip(&profile.amounts) {
        *amount = Eased::at(course.at(0.0));
    }
    let frames = (profile.seconds() * fps).round() as usize + 1;
    let (mut poses, mut steps): (Vec<Pose>, Vec<Step>) = (Vec::with_capacity(frames), Vec::with_capacity(frames));
    for frame in 0..frames {
        let time_s = frame as f64 / fps;
        if frame > 0 {
            let soon_s = time_s - 0.5 / fps + DELAY_S;
            (player.target_speed_m_s, player.target_curvature) = profile.at(soon_s);
            player.amounts.iter_mut().zip(&profile.amounts).for_each(|(amount, course)| amount.target = course.at(soon_s));
            player.next(1.0 / fps);
        }
        poses.push(player.pose());
        steps.push(Step {
            time_s,
            wanted_m_s: profile.at(time_s).0,
            speed_m_s: player.speed_m_s(),
            heading: player.heading(),
            lean: player.lean(),
            running: player.running(),
            phase: player.phase(),
        });
    }
    (Clip { fps, poses, offsets: *offsets, hip_height_m: gaits.slow.hip_height_m }, steps)
}

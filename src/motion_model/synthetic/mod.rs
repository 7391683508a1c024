//! The embedded synthetic database: people who never lived, walking, running and jumping.
//!
//! Shape of the paper's recordings (style paper §3): 9 people at 9 speeds, 5 at 7, 4 at 3 lengths, 4 cycles each. The same
//! bytes at every call. Everything made from it must be labelled synthetic.

mod ground;
mod jumping;
mod posture;
mod running;
mod stride;
mod variation;
mod walking;

use nalgebra::Vector3;
use rayon::prelude::*;

use self::jumping::Habit;
use self::posture::Angles;
use self::variation::{Style, Tracks, add_cycle_noise, cycle_rng, normal, subject_rng, uniform};
use super::cycle::{Activity, Cycle, RootSample};
use crate::body::{Joint, Length, NODES, Shape};

pub(super) const GRAVITY: f64 = 9.81;

/// One synthetic person with a way of doing one activity.
#[derive(Clone, Debug)]
pub struct SyntheticSubject {
    /// `synthetic_1`, … : the number is the seed, and the same number is the same body in all activities.
    pub name: String,
    pub activity: Activity,
    pub stature_m: f64,
    pub hip_height_m: f64,
    seed: u64,
    style: Style,
    /// Own cadence over the population's.
    tempo: f64,
    /// Distance between the tracks of the feet in walking, in units of H.
    step_width: f64,
    habit: Habit,
    offsets: [Vector3<f64>; NODES],
}

/// The synthetic person number `seed`; the database holds 1 to 9 (walking), 5 (running) or 4 (jumping).
pub fn subject(activity: Activity, seed: u64) -> SyntheticSubject {
    let mut body = subject_rng(seed, None);
    let stature_m = 1.55 + 0.35 * uniform(&mut body);
    let hip_height_m = 0.53 * stature_m * (1.0 + 0.02 * normal(&mut body));
    let step_width = 0.12 * (1.0 + 0.3 * normal(&mut body)).clamp(0.3, 1.8);
    let mut rng = subject_rng(seed, Some(activity));
    let tempo = 1.0 + 0.04 * normal(&mut rng);
    let habit = Habit::neutral();
    let shape = shape(stature_m, hip_height_m);
    SyntheticSubject {
        name: format!("synthetic_{seed}"),
        activity,
        stature_m,
        hip_height_m,
        seed,
        style: if seed == 0 { Style::neutral() } else { Style::draw(&mut rng) },
        habit: if seed == 0 { habit } else { habit.varied(1.0, &mut rng) },
        tempo,
        step_width,
        offsets: shape.offsets(),
    }
}

fn shape(stature_m: f64, hip_height_m: f64) -> Shape {
    let mut shape = Shape::template(stature_m);
    let ankle = Joint::LAnkle.rest_position().y;
    let leg = (hip_height_m / stature_m - ankle) / (Joint::LHip.rest_position().y - ankle);
    shape.lengths[Length::Thigh as usize] = leg;
    shape.lengths[Length::Shank as usize] = leg;
    shape
}

impl SyntheticSubject {
    /// The body: the template with legs of this person's hip height.
    pub fn shape(&self) -> Shape {
        shape(self.stature_m, self.hip_height_m)
    }

    /// One recorded cycle: the subject's motion at `parameter` (m/s, for jumps m) with the variation of one cycle.
    pub fn cycle(&self, parameter: f64, repeat: u32) -> Cycle {
        self.make(parameter, &self.tracks(parameter), Some(repeat))
    }

    /// The subject's true motion at `parameter`, without the variation from cycle to cycle.
    pub fn mean_cycle(&self, parameter: f64) -> Cycle {
        self.make(parameter, &self.tracks(parameter), None)
    }

    fn cycles(&self, parameter: f64) -> Vec<Cycle> {
        let tracks = self.tracks(parameter);
        (0..REPEATS).map(|repeat| self.make(parameter, &tracks, Some(repeat))).collect()
    }

    /// The subject's own curves at a parameter. Speed and length count in hip heights.
    fn tracks(&self, parameter: f64) -> Tracks {
        let relative = parameter / self.hip_height_m;
        match self.activity {
            Activity::Walking => self.style.tracks(relative, walking::REFERENCE_RV, true, walking::population),
            Activity::Running => self.style.tracks(relative, running::REFERENCE_RV, true, running::population),
            Activity::Jumping => self.style.tracks(relative, jumping::REFERENCE, false, jumping::population),
        }
    }

    fn sole(&self, angles: &Angles, side: usize) -> posture::Sole {
        angles.sole(side, &self.offsets, self.stature_m)
    }

    fn make(&self, parameter: f64, tracks: &Tracks, repeat: Option<u32>) -> Cycle {
        let mut tracks = tracks.clone();
        let mut rng = repeat.map(|r| cycle_rng(self.seed, self.activity, parameter, r));
        if let Some(rng) = &mut rng {
            add_cycle_noise(&mut tracks, rng);
        }
        let (angles, root, duration_s) = match self.activity {
            Activity::Jumping => {
                let habit = rng.map_or(self.habit.clone(), |mut rng| self.habit.varied(0.25, &mut rng));
                jumping::jump(self, &tracks, &habit, parameter)
            }
            _ => self.stride(&tracks, parameter, rng.map_or(1.0, |mut rng| 1.0 + 0.01 * normal(&mut rng))),
        };
        Cycle {
            subject: self.name.clone(),
            source: format!("synthetic, {}", repeat.map_or("mean cycle".into(), |r| format!("cycle {}", r + 1))),
            activity: self.activity,
            parameter,
            hip_height_m: self.hip_height_m,
            duration_s,
            joints: angles.iter().map(|a| a.joints()).collect(),
            root,
        }
    }

    /// One walking or running cycle, `longer` times the subject's usual duration.
    fn stride(&self, tracks: &Tracks, speed: f64, longer: f64) -> (Vec<Angles>, Vec<RootSample>, f64) {
        let rv = speed / self.hip_height_m;
        let gait = if self.activity == Activity::Running {
            running::gait(speed, rv, longer / (self.tempo * running::frequency_hz(rv)))
        } else {
            walking::gait(speed, rv, longer / (self.tempo * walking::frequency_hz(rv)))
        };
        let (angles, root) = stride::cycle(self, tracks, &gait);
        (angles, root, gait.cycle_s)
    }
}

/// The speeds (m/s) or lengths (m) of the database.
pub fn parameters(activity: Activity) -> Vec<f64> {
    match activity {
        Activity::Walking => (0..9).map(|k| (3.0 + 0.5 * f64::from(k)) / 3.6).collect(),
        Activity::Running => (0..7).map(|k| (6.0 + f64::from(k)) / 3.6).collect(),
        Activity::Jumping => vec![0.4, 0.8, 1.2],
    }
}

/// Cycles of one subject at one parameter.
pub const REPEATS: u32 = 4;

/// How many subjects the database has; their seeds are 1, 2, …
pub fn subjects(activity: Activity) -> u64 {
    match activity {
        Activity::Walking => 9,
        Activity::Running => 5,
        Activity::Jumping => 4,
    }
}

/// All cycles of the synthetic database by subject, parameter and repeat.
pub fn database(activity: Activity) -> Vec<Cycle> {
    let of_subject = |seed: u64| {
        let subject = subject(activity, seed);
        parameters(activity).into_iter().flat_map(|parameter| subject.cycles(parameter)).collect::<Vec<_>>()
    };
    let by_subject: Vec<_> = (1..=subjects(activity)).into_par_iter().map(of_subject).collect();
    by_subject.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests;

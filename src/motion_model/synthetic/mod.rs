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
use rand_chacha::ChaCha12Rng;
use rayon::prelude::*;

use self::jumping::Habit;
use self::posture::Angles;
use self::variation::{Style, add_cycle_noise, cycle_rng, normal, subject_rng, uniform};
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
        self.make(parameter, Some(repeat))
    }

    /// The subject's true motion at `parameter`, without the variation from cycle to cycle.
    pub fn mean_cycle(&self, parameter: f64) -> Cycle {
        self.make(parameter, None)
    }

    fn sole(&self, angles: &Angles, side: usize) -> (posture::Sole, f64) {
        angles.sole(side, &self.offsets, self.stature_m)
    }

    fn make(&self, parameter: f64, repeat: Option<u32>) -> Cycle {
        let mut rng = repeat.map(|r| cycle_rng(self.seed, self.activity, parameter, r));
        let (angles, root, duration_s) = match self.activity {
            Activity::Jumping => self.jump(parameter, rng.as_mut()),
            _ => self.stride(parameter, rng.as_mut()),
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

    fn stride(&self, speed: f64, rng: Option<&mut ChaCha12Rng>) -> (Vec<Angles>, Vec<RootSample>, f64) {
        let rv = speed / self.hip_height_m;
        let running = self.activity == Activity::Running;
        let (mut tracks, frequency_hz) = if running {
            (self.style.tracks(rv, running::REFERENCE_RV, true, running::population), running::frequency_hz(rv))
        } else {
            (self.style.tracks(rv, walking::REFERENCE_RV, true, walking::population), walking::frequency_hz(rv))
        };
        let mut cycle_s = 1.0 / (self.tempo * frequency_hz);
        if let Some(rng) = rng {
            add_cycle_noise(&mut tracks, rng);
            cycle_s *= 1.0 + 0.01 * normal(rng);
        }
        let gait = if running { running::gait(speed, rv, cycle_s) } else { walking::gait(speed, cycle_s) };
        let (angles, root) = stride::cycle(self, &tracks, &gait);
        (angles, root, cycle_s)
    }

    fn jump(&self, length: f64, rng: Option<&mut ChaCha12Rng>) -> (Vec<Angles>, Vec<RootSample>, f64) {
        let mut tracks = self.style.tracks(length / self.hip_height_m, jumping::REFERENCE, false, jumping::population);
        let mut habit = self.habit.clone();
        if let Some(rng) = rng {
            add_cycle_noise(&mut tracks, rng);
            habit = habit.varied(0.25, rng);
        }
        jumping::jump(self, &tracks, &habit, length)
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
        let grid = parameters(activity).into_iter().flat_map(|p| (0..REPEATS).map(move |r| (p, r)));
        grid.map(|(parameter, repeat)| subject.cycle(parameter, repeat)).collect::<Vec<_>>()
    };
    let by_subject: Vec<_> = (1..=subjects(activity)).into_par_iter().map(of_subject).collect();
    by_subject.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests;

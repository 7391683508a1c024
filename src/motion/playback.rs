//! Plays a motion model's cycle at a wanted speed or jump length (style paper §5.1).
//!
//!   μ_t = μ_{t−1} + Δt F,   f = μ_t N                                                                        (9), (10)
//! with F = κ a V^b, the model's own cadence law at V = v/H times the person's factor κ. Root lengths are multiplied by the
//! target's hip height H. The carrier goes straight along +z at exactly v, so the mean speed of whole cycles is v.
//!
//! Size: bodies are alike at equal V (Murray), so a body of hip height H at v moves as the observed one of H_x does at
//! v H_x/H; jump lengths scale in the same way, and their durations with √(H/H_x).
//! A jump's progress is scaled so that it ends at the wanted length.
//! Checked against the wanted speed, the law's frequency, and a cycle of the database played at its own speed.

use nalgebra::{DVector, UnitQuaternion, Vector3};

use crate::body::{BALL_JOINTS, Clip, DOF, NODES, Pose};
use crate::math::rotation::exp;
use crate::motion_model::{Cycle, Detail, Model, RootSample, SAMPLES};
use crate::style::{Extrapolation, Method, Population, Style, StyleError};

/// A jump's progress is only stretched by factors in this range: beyond, the weights describe another kind of jump.
const STRETCH: std::ops::RangeInclusive<f64> = 0.4..=2.5;

/// A motion ready to play.
#[derive(Clone, Debug)]
pub struct Synthesis {
    pub weights: DVector<f64>,
    /// What of a recorded motion the weights do not hold.
    pub detail: Option<Detail>,
    /// Standard deviation of every weight; the paper's scheme has none.
    pub sd: Option<Vec<f64>>,
    /// Wanted speed in m/s or jump length in m.
    pub parameter: f64,
    /// Hip height of the body that is to move.
    pub hip_height_m: f64,
    /// Cycles (jumps) per second.
    pub frequency_hz: f64,
    /// Database subjects and their weights of equation (7).
    pub shares: Vec<(String, f64)>,
    pub notice: Option<String>,
}

impl Synthesis {
    /// Standard deviation of the joint coordinates that the prediction leaves open, rad, root mean square over all and the
    /// whole cycle: the components are orthonormal. The paper's scheme has none.
    pub fn angle_sd(&self) -> Option<f64> {
        let squares: f64 = self.sd.as_ref()?.iter().map(|sd| sd * sd).sum();
        Some((squares / (SAMPLES * DOF) as f64).sqrt())
    }
}

/// How much to play.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Length {
    /// Whole cycles; a jump is played once whatever the number.
    Cycles(usize),
    Seconds(f64),
}

impl Length {
    /// Duration for cycles that repeat `frequency_hz` times a second.
    pub fn seconds(self, frequency_hz: f64) -> f64 {
        match self {
            Length::Cycles(n) => n as f64 / frequency_hz,
            Length::Seconds(s) => s,
        }
    }
}

/// Weights and cadence of `style` at `parameter` for a body with `hip_height_m`; `population` comes from the same model.
pub fn synthesize(
    model: &Model,
    population: &Population,
    method: Method,
    style: &Style,
    parameter: f64,
    hip_height_m: f64,
) -> Result<Synthesis, StyleError> {
    let at_own_size = parameter * style.hip_height_m / hip_height_m;
    let found = style.at(population, method, at_own_size)?;
    let frequency_hz = style.cadence_factor_at(at_own_size) * model.cadence().frequency_hz(parameter, hip_height_m);
    let Extrapolation { weights, detail, sd, shares, notice } = found;
    Ok(Synthesis { weights, detail, sd, parameter, hip_height_m, frequency_hz, shares, notice })
}

/// Plays at `fps` from the start of a cycle; `offsets` are those of the body that moves.
pub fn play(model: &Model, synthesis: &Synthesis, offsets: &[Vector3<f64>; NODES], fps: f64, length: Length) -> Clip {
    let cyclic = model.activity.is_cyclic();
    let ride = Ride {
        cyclic,
        parameter: synthesis.parameter,
        hip_height_m: synthesis.hip_height_m,
        frequency_hz: synthesis.frequency_hz,
        stretch: if cyclic { 1.0 } else { stretch(model, synthesis) },
    };
    ride.clip(&|phase| model.posture_with(synthesis.weights.as_slice(), synthesis.detail.as_ref(), phase), offsets, fps, length)
}

/// Plays a recorded cycle as it is, over and over where it is a gait's.
pub fn play_cycle(cycle: &Cycle, offsets: &[Vector3<f64>; NODES], fps: f64, length: Length) -> Clip {
    let ride = Ride {
        cyclic: cycle.activity.is_cyclic(),
        parameter: cycle.parameter,
        hip_height_m: cycle.hip_height_m,
        frequency_hz: 1.0 / cycle.duration_s,
        stretch: 1.0,
    };
    ride.clip(&|phase| cycle.posture(phase), offsets, fps, length)
}

/// How a cycle is carried through time and space.
struct Ride {
    cyclic: bool,
    parameter: f64,
    hip_height_m: f64,
    frequency_hz: f64,
    stretch: f64,
}

type Posture<'a> = &'a dyn Fn(f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample);

impl Ride {
    fn clip(&self, posture: Posture, offsets: &[Vector3<f64>; NODES], fps: f64, length: Length) -> Clip {
        let seconds = match length {
            Length::Cycles(_) if !self.cyclic => 1.0 / self.frequency_hz,
            _ => length.seconds(self.frequency_hz),
        };
        let frames = (seconds * fps).round() as usize + 1;
        let poses = (0..frames)
            .map(|frame| {
                let time_s = frame as f64 / fps;
                let (joints, root) = posture(time_s * self.frequency_hz);
                let travelled_m = if self.cyclic { self.parameter * time_s } else { 0.0 };
                let at = root_position(&root, self.hip_height_m, travelled_m, self.stretch);
                Pose { root: at, world_from_root: exp(&root.rotation), joints }
            })
            .collect();
        Clip { fps, poses, offsets: *offsets, hip_height_m: self.hip_height_m }
    }
}

fn root_position(root: &RootSample, hip_height_m: f64, travelled_m: f64, stretch: f64) -> Vector3<f64> {
    let p = root.position;
    Vector3::new(p.x, 1.0 + p.y, p.z * stretch) * hip_height_m + Vector3::new(0.0, 0.0, travelled_m)
}

/// Factor that makes a jump end at the wanted length.
fn stretch(model: &Model, synthesis: &Synthesis) -> f64 {
    let (_, end) = model.posture_with(synthesis.weights.as_slice(), synthesis.detail.as_ref(), 1.0);
    let factor = synthesis.parameter / (end.position.z * synthesis.hip_height_m);
    if STRETCH.contains(&factor) { factor } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::motion_model::{Activity, Label, Model, segment, synthetic};

    fn model() -> Model {
        let speeds = [0.9, 1.2, 1.5, 1.8];
        let cycles: Vec<_> = (1..5).flat_map(|seed| speeds.map(|v| synthetic::subject(Activity::Walking, seed).cycle(v, 0))).collect();
        Model::build(Activity::Walking, true, &cycles).unwrap()
    }

    fn style(model: &Model) -> Style {
        let cycle = synthetic::subject(Activity::Walking, 7).mean_cycle(1.2);
        Style::of_cycles(model, "", &[cycle]).unwrap()
    }

    #[test]
    fn walks_at_the_wanted_speed_and_cadence_in_every_size() {
        let model = model();
        let style = style(&model);
        let population = Population::new(&model, style.weights.len());
        for (speed, hip_height_m) in [(0.9, style.hip_height_m), (1.37, style.hip_height_m), (1.2, 0.7)] {
            let s = synthesize(&model, &population, Method::Default, &style, speed, hip_height_m).unwrap();
            let clip = play(&model, &s, &Shape::template(hip_height_m / 0.53).offsets(), 100.0, Length::Cycles(5));
            let seconds = (clip.poses.len() - 1) as f64 / clip.fps;
            let way = clip.poses[clip.poses.len() - 1].root - clip.poses[0].root;
            assert!((way.z / seconds / speed - 1.0).abs() < 0.01 && way.x.abs() < 0.01, "{speed}: {way:?} in {seconds}");
            // An independent reading: cut the clip again and measure.
            let label =
                Label { subject: "x".into(), source: "x".into(), activity: Activity::Walking, parameter: None, start_s: None, end_s: None };
            let cycles = segment(&clip, &label).unwrap().cycles;
            assert!(cycles.len() >= 3, "{}", cycles.len());
            assert!(cycles.iter().all(|c| (c.parameter / speed - 1.0).abs() < 0.01), "{speed}");
            assert!(cycles.iter().all(|c| (c.duration_s * s.frequency_hz - 1.0).abs() < 0.01));
        }
    }

    #[test]
    fn the_observed_cadence_comes_back_at_the_observed_speed() {
        let model = model();
        let style = style(&model);
        let own = synthetic::subject(Activity::Walking, 7).mean_cycle(1.2);
        let population = Population::new(&model, style.weights.len());
        let s = synthesize(&model, &population, Method::Default, &style, 1.2, style.hip_height_m).unwrap();
        assert!((s.frequency_hz * own.duration_s - 1.0).abs() < 1e-9);
        assert!((style.cadence_factor - 1.0).abs() > 1e-3, "the subject's own factor is to be seen");
    }

    #[test]
    fn a_database_subject_plays_its_own_postures() {
        let model = model();
        let member = model.members[5].clone();
        let style = Style::of_cycles(&model, "", &[model.cycle_of(&member)]).unwrap();
        let population = Population::new(&model, style.weights.len());
        let s = synthesize(&model, &population, Method::Default, &style, member.parameter, member.hip_height_m).unwrap();
        let clip = play(&model, &s, &Shape::template(1.7).offsets(), 100.0, Length::Seconds(0.5));
        assert_eq!(clip.poses.len(), 51);
        let expected = model.cycle_of(&member);
        for (i, pose) in clip.poses.iter().enumerate() {
            let at = i as f64 * s.frequency_hz;
            let (k, part) = (at as usize, at - at.floor());
            let knee = expected.joints[k][6].slerp(&expected.joints[(k + 1) % 100][6], part);
            assert!(pose.joints[6].angle_to(&knee) < 1e-3);
        }
    }

    #[test]
    fn a_recorded_cycle_is_played_as_its_own_model_would_play_it() {
        let cycle = synthetic::subject(Activity::Walking, 7).cycle(1.3, 2);
        let model =
            Model::build(Activity::Walking, true, &[cycle.clone(), synthetic::subject(Activity::Walking, 8).cycle(1.3, 2)]).unwrap();
        let weights = model.project(&model.vector_of(&cycle));
        let synthesis = Synthesis {
            weights,
            detail: None,
            sd: None,
            parameter: 1.3,
            hip_height_m: cycle.hip_height_m,
            frequency_hz: 1.0 / cycle.duration_s,
            shares: Vec::new(),
            notice: None,
        };
        let offsets = Shape::template(1.7).offsets();
        let played = play_cycle(&cycle, &offsets, 70.0, Length::Cycles(2));
        let expected = play(&model, &synthesis, &offsets, 70.0, Length::Cycles(2));
        assert_eq!(played.poses.len(), expected.poses.len());
        for (a, b) in played.poses.iter().zip(&expected.poses) {
            // Slerp and interpolated rotation vectors differ between samples; a quarter of a sample's motion would not pass.
            assert!((a.root - b.root).norm() < 1e-4 && a.world_from_root.angle_to(&b.world_from_root) < 1e-3);
            assert!(a.joints.iter().zip(&b.joints).all(|(a, b)| a.angle_to(b) < 2e-3));
        }
    }
}

//! Phantom walks as the fit gets them, without pictures, and the scores of what it makes of them.

use std::sync::Arc;

use anyhow::{Context, Result};
use muybridge::body::{NODES, Pose, Shape, Surface, place};
use muybridge::clouds::{Cloud, CloudPoint};
use muybridge::fit::{self, Candidate, Fit, FitError, FitOptions, Observation, Silhouette};
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, Model, synthetic};
use muybridge::phantom::{Figure, SightOptions, joint_errors, sighting, staging, truth::Positions};
use muybridge::rig::rectify::{Rectification, groups};
use muybridge::rig::{Camera, Lens, Rig, Up};
use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rayon::prelude::*;

use super::super::interrupt;

/// Height of a person's middle and how far away it is expected, metres.
const AIM_M: [f64; 2] = [0.95, 3.6];
/// Motions are played this finely before frames are taken from them, 1/s.
const PLAYED_FPS: f64 = 120.0;
/// Fewer frames in view are no take.
const FEWEST_FRAMES: usize = 15;

/// Cameras at the corners of an upright L that look along y of the world and down to where people walk.
#[derive(Clone, Copy, Debug)]
pub struct LRig {
    pub cameras: usize,
    pub baseline_m: f64,
    pub height_m: f64,
    pub focal_px: f64,
    /// Second camera on the other side.
    pub mirrored: bool,
    /// Misalignment of the cameras, rad.
    pub turn: f64,
}

impl Default for LRig {
    fn default() -> Self {
        LRig { cameras: 3, baseline_m: 0.3, height_m: 1.0, focal_px: 550.0, mirrored: false, turn: 0.01 }
    }
}

impl LRig {
    pub fn rig(&self) -> Rig {
        let level = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0));
        let side = if self.mirrored { -self.baseline_m } else { self.baseline_m };
        let pitch = ((self.height_m - AIM_M[0]) / AIM_M[1]).atan();
        let places = [(0.0, 0.0, 0.0), (side, 0.0, self.turn), (0.0, self.baseline_m, -1.3 * self.turn)];
        let camera = |(k, (x, z, turn)): (usize, (f64, f64, f64))| {
            let camera_from_world = Rotation3::from_euler_angles(pitch + turn, turn, 0.3 * turn) * level;
            Camera {
                name: format!("cam_{k:02}"),
                size_px: [640, 480],
                matrix: Matrix3::new(self.focal_px, 0.0, 319.5, 0.0, self.focal_px, 239.5, 0.0, 0.0, 1.0),
                lens: Lens::BrownConrady([-0.08, 0.01, 2e-4, -3e-4, 0.0, 0.0, 0.0, 0.0]),
                camera_from_world,
                translation: -(camera_from_world * Vector3::new(x, 0.0, self.height_m + z)),
            }
        };
        Rig { cameras: places.into_iter().take(self.cameras).enumerate().map(camera).collect(), up: Up::Z }
    }
}

/// Who does what before which rig, and how it is seen.
#[derive(Clone, Debug)]
pub struct Walk {
    pub activity: Activity,
    /// Number of the synthetic person; those from 1000 on are not in the embedded database.
    pub subject: u64,
    /// m/s, for jumps m.
    pub parameter: f64,
    /// Radians; across the view and a little towards the cameras without it.
    pub heading: Option<f64>,
    /// Share of a cycle before the first frame.
    pub begin: f64,
    pub fps: f64,
    pub seconds: f64,
    /// Share of frames that are lost.
    pub dropped: f64,
    pub rig: LRig,
    pub sight: SightOptions,
}

impl Default for Walk {
    fn default() -> Self {
        Walk {
            activity: Activity::Walking,
            subject: 1000,
            parameter: 1.3,
            heading: None,
            begin: 0.0,
            fps: 30.0,
            seconds: 1.5,
            dropped: 0.0,
            rig: LRig::default(),
            sight: SightOptions::default(),
        }
    }
}

/// What was seen, and what was so.
pub struct Take {
    pub activity: Activity,
    pub rig: Rig,
    pub observations: Vec<Observation>,
    pub truth: Vec<Positions>,
    /// Unwrapped, one per frame.
    pub phases: Vec<f64>,
    pub floor_m: f64,
}

impl Walk {
    /// The motion as far as every camera sees all of it.
    pub fn film(&self) -> Result<Take> {
        let subject = synthetic::subject(self.activity, self.subject);
        let (cycle, shape) = (subject.cycle(self.parameter, 0), subject.shape());
        let from_s = if self.activity.is_cyclic() { self.begin * cycle.duration_s } else { 0.0 };
        let length = if self.activity.is_cyclic() { Length::Seconds(from_s + self.seconds) } else { Length::Cycles(1) };
        let clip = play_cycle(&cycle, &shape.offsets(), PLAYED_FPS, length);
        let clip = staging::resample(&clip, self.fps, from_s, from_s + self.seconds);
        let rig = self.rig.rig();
        let heading = self.heading.unwrap_or_else(|| staging::crossing_heading(&rig));
        let start = staging::cross_the_view(&rig, &clip, &shape, heading).context("the motion finds no place before the rig")?;
        let poses = staging::poses_in_world(&clip, &shape, rig.up, start, heading);
        let mut kept: Vec<usize> = staging::longest_run_in_view(&rig, &shape, &poses).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(self.sight.seed ^ 0xd20);
        let (first, last) = (kept.first().copied(), kept.last().copied());
        kept.retain(|k| Some(*k) == first || Some(*k) == last || rng.random::<f64>() >= self.dropped);
        anyhow::ensure!(kept.len() >= FEWEST_FRAMES, "only {} frames of the motion are in view", kept.len());
        let frames: Vec<(usize, f64)> = kept.iter().map(|k| (*k, *k as f64 / self.fps)).collect();
        let seen: Vec<Pose> = kept.iter().map(|k| poses[*k].clone()).collect();
        Ok(Take {
            activity: self.activity,
            observations: observe(&rig, &shape, &frames, &seen, &self.sight)?,
            truth: positions(&shape, &seen),
            phases: frames.iter().map(|(_, t)| (from_s + t) / cycle.duration_s).collect(),
            floor_m: 0.0,
            rig,
        })
    }
}

/// Joint centres of poses.
pub fn positions(shape: &Shape, poses: &[Pose]) -> Vec<[Vector3<f64>; NODES]> {
    let offsets = shape.offsets();
    poses.iter().map(|p| place(&offsets, p).positions).collect()
}

/// Clouds and silhouettes of a posed body; `frames` are numbers and times.
pub fn observe(rig: &Rig, shape: &Shape, frames: &[(usize, f64)], poses: &[Pose], sight: &SightOptions) -> Result<Vec<Observation>> {
    let groups = groups(rig)?;
    let (surface, offsets) = (Surface::new(shape), shape.offsets());
    let of_frame = |(&(number, time_s), pose): (&(usize, f64), &Pose)| {
        let figure = Figure::new(&surface, &offsets, &place(&offsets, pose));
        let sighted = |group: &Rectification| sighting::points(&figure, group, number, sight);
        let points = groups.iter().flat_map(sighted);
        let point = |(position, covariance)| CloudPoint { position, colour: [128; 3], confidence: 1.0, covariance };
        let silhouettes = sighting::masks(&figure, rig, number, sight).iter().map(|mask| Some(Silhouette::new(mask))).collect();
        Observation { number, time_s, cloud: Cloud { points: points.map(point).collect() }, silhouettes: Arc::new(silhouettes) }
    };
    Ok(frames.par_iter().zip(poses).map(of_frame).collect())
}

/// How a fit stands to the truth.
#[derive(Clone, Debug)]
pub struct Score {
    pub joints_mm: f64,
    /// Mean error of hips' and knees' included angles, degrees.
    pub legs_deg: f64,
    /// The model is one of what was done, left is left, and the phase of a cycle is right to a quarter.
    pub right: bool,
    /// Costs of all models, each with the better and the other half-cycle.
    pub candidates: Vec<Candidate>,
}

impl Score {
    /// Right model, right half-cycle and within six centimetres: a start that more iterations would only polish.
    pub fn started(&self) -> bool {
        self.right && self.joints_mm < 60.0
    }
}

pub fn fitted(take: &Take, models: &[&Model], options: &FitOptions) -> Result<Fit, FitError> {
    fit::fit(&take.observations, &take.rig, models, Some(take.floor_m), options, &|_| !interrupt::came())
}

/// Fit and score; `None` where the fit cannot begin.
pub fn score(take: &Take, models: &[&Model], options: &FitOptions) -> Result<Option<Score>> {
    let fit = match fitted(take, models, options) {
        Ok(fit) => fit,
        Err(error @ FitError::Interrupted) => return Err(error.into()),
        Err(_) => return Ok(None),
    };
    let errors = joint_errors(&positions(fit.shape(), &fit.poses), &take.truth);
    let middle = take.phases.len() / 2;
    let apart = (fit.state.carriers[middle].phase - take.phases[middle] + 0.5).rem_euclid(1.0) - 0.5;
    Ok(Some(Score {
        joints_mm: 1e3 * errors.absolute_m,
        legs_deg: 0.5 * (errors.angles[0] + errors.angles[1]).to_degrees(),
        right: models[fit.model].activity == take.activity
            && errors.swapped_over_straight > 1.0
            && (apart.abs() < 0.25 || !take.activity.is_cyclic()),
        candidates: fit.candidates,
    }))
}

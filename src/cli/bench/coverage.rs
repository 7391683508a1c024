//! `muybridge bench coverage`: do the fit's 95 % intervals hold the truth 95 times in 100?
//!
//! People drawn from the model and the fit's own priors, so that nothing but noise is between fit and truth; every repeat
//! has noise of its own. Their joints leave the model and their carriers accelerate as the priors expect, the latter less the slow
//! part (a cubic over the walk), which would turn them out of their way; `--gliding` people do neither and are easier than the fit
//! believes. An interval is the estimate ± 1.96 σ.

use anyhow::{Context, Result};
use clap::Args;
use muybridge::body::{Joint, Length, Pose, Shape, Surface, place};
use muybridge::fit::curve::Curve;
use muybridge::fit::problem::Settings;
use muybridge::fit::state::{Carrier, DEVIATING, HELD, Posture, State, Turns};
use muybridge::fit::{Fit, FitOptions, SETTINGS, settings};
use muybridge::math::rotation::exp;
use muybridge::motion_model::Activity;
use muybridge::phantom::{SightOptions, staging, truth::SCORED};
use muybridge::rig::Rig;
use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

use super::super::{interrupt, track::NamedModel};
use super::takes::{LRig, Take, fitted, observe, positions};

#[derive(Args)]
pub struct CoverageArgs {
    /// Fits with noise of their own
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..))]
    repeats: u64,
    /// Different people among the repeats, drawn from the model
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    people: u64,
    /// Disparity noise, px
    #[arg(long, default_value_t = 0.15, value_parser = super::super::positive)]
    disparity_noise: f64,
    /// Follow the model exactly, without turns of single joints
    #[arg(long)]
    no_deviations: bool,
    /// People who move as the model, with constant speed, heading and cadence
    #[arg(long)]
    gliding: bool,
}

const FPS: f64 = 30.0;
const FRAMES: usize = 45;
const SPEED_M_S: f64 = 1.25;
const CADENCE_HZ: f64 = 0.95;
/// Where the middle of the walk is before the rig, metres.
const DISTANCE_M: f64 = 3.6;
/// Spread of the people's lengths and widths about the template's.
const LENGTH_SPREAD: f64 = 0.025;
const WIDTH_SPREAD: f64 = 0.1;
/// Half width of the intervals in standard deviations.
const HALF_WIDTH: f64 = 1.96;

/// Errors over their standard deviations.
#[derive(Default)]
struct Scores {
    kinds: [(Vec<f64>, Vec<f64>); KINDS.len()],
}

/// Kind, unit, and how many of it make one in the fit's own.
const KINDS: [(&str, &str, f64); 8] = [
    ("weights", "population sd", 1.0),
    ("stature", "%", 100.0),
    ("limb lengths", "%", 100.0),
    ("limb widths", "%", 100.0),
    ("root position", "mm", 1e3),
    ("root rotation", "deg", 57.295_779_513),
    ("phase", "% of a cycle", 100.0),
    ("joint positions", "mm", 1e3),
];

pub fn run(args: &CoverageArgs) -> Result<()> {
    let model = NamedModel::synthetic(Activity::Walking)?.model;
    let options = FitOptions { deviations: !args.no_deviations, ..FitOptions::default() };
    let (curve, settings) = (Curve::new(&model, options.components), settings(&model, options.components, 1.0 / FPS));
    let mut scores = Scores::default();
    let (mut shares, mut misfits, mut followed) = (Vec::new(), Vec::new(), 0);
    for repeat in 0..args.repeats {
        interrupt::check()?;
        let rig = LRig::default().rig();
        let person = Person::draw(&curve, &settings, &rig, repeat % args.people, args.gliding);
        let sight = SightOptions { seed: 1000 + repeat, disparity_px: args.disparity_noise, ..SightOptions::default() };
        let take = person.film(rig, &sight)?;
        let fit = fitted(&take, &[&model], &options)?;
        scores.add(&person, &take, &fit).with_context(|| format!("repeat {repeat}"))?;
        if let Some(u) = &fit.uncertainty {
            shares.push(u.shares);
            misfits.push(u.misfit_m);
        }
        followed += usize::from(!fit.state.deviations.is_empty());
    }
    scores.print(args);
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
    println!(
        "share of new information: points {:.3}, rays {:.3}; misfit {:.1} mm; turns of single joints kept in {followed} of {}",
        mean(shares.iter().map(|s| s[0]).collect()),
        mean(shares.iter().map(|s| s[1]).collect()),
        1e3 * mean(misfits),
        args.repeats
    );
    Ok(())
}

/// A walker of the model before the rig.
struct Person {
    state: State,
    poses: Vec<Pose>,
    floor_m: f64,
}

impl Person {
    fn draw(curve: &Curve, settings: &Settings, rig: &Rig, seed: u64, gliding: bool) -> Person {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut shape = Shape::template(1.6 + 0.25 * rng.random::<f64>());
        for i in 0..Length::COUNT {
            shape.lengths[i] += LENGTH_SPREAD * normal(&mut rng);
            shape.widths[i] += WIDTH_SPREAD * normal(&mut rng);
        }
        let weights = curve.eigenvalues.iter().map(|lambda| lambda.sqrt() * normal(&mut rng)).collect();
        let begin = rng.random::<f64>();
        let heading = staging::crossing_heading(rig);
        let (up, axes) = (rig.up.direction(), staging::floor_axes(rig.up));
        let forward = axes[0] * heading.cos() + axes[1] * heading.sin();
        let world_from_carrier = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
            up.cross(&forward),
            up,
            forward,
        ])));
        let middle = Vector3::new(0.0, DISTANCE_M, shape.hip_height_m());
        let unsteady = if gliding { 0.0 } else { 1.0 };
        let mut wobble = |sigma: f64| wobble(unsteady * sigma, &mut rng);
        let moved: [Vec<f64>; 3] = std::array::from_fn(|_| wobble(settings.acceleration));
        let turned: [Vec<f64>; 3] = std::array::from_fn(|_| wobble(settings.angular_acceleration));
        let ahead = wobble(settings.phase_acceleration);
        let carrier = |t: usize| {
            let time_s = (t as f64 - 0.5 * (FRAMES - 1) as f64) / FPS;
            let of = |channels: &[Vec<f64>; 3]| Vector3::from_fn(|axis, _| channels[axis][t]);
            Carrier {
                position: middle + forward * (SPEED_M_S * time_s) + of(&moved),
                world_from_carrier: exp(&of(&turned)) * world_from_carrier,
                phase: begin + CADENCE_HZ * time_s + ahead[t],
            }
        };
        let carriers = (0..FRAMES).map(carrier).collect();
        let mut state = State { carriers, weights, shape, posture: Posture::default(), deviations: Vec::new() };
        if !gliding {
            for (turn, joint) in state.posture.iter_mut().zip(HELD) {
                turn.iter_mut().for_each(|angle| *angle = settings.posture_of(joint) * normal(&mut rng));
            }
            state.deviations = vec![Turns::default(); FRAMES];
            for (joint, axis) in (0..DEVIATING.len()).flat_map(|joint| (0..3).map(move |axis| (joint, axis))) {
                let turns = deviation(&mut rng);
                state.deviations.iter_mut().zip(turns.iter()).for_each(|(of_frame, turn)| of_frame[joint][axis] = *turn);
            }
        }
        let poses: Vec<Pose> = (0..FRAMES).map(|t| state.pose(curve, t)).collect();
        let (surface, offsets) = (Surface::new(&state.shape), state.shape.offsets());
        let floor_m = poses.iter().map(|p| staging::lowest_m(&surface, &place(&offsets, p), rig.up)).fold(f64::INFINITY, f64::min);
        Person { state, poses, floor_m }
    }

    fn film(&self, rig: Rig, sight: &SightOptions) -> Result<Take> {
        let frames: Vec<(usize, f64)> = (0..FRAMES).map(|k| (k, k as f64 / FPS)).collect();
        Ok(Take {
            activity: Activity::Walking,
            observations: observe(&rig, &self.state.shape, &frames, &self.poses, sight)?,
            truth: positions(&self.state.shape, &self.poses),
            phases: self.state.carriers.iter().map(|c| c.phase).collect(),
            floor_m: self.floor_m,
            rig,
        })
    }
}

/// Accelerations of standard deviation `sigma`, summed twice, less their cubic: one value per frame.
fn wobble(sigma: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let (mut rate, mut value) = (0.0, 0.0);
    let walk = DVector::from_fn(FRAMES, |_, _| {
        rate += sigma * normal(rng) / FPS;
        value += rate / FPS;
        value
    });
    let powers = DMatrix::from_fn(FRAMES, 4, |t, k| (2.0 * t as f64 / (FRAMES - 1) as f64 - 1.0).powi(k as i32));
    let slow = powers.qr().q();
    (&walk - &slow * slow.tr_mul(&walk)).iter().copied().collect()
}

/// Turns of a joint about one axis, one per frame, rad: likely as the priors of their size and acceleration say.
fn deviation(rng: &mut ChaCha8Rng) -> DVector<f64> {
    let second = FPS * FPS / SETTINGS.turn_acceleration;
    let bend = DMatrix::from_fn(FRAMES - 2, FRAMES, |t, k| second * [1.0, -2.0, 1.0].get(k.wrapping_sub(t)).unwrap_or(&0.0));
    let precision = bend.tr_mul(&bend) + DMatrix::identity(FRAMES, FRAMES) / SETTINGS.deviation.powi(2);
    let drawn = DVector::from_fn(FRAMES, |_, _| normal(rng));
    precision.cholesky().and_then(|factor| factor.l().tr_solve_lower_triangular(&drawn)).unwrap_or_else(|| DVector::zeros(FRAMES))
}

/// A standard normal number within 3 standard deviations.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    loop {
        let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
        let drawn = radius * (std::f64::consts::TAU * rng.random::<f64>()).cos();
        if drawn.abs() < 3.0 {
            return drawn;
        }
    }
}

impl Scores {
    fn push(&mut self, kind: usize, error: f64, sigma: f64, unit: f64) {
        self.kinds[kind].0.push(error / sigma);
        self.kinds[kind].1.push((error / unit).abs());
    }

    fn add(&mut self, person: &Person, take: &Take, fit: &Fit) -> Result<()> {
        let uncertainty = fit.uncertainty.as_ref().context("the equations of the fit are singular")?;
        let (found, truth) = (&fit.state, &person.state);
        let layout = found.layout();
        let sigma = |i: usize| uncertainty.shared[(i, i)].sqrt();
        for (i, (a, b)) in found.weights.iter().zip(&truth.weights).enumerate() {
            self.push(0, a - b, sigma(i), fit.curve.eigenvalues[i].sqrt());
        }
        self.push(1, (found.shape.stature_m / truth.shape.stature_m).ln(), sigma(layout.stature()), 1.0);
        for i in 0..Length::COUNT {
            let at = layout.stature() + 1 + i;
            self.push(2, found.shape.lengths[i] - truth.shape.lengths[i], sigma(at), 1.0);
            self.push(3, found.shape.widths[i] - truth.shape.widths[i], sigma(at + Length::COUNT), 1.0);
        }
        for (t, (a, b)) in found.carriers.iter().zip(&truth.carriers).enumerate() {
            let local = &uncertainty.frames[t].local;
            let turn = (a.world_from_carrier * b.world_from_carrier.inverse()).scaled_axis();
            for axis in 0..3 {
                self.push(4, a.position[axis] - b.position[axis], local[3 + axis], 1.0);
                self.push(5, turn[axis], local[axis], 1.0);
            }
            self.push(6, (a.phase - b.phase + 0.5).rem_euclid(1.0) - 0.5, local[6], 1.0);
        }
        for (t, (a, b)) in positions(fit.shape(), &fit.poses).iter().zip(&take.truth).enumerate() {
            for joint in SCORED.map(|j: Joint| j as usize) {
                let error = a[joint] - b[joint];
                (0..3).for_each(|axis| self.push(7, error[axis], uncertainty.frames[t].joints_m[joint][axis], 1.0));
            }
        }
        Ok(())
    }

    fn print(&self, args: &CoverageArgs) {
        println!(
            "{} fits to {} people of the model, {} px of disparity noise; intervals of 95 %",
            args.repeats, args.people, args.disparity_noise
        );
        println!("{:<18}{:>12}{:>14}{:>15}{:>14}{:>18}", "", "inside %", "rms error/sd", "mean error/sd", "mean error", "unit");
        for ((normalised, errors), (name, unit, factor)) in self.kinds.iter().zip(KINDS) {
            let count = normalised.len().max(1) as f64;
            let inside = normalised.iter().filter(|z| z.abs() < HALF_WIDTH).count();
            let rms = (normalised.iter().map(|z| z * z).sum::<f64>() / count).sqrt();
            let bias = normalised.iter().sum::<f64>() / count;
            let mean = factor * errors.iter().sum::<f64>() / count;
            println!("{name:<18}{:>12.1}{rms:>14.2}{bias:>15.2}{mean:>14.2}{unit:>18}", 100.0 * inside as f64 / count);
        }
    }
}

//! Fitting the body to the clouds of all frames at once: style paper §6.1, starting by itself.
//!
//! Observations ([`targets`]) → track, heading, cadence and phase by search ([`start`]), for every model and both half-cycle
//! hypotheses until the evidence of few frames tells them apart ([`contest`]) → root, phases, weights, shape by
//! Levenberg–Marquardt over all frames ([`problem`]), then with more components, with turns of single joints against the model,
//! at last with derivatives at the skin ([`weighing`]) → poses, weights, shape and their [`uncertainty`]; what beside the
//! weights is the person's own ([`own_motion`]).
//! Components keep what they add to joints all cycle long: without it in the last stage the legs of mesh figures came out 0.4
//! degrees better, but points left out of the fit farther off, and recorded runners 1.6 degrees worse.
//! Checked against the phantom's known truth and against footage of a mesh person with known joints.

pub mod carrier;
pub mod contest;
pub mod curve;
pub mod own_motion;
pub mod people;
pub mod problem;
pub mod silhouette;
pub mod start;
pub mod state;
pub mod targets;
pub mod uncertainty;
pub mod weighing;
pub mod whole_cycle;
mod wrench;

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::body::{Pose, Shape, place};
use crate::math::arrow::{LmOptions, minimise};
use crate::math::order::quantile;
use crate::motion_model::{Activity, Model};
use crate::rig::Rig;
use carrier::Accelerations;
pub use contest::Candidate;
use curve::Curve;
use problem::{Frame, Free, Known, Problem, Settings};
pub use silhouette::Silhouette;
use state::{State, Turns};
use targets::Choice;
pub use targets::Observation;
pub use uncertainty::Uncertainty;
pub use weighing::PointResidual;
use weighing::{Fitness, fitness, total};

/// Why a fit cannot begin.
#[derive(Debug, thiserror::Error)]
pub enum FitError {
    #[error(
        "nobody to fit: only {with_person} of {frames} frames have a cloud of {points} points or more; check that a person walks through the view of all cameras and that the empty-stage pictures belong to this session"
    )]
    NobodySeen { frames: usize, with_person: usize, points: usize },
    #[error("the footage has too few frames for a motion, {frames} where {needed} or more are needed; give it the whole sequence")]
    TooShort { frames: usize, needed: usize },
    #[error(
        "{crowded} of {frames} frames show two people or more, who cannot be told apart; keep one person on the stage, or cut the frames with the others out"
    )]
    Crowd { crowded: usize, frames: usize },
    #[error("the motion model holds no cycles; build it again with `muybridge model build`")]
    EmptyModel,
    #[error("interrupted; nothing was written, run the same command to begin again")]
    Interrupted,
}

/// What to use of model and data.
#[derive(Clone, Copy, Debug)]
pub struct FitOptions {
    /// Components of the model in the last stage.
    pub components: usize,
    /// As many components as hold this part of the model's variance, in place of `components`.
    pub variance: Option<f64>,
    /// Cloud points per frame in the last stages.
    pub points: usize,
    /// Silhouette rays per camera and frame.
    pub rays: usize,
    /// Whether the person may leave the model: joints' posture and turns from frame to frame. They are kept only if they
    /// bring the body nearer to points that the fit did not see.
    pub deviations: bool,
    /// Whether limbs may be longer or shorter than the template's.
    pub lengths: bool,
    /// What of a cloud point is made small in the last stages.
    pub residual: PointResidual,
}

impl Default for FitOptions {
    /// Twenty components reach 2.5 degrees against the true joints where ten reach 4 (fit on CMU walks); 500 points and
    /// 100 rays a frame cost about the same as the silhouettes' search and more change nothing.
    fn default() -> Self {
        FitOptions {
            components: 20,
            variance: None,
            points: 500,
            rays: 100,
            deviations: true,
            lengths: true,
            residual: PointResidual::Distance,
        }
    }
}

/// The fitted motion of one session.
#[derive(Clone, Debug)]
pub struct Fit {
    /// Root, heading and phase per frame, weights α, shape.
    pub state: State,
    /// Poses in the rig's world, one per frame.
    pub poses: Vec<Pose>,
    pub curve: Curve,
    /// How sure all that is; `None` where the equations are singular.
    pub uncertainty: Option<Uncertainty>,
    pub frames: Vec<Fitness>,
    /// Which of the models this is, by its place among those that were given, and how all of them did.
    pub model: usize,
    pub candidates: Vec<Candidate>,
    pub iterations: u64,
    /// Mean horizontal speed of the carrier, m/s.
    pub speed_m_s: f64,
    /// Mean rate of the phase, cycles per second.
    pub cadence_hz: f64,
    /// Up direction of the rig's world.
    pub up: Vector3<f64>,
}

/// The last stages of a fit; [`settings`] has the accelerations of a model's people.
pub const SETTINGS: Settings = Settings {
    residual: PointResidual::Distance,
    at_skin: true,
    model_m: 0.02,
    point_weight: 0.16,
    ray_weight: 0.16,
    outside_weight: 0.3,
    acceleration: carrier::STEADY.linear_m_s2,
    angular_acceleration: carrier::STEADY.angular_rad_s2,
    phase_acceleration: 1.35,
    tilt: 0.08,
    stature: 0.03,
    length: 0.025,
    arm_length: 0.04,
    width: 0.2,
    posture: 0.04,
    wrist: 0.1,
    deviation: 0.1,
    turn_acceleration: 40.0,
};

/// [`SETTINGS`] for somebody who moves as the people of `model` do and is not one of them, in frames every `frame_s` seconds.
pub fn settings(model: &Model, components: usize, frame_s: f64) -> Settings {
    let Accelerations { linear_m_s2, angular_rad_s2 } = carrier::accelerations(model, components, frame_s);
    Settings { acceleration: linear_m_s2, angular_acceleration: angular_rad_s2, ..SETTINGS }
}

/// The usual time between frames.
fn frame_s(times_s: &[f64]) -> f64 {
    quantile(times_s.windows(2).map(|pair| pair[1] - pair[0]).collect(), 0.5).unwrap_or(0.0)
}

/// A second person in more than one of so many frames is one too many.
const CROWDED: usize = 4;

#[derive(Clone, Copy)]
struct Stage {
    free: Free,
    settings: Settings,
    most_rounds: usize,
    /// Ends after a round that moves joints by less, root mean square over joints and frames, metres. Costs do not tell: as points
    /// begin and cease to count they go up and down by up to 1 % for ever, while joints move by 0.1 to 0.4 mm.
    still_m: f64,
}

/// For stages that only lead to the next one; with 4 mm fast runs come out 1 mm worse.
const ROUGHLY_M: f64 = 2e-3;
/// Then joints are 0.7 to 1.6 mm on average from where sixty more rounds put them, and no farther from the truth; with 1 mm those of
/// a run are 2.4 mm from there and 0.9 mm farther.
const CLOSELY_M: f64 = 5e-4;
/// Walks take 2 to 8 in a stage. A run without silhouettes takes 20: after 10 its joints are 44 instead of 31 mm off.
const MOST_ROUNDS: usize = 30;
/// With ten weights, which are too few for some fast runs: their cost rises from the third round on, and where ten are made an arm
/// is lost for good, joints 29 instead of 11 mm off.
const FIRST_ROUNDS: usize = 5;

const PLACED: Free = Free { rotation: false, phase: false, weights: false, stature: false, lengths: false, widths: false, posture: false };
const TURNED: Free = Free { rotation: true, phase: true, ..PLACED };
const STYLED: Free = Free { weights: true, stature: true, widths: true, ..TURNED };
const SHAPED: Free = Free { lengths: true, ..STYLED };
const POSED: Free = Free { posture: true, ..SHAPED };

/// A stage of the fit between two of its rounds.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// Done in this stage.
    pub rounds: usize,
    /// Solver iterations in this stage.
    pub iterations: u64,
    /// How far the last round moved joints, by which a stage ends; infinite where its step was damped.
    pub moved_m: f64,
    pub state: State,
}

/// Where a fit that was stopped goes on, by the number of the stage. argmin's own checkpoints do not serve: weights are frozen
/// anew for every iteration, so each of its runs is one iteration long.
pub struct Checkpoints<'a> {
    pub load: &'a dyn Fn(usize) -> Option<Checkpoint>,
    pub save: &'a dyn Fn(usize, &Checkpoint),
}

impl Checkpoints<'_> {
    pub const NONE: Checkpoints<'static> = Checkpoints { load: &|_| None, save: &|_, _| {} };
}

/// Everything one run needs beside the state.
struct Run<'a> {
    known: Known,
    iterations: u64,
    checkpoints: &'a Checkpoints<'a>,
    /// Stages begun.
    stages: usize,
}

impl Run<'_> {
    /// Stages of which no checkpoints are kept.
    fn rough(known: &Known) -> Run<'static> {
        Run { known: *known, iterations: 0, checkpoints: &Checkpoints::NONE, stages: 0 }
    }

    /// Alternates frozen weights and one solver iteration; more iterations between two freezings take longer to the same cost.
    fn stage(&mut self, state: State, frames: &[Frame], curve: &Curve, stage: &Stage) -> State {
        let begun = (self.checkpoints.load)(self.stages);
        let mut at = begun.unwrap_or(Checkpoint { rounds: 0, iterations: 0, moved_m: f64::INFINITY, state });
        let mut before = joints(&at.state, curve);
        while at.rounds < stage.most_rounds && at.moved_m >= stage.still_m {
            let problem = Problem::new(curve, frames, &stage.settings, stage.free, &self.known, &at.state);
            let (state, summary) = minimise(problem, at.state, &LmOptions { max_iterations: 1, relative_cost: 1e-4 });
            let after = joints(&state, curve);
            let moved_m = (before.iter().zip(&after).map(|(a, b)| (a - b).norm_squared()).sum::<f64>() / after.len() as f64).sqrt();
            // A step that had to be damped is short for that.
            let moved_m = if summary.rejected_steps == 0 { moved_m } else { f64::INFINITY };
            at = Checkpoint { rounds: at.rounds + 1, iterations: at.iterations + summary.iterations, moved_m, state };
            before = after;
            (self.checkpoints.save)(self.stages, &at);
        }
        self.stages += 1;
        self.iterations += at.iterations;
        at.state
    }
}

/// Places of all joints in all frames.
fn joints(state: &State, curve: &Curve) -> Vec<Vector3<f64>> {
    let offsets = state.shape.offsets();
    let of_frame = |t: usize| place(&offsets, &state.pose(curve, t)).positions;
    (0..state.carriers.len()).into_par_iter().map(of_frame).collect::<Vec<_>>().concat()
}

/// Fits the one of `models` that explains them best to the observations of one session, with the floor at height `floor_m` along the rig's up axis where it is
/// known; `progress` is told the share done and says whether to go on.
pub fn fit(
    observations: &[Observation],
    rig: &Rig,
    models: &[&Model],
    floor_m: Option<f64>,
    options: &FitOptions,
    progress: &dyn Fn(f64) -> bool,
) -> Result<Fit, FitError> {
    resume(observations, rig, models, floor_m, options, &Checkpoints::NONE, progress)
}

/// [`fit`] with checkpoints, which must be of the same observations, rig, models and options.
pub fn resume(
    observations: &[Observation],
    rig: &Rig,
    models: &[&Model],
    floor_m: Option<f64>,
    options: &FitOptions,
    checkpoints: &Checkpoints,
    progress: &dyn Fn(f64) -> bool,
) -> Result<Fit, FitError> {
    if models.is_empty() || models.iter().any(|model| model.members.is_empty()) {
        return Err(FitError::EmptyModel);
    }
    let step = |share| if progress(share) { Ok(()) } else { Err(FitError::Interrupted) };
    let up = rig.up.direction();
    let viewpoint = rig.cameras.iter().map(|c| c.centre()).sum::<Vector3<f64>>() / rig.cameras.len().max(1) as f64;
    if observations.len() < start::FEWEST_FRAMES {
        return Err(FitError::TooShort { frames: observations.len(), needed: start::FEWEST_FRAMES });
    }
    let (people, crowded) = people::largest(observations, rig);
    if CROWDED * crowded > people.len() {
        return Err(FitError::Crowd { crowded, frames: people.len() });
    }
    let track = start::track(&people, &viewpoint, &up, floor_m)?;
    let known = Known { viewpoint, up, stature_m: track.stature_m, floor_m: floor_m.filter(|floor| *floor == track.floor_m) };
    let choices: Vec<Choice> = people.par_iter().map(|p| Choice::new(p, rig, known.floor_m)).collect();
    let times: Vec<f64> = people.iter().map(|p| p.time_s()).collect();
    let few = contest::apart(&times);
    let sparse: Vec<Frame> = few.iter().map(|t| choices[*t].frame(rig, 200, 40)).collect();
    step(0.0)?;
    let (rough, candidates) = contest::contest(models, &track.at(&few), &sparse, &known);
    let model = models[contest::best(&candidates)];
    let mut state = rough.between(&few, &times);
    let ten = Curve::new(model, 10);
    // A start that was judged by its mean motion has none.
    state.weights.resize(ten.components(), 0.0);

    let mut run = Run { known, iterations: 0, checkpoints, stages: 0 };
    let components = options.variance.map_or(options.components, |part| model.components(part));
    let settings = Settings { residual: options.residual, ..settings(model, components, frame_s(&times)) };
    let dense: Vec<Frame> = choices.par_iter().map(|c| c.frame(rig, options.points, options.rays)).collect();
    // Half of the targets, each for two, lead there as well.
    let half: Vec<Frame> = dense.iter().map(Frame::half).collect();
    step(0.4)?;
    let shaped = if options.lengths { SHAPED } else { STYLED };
    let approach =
        Settings { at_skin: false, point_weight: 2.0 * settings.point_weight, ray_weight: 2.0 * settings.ray_weight, ..settings };
    let approaching = |free, settings, most_rounds| Stage { free, settings, most_rounds, still_m: ROUGHLY_M };
    state = run.stage(state, &half, &ten, &approaching(STYLED, Settings { model_m: 0.03, ..approach }, FIRST_ROUNDS));
    step(0.55)?;
    let curve = Curve::new(model, components);
    state.weights.resize(curve.components(), 0.0);
    state = run.stage(state, &half, &curve, &approaching(shaped, approach, MOST_ROUNDS));
    step(0.7)?;
    let mut last = Stage { free: shaped, settings, most_rounds: MOST_ROUNDS, still_m: CLOSELY_M };
    if options.deviations {
        let posed = Stage { free: Free { lengths: options.lengths, ..POSED }, ..last };
        let own = State { deviations: vec![Turns::default(); state.carriers.len()], ..state.clone() };
        let own = run.stage(own, &half, &curve, &approaching(posed.free, approach, MOST_ROUNDS));
        step(0.85)?;
        let left_out: Vec<Frame> = choices.par_iter().map(|c| c.left_out(options.points)).collect();
        let cost = |state: &State| total(&fitness(&curve, &left_out, &settings, &known, state)).cost;
        if cost(&own) < cost(&state) {
            (state, last) = (own, posed);
        }
    }
    state = run.stage(state, &dense, &curve, &last);
    step(0.95)?;
    Ok(finish(run, candidates, state, &last, curve, &dense))
}

fn finish(run: Run, candidates: Vec<Candidate>, state: State, last: &Stage, curve: Curve, frames: &[Frame]) -> Fit {
    let uncertainty = uncertainty::uncertainty(&curve, frames, &last.settings, last.free, &run.known, &state);
    let seconds = frames.last().map_or(0.0, |f| f.time_s) - frames.first().map_or(0.0, |f| f.time_s);
    let frames = fitness(&curve, frames, &last.settings, &run.known, &state);
    let poses = (0..state.carriers.len()).map(|t| state.pose(&curve, t)).collect();
    let (first, last) = (&state.carriers[0], &state.carriers[state.carriers.len() - 1]);
    let travelled: f64 =
        state.carriers.windows(2).map(|w| w[1].position - w[0].position).map(|d| (d - run.known.up * d.dot(&run.known.up)).norm()).sum();
    let (speed_m_s, cadence_hz) = (travelled / seconds, (last.phase - first.phase) / seconds);
    Fit {
        model: contest::best(&candidates),
        candidates,
        up: run.known.up,
        poses,
        uncertainty,
        frames,
        iterations: run.iterations,
        speed_m_s,
        cadence_hz,
        state,
        curve,
    }
}

impl Fit {
    /// The motion parameter as filmed: mean speed in m/s, for a jump the length of its path in m.
    pub fn parameter(&self, activity: Activity) -> f64 {
        match (activity.is_cyclic(), self.poses.first(), self.poses.last()) {
            (false, Some(first), Some(last)) => {
                let way = last.root - first.root;
                (way - self.up * way.dot(&self.up)).norm()
            }
            _ => self.speed_m_s,
        }
    }

    /// Costs of the chosen and of the other half-cycle when the choice was made.
    pub fn half_cycles(&self) -> [f64; 2] {
        self.candidates[self.model].costs
    }

    /// Shape of the person.
    pub fn shape(&self) -> &Shape {
        &self.state.shape
    }

    /// Standard deviation of each weight over the population's: near 1 means that the footage said nothing about it.
    pub fn weight_uncertainty(&self) -> Vec<f64> {
        self.curve.eigenvalues.iter().enumerate().map(|(i, lambda)| (self.shared_variance(i) / lambda).sqrt()).collect()
    }

    /// Variance of shared unknown `i` in the state's layout; NaN where it is not known.
    pub fn shared_variance(&self, i: usize) -> f64 {
        self.uncertainty.as_ref().map_or(f64::NAN, |u| u.shared[(i, i)])
    }

    /// Root-mean-square distance of the inlying points to the skin, metres.
    pub fn rms_m(&self) -> f64 {
        let sum = total(&self.frames);
        (sum.inlier_square / sum.inliers.max(1) as f64).sqrt()
    }
}

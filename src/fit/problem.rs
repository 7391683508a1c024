//! Distances of cloud points and silhouette rays to the skin, priors and smoothness as one arrow-structured problem.
//!
//! cost = ½ Σ_i ω_i r_i² + ½ Σ α_i²/λ_i + ½ (ln s/s_0)²/σ_s² + ½ Σ (ℓ−1)²/σ_ℓ² + ½ Σ (w−1)²/σ_w²
//!      + ½ Σ_t (|g̈|²/σ_a² + |ω̇|²/σ_ω² + μ̈²/σ_μ² + tilt²/σ_t²).                                               (1)
//! r_i is equation (2) of body::surface with κ_i = 1/|∇√d_eff| frozen, ω_i a frozen Cauchy weight over the variance of the
//! point along the normal; both are refreshed between solver runs, because a step built on frozen weights but judged by
//! the robust cost is rejected for ever. A silhouette ray counts as the point of the ray nearest to the skin; that point is
//! frozen too (envelope theorem: its motion along the ray changes the distance in second order only).
//! A primitive's centre that projects outside a silhouette counts with its distance to it, else nothing would hold back
//! limbs that reach where no point is.
//! Feet do not sink into the floor: a foot primitive counts with the depth of its underside below it; rays that pass the
//! body just above the floor see contact shadows as often as soles and are left out.
//! Stereo sees front sides: a point where the skin faces away from the cameras has weight zero.
//! Checked against central differences for every kind of unknown.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use rayon::prelude::*;

use super::curve::Curve;
use super::state::{HELD, LOCAL, Layout, Motion, State};
use super::weighing::{Fitness, Frozen, FrozenOutside, PointResidual, freeze, freeze_outsides, outside_px};
use super::wrench::{FrameNormal, Gathered, Gradient, Pull};
use crate::body::surface::{Evaluation, SKIN};
use crate::body::{Joint, Length, NODES, PosedSurface, Surface};
use crate::math::arrow::{ArrowProblem, NormalEquations};
use crate::math::distance_field::DistanceField;
use crate::math::rotation::{hat, left_jacobian, log};
use crate::rig::Camera;

/// One measurement of the skin.
#[derive(Clone, Debug)]
pub enum Target {
    /// A cloud point on the skin, with its covariance, m².
    Point { x: Vector3<f64>, covariance: Matrix3<f64> },
    /// A ray that grazes the body; the blur of the outline is `sigma` radians wide.
    Ray { origin: Vector3<f64>, direction: Vector3<f64>, sigma: f64 },
}

/// The distance to a silhouette in one camera's picture.
#[derive(Clone, Debug)]
pub struct Outside {
    pub camera: Camera,
    /// Pixels.
    pub field: DistanceField,
}

/// What one frame shows.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    pub time_s: f64,
    pub targets: Vec<Target>,
    pub outsides: Arc<Vec<Outside>>,
}

impl Frame {
    /// With every second target.
    pub fn half(&self) -> Frame {
        Frame { time_s: self.time_s, targets: self.targets.iter().step_by(2).cloned().collect(), outsides: self.outsides.clone() }
    }
}

/// Standard deviations and weights of equation (1).
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    pub residual: PointResidual,
    /// Derivatives are taken at the skin, not at the targets: right in noise, but slow from afar.
    pub at_skin: bool,
    /// Difference between the person's skin and the model's, m; large at the start so that far points pull.
    pub model_m: f64,
    /// Share of a cloud point that is new information: neighbours share their correlation window.
    pub point_weight: f64,
    pub ray_weight: f64,
    /// Of a primitive outside a silhouette.
    pub outside_weight: f64,
    pub acceleration: f64,
    pub angular_acceleration: f64,
    pub phase_acceleration: f64,
    /// Lean of the carrier against the vertical, rad.
    pub tilt: f64,
    pub stature: f64,
    pub length: f64,
    pub arm_length: f64,
    pub width: f64,
    /// Constant turn of a joint against the model, rad, and of a wrist, which marker sets hold least alike.
    pub posture: f64,
    pub wrist: f64,
    /// Turn of a joint against the model in one frame, rad, and its acceleration, rad/s².
    pub deviation: f64,
    pub turn_acceleration: f64,
}

impl Settings {
    /// Standard deviation of a joint's posture, rad.
    pub fn posture_of(&self, joint: Joint) -> f64 {
        if matches!(joint, Joint::LWrist | Joint::RWrist) { self.wrist } else { self.posture }
    }
}

/// What is known before the fit.
#[derive(Clone, Copy, Debug)]
pub struct Known {
    /// Centre of the cameras, metres.
    pub viewpoint: Vector3<f64>,
    pub up: Vector3<f64>,
    /// Expected stature, metres.
    pub stature_m: f64,
    /// Height of the floor along `up`, metres, where it is known.
    pub floor_m: Option<f64>,
}

/// Which unknowns may move.
#[derive(Clone, Copy, Debug, Default)]
pub struct Free {
    pub rotation: bool,
    pub phase: bool,
    pub weights: bool,
    pub stature: bool,
    pub lengths: bool,
    pub widths: bool,
    pub posture: bool,
}

/// The problem at one set of frozen weights.
pub struct Problem<'a> {
    pub curve: &'a Curve,
    pub frames: &'a [Frame],
    pub settings: &'a Settings,
    pub free: Free,
    pub known: &'a Known,
    frozen: Vec<Vec<Frozen>>,
    /// Per frame, outside and primitive.
    frozen_outsides: Vec<Vec<FrozenOutside>>,
    /// How well the frames are explained where the weights were frozen.
    pub fitness: Vec<Fitness>,
}

/// Precision of the floor times the share of new information per primitive: 15 mm, 0.3.
const SUNKEN_WEIGHT: f64 = 0.3 / (0.015 * 0.015);
/// Frames whose normal equations are held at the same time; bounds the memory of long sequences.
const AT_ONCE: usize = 64;

/// Precision of what may not move: its variance is nought.
const PINNED: f64 = 1e24;

impl<'a> Problem<'a> {
    pub fn new(curve: &'a Curve, frames: &'a [Frame], settings: &'a Settings, free: Free, known: &'a Known, state: &State) -> Problem<'a> {
        let body = Surface::new(&state.shape);
        let of_frame = |t: usize| {
            let surface = state.posed(curve, &body, t).surface;
            let (frozen, points) = freeze(&frames[t], &surface, settings, known);
            let (outsides, cost) = freeze_outsides(&frames[t], &surface, settings);
            (frozen, (outsides, Fitness { cost: points.cost + cost, ..points }))
        };
        let (frozen, (frozen_outsides, fitness)) = (0..frames.len()).into_par_iter().map(of_frame).unzip();
        Problem { curve, frames, settings, free, known, frozen, frozen_outsides, fitness }
    }

    /// The residuals of each frame as frozen.
    pub fn frozen(&self) -> &[Vec<Frozen>] {
        &self.frozen
    }

    /// The same problem with other weights of the targets.
    pub fn reweighted(mut self, weight: impl Fn(&Frozen) -> f64) -> Problem<'a> {
        self.frozen.iter_mut().flatten().for_each(|f| f.weight = weight(f));
        self
    }

    /// Pull of a force on the centre of primitive `index`, which also scales with the sizes; not its widths.
    fn pull_at_centre(motion: &Motion, state: &State, frame: usize, index: usize, force: &Vector3<f64>, pull: &mut Pull) {
        let p = &motion.surface.primitives[index];
        let layout = state.layout();
        let size = |at: usize| at - layout.stature();
        pull.clear();
        pull.force(p.node as usize, &p.centre, force);
        pull.size(0, force.dot(&(p.centre - state.carriers[frame].position)));
        let growth = p.world_from_node * p.lengthening(&Vector3::zeros()) / state.shape.lengths[p.limb as usize];
        pull.size(size(layout.length(p.limb)), force.dot(&growth));
    }

    /// The residual as frozen, with the pull whose multiple by the second value is its derivative.
    #[inline(always)]
    fn residual(motion: &Motion, state: &State, frame: usize, frozen: &Frozen, scratch: &mut Scratch) -> (f64, f64) {
        let surface = &motion.surface;
        surface.evaluate_among(&frozen.near, &frozen.x, &mut scratch.evaluation);
        let e = &scratch.evaluation;
        let layout = state.layout();
        let size = |at: usize| at - layout.stature();
        let pull = &mut scratch.pull;
        pull.clear();
        let mut force = Vector3::zeros();
        for share in &e.shares {
            let p = &surface.primitives[share.primitive];
            force += share.force;
            pull.force(p.node as usize, &frozen.x, &share.force);
            let limb = p.limb as usize;
            let (length, width) = (state.shape.lengths[limb], state.shape.widths[limb]);
            let in_node = p.world_from_node.transpose() * share.force;
            pull.size(size(layout.length(p.limb)), in_node.dot(&p.lengthening(&share.unit)) / length);
            pull.size(size(layout.width(p.limb)), in_node.dot(&p.widening(&share.unit)) / width);
        }
        pull.size(0, force.dot(&(frozen.x - state.carriers[frame].position)));
        let (residual, slope) = frozen.at(e.root());
        (residual, -slope * e.root_slope())
    }

    fn frame_normal(&self, state: &State, surface: &Surface, frame: usize) -> FrameNormal {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.frame_normal_avx2(state, surface, frame) };
        }
        self.frame_normal_with(state, surface, frame)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn frame_normal_avx2(&self, state: &State, surface: &Surface, frame: usize) -> FrameNormal {
        self.frame_normal_with(state, surface, frame)
    }

    #[inline(always)]
    fn frame_normal_with(&self, state: &State, surface: &Surface, frame: usize) -> FrameNormal {
        let motion = state.motion(self.curve, surface, frame);
        let mut scratch = Scratch::default();
        let mut gathered = Gathered::new();
        for frozen in self.frozen[frame].iter().filter(|f| f.weight > 0.0) {
            let (residual, factor) = Self::residual(&motion, state, frame, frozen, &mut scratch);
            gathered.add(residual, frozen.weight, factor, &mut scratch.pull);
        }
        for (outside, frozen) in self.outsides(frame) {
            for (index, frozen) in frozen.iter().enumerate() {
                let centre = &motion.surface.primitives[index].centre;
                let residual = outside_px(outside, centre) * frozen.metres_per_px;
                if residual > 0.0
                    && let Some((pixel, jacobian)) = outside.camera.project_with_jacobian(centre)
                {
                    let gradient = nalgebra::Vector2::from(outside.field.at(pixel.x, pixel.y).1);
                    let force = jacobian.transpose() * gradient * frozen.metres_per_px;
                    Self::pull_at_centre(&motion, state, frame, index, &force, &mut scratch.pull);
                    gathered.add(residual, frozen.weight, 1.0, &mut scratch.pull);
                }
            }
        }
        for index in feet(&motion.surface) {
            let p = &motion.surface.primitives[index];
            let residual = sunken_m(self.known, &p.centre, p.semi_axes.y);
            if residual > 0.0 {
                let radius = underside(p.semi_axes.y);
                Self::pull_at_centre(&motion, state, frame, index, &-self.known.up, &mut scratch.pull);
                scratch.pull.size(0, radius);
                let layout = state.layout();
                scratch.pull.size(layout.width(p.limb) - layout.stature(), radius / state.shape.widths[p.limb as usize]);
                gathered.add(residual, SUNKEN_WEIGHT, 1.0, &mut scratch.pull);
            }
        }
        gathered.expand(&motion, state.layout(), self.moving(state.layout()))
    }

    /// Σ ω j over the residuals at the skin of each node: minus how the unknowns are pulled when a node's skin lies one
    /// metre off in all frames. A row per unknown of the frames, then the shared ones; a column per node.
    pub fn skin_pulls(&self, state: &State) -> DMatrix<f64> {
        let surface = Surface::new(&state.shape);
        let layout = state.layout();
        let of_frame = |frame: usize| -> Vec<Vec<f64>> {
            let motion = state.motion(self.curve, &surface, frame);
            let mut scratch = Scratch::default();
            let mut nodes = vec![Gradient::new(); NODES];
            for frozen in self.frozen[frame].iter().filter(|f| f.weight > 0.0) {
                let (_, factor) = Self::residual(&motion, state, frame, frozen, &mut scratch);
                nodes[frozen.node as usize].add(frozen.weight * factor, &scratch.pull);
            }
            nodes.iter().map(|node| node.expand(&motion, layout, self.moving(layout))).collect()
        };
        let frames: Vec<_> = (0..self.frames.len()).into_par_iter().map(of_frame).collect();
        let locals = layout.local * frames.len();
        let mut pulls = DMatrix::zeros(locals + layout.shared(), NODES);
        for (t, nodes) in frames.iter().enumerate() {
            for (n, pull) in nodes.iter().enumerate() {
                for (i, value) in pull.iter().enumerate() {
                    let row = if i < layout.local { t * layout.local + i } else { locals + i - layout.local };
                    pulls[(row, n)] += value;
                }
            }
        }
        pulls
    }

    /// How many of the unknowns can move a frame: the posture, last of them, is often pinned.
    fn moving(&self, layout: Layout) -> usize {
        if self.free.posture { layout.size() } else { layout.local + layout.posture(0) }
    }

    /// The silhouettes of a frame with their frozen quantities, one per primitive.
    fn outsides(&self, frame: usize) -> impl Iterator<Item = (&Outside, &[FrozenOutside])> {
        let outsides = &self.frames[frame].outsides;
        let frozen = &self.frozen_outsides[frame];
        let each = frozen.len() / outsides.len().max(1);
        outsides.iter().zip(frozen.chunks(each.max(1)))
    }

    fn frame_cost(&self, state: &State, surface: &Surface, frame: usize) -> f64 {
        let posed = state.posed(self.curve, surface, frame);
        let squares = self.frozen[frame].iter().filter(|f| f.weight > 0.0).map(|f| {
            let (r, _) = f.at(posed.surface.root_among(&f.near, &f.x));
            0.5 * f.weight * r * r
        });
        let points: f64 = squares.sum();
        let outside = self.outsides(frame).flat_map(|(outside, frozen)| {
            posed
                .surface
                .primitives
                .iter()
                .zip(frozen)
                .map(|(p, f)| 0.5 * f.weight * (outside_px(outside, &p.centre) * f.metres_per_px).powi(2))
        });
        let sunken = feet(&posed.surface).map(|i| {
            let p = &posed.surface.primitives[i];
            0.5 * SUNKEN_WEIGHT * sunken_m(self.known, &p.centre, p.semi_axes.y).max(0.0).powi(2)
        });
        points + outside.sum::<f64>() + sunken.sum::<f64>()
    }

    /// What priors and smoothness alone cost.
    pub fn prior_cost(&self, state: &State) -> f64 {
        let shared: f64 = self.shared_priors(state).iter().map(|(_, r, _)| r * r).sum();
        let local: f64 = self.local_priors(state).iter().map(|(r, _)| r * r).sum();
        0.5 * (shared + local)
    }

    /// Residuals of the shared priors: index into z, value, derivative.
    fn shared_priors(&self, state: &State) -> Vec<(usize, f64, f64)> {
        let layout = state.layout();
        let s = self.settings;
        let mut priors: Vec<_> = state
            .weights
            .iter()
            .zip(&self.curve.eigenvalues)
            .enumerate()
            .map(|(i, (a, lambda))| (i, a / lambda.sqrt(), 1.0 / lambda.sqrt()))
            .collect();
        priors.push((layout.stature(), (state.shape.stature_m / self.known.stature_m).ln() / s.stature, 1.0 / s.stature));
        for i in 0..Length::COUNT {
            let arm = [Length::Shoulders, Length::UpperArm, Length::Forearm, Length::Hand].iter().any(|l| *l as usize == i);
            let sigma = if arm { s.arm_length } else { s.length };
            priors.push((layout.weights + 1 + i, (state.shape.lengths[i] - 1.0) / sigma, 1.0 / sigma));
            priors.push((layout.weights + 1 + Length::COUNT + i, (state.shape.widths[i] - 1.0) / s.width, 1.0 / s.width));
        }
        let turns = state.posture.iter().flat_map(|turn| turn.iter()).enumerate();
        priors.extend(turns.map(|(k, turn)| {
            let sigma = s.posture_of(HELD[k / 3]);
            (layout.posture(0) + k, turn / sigma, 1.0 / sigma)
        }));
        priors
    }

    /// Residuals that tie frames together: value and (index into y, derivative) pairs.
    fn local_priors(&self, state: &State) -> Vec<(f64, Vec<(usize, f64)>)> {
        let mut priors = Vec::new();
        let c = &state.carriers;
        let local = state.layout().local;
        let tilt = self.settings.tilt * (c.len() as f64).sqrt();
        for (t, carrier) in c.iter().enumerate() {
            let up_in_carrier = carrier.world_from_carrier.inverse() * self.known.up;
            let slope = carrier.world_from_carrier.inverse().to_rotation_matrix().into_inner() * hat(&self.known.up);
            for axis in [0, 2] {
                let row = (0..3).map(|k| (local * t + k, slope[(axis, k)] / tilt)).collect();
                priors.push((up_in_carrier[axis] / tilt, row));
            }
        }
        for t in 1..c.len().saturating_sub(1) {
            let before = self.frames[t].time_s - self.frames[t - 1].time_s;
            let after = self.frames[t + 1].time_s - self.frames[t].time_s;
            let mid = 0.5 * (before + after);
            let (p, n) = (1.0 / (before * mid), 1.0 / (after * mid));
            let second = |previous: f64, now: f64, next: f64| previous * p + next * n - now * (p + n);
            let stencil = |offset: usize, sigma: f64| {
                vec![(local * (t - 1) + offset, p / sigma), (local * t + offset, -(p + n) / sigma), (local * (t + 1) + offset, n / sigma)]
            };
            for axis in 0..3 {
                let value = second(c[t - 1].position[axis], c[t].position[axis], c[t + 1].position[axis]);
                priors.push((value / self.settings.acceleration, stencil(3 + axis, self.settings.acceleration)));
            }
            let value = second(c[t - 1].phase, c[t].phase, c[t + 1].phase);
            priors.push((value / self.settings.phase_acceleration, stencil(6, self.settings.phase_acceleration)));
            for k in 0..local.saturating_sub(LOCAL) {
                let turn = |frame: usize| state.deviations[frame][k / 3][k % 3];
                let sigma = self.settings.turn_acceleration;
                priors.push((second(turn(t - 1), turn(t), turn(t + 1)) / sigma, stencil(LOCAL + k, sigma)));
            }
            priors.extend(self.turn_priors(state, t, p, n));
        }
        for (t, turns) in state.deviations.iter().enumerate() {
            let sigma = self.settings.deviation;
            let each = turns.iter().flat_map(|turn| turn.iter()).enumerate();
            priors.extend(each.map(|(k, turn)| (turn / sigma, vec![(local * t + LOCAL + k, 1.0 / sigma)])));
        }
        priors
    }

    /// Angular acceleration n log(R_{t+1} R_tᵀ) + p log(R_{t−1} R_tᵀ) over its sigma, by axis.
    fn turn_priors(&self, state: &State, t: usize, p: f64, n: f64) -> Vec<(f64, Vec<(usize, f64)>)> {
        let c = &state.carriers;
        let local = state.layout().local;
        let now = c[t].world_from_carrier.inverse();
        let (to_next, to_previous) = (log(&(c[t + 1].world_from_carrier * now)), log(&(c[t - 1].world_from_carrier * now)));
        // d log(exp(δ) R) = J_l⁻¹ δ and d log(R exp(−δ)) = −J_r⁻¹ δ with J_r(v) = J_l(−v); J_l is regular below 2π.
        let inverse = |v: Vector3<f64>| left_jacobian(&v).try_inverse().unwrap_or_else(Matrix3::identity);
        let sigma = self.settings.angular_acceleration;
        let value = (to_next * n + to_previous * p) / sigma;
        let next = inverse(to_next) * (n / sigma);
        let previous = inverse(to_previous) * (p / sigma);
        let middle = -(inverse(-to_next) * (n / sigma) + inverse(-to_previous) * (p / sigma));
        let row = |axis: usize| {
            [(t - 1, &previous), (t, &middle), (t + 1, &next)]
                .iter()
                .flat_map(|(f, m)| (0..3).map(move |k| (local * f + k, m[(axis, k)])))
                .collect()
        };
        (0..3).map(|axis| (value[axis], row(axis))).collect()
    }

    fn pin(&self, normal: &mut NormalEquations, layout: Layout) {
        let frozen_local = |k: usize| (k < 3 && !self.free.rotation) || (k == 6 && !self.free.phase);
        for i in 0..normal.local.size() {
            if frozen_local(i % layout.local) {
                normal.local.isolate(i);
                normal.border.row_mut(i).fill(0.0);
                normal.local_gradient[i] = 0.0;
            }
        }
        for i in 0..layout.shared() {
            let free = if i < layout.weights {
                self.free.weights
            } else if i == layout.stature() {
                self.free.stature
            } else if i < layout.width(Length::Pelvis) {
                self.free.lengths
            } else if i < layout.posture(0) {
                self.free.widths
            } else {
                self.free.posture
            };
            if !free {
                normal.shared.row_mut(i).fill(0.0);
                normal.shared.column_mut(i).fill(0.0);
                normal.shared[(i, i)] = PINNED;
                normal.border.column_mut(i).fill(0.0);
                normal.shared_gradient[i] = 0.0;
            }
        }
    }
}

/// Primitives of the feet; their chains run along z, so y is their height.
fn feet(surface: &PosedSurface) -> impl Iterator<Item = usize> + '_ {
    let on_foot = |node: Joint| matches!(node, Joint::LAnkle | Joint::RAnkle | Joint::LMidtarsal | Joint::RMidtarsal);
    surface.primitives.iter().enumerate().filter(move |(_, p)| on_foot(p.node)).map(|(i, _)| i)
}

/// Skin below the centre of a chain's primitive of this semi-axis, metres.
fn underside(semi_axis: f64) -> f64 {
    SKIN.sqrt() * semi_axis
}

fn sunken_m(known: &Known, centre: &Vector3<f64>, semi_axis: f64) -> f64 {
    known.floor_m.map_or(f64::NEG_INFINITY, |floor| floor - centre.dot(&known.up) + underside(semi_axis))
}

#[derive(Default)]
struct Scratch {
    evaluation: Evaluation,
    pull: Pull,
}

impl ArrowProblem for Problem<'_> {
    type State = State;

    fn cost(&self, state: &State) -> f64 {
        let surface = Surface::new(&state.shape);
        let frames: Vec<f64> = (0..self.frames.len()).into_par_iter().map(|t| self.frame_cost(state, &surface, t)).collect();
        frames.iter().sum::<f64>() + self.prior_cost(state)
    }

    fn linearise(&self, state: &State) -> NormalEquations {
        let surface = Surface::new(&state.shape);
        let layout = state.layout();
        let count = self.frames.len();
        let mut normal = NormalEquations::zeros(layout.local * count, 3 * layout.local - 1, layout.shared());
        for first in (0..count).step_by(AT_ONCE) {
            let some = first..count.min(first + AT_ONCE);
            let frames: Vec<FrameNormal> = some.into_par_iter().map(|t| self.frame_normal(state, &surface, t)).collect();
            frames.iter().zip(first..).for_each(|(frame, t)| frame.scatter(t, layout.local, &mut normal));
        }
        for (i, r, slope) in self.shared_priors(state) {
            normal.cost += 0.5 * r * r;
            normal.shared[(i, i)] += slope * slope;
            normal.shared_gradient[i] += slope * r;
        }
        for (r, row) in self.local_priors(state) {
            normal.cost += 0.5 * r * r;
            for (i, a) in &row {
                normal.local_gradient[*i] += a * r;
                for (j, b) in row.iter().filter(|(j, _)| j <= i) {
                    normal.local.add(*i, *j, a * b);
                }
            }
        }
        self.pin(&mut normal, layout);
        normal
    }

    fn retract(&self, state: &State, y: &DVector<f64>, z: &DVector<f64>) -> State {
        state.moved(y.as_slice(), z.as_slice())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::body::Shape;
    use crate::fit::curve::tests::made_up_model;
    use crate::fit::state::Carrier;
    use crate::math::rotation::exp;

    pub const SETTINGS: Settings = Settings {
        residual: PointResidual::Distance,
        at_skin: true,
        model_m: 0.03,
        point_weight: 0.1,
        ray_weight: 0.1,
        outside_weight: 0.3,
        acceleration: 1.0,
        angular_acceleration: 4.0,
        phase_acceleration: 1.0,
        tilt: 0.1,
        stature: 0.05,
        length: 0.03,
        arm_length: 0.06,
        width: 0.1,
        posture: 0.1,
        wrist: 0.2,
        deviation: 0.1,
        turn_acceleration: 5.0,
    };
    pub const KNOWN: Known =
        Known { viewpoint: Vector3::new(0.1, 0.0, 1.0), up: Vector3::new(0.0, 0.0, 1.0), stature_m: 1.75, floor_m: Some(0.12) };
    pub const ALL: Free = Free { rotation: true, phase: true, weights: true, stature: true, lengths: true, widths: true, posture: true };

    pub fn state() -> State {
        let mut shape = Shape::template(1.7);
        shape.lengths = std::array::from_fn(|i| 1.0 + 0.05 * (i as f64).sin());
        shape.widths = std::array::from_fn(|i| 1.0 + 0.08 * (2.0 * i as f64).cos());
        let carriers = (0..3).map(|t| Carrier {
            position: Vector3::new(0.3 + 0.04 * t as f64, 3.0 - 0.01 * (t * t) as f64, 0.9),
            world_from_carrier: exp(&Vector3::new(1.5, 0.1 * t as f64, 0.2 + 0.03 * (t * t) as f64)),
            phase: 0.21 + 0.033 * t as f64 + 0.004 * (t * t) as f64,
        });
        let turn = |a: f64, k: usize| 0.1 * Vector3::new((a + k as f64).sin(), (a * k as f64).cos(), a.cos());
        let deviations = (0..3).map(|t| std::array::from_fn(|k| turn(1.0 + t as f64, k))).collect();
        let posture = std::array::from_fn(|k| turn(0.3, k));
        State { carriers: carriers.collect(), weights: vec![2.0, -1.5, 0.7], shape, posture, deviations }
    }

    /// Points around the skin and rays past it.
    pub fn frames(curve: &Curve, state: &State) -> Vec<Frame> {
        (0..3)
            .map(|t| {
                let surface = state.posed(curve, &Surface::new(&state.shape), t).surface;
                let targets = surface.primitives.iter().enumerate().map(|(i, p)| {
                    let aside = Vector3::new((i as f64).sin(), (1.7 * i as f64).cos(), (0.6 * i as f64).sin()) * 0.12;
                    let x = p.centre + aside;
                    if i % 3 == 0 {
                        let origin = Vector3::new(0.1, 0.0, 1.0);
                        Target::Ray { origin, direction: (x - origin).normalize(), sigma: 0.002 }
                    } else {
                        Target::Point { x, covariance: Matrix3::from_diagonal(&Vector3::new(1e-4, 4e-4, 1e-4)) }
                    }
                });
                // A silhouette that half of the body is outside of, seen by a distorted camera at the world's origin.
                let camera = Camera {
                    name: "test".into(),
                    size_px: [640, 480],
                    matrix: Matrix3::new(550.0, 0.0, 320.0, 0.0, 545.0, 240.0, 0.0, 0.0, 1.0),
                    lens: crate::rig::Lens::BrownConrady([-0.08, 0.01, 1e-3, -5e-4, 0.0, 0.0, 0.0, 0.0]),
                    camera_from_world: nalgebra::Rotation3::new(Vector3::new(1.62, -0.01, 0.02)),
                    translation: Vector3::new(0.02, 0.95, 0.05),
                };
                let field = DistanceField::new(640, 480, 2, |x, y| x * 3 + y < 1200);
                Frame { time_s: [0.0, 0.033, 0.1][t], targets: targets.collect(), outsides: Arc::new(vec![Outside { camera, field }]) }
            })
            .collect()
    }

    #[test]
    fn gradient_of_every_unknown_matches_central_differences() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let frames = frames(&curve, &state);
        let problem = Problem::new(&curve, &frames, &SETTINGS, ALL, &KNOWN, &state);
        let normal = problem.linearise(&state);
        assert!((normal.cost - problem.cost(&state)).abs() < 1e-9 * normal.cost);
        assert!(
            freeze_outsides(&frames[1], &state.posed(&curve, &Surface::new(&state.shape), 1).surface, &SETTINGS).1 > 1.0,
            "the silhouette must matter"
        );
        let (locals, shareds) = (normal.local_gradient.len(), normal.shared_gradient.len());
        for i in 0..locals + shareds {
            let at = |h: f64| {
                let mut step = vec![0.0; locals + shareds];
                step[i] = h;
                problem.cost(&state.moved(&step[..locals], &step[locals..]))
            };
            let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
            let analytic = if i < locals { normal.local_gradient[i] } else { normal.shared_gradient[i - locals] };
            assert!(
                (numeric - analytic).abs() < 1e-5 * (1.0 + numeric.abs()),
                "unknown {i} of {locals} + {shareds}: {numeric} against {analytic}"
            );
        }
    }

    #[test]
    fn rows_of_every_residual_match_central_differences() {
        [PointResidual::Distance, PointResidual::Ray, PointResidual::Field].into_iter().for_each(rows_match_central_differences);
    }

    fn rows_match_central_differences(residual: PointResidual) {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let frames = frames(&curve, &state);
        let settings = Settings { residual, ..SETTINGS };
        let problem = Problem::new(&curve, &frames, &settings, ALL, &KNOWN, &state);
        assert_eq!(problem.frozen.iter().flatten().any(|f| f.is_point && f.offset_m.abs() > 1e-3), residual != PointResidual::Field);
        let layout = state.layout();
        let motion = state.motion(&curve, &Surface::new(&state.shape), 1);
        for frozen in &problem.frozen[1] {
            let mut scratch = Scratch::default();
            let factor = Problem::residual(&motion, &state, 1, frozen, &mut scratch).1;
            let mut gathered = Gathered::new();
            gathered.add(1.0, 1.0, factor, &mut scratch.pull);
            let row = gathered.expand(&motion, layout, layout.size()).gradient;
            for (i, analytic) in row.iter().enumerate() {
                let at = |h: f64| {
                    let (mut y, mut z) = (vec![0.0; 3 * layout.local], vec![0.0; layout.shared()]);
                    if i < layout.local {
                        y[layout.local + i] = h
                    } else {
                        z[i - layout.local] = h
                    }
                    let moved = state.moved(&y, &z);
                    let mut evaluation = Evaluation::default();
                    moved.posed(&curve, &Surface::new(&moved.shape), 1).surface.evaluate_among(&frozen.near, &frozen.x, &mut evaluation);
                    frozen.at(evaluation.root()).0
                };
                let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((numeric - analytic).abs() < 1e-6 * (1.0 + numeric.abs()), "unknown {i}: {numeric} against {analytic}");
            }
        }
    }

    fn to_the_skin(surface: &PosedSurface, x: &mut Vector3<f64>) {
        for _ in 0..20 {
            let at = surface.evaluate(x);
            *x -= at.gradient.normalize() * at.distance().clamp(-0.02, 0.02);
        }
    }

    #[test]
    fn skin_that_is_off_pulls_as_points_that_are_moved() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let mut frames = frames(&curve, &state);
        for (t, frame) in frames.iter_mut().enumerate() {
            let posed = state.posed(&curve, &Surface::new(&state.shape), t).surface;
            for target in &mut frame.targets {
                if let Target::Point { x, .. } = target {
                    to_the_skin(&posed, x);
                }
            }
        }
        let mut problem = Problem::new(&curve, &frames, &SETTINGS, ALL, &KNOWN, &state);
        let (pulls, before) = (problem.skin_pulls(&state), problem.linearise(&state));
        let node = problem.frozen.iter().flatten().filter(|f| f.is_point).max_by(|a, b| a.weight.total_cmp(&b.weight)).unwrap().node;
        let (surface, off_m) = (Surface::new(&state.shape), 1e-6);
        for t in 0..frames.len() {
            let posed = state.posed(&curve, &surface, t).surface;
            for frozen in problem.frozen[t].iter_mut().filter(|f| f.node == node) {
                let mut evaluation = Evaluation::default();
                posed.evaluate_among(&frozen.near, &frozen.x, &mut evaluation);
                let slope = frozen.metres_per_root * evaluation.gradient * evaluation.root_slope();
                // The distance grows by as much, and the force keeps its place in first order only where residuals are small.
                frozen.x += slope * (off_m / slope.norm_squared());
            }
        }
        let after = problem.linearise(&state);
        let moved = |i: usize, locals: usize| {
            if i < locals {
                after.local_gradient[i] - before.local_gradient[i]
            } else {
                after.shared_gradient[i - locals] - before.shared_gradient[i - locals]
            }
        };
        let locals = before.local_gradient.len();
        let column = pulls.column(node as usize);
        let numeric = DVector::from_fn(column.len(), |i, _| moved(i, locals) / off_m);
        assert!(
            column.norm() > 1.0 && (&numeric - column).norm() < 0.35 * column.norm(),
            "{} of {}",
            (&numeric - column).norm(),
            column.norm()
        );
    }

    #[test]
    fn pinned_unknowns_do_not_move() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = State { deviations: Vec::new(), ..state() };
        let frames = frames(&curve, &state);
        let free = Free { weights: true, ..Free::default() };
        let problem = Problem::new(&curve, &frames, &SETTINGS, free, &KNOWN, &state);
        let (y, z) = problem.linearise(&state).step(0.1).unwrap();
        assert!(y.iter().enumerate().all(|(i, v)| (3..6).contains(&(i % LOCAL)) || *v == 0.0));
        assert!(z.rows(0, 3).amax() > 0.0 && z.rows(3, z.len() - 3).amax() == 0.0);
    }
}

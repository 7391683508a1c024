//! Markers against the body as one arrow-structured problem.
//!
//! cost = Σ_t Σ_m ½ c² ln(1 + |p_m(t) − x_m(t)|²/(σ c)²) + ½ Σ_t Σ_j |W_j log(q̄_j⁻¹ q_j)|²
//!      + ½ Σ_t (|Δroot|²/σ_v² + Σ_j |log(q_j(t−1)⁻¹ q_j(t))|²/σ_ω²)/Δt²
//!      + ½ ((s − s_0)/σ_s s_0)² + ½ Σ_g (ℓ_g − 1)²/σ_ℓ² + ½ Σ_m |o_m − ō_m|²/σ_m²,                            (1)
//!   p_m = P_on + R_on (ℓ s e_near + o_m).
//! Local unknowns are root and seen joints of a frame, chained with the frame before; shared ones are stature s, lengths ℓ and
//! marker offsets o. Cauchy's loss lets go of exchanged markers; the Gauss–Newton matrix takes its weight 1/(1 + r²/c²), the
//! gradient is exact. Rotations are perturbed on the right. Checked against central differences.

use nalgebra::{DMatrix, DVector, Matrix3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::set::{MarkerSet, Match, STATURE_M};
use crate::body::{Joint, Length, Placement, Pose, Shape, place};
use crate::math::arrow::{ArrowProblem, NormalEquations};
use crate::math::rotation::{exp, hat, left_jacobian, log};

/// Skin over bone and what the skeleton cannot follow, metres.
const MARKER_M: f64 = 0.01;
/// Stature against the first guess, segments against the template, parts.
const STATURE: f64 = 0.08;
const LENGTH: f64 = 0.06;
/// Speeds that a body reaches: they bridge gaps and hardly touch what is seen. m/s and rad/s.
const ROOT_M_S: f64 = 6.0;
const TURN_RAD_S: f64 = 12.0;
/// First unknowns of a frame: turn and shift of the root; then three per seen joint.
const ROOT: usize = 6;
/// First shared unknowns: stature, lengths; then three per marker.
const SIZES: usize = 1 + Length::COUNT;

/// Joints that markers can move, with what is known of their rotation vectors: mean flexion and standard deviations about
/// x (flexion), y (twist) and z (to the side), degrees. Large is free, small holds what markers on skin cannot tell.
const JOINTS: [(Joint, f64, [f64; 3]); 16] = [
    (Joint::LHip, -10.0, [40.0, 15.0, 12.0]),
    (Joint::LKnee, 30.0, [45.0, 6.0, 4.0]),
    (Joint::LAnkle, 0.0, [25.0, 8.0, 8.0]),
    (Joint::RHip, -10.0, [40.0, 15.0, 12.0]),
    (Joint::RKnee, 30.0, [45.0, 6.0, 4.0]),
    (Joint::RAnkle, 0.0, [25.0, 8.0, 8.0]),
    (Joint::Vl5, 0.0, [15.0, 15.0, 12.0]),
    (Joint::Skullbase, 0.0, [25.0, 40.0, 20.0]),
    (Joint::LSternoclavicular, 0.0, [5.0, 12.0, 12.0]),
    (Joint::LShoulder, 0.0, [60.0, 40.0, 40.0]),
    (Joint::LElbow, -50.0, [50.0, 40.0, 6.0]),
    (Joint::RSternoclavicular, 0.0, [5.0, 12.0, 12.0]),
    (Joint::RShoulder, 0.0, [60.0, 40.0, 40.0]),
    (Joint::RElbow, -50.0, [50.0, 40.0, 6.0]),
    (Joint::LWrist, 0.0, [25.0, 10.0, 20.0]),
    (Joint::RWrist, 0.0, [25.0, 10.0, 20.0]),
];

/// A joint that moves in the solution.
#[derive(Clone, Debug)]
struct Moving {
    joint: Joint,
    mean: UnitQuaternion<f64>,
    /// Reciprocal standard deviations, 1/rad.
    certainty: Vector3<f64>,
}

/// What the markers of one person ask of the body; columns of frames are those of `matches`.
pub struct Person<'a> {
    pub set: &'a MarkerSet,
    pub matches: &'a [Match],
    pub stature_m: f64,
    moving: Vec<Moving>,
}

/// Unknowns of (1).
#[derive(Clone, Debug)]
pub struct State {
    pub shape: Shape,
    /// o_m from the node `near`, metres, by match.
    pub offsets: Vec<Vector3<f64>>,
    pub poses: Vec<Pose>,
}

/// Equation (1) over some frames.
pub struct Problem<'a> {
    pub person: &'a Person<'a>,
    pub frames: Vec<&'a [Option<Vector3<f64>>]>,
    /// Time from one of `frames` to the next, seconds.
    pub step_s: f64,
    /// c, in units of σ.
    pub cauchy: f64,
    /// Whether stature, lengths and offsets are unknowns too.
    pub shared: bool,
}

impl<'a> Person<'a> {
    pub fn new(set: &'a MarkerSet, matches: &'a [Match], stature_m: f64) -> Person<'a> {
        let seen = |joint: Joint| matches.iter().any(|m| chain(set.markers[m.marker].on).any(|j| j == joint));
        let moving = JOINTS.iter().filter(|(joint, ..)| seen(*joint)).map(|&(joint, flexion, spread)| Moving {
            joint,
            mean: exp(&Vector3::new(flexion.to_radians(), 0.0, 0.0)),
            certainty: Vector3::from(spread).map(|s| 1.0 / s.to_radians()),
        });
        Person { set, matches, stature_m, moving: moving.collect() }
    }

    /// The state before any marker is seen.
    pub fn rest(&self, frames: usize) -> State {
        let mut pose = Pose::rest(Vector3::zeros());
        for m in &self.moving {
            pose.joints[m.joint as usize - 1] = m.mean;
        }
        let offsets = (0..self.matches.len()).map(|i| self.nominal(i)).collect();
        State { shape: Shape::template(self.stature_m), offsets, poses: vec![pose; frames] }
    }

    fn nominal(&self, index: usize) -> Vector3<f64> {
        self.set.markers[self.matches[index].marker].at * (self.stature_m / STATURE_M)
    }

    /// Unknowns of a frame.
    fn width(&self) -> usize {
        ROOT + 3 * self.moving.len()
    }

    fn slot(&self, joint: Joint) -> Option<usize> {
        self.moving.iter().position(|m| m.joint == joint).map(|k| ROOT + 3 * k)
    }

    /// Where a marker rides, from its node, metres.
    fn arm(&self, state: &State, index: usize) -> Vector3<f64> {
        let marker = &self.set.markers[self.matches[index].marker];
        let to_near = if marker.near == marker.on { Vector3::zeros() } else { segment(&state.shape, marker.near) };
        to_near + state.offsets[index]
    }

    /// p_m of a placed body.
    pub fn position(&self, state: &State, placed: &Placement, index: usize) -> Vector3<f64> {
        let on = self.set.markers[self.matches[index].marker].on;
        placed.position(on) + placed.world_from_node[on as usize] * self.arm(state, index)
    }
}

/// From a node up to, not with, the root.
fn chain(from: Joint) -> impl Iterator<Item = Joint> {
    std::iter::successors(Some(from), |j| j.parent()).filter(|j| *j != Joint::Root)
}

/// Offset of a node from its parent.
fn segment(shape: &Shape, joint: Joint) -> Vector3<f64> {
    let unit = joint.rest_position() - joint.parent().map_or(Vector3::zeros(), Joint::rest_position);
    unit * shape.stature_m * shape.lengths[Length::above(joint) as usize]
}

/// Derivative of log(q̄⁻¹ q exp(δ)) by δ at v = log(q̄⁻¹ q).
fn by_right(v: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian(&-v).try_inverse().unwrap_or_else(Matrix3::identity)
}

/// What one frame adds to the normal equations.
struct Block {
    local: DMatrix<f64>,
    gradient: DVector<f64>,
    border: DMatrix<f64>,
    shared: DMatrix<f64>,
    shared_gradient: DVector<f64>,
}

/// Derivatives of a marker's position: columns of the frame's and the shared unknowns, three rows each.
struct Derivatives {
    local: Vec<(usize, Vector3<f64>)>,
    shared: Vec<(usize, Vector3<f64>)>,
}

impl Problem<'_> {
    fn shareds(&self) -> usize {
        if self.shared { SIZES + 3 * self.person.matches.len() } else { 1 }
    }

    /// Marker residuals of a frame: index of the match and p_m − x_m.
    fn residuals(&self, state: &State, placed: &Placement, frame: usize) -> Vec<(usize, Vector3<f64>)> {
        let residual = |(i, seen): (usize, &Option<Vector3<f64>>)| Some((i, self.person.position(state, placed, i) - (*seen)?));
        self.frames[frame].iter().enumerate().filter_map(residual).collect()
    }

    fn derivatives(&self, state: &State, placed: &Placement, index: usize) -> Derivatives {
        let marker = &self.person.set.markers[self.person.matches[index].marker];
        let p = self.person.position(state, placed, index);
        let mut found = Derivatives { local: Vec::new(), shared: Vec::new() };
        let turning = |node: Joint| {
            let rotation = placed.world_from_node[node as usize].to_rotation_matrix();
            -rotation.matrix() * hat(&(rotation.inverse() * (p - placed.position(node))))
        };
        let mut add = |at: usize, by: &Matrix3<f64>| found.local.extend((0..3).map(|k| (at + k, by.column(k).into_owned())));
        add(0, &turning(Joint::Root));
        add(3, &Matrix3::identity());
        for joint in chain(marker.on) {
            if let Some(slot) = self.person.slot(joint) {
                add(slot, &turning(joint));
            }
        }
        if self.shared {
            let mut sizes = [Vector3::zeros(); SIZES];
            let near = (marker.near != marker.on).then_some(marker.near);
            for joint in chain(marker.on).chain(near) {
                let parent = joint.parent().map_or(0, |p| p as usize);
                let along = placed.world_from_node[parent] * segment(&state.shape, joint);
                let group = Length::above(joint) as usize;
                sizes[0] += along / state.shape.stature_m;
                sizes[1 + group] += along / state.shape.lengths[group];
            }
            found.shared.extend(sizes.into_iter().enumerate());
            let rotation = placed.world_from_node[marker.on as usize].to_rotation_matrix();
            found.shared.extend((0..3).map(|k| (SIZES + 3 * index + k, rotation.matrix().column(k).into_owned())));
        }
        found
    }

    fn posture(&self, pose: &Pose) -> impl Iterator<Item = (usize, Vector3<f64>, Vector3<f64>)> {
        self.person.moving.iter().enumerate().map(|(k, m)| {
            let v = log(&(m.mean.inverse() * pose.joint(m.joint)));
            (ROOT + 3 * k, v, m.certainty)
        })
    }

    /// Turns from one frame to the next: slot, rotation vector, 1/σ.
    fn turns(&self, a: &Pose, b: &Pose) -> Vec<(usize, Vector3<f64>)> {
        let joints = self.person.moving.iter().enumerate();
        let of_joint = |(k, m): (usize, &Moving)| (ROOT + 3 * k, log(&(a.joint(m.joint).inverse() * b.joint(m.joint))));
        std::iter::once((0, log(&(a.world_from_root.inverse() * b.world_from_root)))).chain(joints.map(of_joint)).collect()
    }

    fn frame_cost(&self, state: &State, frame: usize) -> f64 {
        let pose = &state.poses[frame];
        let placed = place(&state.shape.offsets(), pose);
        let c2 = self.cauchy * self.cauchy;
        let of_marker = |(_, r): &(usize, Vector3<f64>)| 0.5 * c2 * (r.norm_squared() / (MARKER_M * MARKER_M * c2)).ln_1p();
        let markers: f64 = self.residuals(state, &placed, frame).iter().map(of_marker).sum();
        let posture: f64 = self.posture(pose).map(|(_, v, w)| 0.5 * v.component_mul(&w).norm_squared()).sum();
        let Some(before) = frame.checked_sub(1).map(|f| &state.poses[f]) else { return markers + posture };
        let turns: f64 = self.turns(before, pose).iter().map(|(_, v)| v.norm_squared()).sum();
        let moved = (pose.root - before.root).norm_squared();
        markers + posture + 0.5 * (turns / (TURN_RAD_S * self.step_s).powi(2) + moved / (ROOT_M_S * self.step_s).powi(2))
    }

    fn block(&self, state: &State, frame: usize) -> Block {
        let (width, shareds) = (self.person.width(), self.shareds());
        let mut block = Block {
            local: DMatrix::zeros(width, width),
            gradient: DVector::zeros(width),
            border: DMatrix::zeros(width, shareds),
            shared: DMatrix::zeros(shareds, shareds),
            shared_gradient: DVector::zeros(shareds),
        };
        let placed = place(&state.shape.offsets(), &state.poses[frame]);
        for (index, r) in self.residuals(state, &placed, frame) {
            let weight = 1.0 / (MARKER_M * MARKER_M * (1.0 + r.norm_squared() / (self.cauchy * MARKER_M).powi(2)));
            let by = self.derivatives(state, &placed, index);
            for (i, a) in &by.local {
                block.gradient[*i] += weight * a.dot(&r);
                by.local.iter().for_each(|(j, b)| block.local[(*i, *j)] += weight * a.dot(b));
                by.shared.iter().for_each(|(j, b)| block.border[(*i, *j)] += weight * a.dot(b));
            }
            for (i, a) in &by.shared {
                block.shared_gradient[*i] += weight * a.dot(&r);
                by.shared.iter().for_each(|(j, b)| block.shared[(*i, *j)] += weight * a.dot(b));
            }
        }
        for (slot, v, certainty) in self.posture(&state.poses[frame]) {
            let jacobian = Matrix3::from_diagonal(&certainty) * by_right(&v);
            let mut local = block.local.fixed_view_mut::<3, 3>(slot, slot);
            local += jacobian.tr_mul(&jacobian);
            let mut gradient = block.gradient.fixed_rows_mut::<3>(slot);
            gradient += jacobian.tr_mul(&v.component_mul(&certainty));
        }
        block
    }

    /// The chain from frame − 1 to `frame`.
    fn add_chain(&self, state: &State, frame: usize, normal: &mut NormalEquations) {
        let (a, b) = (&state.poses[frame - 1], &state.poses[frame]);
        let (before, after) = (self.person.width() * (frame - 1), self.person.width() * frame);
        let mut add = |slot: usize, r: Vector3<f64>, by_a: Matrix3<f64>, by_b: Matrix3<f64>, weight: f64| {
            for (row, by_row) in [(before + slot, &by_a), (after + slot, &by_b)] {
                let gradient = by_row.tr_mul(&r) * weight;
                (0..3).for_each(|k| normal.local_gradient[row + k] += gradient[k]);
                for (column, by_column) in [(before + slot, &by_a), (after + slot, &by_b)] {
                    let product = by_row.tr_mul(by_column) * weight;
                    for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))).filter(|(i, j)| row + i >= column + j) {
                        normal.local.add(row + i, column + j, product[(i, j)]);
                    }
                }
            }
        };
        for (slot, v) in self.turns(a, b) {
            let by_a = -left_jacobian(&v).try_inverse().unwrap_or_else(Matrix3::identity);
            add(slot, v, by_a, by_right(&v), (TURN_RAD_S * self.step_s).powi(-2));
        }
        add(3, b.root - a.root, -Matrix3::identity(), Matrix3::identity(), (ROOT_M_S * self.step_s).powi(-2));
    }

    /// Priors of the shared unknowns: place, residual in standard deviations, 1/σ.
    fn priors(&self, state: &State) -> Vec<(usize, f64, f64)> {
        if !self.shared {
            return Vec::new();
        }
        let stature = 1.0 / (STATURE * self.person.stature_m);
        let mut priors = vec![(0, (state.shape.stature_m - self.person.stature_m) * stature, stature)];
        priors.extend(state.shape.lengths.iter().enumerate().map(|(g, l)| (1 + g, (l - 1.0) / LENGTH, 1.0 / LENGTH)));
        for (i, offset) in state.offsets.iter().enumerate() {
            let certainty = 1.0 / self.person.set.markers[self.person.matches[i].marker].spread_m;
            let off = (offset - self.person.nominal(i)) * certainty;
            priors.extend((0..3).map(|k| (SIZES + 3 * i + k, off[k], certainty)));
        }
        priors
    }
}

impl ArrowProblem for &Problem<'_> {
    type State = State;

    fn cost(&self, state: &State) -> f64 {
        let costs: Vec<f64> = (0..self.frames.len()).into_par_iter().map(|f| self.frame_cost(state, f)).collect();
        costs.iter().sum::<f64>() + self.priors(state).iter().map(|(_, r, _)| 0.5 * r * r).sum::<f64>()
    }

    fn linearise(&self, state: &State) -> NormalEquations {
        let (width, shareds) = (self.person.width(), self.shareds());
        let mut normal = NormalEquations::zeros(width * self.frames.len(), 2 * width - 1, shareds);
        normal.cost = self.cost(state);
        let blocks: Vec<Block> = (0..self.frames.len()).into_par_iter().map(|f| self.block(state, f)).collect();
        for (frame, block) in blocks.iter().enumerate() {
            let first = frame * width;
            for (i, j) in (0..width).flat_map(|i| (0..=i).map(move |j| (i, j))) {
                normal.local.add(first + i, first + j, block.local[(i, j)]);
            }
            normal.local_gradient.rows_mut(first, width).copy_from(&block.gradient);
            normal.border.view_mut((first, 0), (width, shareds)).copy_from(&block.border);
            normal.shared += &block.shared;
            normal.shared_gradient += &block.shared_gradient;
        }
        (1..self.frames.len()).for_each(|frame| self.add_chain(state, frame, &mut normal));
        for (at, r, certainty) in self.priors(state) {
            normal.shared[(at, at)] += certainty * certainty;
            normal.shared_gradient[at] += certainty * r;
        }
        if !self.shared {
            normal.shared[(0, 0)] = 1.0;
        }
        normal
    }

    fn retract(&self, state: &State, y: &DVector<f64>, z: &DVector<f64>) -> State {
        let mut moved = state.clone();
        let vector = |v: &DVector<f64>, at: usize| Vector3::new(v[at], v[at + 1], v[at + 2]);
        let turned = |q: &UnitQuaternion<f64>, by: &Vector3<f64>| UnitQuaternion::new_normalize((q * exp(by)).into_inner());
        for (frame, pose) in moved.poses.iter_mut().enumerate() {
            let first = frame * self.person.width();
            pose.world_from_root = turned(&pose.world_from_root, &vector(y, first));
            pose.root += vector(y, first + 3);
            for (k, m) in self.person.moving.iter().enumerate() {
                let q = &mut pose.joints[m.joint as usize - 1];
                *q = turned(q, &vector(y, first + ROOT + 3 * k));
            }
        }
        if self.shared {
            moved.shape.stature_m += z[0];
            moved.shape.lengths.iter_mut().enumerate().for_each(|(g, l)| *l += z[1 + g]);
            moved.offsets.iter_mut().enumerate().for_each(|(i, o)| *o += vector(z, SIZES + 3 * i));
        }
        moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::markers::choose;
    use rand::{RngExt, SeedableRng};

    fn problem_of<'a>(person: &'a Person<'a>, frames: &'a [Vec<Option<Vector3<f64>>>]) -> Problem<'a> {
        Problem { person, frames: frames.iter().map(Vec::as_slice).collect(), step_s: 0.1, cauchy: 3.0, shared: true }
    }

    /// A state off its rest in everything, with gaps and an outlier: every derivative of (1) has its part in the gradient,
    /// and where residuals vanish the matrix is that of the differences of gradients.
    #[test]
    fn gradient_and_matrix_match_central_differences() {
        let sets = MarkerSet::supplied().unwrap();
        let names: Vec<String> = sets[0].markers.iter().map(|m| m.names[0].clone()).collect();
        let (set, matches) = choose(&sets, &names).unwrap();
        let person = Person::new(set, &matches, 1.8);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let mut state = person.rest(3);
        let shareds = SIZES + 3 * matches.len();
        let mut random = |n: usize, size: f64| DVector::from_fn(n, |_, _| size * rng.random_range(-1.0..1.0));
        let (y, z) = (random(3 * person.width(), 0.6), random(shareds, 0.03));
        let empty: Vec<Vec<Option<Vector3<f64>>>> = vec![vec![None; matches.len()]; 3];
        state = (&problem_of(&person, &empty)).retract(&state, &y, &z);
        let placed: Vec<Placement> = state.poses.iter().map(|p| place(&state.shape.offsets(), p)).collect();
        let noise = random(9 * matches.len(), 0.02);
        for (size, what) in [(1.0, "gradient"), (0.0, "matrix")] {
            let seen = |f: usize, i: usize| {
                let outlier = if (f, i) == (1, 4) { Vector3::new(0.2, -0.1, 0.0) } else { Vector3::zeros() };
                let noise = Vector3::from_fn(|k, _| noise[9 * i + 3 * f + k]);
                (!(f + i).is_multiple_of(7)).then(|| person.position(&state, &placed[f], i) + (noise + outlier) * size)
            };
            let frames: Vec<Vec<Option<Vector3<f64>>>> = (0..3).map(|f| (0..matches.len()).map(|i| seen(f, i)).collect()).collect();
            let problem = problem_of(&person, &frames);
            let normal = (&problem).linearise(&state);
            let locals = normal.local_gradient.len();
            let moved = |k: usize, h: f64| {
                let (mut y, mut z) = (DVector::zeros(locals), DVector::zeros(shareds));
                if k < locals {
                    y[k] = h
                } else {
                    z[k - locals] = h
                }
                (&problem).retract(&state, &y, &z)
            };
            let h = 1e-5;
            if what == "gradient" {
                for k in 0..locals + shareds {
                    let numeric = ((&problem).cost(&moved(k, h)) - (&problem).cost(&moved(k, -h))) / (2.0 * h);
                    let analytic = if k < locals { normal.local_gradient[k] } else { normal.shared_gradient[k - locals] };
                    assert!((numeric - analytic).abs() < 1e-6 * analytic.abs().max(100.0), "{k}: {numeric} {analytic}");
                }
                continue;
            }
            // Markers fit exactly: their part of the matrix is the differences of their gradient.
            for k in (0..locals + shareds).step_by(5) {
                let [plus, minus] = [h, -h].map(|h| (&problem).linearise(&moved(k, h)));
                for j in 0..shareds {
                    let numeric = (plus.shared_gradient[j] - minus.shared_gradient[j]) / (2.0 * h);
                    let analytic = if k < locals { normal.border[(k, j)] } else { normal.shared[(j, k - locals)] };
                    assert!((numeric - analytic).abs() < 1e-5 * analytic.abs().max(1e4), "{k} {j}: {numeric} {analytic}");
                }
            }
        }
    }
}

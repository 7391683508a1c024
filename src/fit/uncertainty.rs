//! How sure the fit is: covariance of all unknowns and of the joints' positions, from residuals as they are.
//!
//! The fit weighs its residuals with less than their precision, so that limbs unlike the model's do not bend it, and its errors
//! are not those of its normal equations A = Jᵀ W J + P. With V the variances that the residuals have, and the truth spread about
//! the priors as P says, the gradient at the truth has covariance B, and the solution
//!   Σ = A⁻¹ B A⁻¹ + l² Σ_n g_n g_nᵀ,  B = Jᵀ W V W J + P;   A⁻¹ B A⁻¹ = −d/dh (A + h B)⁻¹ at h = 0.                (1)
//! Of the inverses only the blocks of one frame and of the shared unknowns are formed (selected inversion), so time and
//! memory are linear in the number of frames; the derivative is taken numerically, to six digits.
//! Neighbouring points share correlation windows and the same misfit of the body's skin, so N residuals are not N
//! measurements. With z_i the normalised residuals and clusters c of those on one node in one frame, the share of each
//! residual that is new information is
//!   s = Σ ω_i / Σ_c (Σ_{i∈c} ω_i z_i)²,  V_i = (nᵀ Σ_i n + m²) / s,                                             (2)
//! one for points and one for rays: what makes the scores' variance the one that they show (a cluster-robust "sandwich"). m is
//! the misfit of the skin, what the residuals show beyond the points' own covariance.
//! The second term of (1): a misfit l that stays with the skin of node n in all frames is averaged out by no number of them; g_n is
//! how far it moves the solution (consider covariance; G. Bierman, Factorization methods, 1977). l is what nodes' mean residuals
//! show, twice: the fit has taken away as much as it has left, say.
//! A joint at x moves by J δ, hence its covariance is J Σ Jᵀ.
//! What is not in it: joint centres of another convention, and motions that differ from all subjects of the database.
//! Checked against the dense inverse, and by the coverage of its intervals over repeated noise.

use nalgebra::{DMatrix, Vector3};
use rayon::prelude::*;

use super::curve::Curve;
use super::problem::{Frame, Free, Known, Problem, Settings};
use super::state::{LOCAL, Motion, State};
use super::weighing::Frozen;
use crate::body::{NODES, Surface};
use crate::math::arrow::{ArrowProblem, NormalEquations};
use crate::math::banded::{BandCholesky, BandMatrix};
use crate::math::order::quantile;

/// Standard deviations of one frame.
#[derive(Clone, Debug)]
pub struct FrameUncertainty {
    /// Carrier rotation (rad, 3), position (m, 3), phase.
    pub local: [f64; LOCAL],
    /// Position of each node in the rig's world, by axis, metres.
    pub joints_m: [Vector3<f64>; NODES],
}

/// How sure a fit is.
#[derive(Clone, Debug)]
pub struct Uncertainty {
    /// Covariance of the shared unknowns in the order of the state's layout.
    pub shared: DMatrix<f64>,
    pub frames: Vec<FrameUncertainty>,
    /// Share of new information of a cloud point and of a silhouette ray, equation (1).
    pub shares: [f64; 2],
    /// Misfit of the skin, metres.
    pub misfit_m: f64,
}

/// Fewer residuals than this say nothing about their own variance.
const FEWEST: f64 = 100.0;
/// Least misfit of any body model, metres: by what widths are off on bodies of its own kind (`bench coverage`).
const LEAST_MISFIT_M: f64 = 0.0005;
/// Of no kind of residual less is new.
const LEAST_SHARE: f64 = 1e-3;
/// Step of the derivative in equation (1).
const STEP: f64 = 1e-3;

/// Uncertainty at a solution found with `settings`; `None` where the equations are singular.
pub fn uncertainty(curve: &Curve, frames: &[Frame], settings: &Settings, free: Free, known: &Known, state: &State) -> Option<Uncertainty> {
    let problem = Problem::new(curve, frames, settings, free, known, state);
    let misfit_m = misfit_m(&problem);
    let of_kind = |points| problem.frozen().iter().map(move |f| f.iter().filter(move |f| f.is_point == points));
    let shares = [true, false].map(|points| share(of_kind(points), misfit_m));
    let pulls = problem.skin_pulls(state) * lasting_m(&problem);
    let normal = problem.linearise(state);
    let shown = |f: &Frozen| f.weight.powi(2) * (f.variance + misfit_m.powi(2)) / shares[usize::from(!f.is_point)];
    let scores = problem.reweighted(shown).linearise(state);
    let (shared, frames) = propagate(&normal, &scores, &pulls, curve, state)?;
    Some(Uncertainty { shared, frames, shares, misfit_m })
}

/// What the median point's distance shows beyond its own standard deviation along the normal.
fn misfit_m(problem: &Problem) -> f64 {
    let points = || problem.frozen().iter().flatten().filter(|f| f.is_point && f.weight > 0.0);
    let median = |values: Vec<f64>| quantile(values, 0.5).unwrap_or(0.0);
    let spread = 1.4826 * median(points().map(|f| f.distance_m.abs()).collect());
    (spread * spread - median(points().map(|f| f.variance).collect())).max(0.0).sqrt().max(LEAST_MISFIT_M)
}

/// Root mean square of the nodes' mean distances, for what is left and what was taken.
fn lasting_m(problem: &Problem) -> f64 {
    let mut nodes = [[0.0; 2]; NODES];
    for f in problem.frozen().iter().flatten().filter(|f| f.is_point) {
        nodes[f.node as usize][0] += f.robust * f.distance_m;
        nodes[f.node as usize][1] += f.robust;
    }
    let seen = || nodes.iter().filter(|n| n[1] > 0.0);
    let square: f64 = seen().map(|n| n[0] * n[0] / n[1]).sum();
    (2.0 * square / seen().map(|n| n[1]).sum::<f64>().max(1.0)).sqrt().max(LEAST_MISFIT_M)
}

/// Equation (2) over frames of residuals.
fn share<'a, F: Iterator<Item = &'a Frozen>>(frames: impl Iterator<Item = F>, misfit_m: f64) -> f64 {
    let (mut believed, mut shown) = (0.0, 0.0);
    for frame in frames {
        let mut sums = [0.0; NODES];
        for f in frame {
            believed += f.robust;
            sums[f.node as usize] += f.robust * f.distance_m / (f.variance + misfit_m.powi(2)).sqrt();
        }
        shown += sums.iter().map(|s| s * s).sum::<f64>();
    }
    if believed < FEWEST { LEAST_SHARE } else { (believed / shown).clamp(LEAST_SHARE, 1.0) }
}

/// The inverse of normal equations in the parts that are asked for.
struct Inverse {
    factor: BandCholesky,
    /// K⁻¹ B.
    eliminated: DMatrix<f64>,
    shared: DMatrix<f64>,
}

impl Inverse {
    fn of(normal: &NormalEquations) -> Option<Inverse> {
        let factor = normal.local.cholesky()?;
        let eliminated = factor.solve(&normal.border);
        // A product with a transposed copy runs in blocks, `tr_mul` does not.
        let shared = (&normal.shared - normal.border.transpose() * &eliminated).cholesky()?.inverse();
        Some(Inverse { factor, eliminated, shared })
    }

    /// How the solution gives way to pulls on it, a column each: the frames' unknowns, the shared ones.
    fn way(&self, pulls: &DMatrix<f64>) -> [DMatrix<f64>; 2] {
        let locals = self.eliminated.nrows();
        let own = pulls.rows(0, locals).into_owned();
        let shared = &self.shared * (pulls.rows(locals, self.shared.nrows()) - self.eliminated.tr_mul(&own));
        [self.factor.solve(&own) - &self.eliminated * &shared, shared]
    }

    /// Covariance of the unknowns of the frame that begins with unknown `first`, then the shared ones; `band` is the selected inverse.
    fn covariance(&self, band: &BandMatrix, first: usize, local: usize) -> DMatrix<f64> {
        let through = self.eliminated.rows(first, local);
        let across = -(through * &self.shared);
        let own = DMatrix::from_fn(local, local, |i, j| band.get(first + i, first + j)) - &across * through.transpose();
        let size = local + self.shared.nrows();
        DMatrix::from_fn(size, size, |i, j| match (i < local, j < local) {
            (true, true) => own[(i, j)],
            (true, false) => across[(i, j - local)],
            (false, true) => across[(j, i - local)],
            (false, false) => self.shared[(i - local, j - local)],
        })
    }
}

/// The covariance of the shared unknowns, and what follows for each frame; `pulls` are those of skin that is off.
fn propagate(
    normal: &NormalEquations,
    scores: &NormalEquations,
    pulls: &DMatrix<f64>,
    curve: &Curve,
    state: &State,
) -> Option<(DMatrix<f64>, Vec<FrameUncertainty>)> {
    let selected = |h: f64| {
        let inverse = Inverse::of(&normal.plus(h, scores))?;
        let band = inverse.factor.selected_inverse();
        Some((inverse, band))
    };
    let (ways, (less, more)) = rayon::join(|| Some(Inverse::of(normal)?.way(pulls)), || rayon::join(|| selected(-STEP), || selected(STEP)));
    let ([way, way_shared], (less, band_less), (more, band_more)) = (ways?, less?, more?);
    let surface = Surface::new(&state.shape);
    let layout = state.layout();
    let of_frame = |t: usize| {
        let first = t * layout.local;
        let solved = less.covariance(&band_less, first, layout.local) - more.covariance(&band_more, first, layout.local);
        let mut moved = DMatrix::zeros(layout.size(), pulls.ncols());
        moved.rows_mut(0, layout.local).copy_from(&way.rows(first, layout.local));
        moved.rows_mut(layout.local, layout.shared()).copy_from(&way_shared);
        let covariance = solved / (2.0 * STEP) + &moved * moved.transpose();
        let motion = state.motion(curve, &surface, t);
        let placement = state.posed(curve, &surface, t).placement;
        let joints_m = std::array::from_fn(|node| {
            let jacobian = position_jacobian(&motion, state, t, node, &placement.positions[node]);
            let of_joint = &jacobian * &covariance * jacobian.transpose();
            Vector3::from_fn(|axis, _| of_joint[(axis, axis)].max(0.0).sqrt())
        });
        FrameUncertainty { local: std::array::from_fn(|i| covariance[(i, i)].max(0.0).sqrt()), joints_m }
    };
    let frames = (0..state.carriers.len()).into_par_iter().map(of_frame).collect();
    let shared = (less.shared - more.shared) / (2.0 * STEP) + &way_shared * way_shared.transpose();
    Some((shared, frames))
}

/// Derivative of a node's position for the unknowns of the frame and the shared ones, 3 rows.
fn position_jacobian(motion: &Motion, state: &State, frame: usize, node: usize, x: &Vector3<f64>) -> DMatrix<f64> {
    let layout = state.layout();
    let twist = &motion.twists[node];
    let mut jacobian = DMatrix::from_fn(3, layout.size(), |axis, column| {
        let omega = Vector3::from_fn(|k, _| twist.row(3 + k)[column]);
        twist.row(axis)[column] + omega.cross(x)[axis]
    });
    let grown = x - state.carriers[frame].position;
    (0..3).for_each(|axis| jacobian[(axis, layout.local + layout.stature())] += grown[axis]);
    jacobian
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::curve::tests::made_up_model;
    use crate::fit::problem::tests::{ALL, KNOWN, SETTINGS, state};

    #[test]
    fn positions_move_as_their_jacobian_says() {
        let curve = Curve::new(&made_up_model(3), 3);
        let state = state();
        let layout = state.layout();
        let surface = Surface::new(&state.shape);
        let motion = state.motion(&curve, &surface, 1);
        let at = |s: &State| s.posed(&curve, &surface, 1).placement.positions;
        for node in [0, 3, 12, 20, 26] {
            let jacobian = position_jacobian(&motion, &state, 1, node, &at(&state)[node]);
            for column in 0..layout.size() {
                let step = |h: f64| {
                    let (mut y, mut z) = (vec![0.0; 3 * layout.local], vec![0.0; layout.shared()]);
                    if column < layout.local {
                        y[layout.local + column] = h
                    } else {
                        z[column - layout.local] = h
                    }
                    at(&state.moved(&y, &z))[node]
                };
                let numeric = (step(1e-6) - step(-1e-6)) / 2e-6;
                assert!((numeric - jacobian.column(column)).norm() < 1e-6 * (1.0 + numeric.norm()), "{node} {column}");
            }
        }
    }

    #[test]
    fn covariances_are_those_of_the_dense_inverse() {
        let curve = Curve::new(&made_up_model(3), 3);
        let state = state();
        let frames = crate::fit::problem::tests::frames(&curve, &state);
        let problem = Problem::new(&curve, &frames, &SETTINGS, ALL, &KNOWN, &state);
        let (normal, pulls) = (problem.linearise(&state), problem.skin_pulls(&state) * 0.003);
        let scores = problem.reweighted(|f| 0.3 * f.weight).linearise(&state);
        let (shared, found) = propagate(&normal, &scores, &pulls, &curve, &state).unwrap();
        let (locals, layout) = (normal.local_gradient.len(), state.layout());
        let dense = |normal: &NormalEquations| {
            DMatrix::from_fn(locals + layout.shared(), locals + layout.shared(), |i, j| match (i < locals, j < locals) {
                (true, true) => normal.local.get(i.max(j), i.min(j)),
                (true, false) => normal.border[(i, j - locals)],
                (false, true) => normal.border[(j, i - locals)],
                (false, false) => normal.shared[(i - locals, j - locals)],
            })
        };
        let inverse = dense(&normal).try_inverse().unwrap();
        let way = &inverse * &pulls;
        let covariance = &inverse * dense(&scores) * &inverse + &way * way.transpose();
        let scale = |i: usize, j: usize| (covariance[(i, i)] * covariance[(j, j)]).sqrt();
        for i in 0..layout.shared() {
            for j in 0..layout.shared() {
                let (a, b) = (locals + i, locals + j);
                assert!((shared[(i, j)] - covariance[(a, b)]).abs() < 1e-5 * scale(a, b), "{i} {j}");
            }
        }
        let surface = Surface::new(&state.shape);
        for (t, frame) in found.iter().enumerate() {
            for k in 0..LOCAL {
                let at = layout.local * t + k;
                assert!((frame.local[k] / covariance[(at, at)].sqrt() - 1.0).abs() < 1e-5, "{t} {k}");
            }
            let (motion, x) = (state.motion(&curve, &surface, t), state.posed(&curve, &surface, t).placement.positions);
            let own: Vec<usize> = (0..layout.local).map(|k| layout.local * t + k).chain(locals..locals + layout.shared()).collect();
            let block = DMatrix::from_fn(own.len(), own.len(), |i, j| covariance[(own[i], own[j])]);
            let jacobian = position_jacobian(&motion, &state, t, 12, &x[12]);
            let expected = &jacobian * block * jacobian.transpose();
            assert!((0..3).all(|axis| (frame.joints_m[12][axis] / expected[(axis, axis)].sqrt() - 1.0).abs() < 1e-5));
        }
    }

    #[test]
    fn correlated_residuals_are_worth_less() {
        let frozen = |node: u8, z: f64| Frozen { node, robust: 1.0, distance_m: z, variance: 1.0, is_point: true, ..Frozen::default() };
        let waves: Vec<f64> = (0..400).map(|i| (1.7 * (i * i) as f64).sin() * std::f64::consts::SQRT_2).collect();
        let alone: Vec<Vec<Frozen>> = waves.iter().map(|z| vec![frozen(3, *z)]).collect();
        assert!((share(alone.iter().map(|f| f.iter()), 0.0) - 1.0).abs() < 0.1);
        let fivefold: Vec<Vec<Frozen>> = waves.iter().map(|z| vec![frozen(3, *z); 5]).collect();
        assert!((share(fivefold.iter().map(|f| f.iter()), 0.0) - 0.2).abs() < 0.02);
    }
}

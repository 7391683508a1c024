//! How sure the fit is: covariance of all unknowns and of the joints' positions, from residuals as they are.
//!
//! Neighbouring points share correlation windows and the same misfit of the body's skin, so N residuals are not N
//! measurements. With z_i the normalised residuals and clusters c of those on one node in one frame, the share of each
//! residual that is new information is
//!   s = Σ ω_i / Σ_c (Σ_{i∈c} ω_i z_i)²,                                                                         (1)
//! the factor at which the variance that the least-squares fit believes its scores to have equals the variance that
//! they show (a cluster-robust "sandwich" with one factor per kind of residual); points and rays have one each. The
//! misfit of the skin is what the residuals show beyond the points' own covariance. The priors enter as they are:
//!   Σ = (Σ_kinds s Jᵀ W J + P)⁻¹ + m² Σ_n g_n g_nᵀ.                                                             (2)
//! The second term: a misfit m that stays with the skin of node n in all frames is averaged out by no number of them; g_n is
//! how far it moves the solution (consider covariance; G. Bierman, Factorization methods, 1977). Half of its variance is
//! common to all nodes, as clothes are and noise that takes points off thin limbs, and moves the solution by Σ_n g_n.
//! Of the inverse only the blocks of one frame and of the shared unknowns are formed (selected inversion), so time and
//! memory are linear in the number of frames. A joint at x moves by J δ, hence its covariance is J Σ Jᵀ.
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
/// Least misfit of any body model, metres: what the fit itself is off by on bodies of its own kind (`bench coverage`).
const LEAST_MISFIT_M: f64 = 0.0015;

/// Uncertainty at a solution found with `settings`; `None` where the equations are singular.
pub fn uncertainty(curve: &Curve, frames: &[Frame], settings: &Settings, free: Free, known: &Known, state: &State) -> Option<Uncertainty> {
    let misfit_m = misfit_m(&Problem::new(curve, frames, settings, free, known, state));
    let believed = Settings { model_m: misfit_m, point_weight: 1.0, ray_weight: 1.0, ..settings.clone() };
    let shares = {
        let frozen = Problem::new(curve, frames, &believed, free, known, state);
        [true, false].map(|points| share(frozen.frozen().iter().map(|f| f.iter().filter(|f| f.is_point == points))))
    };
    let measured = Settings { point_weight: shares[0], ray_weight: shares[1], ..believed };
    let problem = Problem::new(curve, frames, &measured, free, known, state);
    let (shared, frames) = propagate(&problem.linearise(state), &misfits(problem.skin_pulls(state), misfit_m), curve, state)?;
    Some(Uncertainty { shared, frames, shares, misfit_m })
}

/// Pulls of skin that is off by a standard deviation: of each node by itself, and of all together.
fn misfits(pulls: DMatrix<f64>, misfit_m: f64) -> DMatrix<f64> {
    let common = pulls.column_sum();
    let nodes = pulls.ncols();
    let mut all = pulls.insert_column(nodes, 0.0);
    all.set_column(nodes, &common);
    all * (misfit_m * std::f64::consts::FRAC_1_SQRT_2)
}

/// What the median point's distance shows beyond its own standard deviation along the normal.
fn misfit_m(problem: &Problem) -> f64 {
    let points = || problem.frozen().iter().flatten().filter(|f| f.is_point && f.weight > 0.0);
    let median = |values: Vec<f64>| quantile(values, 0.5).unwrap_or(0.0);
    let spread = 1.4826 * median(points().map(|f| f.distance_m.abs()).collect());
    (spread * spread - median(points().map(|f| f.variance).collect())).max(0.0).sqrt().max(LEAST_MISFIT_M)
}

/// Equation (1) over frames of residuals.
fn share<'a, F: Iterator<Item = &'a Frozen>>(frames: impl Iterator<Item = F>) -> f64 {
    let (mut believed, mut shown) = (0.0, 0.0);
    for frame in frames {
        let mut sums = [0.0; NODES];
        for f in frame {
            believed += f.robust;
            sums[f.node as usize] += f.robust * f.distance_m / f.sigma_m;
        }
        shown += sums.iter().map(|s| s * s).sum::<f64>();
    }
    if believed < FEWEST { 0.0 } else { (believed / shown.max(believed * 1e-3)).min(1.0) }
}

/// The covariance of the shared unknowns, and what follows for each frame; `pulls` are those of skin that is off.
fn propagate(
    normal: &NormalEquations,
    pulls: &DMatrix<f64>,
    curve: &Curve,
    state: &State,
) -> Option<(DMatrix<f64>, Vec<FrameUncertainty>)> {
    let factor = normal.local.cholesky()?;
    let eliminated = factor.solve(&normal.border);
    let shared = (&normal.shared - normal.border.tr_mul(&eliminated)).cholesky()?.inverse();
    let inverse = factor.selected_inverse();
    let locals = eliminated.nrows();
    // How the solution gives way to the pulls: shared unknowns, then the frames'.
    let way_shared = &shared * (pulls.rows(locals, shared.nrows()) - eliminated.tr_mul(&pulls.rows(0, locals)));
    let way = factor.solve(&pulls.rows(0, locals).into_owned()) - &eliminated * &way_shared;
    let surface = Surface::new(&state.shape);
    let layout = state.layout();
    let of_frame = |t: usize| {
        let first = t * layout.local;
        let block = DMatrix::from_fn(layout.local, layout.local, |i, j| inverse.get(first + i, first + j));
        let through = eliminated.rows(first, layout.local).into_owned();
        let own_way = way.rows(first, layout.local);
        let whole = &block + &through * &shared * through.transpose() + own_way * own_way.transpose();
        let motion = state.motion(curve, &surface, t);
        let placement = state.posed(curve, &surface, t).placement;
        let joints_m = std::array::from_fn(|node| {
            let jacobian = position_jacobian(&motion, state, t, node, &placement.positions[node]);
            let local = jacobian.columns(0, layout.local);
            let (direct, moved) = (jacobian.columns(layout.local, layout.shared()), local * own_way);
            let rest = direct - local * &through;
            let moved = moved + direct * &way_shared;
            let covariance = local * &block * local.transpose() + &rest * &shared * rest.transpose() + &moved * moved.transpose();
            Vector3::from_fn(|axis, _| covariance[(axis, axis)].max(0.0).sqrt())
        });
        FrameUncertainty { local: std::array::from_fn(|i| whole[(i, i)].max(0.0).sqrt()), joints_m }
    };
    let frames = (0..state.carriers.len()).into_par_iter().map(of_frame).collect();
    let shared = shared + &way_shared * way_shared.transpose();
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
        let (normal, pulls) = (problem.linearise(&state), misfits(problem.skin_pulls(&state), 0.003));
        let (shared, found) = propagate(&normal, &pulls, &curve, &state).unwrap();
        let (locals, layout) = (normal.local_gradient.len(), state.layout());
        let dense = DMatrix::from_fn(locals + layout.shared(), locals + layout.shared(), |i, j| match (i < locals, j < locals) {
            (true, true) => normal.local.get(i.max(j), i.min(j)),
            (true, false) => normal.border[(i, j - locals)],
            (false, true) => normal.border[(j, i - locals)],
            (false, false) => normal.shared[(i - locals, j - locals)],
        });
        let inverse = dense.try_inverse().unwrap();
        let way = &inverse * &pulls;
        let covariance = inverse + &way * way.transpose();
        let scale = |i: usize, j: usize| (covariance[(i, i)] * covariance[(j, j)]).sqrt();
        for i in 0..layout.shared() {
            for j in 0..layout.shared() {
                let (a, b) = (locals + i, locals + j);
                assert!((shared[(i, j)] - covariance[(a, b)]).abs() < 1e-6 * scale(a, b), "{i} {j}");
            }
        }
        let surface = Surface::new(&state.shape);
        for (t, frame) in found.iter().enumerate() {
            for k in 0..LOCAL {
                let at = layout.local * t + k;
                assert!((frame.local[k] / covariance[(at, at)].sqrt() - 1.0).abs() < 1e-6, "{t} {k}");
            }
            let (motion, x) = (state.motion(&curve, &surface, t), state.posed(&curve, &surface, t).placement.positions);
            let own: Vec<usize> = (0..layout.local).map(|k| layout.local * t + k).chain(locals..locals + layout.shared()).collect();
            let block = DMatrix::from_fn(own.len(), own.len(), |i, j| covariance[(own[i], own[j])]);
            let jacobian = position_jacobian(&motion, &state, t, 12, &x[12]);
            let expected = &jacobian * block * jacobian.transpose();
            assert!((0..3).all(|axis| (frame.joints_m[12][axis] / expected[(axis, axis)].sqrt() - 1.0).abs() < 1e-6));
        }
    }

    #[test]
    fn correlated_residuals_are_worth_less() {
        let frozen = |node: u8, z: f64| Frozen { node, robust: 1.0, distance_m: z, sigma_m: 1.0, is_point: true, ..Frozen::default() };
        let waves: Vec<f64> = (0..400).map(|i| (1.7 * (i * i) as f64).sin() * std::f64::consts::SQRT_2).collect();
        let alone: Vec<Vec<Frozen>> = waves.iter().map(|z| vec![frozen(3, *z)]).collect();
        assert!((share(alone.iter().map(|f| f.iter())) - 1.0).abs() < 0.1);
        let fivefold: Vec<Vec<Frozen>> = waves.iter().map(|z| vec![frozen(3, *z); 5]).collect();
        assert!((share(fivefold.iter().map(|f| f.iter())) - 0.2).abs() < 0.02);
    }
}

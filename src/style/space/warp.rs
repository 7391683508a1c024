//! Time warp to full correspondence: when a motion does what the reference does at each of its knots.
//!
//! With features a_i of the reference at its K + 1 knots and b_j of the other on a grid [`REFINE`] times as fine,
//!   min Σ_i |a_i − b_{j_i}|² + stiffness Σ_i ln²((j_{i+1} − j_i)/REFINE),   j_0 = 0,  j_K = K·REFINE,              (1)
//! over j_i that rise by REFINE/4 to 4 REFINE, by dynamic programming: the best of all, in O(K² REFINE²). Every
//! knot gets one time of its own and times increase strictly, so there are no plateaus to spread, as there are where a vertex
//! may meet several (Bruderlin and Williams 1995, whom the paper follows). The increments are then averaged over
//! [`SMOOTH`] knots, which takes the grid's steps out of the speed.
//!
//! Features are all rotation curves, and how far the feet are ahead of the root, whose maxima are the heel strikes: values and
//! speeds, each motion's own mean taken off and each kind scaled to unit power, the feet's weighted by [`FEET`]. What counts is
//! how people move, not how they hold themselves (an old man's stoop is no reason to warp).
//! Departure: Bruderlin and Williams's work of stretching and bending is of one curve; here all curves have one cost.
//! Fails when: the motions do not do the same things in the same order.
//! Checked against the best of all paths tried one by one, and against a warp put in.

use nalgebra::{DMatrix, DVector};

use super::example::{CURVES, Curves, PROGRESS};

/// Grid of the other motion's times, per interval between knots.
pub const REFINE: usize = 8;
/// Of (1); features have unit power, and two styles' differ by about 1. Ten times more leaves steps where they are, ten times
/// less follows noise of single joints.
pub const STIFFNESS: f64 = 0.3;
/// Standard deviation of the average over increments, in knots.
const SMOOTH: f64 = 1.5;
/// Weight of the feet's features. Without them the strikes of one person's slow and fast walk are brought together to 2.9 % of the
/// cycle only, with 1.5 to 1.5 %: stance shortens with speed, and the many curves that follow the toe-off pull the strike along.
const FEET: f64 = 1.5;
/// Own paths of single curves: what leaving the common path by the whole motion costs, against unit power.
const TETHER: f64 = 400.0;
/// Curves that move less (radians or hip heights, r.m.s.) have no timing of their own, and feet no say.
const FLAT: f64 = 0.02;

/// Values and speeds of all curves and of the feet at `count` + 1 equal steps, curves × knots.
struct Sampled {
    curves: [DMatrix<f64>; 2],
    feet: [DMatrix<f64>; 2],
}

impl Sampled {
    fn new(curves: &Curves, count: usize) -> Sampled {
        let times = curves.times();
        // Central differences over the spacing of the samples themselves, whatever the grid.
        let reach = 1.0 / (times.len() - 1) as f64;
        let inside = |t: f64| if curves.cyclic { t.rem_euclid(1.0) } else { t };
        let around = |t: f64| if curves.cyclic { (t - reach, t + reach) } else { ((t - reach).max(0.0), (t + reach).min(1.0)) };
        let both = |f: &dyn Fn(f64) -> DVector<f64>| {
            let speed = |t: f64| {
                let (low, high) = around(t);
                (f(inside(high)) - f(inside(low))) / (high - low)
            };
            let at: Vec<f64> = (0..=count).map(|k| k as f64 / count as f64).collect();
            let columns = |f: &dyn Fn(f64) -> DVector<f64>| DMatrix::from_columns(&at.iter().map(|&t| f(t)).collect::<Vec<_>>());
            [columns(f), columns(&speed)]
        };
        Sampled { curves: both(&|t| curves.at(&times, t)), feet: both(&|t| curves.feet_at(&times, t)) }
    }

    /// Features of some curves.
    fn features(&self, rows: std::ops::Range<usize>) -> DMatrix<f64> {
        stacked(&self.curves.each_ref().map(|m| unit_power(m.rows_range(rows.clone()).into_owned())))
    }

    /// Features of all that turns, and of feet that move.
    fn all_features(&self) -> DMatrix<f64> {
        let weight = if self.feet[0].row_iter().any(|row| row.variance().sqrt() > FLAT) { FEET } else { 0.0 };
        let feet = self.feet.each_ref().map(|m| unit_power(m.clone()) * weight);
        stacked(&[self.features(0..CURVES - 3), stacked(&feet)])
    }
}

fn stacked([above, below]: &[DMatrix<f64>; 2]) -> DMatrix<f64> {
    let mut both = DMatrix::zeros(above.nrows() + below.nrows(), above.ncols());
    both.rows_mut(0, above.nrows()).copy_from(above);
    both.rows_mut(above.nrows(), below.nrows()).copy_from(below);
    both
}

/// Rows without their means, the mean squared column 1; what does not move stays zero.
fn unit_power(mut block: DMatrix<f64>) -> DMatrix<f64> {
    let mean = block.column_mean();
    block.column_iter_mut().for_each(|mut c| c -= &mean);
    let power = (block.norm_squared() / block.ncols() as f64).sqrt();
    if power > 1e-9 { block / power } else { block }
}

/// Cost of every knot at every time of the fine grid: knots × grid.
fn costs(reference: &DMatrix<f64>, other: &DMatrix<f64>) -> DMatrix<f64> {
    let products = reference.tr_mul(other);
    let [a, b] = [reference, other].map(|m| m.column_iter().map(|c| c.norm_squared()).collect::<Vec<f64>>());
    DMatrix::from_fn(a.len(), b.len(), |i, j| (a[i] + b[j] - 2.0 * products[(i, j)]).max(0.0))
}

/// The path of (1) for given costs (knots × grid), by dynamic programming; `refine` grid steps per knot.
pub fn best_path(costs: &DMatrix<f64>, refine: usize, stiffness: f64) -> Vec<usize> {
    let (knots, grid) = costs.shape();
    let steps = (refine / 4).max(1)..=4 * refine;
    let work: Vec<f64> = (0..=4 * refine).map(|s| stiffness * (s as f64 / refine as f64).ln().powi(2)).collect();
    // Steps fit a byte, and a long clip's table is the largest thing here.
    let mut stepped = DMatrix::from_element(knots, grid, 0u8);
    let mut total = vec![f64::INFINITY; grid];
    total[0] = costs[(0, 0)];
    for i in 1..knots {
        let mut next = vec![f64::INFINITY; grid];
        for (j, best) in next.iter_mut().enumerate() {
            for step in steps.clone().take_while(|&s| s <= j) {
                let sum = total[j - step] + work[step];
                if sum < *best {
                    (*best, stepped[(i, j)]) = (sum, step as u8);
                }
            }
            *best += costs[(i, j)];
        }
        total = next;
    }
    let mut path = vec![grid - 1; knots];
    for i in (1..knots).rev() {
        path[i - 1] = path[i] - usize::from(stepped[(i, path[i])]);
    }
    path
}

/// Increasing parts of the duration, 0 to 1, from a path: increments averaged over their neighbours.
fn smoothed(path: &[usize], cyclic: bool) -> Vec<f64> {
    let increments: Vec<f64> = path.windows(2).map(|w| (w[1] - w[0]) as f64).collect();
    let count = increments.len() as isize;
    let reach = (3.0 * SMOOTH).ceil() as isize;
    let mean = |i: isize| {
        let (mut sum, mut weight) = (0.0, 0.0);
        for k in -reach..=reach {
            let at = if cyclic { (i + k).rem_euclid(count) } else { (i + k).clamp(0, count - 1) };
            let w = (-0.5 * (k as f64 / SMOOTH).powi(2)).exp();
            sum += w * increments[at as usize];
            weight += w;
        }
        sum / weight
    };
    let averaged: Vec<f64> = (0..count).map(mean).collect();
    let total: f64 = averaged.iter().sum();
    let mut time = 0.0;
    let inner = averaged[..averaged.len() - 1].iter().map(|step| {
        time += step / total;
        time
    });
    std::iter::once(0.0).chain(inner.collect::<Vec<_>>()).chain([1.0]).collect()
}

/// Times, parts of the other's duration from 0 to 1, that correspond to equal steps of the reference: one list for all curves,
/// or one for each. The evidence of the common list are the rotations and the feet.
pub fn warp(reference: &Curves, other: &Curves, intervals: usize, per_curve: bool) -> Vec<Vec<f64>> {
    let [coarse, fine] = [Sampled::new(reference, intervals), Sampled::new(other, intervals * REFINE)];
    let all = costs(&coarse.all_features(), &fine.all_features());
    let common = smoothed(&best_path(&all, REFINE, STIFFNESS), reference.cyclic);
    if !per_curve {
        return vec![common];
    }
    (0..CURVES).map(|curve| own_times(&coarse, &fine, curve, &common, reference.cyclic)).collect()
}

/// A curve's own times, held near the common ones; nearly flat curves have these, and so has the progress, a ramp that does not
/// show what happens when.
fn own_times(coarse: &Sampled, fine: &Sampled, curve: usize, common: &[f64], cyclic: bool) -> Vec<f64> {
    let flat = |sampled: &Sampled| sampled.curves[0].row(curve).variance().sqrt() < FLAT;
    if curve == PROGRESS || flat(coarse) || flat(fine) {
        return common.to_vec();
    }
    let mut costs = costs(&coarse.features(curve..curve + 1), &fine.features(curve..curve + 1));
    let grid = (costs.ncols() - 1) as f64;
    for (mut row, at) in costs.row_iter_mut().zip(common) {
        row.iter_mut().enumerate().for_each(|(j, cost)| *cost += TETHER * (j as f64 / grid - at).powi(2));
    }
    smoothed(&best_path(&costs, REFINE, STIFFNESS), cyclic)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::{Activity, synthetic};
    use crate::style::space::Example;
    use nalgebra::UnitQuaternion;
    use rand::{RngExt, SeedableRng};
    use std::f64::consts::TAU;

    /// Every path tried, one by one.
    fn brute_force(costs: &DMatrix<f64>, refine: usize, stiffness: f64) -> (f64, Vec<usize>) {
        fn extend(path: &mut Vec<usize>, sum: f64, costs: &DMatrix<f64>, refine: usize, stiffness: f64, best: &mut (f64, Vec<usize>)) {
            let (i, j) = (path.len() - 1, path[path.len() - 1]);
            if i + 1 == costs.nrows() {
                if j + 1 == costs.ncols() && sum < best.0 {
                    *best = (sum, path.clone());
                }
                return;
            }
            for next in j + (refine / 4).max(1)..(j + 4 * refine + 1).min(costs.ncols()) {
                let work = stiffness * ((next - j) as f64 / refine as f64).ln().powi(2);
                path.push(next);
                extend(path, sum + work + costs[(i + 1, next)], costs, refine, stiffness, best);
                path.pop();
            }
        }
        let mut best = (f64::INFINITY, Vec::new());
        extend(&mut vec![0], costs[(0, 0)], costs, refine, stiffness, &mut best);
        best
    }

    #[test]
    fn dynamic_programming_finds_the_best_of_all_paths() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        for (knots, refine) in [(6, 1), (7, 2), (5, 4)] {
            for stiffness in [0.0, 0.3, 3.0] {
                let costs = DMatrix::from_fn(knots, (knots - 1) * refine + 1, |_, _| rng.random::<f64>());
                let path = best_path(&costs, refine, stiffness);
                let (sum, expected) = brute_force(&costs, refine, stiffness);
                assert_eq!(path, expected, "{sum}");
            }
        }
        // Not the straight path, which would be right for costs of zero only.
        let costs = DMatrix::from_fn(7, 13, |i, j| (j as f64 - (i * i) as f64 / 3.0).powi(2));
        assert_ne!(best_path(&costs, 2, 0.0), (0..7).map(|i| 2 * i).collect::<Vec<_>>());
    }

    fn walk(seed: u64, speed: f64) -> Curves {
        let cycle = synthetic::subject(Activity::Walking, seed).cycle(speed, 0);
        Example::of_cycle("", &cycle).curves(&[UnitQuaternion::identity(); crate::body::BALL_JOINTS])
    }

    #[test]
    fn a_warp_that_was_put_in_comes_out() {
        let reference = walk(1, 1.3);
        let times = reference.times();
        // The other motion does at w(t) what the reference does at t.
        let w = |t: f64| t + 0.06 * (TAU * t).sin() / TAU * 2.0 + 0.02 * (2.0 * TAU * t + 1.0).sin() - 0.02 * 1.0f64.sin();
        let inverse =
            |s: f64| (0..60).fold((0.0, 1.0), |(a, b), _| if w((a + b) / 2.0) < s { ((a + b) / 2.0, b) } else { (a, (a + b) / 2.0) }).0;
        let columns: Vec<_> = (0..100).map(|k| reference.at(&times, inverse(k as f64 / 100.0))).collect();
        let feet: Vec<_> = (0..100).map(|k| reference.feet_at(&times, inverse(k as f64 / 100.0))).collect();
        let other = Curves { values: DMatrix::from_columns(&columns), feet: DMatrix::from_columns(&feet), ..reference.clone() };
        let found = warp(&reference, &other, 100, false).remove(0);
        let worst = |f: &dyn Fn(f64) -> f64| (0..=100).map(|k| (found[k] - f(k as f64 / 100.0)).abs()).fold(0.0, f64::max);
        assert!(worst(&w) < 0.01, "{}", worst(&w));
        assert!(worst(&|t| t) > 0.02, "the warp is to be seen");
        assert!(found.windows(2).all(|w| w[1] > w[0]));
        let own = warp(&reference, &other, 100, true);
        assert!(own.len() == CURVES && own.iter().all(|c| c.windows(2).all(|w| w[1] > w[0])));
        let strays = own.iter().map(|c| (0..=100).map(|k| (c[k] - w(k as f64 / 100.0)).abs()).fold(0.0, f64::max)).fold(0.0, f64::max);
        assert!(strays < 0.012, "{strays}");
    }

    #[test]
    fn a_motion_corresponds_to_itself_and_posture_alone_does_not_count() {
        let reference = walk(2, 1.1);
        let mut stooped = reference.clone();
        stooped.values.row_mut(30).add_scalar_mut(0.5);
        for other in [&reference, &stooped] {
            let found = warp(&reference, other, 60, false).remove(0);
            assert!(found.iter().enumerate().all(|(k, t)| (t - k as f64 / 60.0).abs() < 1e-12));
        }
    }
}

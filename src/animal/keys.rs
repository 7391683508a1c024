//! Key images: the frames whose kernel matrix is best conditioned.
//!
//! Of all sets S of m frames the one with the smallest κ(H_S) = λmax/λmin is wanted (Favreau et al. 2004, section 3.1;
//! their κ(HᵀH) = κ(H)²). H_S is a principal submatrix of the n×n kernel matrix, so eigenvalues interlace and κ never
//! falls when a frame is added: branch and bound drops every partial set whose κ reaches the best one's, and every pair
//! closer than κ({i,j}) = (1+h)/(1−h) allows. With s = 1 − bᵀH_S⁻¹b (Schur) λmin(H_{S∪c}) ≤ s bounds κ before any
//! eigenvalue is computed. Exact while the count of evaluated sets stays below a limit; beyond it the result is the
//! greedy search's with exchanges, and `bound` says how much better any set could be: the exact κ of fewer keys.
//! Ties go to the earliest frames. Checked against all subsets of small clips.

use nalgebra::{DMatrix, DVector};

use crate::math::rbf::kernel_matrix;

/// Sets evaluated before the exact search gives up: a second or three.
const MOST_EVALUATIONS: usize = 500_000;
/// κ of two frames that are as good as one.
const SINGULAR: f64 = 1e9;
/// Relative difference below which two κ are equal.
const TIE: f64 = 1e-12;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum KeyError {
    #[error("{keys} key images cannot be chosen from {frames} frames; ask for 2 to {frames}")]
    Count { keys: usize, frames: usize },
    #[error("the clip has fewer than {keys} different silhouettes; ask for fewer keys")]
    Alike { keys: usize },
}

#[derive(Clone, Debug, PartialEq)]
pub struct Selection {
    /// In order of time.
    pub frames: Vec<usize>,
    /// κ(H_S).
    pub condition: f64,
    /// Whether no set is better.
    pub exact: bool,
    /// No set of as many keys has a smaller κ.
    pub bound: f64,
    /// Sets whose eigenvalues were computed.
    pub evaluations: usize,
}

/// Chooses `keys` of the points (coefficients of one frame each).
pub fn select(points: &[Vec<f64>], keys: usize) -> Result<Selection, KeyError> {
    select_within(points, keys, MOST_EVALUATIONS)
}

fn select_within(points: &[Vec<f64>], keys: usize, most: usize) -> Result<Selection, KeyError> {
    if keys < 2 || keys > points.len() {
        return Err(KeyError::Count { keys, frames: points.len() });
    }
    let h = kernel_matrix(points);
    let greedy = greedy_with_exchanges(&h, keys);
    if greedy.1 > SINGULAR {
        return Err(KeyError::Alike { keys });
    }
    let mut search = Search { h: &h, keys, best: None, limit: greedy.1 * (1.0 + TIE), evaluations: 0, most };
    search.extend(&mut Vec::new(), &(0..points.len()).collect::<Vec<_>>());
    let exact = search.evaluations < most;
    let evaluations = search.evaluations;
    let (mut frames, condition) = match search.best {
        Some(best) => best,
        None => greedy,
    };
    frames.sort_unstable();
    // κ grows with every key: fewer keys' optimum bounds it from below.
    let bound = match (exact, keys) {
        (true, _) => condition,
        (false, 2) => 1.0,
        (false, _) => (2..=4.min(keys - 1))
            .rev()
            .find_map(|fewer| {
                let found = select_within(points, fewer, most).ok()?;
                found.exact.then_some(found.condition)
            })
            .unwrap_or(1.0),
    };
    Ok(Selection { frames, condition, exact, bound, evaluations })
}

/// κ of the principal submatrix of some frames.
pub fn condition(h: &DMatrix<f64>, frames: &[usize]) -> f64 {
    let (smallest, largest) = extremes(h, frames);
    if smallest > 0.0 { largest / smallest } else { f64::INFINITY }
}

fn extremes(h: &DMatrix<f64>, frames: &[usize]) -> (f64, f64) {
    match *frames {
        [] | [_] => (1.0, 1.0),
        [a, b] => (1.0 - h[(a, b)], 1.0 + h[(a, b)]),
        _ => {
            let part = DMatrix::from_fn(frames.len(), frames.len(), |i, j| h[(frames[i], frames[j])]);
            let values = part.symmetric_eigenvalues();
            (values.min(), values.max())
        }
    }
}

struct Search<'a> {
    h: &'a DMatrix<f64>,
    keys: usize,
    best: Option<(Vec<usize>, f64)>,
    /// κ to stay below.
    limit: f64,
    evaluations: usize,
    most: usize,
}

impl Search<'_> {
    /// Tries all completions of `chosen` by later frames out of `candidates`.
    fn extend(&mut self, chosen: &mut Vec<usize>, candidates: &[usize]) {
        if chosen.len() == self.keys {
            let value = condition(self.h, chosen);
            self.limit = value * (1.0 - TIE);
            self.best = Some((chosen.clone(), value));
            return;
        }
        let missing = self.keys - chosen.len();
        let Some(schur) = Schur::new(self.h, chosen) else { return };
        // Frames that can be added alone; a completion consists of such only.
        let mut open: Vec<(usize, f64)> = Vec::new();
        for &c in candidates {
            if schur.bound(self.h, c) >= self.limit {
                continue;
            }
            chosen.push(c);
            self.evaluations += 1;
            let k = condition(self.h, chosen);
            chosen.pop();
            if k < self.limit {
                open.push((c, k));
            }
        }
        for i in 0..open.len() {
            if open.len() - i < missing || self.evaluations >= self.most {
                return;
            }
            let (c, k) = open[i];
            if k >= self.limit {
                continue;
            }
            // The pair's own κ: (1+h)/(1−h) < limit.
            let nearest = (self.limit - 1.0) / (self.limit + 1.0);
            let rest: Vec<usize> = open[i + 1..].iter().filter(|o| o.1 < self.limit && self.h[(c, o.0)] < nearest).map(|o| o.0).collect();
            chosen.push(c);
            self.extend(chosen, &rest);
            chosen.pop();
        }
    }
}

/// H_S⁻¹ and λmax(H_S) of a set that is to grow.
struct Schur {
    chosen: Vec<usize>,
    inverse: DMatrix<f64>,
    largest: f64,
}

impl Schur {
    fn new(h: &DMatrix<f64>, chosen: &[usize]) -> Option<Schur> {
        let part = DMatrix::from_fn(chosen.len(), chosen.len(), |i, j| h[(chosen[i], chosen[j])]);
        let inverse = if chosen.is_empty() { DMatrix::zeros(0, 0) } else { part.cholesky()?.inverse() };
        Some(Schur { chosen: chosen.to_vec(), inverse, largest: extremes(h, chosen).1 })
    }

    /// κ(H_{S∪c}) is at least this.
    fn bound(&self, h: &DMatrix<f64>, c: usize) -> f64 {
        let b = DVector::from_iterator(self.chosen.len(), self.chosen.iter().map(|&i| h[(i, c)]));
        let s = 1.0 - b.dot(&(&self.inverse * &b));
        if s > 0.0 { self.largest / s } else { f64::INFINITY }
    }
}

/// Greedy growth from several first frames, each followed by the best exchanges of one frame until none helps.
fn greedy_with_exchanges(h: &DMatrix<f64>, keys: usize) -> (Vec<usize>, f64) {
    let n = h.nrows();
    let starts = n.min(8);
    let mut best = (Vec::new(), f64::INFINITY);
    for start in (0..starts).map(|i| i * n / starts) {
        let mut set = vec![start];
        while set.len() < keys {
            let free = (0..n).filter(|c| !set.contains(c));
            let next = free.map(|c| (c, condition(h, &[&set[..], &[c]].concat()))).min_by(|a, b| a.1.total_cmp(&b.1));
            set.extend(next.map(|n| n.0));
        }
        let improved = exchange(h, set);
        if improved.1 < best.1 || best.0.is_empty() {
            best = improved;
        }
    }
    best
}

fn exchange(h: &DMatrix<f64>, mut set: Vec<usize>) -> (Vec<usize>, f64) {
    let mut value = condition(h, &set);
    loop {
        let before = value;
        for i in 0..set.len() {
            for c in 0..h.nrows() {
                let old = set[i];
                if set.contains(&c) {
                    continue;
                }
                set[i] = c;
                let k = condition(h, &set);
                if k < value * (1.0 - TIE) { value = k } else { set[i] = old }
            }
        }
        if value >= before {
            return (set, value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A noisy circle of the size that unit variance gives.
    fn circle(n: usize, period: f64, seed: u64) -> Vec<Vec<f64>> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        (0..n)
            .map(|t| {
                let a = std::f64::consts::TAU * t as f64 / period;
                [a.cos(), a.sin()].map(|v| 1.4 * v + 0.3 * (random.random::<f64>() - 0.5)).to_vec()
            })
            .collect()
    }

    fn all_subsets(n: usize, m: usize) -> Vec<Vec<usize>> {
        if m == 0 {
            return vec![Vec::new()];
        }
        (m - 1..n)
            .flat_map(|last| {
                all_subsets(last, m - 1).into_iter().map(move |mut s| {
                    s.push(last);
                    s
                })
            })
            .collect()
    }

    #[test]
    fn equals_the_exhaustive_search() {
        for (n, m, seed) in [(18, 2, 1), (18, 3, 2), (16, 4, 3), (14, 5, 4), (12, 6, 5)] {
            let points = circle(n, 13.3, seed);
            let h = kernel_matrix(&points);
            let best = all_subsets(n, m).iter().map(|s| condition(&h, s)).fold(f64::INFINITY, f64::min);
            let found = select(&points, m).unwrap();
            assert!(found.exact && (found.condition - best).abs() < 1e-9 * best, "{n} {m}: {} {best}", found.condition);
            assert!((condition(&h, &found.frames) - best).abs() < 1e-9 * best && found.bound == found.condition);
            assert!(found.frames.windows(2).all(|w| w[0] < w[1]));
        }
    }

    #[test]
    fn a_cheetahs_137_frames_are_searched_exactly_and_beyond_the_limit_a_bound_is_given() {
        let points = circle(137, 17.7, 9);
        let four = select(&points, 4).unwrap();
        assert!(four.exact && four.evaluations < 1_000_000, "{}", four.evaluations);
        let eight = select_within(&points, 8, 100_000).unwrap();
        assert!(!eight.exact && eight.frames.len() == 8);
        let limited = select_within(&points, 8, 300_000).unwrap();
        assert!(limited.bound <= four.condition * (1.0 + 1e-12) && limited.bound > 1.0 && limited.condition > limited.bound);
    }

    #[test]
    fn of_equal_frames_the_earliest_are_taken() {
        let once = circle(12, 12.0, 11);
        let twice = [once.clone(), once.clone()].concat();
        let (a, b) = (select(&once, 4).unwrap(), select(&twice, 4).unwrap());
        assert_eq!(a.frames, b.frames);
        assert!(b.frames.iter().all(|f| *f < 12));
    }

    #[test]
    fn impossible_wishes_are_errors() {
        let points = circle(5, 5.0, 1);
        assert_eq!(select(&points, 6), Err(KeyError::Count { keys: 6, frames: 5 }));
        assert_eq!(select(&points, 1), Err(KeyError::Count { keys: 1, frames: 5 }));
        let same = vec![vec![0.5, 0.5]; 7];
        assert_eq!(select(&same, 3), Err(KeyError::Alike { keys: 3 }));
    }
}

//! Weights of the key poses over time: one model of all keys, or models that switch for symmetric gaits.
//!
//! A walk shows each silhouette twice per stride, with the legs exchanged. 2m keys in the order of the stride make four
//! sets of m, each half a set after the other (animal paper, equations 16 to 19):
//!   σ = [1 2 3 4; 3 4 5 6; 5 6 7 8; 7 8 1 2]  for m = 4
//! and the set after the present one takes over when the nearest key of the present set is its last one.
//! Departures: the nearest key must be the last one in two successive frames (hysteresis), sets cross-fade over two
//! frames, and of the four sets to begin with the one is taken that gives the keys' own frames their own poses.
//! Checked on a known stride, whose two halves look alike.

use crate::math::rbf::{Rbf, in_hull, squared_distance};

/// Successive frames that must agree before the set switches.
const AGREEING: usize = 2;
/// Frames over which the weights go from one set to the next.
const FADE: usize = 2;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum SwitchError {
    #[error("two key images lie in one point of the component plane; choose other keys")]
    Alike,
    #[error("{0} keys cannot be switched; their number must be a multiple of 4, in the order of the stride")]
    Count(usize),
}

#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    /// One row per frame, one weight per key.
    pub rows: Vec<Vec<f64>>,
    /// The set at work in every frame; all 0 for one model.
    pub sets: Vec<usize>,
}

/// One model of all keys; `keys` are frames.
pub fn single(points: &[Vec<f64>], keys: &[usize], clamp: bool) -> Result<Weights, SwitchError> {
    let nodes: Vec<Vec<f64>> = keys.iter().map(|k| points[*k].clone()).collect();
    single_over(points, &nodes, clamp)
}

/// The same for keys that are places in the component plane.
pub fn single_over(points: &[Vec<f64>], nodes: &[Vec<f64>], clamp: bool) -> Result<Weights, SwitchError> {
    let rbf = model(nodes, &(0..nodes.len()).collect::<Vec<_>>())?;
    let rows = points.iter().map(|p| limited(rbf.weights(p), clamp)).collect();
    Ok(Weights { rows, sets: vec![0; points.len()] })
}

/// Four overlapping sets of half of the keys; `keys` are frames in the order of the stride.
pub fn switched(points: &[Vec<f64>], keys: &[usize], clamp: bool) -> Result<Weights, SwitchError> {
    let own: Vec<Option<usize>> = keys.iter().map(|k| Some(*k)).collect();
    let nodes: Vec<Vec<f64>> = keys.iter().map(|k| points[*k].clone()).collect();
    switched_between(points, &nodes, &own, clamp)
}

/// The same for a clip that does not hold the keys' own frames, only their places in the component plane.
pub fn switched_over(points: &[Vec<f64>], nodes: &[Vec<f64>], clamp: bool) -> Result<Weights, SwitchError> {
    switched_between(points, nodes, &[], clamp)
}

fn switched_between(points: &[Vec<f64>], nodes: &[Vec<f64>], frames: &[Option<usize>], clamp: bool) -> Result<Weights, SwitchError> {
    let n = nodes.len();
    if n == 0 || !n.is_multiple_of(4) {
        return Err(SwitchError::Count(n));
    }
    let m = n / 2;
    let sets: Vec<Vec<usize>> = (0..4).map(|s| (0..m).map(|k| (s * m / 2 + k) % n).collect()).collect();
    let models = sets.iter().map(|set| model(nodes, set)).collect::<Result<Vec<_>, _>>()?;
    let runs = (0..4).map(|start| states(points, nodes, &sets, start)).map(|states| {
        let rows = blended(points, n, &sets, &models, &states, clamp);
        // How much of their own pose the keys' frames have, less what the motion turns to and fro in the stride.
        let own: f64 = frames.iter().enumerate().filter_map(|(k, frame)| Some(rows[(*frame)?][k].clamp(0.0, 1.0))).sum();
        (own - turning(&rows), Weights { rows, sets: states })
    });
    let best = runs.reduce(|best, next| if next.0 > best.0 + 1e-9 { next } else { best });
    best.map(|b| b.1).ok_or(SwitchError::Count(n))
}

/// Turns of the stride that the weighted keys pass, forward or backward.
fn turning(rows: &[Vec<f64>]) -> f64 {
    use std::f64::consts::TAU;
    let place = |row: &Vec<f64>| {
        let at = |k: usize| TAU * k as f64 / row.len() as f64;
        let sum = row.iter().enumerate().fold([0.0; 2], |[c, s], (k, w)| [c + w * at(k).cos(), s + w * at(k).sin()]);
        sum[1].atan2(sum[0]) / TAU
    };
    rows.windows(2).map(|w| place(&w[1]) - place(&w[0])).map(|step| (step - step.round()).abs()).sum()
}

fn model(nodes: &[Vec<f64>], set: &[usize]) -> Result<Rbf, SwitchError> {
    Rbf::new(set.iter().map(|k| nodes[*k].clone()).collect()).ok_or(SwitchError::Alike)
}

fn limited(weights: Vec<f64>, clamp: bool) -> Vec<f64> {
    if clamp { in_hull(&weights) } else { weights }
}

fn states(points: &[Vec<f64>], nodes: &[Vec<f64>], sets: &[Vec<usize>], start: usize) -> Vec<usize> {
    let (mut state, mut agreeing) = (start, 0);
    let mut states = Vec::with_capacity(points.len());
    for p in points {
        let set = &sets[state];
        let distance = |k: &usize| squared_distance(&nodes[*k], p);
        let nearest = set.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
        agreeing = if nearest == set.last() { agreeing + 1 } else { 0 };
        if agreeing >= AGREEING {
            (state, agreeing) = ((state + 1) % sets.len(), 0);
        }
        states.push(state);
    }
    states
}

fn blended(points: &[Vec<f64>], keys: usize, sets: &[Vec<usize>], models: &[Rbf], states: &[usize], clamp: bool) -> Vec<Vec<f64>> {
    let of_set = |s: usize, p: &[f64]| {
        let mut row = vec![0.0; keys];
        for (k, w) in sets[s].iter().zip(limited(models[s].weights(p), clamp)) {
            row[*k] += w;
        }
        row
    };
    let frame = |(t, p): (usize, &Vec<f64>)| {
        let since = (0..FADE).find(|back| t > *back && states[t - back] != states[t - back - 1]);
        let now = of_set(states[t], p);
        match since {
            Some(back) => {
                let part = (back + 1) as f64 / (FADE + 1) as f64;
                let before = of_set(states[t - back - 1], p);
                now.iter().zip(before).map(|(n, b)| part * n + (1.0 - part) * b).collect()
            }
            None => now,
        }
    };
    points.iter().enumerate().map(frame).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// Silhouettes go round twice per stride of 26 frames.
    fn walk(n: usize, start: f64) -> Vec<Vec<f64>> {
        (0..n).map(|t| start + TAU * t as f64 / 13.0).map(|a| vec![1.4 * a.cos(), 1.4 * a.sin()]).collect()
    }

    #[test]
    fn the_two_halves_of_a_stride_are_told_apart() {
        for start in [0.0, 1.0, 4.0] {
            let points = walk(104, start);
            let keys = [2, 5, 8, 12, 15, 18, 21, 25];
            let found = switched(&points, &keys, false).unwrap();
            for (t, row) in found.rows.iter().enumerate() {
                let heaviest = (0..8).max_by(|a, b| row[*a].total_cmp(&row[*b])).unwrap();
                let away = (keys[heaviest] as f64 - (t % 26) as f64).abs();
                assert!(away.min(26.0 - away) <= 3.0, "start {start} frame {t}: key {heaviest}, set {}", found.sets[t]);
                assert!((row.iter().sum::<f64>() - 1.0).abs() < 0.6, "{row:?}");
            }
            // One model of four keys gives both halves the same poses.
            let plain = single(&points, &keys[..4], false).unwrap();
            assert!((0..4).all(|k| (plain.rows[3][k] - plain.rows[16][k]).abs() < 1e-9));
        }
    }

    #[test]
    fn keys_keep_their_own_pose_and_clamped_weights_stay_in_the_hull() {
        let points = walk(30, 0.3);
        let found = single(&points, &[0, 3, 6, 10], false).unwrap();
        assert!((found.rows[3][1] - 1.0).abs() < 1e-9 && found.rows[3][0].abs() < 1e-9);
        assert!(found.rows.iter().flatten().any(|w| *w < -1e-3));
        let clamped = single(&points, &[0, 3, 6, 10], true).unwrap();
        assert!(clamped.rows.iter().all(|r| r.iter().all(|w| *w >= 0.0) && (r.iter().sum::<f64>() - 1.0).abs() < 1e-12));
        assert_eq!(single(&points, &[1, 14], false), Err(SwitchError::Alike));
        assert_eq!(switched(&points, &[0, 1, 2, 3, 4, 5], false), Err(SwitchError::Count(6)));
    }

    #[test]
    fn another_clip_is_driven_by_places_in_the_plane() {
        let keys = [2, 5, 8, 12, 15, 18, 21, 25];
        let known = walk(40, 0.0);
        let nodes: Vec<Vec<f64>> = keys.iter().map(|k| known[*k].clone()).collect();
        let own = single(&known, &keys[..4], false).unwrap();
        assert_eq!(single_over(&known, &nodes[..4], false).unwrap(), own);
        // Half a frame later, two strides.
        let found = switched_over(&walk(52, 0.24), &nodes, false).unwrap();
        let heaviest: Vec<usize> = found.rows.iter().map(|r| (0..8).max_by(|a, b| r[*a].total_cmp(&r[*b])).unwrap()).collect();
        let steps: Vec<usize> = heaviest.windows(2).map(|w| (w[1] + 8 - w[0]) % 8).collect();
        assert!(steps.iter().all(|s| *s <= 1) && (14..=17).contains(&steps.iter().sum::<usize>()), "{heaviest:?}");
    }
}

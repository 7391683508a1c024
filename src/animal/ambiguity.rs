//! The second frame of each key's silhouette: the other half of a symmetric stride.
//!
//! Candidates for a key are the frames nearest to it in the component plane, at least 3 frames away (animal paper,
//! section 3.2) and, where the rhythm is known, an odd number of silhouette periods away, give or take a quarter: even
//! numbers are the same half of another stride. Checked on a known stride.

use crate::math::rbf::squared_distance;

/// Frames that a candidate is away at least.
const APART: usize = 3;

/// Frames that may show the key's silhouette with the legs exchanged, the likeliest first. `turns` counts silhouette periods
/// ([`super::rhythm::Rhythm::turns`]); without it any distance in time will do.
pub fn candidates(points: &[Vec<f64>], turns: Option<&[f64]>, key: usize) -> Vec<usize> {
    let other_half = |frame: usize| {
        turns.is_none_or(|turns| {
            let away = (turns[frame] - turns[key]).abs();
            away.round() % 2.0 == 1.0 && (away - away.round()).abs() <= 0.25
        })
    };
    let mut found: Vec<usize> = (0..points.len()).filter(|f| f.abs_diff(key) >= APART && other_half(*f)).collect();
    let distance = |f: &usize| squared_distance(&points[*f], &points[key]);
    found.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.cmp(b)));
    found
}

/// Keys and their accepted alternates in the order of the stride, from the earliest key on: by their place in the stride of
/// two silhouette periods, or, without `turns`, all keys and then all alternates.
pub fn stride_order(keys: &[usize], alternates: &[usize], turns: Option<&[f64]>) -> Vec<usize> {
    let mut all: Vec<usize> = keys.iter().chain(alternates).copied().collect();
    if let (Some(turns), Some(first)) = (turns, keys.iter().min()) {
        let place = |f: &usize| ((turns[*f] - turns[*first]) / 2.0 + 1e-9).rem_euclid(1.0);
        all.sort_by(|a, b| place(a).total_cmp(&place(b)).then(a.cmp(b)));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn alternates_lie_in_the_other_half_and_the_order_is_the_strides() {
        // The paper's walk: half a stride is 13 frames.
        let turns: Vec<f64> = (0..80).map(|t| f64::from(t) / 13.0).collect();
        let points: Vec<Vec<f64>> = turns.iter().map(|t| vec![(TAU * t).cos(), (TAU * t).sin()]).collect();
        let keys = [14, 17, 21, 24];
        let alternates = keys.map(|k| candidates(&points, Some(&turns), k)[0]);
        assert!(keys.iter().zip(alternates).all(|(k, a)| (a.abs_diff(*k) / 13) % 2 == 1 && a.abs_diff(*k) % 13 == 0), "{alternates:?}");
        let order = stride_order(&keys, &alternates, Some(&turns));
        let places: Vec<usize> = order.iter().map(|f| (f + 26 - 14) % 26).collect();
        assert_eq!(places, [0, 3, 7, 10, 13, 16, 20, 23]);
        assert!(candidates(&points, None, 14).iter().all(|f| f.abs_diff(14) >= 3));
        assert_eq!(stride_order(&[4, 9], &[15, 20], None), [4, 9, 15, 20]);
    }
}

//! Lone points out, thinning.
//!
//! A point goes when the mean distance to its k nearest neighbours, in units of its own standard deviation, exceeds the
//! cloud's median by more than c median deviations (PCL's statistical outlier filter, with the median for the mean, because a
//! cloud of few points must not excuse its own outliers). Any k points are at least as far on average as the k nearest: where
//! those of the neighbouring pixels are near enough, nothing is searched.

use super::cloud::{Cloud, CloudPoint};
use crate::math::order::quantile;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::collections::BTreeMap;
use std::num::NonZero;

/// Neighbours that a point is judged by; fewer let pairs of outliers excuse each other.
pub const NEIGHBOURS: usize = 12;

/// Points that the medians are taken over, about.
const SAMPLED: usize = 1000;

/// c: robust standard deviations of the neighbour distance.
const OUTLIER_LIMIT: f64 = 6.0;

/// Clouds of fewer points are not judged.
const FEWEST_POINTS: usize = 50;

/// The cloud without its lone points. `beside` names points that are likely the nearest to one, where it can.
pub fn remove_outliers(cloud: Cloud, beside: impl Fn(usize) -> Option<[usize; NEIGHBOURS]>) -> Cloud {
    let Some(first) = cloud.points.first().filter(|_| cloud.points.len() >= FEWEST_POINTS) else { return cloud };
    let places = places(&cloud, first);
    // More points than a bucket at one place make the tree refuse; such a cloud is left as it is.
    let Ok(tree) = ImmutableKdTree::<f32, 3>::new_from_slice(&places) else { return cloud };
    let wanted = NonZero::new(NEIGHBOURS + 1).unwrap_or(NonZero::<usize>::MIN);
    let spread = |i: usize, squares: &mut dyn Iterator<Item = f32>| {
        let mean = squares.map(|square| f64::from(square).sqrt()).sum::<f64>() / NEIGHBOURS as f64;
        mean / cloud.points[i].covariance.trace().max(1e-12).sqrt()
    };
    let nearest = |i: usize| {
        let near = tree.query(&places[i]).nearest_n::<SquaredEuclidean<f32>>(wanted).execute();
        spread(i, &mut near.iter().map(|n| n.distance))
    };
    let step = (places.len() / SAMPLED).max(1);
    let sampled: Vec<f64> = (0..places.len()).step_by(step).map(nearest).collect();
    let middle = median(sampled.clone());
    let deviation = 1.4826 * median(sampled.iter().map(|s| (s - middle).abs()).collect());
    let limit = middle + OUTLIER_LIMIT * deviation.max(0.15 * middle);
    let square = |i: usize, j: usize| (0..3).map(|k| (places[i][k] - places[j][k]).powi(2)).sum();
    let stays = |i: usize| match (i % step, beside(i)) {
        (0, _) => sampled[i / step] <= limit,
        (_, Some(others)) if spread(i, &mut others.iter().map(|j| square(i, *j))) <= limit => true,
        _ => nearest(i) <= limit,
    };
    let stay: Vec<bool> = (0..places.len()).map(stays).collect();
    let mut points: Vec<CloudPoint> = cloud.points.into_iter().zip(stay).filter(|(_, stays)| *stays).map(|(p, _)| p).collect();
    // Clouds of all frames are kept.
    points.shrink_to_fit();
    Cloud { points }
}

/// Where the points of a cloud are from one of them on: micrometres are enough to find neighbours.
fn places(cloud: &Cloud, from: &CloudPoint) -> Vec<[f32; 3]> {
    cloud.points.iter().map(|p| (p.position - from.position).map(|v| v as f32).into()).collect()
}

/// The most confident point of every cube of side `voxel_m`, in the order of the cloud.
pub fn thin(cloud: Cloud, voxel_m: f64) -> Cloud {
    let mut best: BTreeMap<[i64; 3], usize> = BTreeMap::new();
    for (i, point) in cloud.points.iter().enumerate() {
        let cube: [i64; 3] = point.position.map(|x| (x / voxel_m).floor() as i64).into();
        let kept = best.entry(cube).or_insert(i);
        if point.confidence > cloud.points[*kept].confidence {
            *kept = i;
        }
    }
    let mut kept: Vec<usize> = best.into_values().collect();
    kept.sort_unstable();
    Cloud { points: kept.into_iter().map(|i| cloud.points[i].clone()).collect() }
}

fn median(values: Vec<f64>) -> f64 {
    quantile(values, 0.5).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Vector3};

    fn point(x: f64, y: f64, z: f64) -> CloudPoint {
        CloudPoint { position: Vector3::new(x, y, z), colour: [0; 3], confidence: x, covariance: Matrix3::identity() * 1e-4 }
    }

    fn sheet() -> Cloud {
        let mut points: Vec<_> =
            (0..900).map(|i| point(f64::from(i % 30) * 0.01, f64::from(i / 30) * 0.01, 0.002 * f64::from(i * 7 % 5))).collect();
        points.push(point(0.15, 0.15, 0.5));
        points.push(point(0.9, 0.1, 0.0));
        points.push(point(0.9, 0.1, 0.01));
        Cloud { points }
    }

    #[test]
    fn lone_points_go_and_the_sheet_stays() {
        let kept = remove_outliers(sheet(), |_| None);
        assert_eq!(kept.points.len(), 900);
        assert!(kept.points.iter().all(|p| p.position.x < 0.5 && p.position.z < 0.1));
    }

    #[test]
    fn neighbours_that_are_named_change_nothing() {
        let (columns, rows) = (80usize, 60);
        let depth = |i: usize| if i % 97 == 5 { 0.4 } else { 0.002 * (i * 7 % 5) as f64 };
        let points = (0..columns * rows).map(|i| point((i % columns) as f64 * 0.01, (i / columns) as f64 * 0.01, depth(i)));
        let cloud = Cloud { points: points.collect() };
        let around = || (-2isize..=2).flat_map(|y| (-2isize..=2).map(move |x| (x, y))).filter(|(x, y)| (1..=4).contains(&(x * x + y * y)));
        let beside = |i: usize| {
            let inside = (2..columns - 2).contains(&(i % columns)) && (2..rows - 2).contains(&(i / columns));
            let near: Vec<usize> = around().filter_map(|(x, y)| i.checked_add_signed(x + y * columns as isize)).collect();
            if inside { near.try_into().ok() } else { None }
        };
        let (with, without) = (remove_outliers(cloud.clone(), beside), remove_outliers(cloud, |_| None));
        assert!(without.points.len() < columns * rows && without.points.len() > columns * rows * 9 / 10);
        assert_eq!(with, without);
    }

    #[test]
    fn distances_meet_brute_force() {
        let cloud = sheet();
        let places = places(&cloud, &cloud.points[0]);
        let tree = ImmutableKdTree::<f32, 3>::new_from_slice(&places).unwrap();
        for (at, point) in places.iter().zip(&cloud.points) {
            let near = tree.query(at).nearest_n::<SquaredEuclidean<f32>>(NonZero::new(NEIGHBOURS + 1).unwrap()).execute();
            let mut all: Vec<f64> = cloud.points.iter().map(|p| (p.position - point.position).norm_squared()).collect();
            all.sort_by(f64::total_cmp);
            let (ours, theirs): (f64, f64) = (near.iter().map(|n| f64::from(n.distance)).sum(), all[..=NEIGHBOURS].iter().sum());
            assert!((ours - theirs).abs() < 1e-4 * theirs);
        }
    }

    #[test]
    fn thinning_keeps_the_most_confident_of_each_cube() {
        let thinned = thin(sheet(), 0.1);
        assert!(thinned.points.len() < 20);
        assert!(thinned.points.iter().any(|p| (p.position.x - 0.09).abs() < 1e-9));
        assert_eq!(thin(Cloud::default(), 0.1), Cloud::default());
    }
}

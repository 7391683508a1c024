//! Measurements of one frame: thinned cloud points and silhouette rays.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Matrix3, Point2, Vector3};

use super::people::Person;
use super::problem::{Frame, Outside, Target};
use super::silhouette::Silhouette;
use crate::clouds::{Cloud, CloudPoint};
use crate::rig::{Camera, Rig};

/// What the cameras saw of the person at one instant.
#[derive(Clone, Debug, Default)]
pub struct Observation {
    /// Number of the frame in the input.
    pub number: usize,
    pub time_s: f64,
    pub cloud: Cloud,
    /// Per camera of the rig; `None` where a camera has none.
    pub silhouettes: Arc<Vec<Option<Silhouette>>>,
}

/// Edge of the cubes over which points are averaged: about a correlation window, below which points say the same thing.
const VOXEL_M: f64 = 0.025;
/// Points lower than this above the floor are the floor in the person's shadow as often as the person.
const SHADOW_M: f64 = 0.03;
/// Uncertainty of a mask's outline.
const OUTLINE_PX: f64 = 1.5;

/// All that one frame's measurements are chosen from.
#[derive(Clone, Debug)]
pub struct Choice {
    time_s: f64,
    /// Thinned.
    points: Vec<Target>,
    /// Per camera, pixels.
    outlines: Vec<Vec<Point2<f64>>>,
    outsides: Arc<Vec<Outside>>,
}

impl Choice {
    /// Of a person; the floor is at height `floor_m`.
    pub fn new(person: &Person, rig: &Rig, floor_m: Option<f64>) -> Choice {
        let up = rig.up.direction();
        let lowest = floor_m.map_or(f64::NEG_INFINITY, |floor| floor + SHADOW_M);
        let seen = rig.cameras.iter().zip(person.silhouettes.iter()).filter_map(|(c, s)| Some((c, s.as_ref()?)));
        Choice {
            time_s: person.time_s(),
            points: thinned(person.points(), |x| x.dot(&up) > lowest),
            outlines: person.silhouettes.iter().map(|s| s.as_ref().map_or(Vec::new(), Silhouette::outline)).collect(),
            outsides: Arc::new(seen.map(|(camera, s)| Outside { camera: camera.clone(), field: s.distances() }).collect()),
        }
    }

    /// At most `points` cloud points and `rays` silhouette rays per camera, evenly chosen.
    pub fn frame(&self, rig: &Rig, points: usize, rays: usize) -> Frame {
        let mut targets = evenly(&self.points, points);
        for (camera, outline) in rig.cameras.iter().zip(&self.outlines) {
            targets.extend(evenly(outline, rays).iter().filter_map(|pixel| ray(camera, pixel)));
        }
        Frame { time_s: self.time_s, targets, outsides: self.outsides.clone() }
    }

    /// At most `points` of the cloud points that [`frame`](Self::frame) does not choose.
    pub fn left_out(&self, points: usize) -> Frame {
        let chosen: Vec<usize> = evenly(&(0..self.points.len()).collect::<Vec<_>>(), points);
        let others = (0..self.points.len()).filter(|i| chosen.binary_search(i).is_err()).map(|i| self.points[i].clone());
        Frame { time_s: self.time_s, targets: evenly(&others.collect::<Vec<_>>(), points), outsides: Arc::default() }
    }
}

fn evenly<T: Clone>(items: &[T], wanted: usize) -> Vec<T> {
    if items.len() <= wanted {
        return items.to_vec();
    }
    (0..wanted).map(|i| items[i * items.len() / wanted].clone()).collect()
}

/// Mean position and mean covariance of the points in each cube of [`VOXEL_M`].
fn thinned<'a>(points: impl Iterator<Item = &'a CloudPoint>, wanted: impl Fn(&Vector3<f64>) -> bool) -> Vec<Target> {
    let mut cubes: BTreeMap<[i64; 3], (Vector3<f64>, Matrix3<f64>, f64)> = BTreeMap::new();
    for point in points.filter(|p| wanted(&p.position)) {
        let key = [0, 1, 2].map(|k| (point.position[k] / VOXEL_M).floor() as i64);
        let cube = cubes.entry(key).or_insert((Vector3::zeros(), Matrix3::zeros(), 0.0));
        cube.0 += point.position;
        cube.1 += point.covariance;
        cube.2 += 1.0;
    }
    cubes.into_values().map(|(sum, covariance, n)| Target::Point { x: sum / n, covariance: covariance / n }).collect()
}

fn ray(camera: &Camera, pixel: &Point2<f64>) -> Option<Target> {
    let sigma = OUTLINE_PX / camera.matrix[(0, 0)];
    Some(Target::Ray { origin: camera.centre(), direction: camera.ray(pixel)?, sigma })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_averages_cubes_and_keeps_the_rest() {
        let point = |x: f64| CloudPoint {
            position: Vector3::new(x, 0.001, 0.001),
            colour: [0; 3],
            confidence: 1.0,
            covariance: Matrix3::identity() * x,
        };
        let points = [point(0.004), point(0.012), point(0.5), point(2.0)];
        let targets = thinned(points.iter(), |x| x.x < 1.0);
        assert_eq!(targets.len(), 2);
        assert!(
            matches!(&targets[0], Target::Point { x, covariance } if (x.x - 0.008).abs() < 1e-12 && (covariance[(0, 0)] - 0.008).abs() < 1e-12)
        );
    }
}

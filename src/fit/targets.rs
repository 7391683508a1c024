//! Measurements of one frame: thinned cloud points and silhouette rays.

use std::collections::BTreeMap;
use std::sync::Arc;

use image::GrayImage;
use nalgebra::{Matrix3, Point2, Vector3};

use super::people::Person;
use super::problem::{Frame, Outside, Target};
use crate::clouds::{Cloud, CloudPoint};
use crate::math::distance_field::DistanceField;
use crate::rig::{Camera, Rig};

/// What the cameras saw of the person at one instant.
#[derive(Clone, Debug, Default)]
pub struct Observation {
    /// Number of the frame in the input.
    pub number: usize,
    pub time_s: f64,
    pub cloud: Cloud,
    /// Silhouette per camera of the rig, raw pixels, 255 inside; `None` where a camera has none.
    pub masks: Arc<Vec<Option<GrayImage>>>,
}

/// Edge of the cubes over which points are averaged: about a correlation window, below which points say the same thing.
const VOXEL_M: f64 = 0.025;
/// Points lower than this above the floor are the floor in the person's shadow as often as the person.
const SHADOW_M: f64 = 0.03;
/// Uncertainty of a mask's outline.
const OUTLINE_PX: f64 = 1.5;
/// Cells of the distance to a silhouette: half the memory of pixels in each direction, a centimetre at 3 m.
const FIELD_STEP_PX: usize = 2;
/// Outlines this close to the image border are the border's.
const BORDER_PX: u32 = 3;

/// Distances to the silhouettes of one frame.
pub fn outsides(person: &Person, rig: &Rig) -> Vec<Outside> {
    let masks = rig.cameras.iter().zip(person.masks.iter());
    let known = masks.filter_map(|(camera, mask)| mask.as_ref().map(|m| (camera, m)));
    known
        .map(|(camera, mask)| {
            let (width, height) = (mask.width() as usize, mask.height() as usize);
            let inside = |x: usize, y: usize| mask.as_raw()[y * width + x] > 127;
            Outside { camera: camera.clone(), field: DistanceField::new(width, height, FIELD_STEP_PX, inside) }
        })
        .collect()
}

/// At most `points` cloud points and `rays` silhouette rays per camera, evenly chosen; the floor is at height `floor_m`.
pub fn frame(person: &Person, rig: &Rig, outsides: &Arc<Vec<Outside>>, floor_m: Option<f64>, points: usize, rays: usize) -> Frame {
    let up = rig.up.direction();
    let lowest = floor_m.map_or(f64::NEG_INFINITY, |floor| floor + SHADOW_M);
    let mut targets = evenly(&thinned(person.points(), |x| x.dot(&up) > lowest), points);
    for (camera, mask) in rig.cameras.iter().zip(person.masks.iter()) {
        if let Some(mask) = mask {
            targets.extend(evenly(&outline(mask), rays).iter().filter_map(|pixel| ray(camera, pixel)));
        }
    }
    Frame { time_s: person.time_s(), targets, outsides: outsides.clone() }
}

/// At most `points` of the cloud points that [`frame`] does not choose.
pub fn left_out(person: &Person, rig: &Rig, floor_m: Option<f64>, points: usize) -> Frame {
    let all = thinned(person.points(), |x| x.dot(&rig.up.direction()) > floor_m.map_or(f64::NEG_INFINITY, |floor| floor + SHADOW_M));
    let chosen: Vec<usize> = evenly(&(0..all.len()).collect::<Vec<_>>(), points);
    let others: Vec<Target> = (0..all.len()).filter(|i| chosen.binary_search(i).is_err()).map(|i| all[i].clone()).collect();
    Frame { time_s: person.time_s(), targets: evenly(&others, points), outsides: Arc::default() }
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

/// Points half-way between mask pixels and their 4-neighbours outside, row by row.
fn outline(mask: &GrayImage) -> Vec<Point2<f64>> {
    let (width, height) = mask.dimensions();
    let inside = |x: u32, y: u32| mask.get_pixel(x, y).0[0] > 127;
    let mut pixels = Vec::new();
    for y in BORDER_PX..height.saturating_sub(BORDER_PX) {
        for x in BORDER_PX..width.saturating_sub(BORDER_PX) {
            if inside(x, y) {
                for (dx, dy) in [(-1i32, 0i32), (1, 0), (0, -1), (0, 1)] {
                    if !inside((x as i32 + dx) as u32, (y as i32 + dy) as u32) {
                        pixels.push(Point2::new(x as f64 + 0.5 * dx as f64, y as f64 + 0.5 * dy as f64));
                    }
                }
            }
        }
    }
    pixels
}

fn ray(camera: &Camera, pixel: &Point2<f64>) -> Option<Target> {
    let sigma = OUTLINE_PX / camera.matrix[(0, 0)];
    Some(Target::Ray { origin: camera.centre(), direction: camera.ray(pixel)?, sigma })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outline_of_a_rectangle_runs_along_its_edges() {
        let mask = GrayImage::from_fn(40, 30, |x, y| image::Luma([if (10..20).contains(&x) && (8..20).contains(&y) { 255 } else { 0 }]));
        let pixels = outline(&mask);
        assert_eq!(pixels.len(), 2 * (10 + 12));
        assert!(pixels.iter().all(|p| p.x == 9.5 || p.x == 19.5 || p.y == 7.5 || p.y == 19.5));
        assert!(outline(&GrayImage::from_pixel(40, 30, image::Luma([255]))).is_empty());
    }

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

//! How tall the person is and which way is up, by the rig: wrong units and wrong up axes show.
//!
//! Corners matched between the cameras give the person's distance (medians of triangulated points); the silhouette is
//! carried to the plane through it that faces the camera. Its longest direction d is the person's, their height its length;
//! the head is the narrower end. `u` is up in the pictures, as the rig has it in the world.
//! Nothing is said of people cut by the picture's edge, or who are not upright in the pictures.
//! Checked on a rendered walker with scaled, turned and upside-down rigs.

use super::epipolar::PairMatches;
use super::reduce::{full_px, reduction};
use crate::math::order::quantile;
use crate::rig::{Camera, Rig};
use image::GrayImage;
use nalgebra::{Matrix2, Vector2, Vector3};

/// Fewer matched corners at an instant give no distance.
const FEWEST_POINTS: usize = 8;
/// Share of the length at either end that is head or feet.
const END: f64 = 0.15;
/// A person is this many times longer than wide.
const ELONGATED: f64 = 1.8;
/// Smaller and taller people than these do not walk before cameras.
const STATURES_M: std::ops::Range<f64> = 0.4..3.2;
/// Cosines above this are alike, below the other across.
const ALIKE: f64 = 0.8;
const ACROSS: f64 = 0.5;
/// Feet in stride are this many times wider than the head.
const WIDER: f64 = 1.2;

/// The person by the rig's own measure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Person {
    /// Length of the silhouette, metres.
    pub height_m: f64,
    /// Lowest point along the rig's up axis, metres.
    pub feet_m: f64,
    /// From feet to head, unit, in the world.
    pub head: Vector3<f64>,
    /// Up in the pictures, unit, in the world.
    pub picture_up: Vector3<f64>,
}

/// What the rig says wrongly of the person.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Doubt {
    /// The person would be `height_m` tall; translations times `scale` would make an adult of them.
    Units {
        height_m: f64,
        scale: f64,
    },
    /// The person stands along this axis of the world (0 to 2, and its sign), which is not the rig's up.
    Up {
        axis: usize,
        positive: bool,
    },
    UpsideDown,
}

/// The silhouette of one camera at one instant.
struct Outline {
    height_m: f64,
    feet_m: f64,
    head: Vector3<f64>,
    /// Width at the feet over that at the head.
    widening: f64,
}

/// Measures the person at some instants: matches on them (one list per instant) and reduced masks per instant and camera.
/// `None` where nobody is whole in view.
pub fn measure(rig: &Rig, pairs: &[PairMatches], masks: &[Vec<GrayImage>]) -> Option<Person> {
    let picture_up: Vector3<f64> = rig.cameras.iter().map(|c| c.camera_from_world.inverse() * -Vector3::y()).sum();
    let picture_up = picture_up.try_normalize(1e-6)?;
    let mut outlines = Vec::new();
    for (instant, masks) in masks.iter().enumerate() {
        let Some(place) = place(rig, pairs, instant) else { continue };
        let up = rig.up.direction();
        outlines.extend(rig.cameras.iter().zip(masks).filter_map(|(camera, mask)| outline(camera, mask, &place, &picture_up, &up)));
    }
    let median = |value: &dyn Fn(&Outline) -> f64| quantile(outlines.iter().map(value).collect(), 0.5);
    let part = |k: usize| median(&|o: &Outline| o.head[k]);
    let along = Vector3::new(part(0)?, part(1)?, part(2)?).try_normalize(1e-6)?;
    let head = if median(&|o| o.widening.ln())? < -WIDER.ln() { -along } else { along };
    Some(Person { height_m: median(&|o| o.height_m)?, feet_m: median(&|o| o.feet_m)?, head, picture_up })
}

/// Where the person is at an instant.
fn place(rig: &Rig, pairs: &[PairMatches], instant: usize) -> Option<Vector3<f64>> {
    let mut points = Vec::new();
    for pair in pairs {
        let (a, b) = (&rig.cameras[pair.first], &rig.cameras[pair.second]);
        let found = pair.sets.get(instant).into_iter().flatten();
        points.extend(found.filter_map(|m| midpoint([a, b], [&a.ray(&m.first_px)?, &b.ray(&m.second_px)?])));
    }
    if points.len() < FEWEST_POINTS {
        return None;
    }
    let median = |k: usize| quantile(points.iter().map(|p: &Vector3<f64>| p[k]).collect(), 0.5);
    Some(Vector3::new(median(0)?, median(1)?, median(2)?))
}

/// The point nearest to both rays; `None` behind a camera.
fn midpoint([a, b]: [&Camera; 2], [ray_a, ray_b]: [&Vector3<f64>; 2]) -> Option<Vector3<f64>> {
    let (between, cosine) = (b.centre() - a.centre(), ray_a.dot(ray_b));
    let determinant = 1.0 - cosine * cosine;
    let s = (between.dot(ray_a) - cosine * between.dot(ray_b)) / determinant;
    let t = (cosine * between.dot(ray_a) - between.dot(ray_b)) / determinant;
    (determinant > 1e-9 && s > 0.0 && t > 0.0).then(|| (a.centre() + ray_a * s + b.centre() + ray_b * t) / 2.0)
}

/// The silhouette in the plane through `place` that faces the camera; `None` where it is cut, or not elongated upwards in
/// the picture.
fn outline(camera: &Camera, mask: &GrayImage, place: &Vector3<f64>, picture_up: &Vector3<f64>, up: &Vector3<f64>) -> Option<Outline> {
    let (factor, last) = (reduction(camera.size_px), [mask.width().checked_sub(1)?, mask.height().checked_sub(1)?]);
    let pixels: Vec<[u32; 2]> = mask.enumerate_pixels().filter(|(_, _, m)| m.0[0] > 0).map(|(x, y, _)| [x, y]).collect();
    if pixels.is_empty() || pixels.iter().any(|p| p[0] == 0 || p[1] == 0 || p[0] == last[0] || p[1] == last[1]) {
        return None;
    }
    let (depth_m, world_from_camera) = (camera.camera_point(place).z, camera.camera_from_world.inverse());
    let points: Vec<Vector2<f64>> =
        pixels.iter().filter_map(|p| camera.normalise(&full_px(p[0], p[1], factor))).map(|n| n * depth_m).collect();
    let mean = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
    let spread = points.iter().map(|p| (p - mean) * (p - mean).transpose()).sum::<Matrix2<f64>>().symmetric_eigen();
    let long = spread.eigenvalues.imax();
    let ratio = (spread.eigenvalues[long] / spread.eigenvalues[1 - long].max(1e-12)).sqrt();
    let along = spread.eigenvectors.column(long).into_owned();
    let in_world = |v: &Vector2<f64>| world_from_camera * Vector3::new(v.x, v.y, 0.0);
    let along = if in_world(&along).dot(picture_up) < 0.0 { -along } else { along };
    if ratio < ELONGATED || in_world(&along).dot(picture_up) < ALIKE {
        return None;
    }
    let heights: Vec<f64> = points.iter().map(|p| (p - mean).dot(&along)).collect();
    let (low, high) = (heights.iter().copied().fold(f64::INFINITY, f64::min), heights.iter().copied().fold(f64::NEG_INFINITY, f64::max));
    let width = |inside: &dyn Fn(f64) -> bool| {
        let across = points.iter().zip(&heights).filter(|(_, h)| inside(**h)).map(|(p, _)| (p - mean).perp(&along));
        let (left, right) = across.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, r), x| (l.min(x), r.max(x)));
        (right - left).max(1e-3 * (high - low))
    };
    let end = END * (high - low);
    let widening = width(&|h| h < low + end) / width(&|h| h > high - end);
    let lowest = points.iter().map(|p| (world_from_camera * (Vector3::new(p.x, p.y, depth_m) - camera.translation)).dot(up));
    Some(Outline { height_m: high - low, feet_m: lowest.fold(f64::INFINITY, f64::min), head: in_world(&along), widening })
}

impl Person {
    /// What the rig says wrongly.
    pub fn doubt(&self, rig: &Rig) -> Option<Doubt> {
        if !STATURES_M.contains(&self.height_m) {
            return Some(Doubt::Units { height_m: self.height_m, scale: likely_scale(self.height_m) });
        }
        let up = rig.up.direction();
        if self.head.dot(&up).abs() < ACROSS && self.picture_up.dot(&up).abs() < ACROSS {
            let axis = self.head.iamax();
            return Some(Doubt::Up { axis, positive: self.head[axis] > 0.0 });
        }
        (self.head.dot(&up) < -ALIKE && self.picture_up.dot(&up) < -ALIKE).then_some(Doubt::UpsideDown)
    }
}

/// The change of units that makes an adult.
fn likely_scale(height_m: f64) -> f64 {
    let units = [1e-3, 1e-2, 0.0254, 0.1, 0.3048, 10.0, 100.0, 1000.0];
    let error = |scale: f64| (height_m * scale / 1.7).ln().abs();
    units.into_iter().min_by(|a, b| error(*a).total_cmp(&error(*b))).unwrap_or(1.0)
}

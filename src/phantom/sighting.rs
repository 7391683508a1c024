//! What stereo and background subtraction measure of a figure, without pictures: for tables over hundreds of walks.
//!
//! A point of the cloud belongs to a pixel p of the reference camera; its disparity is that of the skin at p + δ, plus ε:
//!   X = world(p, d(p + δ) + ε),   Σ = J diag(σ_δ², σ_δ², σ_ε²) Jᵀ,                                                  (1)
//! as clouds are triangulated. δ and ε are means of white noise over windows of 5×5 px, so neighbours share them as they
//! share a correlation window. Skin that no other camera sees has no point. With n cameras σ_ε is that of a pair over √(n−1).
//! Masks: silhouettes whose pixels are displaced by smooth noise. Pixels between four corners inside are inside without a
//! look, so details smaller than the corners' distance may be lost.
//! Checked against the figure's distance (no noise), the spread that Σ states, and the full silhouette.

use std::ops::Range;

use image::{GrayImage, Luma};
use nalgebra::{Matrix3, Point2, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use super::figure::{Eye, Figure};
use super::noise::gradient_noise;
use super::scene::{gaussian_pair, pixel_box};
use crate::rig::rectify::Rectification;
use crate::rig::{Camera, Rig};

/// Half the edge of the windows in which points share their noise, px.
const WINDOW: i64 = 2;
/// Pixels between the corners that are looked at for a mask.
const CORNERS_PX: u32 = 4;
/// Cell of the noise that displaces outlines, px.
const OUTLINE_CELL_PX: f64 = 10.0;
/// Standard deviation of [`gradient_noise`] away from its lattice.
const NOISE_SIGMA: f64 = 0.27;
/// A second camera sees a point when nothing is nearer by more than this, metres.
const OCCLUDED_M: f64 = 0.01;
/// Clutter lies in the figure's box widened by this, metres.
const AROUND_M: f64 = 0.4;

/// What goes wrong between the skin and the measurement.
#[derive(Clone, Copy, Debug)]
pub struct SightOptions {
    /// Pixels between points of the cloud.
    pub step_px: usize,
    /// σ_ε of one pair of cameras.
    pub disparity_px: f64,
    /// σ_δ along each axis of the picture.
    pub place_px: f64,
    /// Standard deviation of the masks' outlines.
    pub outline_px: f64,
    /// Share of the points that lie anywhere around the figure, 0 to below 1.
    pub clutter: f64,
    pub seed: u64,
}

impl Default for SightOptions {
    /// As measured on rendered footage with 2 grey levels of noise, a little worse.
    fn default() -> Self {
        SightOptions { step_px: 3, disparity_px: 0.15, place_px: 1.0, outline_px: 0.7, clutter: 0.0, seed: 1 }
    }
}

/// A measured point in the world with its covariance, metres and m².
pub type SightedPoint = (Vector3<f64>, Matrix3<f64>);

/// Points that the cameras of `group` measure of a figure in frame number `frame`.
pub fn points(figure: &Figure, group: &Rectification, frame: usize, options: &SightOptions) -> Vec<SightedPoint> {
    let camera = &group.views[0].camera;
    let Some([columns, rows]) = bounding_box(figure, camera) else { return Vec::new() };
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    rng.set_stream(frame as u64);
    let noise: [Windowed; 3] = std::array::from_fn(|_| Windowed::new(&columns, &rows, &mut rng));
    let mut eyes: Vec<Eye> = group.views.iter().map(|v| figure.seen_from(&v.camera.centre())).collect();
    let sigma_px = options.disparity_px / ((group.views.len() - 1) as f64).sqrt();
    let mut found = Vec::new();
    for y in rows.clone().step_by(options.step_px.max(1)) {
        for x in columns.clone().step_by(options.step_px.max(1)) {
            let [du, dv, dd] = noise.each_ref().map(|n| n.at(x, y));
            let at = Point2::new(f64::from(x), f64::from(y));
            let moved = at + options.place_px * Vector2::new(du, dv);
            let seen = skin_at(group, &mut eyes, &moved).and_then(|skin| disparity(group, &skin));
            if let (Some(d), Some(pixel)) = (seen, group.rectified_pixel(0, &at)) {
                found.push(measured(group, &pixel, d + sigma_px * dd, [options.place_px, sigma_px]));
            }
        }
    }
    let strays = (found.len() as f64 * options.clutter / (1.0 - options.clutter)).round() as usize;
    found.extend(clutter(figure, group, strays, [options.place_px, sigma_px], &mut rng));
    found
}

/// Equation (1) at a rectified pixel.
fn measured(group: &Rectification, pixel: &Vector2<f64>, d: f64, [place_px, sigma_px]: [f64; 2]) -> SightedPoint {
    let jacobian = group.world_jacobian(pixel.x, pixel.y, d);
    let variances = Vector3::new(place_px.powi(2), place_px.powi(2), sigma_px.powi(2));
    (group.world_from_pixel(pixel.x, pixel.y, d), jacobian * Matrix3::from_diagonal(&variances) * jacobian.transpose())
}

/// Skin at a raw pixel of the reference camera if one of the others sees it too.
fn skin_at(group: &Rectification, eyes: &mut [Eye], at: &Point2<f64>) -> Option<Vector3<f64>> {
    let camera = &group.views[0].camera;
    let ray = camera.ray(at)?;
    let (first, others) = eyes.split_first_mut()?;
    let skin = camera.centre() + ray * first.first_hit(&ray)?;
    let seen = others.iter_mut().zip(&group.views[1..]).any(|(eye, view)| {
        let to = skin - view.camera.centre();
        view.camera.project(&skin).is_some() && eye.first_hit(&to.normalize()).is_none_or(|t| t > to.norm() - OCCLUDED_M)
    });
    seen.then_some(skin)
}

fn disparity(group: &Rectification, x: &Vector3<f64>) -> Option<f64> {
    let step = group.views[1].step;
    Some((group.project(1, x)? - group.project(0, x)?).dot(&step) / step.norm_squared())
}

fn clutter<'a>(
    figure: &Figure,
    group: &'a Rectification,
    count: usize,
    sigmas: [f64; 2],
    rng: &'a mut ChaCha8Rng,
) -> impl Iterator<Item = SightedPoint> + 'a {
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    for (centre, radius) in figure.bounds() {
        low = low.inf(&(centre - Vector3::repeat(radius + AROUND_M)));
        high = high.sup(&(centre + Vector3::repeat(radius + AROUND_M)));
    }
    (0..count).filter_map(move |_| {
        let share = Vector3::from_fn(|_, _| f64::from(rng.next_u32()) / 4_294_967_296.0);
        let x = low + share.component_mul(&(high - low));
        Some(measured(group, &group.project(0, &x)?, disparity(group, &x)?, sigmas))
    })
}

/// White noise averaged over windows, of unit variance.
struct Windowed {
    white: Vec<f32>,
    width: i64,
    corner: [i64; 2],
}

impl Windowed {
    fn new(columns: &Range<u32>, rows: &Range<u32>, rng: &mut ChaCha8Rng) -> Windowed {
        let size = |r: &Range<u32>| i64::from(r.end.saturating_sub(r.start)) + 2 * WINDOW;
        let count = (size(columns) * size(rows)) as usize;
        let white: Vec<f32> = (0..count.div_ceil(2)).flat_map(|_| gaussian_pair(rng)).map(|n| n as f32).collect();
        Windowed { white, width: size(columns), corner: [i64::from(columns.start) - WINDOW, i64::from(rows.start) - WINDOW] }
    }

    fn at(&self, x: u32, y: u32) -> f64 {
        let [x, y] = [i64::from(x) - self.corner[0], i64::from(y) - self.corner[1]];
        let row = |dy: i64| ((y + dy) * self.width + x - WINDOW) as usize;
        let sum: f32 = (-WINDOW..=WINDOW).map(|dy| self.white[row(dy)..][..(2 * WINDOW + 1) as usize].iter().sum::<f32>()).sum();
        f64::from(sum) / (2 * WINDOW + 1) as f64
    }
}

/// Mask of a figure in every camera of a rig, 0 or 255, in frame number `frame`.
pub fn masks(figure: &Figure, rig: &Rig, frame: usize, options: &SightOptions) -> Vec<GrayImage> {
    rig.cameras.iter().enumerate().map(|(k, camera)| mask(figure, camera, (k * 1_000_000 + frame) as f64, options)).collect()
}

fn mask(figure: &Figure, camera: &Camera, layer: f64, options: &SightOptions) -> GrayImage {
    let [width, height] = camera.size_px;
    let mut mask = GrayImage::new(width, height);
    let Some([columns, rows]) = bounding_box(figure, camera) else { return mask };
    let mut eye = figure.seen_from(&camera.centre());
    let mut inside = |x: u32, y: u32| {
        let at = Point2::new(f64::from(x), f64::from(y));
        let in_noise = Vector3::new(at.x / OUTLINE_CELL_PX, at.y / OUTLINE_CELL_PX, 1.7 * layer + 0.5);
        let shift = |k: u32| options.outline_px / NOISE_SIGMA * gradient_noise(&in_noise, options.seed as u32 ^ (k << 16));
        let moved = if options.outline_px > 0.0 { at + Vector2::new(shift(1), shift(2)) } else { at };
        camera.ray(&moved).is_some_and(|ray| eye.first_hit(&ray).is_some())
    };
    let corners = |r: &Range<u32>| (r.start / CORNERS_PX * CORNERS_PX..r.end + CORNERS_PX).step_by(CORNERS_PX as usize);
    let across: Vec<u32> = corners(&columns).collect();
    let mut above: Vec<bool> = across.iter().map(|x| inside(*x, rows.start / CORNERS_PX * CORNERS_PX)).collect();
    for y in corners(&rows) {
        let below: Vec<bool> = across.iter().map(|x| inside(*x, y + CORNERS_PX)).collect();
        for k in 1..across.len() {
            let known = [above[k - 1], above[k], below[k - 1], below[k]];
            let same = known.iter().all(|c| *c == known[0]);
            for (u, v) in (across[k - 1]..across[k]).flat_map(|u| (y..y + CORNERS_PX).map(move |v| (u, v))) {
                if u < width && v < height && if same { known[0] } else { inside(u, v) } {
                    mask.put_pixel(u, v, Luma([255]));
                }
            }
        }
        above = below;
    }
    mask
}

/// Columns and rows of the picture that hold the figure.
fn bounding_box(figure: &Figure, camera: &Camera) -> Option<[Range<u32>; 2]> {
    let boxes =
        figure.bounds().filter_map(|(centre, radius)| pixel_box(camera, &centre, radius)).filter(|b| b.iter().all(|r| !r.is_empty()));
    boxes.reduce(|a, b| std::array::from_fn(|k| a[k].start.min(b[k].start)..a[k].end.max(b[k].end)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Placement, PosedSurface, Shape, Surface, place};
    use crate::phantom::scene::tests::{lab_rig, stride};
    use crate::phantom::{distance_to_skin, silhouette};
    use crate::rig::rectify::groups;

    struct Before {
        rig: Rig,
        surface: Surface,
        offsets: [Vector3<f64>; crate::body::NODES],
        placement: Placement,
    }

    fn before() -> Before {
        let shape = Shape::template(1.72);
        let (surface, offsets) = (Surface::new(&shape), shape.offsets());
        Before { rig: lab_rig([640, 480]), surface, offsets, placement: place(&offsets, &stride(&shape, 0.7)) }
    }

    #[test]
    fn points_without_noise_are_on_the_skin_and_noise_is_as_stated() {
        let b = before();
        let figure = Figure::new(&b.surface, &b.offsets, &b.placement);
        let skin = PosedSurface::new(&b.surface, &b.placement);
        let group = &groups(&b.rig).unwrap()[0];
        let exact = SightOptions { disparity_px: 0.0, place_px: 0.0, outline_px: 0.0, ..SightOptions::default() };
        let clean = points(&figure, group, 3, &exact);
        assert!(clean.len() > 1000, "{}", clean.len());
        assert!(clean.iter().all(|(x, _)| distance_to_skin(&skin, x) < 5e-5));
        // The same pixels with noise along the rays only.
        let noisy = points(&figure, group, 3, &SightOptions { disparity_px: 0.3, ..exact });
        assert_eq!(noisy.len(), clean.len());
        let squares: f64 = clean
            .iter()
            .zip(&noisy)
            .map(|((x, _), (y, covariance))| {
                let ray = (y - group.views[0].camera.centre()).normalize();
                (y - x).dot(&ray).powi(2) / ray.dot(&(covariance * ray))
            })
            .sum();
        assert!((squares / clean.len() as f64 - 1.0).abs() < 0.15, "{}", squares / clean.len() as f64);
        let neighbours = |step: usize| -> f64 {
            let error = |i: usize| (noisy[i].0 - clean[i].0).dot(&(clean[i].0 - group.views[0].camera.centre()).normalize());
            let (mut product, mut square) = (0.0, 0.0);
            for i in 0..clean.len() - step {
                product += error(i) * error(i + step);
                square += error(i) * error(i);
            }
            product / square
        };
        // Windows of 5 px, points 3 px apart: 2 of 5 columns are shared, of the second neighbour none.
        assert!((neighbours(1) - 0.4).abs() < 0.12 && neighbours(2).abs() < 0.15, "{} {}", neighbours(1), neighbours(2));
        let strewn = points(&figure, group, 3, &SightOptions { clutter: 0.3, ..exact });
        let off = strewn.iter().filter(|(x, _)| distance_to_skin(&skin, x) > 0.02).count();
        assert!((off as f64 / strewn.len() as f64 - 0.28).abs() < 0.03, "{off} of {}", strewn.len());
    }

    #[test]
    fn masks_are_silhouettes_and_their_noise_stays_at_the_outline() {
        let b = before();
        let figure = Figure::new(&b.surface, &b.offsets, &b.placement);
        let clean = SightOptions { outline_px: 0.0, ..SightOptions::default() };
        let differ = |options: &SightOptions, camera: usize| {
            let full = silhouette(&b.surface, &b.offsets, &b.placement, &b.rig.cameras[camera]);
            let quick = &masks(&figure, &b.rig, 2, options)[camera];
            let different = full.iter().zip(quick.iter()).filter(|(a, b)| a != b).count();
            different as f64 / full.iter().filter(|p| **p > 0).count() as f64
        };
        assert!((0..3).all(|k| differ(&clean, k) < 0.002), "{:?}", [0, 1, 2].map(|k| differ(&clean, k)));
        let noisy = differ(&SightOptions { outline_px: 1.0, ..clean }, 1);
        assert!((0.01..0.08).contains(&noisy), "{noisy}");
    }
}

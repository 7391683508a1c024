//! Whether pictures fit the calibration: distances of matched corners from their epipolar curves.
//!
//! A corner x of one camera lies on the other's curve c(1/Z) = π₂(C₁ + Z r(x)), r the ray of x. Within a band of 20 px on
//! both sides of the curve the best normalised correlation of the corner's surroundings is sought, and from there back; a
//! match that returns to its corner counts, and its signed distance across the curve is the residual. A rig that fits
//! has residuals well under a pixel. Blind to errors along the curve (such as a wrong baseline length).
//!
//! Corners after Shi and Tomasi (1994), "Good features to track", one per cell of a grid. Fails on pictures without texture
//! (few matches) and for residuals beyond the band. Checked on rendered footage with cameras right and turned by hand.

use super::foreground::box_mean;
use crate::math::order::quantile;
use crate::rig::{Camera, Rig};
use image::GrayImage;
use nalgebra::{Point2, Vector2};
use rayon::prelude::*;

/// Corners are sought one per square cell; this many cells along the longer side, but none smaller than 10 px.
const CELLS: usize = 20;
/// Correlation windows have side 2 r + 1; smaller ones match by chance, larger ones see perspective.
const WINDOW_RADIUS_PX: i64 = 6;
const BAND_PX: i64 = 20;
/// Matches below this correlation are chance; noise of 2 grey levels on weak texture leaves 0.9.
const LOWEST_CORRELATION: f64 = 0.85;
/// First the band is sought at this step; texture finer than two of it would be missed.
const COARSE_PX: usize = 2;
/// What correlation a step aside leaves of a match.
const LOWEST_COARSE: f64 = 0.4;
/// How far the way back may end from the corner.
const RETURN_PX: f64 = 2.0;
/// The nearest depth searched, in baselines.
const NEAREST_BASELINES: f64 = 5.0;
/// Corners weaker than this share of the strongest are no corners.
const WEAKEST_CORNER: f32 = 0.01;

/// A corner of one picture found in another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    pub first_px: Point2<f64>,
    pub second_px: Point2<f64>,
    /// Unit normal of the epipolar curve in the second picture.
    pub normal: Vector2<f64>,
    /// Signed distance from the curve along the normal.
    pub distance_px: f64,
}

/// What two cameras have in common in sets of simultaneous pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct PairMatches {
    pub first: usize,
    pub second: usize,
    /// One list per set.
    pub sets: Vec<Vec<Match>>,
}

/// How two cameras fit together.
#[derive(Clone, Debug, PartialEq)]
pub struct PairResidual {
    pub first: usize,
    pub second: usize,
    /// Corners found in both pictures.
    pub matches: usize,
    /// Median distance from the epipolar curve; `None` without matches.
    pub median_px: Option<f64>,
}

impl From<&PairMatches> for PairResidual {
    fn from(pair: &PairMatches) -> PairResidual {
        let distances: Vec<f64> = pair.sets.iter().flatten().map(|m| m.distance_px.abs()).collect();
        PairResidual { first: pair.first, second: pair.second, matches: distances.len(), median_px: quantile(distances, 0.5) }
    }
}

/// Matches of every pair of cameras in sets of simultaneous pictures (one per camera). With `masks`, of the same form,
/// only corners inside the first camera's mask count.
pub fn pair_matches(rig: &Rig, sets: &[&[GrayImage]], masks: Option<&[Vec<GrayImage>]>) -> Vec<PairMatches> {
    let pair = |(first, second, baseline_m): (usize, usize, f64)| {
        let of_set = |(k, set): (usize, &&[GrayImage])| match (set.get(first), set.get(second)) {
            (Some(a), Some(b)) => {
                let mask = masks.and_then(|m| m.get(k)?.get(first));
                matches(&rig.cameras[first], &rig.cameras[second], [a, b], mask, NEAREST_BASELINES * baseline_m)
            }
            _ => Vec::new(),
        };
        PairMatches { first, second, sets: sets.iter().enumerate().map(of_set).collect() }
    };
    rig.baselines_m().into_iter().map(pair).collect()
}

/// Matches of one pair of pictures.
fn matches(from: &Camera, to: &Camera, images: [&GrayImage; 2], mask: Option<&GrayImage>, nearest_m: f64) -> Vec<Match> {
    let inside = |p: &(u32, u32)| mask.is_none_or(|m| m.get_pixel_checked(p.0, p.1).is_some_and(|v| v.0[0] > 0));
    let corners: Vec<_> = corners(images[0]).into_iter().filter(inside).collect();
    let found = |&(x, y): &(u32, u32)| {
        let corner = Point2::new(f64::from(x), f64::from(y));
        let there = best_match(from, to, images, corner, nearest_m)?;
        let back = best_match(to, from, [images[1], images[0]], there.second_px, nearest_m)?;
        ((back.second_px - corner).norm() <= RETURN_PX).then_some(there)
    };
    corners.par_iter().map(found).collect::<Vec<_>>().into_iter().flatten().collect()
}

/// The best place of a pixel's surroundings in the other picture: over every second pixel of the band, then around the best.
fn best_match(from: &Camera, to: &Camera, images: [&GrayImage; 2], pixel: Point2<f64>, nearest_m: f64) -> Option<Match> {
    let rounded = Point2::new(pixel.x.round(), pixel.y.round());
    let window = Window::at(images[0], rounded.x as i64, rounded.y as i64)?;
    let score = |x: i64, y: i64| Window::at(images[1], x, y).map_or(-1.0, |other| window.correlation(&other));
    let band = || (-BAND_PX..=BAND_PX).step_by(COARSE_PX);
    let (mut highest, mut best) = (LOWEST_COARSE, None);
    for (point, normal) in curve(from, to, &rounded, nearest_m)?.into_iter().step_by(COARSE_PX) {
        for at in band().map(|offset| point + normal * offset as f64) {
            let (x, y) = (at.x.round() as i64, at.y.round() as i64);
            let correlation = score(x, y);
            if correlation > highest {
                (highest, best) = (correlation, Some((x, y, point, normal)));
            }
        }
    }
    let (x, y, point, normal) = best?;
    let reach = COARSE_PX as i64;
    let around = (y - reach..=y + reach).flat_map(|y| (x - reach..=x + reach).map(move |x| (x, y)));
    let (x, y, top) = around.map(|(x, y)| (x, y, score(x, y))).max_by(|a, b| a.2.total_cmp(&b.2))?;
    let shift = |before: f64, after: f64| peak(before.max(0.0), top, after.max(0.0));
    let place = Point2::new(x as f64 + shift(score(x - 1, y), score(x + 1, y)), y as f64 + shift(score(x, y - 1), score(x, y + 1)));
    (top > LOWEST_CORRELATION).then(|| Match { first_px: pixel, second_px: place, normal, distance_px: (place - point).dot(&normal) })
}

/// Points 1 px apart along the epipolar curve of a pixel, each with the unit normal there.
fn curve(from: &Camera, to: &Camera, pixel: &Point2<f64>, nearest_m: f64) -> Option<Vec<(Point2<f64>, Vector2<f64>)>> {
    let (ray, centre) = (from.ray(pixel)?, from.centre());
    // Infinity is far enough at 1000 times the nearest depth.
    let at = |t: f64| to.project(&(centre + ray * (nearest_m / t.max(1e-3))));
    let steps = (at(1.0)? - at(0.0)?).norm().ceil().clamp(1.0, 1000.0);
    let sample = |k: usize| {
        let t = k as f64 / steps;
        let (before, after) = (at(t - 0.5 / steps)?, at(t + 0.5 / steps)?);
        let along = (after - before).try_normalize(1e-9)?;
        Some((at(t)?, Vector2::new(-along.y, along.x)))
    };
    Some((0..=steps as usize).filter_map(sample).collect())
}

/// Offset of the top of the parabola through three neighbours.
fn peak(before: f64, top: f64, after: f64) -> f64 {
    let bend = before - 2.0 * top + after;
    if bend < -1e-12 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 }
}

const WINDOW_PIXELS: usize = ((2 * WINDOW_RADIUS_PX + 1) * (2 * WINDOW_RADIUS_PX + 1)) as usize;

/// The surroundings of a pixel.
struct Window {
    pixels: [u8; WINDOW_PIXELS],
    sum: u32,
    squares: u32,
}

impl Window {
    /// `None` where the window leaves the picture.
    fn at(image: &GrayImage, x: i64, y: i64) -> Option<Window> {
        let (r, width, height) = (WINDOW_RADIUS_PX, i64::from(image.width()), i64::from(image.height()));
        if x < r || y < r || x + r >= width || y + r >= height {
            return None;
        }
        let side = (2 * r + 1) as usize;
        let mut pixels = [0; WINDOW_PIXELS];
        for (line, row) in pixels.chunks_exact_mut(side).zip(y - r..) {
            let start = (row * width + x - r) as usize;
            line.copy_from_slice(&image.as_raw()[start..start + side]);
        }
        let sum = pixels.iter().map(|&p| u32::from(p)).sum();
        let squares = pixels.iter().map(|&p| u32::from(p) * u32::from(p)).sum();
        Some(Window { pixels, sum, squares })
    }

    /// Normalised correlation, -1 to 1; 0 for windows without contrast.
    fn correlation(&self, other: &Window) -> f64 {
        let products: u32 = self.pixels.iter().zip(&other.pixels).map(|(&a, &b)| u32::from(a) * u32::from(b)).sum();
        let n = WINDOW_PIXELS as f64;
        let variance = |w: &Window| f64::from(w.squares) - f64::from(w.sum) * f64::from(w.sum) / n;
        let covariance = f64::from(products) - f64::from(self.sum) * f64::from(other.sum) / n;
        let scale = (variance(self) * variance(other)).sqrt();
        if scale > 1e-9 { covariance / scale } else { 0.0 }
    }
}

/// The strongest corner of every cell: largest smaller eigenvalue of the gradient products' mean over 5x5.
fn corners(image: &GrayImage) -> Vec<(u32, u32)> {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let pixel = |x: usize, y: usize| f32::from(image.as_raw()[y.min(height - 1) * width + x.min(width - 1)]);
    let gradient = |k: usize| {
        let (x, y) = (k % width, k / width);
        (pixel(x + 1, y) - pixel(x.saturating_sub(1), y), pixel(x, y + 1) - pixel(x, y.saturating_sub(1)))
    };
    let gradients: Vec<_> = (0..width * height).map(gradient).collect();
    let mean = |product: fn(&(f32, f32)) -> f32| box_mean(&gradients.iter().map(product).collect::<Vec<_>>(), width, 2);
    let (xx, yy, xy) = (mean(|g| g.0 * g.0), mean(|g| g.1 * g.1), mean(|g| g.0 * g.1));
    let strength = |k: usize| 0.5 * (xx[k] + yy[k]) - (0.25 * (xx[k] - yy[k]).powi(2) + xy[k] * xy[k]).sqrt();
    let cell = (width.max(height) / CELLS).max(10);
    let cells = (0..height / cell).flat_map(|row| (0..width / cell).map(move |column| (column * cell, row * cell)));
    let strongest = |(x0, y0): (usize, usize)| {
        let pixels = (y0..y0 + cell).flat_map(|y| (x0..x0 + cell).map(move |x| y * width + x));
        pixels.map(|k| (strength(k), k)).fold((0.0, y0 * width + x0), |best, next| if next.0 > best.0 { next } else { best })
    };
    let found: Vec<(f32, usize)> = cells.map(strongest).collect();
    let limit = WEAKEST_CORNER * found.iter().map(|c| c.0).fold(0.0, f32::max);
    found.into_iter().filter(|c| c.0 > limit).map(|(_, k)| ((k % width) as u32, (k / width) as u32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::Up;
    use nalgebra::{Matrix3, Rotation3, Vector3};

    fn residuals(rig: &Rig, images: &[GrayImage], masks: Option<&[Vec<GrayImage>]>) -> Vec<PairResidual> {
        pair_matches(rig, &[images], masks).iter().map(PairResidual::from).collect()
    }

    /// A textured wall at y = 3 m, seen by three cameras.
    fn wall() -> (Rig, Vec<GrayImage>) {
        let camera_from_world = Rotation3::from_scaled_axis(Vector3::x() * std::f64::consts::FRAC_PI_2);
        let camera = |name: &str, centre: Vector3<f64>| Camera {
            name: name.into(),
            size_px: [320, 240],
            matrix: Matrix3::new(280.0, 0.0, 160.0, 0.0, 280.0, 120.0, 0.0, 0.0, 1.0),
            lens: crate::rig::Lens::BrownConrady([-0.1, 0.02, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0]),
            camera_from_world,
            translation: -(camera_from_world * centre),
        };
        let cameras = vec![
            camera("cam_00", Vector3::zeros()),
            camera("cam_01", Vector3::new(0.3, 0.0, 0.0)),
            camera("cam_02", Vector3::new(0.0, 0.0, 0.3)),
        ];
        let texture = |x: f64, z: f64| {
            (1..9).map(f64::from).map(|k| (x * (5.0 + 7.3 * k) + 2.0 * k * k).sin() * (z * (31.0 - 2.9 * k) + k * k * k).cos()).sum::<f64>()
        };
        let see = |c: &Camera| {
            GrayImage::from_fn(320, 240, |u, v| {
                let ray = c.ray(&Point2::new(f64::from(u), f64::from(v))).unwrap();
                let at = c.centre() + ray * (3.0 / ray.y);
                image::Luma([(128.0 + 25.0 * texture(at.x, at.z)).clamp(0.0, 255.0) as u8])
            })
        };
        let images = cameras.iter().map(see).collect();
        (Rig { cameras, up: Up::Z }, images)
    }

    #[test]
    fn right_cameras_fit_and_a_turned_one_shows_its_error() {
        let (mut rig, images) = wall();
        for pair in residuals(&rig, &images, None) {
            assert!(pair.matches > 30 && pair.median_px.unwrap() < 0.15, "{pair:?}");
        }
        // Pitch moves the picture of camera 1 by 280 px tan(1 degree) = 4.9 px across its epipolar curves with camera 0.
        let pitch = Rotation3::from_scaled_axis(Vector3::x() * 1f64.to_radians());
        rig.cameras[1].camera_from_world = pitch * rig.cameras[1].camera_from_world;
        rig.cameras[1].translation = pitch * rig.cameras[1].translation;
        let found = residuals(&rig, &images, None);
        assert!((found[0].median_px.unwrap() - 4.9).abs() < 0.4, "{found:?}");
        assert!(found[1].median_px.unwrap() < 0.15 && found[2].median_px.unwrap() > 1.5, "{found:?}");
    }

    #[test]
    fn masks_restrict_the_corners_and_plain_pictures_have_none() {
        let (rig, images) = wall();
        let half: Vec<_> =
            images.iter().map(|i| GrayImage::from_fn(i.width(), i.height(), |x, _| image::Luma([if x < 160 { 255 } else { 0 }]))).collect();
        let all = residuals(&rig, &images, None)[0].matches;
        let some = residuals(&rig, &images, Some(&[half]))[0].matches;
        assert!(some > 10 && some < all * 2 / 3, "{some} of {all}");
        let plain = vec![GrayImage::from_pixel(320, 240, image::Luma([90])); 3];
        assert!(residuals(&rig, &plain, None).iter().all(|p| p.matches == 0 && p.median_px.is_none()));
    }

    #[test]
    fn corners_are_where_opencv_sees_them() {
        use opencv::core::{BORDER_REPLICATE, Mat};
        use opencv::prelude::*;
        let image = wall().1.remove(0);
        let mat = Mat::new_rows_cols_with_data(240, 320, image.as_raw()).unwrap();
        let mut strength = Mat::default();
        opencv::imgproc::corner_min_eigen_val(&mat, &mut strength, 5, 3, BORDER_REPLICATE).unwrap();
        let values = strength.data_typed::<f32>().unwrap();
        let mut sorted = values.to_vec();
        sorted.sort_by(f32::total_cmp);
        let strong = sorted[sorted.len() * 9 / 10];
        let corners = corners(&image);
        let agreeing = corners.iter().filter(|(x, y)| values[*y as usize * 320 + *x as usize] > strong).count();
        assert!(corners.len() > 60 && agreeing * 10 > corners.len() * 7, "{agreeing} of {}", corners.len());
    }
}

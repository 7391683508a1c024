//! The pixels of rectified pictures in the raw ones, and back.
//!
//! Checked with [`super`]: warped pictures show points where they belong.

use super::Rectification;
use image::GrayImage;
use nalgebra::{Point2, Vector2};
use rayon::prelude::*;

/// Raw pixel of every rectified pixel of a view; NaN where its camera sees nothing.
pub fn warp_map(rectification: &Rectification, view: usize) -> Vec<[f32; 2]> {
    let [width, height] = rectification.size_px;
    let [w, h] = rectification.views[view].camera.size_px.map(|s| f64::from(s) - 1.0);
    let pixels = (0..height).into_par_iter().flat_map_iter(|v| (0..width).map(move |u| Vector2::new(f64::from(u), f64::from(v))));
    let back_map = &rectification.views[view].back_map;
    let raw = |p: Vector2<f64>| {
        let raw = rectification.raw_pixel(view, &p)?;
        if !(raw.x >= -0.5 && raw.y >= -0.5 && raw.x < w + 0.5 && raw.y < h + 0.5) {
            return None;
        }
        // Far outside the image the distortion may fold back into it; there the way back leads elsewhere.
        let [x, y] = *back_map.get(raw.y.round() as usize * (w as usize + 1) + raw.x.round() as usize)?;
        ((p - Vector2::new(x.into(), y.into())).norm() < 3.0).then_some([raw.x as f32, raw.y as f32])
    };
    pixels.map(|p| raw(p).unwrap_or([f32::NAN; 2])).collect()
}

/// Rectified pixel of every raw pixel of a view; NaN where the distortion has no inverse.
pub fn back_map(rectification: &Rectification, view: usize) -> Vec<[f32; 2]> {
    let [width, height] = rectification.views[view].camera.size_px;
    let pixels = (0..height).into_par_iter().flat_map_iter(|v| (0..width).map(move |u| Point2::new(f64::from(u), f64::from(v))));
    pixels.map(|raw| rectification.rectified_pixel(view, &raw).map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32])).collect()
}

/// Catmull-Rom interpolation at the places of a row, with replicated borders; NaN at NaN.
pub fn bicubic_row(image: &GrayImage, places: &[[f32; 2]], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { bicubic_row_avx2(image, places, out) };
    }
    bicubic_row_plain(image, places, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn bicubic_row_avx2(image: &GrayImage, places: &[[f32; 2]], out: &mut [f32]) {
    bicubic_row_plain(image, places, out);
}

#[inline(always)]
fn bicubic_row_plain(image: &GrayImage, places: &[[f32; 2]], out: &mut [f32]) {
    for (out, [x, y]) in out.iter_mut().zip(places) {
        *out = if x.is_nan() { f32::NAN } else { bicubic(image, *x, *y) };
    }
}

#[inline(always)]
fn bicubic(image: &GrayImage, x: f32, y: f32) -> f32 {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let (x0, y0) = (x.floor(), y.floor());
    let (left, top) = (x0 as isize - 1, y0 as isize - 1);
    let inside = left >= 0 && top >= 0 && left + 4 <= width as isize && top + 4 <= height as isize;
    let mut sums = [0.0; 4];
    for (j, weight) in catmull_rom(y - y0).into_iter().enumerate() {
        let taps = match inside {
            true => *image.as_raw()[(top as usize + j) * width + left as usize..].first_chunk::<4>().unwrap_or(&[0; 4]),
            false => border_row(image, left, top + j as isize),
        };
        for (sum, tap) in sums.iter_mut().zip(taps) {
            *sum += weight * f32::from(tap);
        }
    }
    let weights = catmull_rom(x - x0);
    (weights[0] * sums[0] + weights[1] * sums[1]) + (weights[2] * sums[2] + weights[3] * sums[3])
}

/// Four pixels from (x, y) on, each the nearest one in the picture.
#[cold]
fn border_row(image: &GrayImage, x: isize, y: isize) -> [u8; 4] {
    let nearest = |at: isize, size: u32| at.clamp(0, size as isize - 1) as u32;
    std::array::from_fn(|i| image.get_pixel(nearest(x + i as isize, image.width()), nearest(y, image.height())).0[0])
}

#[inline(always)]
fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

/// Bilinear interpolation; 0 outside and at NaN.
#[inline]
pub fn bilinear(image: &GrayImage, x: f32, y: f32) -> f32 {
    let (width, height) = (image.width() as f32, image.height() as f32);
    if !(x >= 0.0 && y >= 0.0 && x <= width - 1.0 && y <= height - 1.0) {
        return 0.0;
    }
    let (x0, y0) = (x as u32, y as u32);
    let (tx, ty) = (x - x0 as f32, y - y0 as f32);
    let at = |i: u32, j: u32| f32::from(image.get_pixel((x0 + i).min(image.width() - 1), (y0 + j).min(image.height() - 1)).0[0]);
    (1.0 - ty) * ((1.0 - tx) * at(0, 0) + tx * at(1, 0)) + ty * ((1.0 - tx) * at(0, 1) + tx * at(1, 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;

    #[test]
    fn bicubic_rows_meet_the_definition_up_to_the_border() {
        let image = GrayImage::from_fn(23, 17, |x, y| Luma([((x * 7919 + y * 104_729) % 251) as u8]));
        let places: Vec<[f32; 2]> =
            (0..400).map(|i| [-0.5 + 23.0 * (i % 20) as f32 / 19.7, -0.5 + 17.0 * (i / 20) as f32 / 19.7]).collect();
        let mut found = vec![0.0; places.len()];
        bicubic_row(&image, &places, &mut found);
        // Keys' kernel with a = -1/2.
        let kernel = |t: f64| match t.abs() {
            t if t < 1.0 => 1.5 * t * t * t - 2.5 * t * t + 1.0,
            t if t < 2.0 => -0.5 * t * t * t + 2.5 * t * t - 4.0 * t + 2.0,
            _ => 0.0,
        };
        for ([x, y], found) in places.into_iter().zip(found) {
            let mut expected = 0.0;
            for v in -4..=21 {
                for u in -4..=27 {
                    let value = image.get_pixel(u.clamp(0, 22) as u32, v.clamp(0, 16) as u32).0[0];
                    expected += kernel(f64::from(x) - f64::from(u)) * kernel(f64::from(y) - f64::from(v)) * f64::from(value);
                }
            }
            assert!((f64::from(found) - expected).abs() < 1e-3, "({x}, {y}): {found} {expected}");
        }
    }
}

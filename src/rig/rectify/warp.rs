//! The pixels of rectified pictures in the raw ones, and back.
//!
//! Checked with [`super`]: warped pictures show points where they belong, and the way back is the lens's own inverse.

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

/// Every so many pixels an ordinary lens is inverted; a straight line between them is at most 0.01 px off where it moves a corner by a tenth.
const NODE_PX: usize = 4;

/// Rectified pixel of every raw pixel of a view; NaN where the distortion has no inverse.
pub fn back_map(rectification: &Rectification, view: usize) -> Vec<[f32; 2]> {
    let [width, height] = rectification.views[view].camera.size_px.map(|s| s as usize);
    let exact = |x: usize, y: usize| rectification.rectified_pixel(view, &Point2::new(x as f64, y as f64));
    // Towards 90 degrees a plane has no straight lines.
    let step = if rectification.views[view].camera.lens.is_fisheye() { 1 } else { NODE_PX };
    let columns = width.div_ceil(step) + 1;
    let nodes = (0..(height.div_ceil(step) + 1) * columns).into_par_iter().map(|k| exact(k % columns * step, k / columns * step));
    let nodes: Vec<Option<Vector2<f64>>> = nodes.collect();
    let between = |x: usize, y: usize| {
        let first = y / step * columns + x / step;
        let [across, down] = [x % step, y % step].map(|k| k as f64 / step as f64);
        let row = |k: usize| Some(nodes[k]?.lerp(&nodes[k + 1]?, across));
        Some(row(first)?.lerp(&row(first + columns)?, down))
    };
    let pixels = (0..height).into_par_iter().flat_map_iter(|y| (0..width).map(move |x| (x, y)));
    pixels.map(|(x, y)| between(x, y).or_else(|| exact(x, y)).map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32])).collect()
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
    let (eights, rest) = places.as_chunks();
    let (out_eights, out_rest) = out.as_chunks_mut();
    for (places, out) in eights.iter().zip(out_eights) {
        match bicubic_eight(image, places) {
            Some(values) => *out = values,
            None => bicubic_row_plain(image, places, out),
        }
    }
    bicubic_row_plain(image, rest, out_rest);
}

/// [`bicubic`] at eight places with the same bits; `None` unless all their pixels are in the picture.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn bicubic_eight(image: &GrayImage, places: &[[f32; 2]; 8]) -> Option<[f32; 8]> {
    use std::arch::x86_64::*;
    let (width, height) = (image.width() as f32, image.height() as f32);
    let [near, far] = [0, 8].map(|from| {
        // SAFETY: `places` holds 16 numbers, of which 8 are read from the first or the ninth on.
        unsafe { _mm256_loadu_ps(places.as_flattened().as_ptr().add(from)) }
    });
    let in_order = |v: __m256| _mm256_castpd_ps(_mm256_permute4x64_pd::<0xd8>(_mm256_castps_pd(v)));
    let [x, y] = [in_order(_mm256_shuffle_ps::<0x88>(near, far)), in_order(_mm256_shuffle_ps::<0xdd>(near, far))];
    let [x0, y0] = [_mm256_floor_ps(x), _mm256_floor_ps(y)];
    let within = |v: __m256, size: f32| {
        let [low, high] = [_mm256_cmp_ps::<_CMP_GE_OQ>(v, _mm256_set1_ps(1.0)), _mm256_cmp_ps::<_CMP_LE_OQ>(v, _mm256_set1_ps(size - 3.0))];
        _mm256_and_ps(low, high)
    };
    if _mm256_movemask_ps(_mm256_and_ps(within(x0, width), within(y0, height))) != 0xff || image.len() > i32::MAX as usize {
        return None;
    }
    let one = _mm256_set1_epi32(1);
    let [left, top] = [x0, y0].map(|v| _mm256_sub_epi32(_mm256_cvttps_epi32(v), one));
    let stride = _mm256_set1_epi32(image.width() as i32);
    let mut first = _mm256_add_epi32(_mm256_mullo_epi32(top, stride), left);
    let mut sums = [_mm256_setzero_ps(); 4];
    for weight in catmull_rom_eight(_mm256_sub_ps(y, y0)) {
        // SAFETY: left, top >= 0 and left + 4, top + 4 are within the picture, whose rows follow each other.
        let taps = unsafe { _mm256_i32gather_epi32::<1>(image.as_raw().as_ptr().cast(), first) };
        let byte = _mm256_set1_epi32(0xff);
        let taps = [
            _mm256_and_si256(taps, byte),
            _mm256_and_si256(_mm256_srli_epi32::<8>(taps), byte),
            _mm256_and_si256(_mm256_srli_epi32::<16>(taps), byte),
            _mm256_srli_epi32::<24>(taps),
        ];
        for (sum, tap) in sums.iter_mut().zip(taps) {
            *sum = _mm256_add_ps(*sum, _mm256_mul_ps(weight, _mm256_cvtepi32_ps(tap)));
        }
        first = _mm256_add_epi32(first, stride);
    }
    let weights = catmull_rom_eight(_mm256_sub_ps(x, x0));
    let [a, b, c, d] = std::array::from_fn(|i| _mm256_mul_ps(weights[i], sums[i]));
    let mut values = [0.0; 8];
    // SAFETY: `values` holds 8 numbers.
    unsafe { _mm256_storeu_ps(values.as_mut_ptr(), _mm256_add_ps(_mm256_add_ps(a, b), _mm256_add_ps(c, d))) };
    Some(values)
}

/// [`catmull_rom`] of eight.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn catmull_rom_eight(t: std::arch::x86_64::__m256) -> [std::arch::x86_64::__m256; 4] {
    use std::arch::x86_64::*;
    let times = |factor: f32, v: __m256| _mm256_mul_ps(_mm256_set1_ps(factor), v);
    let t2 = _mm256_mul_ps(t, t);
    let t3 = _mm256_mul_ps(t, t2);
    [
        times(0.5, _mm256_sub_ps(_mm256_add_ps(times(-1.0, t3), times(2.0, t2)), t)),
        times(0.5, _mm256_add_ps(_mm256_sub_ps(times(3.0, t3), times(5.0, t2)), _mm256_set1_ps(2.0))),
        times(0.5, _mm256_add_ps(_mm256_add_ps(times(-3.0, t3), times(4.0, t2)), t)),
        times(0.5, _mm256_sub_ps(t3, t2)),
    ]
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
    fn many_pixels_at_once_have_the_bits_of_one() {
        let image = GrayImage::from_fn(61, 43, |x, y| Luma([((x * 7919 + y * 104_729) % 251) as u8]));
        let place = |i: usize| match i % 97 {
            0 => [f32::NAN; 2],
            _ => [-2.0 + 65.0 * (0.37 * i as f32).fract(), -2.0 + 47.0 * (0.113 * i as f32).fract()],
        };
        let places: Vec<[f32; 2]> = (0..2003).map(place).chain([[1.0, 1.0]; 8]).chain([[58.0, 40.0]; 8]).collect();
        let (mut many, mut single) = (vec![0.0; places.len()], vec![0.0; places.len()]);
        bicubic_row(&image, &places, &mut many);
        bicubic_row_plain(&image, &places, &mut single);
        assert!(many.iter().zip(&single).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert!(many.iter().filter(|v| v.is_nan()).count() < 30);
    }

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

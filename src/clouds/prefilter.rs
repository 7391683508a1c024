//! Gradient along the baseline before correlation.
//!
//!   G = 128 + clip(∂I/∂b, ±c),   ∂/∂b = (b_x D_x + b_y D_y) / |b|,                                  (1)
//! with Sobel's D_x = [−1 0 1]ᵀ[1 2 1] and D_y its transpose. An offset between cameras vanishes, a gain changes the weak
//! gradients little and the clipped ones not at all. Only intensity changes along the baseline tell a disparity, so each
//! pair of views has its own direction.
//!
//! OpenCV's StereoBM and StereoSGBM use D_x too. Checked against cv::Sobel; alternatives are in [`super::correlate`]'s table.

use crate::rig::rectify::Plane;
use image::GrayImage;
use nalgebra::Vector2;
use rayon::prelude::*;

/// c of (1), grey levels times 4 per pixel: smaller drowns edges in noise, larger lets one strong edge outvote its window.
const CAP: f32 = 31.0;

/// Adding 1.5 2^23 rounds a number to the last bit of its mantissa, whose low byte is then the integer; that of NaN is 0. Much
/// faster than a conversion that has to think of NaN.
const ROUND_TO_128: f32 = 12_582_912.0 + 128.0;

/// The picture of equation (1), 97 to 159; 0 where a pixel or a neighbour is NaN. Borders are replicated.
pub fn gradient(plane: &Plane, along: Vector2<f64>) -> GrayImage {
    let (width, height) = (plane.width() as usize, plane.height() as usize);
    let along = along.normalize().map(|v| v as f32);
    let mut values = vec![0u8; width * height];
    let row = |y: usize| &plane.as_raw()[y.min(height - 1) * width..][..width];
    values.par_chunks_exact_mut(width.max(1)).enumerate().for_each(|(y, out)| {
        gradient_row([row(y.saturating_sub(1)), row(y), row(y + 1)], [along.x, along.y], out);
    });
    GrayImage::from_raw(plane.width(), plane.height(), values).expect("one value per pixel")
}

fn gradient_row(rows: [&[f32]; 3], along: [f32; 2], out: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { gradient_row_avx2(rows, along, out) };
    }
    gradient_row_plain(rows, along, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn gradient_row_avx2(rows: [&[f32]; 3], along: [f32; 2], out: &mut [u8]) {
    gradient_row_plain(rows, along, out);
}

/// Equation (1) of the middle row.
#[inline(always)]
fn gradient_row_plain(rows: [&[f32]; 3], [right, down]: [f32; 2], out: &mut [u8]) {
    let (width, code) = (out.len(), |slope: f32| (ROUND_TO_128 + slope.clamp(-CAP, CAP)).to_bits() as u8);
    let Some(inner) = width.checked_sub(2) else { return out.fill(code(0.0)) };
    let [[a, b, c], [d, _, f], [g, h, i]] = rows.map(|row| [&row[..inner], &row[1..=inner], &row[2..width]]);
    for (x, out) in out[1..=inner].iter_mut().enumerate() {
        let across = (c[x] - a[x]) + 2.0 * (f[x] - d[x]) + (i[x] - g[x]);
        let along = (g[x] - a[x]) + 2.0 * (h[x] - b[x]) + (i[x] - c[x]);
        *out = code(right * across + down * along);
    }
    let [above, here, below] = rows;
    for (x, from, to) in [(0, 0, 1), (width - 1, width - 2, width - 1)] {
        let across = (above[to] - above[from]) + 2.0 * (here[to] - here[from]) + (below[to] - below[from]);
        let along = (below[from] - above[from]) + 2.0 * (below[x] - above[x]) + (below[to] - above[to]);
        out[x] = code(right * across + down * along);
    }
}

/// Gaussian blur with replicated borders.
pub(crate) fn blur(values: &[f32], width: usize, sigma_px: f32) -> Vec<f32> {
    let kernel = gaussian(sigma_px);
    let (radius, height) = (kernel.len() / 2, values.len() / width.max(1));
    let mut blurred = vec![0.0; values.len()];
    let scratch = || (Vec::with_capacity(kernel.len()), vec![0.0; width + 2 * radius]);
    blurred.par_chunks_exact_mut(width.max(1)).enumerate().for_each_init(scratch, |(lines, padded), (y, out)| {
        lines.clear();
        lines.extend((y..y + kernel.len()).map(|y| &values[y.saturating_sub(radius).min(height - 1) * width..][..width]));
        weighted_sum(lines, &kernel, &mut padded[radius..][..width]);
        let [first, last] = [padded[radius], padded[radius + width - 1]];
        padded[..radius].fill(first);
        padded[radius + width..].fill(last);
        let shifted: Vec<&[f32]> = (0..kernel.len()).map(|k| &padded[k..][..width]).collect();
        weighted_sum(&shifted, &kernel, out);
    });
    blurred
}

fn weighted_sum(lines: &[&[f32]], weights: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { weighted_sum_avx2(lines, weights, out) };
    }
    weighted_sum_plain(lines, weights, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn weighted_sum_avx2(lines: &[&[f32]], weights: &[f32], out: &mut [f32]) {
    weighted_sum_plain(lines, weights, out);
}

/// Values that are summed together, in registers.
const BLOCK: usize = 32;

#[inline(always)]
fn weighted_sum_plain(lines: &[&[f32]], weights: &[f32], out: &mut [f32]) {
    let (blocks, rest) = out.as_chunks_mut::<BLOCK>();
    for (k, out) in blocks.iter_mut().enumerate() {
        let mut sums = [0.0; BLOCK];
        for (line, weight) in lines.iter().zip(weights) {
            if let Some(values) = line[k * BLOCK..].first_chunk::<BLOCK>() {
                for (sum, value) in sums.iter_mut().zip(values) {
                    *sum += weight * value;
                }
            }
        }
        *out = sums;
    }
    let done = blocks.len() * BLOCK;
    for (x, out) in (done..).zip(rest) {
        *out = lines.iter().zip(weights).map(|(line, weight)| weight * line[x]).sum();
    }
}

fn gaussian(sigma_px: f32) -> Vec<f32> {
    let radius = (3.0 * sigma_px).ceil() as i32;
    let weights: Vec<f32> = (-radius..=radius).map(|k| (-0.5 * (k as f32 / sigma_px).powi(2)).exp()).collect();
    let sum: f32 = weights.iter().sum();
    weights.into_iter().map(|w| w / sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_meet_opencv() {
        use opencv::{core, imgproc, prelude::*};
        let values: Vec<f32> = (0..50 * 40).map(|i| ((i * 7919) % 13) as f32).collect();
        let plane = Plane::from_raw(50, 40, values.clone()).unwrap();
        let source = core::Mat::new_rows_cols_with_data(40, 50, &values).unwrap();
        for (along, dx) in [(Vector2::new(-1.0, 0.0), 1), (Vector2::new(0.0, 2.0), 0)] {
            let mut expected = core::Mat::default();
            imgproc::sobel(&source, &mut expected, core::CV_32F, dx, 1 - dx, 3, 1.0, 0.0, core::BORDER_REPLICATE).unwrap();
            let sign = if dx == 1 { -1.0 } else { 1.0 };
            for (ours, theirs) in gradient(&plane, along).iter().zip(expected.data_typed::<f32>().unwrap()) {
                assert_eq!(f32::from(*ours), 128.0 + (sign * theirs).clamp(-CAP, CAP), "{along:?}");
            }
        }
    }

    #[test]
    fn diagonal_gradient_is_the_mean_of_both() {
        let plane = Plane::from_fn(9, 9, |x, y| image::Luma([2.0 * x as f32 + 0.5 * y as f32]));
        let diagonal = gradient(&plane, Vector2::new(1.0, 1.0));
        assert_eq!(diagonal.get_pixel(4, 4).0[0], (128.0 + 8.0 * 2.5 / 2f32.sqrt()).round() as u8);
    }

    #[test]
    fn blur_meets_opencv() {
        use opencv::{core, imgproc, prelude::*};
        let values: Vec<f32> = (0..50 * 40).map(|i| ((i * 7919) % 251) as f32).collect();
        let source = core::Mat::new_rows_cols_with_data(40, 50, &values).unwrap();
        let mut expected = core::Mat::default();
        imgproc::gaussian_blur(&source, &mut expected, core::Size::new(13, 13), 2.0, 2.0, core::BORDER_REPLICATE).unwrap();
        for (ours, theirs) in blur(&values, 50, 2.0).iter().zip(expected.data_typed::<f32>().unwrap()) {
            assert!((ours - theirs).abs() < 1e-3, "{ours} {theirs}");
        }
    }

    #[test]
    fn unknown_stays_unknown() {
        let plane = Plane::from_fn(30, 20, |x, y| image::Luma([if x < 5 { f32::NAN } else { (x * y) as f32 }]));
        let unknown = |v: u8| v == 0;
        assert!(gradient(&plane, Vector2::new(1.0, 0.0)).enumerate_pixels().all(|(x, _, p)| unknown(p.0[0]) == (x < 6)));
    }
}

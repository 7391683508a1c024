//! Local mean and contrast normalisation before correlation.
//!
//!   g = (I − m) / (s + s0),   m = G_σ * I,   s² = G_σ * (I − m)²,                                    (1)
//! stored in 8 bits as 128 + 40 g. Gain and offset between cameras vanish, weak texture weighs as much as strong, and the
//! floor s0 keeps sensor noise from being taken for texture.
//!
//! Departure from OpenCV's NORMALIZED_RESPONSE: a Gaussian instead of a box, which rings less at the person's outline.

use crate::rig::rectify::Plane;
use image::GrayImage;
use rayon::prelude::*;

/// Wider lets the outline's contrast change the values of pixels further inside; narrower removes the texture itself.
const SIGMA_PX: f32 = 1.5;

/// About twice the noise of an 8-bit camera, grey levels. Smaller amplifies noise on bare walls, larger forgets weak texture.
const CONTRAST_FLOOR: f32 = 5.0;

/// Grey steps per unit of g: 3 standard deviations fill the 8 bits.
const GAIN: f32 = 40.0;

/// The normalised picture of equation (1), 1 to 255; 0 where the plane is NaN.
pub fn normalise(plane: &Plane) -> GrayImage {
    let (width, height) = plane.dimensions();
    let filled = fill_unknown(plane);
    let mean = blur(&filled, width as usize, SIGMA_PX);
    let centred: Vec<f32> = filled.par_iter().zip(&mean).map(|(i, m)| i - m).collect();
    let squares: Vec<f32> = centred.par_iter().map(|c| c * c).collect();
    let variance = blur(&squares, width as usize, SIGMA_PX);
    let value = |((c, v), raw): ((&f32, &f32), &f32)| {
        if raw.is_nan() { 0 } else { (128.0 + GAIN * c / (v.max(0.0).sqrt() + CONTRAST_FLOOR)).round().clamp(1.0, 255.0) as u8 }
    };
    let values = centred.par_iter().zip(&variance).zip(plane.as_raw()).map(value).collect();
    GrayImage::from_raw(width, height, values).expect("one value per pixel")
}

/// Unknown pixels take the last known value of their row, so that the filter rings little at the border.
fn fill_unknown(plane: &Plane) -> Vec<f32> {
    let mut values = plane.as_raw().clone();
    for row in values.chunks_exact_mut(plane.width().max(1) as usize) {
        let mut last = row.iter().copied().find(|v| !v.is_nan()).unwrap_or(128.0);
        for v in row {
            if v.is_nan() { *v = last } else { last = *v }
        }
    }
    values
}

/// Gaussian blur with replicated borders.
pub(crate) fn blur(values: &[f32], width: usize, sigma_px: f32) -> Vec<f32> {
    if values.is_empty() {
        return Vec::new();
    }
    let kernel = gaussian(sigma_px);
    let (radius, height) = (kernel.len() / 2, values.len() / width);
    let mut across = vec![0.0; values.len()];
    across.par_chunks_exact_mut(width).zip(values.par_chunks_exact(width)).for_each(|(out, row)| {
        let mut padded = vec![row[0]; radius];
        padded.extend_from_slice(row);
        padded.extend(std::iter::repeat_n(row[width - 1], radius));
        for (k, weight) in kernel.iter().enumerate() {
            out.iter_mut().zip(&padded[k..]).for_each(|(o, v)| *o += weight * v);
        }
    });
    let mut both = vec![0.0; values.len()];
    both.par_chunks_exact_mut(width).enumerate().for_each(|(y, out)| {
        for (k, weight) in kernel.iter().enumerate() {
            let from = (y + k).saturating_sub(radius).min(height - 1);
            out.iter_mut().zip(&across[from * width..]).for_each(|(o, v)| *o += weight * v);
        }
    });
    both
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
    fn gain_and_offset_vanish_where_there_is_texture() {
        let texture = |x: u32, y: u32| 90.0 * ((x * x + 3 * y * x + 7 * y) as f32 * 0.37).sin();
        let a = Plane::from_fn(80, 60, |x, y| image::Luma([100.0 + texture(x, y)]));
        let b = Plane::from_fn(80, 60, |x, y| image::Luma([90.0 + 0.9 * texture(x, y)]));
        let (fa, fb) = (normalise(&a), normalise(&b));
        let difference = fa.as_raw().iter().zip(fb.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / 4800.0;
        let contrast = fa.as_raw().iter().map(|a| f64::from(a.abs_diff(128))).sum::<f64>() / 4800.0;
        assert!(difference < 0.6 && contrast > 20.0, "difference {difference}, contrast {contrast}");
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
        let f = normalise(&plane);
        assert!(f.enumerate_pixels().all(|(x, _, p)| (p.0[0] == 0) == (x < 5)));
    }
}

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

/// Catmull-Rom interpolation with replicated borders; NaN at NaN.
pub fn bicubic(image: &GrayImage, x: f32, y: f32) -> f32 {
    if x.is_nan() {
        return f32::NAN;
    }
    let (x0, y0) = (x.floor(), y.floor());
    let (wx, wy) = (catmull_rom(x - x0), catmull_rom(y - y0));
    let (width, height) = (image.width() as i32, image.height() as i32);
    let data = image.as_raw();
    let mut sum = 0.0;
    for (j, wy) in wy.iter().enumerate() {
        let row = (y0 as i32 + j as i32 - 1).clamp(0, height - 1) * width;
        for (i, wx) in wx.iter().enumerate() {
            let column = (x0 as i32 + i as i32 - 1).clamp(0, width - 1);
            sum += wy * wx * f32::from(data[(row + column) as usize]);
        }
    }
    sum
}

fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

/// Bilinear interpolation; 0 outside and at NaN.
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

//! Which matches to believe.
//!
//! - uniqueness: no rival more than one disparity away costs less than (1 + u) times the winner;
//! - texture: the window's contrast along some baseline stands above noise;
//! - consistency: the pixel that another view's own search finds there leads back (left-right, top-bottom). One confirming
//!   view is enough, because near an outline the other view is often occluded;
//! - speckle: connected pieces of slowly changing disparity smaller than an area are dropped (cv::filterSpeckles).

use super::correlate::{Matches, NO_MATCH};
use super::subpixel::equiangular;
use crate::rig::rectify::Plane;
use image::Luma;
use nalgebra::Vector2;

/// Sub-pixel disparities of the unique winners on the whole canvas; NaN elsewhere.
pub fn unique(matches: &Matches, size_px: [u32; 2], ratio: f32) -> Plane {
    let mut plane = Plane::from_pixel(size_px[0], size_px[1], Luma([f32::NAN]));
    let region = matches.region;
    for (i, (&best, &cost)) in matches.best.iter().zip(&matches.cost).enumerate() {
        let alone = f32::from(matches.rival[i]) > f32::from(cost[1]) * (1.0 + ratio);
        if let (true, true, Some(offset)) = (best != NO_MATCH, alone, equiangular(cost)) {
            let (x, y) = (region.x[0] + i % region.width(), region.y[0] + i / region.width());
            plane.put_pixel(x as u32, y as u32, Luma([f32::from(best) + offset]));
        }
    }
    plane
}

/// Keeps disparities that at least one other view confirms within `tolerance_px`. `others` are the other views' own
/// disparities with their steps against this view's. Returns the plane and for each pixel the bits of the confirming views.
pub fn consistent(disparity: &Plane, others: &[(&Plane, Vector2<f64>)], tolerance_px: f32) -> (Plane, Vec<u8>) {
    let width = disparity.width();
    let mut kept = disparity.clone();
    let mut confirmed = vec![0u8; kept.as_raw().len()];
    for (i, value) in kept.iter_mut().enumerate() {
        let at = Vector2::new(f64::from(i as u32 % width), f64::from(i as u32 / width));
        for (k, (other, step)) in others.iter().enumerate() {
            let there = at + step * f64::from(*value);
            confirmed[i] |= u8::from(agrees(other, there, *value, tolerance_px)) << k;
        }
        if confirmed[i] == 0 {
            *value = f32::NAN;
        }
    }
    (kept, confirmed)
}

/// Whether one of the four pixels around `at` has the disparity.
fn agrees(other: &Plane, at: Vector2<f64>, disparity: f32, tolerance_px: f32) -> bool {
    let inside = |x: f64, y: f64| x >= 0.0 && y >= 0.0 && x < f64::from(other.width()) && y < f64::from(other.height());
    let near = |x: f64, y: f64| inside(x, y) && (other.get_pixel(x as u32, y as u32).0[0] - disparity).abs() <= tolerance_px;
    let (x, y) = (at.x.floor(), at.y.floor());
    near(x, y) || near(x + 1.0, y) || near(x, y + 1.0) || near(x + 1.0, y + 1.0)
}

/// Removes connected pieces of fewer than `area_px` pixels; neighbours belong together when they differ by at most `step_px`.
pub fn remove_speckles(disparity: &mut Plane, area_px: usize, step_px: f32) {
    let (width, height) = (disparity.width() as usize, disparity.height() as usize);
    let mut seen = vec![false; width * height];
    let mut piece = Vec::new();
    for start in 0..width * height {
        if seen[start] || disparity.as_raw()[start].is_nan() {
            continue;
        }
        seen[start] = true;
        piece.clear();
        piece.push(start);
        let mut next = 0;
        while let Some(&i) = piece.get(next) {
            next += 1;
            let (x, value) = (i % width, disparity.as_raw()[i]);
            let neighbours = [
                (x > 0).then(|| i - 1),
                (x + 1 < width).then_some(i + 1),
                i.checked_sub(width),
                (i + width < width * height).then_some(i + width),
            ];
            for j in neighbours.into_iter().flatten() {
                if !seen[j] && (disparity.as_raw()[j] - value).abs() <= step_px {
                    seen[j] = true;
                    piece.push(j);
                }
            }
        }
        if piece.len() < area_px {
            let values: &mut [f32] = disparity;
            piece.iter().for_each(|&i| values[i] = f32::NAN);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speckle_filter_meets_opencv() {
        use opencv::{calib3d, core, prelude::*};
        let field = |x: usize, y: usize| 16 * (5 + (x / 9 + y / 5) % 3 * 4) as i16 + ((x * 31 + y * 17) % 7) as i16;
        let values: Vec<i16> = (0..60 * 80).map(|i| if (i * 7919) % 11 < 3 { -16 } else { field(i % 80, i / 80) }).collect();
        let mut theirs = core::Mat::new_rows_cols_with_data(60, 80, &values).unwrap().try_clone().unwrap();
        calib3d::filter_speckles(&mut theirs, -16.0, 25, 16.0, &mut core::no_array()).unwrap();
        let known = |v: i16| if v == -16 { f32::NAN } else { f32::from(v) / 16.0 };
        let mut ours = Plane::from_raw(80, 60, values.iter().map(|&v| known(v)).collect()).unwrap();
        remove_speckles(&mut ours, 26, 1.0);
        let theirs: Vec<bool> = theirs.data_typed::<i16>().unwrap().iter().map(|&v| v == -16).collect();
        let ours: Vec<bool> = ours.as_raw().iter().map(|v| v.is_nan()).collect();
        assert_eq!(ours, theirs);
        assert!(theirs.iter().filter(|&&gone| gone).count() > values.iter().filter(|&&v| v == -16).count() + 50);
    }

    #[test]
    fn only_confirmed_disparities_stay() {
        let value = |d: f32| Luma([d]);
        let mut here = Plane::from_pixel(20, 1, value(f32::NAN));
        here.put_pixel(10, 0, value(4.2));
        here.put_pixel(12, 0, value(4.0));
        let mut there = Plane::from_pixel(20, 1, value(f32::NAN));
        there.put_pixel(6, 0, value(4.6));
        there.put_pixel(8, 0, value(7.0));
        let (kept, confirmed) = consistent(&here, &[(&there, Vector2::new(-1.0, 0.0))], 1.0);
        assert_eq!(kept.get_pixel(10, 0).0[0], 4.2);
        assert_eq!(confirmed.iter().filter(|&&c| c == 1).count(), 1);
        assert!(kept.get_pixel(12, 0).0[0].is_nan());
    }
}

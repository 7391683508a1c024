//! From binary images to what drives keys and animation: windows, eigenimages, rhythm.

use image::GrayImage;

use super::eigen::{EigenError, Eigenimages, eigenimages};
use super::region::{Region, follow, window, window_size};
use super::rhythm::{Rhythm, rhythm};

/// Components that are kept.
pub const COMPONENTS: usize = 10;

#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    #[error("frame {0} has no silhouette; draw it with `muybridge animal sketch`, or leave the frame out with --frames")]
    Nothing(usize),
    #[error(transparent)]
    Eigen(#[from] EigenError),
}

#[derive(Clone, Debug)]
pub struct Analysis {
    /// Of every frame, in pixels of its mask.
    pub regions: Vec<Region>,
    /// Silhouettes round their centres of mass, all of one size.
    pub windows: Vec<GrayImage>,
    pub eigen: Eigenimages,
    pub rhythm: Rhythm,
}

/// Where the animal is in a mask: the followed piece, or, of strokes, all that is drawn.
fn region(mask: &GrayImage, near: Option<[f64; 2]>, strokes: bool) -> Option<(GrayImage, Region)> {
    if !strokes {
        return follow(mask, near);
    }
    let drawn: Vec<(u32, u32)> = mask.enumerate_pixels().filter(|(_, _, p)| p.0[0] > 127).map(|(x, y, _)| (x, y)).collect();
    let n = drawn.len();
    let sum = drawn.iter().fold([0.0; 2], |[sx, sy], (x, y)| [sx + f64::from(*x), sy + f64::from(*y)]);
    let bounds = drawn.iter().fold([u32::MAX, u32::MAX, 0, 0], |b, (x, y)| [b[0].min(*x), b[1].min(*y), b[2].max(*x), b[3].max(*y)]);
    (n > 0).then(|| (mask.clone(), Region { area_px: n, centre_px: sum.map(|s| s / n as f64), bounds_px: bounds, second_px: None }))
}

/// Analyses masks (or drawn strokes) of successive frames; trends up to a degree are taken away (see [`eigenimages`]).
pub fn analyse(masks: &[GrayImage], strokes: bool, trend_degree: usize) -> Result<Analysis, AnalysisError> {
    let (mut cleaned, mut regions, mut near) = (Vec::new(), Vec::new(), None);
    for (frame, mask) in masks.iter().enumerate() {
        let (only, region) = region(mask, near, strokes).ok_or(AnalysisError::Nothing(frame))?;
        near = Some(region.centre_px);
        cleaned.push(only);
        regions.push(region);
    }
    let size = window_size(&regions);
    let windows: Vec<GrayImage> = cleaned.iter().zip(&regions).map(|(m, r)| window(m, r.centre_px, size)).collect();
    let eigen = eigenimages(&windows, COMPONENTS, trend_degree)?;
    let rhythm = rhythm(&eigen, strokes);
    Ok(Analysis { regions, windows, eigen, rhythm })
}

/// Silhouettes of another clip of the same species in the windows of a known basis: scaled by the ratio of the median root
/// areas, centred, and turned over where `mirrored`.
pub fn fitted_windows(masks: &[GrayImage], basis: &[GrayImage], mirrored: bool) -> Result<Vec<GrayImage>, AnalysisError> {
    let own = analyse(masks, false, 0)?;
    let area = |list: &[GrayImage]| {
        let mut areas: Vec<usize> = list.iter().map(|m| m.iter().filter(|p| **p > 127).count()).collect();
        areas.sort_unstable();
        areas.get(areas.len() / 2).copied().unwrap_or(0) as f64
    };
    let scale = (area(basis) / area(&own.windows).max(1.0)).sqrt();
    let size = basis.first().map_or([1, 1], |b| [b.width(), b.height()]);
    let fitted = |mask: &GrayImage| {
        GrayImage::from_fn(size[0], size[1], |x, y| {
            let from = |at: u32, to: u32, own: u32| (f64::from(at) - f64::from(to / 2)) / scale + f64::from(own / 2);
            let x = if mirrored { size[0] - 1 - x } else { x };
            let (sx, sy) = (from(x, size[0], mask.width()).round(), from(y, size[1], mask.height()).round());
            let inside = sx >= 0.0 && sy >= 0.0 && sx < f64::from(mask.width()) && sy < f64::from(mask.height());
            if inside { *mask.get_pixel(sx as u32, sy as u32) } else { image::Luma([0]) }
        })
    };
    Ok(own.windows.iter().map(fitted).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::horse::{Gait, horse, posture};
    use crate::animal::render::{View, silhouette};
    use crate::animal::rhythm::Verdict;

    fn gallop(n: usize, px_per_m: f64, size_px: [u32; 2]) -> Vec<GrayImage> {
        let horse = horse();
        let view = View { px_per_unit: px_per_m, ..View::side(&horse, size_px) };
        (0..n).map(|t| silhouette(&horse, &posture(&horse, Gait::Gallop, t as f64 / 12.75), &view)).collect()
    }

    #[test]
    fn a_gallop_is_usable_and_a_missing_frame_named() {
        let mut masks = gallop(100, 45.0, [180, 140]);
        let found = analyse(&masks, false, 0).unwrap();
        assert_eq!(found.rhythm.verdict, Verdict::Usable, "{:?}", found.rhythm);
        assert!((found.rhythm.period_frames.unwrap() - 12.5).abs() < 0.3);
        assert!(found.windows.iter().all(|w| w.dimensions() == found.windows[0].dimensions()));
        masks[7] = GrayImage::new(180, 140);
        assert!(analyse(&masks, false, 0).unwrap_err().to_string().starts_with("frame 7 has no silhouette"));
        assert!(analyse(&masks[..1], false, 0).is_err());
    }

    #[test]
    fn another_clip_at_another_size_projects_to_the_same_coefficients() {
        let known = analyse(&gallop(40, 60.0, [240, 180]), false, 0).unwrap();
        let mirrored: Vec<GrayImage> = gallop(40, 42.0, [200, 160]).iter().map(image::imageops::flip_horizontal).collect();
        let fitted = fitted_windows(&mirrored, &known.windows, true).unwrap();
        for (t, window) in fitted.iter().enumerate() {
            let p = known.eigen.project(window);
            let away = (0..2).map(|k| (p[k] - known.eigen.coefficients[(t, k)]).powi(2)).sum::<f64>().sqrt();
            assert!(away < 0.35, "{t}: {away}");
        }
        let unturned = fitted_windows(&mirrored, &known.windows, false).unwrap();
        let away = |w: &GrayImage, t: usize| {
            let p = known.eigen.project(w);
            (0..2).map(|k| (p[k] - known.eigen.coefficients[(t, k)]).powi(2)).sum::<f64>()
        };
        assert!((0..40).map(|t| away(&unturned[t], t)).sum::<f64>() > 4.0 * (0..40).map(|t| away(&fitted[t], t)).sum::<f64>());
    }
}

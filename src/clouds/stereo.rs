//! Dense disparities of two or three rectified views: every view is searched as the reference, and they must agree.

use super::correlate::{Matches, Region, Search, correlate};
use super::{prefilter, validate};
use crate::rig::rectify::Plane;
use image::GrayImage;
use nalgebra::Vector2;

/// How to match. The defaults suit a person of a few hundred pixels.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StereoOptions {
    /// Half-width of the small correlation box, px; the windows that lean on it reach three times as far. 1 is noisy, 4 fattens
    /// limbs of 20 px.
    pub radius: usize,
    /// Largest difference of one pixel, in steps of the normalised picture (40 is one local standard deviation).
    pub truncation: u8,
    /// Extra cost per pixel for counting only one of two pairs.
    pub occlusion_penalty: u16,
    /// How much dearer the best rival must be, as a fraction of the winner's cost.
    pub uniqueness: f32,
    /// Tolerance of the check between views, px.
    pub consistency_px: f32,
    /// Smallest connected piece, px.
    pub speckle_area_px: usize,
    /// Largest difference of neighbours within a piece, px.
    pub speckle_step_px: f32,
}

impl Default for StereoOptions {
    fn default() -> Self {
        let e = |n: &str, d: f32| std::env::var(n).ok().and_then(|v| v.parse().ok()).unwrap_or(d);
        Self {
            radius: e("R", 2.0) as usize,
            truncation: e("T", 50.0) as u8,
            occlusion_penalty: e("P", 4.0) as u16,
            uniqueness: e("U", 0.2),
            consistency_px: e("C", 1.0),
            speckle_area_px: e("A", 100.0) as usize,
            speckle_step_px: e("S", 1.5),
        }
    }
}

/// One view of a rectified group, ready for matching.
#[derive(Clone, Debug)]
pub struct PreparedView {
    /// Rectified picture, grey levels; NaN where unknown.
    pub plane: Plane,
    /// Normalised for correlation; 0 where unknown.
    pub feature: GrayImage,
    /// As in [`crate::rig::rectify::RectifiedView::step`].
    pub step: Vector2<f64>,
}

impl PreparedView {
    pub fn new(plane: Plane, step: Vector2<f64>) -> Self {
        Self { feature: prefilter::normalise(&plane), plane, step }
    }
}

/// Disparities seen from one view.
#[derive(Clone, Debug)]
pub struct ViewDisparity {
    /// Validated sub-pixel disparities, px; NaN elsewhere.
    pub disparity: Plane,
    /// Bits of the other views (in order, this one left out) that confirm a pixel.
    pub confirmed: Vec<u8>,
    pub matches: Matches,
}

/// Matches all views against each other; `regions` say where each view is searched, `range` the disparities first..=last.
pub fn match_views(
    views: &[PreparedView],
    regions: &[Region],
    range: [usize; 2],
    options: &StereoOptions,
    probes: &[Option<Vec<f32>>],
) -> Vec<ViewDisparity> {
    let search = Search {
        first: range[0],
        last: range[1],
        radius: options.radius,
        truncation: options.truncation,
        occlusion_penalty: options.occlusion_penalty,
    };
    let searched: Vec<Matches> = (0..views.len())
        .map(|k| {
            let others: Vec<_> = others_of(views, k).map(|o| (&o.feature, o.step - views[k].step)).collect();
            correlate(&views[k].feature, &others, regions[k], &search, probes.get(k).and_then(|p| p.as_deref()))
        })
        .collect();
    let size = |k: usize| [views[k].plane.width(), views[k].plane.height()];
    let unique: Vec<Plane> = searched.iter().enumerate().map(|(k, m)| validate::unique(m, size(k), options.uniqueness)).collect();
    let winners: Vec<Plane> = searched.iter().enumerate().map(|(k, m)| validate::unique(m, size(k), 0.0)).collect();
    let finish = |(k, matches): (usize, Matches)| {
        let others: Vec<_> = (0..views.len()).filter(|&j| j != k).map(|j| (&winners[j], views[j].step - views[k].step)).collect();
        let (mut disparity, confirmed) = validate::consistent(&unique[k], &others, options.consistency_px);
        validate::remove_speckles(&mut disparity, options.speckle_area_px, options.speckle_step_px);
        ViewDisparity { disparity, confirmed, matches }
    };
    searched.into_iter().enumerate().map(finish).collect()
}

fn others_of(views: &[PreparedView], k: usize) -> impl Iterator<Item = &PreparedView> {
    views.iter().enumerate().filter(move |(j, _)| *j != k).map(|(_, v)| v)
}

//! The empty stage, and who stands in front of it.
//!
//! A pixel belongs to the person when (a) its grey value changed against the empty stage and (b) the present pictures do not
//! match at the stage's own disparity. A cast shadow changes the grey value but stays at the stage's depth in all views, so
//! (b) removes it; a blurred match beside the outline has the person's depth but unchanged grey values, so (a) removes it.
//! Changed pixels without a valid match (occluded in the other views) go with their neighbours.
//!
//! Fails where the person stays within [`StageOptions::clearance_m`] of the stage, and for mirrors and curtains.

use super::correlate::Region;
use super::masks;
use super::prefilter::blur;
use super::stereo::{PreparedView, StereoOptions, ViewDisparity, match_views};
use crate::rig::rectify::{Plane, Rectification};
use image::{GrayImage, Luma};

/// When a pixel counts as changed, and as standing before the stage.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StageOptions {
    /// Change of the smoothed grey value in units of its noise. Lower lets noise in, higher loses clothes of the wall's grey.
    pub change_sigmas: f32,
    /// Smallest distance in depth from the stage, metres.
    pub clearance_m: f64,
    /// Smallest difference in disparity from the stage, px; about three times the matching noise.
    pub clearance_px: f32,
    /// Smallest piece of a person, px; anything smaller is noise.
    pub smallest_piece_px: usize,
}

impl Default for StageOptions {
    fn default() -> Self {
        Self { change_sigmas: 4.0, clearance_m: 0.02, clearance_px: 0.5, smallest_piece_px: 150 }
    }
}

/// The empty stage as a rectified group sees it.
#[derive(Clone, Debug)]
pub struct Stage {
    /// One per view: picture and disparities without gaps.
    pub(crate) views: Vec<StageView>,
}

#[derive(Clone, Debug)]
pub(crate) struct StageView {
    pub plane: Plane,
    pub disparity: Plane,
}

impl Stage {
    /// Matches the pictures of the empty stage, one per camera of the rig, up to the largest disparity.
    pub(crate) fn new(rectification: &Rectification, images: &[&GrayImage], largest_px: usize, options: &StereoOptions) -> Self {
        let prepared: Vec<PreparedView> =
            (0..images.len()).map(|k| PreparedView::new(rectification.warp(k, images[k]), rectification.views[k].step)).collect();
        let regions = vec![whole(rectification); prepared.len()];
        let found = match_views(&prepared, &regions, [0, largest_px], options, &[]);
        let views = prepared.into_iter().zip(found).map(|(p, f)| StageView { plane: p.plane, disparity: fill_gaps(&f.disparity) });
        Self { views: views.collect() }
    }
}

pub(crate) fn whole(rectification: &Rectification) -> Region {
    let [width, height] = rectification.size_px.map(|s| s as usize);
    Region { x: [0, width], y: [0, height] }
}

/// Gaps take the farther of the known values to their left and right, then above and below: they are mostly occlusions.
fn fill_gaps(disparity: &Plane) -> Plane {
    let (width, height) = (disparity.width() as usize, disparity.height() as usize);
    let mut filled = disparity.clone();
    let values: &mut [f32] = &mut filled;
    for y in 0..height {
        fill_line(values, (0..width).map(|x| y * width + x).collect());
    }
    for x in 0..width {
        fill_line(values, (0..height).map(|y| y * width + x).collect());
    }
    filled
}

fn fill_line(values: &mut [f32], line: Vec<usize>) {
    let before: Vec<f32> = line
        .iter()
        .scan(f32::NAN, |last, &i| {
            *last = if values[i].is_nan() { *last } else { values[i] };
            Some(*last)
        })
        .collect();
    let mut after = f32::NAN;
    for (&i, before) in line.iter().zip(before).rev() {
        if values[i].is_nan() {
            values[i] = before.min(after);
        } else {
            after = values[i];
        }
    }
}

/// 255 where the smoothed grey value differs from the stage's by more than the noise allows.
pub(crate) fn changed(now: &Plane, stage: &Plane, options: &StageOptions) -> GrayImage {
    let difference: Vec<f32> = now.iter().zip(stage.iter()).map(|(a, b)| if a.is_nan() || b.is_nan() { 0.0 } else { a - b }).collect();
    let smooth = blur(&difference, now.width() as usize, 0.7);
    let mut sizes: Vec<f32> = smooth.iter().zip(now.iter()).filter(|(_, n)| !n.is_nan()).map(|(s, _)| s.abs()).collect();
    let middle = sizes.len() / 2;
    // Most pixels show the stage, so the median change is noise; 8-bit pictures have at least rounding noise.
    let sigma = if sizes.is_empty() { 1.0 } else { (1.4826 * *sizes.select_nth_unstable_by(middle, f32::total_cmp).1).max(0.5) };
    let limit = options.change_sigmas * sigma;
    let values = smooth.iter().map(|s| if s.abs() > limit { 255 } else { 0 }).collect();
    GrayImage::from_raw(now.width(), now.height(), values).expect("one value per pixel")
}

/// The box around the changed pieces of at least the smallest size, with a margin; `None` when there are none.
pub(crate) fn changed_box(changed: &GrayImage, options: &StageOptions, margin: usize) -> Option<Region> {
    let (width, height) = (changed.width() as usize, changed.height() as usize);
    let solid = masks::box_vote(changed, 1, 0.6);
    let mut found: Option<Region> = None;
    for piece in masks::pieces(&solid, |v| v != 0).into_iter().filter(|p| p.len() >= options.smallest_piece_px) {
        for i in piece {
            let (x, y) = (i % width, i / width);
            let b = found.get_or_insert(Region { x: [x, x], y: [y, y] });
            *b = Region { x: [b.x[0].min(x), b.x[1].max(x)], y: [b.y[0].min(y), b.y[1].max(y)] };
        }
    }
    let grow = |[low, high]: [usize; 2], size: usize| [low.saturating_sub(margin), (high + 1 + margin).min(size)];
    found.map(|b| Region { x: grow(b.x, width), y: grow(b.y, height) })
}

/// Least disparity difference that counts as standing before the stage.
fn clearance(rectification: &Rectification, stage_px: f32, options: &StageOptions) -> f32 {
    let per_metre = f64::from(stage_px).powi(2) / (rectification.focal_px * rectification.baseline_m);
    ((per_metre * options.clearance_m) as f32).max(options.clearance_px)
}

/// The person in one rectified view: 0/255.
pub(crate) fn person_mask(
    rectification: &Rectification,
    changed: &GrayImage,
    stage: &StageView,
    found: &ViewDisparity,
    options: &StageOptions,
) -> GrayImage {
    const PERSON: u8 = 2;
    const STAGE: u8 = 1;
    let label = |((&changed, &d), &stage_d): ((&u8, &f32), &f32)| {
        if changed == 0 || d.is_nan() {
            0
        } else if stage_d.is_nan() || d > stage_d + clearance(rectification, stage_d, options) {
            PERSON
        } else {
            STAGE
        }
    };
    let labels: Vec<u8> = changed.iter().zip(found.disparity.iter()).zip(stage.disparity.iter()).map(label).collect();
    let (width, height) = changed.dimensions();
    let picture = |wanted: u8| GrayImage::from_raw(width, height, labels.iter().map(|&l| if l == wanted { 255 } else { 0 }).collect());
    let (person, ground) = (picture(PERSON).expect("same size"), picture(STAGE).expect("same size"));
    let (near_person, near_ground) = (counts(&person, 4), counts(&ground, 4));
    let mut mask = GrayImage::from_fn(width, height, |x, y| {
        let i = (y * width + x) as usize;
        let undecided = changed.as_raw()[i] != 0 && labels[i] == 0;
        Luma([if labels[i] == PERSON || (undecided && near_person[i] > near_ground[i]) { 255 } else { 0 }])
    });
    mask = masks::box_vote(&mask, 1, 0.5);
    masks::keep_large(&mut mask, options.smallest_piece_px);
    masks::fill_holes(&mut mask, 60);
    mask
}

fn counts(mask: &GrayImage, r: i32) -> Vec<f32> {
    let values: Vec<f32> = mask.iter().map(|&v| f32::from(v != 0)).collect();
    blur(&values, mask.width() as usize, r as f32 / 2.0)
}

//! The empty stage, and who stands in front of it.
//!
//! A pixel belongs to the person when (a) its grey value changed against the empty stage and (b) the present pictures do not
//! match at the stage's own disparity. A cast shadow changes the grey value but stays at the stage's depth in all views, so
//! (b) removes it, together with its two own marks: it darkens smoothly, and by the same ratio in all views; a blurred match beside the outline has the person's depth but unchanged grey values, so (a) removes it.
//! Changed pixels without a valid match (occluded in the other views) go with their neighbours.
//!
//! Fails where the person stays within [`StageOptions::clearance_m`] of the stage, and for mirrors and curtains.

use super::correlate::Region;
use super::prefilter::blur;
use super::stereo::{StereoOptions, StereoView, ViewDisparity, match_views};
use crate::footage::regions;
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
    /// Roughness of the ratio to the stage, in units of its median over the picture, below which a darkening counts as a shadow.
    pub shade_roughness: f32,
    /// Shadows reach this far behind the person where windows blur depths, metres.
    pub shade_reach_m: f64,
    /// Largest hole that is filled, px; gaps between arm and trunk are larger.
    pub largest_hole_px: usize,
    /// Smallest piece of a person, px; anything smaller is noise.
    pub smallest_piece_px: usize,
}

impl Default for StageOptions {
    fn default() -> Self {
        Self {
            change_sigmas: 4.0,
            clearance_m: 0.02,
            clearance_px: 0.5,
            shade_roughness: 2.2,
            shade_reach_m: 0.3,
            largest_hole_px: 60,
            smallest_piece_px: 150,
        }
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
    /// As matched, px; NaN where nothing was found.
    pub matched: Plane,
    /// The same with its gaps filled.
    pub disparity: Plane,
}

impl Stage {
    /// Matches the pictures of the empty stage, one per camera of the rig, up to the largest disparity.
    pub(crate) fn measure(rectification: &Rectification, images: &[&GrayImage], largest_px: usize, options: &StereoOptions) -> Self {
        let prepared: Vec<StereoView> =
            (0..images.len()).map(|k| StereoView { plane: rectification.warp(k, images[k]), step: rectification.views[k].step }).collect();
        let regions = vec![whole(rectification); prepared.len()];
        let found = match_views(&prepared, &regions, [0, largest_px], options);
        let views = prepared.into_iter().zip(found).map(|(p, f)| StageView {
            plane: p.plane,
            disparity: fill_gaps(&f.disparity),
            matched: f.disparity,
        });
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

/// How a rectified picture differs from the stage's.
#[derive(Clone, Debug)]
pub(crate) struct Change {
    /// Smoothed difference, grey levels.
    pub difference: Vec<f32>,
    /// Smoothed logarithm of the ratio.
    pub ratio: Vec<f32>,
    /// 255 where the difference exceeds its noise.
    pub changed: GrayImage,
    /// 255 where the grey values are a smooth fraction of the stage's, as in a cast shadow.
    pub shaded: GrayImage,
}

/// Compares a picture with the stage's. Most pixels must show the stage: the medians over the picture are taken for noise.
pub(crate) fn compare(now: &Plane, stage: &Plane, options: &StageOptions) -> Change {
    let width = now.width() as usize;
    let both = |f: fn(f32, f32) -> f32| -> Vec<f32> {
        now.iter().zip(stage.iter()).map(|(&a, &b)| if a.is_nan() || b.is_nan() { f32::NAN } else { f(a, b) }).collect()
    };
    let difference = both(|a, b| a - b);
    let known: Vec<bool> = difference.iter().map(|d| !d.is_nan()).collect();
    let zero = |values: Vec<f32>| -> Vec<f32> { values.into_iter().map(|v| if v.is_nan() { 0.0 } else { v }).collect() };
    let difference = blur(&zero(difference), width, DIFFERENCE_SIGMA_PX);
    // 8-bit pictures have at least rounding noise.
    let noise = (1.4826 * median(difference.iter().map(|d| d.abs()), &known)).max(0.5);
    let ratio = blur(&zero(both(|a, b| ((a.max(0.0) + DARK) / (b.max(0.0) + DARK)).ln())), width, DIFFERENCE_SIGMA_PX);
    let coarse = blur(&ratio, width, 2.0);
    let squares: Vec<f32> = ratio.iter().zip(&coarse).map(|(r, c)| (r - c).powi(2)).collect();
    let roughness: Vec<f32> = blur(&squares, width, 1.5).into_iter().map(f32::sqrt).collect();
    let smooth = options.shade_roughness * median(roughness.iter().copied(), &known);
    let step = 4.0 * 1.4826 * median(ratio.iter().zip(ratio.iter().skip(1)).map(|(a, b)| (a - b).abs()), &known);
    let mask = |set: &dyn Fn(usize) -> bool| {
        GrayImage::from_fn(now.width(), now.height(), |x, y| Luma([if set(y as usize * width + x as usize) { 255 } else { 0 }]))
    };
    let changed = mask(&|i| difference[i].abs() > options.change_sigmas * noise);
    let mut shaded = mask(&|i| roughness[i] < smooth && coarse[i] < 0.0 && coarse[i] > DARKEST_SHADE);
    grow_shade(&mut shaded, &ratio, step);
    Change { difference, ratio, changed, shaded }
}

/// Roughness reaches a few pixels beyond an outline; there the shadow grows over small steps of the ratio.
fn grow_shade(shaded: &mut GrayImage, ratio: &[f32], largest_step: f32) {
    let (width, height) = (shaded.width() as usize, shaded.height() as usize);
    for _ in 0..GROWTH_PX {
        let before = shaded.as_raw().clone();
        for i in width..(width * height).saturating_sub(width + 1) {
            let joins = |j: usize| before[j] != 0 && (ratio[i] - ratio[j]).abs() < largest_step;
            if before[i] == 0 && ratio[i] < 0.0 && (joins(i - 1) || joins(i + 1) || joins(i - width) || joins(i + width)) {
                shaded.put_pixel((i % width) as u32, (i / width) as u32, Luma([255]));
            }
        }
    }
}

/// The reach of the roughness measure.
const GROWTH_PX: usize = 5;

/// Against noise; wider moves the outline.
const DIFFERENCE_SIGMA_PX: f32 = 0.7;

/// Grey levels added before taking ratios, so that noise in black pixels does not count.
const DARK: f32 = 5.0;

/// Logarithm of the deepest shadow: a fifth of the light. What is darker is a dark thing.
const DARKEST_SHADE: f32 = -1.6;

fn median(values: impl Iterator<Item = f32>, known: &[bool]) -> f32 {
    let mut values: Vec<f32> = values.zip(known).filter(|(_, k)| **k).map(|(v, _)| v).collect();
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// The box around the changed pieces of at least the smallest size, with a margin; `None` when there are none.
pub(crate) fn changed_box(changed: &GrayImage, options: &StageOptions, margin: usize) -> Option<Region> {
    let (width, height) = (changed.width() as usize, changed.height() as usize);
    let solid = regions::box_vote(changed, 1, 0.6);
    let mut found: Option<Region> = None;
    for piece in regions::pieces(&solid, false).into_iter().filter(|p| p.len() >= options.smallest_piece_px) {
        for i in piece {
            let (x, y) = (i % width, i / width);
            let b = found.get_or_insert(Region { x: [x, x], y: [y, y] });
            *b = Region { x: [b.x[0].min(x), b.x[1].max(x)], y: [b.y[0].min(y), b.y[1].max(y)] };
        }
    }
    let grow = |[low, high]: [usize; 2], size: usize| [low.saturating_sub(margin), (high + 1 + margin).min(size)];
    found.map(|b| Region { x: grow(b.x, width), y: grow(b.y, height) })
}

/// Disparity difference of a distance in depth at the stage's disparity.
fn clearance(rectification: &Rectification, stage_px: f32, distance_m: f64) -> f32 {
    let depth = rectification.depth(f64::from(stage_px));
    if depth > distance_m { (rectification.disparity(depth - distance_m) - f64::from(stage_px)) as f32 } else { f32::INFINITY }
}

/// The person in rectified view `k`: 0/255. `changes` and `found` are those of all views.
pub(crate) fn person_mask(
    rectification: &Rectification,
    k: usize,
    changes: &[Change],
    stage: &StageView,
    found: &ViewDisparity,
    options: &StageOptions,
) -> GrayImage {
    let (width, height) = changes[k].changed.dimensions();
    let labels: Vec<Label> = (0..(width * height) as usize)
        .map(|i| label(rectification, k, i, changes, stage.disparity.as_raw()[i], found.disparity.as_raw()[i], options))
        .collect();
    let density =
        |wanted: Label| blur(&labels.iter().map(|&l| if l == wanted { 1.0 } else { 0.0 }).collect::<Vec<_>>(), width as usize, 2.0);
    let (person, ground) = (density(Label::Person), density(Label::Stage));
    let set = |i: usize| labels[i] == Label::Person || (labels[i] == Label::Undecided && person[i] > ground[i]);
    let mut mask = GrayImage::from_fn(width, height, |x, y| Luma([if set((y * width + x) as usize) { 255 } else { 0 }]));
    mask = regions::box_vote(&mask, 1, 0.5);
    mask = regions::keep_large(&mask, options.smallest_piece_px);
    mask = bridge(rectification, &mask, &found.disparity, &stage.disparity, options);
    mask = regions::fill_holes(&mask, options.largest_hole_px);
    trim_outline(&mut mask, &changes[k].difference);
    mask
}

/// Gaps in the mask of up to twice this are bridged, px.
const BRIDGE_PX: u32 = 4;

/// Joins to the mask what lies between its parts and stands before the stage, though its grey is the stage's: bare skin.
fn bridge(rectification: &Rectification, mask: &GrayImage, disparity: &Plane, stage: &Plane, options: &StageOptions) -> GrayImage {
    let closed = regions::close(mask, BRIDGE_PX);
    let before = |i: usize| {
        let (d, s) = (disparity.as_raw()[i], stage.as_raw()[i]);
        d - s > clearance(rectification, s, options.clearance_m).max(options.clearance_px)
    };
    let joins = |i: usize| mask.as_raw()[i] != 0 || (closed.as_raw()[i] != 0 && before(i));
    let width = mask.width() as usize;
    GrayImage::from_fn(mask.width(), mask.height(), |x, y| Luma([if joins(y as usize * width + x as usize) { 255 } else { 0 }]))
}

#[derive(Clone, Copy, PartialEq)]
enum Label {
    Nothing,
    Stage,
    Person,
    /// Changed, but without a valid match.
    Undecided,
}

fn label(
    rectification: &Rectification,
    k: usize,
    i: usize,
    changes: &[Change],
    stage_px: f32,
    disparity: f32,
    options: &StageOptions,
) -> Label {
    let changed = changes[k].changed.as_raw()[i] != 0;
    let shaded = changes[k].shaded.as_raw()[i] != 0;
    let spread = if changed { ratio_spread(rectification, k, i, changes, stage_px) } else { None };
    let shaded = match spread {
        Some(spread) => changes[k].ratio[i] < 0.0 && (spread < SAME_RATIO || (shaded && spread < OTHER_RATIO)),
        None => shaded,
    };
    if disparity.is_nan() {
        return match (changed, shaded) {
            (true, false) => Label::Undecided,
            (true, true) => Label::Stage,
            _ => Label::Nothing,
        };
    }
    let before = disparity - stage_px;
    let needed = clearance(rectification, stage_px, options.clearance_m).max(options.clearance_px);
    // Windows at a foot's outline carry its depth over to the shadow beside it.
    let beside_shadow = shaded && before < clearance(rectification, stage_px, options.shade_reach_m);
    if !stage_px.is_nan() && (before <= needed || beside_shadow) {
        return if changed { Label::Stage } else { Label::Nothing };
    }
    let votes = (0..changes.len()).filter(|&j| j == k || changed_at(rectification, k, j, i, changes, disparity)).count();
    let votes = votes - usize::from(!changed);
    if 2 * votes > changes.len() || (changed && changes.len() == 2) { Label::Person } else { Label::Nothing }
}

/// A shadow darkens a place of the stage by the same ratio in all views: closer than this (logarithm) no more evidence is
/// needed. Three times the noise of 8-bit pictures of medium brightness; larger takes parts of the person for shadow.
const SAME_RATIO: f32 = 0.03;

/// Farther apart than this (logarithm) even a smooth darkening is no shadow; smaller lets half hidden shadows pass for a person.
const OTHER_RATIO: f32 = 0.1;

/// Largest difference of the ratio between view `k` and where the others see the same place of the stage; `None` where no
/// other view sees it.
fn ratio_spread(rectification: &Rectification, k: usize, i: usize, changes: &[Change], stage_px: f32) -> Option<f32> {
    let others = (0..changes.len()).filter(|&j| j != k);
    let there = others.filter_map(|j| Some(changes[j].ratio[pixel_in(rectification, k, j, i, stage_px)?]));
    there.map(|ratio| (ratio - changes[k].ratio[i]).abs()).reduce(f32::max)
}

/// Whether view `j` shows a change where it sees pixel `i` of view `k` at this disparity.
fn changed_at(rectification: &Rectification, k: usize, j: usize, i: usize, changes: &[Change], disparity: f32) -> bool {
    pixel_in(rectification, k, j, i, disparity).is_some_and(|there| changes[j].changed.as_raw()[there] != 0)
}

/// The pixel of view `j` that shows pixel `i` of view `k` at this disparity.
fn pixel_in(rectification: &Rectification, k: usize, j: usize, i: usize, disparity: f32) -> Option<usize> {
    let [width, height] = rectification.size_px.map(|s| s as usize);
    let step = rectification.views[j].step - rectification.views[k].step;
    let x = ((i % width) as f64 + step.x * f64::from(disparity)).round();
    let y = ((i / width) as f64 + step.y * f64::from(disparity)).round();
    let inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
    inside.then(|| y as usize * width + x as usize)
}

/// Drops outline pixels that changed less than half as much as their surroundings: they are mostly stage.
fn trim_outline(mask: &mut GrayImage, difference: &[f32]) {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let before = mask.clone();
    let set = |i: usize| before.as_raw()[i] != 0;
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            if !set(i) || (set(i - 1) && set(i + 1) && set(i - width) && set(i + width)) {
                continue;
            }
            let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| y * width + x));
            let strongest = around.map(|j| difference[j].abs()).fold(0.0, f32::max);
            if difference[i].abs() < 0.5 * strongest {
                mask.put_pixel(x as u32, y as u32, Luma([0]));
            }
        }
    }
}

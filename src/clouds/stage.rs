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
use image::GrayImage;

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
    /// Roughness of the ratio to the stage, in units of its median where nothing changed around the person, below which a darkening
    /// counts as a shadow.
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
    /// Logarithm of the picture, see [`DARK`]; NaN where unknown.
    pub logarithm: Vec<f32>,
}

impl Stage {
    /// Matches the pictures of the empty stage, one per camera of the rig, up to the largest disparity.
    pub(crate) fn measure(rectification: &Rectification, images: &[&GrayImage], largest_px: usize, options: &StereoOptions) -> Self {
        let prepared: Vec<StereoView> =
            (0..images.len()).map(|k| StereoView { plane: rectification.warp(k, images[k]), step: rectification.views[k].step }).collect();
        let regions = vec![whole(rectification); prepared.len()];
        let found = match_views(&prepared, &regions, [0, largest_px], options);
        let views = prepared.into_iter().zip(found).map(|(p, f)| StageView {
            logarithm: p.plane.iter().map(|&v| logarithm(v)).collect(),
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

/// Where a rectified picture differs from the stage's.
#[derive(Clone, Debug)]
pub(crate) struct Change {
    /// Smoothed difference, grey levels.
    pub difference: Vec<f32>,
    /// 255 where the difference exceeds its noise.
    pub changed: GrayImage,
}

/// Compares a picture with the stage's. Most pixels must show the stage: the median over the picture is taken for noise.
pub(crate) fn compare(now: &Plane, stage: &StageView, options: &StageOptions) -> Change {
    let known = |i: usize| !(now.as_raw()[i] - stage.plane.as_raw()[i]).is_nan();
    let difference: Vec<f32> = now.iter().zip(stage.plane.iter()).map(|(a, b)| or_0(a - b)).collect();
    let difference = blur(&difference, now.width() as usize, DIFFERENCE_SIGMA_PX);
    // 8-bit pictures have at least rounding noise.
    let noise = (1.4826 * median_over(difference.len(), known, |i| difference[i].abs())).max(0.5);
    let changed = difference.iter().map(|d| if d.abs() > options.change_sigmas * noise { 255 } else { 0 }).collect();
    let changed = GrayImage::from_raw(now.width(), now.height(), changed).expect("one value per pixel");
    Change { difference, changed }
}

#[inline]
fn or_0(v: f32) -> f32 {
    if v.is_nan() { 0.0 } else { v }
}

/// How much darker a part of a picture is than the stage.
#[derive(Clone, Debug)]
pub(crate) struct Shade {
    region: Region,
    /// Smoothed logarithm of the ratio.
    ratio: Vec<f32>,
    /// Where the grey values are a smooth fraction of the stage's, as in a cast shadow.
    shaded: Vec<bool>,
}

impl Shade {
    /// Of a region around what changed; what did not change in it tells the noise.
    pub fn new(now: &Plane, stage: &StageView, change: &Change, region: Region, options: &StageOptions) -> Shade {
        let (canvas, width) = (now.width() as usize, region.width());
        let unchanged = |place: usize| {
            let i = (region.y[0] + place / width) * canvas + region.x[0] + place % width;
            change.changed.as_raw()[i] == 0 && !(now.as_raw()[i] - stage.plane.as_raw()[i]).is_nan()
        };
        let mut ratio = region.cut(now, canvas);
        for (out, row) in ratio.chunks_exact_mut(width).zip(region.rows(canvas)) {
            out.iter_mut().zip(&stage.logarithm[row]).for_each(|(a, b)| *a = or_0(logarithm(*a) - b));
        }
        let ratio = blur(&ratio, width, DIFFERENCE_SIGMA_PX);
        let coarse = blur(&ratio, width, 2.0);
        let squares: Vec<f32> = ratio.iter().zip(&coarse).map(|(r, c)| (r - c).powi(2)).collect();
        let mut roughness = blur(&squares, width, 1.5);
        roughness.iter_mut().for_each(|r| *r = r.sqrt());
        let smooth = options.shade_roughness * median_over(roughness.len(), unchanged, |i| roughness[i]);
        let step = 4.0 * 1.4826 * median_over(ratio.len().saturating_sub(1), unchanged, |i| (ratio[i] - ratio[i + 1]).abs());
        let shade = |(roughness, coarse): (&f32, &f32)| *roughness < smooth && *coarse < 0.0 && *coarse > DARKEST_SHADE;
        let mut shaded: Vec<bool> = roughness.iter().zip(&coarse).map(shade).collect();
        grow_shade(&mut shaded, &ratio, width, step);
        Shade { region, ratio, shaded }
    }

    /// The ratio at a pixel of the canvas; outside of the region nothing changed.
    fn ratio(&self, i: usize, canvas: usize) -> f32 {
        self.region.place(i, canvas).map_or(0.0, |place| self.ratio[place])
    }
}

/// Roughness reaches a few pixels beyond an outline; there the shadow grows over small steps of the ratio.
fn grow_shade(shaded: &mut [bool], ratio: &[f32], width: usize, largest_step: f32) {
    let inside = width..shaded.len().saturating_sub(width + 1);
    let small = |i: usize, j: usize| (ratio[i] - ratio[j]).abs() < largest_step;
    let joins = |i: &usize| !shaded[*i] && ratio[*i] < 0.0 && around(*i, width).into_iter().any(|j| shaded[j] && small(*i, j));
    let mut grown: Vec<usize> = inside.clone().filter(joins).collect();
    grown.iter().for_each(|i| shaded[*i] = true);
    for _ in 1..GROWTH_PX {
        let mut next = Vec::new();
        for j in grown {
            for i in around(j, width).into_iter().filter(|i| inside.contains(i)) {
                if !shaded[i] && ratio[i] < 0.0 && small(i, j) {
                    shaded[i] = true;
                    next.push(i);
                }
            }
        }
        grown = next;
    }
}

/// The four neighbours of a pixel that is neither in the first row nor in the last.
fn around(i: usize, width: usize) -> [usize; 4] {
    [i - 1, i + 1, i - width, i + width]
}

/// The reach of the roughness measure.
const GROWTH_PX: usize = 5;

/// Against noise; wider moves the outline.
const DIFFERENCE_SIGMA_PX: f32 = 0.7;

/// Grey levels added before taking ratios, so that noise in black pixels does not count.
const DARK: f32 = 5.0;

/// Logarithm of the deepest shadow: a fifth of the light. What is darker is a dark thing.
const DARKEST_SHADE: f32 = -1.6;

/// Logarithm of a grey value, see [`DARK`]; NaN for NaN.
#[inline]
fn logarithm(grey: f32) -> f32 {
    if grey.is_nan() { f32::NAN } else { ln(grey.max(0.0) + DARK) }
}

/// Natural logarithm of a normal number above 0, to 2e-6. x = 2^e m with 1 <= m < 2 and t = (m − 1) / (m + 1) give
/// e ln 2 + 2 (t + t³/3 + t⁵/5 + …), which, unlike the library's, is done for many pixels together.
#[inline]
fn ln(x: f32) -> f32 {
    let (exponent, m) = ((x.to_bits() >> 23) as i32 - 127, f32::from_bits(x.to_bits() & 0x007f_ffff | 0x3f80_0000));
    let t = (m - 1.0) / (m + 1.0);
    let s = t * t;
    exponent as f32 * std::f32::consts::LN_2 + 2.0 * t * (1.0 + s * (1.0 / 3.0 + s * (0.2 + s * (1.0 / 7.0 + s * (1.0 / 9.0)))))
}

/// One pixel in this many is enough for a median over a picture; prime, so that they do not stand in columns.
const SAMPLED: usize = 11;

/// Median of `value` over the known of the pixels 0..count; 0 without any.
fn median_over(count: usize, known: impl Fn(usize) -> bool, value: impl Fn(usize) -> f32) -> f32 {
    let mut values: Vec<f32> = (0..count).step_by(SAMPLED).filter(|&i| known(i)).map(value).collect();
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// The box around the changed pieces of at least the smallest size, with a margin; `None` when there are none.
pub(crate) fn changed_box(changed: &GrayImage, options: &StageOptions, margin: usize) -> Option<Region> {
    let (width, height) = (changed.width() as usize, changed.height() as usize);
    let solid = regions::box_vote(changed, 1, 0.6);
    let pieces = regions::runs(&solid, false);
    let large = pieces.iter().filter(|piece| regions::runs_area_px(piece) >= options.smallest_piece_px);
    let found = large.flatten().map(|run| Region { x: [run.from, run.to], y: [run.y, run.y + 1] }).reduce(Region::around);
    let grow = |[low, high]: [usize; 2], size: usize| [low.saturating_sub(margin), (high + margin).min(size)];
    found.map(|b| Region { x: grow(b.x, width), y: grow(b.y, height) })
}

/// Whether a disparity is more than a distance nearer than the stage's, which it exceeds by `ahead_px`; false for NaN.
fn nearer(rectification: &Rectification, stage_px: f32, ahead_px: f32, distance_m: f64) -> bool {
    // With d = f b / z at the stage's depth z: ahead > f b / (z - distance) - d.
    let [at, ahead] = [stage_px, ahead_px].map(f64::from);
    let left = rectification.focal_px * rectification.baseline_m - distance_m * at;
    left > 0.0 && ahead * left > distance_m * at * at
}

/// Whether a disparity stands clear of the stage's.
fn clear(rectification: &Rectification, stage_px: f32, ahead_px: f32, options: &StageOptions) -> bool {
    ahead_px > options.clearance_px && nearer(rectification, stage_px, ahead_px, options.clearance_m)
}

/// The person in rectified view `k`, in the region of its shade: 0/255. `changes` and `shades` are those of all views.
pub(crate) fn person_mask(
    rectification: &Rectification,
    k: usize,
    (changes, shades): (&[Change], &[Shade]),
    stage: &StageView,
    found: &ViewDisparity,
    options: &StageOptions,
) -> GrayImage {
    let (canvas, region) = (rectification.size_px[0] as usize, shades[k].region);
    let [disparity, ground] = [&found.disparity, &stage.disparity].map(|plane| region.cut(plane, canvas));
    let mut labels = Vec::with_capacity(disparity.len());
    for i in region.rows(canvas).flatten() {
        let place = labels.len();
        let (shaded, disparities) = (shades[k].shaded[place], [disparity[place], ground[place]]);
        labels.push(label(rectification, k, i, (changes, shades), shaded, disparities, options));
    }
    let sides = labels.iter().map(|label| match label {
        Label::Person => 1.0,
        Label::Stage => -1.0,
        Label::Nothing | Label::Undecided => 0.0,
    });
    // Positive where there is more of the person than of the stage around.
    let side = blur(&sides.collect::<Vec<f32>>(), region.width(), 2.0);
    let set = |i: usize| labels[i] == Label::Person || (labels[i] == Label::Undecided && side[i] > 0.0);
    let mut mask = mask_of(region, set);
    mask = regions::box_vote(&mask, 1, 0.5);
    mask = regions::keep_large(&mask, options.smallest_piece_px);
    mask = bridge(rectification, &mask, region, &disparity, &ground, options);
    mask = regions::fill_holes(&mask, options.largest_hole_px);
    trim_outline(&mut mask, &region.cut(&changes[k].difference, canvas));
    mask
}

/// A mask of the size of a region from its pixels' indices.
fn mask_of(region: Region, set: impl Fn(usize) -> bool) -> GrayImage {
    let pixels = (0..region.width() * region.height()).map(|i| if set(i) { 255 } else { 0 }).collect();
    GrayImage::from_raw(region.width() as u32, region.height() as u32, pixels).expect("one value per pixel")
}

/// Gaps in the mask of up to twice this are bridged, px.
const BRIDGE_PX: u32 = 4;

/// Joins to the mask what lies between its parts and stands before the stage, though its grey is the stage's: bare skin.
fn bridge(
    rectification: &Rectification,
    mask: &GrayImage,
    region: Region,
    disparity: &[f32],
    stage: &[f32],
    options: &StageOptions,
) -> GrayImage {
    let closed = regions::close(mask, BRIDGE_PX);
    let before = |i: usize| clear(rectification, stage[i], disparity[i] - stage[i], options);
    mask_of(region, |i| mask.as_raw()[i] != 0 || (closed.as_raw()[i] != 0 && before(i)))
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
    (changes, shades): (&[Change], &[Shade]),
    shaded: bool,
    [disparity, stage_px]: [f32; 2],
    options: &StageOptions,
) -> Label {
    let changed = changes[k].changed.as_raw()[i] != 0;
    let ahead = disparity - stage_px;
    let at_stage = !stage_px.is_nan() && !clear(rectification, stage_px, ahead, options);
    if !changed && (disparity.is_nan() || at_stage) {
        return Label::Nothing;
    }
    let shaded = || {
        let spread = if changed { ratio_spread(rectification, k, i, shades, stage_px) } else { None };
        spread.map_or(shaded, |(ratio, spread)| ratio < 0.0 && (spread < SAME_RATIO || (shaded && spread < OTHER_RATIO)))
    };
    if disparity.is_nan() {
        return if shaded() { Label::Stage } else { Label::Undecided };
    }
    // Windows at a foot's outline carry its depth over to the shadow beside it.
    let reached = || !stage_px.is_nan() && !nearer(rectification, stage_px, ahead, options.shade_reach_m);
    if at_stage || (reached() && shaded()) {
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

/// The ratio of view `k`, and its largest difference from where the others see the same place of the stage; `None` where no
/// other view sees it.
fn ratio_spread(rectification: &Rectification, k: usize, i: usize, shades: &[Shade], stage_px: f32) -> Option<(f32, f32)> {
    let canvas = rectification.size_px[0] as usize;
    let own = shades[k].ratio(i, canvas);
    let others = (0..shades.len()).filter(|&j| j != k);
    let there = others.filter_map(|j| Some(shades[j].ratio(pixel_in(rectification, k, j, i, stage_px)?, canvas)));
    there.map(|ratio| (ratio - own).abs()).reduce(f32::max).map(|spread| (own, spread))
}

/// Whether view `j` shows a change where it sees pixel `i` of view `k` at this disparity.
fn changed_at(rectification: &Rectification, k: usize, j: usize, i: usize, changes: &[Change], disparity: f32) -> bool {
    pixel_in(rectification, k, j, i, disparity).is_some_and(|there| changes[j].changed.as_raw()[there] != 0)
}

/// The pixel of view `j` that shows pixel `i` of view `k` at this disparity.
fn pixel_in(rectification: &Rectification, k: usize, j: usize, i: usize, disparity: f32) -> Option<usize> {
    let [width, height] = rectification.size_px.map(|s| s as usize);
    let step = rectification.views[j].step - rectification.views[k].step;
    let x = (i % width) as f64 + step.x * f64::from(disparity) + 0.5;
    let y = (i / width) as f64 + step.y * f64::from(disparity) + 0.5;
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
                mask.put_pixel(x as u32, y as u32, image::Luma([0]));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::rectify::rectify;
    use crate::rig::rectify::tests::random_rig;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    #[test]
    fn shade_grows_as_when_every_pixel_is_asked_in_every_round() {
        let (width, height, step) = (41, 29, 0.3);
        let wave = |i: usize| (0.7 * i as f32).sin() * (0.13 * (i * i) as f32).cos();
        let ratio: Vec<f32> = (0..width * height).map(|i| wave(i) - 0.2).collect();
        let seeds: Vec<bool> = (0..width * height).map(|i| i * 7919 % 23 == 0).collect();
        let mut expected = seeds.clone();
        for _ in 0..GROWTH_PX {
            let before = expected.clone();
            for i in (width..width * (height - 1) - 1).filter(|i| !before[*i] && ratio[*i] < 0.0) {
                expected[i] = [i - 1, i + 1, i - width, i + width].iter().any(|j| before[*j] && (ratio[i] - ratio[*j]).abs() < step);
            }
        }
        let mut found = seeds.clone();
        grow_shade(&mut found, &ratio, width, step);
        let count = |shaded: &[bool]| shaded.iter().filter(|s| **s).count();
        assert!(found == expected && count(&found) > 2 * count(&seeds), "{} {} {}", count(&seeds), count(&found), count(&expected));
    }

    #[test]
    fn nearer_is_nearer_in_depth() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let rectification = rectify(&random_rig(&mut random, false), &[0, 1, 2]).unwrap();
        for (depth, distance) in [(4.0, 0.02), (4.0, 0.3), (0.9, 0.5)] {
            let at = rectification.disparity(depth);
            let needed = rectification.disparity(depth - distance) - at;
            let beyond = |part: f64| nearer(&rectification, at as f32, (part * needed) as f32, distance);
            assert!(beyond(1.001) && !beyond(0.999), "{depth} {distance}");
        }
        assert!(!nearer(&rectification, rectification.disparity(0.4) as f32, 1e6, 0.5));
        assert!(!nearer(&rectification, f32::NAN, 9.0, 0.1) && !nearer(&rectification, 9.0, f32::NAN, 0.1));
    }

    #[test]
    fn logarithms_meet_the_library() {
        for i in 0..3000 {
            let x = 5.0 + 0.087 * i as f32;
            assert!((ln(x) - x.ln()).abs() < 3e-6, "{x}: {} {}", ln(x), x.ln());
        }
        assert!(logarithm(f32::NAN).is_nan() && (logarithm(-3.0) - DARK.ln()).abs() < 3e-6);
    }
}

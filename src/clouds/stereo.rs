//! Dense disparities of two or three rectified views, seen from one of them.

use super::correlate::{Pair, Region, Scores, correlate};
use super::prefilter;
use super::smooth::smooth;
use super::subpixel::equiangular;
use super::validate::{self, Owners};
use crate::rig::rectify::Plane;
use nalgebra::Vector2;
use rayon::prelude::*;

/// How to match. The defaults suit a person of a few hundred pixels.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StereoOptions {
    /// Half-width of the correlation window, px. 1 is noisy, 4 fattens limbs of 20 px.
    pub radius: usize,
    /// How much dearer the best rival must be, as a fraction of the winner's cost; twice that where a view does not confirm.
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
        Self { radius: 2, uniqueness: 0.1, consistency_px: 1.0, speckle_area_px: 100, speckle_step_px: 1.5 }
    }
}

/// One view of a rectified group.
#[derive(Clone, Debug)]
pub struct StereoView {
    /// Rectified picture, grey levels; NaN where unknown.
    pub plane: Plane,
    /// As in [`crate::rig::rectify::RectifiedView::step`].
    pub step: Vector2<f64>,
}

/// Disparities seen from one view.
#[derive(Clone, Debug)]
pub struct ViewDisparity {
    /// Validated sub-pixel disparities, px; NaN elsewhere.
    pub disparity: Plane,
    /// Bits of the other views (in order, this one left out) that confirm a pixel.
    pub confirmed: Vec<u8>,
}

/// Disparities of the whole first view, averaged over their surfaces ([`super::smooth`]), px; NaN where no match stands.
/// `range` first..=last, px.
pub fn disparity_map(views: &[StereoView], range: [usize; 2], options: &StereoOptions) -> Plane {
    let Some(first) = views.first() else { return Plane::default() };
    let [width, height] = [first.plane.width(), first.plane.height()].map(|size| size as usize);
    let found = match_view(views, 0, Region { x: [0, width], y: [0, height] }, range, options);
    smooth(&found.disparity)
}

/// Matches every view against the others; `regions` say where each is searched, `range` the disparities first..=last.
pub fn match_views(views: &[StereoView], regions: &[Region], range: [usize; 2], options: &StereoOptions) -> Vec<ViewDisparity> {
    (0..views.len()).map(|k| match_view(views, k, regions[k], range, options)).collect()
}

/// Matches `region` of one view against one or two others of its size. Disparities `range` first..=last, px.
///
/// Hypotheses are as fine as the longest baseline sees them: a pixel there, half a pixel of disparity where it is twice as
/// long as the baseline in which disparities are counted.
pub fn match_view(views: &[StereoView], reference: usize, region: Region, range: [usize; 2], options: &StereoOptions) -> ViewDisparity {
    let here = &views[reference];
    let steps: Vec<Vector2<f64>> = others_of(views, reference).map(|o| o.step - here.step).collect();
    let per_px = steps.iter().map(Vector2::amax).fold(f64::MIN_POSITIVE, f64::max);
    let steps: Vec<Vector2<f64>> = steps.iter().map(|s| s / per_px).collect();
    let pair = |(other, step): (&StereoView, &Vector2<f64>)| {
        let gradient = |plane: &Plane| prefilter::gradient(plane, *step);
        let (reference, other) = rayon::join(|| gradient(&here.plane), || gradient(&other.plane));
        Pair { reference, other, step: *step }
    };
    let others: Vec<(&StereoView, &Vector2<f64>)> = others_of(views, reference).zip(&steps).collect();
    let pairs: Vec<Pair> = others.into_par_iter().map(pair).collect();
    let hypotheses = (range[0] as f64 * per_px) as usize..(range[1] as f64 * per_px).ceil() as usize + 1;
    let matches = correlate(&pairs, region, hypotheses, options.radius);
    let owners: Vec<Owners> = pairs.par_iter().map(|pair| Owners::new(&matches, pair)).collect();
    let (width, height) = here.plane.dimensions();
    let mut disparity = Plane::from_raw(width, height, vec![f32::NAN; (width * height) as usize]).expect("one value per pixel");
    let mut confirmed = vec![0; (width * height) as usize];
    let tolerance = (f64::from(options.consistency_px) * per_px) as u16;
    let bar = Bar { uniqueness: options.uniqueness, all: (1 << owners.len()) - 1, px: (1.0 / per_px) as f32 };
    let rows = disparity.par_chunks_exact_mut(width.max(1) as usize).zip(confirmed.par_chunks_exact_mut(width.max(1) as usize));
    rows.skip(region.y[0]).take(region.height()).enumerate().for_each(|(y, (values, confirmed))| {
        let row = y * region.width()..(y + 1) * region.width();
        let (best, confirmed) = (&matches.best[row.clone()], &mut confirmed[region.x[0]..region.x[1]]);
        validate::confirm(best, &owners, y, tolerance, confirmed);
        believe_row(&bar, best, &matches.scores[row], confirmed, &mut values[region.x[0]..region.x[1]]);
    });
    validate::remove_speckles(&mut disparity, options.speckle_area_px, options.speckle_step_px);
    ViewDisparity { disparity, confirmed }
}

/// What a winner must meet.
struct Bar {
    uniqueness: f32,
    /// The bits of all other views.
    all: u8,
    /// Disparity of one hypothesis.
    px: f32,
}

/// Sub-pixel disparities of the winners of a row that stand.
fn believe_row(bar: &Bar, best: &[u16], scores: &[Scores], confirmed: &[u8], values: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { believe_row_avx2(bar, best, scores, confirmed, values) };
    }
    believe_row_plain(bar, best, scores, confirmed, values);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn believe_row_avx2(bar: &Bar, best: &[u16], scores: &[Scores], confirmed: &[u8], values: &mut [f32]) {
    believe_row_plain(bar, best, scores, confirmed, values);
}

#[inline(always)]
fn believe_row_plain(bar: &Bar, best: &[u16], scores: &[Scores], confirmed: &[u8], values: &mut [f32]) {
    for (((best, scores), confirmed), value) in best.iter().zip(scores).zip(confirmed).zip(values) {
        let ratio = if *confirmed == bar.all { bar.uniqueness } else { 2.0 * bar.uniqueness };
        let disparity = (f32::from(*best) + equiangular(*scores)) * bar.px;
        *value = if (*confirmed != 0) & validate::unique(*scores, ratio) { disparity } else { f32::NAN };
    }
}

fn others_of(views: &[StereoView], k: usize) -> impl Iterator<Item = &StereoView> {
    views.iter().enumerate().filter(move |(j, _)| *j != k).map(|(_, v)| v)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, Luma};
    use std::path::Path;

    /// A band-limited texture without repetition in view.
    fn texture(x: f64, y: f64) -> f64 {
        let wave = |a: f64, b: f64, c: f64| (a * x + b * y + c).sin();
        let sum = wave(0.9, 0.31, 0.3)
            + wave(-0.43, 0.83, 1.1)
            + wave(1.37, -0.71, 2.0)
            + wave(0.23, 1.19, 0.7)
            + wave(0.61, 0.57, 1.9)
            + wave(1.07, 1.01, 4.0);
        128.0 + 18.0 * sum + 12.0 * wave(0.171, 0.093, 0.0) * wave(0.077, -0.139, 2.0)
    }

    fn picture(f: impl Fn(f64, f64) -> f64) -> Plane {
        Plane::from_fn(200, 160, |x, y| Luma([f(f64::from(x), f64::from(y)).round() as f32]))
    }

    #[test]
    fn a_slanted_plane_is_measured_without_bias() {
        // d = a + b u + c v; the right view shows at u' = u - d what the reference shows at u, the upper one at v' = v + d.
        for (b, c) in [(0.0, 0.0), (0.05, -0.03), (-0.04, 0.06)] {
            let a = 20.3;
            let views = [
                StereoView { plane: picture(texture), step: Vector2::zeros() },
                StereoView { plane: picture(|u, v| texture((u + a + c * v) / (1.0 - b), v)), step: Vector2::new(-1.0, 0.0) },
                StereoView { plane: picture(|u, v| texture(u, (v - a - b * u) / (1.0 + c))), step: Vector2::new(0.0, 1.0) },
            ];
            let all = Region { x: [0, 200], y: [0, 160] };
            for count in [2, 3] {
                let found = match_view(&views[..count], 0, all, [5, 45], &StereoOptions::default());
                let inner = found.disparity.enumerate_pixels().filter(|(x, y, _)| (55..190).contains(x) && (10..110).contains(y));
                let errors: Vec<f64> = inner
                    .filter(|(_, _, d)| !d.0[0].is_nan())
                    .map(|(x, y, d)| f64::from(d.0[0]) - (a + b * f64::from(x) + c * f64::from(y)))
                    .collect();
                let mean = errors.iter().sum::<f64>() / errors.len() as f64;
                let absolute = errors.iter().map(|e| e.abs()).sum::<f64>() / errors.len() as f64;
                assert!(errors.len() > 12000, "{} of 13500 pixels", errors.len());
                assert!(mean.abs() < 0.05 && absolute < 0.1, "{count} views, slant {b} {c}: bias {mean}, mean error {absolute}");
            }
        }
    }

    /// Density and share of errors above 1 px on pixels seen by both cameras, against Middlebury's truth.
    fn score(disparity: &[f32], truth: &[f32]) -> (f64, f64) {
        let known = truth.iter().filter(|t| **t > 0.0).count() as f64;
        let both: Vec<f32> = disparity.iter().zip(truth).filter(|(d, t)| **d > 0.0 && **t > 0.0).map(|(d, t)| (d - t).abs()).collect();
        (both.len() as f64 / known, both.iter().filter(|e| **e > 1.0).count() as f64 / both.len() as f64)
    }

    #[test]
    fn real_pairs_are_matched_more_densely_than_by_opencv_and_no_worse() {
        use opencv::{calib3d, core, prelude::*};
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/stereo/cones-3view");
        if !folder.exists() {
            println!("skipped: {} is not there", folder.display());
            return;
        }
        let grey = |name: &str| image::open(folder.join(name)).unwrap().into_luma8();
        let (left, right) = (grey("im2.png"), grey("im6.png"));
        let (width, height) = left.dimensions();
        let plane = |g: &GrayImage| Plane::from_fn(width, height, |x, y| Luma([f32::from(g.get_pixel(x, y).0[0])]));
        let views = [
            StereoView { plane: plane(&left), step: Vector2::zeros() },
            StereoView { plane: plane(&right), step: Vector2::new(-1.0, 0.0) },
        ];
        let all = Region { x: [0, width as usize], y: [0, height as usize] };
        let ours = match_view(&views, 0, all, [0, 63], &StereoOptions::default());
        let pgm = opencv::imgcodecs::imread(folder.join("disp2.pgm").to_str().unwrap(), 0).unwrap();
        let truth: Vec<f32> = pgm.data_typed::<u8>().unwrap().iter().map(|v| f32::from(*v) / 4.0).collect();
        let mat = |g: &GrayImage| core::Mat::new_rows_cols_with_data(height as i32, width as i32, g.as_raw()).unwrap().try_clone().unwrap();
        let mut matcher = calib3d::StereoBM::create(64, 15).unwrap();
        matcher.set_disp12_max_diff(1).unwrap();
        let mut theirs = core::Mat::default();
        matcher.compute(&mat(&left), &mat(&right), &mut theirs).unwrap();
        let theirs: Vec<f32> = theirs.data_typed::<i16>().unwrap().iter().map(|v| f32::from(*v) / 16.0).collect();
        let (ours, bm) = (score(ours.disparity.as_raw(), &truth), score(&theirs, &truth));
        println!("cones: density {:.3}, above 1 px {:.4}; StereoBM {:.3}, {:.4}", ours.0, ours.1, bm.0, bm.1);
        assert!(ours.0 > bm.0 && ours.1 < bm.1, "{ours:?} {bm:?}");
    }
}

//! Where the person is: pixels that differ from the empty stage.
//!
//! With I the picture, S the stage under the picture's exposure (I ≈ gain S + offset, a robust line), σ the noise of I − S:
//!   changed:  mean over 3x3 of (I − S)² / σ² > t, connected to pixels well above t;                     (1)
//!   shadow:   in a 5x5 window I ≈ a S with one a, that is (Σ I² − a² Σ S²) / (25 σ²) ≈ 1,
//!             a = Σ I S / Σ S², over an area of some size; shadows shade the stage's texture, a person hides it. (2)
//! The person is changed and not shadow; gaps and holes are closed.
//!
//! (2) is the correlation test of Jacques, Jung and Musse (2005), "Background subtraction and shadow detection in grayscale
//! video sequences", with the residual against the noise in the place of a threshold on the correlation, so that it works
//! on plain floors too. Fails when the person covers more than half of the picture, when they look like the stage within
//! the noise, or when a plain dark garment hides a plain bright stage (taken for shadow).
//! Checked on rendered footage against true silhouettes, and on drawn pictures.

use super::regions;
use image::GrayImage;

/// Side of the window that gathers evidence of change is 2 r + 1; larger windows fatten outlines.
const CHANGE_RADIUS_PX: usize = 1;
/// A region of change needs one place this many times above the threshold; lower, noise makes regions.
const SURE_FACTOR: f32 = 2.0;
/// Windows of the shadow test; larger ones see the shadow's own slope as misfit, smaller ones see nothing but noise.
const SHADOW_RADIUS_PX: usize = 2;
/// Residual over noise up to which shadow is certain, and where it still is if connected to certain shadow.
const SHADOW_RESIDUALS: [f32; 2] = [1.7, 3.0];
/// Light that a shadow leaves; in deeper ones nothing can be told. Above 1: light where the stage's picture had a shadow.
const SHADOW_DEPTH: std::ops::Range<f32> = 0.45..1.2;
/// Certain shadow is at least this large; a person has smaller patches that look like it.
const SMALLEST_SHADOW: f64 = 5e-4;
/// Regions below this share of the picture are no person, and holes below twice of it no background.
const SMALLEST_PERSON: f64 = 5e-4;
/// Outline pixels nearer than this to the stage, in noise sigmas, are the window's fattening.
const OUTLINE_SIGMAS: f32 = 2.0;
/// The line has settled after fewer.
const EXPOSURE_STEPS: usize = 15;
/// Gaps in the person up to twice this are closed.
const CLOSE_RADIUS_PX: u32 = 3;

/// Width of the interval of grey values that count as one surface over time: four standard deviations of a noisy camera.
const STAGE_GREYS: u8 = 16;

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ForegroundOptions {
    /// t of (1); noise alone gives 1. Lower keeps weaker clothes and more noise.
    pub threshold: f64,
    /// Whether the shadow test (2) is done.
    pub remove_shadows: bool,
}

impl Default for ForegroundOptions {
    fn default() -> Self {
        ForegroundOptions { threshold: 3.0, remove_shadows: true }
    }
}

/// The mask (0 or 255) of what stands before the stage; pictures of one size, else nothing is foreground.
pub fn foreground(image: &GrayImage, stage: &GrayImage, options: &ForegroundOptions) -> GrayImage {
    if image.dimensions() != stage.dimensions() || image.is_empty() {
        return GrayImage::new(image.width(), image.height());
    }
    let view = View::new(image, stage);
    let changed = changed(&view, options.threshold as f32);
    let mut person = changed.clone();
    if options.remove_shadows {
        let shadow = shadow(&view, &changed);
        person.iter_mut().zip(shadow.iter()).for_each(|(p, s)| *p &= !s);
    }
    let person = regions::close(&regions::open(&trim_outline(&view, &person), 2), 2);
    let person = regions::fill_holes(&person, view.share_px(2.0 * SMALLEST_PERSON));
    regions::keep_large(&person, view.share_px(SMALLEST_PERSON))
}

/// The stage from pictures of one size with somebody in them: at each pixel the mean of the most frequent grey values.
///
/// Of all intervals of [`STAGE_GREYS`] the one that holds most of the pixel's values (a mean shift of the densest place), so
/// the stage need not show in half of the pictures, only more often than anything else. Works when the person moves through
/// the view and `frames` are spread over that time ([`spread`]); who stands still for longer than the place is free becomes
/// part of the stage. `None` without pictures or with pictures of different sizes.
///
/// Tried beside it on the rendered sessions, 25 frames, pixels off by more than 10 grey levels where the person ever was, the
/// last figures with the person standing still for a third of the clip:
///
/// | | p12 | p35 | p39 | p02 | p12 still | p35 still | p39 still | p02 still |
/// |---|---|---|---|---|---|---|---|---|
/// | densest interval | 0.0 % | 0.4 % | 0.0 % | 0.0 % | 3.3 % | 6.0 % | 0.8 % | 1.2 % |
/// | median | 0.9 % | 1.1 % | 0.0 % | 0.0 % | 3.9 % | 11.3 % | 1.0 % | 0.4 % |
/// | half-sample mode | 0.2 % | 0.7 % | 0.0 % | 0.0 % | 3.6 % | 8.2 % | 1.0 % | 1.2 % |
/// | OpenCV's MOG2, all frames | 5.3 % | 13.0 % | 2.2 % | 1.5 % | 7.9 % | 19.4 % | 6.1 % | 3.7 % |
pub fn stage_from_frames(frames: &[GrayImage]) -> Option<GrayImage> {
    let first = frames.first()?;
    if frames.iter().any(|f| f.dimensions() != first.dimensions()) {
        return None;
    }
    let mut values = vec![0u8; frames.len()];
    let pixels = (0..first.len()).map(|i| {
        values.iter_mut().zip(frames).for_each(|(value, frame)| *value = frame.as_raw()[i]);
        values.sort_unstable();
        densest_mean(&values)
    });
    Some(regions::with_pixels(first, pixels.collect()))
}

/// Mean of the values around the densest interval of a sorted list; the lowest of equally dense ones.
fn densest_mean(sorted: &[u8]) -> u8 {
    let (mut low, mut most, mut end) = (0, 0, 0);
    for (start, &value) in sorted.iter().enumerate() {
        while end < sorted.len() && sorted[end] - value <= STAGE_GREYS {
            end += 1;
        }
        if end - start > most {
            (low, most) = (start, end - start);
        }
    }
    let mean = |values: &[u8]| values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len().max(1) as f64;
    let middle = mean(&sorted[low..low + most]);
    let near: Vec<u8> = sorted.iter().copied().filter(|&v| (f64::from(v) - middle).abs() <= f64::from(STAGE_GREYS / 2)).collect();
    mean(&near).round() as u8
}

/// At most `wanted` positions spread evenly over `count`, first and last included.
pub fn spread(count: usize, wanted: usize) -> Vec<usize> {
    if count <= wanted {
        return (0..count).collect();
    }
    let steps = wanted.saturating_sub(1).max(1);
    (0..wanted).map(|i| i * (count - 1) / steps).collect()
}

/// Picture and stage as floats, under one exposure.
struct View<'a> {
    picture: &'a GrayImage,
    image: Vec<f32>,
    stage: Vec<f32>,
    /// Noise of their difference, grey levels.
    sigma: f32,
}

impl View<'_> {
    fn new<'a>(image: &'a GrayImage, stage: &GrayImage) -> View<'a> {
        let (gain, offset, sigma) = exposure(image, stage);
        let stage = stage.iter().map(|&s| (gain * f64::from(s) + offset) as f32).collect();
        View { picture: image, image: image.iter().map(|&p| f32::from(p)).collect(), stage, sigma: sigma as f32 }
    }

    fn share_px(&self, share: f64) -> usize {
        (share * self.image.len() as f64) as usize
    }

    fn mask(&self, inside: impl Iterator<Item = bool>) -> GrayImage {
        regions::with_pixels(self.picture, inside.map(|i| if i { 255 } else { 0 }).collect())
    }

    fn mean(&self, values: impl Iterator<Item = f32>, radius_px: usize) -> Vec<f32> {
        box_mean(&values.collect::<Vec<_>>(), self.picture.width() as usize, radius_px)
    }
}

/// Gain, offset and noise σ of I ≈ gain S + offset: least squares over the pixels within 2.5 σ of the last line, σ first
/// from the median distance, then from those pixels, as the median feels the person.
fn exposure(image: &GrayImage, stage: &GrayImage) -> (f64, f64, f64) {
    // A prime stride samples all columns; 20 000 pixels are plenty for two numbers.
    let stride = if image.len() > 200_000 { 13 } else { 1 };
    let pairs: Vec<(f64, f64)> = stage.iter().zip(image.iter()).step_by(stride).map(|(&s, &i)| (f64::from(s), f64::from(i))).collect();
    let mut differences: Vec<f64> = pairs.iter().map(|(s, i)| i - s).collect();
    let middle = differences.len() / 2;
    let (mut gain, mut offset) = (1.0, *differences.select_nth_unstable_by(middle, f64::total_cmp).1);
    let mut distances: Vec<f64> = differences.iter().map(|d| (d - offset).abs()).collect();
    let mut sigma = (1.4826 * *distances.select_nth_unstable_by(middle, f64::total_cmp).1).max(1.5);
    for _ in 0..EXPOSURE_STEPS {
        let near: Vec<_> = pairs.iter().filter(|(s, i)| (i - gain * s - offset).abs() < 2.5 * sigma).copied().collect();
        (gain, offset) = line_through(&near).unwrap_or((gain, offset));
        let squares: f64 = near.iter().map(|(s, i)| (i - gain * s - offset).powi(2)).sum();
        // A normal distribution cut at 2.5 σ has 0.9546 of its σ left; rounding alone leaves 0.3.
        sigma = ((squares / near.len().max(1) as f64).sqrt() / 0.9546).max(0.5);
    }
    (gain, offset, sigma)
}

/// Least squares gain and offset of (S, I) pairs; `None` for one grey level, which tells no gain.
fn line_through(pairs: &[(f64, f64)]) -> Option<(f64, f64)> {
    let mut sums = [0.0; 4];
    for (s, i) in pairs {
        [s * s, *s, s * i, *i].iter().zip(&mut sums).for_each(|(x, sum)| *sum += x);
    }
    let (n, [ss, s, si, i]) = (pairs.len() as f64, sums);
    let determinant = n * ss - s * s;
    (determinant > 1e-3 * n * n).then(|| ((n * si - s * i) / determinant, (ss * i - s * si) / determinant))
}

/// Equation (1).
fn changed(view: &View, threshold: f32) -> GrayImage {
    let squares = view.image.iter().zip(&view.stage).map(|(i, s)| (i - s) * (i - s));
    let energy = view.mean(squares, CHANGE_RADIUS_PX);
    let variance = view.sigma * view.sigma;
    let above = |t: f32| view.mask(energy.iter().map(move |e| *e > t * variance));
    let seeded = regions::keep_seeded(&above(threshold), &above(SURE_FACTOR * threshold));
    let closed = regions::close(&regions::open(&seeded, 1), CLOSE_RADIUS_PX);
    regions::fill_holes(&closed, view.share_px(2.0 * SMALLEST_PERSON))
}

/// Equation (2) within the changed pixels.
fn shadow(view: &View, changed: &GrayImage) -> GrayImage {
    let (image, stage) = (|| view.image.iter(), || view.stage.iter());
    let ii = view.mean(image().map(|i| i * i), SHADOW_RADIUS_PX);
    let ss = view.mean(stage().map(|s| s * s), SHADOW_RADIUS_PX);
    let is = view.mean(image().zip(stage()).map(|(i, s)| i * s), SHADOW_RADIUS_PX);
    let variance = view.sigma * view.sigma;
    let residual = |k: usize| {
        let a = is[k] / ss[k].max(1.0);
        // σ² is the noise of both pictures together; of I − a S it is this part.
        let expected = variance * (1.0 + a * a) / 2.0;
        if SHADOW_DEPTH.contains(&a) { (ii[k] - a * a * ss[k]) / expected } else { f32::INFINITY }
    };
    let residuals: Vec<f32> = changed.iter().enumerate().map(|(k, &c)| if c > 0 { residual(k) } else { f32::INFINITY }).collect();
    let [certain, possible] = SHADOW_RESIDUALS.map(|limit| view.mask(residuals.iter().map(move |r| *r < limit)));
    let certain = regions::keep_large(&regions::open(&certain, 1), view.share_px(SMALLEST_SHADOW));
    regions::keep_seeded(&possible, &certain)
}

/// Removes outline pixels that differ from the stage no more than noise does.
fn trim_outline(view: &View, person: &GrayImage) -> GrayImage {
    let inner = regions::erode(person, 1);
    let differs = view.image.iter().zip(&view.stage).map(|(i, s)| (i - s).abs() > OUTLINE_SIGMAS * view.sigma);
    view.mask(person.iter().zip(inner.iter()).zip(differs).map(|((&p, &inner), differs)| p > 0 && (inner > 0 || differs)))
}

/// Means over windows of side 2 r + 1, cut at the border; `values` in rows of `width`.
pub(super) fn box_mean(values: &[f32], width: usize, radius_px: usize) -> Vec<f32> {
    let height = values.len() / width.max(1);
    let window = |at: usize, end: usize| at.saturating_sub(radius_px)..(at + radius_px + 1).min(end);
    let mut across = vec![0.0; values.len()];
    for (line, row) in across.chunks_exact_mut(width).zip(values.chunks_exact(width)) {
        for (x, mean) in line.iter_mut().enumerate() {
            let window = &row[window(x, width)];
            *mean = window.iter().sum::<f32>() / window.len() as f32;
        }
    }
    let mut means = vec![0.0f32; values.len()];
    for (y, line) in means.chunks_exact_mut(width).enumerate() {
        let rows = window(y, height);
        let weight = 1.0 / rows.len() as f32;
        for row in rows {
            line.iter_mut().zip(&across[row * width..]).for_each(|(mean, x)| *mean += weight * x);
        }
    }
    means
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use std::path::{Path, PathBuf};

    /// Recall, precision and intersection over union.
    fn scores(found: &GrayImage, truth: &GrayImage) -> [f64; 3] {
        let both = found.iter().zip(truth.iter()).filter(|(f, t)| **f > 127 && **t > 127).count() as f64;
        let (f, t) = (regions::area_px(found) as f64, regions::area_px(truth) as f64);
        [both / t, both / f.max(1.0), both / (f + t - both)]
    }

    /// A stage of weak smooth texture, a person of other texture, a shadow beside, noise of 2 grey levels on both.
    fn drawn(gain: f64, offset: f64, person_contrast: f64) -> [GrayImage; 3] {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let mut noise = move || (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>() * 2.0;
        let stage = |x: f64, y: f64| 120.0 + 25.0 * (x / 9.0).sin() * (y / 7.0).cos();
        let inside = |x: f64, y: f64| ((x - 100.0) / 25.0).powi(2) + ((y - 80.0) / 55.0).powi(2) < 1.0;
        let in_shadow = |x: f64, y: f64| ((x - 130.0) / 40.0).powi(2) + ((y - 130.0) / 12.0).powi(2) < 1.0;
        let pixel = |value: f64| image::Luma([value.round().clamp(0.0, 255.0) as u8]);
        let picture = |f: &mut dyn FnMut(f64, f64) -> f64| GrayImage::from_fn(240, 160, |x, y| pixel(f(f64::from(x), f64::from(y))));
        let empty = picture(&mut |x, y| stage(x, y) + noise());
        let seen = picture(&mut |x, y| {
            let light = match (inside(x, y), in_shadow(x, y)) {
                (true, _) => 120.0 + person_contrast + 35.0 * (x / 2.0).sin() * (y / 2.5).cos(),
                (false, true) => 0.75 * stage(x, y),
                _ => stage(x, y),
            };
            gain * light + offset + noise()
        });
        [seen, empty, picture(&mut |x, y| if inside(x, y) { 255.0 } else { 0.0 })]
    }

    #[test]
    fn a_person_is_found_under_another_exposure_and_the_shadow_is_not() {
        for (gain, offset, contrast) in [(1.0, 0.0, 30.0), (1.15, -12.0, -35.0), (1.0, 0.0, 9.0)] {
            let [image, stage, truth] = drawn(gain, offset, contrast);
            let (found_gain, found_offset, sigma) = exposure(&image, &stage);
            assert!((found_gain - gain).abs() < 0.03 && (found_offset - offset).abs() < 4.0, "{found_gain} {found_offset}");
            assert!((sigma - 2.0 * (1.0 + gain * gain).sqrt()).abs() < 0.5, "{sigma}");
            let [recall, precision, _] = scores(&foreground(&image, &stage, &ForegroundOptions::default()), &truth);
            assert!(recall > 0.9 && precision > 0.88, "contrast {contrast}: recall {recall}, precision {precision}");
            let with_shadow = ForegroundOptions { remove_shadows: false, ..Default::default() };
            let [_, precision, _] = scores(&foreground(&image, &stage, &with_shadow), &truth);
            assert!(precision < 0.8, "{precision}");
        }
    }

    #[test]
    fn an_empty_stage_has_no_foreground() {
        let [_, stage, _] = drawn(1.0, 0.0, 0.0);
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let noisy = GrayImage::from_fn(240, 160, |x, y| {
            let noise = (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>() * 2.0;
            image::Luma([(f64::from(stage.get_pixel(x, y).0[0]) + noise).round() as u8])
        });
        assert_eq!(regions::area_px(&foreground(&noisy, &stage, &ForegroundOptions::default())), 0);
        assert_eq!(regions::area_px(&foreground(&stage, &stage, &ForegroundOptions::default())), 0);
        let plain = GrayImage::from_pixel(64, 48, image::Luma([90]));
        assert_eq!(regions::area_px(&foreground(&plain, &plain, &ForegroundOptions::default())), 0);
    }

    #[test]
    fn the_most_frequent_grey_over_time_is_the_stage() {
        let frames: Vec<_> =
            (0..5).map(|k| GrayImage::from_fn(50, 10, |x, _| image::Luma([if x / 10 == k { 250 } else { 40 + (x % 7) as u8 }]))).collect();
        let stage = stage_from_frames(&frames).unwrap();
        assert!(stage.enumerate_pixels().all(|(x, _, p)| p.0[0] == 40 + (x % 7) as u8));
        assert!(stage_from_frames(&[]).is_none());
        assert!(stage_from_frames(&[GrayImage::new(2, 2), GrayImage::new(2, 3)]).is_none());
        assert_eq!(spread(5, 25), [0, 1, 2, 3, 4]);
        assert_eq!(spread(101, 5), [0, 25, 50, 75, 100]);
        assert_eq!(densest_mean(&[10, 80, 81, 83, 120, 200, 240]), 81);
        assert_eq!(densest_mean(&[7]), 7);
    }

    /// A person of moving texture crosses a stage, stands still for a third of the 60 frames and walks on; noise of 2.
    fn pausing() -> (Vec<GrayImage>, GrayImage) {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        let stage = |x: f64, y: f64| 120.0 + 25.0 * (x / 9.0).sin() * (y / 7.0).cos();
        let mut picture = |place: f64, noise: f64| {
            GrayImage::from_fn(160, 60, |x, y| {
                let (x, y) = (f64::from(x), f64::from(y));
                let body = 110.0 + 45.0 * ((x - place) / 3.0).sin() * (y / 4.0).cos();
                let grey = if (x - place).abs() < 12.0 && y > 8.0 { body } else { stage(x, y) };
                let normal = (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>();
                image::Luma([(grey + noise * normal).round() as u8])
            })
        };
        let place = |k: usize| if k < 20 { 4.0 * k as f64 } else { 80.0 + 4.0 * (k as f64 - 40.0).max(0.0) };
        ((0..60).map(|k| picture(place(k), 2.0)).collect(), picture(-99.0, 0.0))
    }

    #[test]
    fn who_stands_still_for_a_third_of_the_time_does_not_become_the_stage() {
        use opencv::{core::Mat, prelude::*, video};
        let (frames, empty) = pausing();
        let error = |stage: &[u8]| stage.iter().zip(empty.iter()).filter(|(a, b)| a.abs_diff(**b) > 10).count() as f64 / empty.len() as f64;
        let chosen: Vec<GrayImage> = spread(60, 25).into_iter().map(|k| frames[k].clone()).collect();
        let ours = error(&stage_from_frames(&chosen).unwrap());
        let mut mixture = video::create_background_subtractor_mog2(60, 16.0, false).unwrap();
        for frame in &frames {
            let picture = Mat::new_rows_cols_with_data(60, 160, frame.as_raw()).unwrap();
            BackgroundSubtractorMOG2Trait::apply(&mut mixture, &picture, &mut Mat::default(), -1.0).unwrap();
        }
        let mut background = Mat::default();
        BackgroundSubtractorTraitConst::get_background_image(&mixture, &mut background).unwrap();
        let theirs = error(background.data_bytes().unwrap());
        let middle = error(&frames[30]);
        println!("pixels off: {ours:.4}, MOG2 {theirs:.4}, one frame {middle:.4}");
        assert!(ours < 0.002 && ours < theirs && middle > 0.05);
    }

    #[test]
    fn box_means_are_means_over_the_window() {
        let values: Vec<f32> = (0..35).map(|i| ((i * i) % 17) as f32).collect();
        let means = box_mean(&values, 7, 2);
        for (at, mean) in means.iter().enumerate() {
            let (x, y) = (at % 7, at / 7);
            let window: Vec<f32> =
                (0..35usize).filter(|k| (k % 7).abs_diff(x) <= 2 && (k / 7).abs_diff(y) <= 2).map(|k| values[k]).collect();
            assert!((mean - window.iter().sum::<f32>() / window.len() as f32).abs() < 1e-4);
        }
    }

    fn load(path: &Path) -> GrayImage {
        image::open(path).unwrap().into_luma8()
    }

    /// Sessions of the development footage with their true silhouettes of camera 0.
    fn footage() -> Vec<(PathBuf, Vec<PathBuf>)> {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/footage");
        let files = |folder: &Path| {
            let mut files: Vec<_> = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
            files.sort();
            files
        };
        if !data.exists() {
            println!("skipped: no {}", data.display());
        }
        files(&data).into_iter().filter(|p| p.is_dir()).map(|p| (p.clone(), files(&p.join("truth/mask_cam_00")))).collect()
    }

    fn mean_scores(session: &Path, masks: &[PathBuf], stage: &GrayImage, options: &ForegroundOptions) -> [f64; 3] {
        let mut means = [0.0; 3];
        for mask in masks {
            let picture = session.join("cam_00").join(mask.file_stem().unwrap()).with_extension("jpg");
            let scores = scores(&foreground(&load(&picture), stage, options), &load(mask));
            means.iter_mut().zip(scores).for_each(|(mean, s)| *mean += s / masks.len() as f64);
        }
        means
    }

    #[test]
    fn rendered_people_are_found() {
        for (session, masks) in footage() {
            let stage = load(&session.join("cam_00_background.png"));
            let plain = ForegroundOptions { remove_shadows: false, ..Default::default() };
            let with_shadow = mean_scores(&session, &masks, &stage, &plain);
            let [recall, precision, iou] = mean_scores(&session, &masks, &stage, &ForegroundOptions::default());
            println!("{}: with shadow {with_shadow:.3?}, without {:.3?}", session.display(), [recall, precision, iou]);
            assert!(recall > 0.98 && precision > 0.8, "{}", session.display());
            assert!(recall > with_shadow[0] - 0.02 && precision > with_shadow[1] + 0.1, "{}", session.display());
        }
    }

    #[test]
    fn a_stage_from_the_frames_serves_as_well() {
        for (session, masks) in footage() {
            if !session.ends_with("p12_walk_lab") {
                continue;
            }
            let frames: Vec<_> = spread(52, 25).iter().map(|i| load(&session.join(format!("cam_00/{i:06}.jpg")))).collect();
            let stage = stage_from_frames(&frames).unwrap();
            let [recall, precision, iou] = mean_scores(&session, &masks, &stage, &ForegroundOptions::default());
            println!("stage from frames: {:.3?}", [recall, precision, iou]);
            assert!(recall > 0.9 && precision > 0.82);
        }
    }
}

//! What footage lets one expect before any long work: is somebody in view, do they move, is the light usable, does the
//! calibration fit, are the cameras simultaneous.
//!
//! All frames are looked at once, reduced; the rest is measured at some instants. A lens out of focus leaves less detail
//! (pixels against their neighbours, as a share of the contrast) than the other cameras have of the same stage.

use super::epipolar::PairResidual;
use super::foreground::{ForegroundOptions, foreground};
use super::reduce::{reduced, reduction};
use super::synchrony::{Offset, Signatures};
use super::{FrameSet, regions};
use crate::math::order::quantile;
use crate::rig::Rig;
use image::GrayImage;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Calibrations leave some tenths of a pixel, matches add one; half a pixel starts to cost matches and depth.
const MISFIT_PX: f64 = 0.5;
/// Correlation windows beyond this distance from the true line see something else.
const UNUSABLE_PX: f64 = 2.0;
/// A median of fewer matches says little.
const FEWEST_MATCHES: usize = 20;
/// Frames held in memory at once.
const CHUNK: usize = 16;
/// Mean grey below which a picture counts as dark.
const DARK_GREY: f64 = 15.0;
/// Share of pixels at 250 or more above which a picture counts as overexposed.
const BRIGHT_SHARE: f64 = 0.25;
/// Masks that overlap more than this in every frame show nobody moving.
const STILL_OVERLAP: f64 = 0.9;
/// Standard deviation of grey levels below which a picture shows nothing.
const EVEN_GREY: f64 = 3.0;
/// A camera with less than this share of the others' relative detail is out of focus.
const BLUR_SHARE: f64 = 0.5;
/// Cameras further apart in time are refused; what is left after whole frames are cut is less.
const LARGEST_OFFSET: f64 = 0.5;
/// Smaller offsets do no harm: 3 ms at 30 frames per second move a foot by a centimetre.
const HARMLESS_OFFSET: f64 = 0.1;
/// Offsets within this many standard deviations of zero may be none.
const SIGNIFICANT: f64 = 3.0;

/// What was seen by one camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraFacts {
    /// Mean share of foreground pixels.
    pub foreground_share: f64,
    /// Frames without any foreground.
    pub empty_frames: usize,
    pub dark_frames: usize,
    pub overexposed_frames: usize,
    /// Smallest intersection over union of a frame's mask with the first one that is not empty.
    pub least_overlap: f64,
    /// Standard deviation of the stage's grey levels.
    pub contrast_grey: f64,
    /// Detail of the stage over its contrast.
    pub detail: f64,
}

/// What was seen in all frames.
pub struct Survey {
    pub frames: usize,
    pub cameras: Vec<CameraFacts>,
    /// Numbers of the frames in which every camera sees somebody, ascending.
    pub together: Vec<usize>,
    pub signatures: Signatures,
}

/// Looks at all frames against the stage pictures (one per camera of the rig).
pub fn survey<E>(frames: impl Iterator<Item = Result<FrameSet, E>>, rig: &Rig, stages: &[GrayImage]) -> Result<Survey, E> {
    let factors: Vec<u32> = rig.cameras.iter().map(|c| reduction(c.size_px)).collect();
    let stages: Vec<GrayImage> = stages.iter().zip(&factors).map(|(s, f)| reduced(s, *f)).collect();
    let mut survey = Survey {
        frames: 0,
        cameras: stages.iter().map(CameraFacts::of_stage).collect(),
        together: Vec::new(),
        signatures: Signatures::new(rig),
    };
    let mut first_masks = vec![None; stages.len()];
    let mut frames = frames.peekable();
    while frames.peek().is_some() {
        let chunk = frames.by_ref().take(CHUNK).collect::<Result<Vec<_>, E>>()?;
        let look = |frame: &FrameSet| {
            let images: Vec<GrayImage> = frame.images.iter().zip(&factors).map(|(i, f)| reduced(i, *f)).collect();
            let masks = masks(&images, &stages);
            let signature = survey.signatures.signature(&masks);
            (images, masks, signature)
        };
        let seen: Vec<_> = chunk.par_iter().map(look).collect();
        for (frame, (images, masks, signature)) in chunk.iter().zip(seen) {
            for (k, (image, mask)) in images.iter().zip(&masks).enumerate() {
                survey.cameras[k].add(image, mask, &mut first_masks[k]);
            }
            if masks.iter().all(|m| regions::area_px(m) > 0) {
                survey.together.push(frame.number);
            }
            survey.signatures.push(frame.number, signature);
            survey.frames += 1;
        }
    }
    survey.cameras.iter_mut().for_each(|c| c.foreground_share /= survey.frames.max(1) as f64);
    Ok(survey)
}

/// What stands before the stages, one mask per picture.
pub fn masks(images: &[GrayImage], stages: &[GrayImage]) -> Vec<GrayImage> {
    images.iter().zip(stages).map(|(image, stage)| foreground(image, stage, &ForegroundOptions::default())).collect()
}

impl CameraFacts {
    fn of_stage(stage: &GrayImage) -> CameraFacts {
        let (contrast_grey, detail) = contrast_and_detail(stage);
        CameraFacts { least_overlap: 1.0, contrast_grey, detail, ..Default::default() }
    }

    fn add(&mut self, image: &GrayImage, mask: &GrayImage, first: &mut Option<GrayImage>) {
        let pixels = image.len().max(1) as f64;
        let area_px = regions::area_px(mask);
        self.foreground_share += area_px as f64 / pixels;
        self.empty_frames += usize::from(area_px == 0);
        let mean = image.iter().map(|&p| f64::from(p)).sum::<f64>() / pixels;
        self.dark_frames += usize::from(mean < DARK_GREY);
        self.overexposed_frames += usize::from(image.iter().filter(|&&p| p >= 250).count() as f64 > BRIGHT_SHARE * pixels);
        match first {
            Some(first) => self.least_overlap = self.least_overlap.min(overlap(first, mask)),
            None if area_px > 0 => *first = Some(mask.clone()),
            None => {}
        }
    }
}

/// Standard deviation of the grey levels, and of pixels against the mean of their four neighbours as a share of it.
fn contrast_and_detail(image: &GrayImage) -> (f64, f64) {
    let n = image.len().max(1) as f64;
    let mean = image.iter().map(|&p| f64::from(p)).sum::<f64>() / n;
    let contrast = (image.iter().map(|&p| (f64::from(p) - mean).powi(2)).sum::<f64>() / n).sqrt();
    let (width, height) = (image.width() as usize, image.height() as usize);
    let at = |x: usize, y: usize| f64::from(image.as_raw()[y * width + x]);
    let stands_out = |x: usize, y: usize| at(x, y) - (at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1)) / 4.0;
    let inner = (1..height.saturating_sub(1)).flat_map(|y| (1..width.saturating_sub(1)).map(move |x| (x, y)));
    let squares: f64 = inner.map(|(x, y)| stands_out(x, y).powi(2)).sum();
    (contrast, (squares / n).sqrt() / contrast.max(1.0))
}

/// Intersection over union.
fn overlap(a: &GrayImage, b: &GrayImage) -> f64 {
    let both = a.iter().zip(b.iter()).filter(|(a, b)| **a > 0 && **b > 0).count();
    let either = a.iter().zip(b.iter()).filter(|(a, b)| **a > 0 || **b > 0).count();
    both as f64 / either.max(1) as f64
}

impl Survey {
    /// Whether any camera sees somebody in any frame.
    pub fn somebody_in_view(&self) -> bool {
        self.cameras.iter().any(|c| c.empty_frames < self.frames)
    }

    /// What the user should know, one sentence each.
    pub fn warnings(&self, rig: &Rig) -> Vec<String> {
        let all = self.frames;
        let mut warnings = Vec::new();
        for (camera, facts) in rig.cameras.iter().zip(&self.cameras) {
            let mut warn = |count: usize, what: &str| {
                if count > 0 {
                    warnings.push(format!("{}: {what} in {count} of {all} frames", camera.name));
                }
            };
            warn(facts.empty_frames, "nobody is in view");
            warn(facts.dark_frames, "almost no light");
            warn(facts.overexposed_frames, "more than a quarter of the picture is overexposed");
            if facts.foreground_share > 0.4 {
                let share = 100.0 * facts.foreground_share;
                warnings.push(format!(
                    "{}: {share:.0} % of the pictures differ from the empty stage; was the camera or the light moved?",
                    camera.name
                ));
            }
        }
        warnings.extend(self.blurred(rig));
        if all > 1 && self.somebody_in_view() && self.cameras.iter().all(|c| c.least_overlap > STILL_OVERLAP) {
            warnings.push("nothing moves in these pictures; a motion cannot be measured from them".into());
        }
        warnings
    }

    /// Why no tracking can come of this footage.
    pub fn refusal(&self, rig: &Rig) -> Option<String> {
        let (camera, facts) = rig.cameras.iter().zip(&self.cameras).find(|(_, facts)| facts.contrast_grey < EVEN_GREY)?;
        let grey = facts.contrast_grey;
        Some(format!(
            "{}: shows nothing but an even grey (contrast of {grey:.1} grey levels); take off the lens cap, switch on the light, or focus",
            camera.name
        ))
    }

    /// The first camera that is out of focus, with the remedy.
    pub fn blurred(&self, rig: &Rig) -> Option<String> {
        let usual = self.usual_detail();
        let blurred = |facts: &CameraFacts| facts.contrast_grey >= EVEN_GREY && facts.detail < BLUR_SHARE * usual;
        let (camera, facts) = rig.cameras.iter().zip(&self.cameras).find(|(_, facts)| blurred(facts))?;
        let share = 100.0 * facts.detail / usual;
        Some(format!("{}: shows {share:.0} % of the detail that the other cameras see; focus its lens", camera.name))
    }

    /// The upper median of the cameras' detail.
    fn usual_detail(&self) -> f64 {
        quantile(self.cameras.iter().map(|c| c.detail).collect(), 0.5).unwrap_or(0.0)
    }
}

/// How a residual is judged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fit {
    /// Too few matches.
    Unknown,
    Good,
    /// Usable, but worth a new calibration.
    Loose,
    Unusable,
}

impl Fit {
    pub fn of(residual: &PairResidual) -> Fit {
        match residual.median_px.filter(|_| residual.matches >= FEWEST_MATCHES) {
            None => Fit::Unknown,
            Some(px) if px > UNUSABLE_PX => Fit::Unusable,
            Some(px) if px > MISFIT_PX => Fit::Loose,
            Some(_) => Fit::Good,
        }
    }
}

/// What the times of the cameras mean: a refusal, and warnings.
pub fn judge_offsets(rig: &Rig, offsets: &[Option<Offset>], fps: f64) -> (Option<String>, Vec<String>) {
    let name = |k: usize| rig.cameras[k].name.as_str();
    let known: Vec<(usize, Offset)> = offsets.iter().enumerate().filter_map(|(k, o)| Some((k, (*o)?))).collect();
    let significant = |o: &Offset, limit: f64| o.frames.abs() > limit && o.frames.abs() > SIGNIFICANT * o.sigma;
    let text = |k: usize, o: &Offset| {
        let side = if o.frames > 0.0 { "after" } else { "before" };
        let (frames, ms) = (o.frames.abs(), 1e3 * o.frames.abs() / fps);
        format!("{}: its pictures were taken {frames:.2} +- {:.2} frames ({ms:.0} ms) {side} those of the same number", name(k), o.sigma)
    };
    let late = known.iter().filter(|(_, o)| significant(o, LARGEST_OFFSET)).max_by(|a, b| a.1.frames.abs().total_cmp(&b.1.frames.abs()));
    let refusal = late.map(|(k, o)| format!("{}; {}", text(*k, o), remedy(rig, &known)));
    let mut warnings: Vec<String> = known
        .iter()
        .filter(|(_, o)| significant(o, HARMLESS_OFFSET) && !significant(o, LARGEST_OFFSET))
        .map(|(k, o)| format!("{}; fast limbs will be blurred, use a trigger", text(*k, o)))
        .collect();
    warnings.extend((0..offsets.len()).filter(|&k| offsets[k].is_none()).map(|k| {
        format!("{}: the motion does not tell when its pictures were taken; film somebody who walks or jumps to be sure", name(k))
    }));
    (refusal, warnings)
}

/// Which cameras must lose how many frames at their start.
fn remedy(rig: &Rig, known: &[(usize, Offset)]) -> String {
    let latest = known.iter().map(|(_, o)| o.frames).fold(f64::NEG_INFINITY, f64::max);
    let mut cuts: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
    known.iter().for_each(|(k, o)| cuts.entry((latest - o.frames).round() as usize).or_default().push(&rig.cameras[*k].name));
    let frames = |count: usize| if count == 1 { "frame".into() } else { format!("{count} frames") };
    let texts = cuts
        .iter()
        .filter(|(count, _)| **count > 0)
        .map(|(&count, names)| format!("the first {} of {}", frames(count), names.join(" and ")));
    format!("cut {} and number all from the same again, or start the cameras with one trigger", texts.collect::<Vec<_>>().join(" and "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::{Camera, Up};
    use nalgebra::{Matrix3, Rotation3, Vector3};
    use std::convert::Infallible;

    fn stage() -> GrayImage {
        GrayImage::from_fn(120, 90, |x, y| image::Luma([(90 + (x * 7 + y * 13) % 40) as u8]))
    }

    /// The stage with a bright square whose left edge is at `x`.
    fn with_square(x: u32) -> GrayImage {
        let mut image = stage();
        image.enumerate_pixels_mut().filter(|(u, v, _)| (x..x + 20).contains(u) && (30..60).contains(v)).for_each(|(_, _, p)| p.0[0] = 230);
        image
    }

    fn rig() -> Rig {
        let camera = |name: &str| Camera {
            name: name.into(),
            size_px: [120, 90],
            matrix: Matrix3::new(100.0, 0.0, 60.0, 0.0, 100.0, 45.0, 0.0, 0.0, 1.0),
            lens: crate::rig::Lens::IDEAL,
            camera_from_world: Rotation3::identity(),
            translation: Vector3::zeros(),
        };
        Rig { cameras: vec![camera("cam_00"), camera("cam_01")], up: Up::Z }
    }

    fn look(images: Vec<[GrayImage; 2]>) -> Survey {
        let frames =
            images.into_iter().enumerate().map(|(number, i)| Ok::<_, Infallible>(FrameSet { number, time_s: 0.0, images: i.into() }));
        survey(frames, &rig(), &[stage(), stage()]).unwrap()
    }

    #[test]
    fn a_moving_square_is_measured_and_an_empty_camera_named() {
        let survey = look((0..20).map(|i| [with_square(10 + 3 * i), stage()]).collect());
        assert!((survey.cameras[0].foreground_share - 600.0 / 10800.0).abs() < 0.006, "{:?}", survey.cameras[0]);
        assert_eq!((survey.frames, survey.cameras[0].empty_frames, survey.cameras[1].empty_frames), (20, 0, 20));
        assert!(survey.together.is_empty());
        assert_eq!(survey.warnings(&rig()), ["cam_01: nobody is in view in 20 of 20 frames"]);
    }

    #[test]
    fn stillness_darkness_and_an_empty_stage_are_noticed() {
        let still = look(vec![[with_square(30), with_square(40)], [with_square(30), with_square(40)]]);
        assert!(still.warnings(&rig())[0].starts_with("nothing moves"));
        assert!(!look(vec![[stage(), stage()]]).somebody_in_view());
        let dark = look(vec![[GrayImage::new(120, 90), GrayImage::from_pixel(120, 90, image::Luma([255]))]]);
        assert_eq!((dark.cameras[0].dark_frames, dark.cameras[1].overexposed_frames), (1, 1));
    }

    #[test]
    fn caps_and_blur_are_named_and_exposure_is_not() {
        let frames = || std::iter::empty::<Result<FrameSet, Infallible>>();
        let looked = |other: GrayImage| survey(frames(), &rig(), &[stage(), other]).unwrap();
        let even = looked(GrayImage::from_fn(120, 90, |x, y| image::Luma([4 + ((7 * x + 3 * y) % 3) as u8])));
        let refusal = even.refusal(&rig()).unwrap();
        assert!(refusal.starts_with("cam_01: shows nothing but an even grey (contrast of 0.8 grey levels)"), "{refusal}");
        let slope = looked(GrayImage::from_fn(120, 90, |x, y| image::Luma([(60 + x + (x + y) % 2) as u8])));
        let blurred = slope.blurred(&rig()).unwrap();
        assert!(slope.refusal(&rig()).is_none() && blurred.contains("of the detail that the other cameras see; focus"), "{blurred}");
        let brighter = looked(GrayImage::from_fn(120, 90, |x, y| image::Luma([(f64::from(stage().get_pixel(x, y).0[0]) * 1.3) as u8])));
        assert_eq!((brighter.refusal(&rig()), brighter.blurred(&rig())), (None, None));
    }

    #[test]
    fn residuals_are_judged_by_matches_and_distance() {
        let fit = |matches, px| Fit::of(&PairResidual { first: 0, second: 1, matches, median_px: px });
        assert_eq!([fit(99, Some(0.3)), fit(99, Some(0.9)), fit(99, Some(2.5))], [Fit::Good, Fit::Loose, Fit::Unusable]);
        assert_eq!([fit(9, Some(0.1)), fit(0, None)], [Fit::Unknown, Fit::Unknown]);
    }

    #[test]
    fn offsets_are_refused_above_half_a_frame_and_only_where_they_are_certain() {
        let judge = |frames: f64, sigma: f64| {
            let offsets = [Offset { frames: 0.0, sigma: 0.0 }, Offset { frames, sigma }].map(Some);
            let (refusal, warnings) = judge_offsets(&rig(), &offsets, 25.0);
            (refusal.unwrap_or_default(), warnings.join(" "))
        };
        let late = judge(2.1, 0.05).0;
        assert!(late.contains("cam_01: its pictures were taken 2.10 +- 0.05 frames (84 ms) after"), "{late}");
        assert!(late.contains("cut the first 2 frames of cam_00 and number"), "{late}");
        assert!(judge(-0.7, 0.1).0.contains("before those of the same number; cut the first frame of cam_01"));
        assert_eq!(judge(0.9, 0.4), Default::default());
        assert!(judge(0.3, 0.02).1.contains("use a trigger") && judge(0.3, 0.02).0.is_empty());
        assert_eq!(judge(0.05, 0.001), Default::default());
        let silent = judge_offsets(&rig(), &[Some(Offset { frames: 0.0, sigma: 0.0 }), None], 25.0);
        assert!(silent.0.is_none() && silent.1[0].starts_with("cam_01: the motion does not tell"));
    }
}

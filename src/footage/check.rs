//! What footage lets one expect before any long work: is somebody in view, do they move, is the light usable, does the
//! calibration fit, are the cameras simultaneous.

use super::epipolar::PairResidual;
use super::foreground::{ForegroundOptions, foreground, spread};
use super::{FrameSet, regions};
use crate::rig::Rig;
use image::GrayImage;
use rayon::prelude::*;

/// Epipolar residuals of rigs that fit stay well below this.
const LARGEST_RESIDUAL_PX: f64 = 1.5;
/// A median of fewer matches says little.
const FEWEST_MATCHES: usize = 20;
/// Pictures kept for the test of simultaneity.
const SAMPLES: usize = 5;
/// Frames held in memory at once.
const CHUNK: usize = 16;
/// Mean grey below which a picture counts as dark.
const DARK_GREY: f64 = 15.0;
/// Share of pixels at 250 or more above which a picture counts as overexposed.
const BRIGHT_SHARE: f64 = 0.25;
/// Masks that overlap more than this in every frame show nobody moving.
const STILL_OVERLAP: f64 = 0.9;

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
}

/// What was seen in all frames.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    pub frames: usize,
    pub cameras: Vec<CameraFacts>,
    /// Some frames with their masks, spread over time.
    pub samples: Vec<(FrameSet, Vec<GrayImage>)>,
}

/// Looks at all frames, of which there are `count`, against the stage pictures (one per camera).
pub fn survey<E>(frames: impl Iterator<Item = Result<FrameSet, E>>, count: usize, stages: &[GrayImage]) -> Result<Survey, E> {
    let sampled = spread(count, SAMPLES);
    let mut survey = Survey { cameras: vec![CameraFacts { least_overlap: 1.0, ..Default::default() }; stages.len()], ..Default::default() };
    let mut first_masks = vec![None; stages.len()];
    let mut frames = frames.peekable();
    while frames.peek().is_some() {
        let chunk = frames.by_ref().take(CHUNK).collect::<Result<Vec<_>, E>>()?;
        let options = ForegroundOptions::default();
        let masks_of = |frame: &FrameSet| frame.images.iter().zip(stages).map(|(i, s)| foreground(i, s, &options)).collect::<Vec<_>>();
        let masks: Vec<Vec<GrayImage>> = chunk.par_iter().map(masks_of).collect();
        for (frame, masks) in chunk.into_iter().zip(masks) {
            for (k, (image, mask)) in frame.images.iter().zip(&masks).enumerate() {
                survey.cameras[k].add(image, mask, &mut first_masks[k]);
            }
            if sampled.contains(&survey.frames) {
                survey.samples.push((frame, masks));
            }
            survey.frames += 1;
        }
    }
    survey.cameras.iter_mut().for_each(|c| c.foreground_share /= survey.frames.max(1) as f64);
    Ok(survey)
}

impl CameraFacts {
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
        if all > 1 && self.somebody_in_view() && self.cameras.iter().all(|c| c.least_overlap > STILL_OVERLAP) {
            warnings.push("nothing moves in these pictures; a motion cannot be measured from them".into());
        }
        warnings
    }
}

/// What the residuals of the still stage say about the calibration, and those of the person about simultaneity.
pub fn residual_warnings(rig: &Rig, stage: &[PairResidual], person: &[PairResidual]) -> Vec<String> {
    let mut warnings = Vec::new();
    for (still, moving) in stage.iter().zip(person) {
        let pair = format!("{} and {}", rig.cameras[still.first].name, rig.cameras[still.second].name);
        let [still_px, moving_px] = [still, moving].map(|r| r.median_px.filter(|_| r.matches >= FEWEST_MATCHES));
        match (still_px, moving_px) {
            (None, _) => warnings.push(format!("{pair}: too few common corners ({}) to judge the calibration", still.matches)),
            (Some(px), _) if px > LARGEST_RESIDUAL_PX => {
                warnings.push(format!("{pair}: calibration does not fit these pictures, common corners lie {px:.1} px from their epipolar lines; calibrate again"));
            }
            (Some(_), Some(px)) if px > LARGEST_RESIDUAL_PX => {
                warnings.push(format!(
                    "{pair}: the person lies {px:.1} px from the epipolar lines but the stage fits; the cameras are not synchronous"
                ));
            }
            _ => {}
        }
    }
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::footage::epipolar::PairResidual;
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
        let count = images.len();
        let frames =
            images.into_iter().enumerate().map(|(number, i)| Ok::<_, Infallible>(FrameSet { number, time_s: 0.0, images: i.into() }));
        survey(frames, count, &[stage(), stage()]).unwrap()
    }

    #[test]
    fn a_moving_square_is_measured_and_an_empty_camera_named() {
        let survey = look((0..20).map(|i| [with_square(10 + 3 * i), stage()]).collect());
        assert!((survey.cameras[0].foreground_share - 600.0 / 10800.0).abs() < 0.006, "{:?}", survey.cameras[0]);
        assert_eq!((survey.frames, survey.cameras[0].empty_frames, survey.cameras[1].empty_frames), (20, 0, 20));
        assert_eq!(survey.samples.iter().map(|s| s.0.number).collect::<Vec<_>>(), [0, 4, 9, 14, 19]);
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
    fn residuals_tell_calibration_from_synchronization() {
        let residual = |matches, px| vec![PairResidual { first: 0, second: 1, matches, median_px: Some(px) }];
        let said = |stage: Vec<PairResidual>, person: Vec<PairResidual>| residual_warnings(&rig(), &stage, &person).join(" ");
        assert!(said(residual(99, 2.0), residual(99, 2.0)).contains("calibration does not fit"));
        assert!(said(residual(99, 0.3), residual(99, 2.0)).contains("not synchronous"));
        assert!(said(residual(3, 9.0), residual(99, 0.3)).contains("too few common corners (3)"));
        assert_eq!(said(residual(99, 0.3), residual(9, 5.0)), "");
    }
}

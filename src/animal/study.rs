//! The animal paper's evaluation (section 4): a known animal is rendered from the side, its own postures serve as the
//! artist's at the chosen keys, and the blended motion's angles about the line of sight are held against the truth.

use image::GrayImage;
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::ambiguity::{candidates, stride_order};
use super::analysis::{Analysis, AnalysisError, analyse};
use super::blend::PoseSpace;
use super::creature::{Creature, Motion, Posture};
use super::horse;
use super::keys::{KeyError, Selection, select};
use super::render::{Stroke, View, silhouette, strokes};
use super::switching::{SwitchError, single, switched};

/// A rendered clip with its truth.
pub struct Take {
    pub postures: Vec<Posture>,
    pub masks: Vec<GrayImage>,
    pub view: View,
}

/// `frames` of a looping motion at a rate, seen from the animal's right side.
pub fn film(creature: &Creature, motion: &Motion, frames: usize, fps: f64, size_px: [u32; 2]) -> Take {
    let view = View::side(creature, size_px);
    let start = motion.times_s.first().copied().unwrap_or(0.0);
    let at = |t: usize| start + (t as f64 / fps).rem_euclid(motion.duration_s().max(1e-9));
    let postures: Vec<Posture> = (0..frames).filter_map(|t| motion.at(at(t))).collect();
    let masks = postures.iter().map(|p| silhouette(creature, p, &view)).collect();
    Take { postures, masks, view }
}

/// What a quick hand would draw over the horse: lines 6 px wide that wander by up to `wobble_px`, differently in every frame.
pub fn sketch_horse(creature: &Creature, take: &Take, wobble_px: f64) -> Vec<GrayImage> {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    take.postures
        .iter()
        .map(|posture| {
            let lines = horse::lines(creature, posture).into_iter().map(|(part, points)| {
                let mut near = |v: f64| v + wobble_px * (2.0 * random.random::<f64>() - 1.0);
                let points = points.iter().map(|p| take.view.pixel(p)).map(|p| [near(p.x), near(p.y)]).collect();
                Stroke { part: part.into(), width_px: 6.0, points }
            });
            strokes(&lines.collect::<Vec<_>>(), take.view.size_px)
        })
        .collect()
}

/// Mean and standard deviation of absolute angle differences, degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AngleError {
    pub mean_deg: f64,
    pub sd_deg: f64,
}

/// Over all frames and those bones that turn in the truth by more than half a degree about the line of sight.
pub fn angle_error(creature: &Creature, truth: &[Posture], found: &[Posture]) -> AngleError {
    let axis = Vector3::x();
    let angles = |list: &[Posture]| -> Vec<Vec<f64>> { list.iter().map(|p| creature.angles_about(&axis, p)).collect() };
    let (truth, found) = (angles(truth), angles(found));
    let turning: Vec<usize> = (0..creature.bones.len())
        .filter(|k| {
            let range = truth.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), row| (a.min(row[*k]), b.max(row[*k])));
            range.1 - range.0 > 0.5f64.to_radians()
        })
        .collect();
    let mut errors = Vec::new();
    for (truth, found) in truth.iter().zip(&found) {
        errors.extend(turning.iter().map(|k| {
            let difference = truth[*k] - found[*k];
            (difference - std::f64::consts::TAU * (difference / std::f64::consts::TAU).round()).abs().to_degrees()
        }));
    }
    let n = errors.len().max(1) as f64;
    let mean_deg = errors.iter().sum::<f64>() / n;
    AngleError { mean_deg, sd_deg: (errors.iter().map(|e| (e - mean_deg).powi(2)).sum::<f64>() / n).sqrt() }
}

#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    #[error(transparent)]
    Keys(#[from] KeyError),
    #[error(transparent)]
    Switch(#[from] SwitchError),
    #[error("frame {0} has no other half of the stride in the clip")]
    NoAlternate(usize),
    #[error("no key pose")]
    NoPose,
}

/// An experiment's outcome.
pub struct Outcome {
    pub error: AngleError,
    pub keys: Vec<usize>,
    pub postures: Vec<Posture>,
}

fn replay(creature: &Creature, take: &Take, keys: Vec<usize>, rows: &[Vec<f64>]) -> Result<Outcome, StudyError> {
    let poses: Vec<Posture> = keys.iter().map(|k| take.postures[*k].clone()).collect();
    let space = PoseSpace::new(&poses).ok_or(StudyError::NoPose)?;
    let postures: Vec<Posture> = rows.iter().map(|w| space.blend(w)).collect();
    Ok(Outcome { error: angle_error(creature, &take.postures, &postures), keys, postures })
}

/// One model of `keys` keys over `components` components.
pub fn one_model(
    creature: &Creature,
    take: &Take,
    analysis: &Analysis,
    keys: usize,
    components: usize,
    filter: bool,
) -> Result<Outcome, StudyError> {
    let points = analysis.rhythm.points(&analysis.eigen, components, filter);
    let Selection { frames, .. } = select(&points, keys)?;
    let weights = single(&points, &frames, false)?;
    replay(creature, take, frames, &weights.rows)
}

/// Four keys over two components, each with its silhouette's other half of the stride, and four switching models.
pub fn switching_models(creature: &Creature, take: &Take, analysis: &Analysis, filter: bool) -> Result<Outcome, StudyError> {
    let points = analysis.rhythm.points(&analysis.eigen, 2, filter);
    let turns = analysis.rhythm.turns(&analysis.eigen);
    let first = select(&points, 4)?.frames;
    let alternates = first
        .iter()
        .map(|k| candidates(&points, turns.as_deref(), *k).first().copied().ok_or(StudyError::NoAlternate(*k)))
        .collect::<Result<Vec<_>, _>>()?;
    let keys = stride_order(&first, &alternates, turns.as_deref());
    let weights = switched(&points, &keys, false)?;
    replay(creature, take, keys, &weights.rows)
}

/// Films a motion at 25 frames per second, 320×240, as the paper's synthetic clips, and analyses it.
pub fn filmed(creature: &Creature, motion: &Motion, frames: usize) -> Result<(Take, Analysis), StudyError> {
    let take = film(creature, motion, frames, 25.0, [320, 240]);
    let analysis = analyse(&take.masks, false, 0)?;
    Ok((take, analysis))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::horse::{Gait, horse};

    fn gait(gait: Gait) -> (Creature, Take, Analysis) {
        let creature = horse();
        let motion = creature.motions.iter().find(|m| m.name == gait.name()).unwrap().clone();
        let (take, analysis) = filmed(&creature, &motion, 100).unwrap();
        (creature, take, analysis)
    }

    #[test]
    fn four_keys_and_two_components_reproduce_canter_and_gallop() {
        for (which, least) in [(Gait::Canter, 5.0), (Gait::Gallop, 5.0)] {
            let (creature, take, analysis) = gait(which);
            let error = |keys, components| one_model(&creature, &take, &analysis, keys, components, false).unwrap().error.mean_deg;
            let four = error(4, 2);
            println!(
                "{}: {:.2} {:.2} {four:.2} {:.2}, one {:.2}, three {:.2}",
                which.name(),
                error(2, 2),
                error(3, 2),
                error(5, 2),
                error(4, 1),
                error(4, 3)
            );
            assert!(four < least && error(2, 2) > four && error(3, 2) > four, "{four}");
            // The fifth key gains less than a degree, and a third component nothing that matters.
            assert!(error(5, 2) > four - 1.0 && error(4, 1) > four && error(4, 3) > four - 0.5);
            // The mean posture's error is several times as large.
            let still = PoseSpace::new(&take.postures).unwrap().blend(&vec![1.0 / 100.0; 100]);
            assert!(angle_error(&creature, &take.postures, &vec![still; 100]).mean_deg > 1.8 * four);
        }
    }

    #[test]
    fn a_walk_needs_eight_keys_and_switching_models() {
        let (creature, take, analysis) = gait(Gait::Walk);
        let four = one_model(&creature, &take, &analysis, 4, 2, false).unwrap().error.mean_deg;
        for filter in [false, true] {
            let eight = switching_models(&creature, &take, &analysis, filter).unwrap();
            println!("walk: 4 keys {four:.2}, 8 keys switching {:.2}, filter {filter}", eight.error.mean_deg);
            assert!(eight.error.mean_deg < 0.6 * four && eight.error.mean_deg < 3.0, "{four} {:?}", eight.error);
        }
    }

    #[test]
    fn strokes_serve_as_well_as_masks() {
        let (creature, take, masks) = gait(Gait::Gallop);
        let drawn = analyse(&sketch_horse(&creature, &take, 2.0), true, 0).unwrap();
        assert_eq!(drawn.rhythm.verdict, crate::animal::rhythm::Verdict::Usable, "{:?}", drawn.rhythm);
        let error = |a: &Analysis, filter| one_model(&creature, &take, a, 4, 2, filter).unwrap().error.mean_deg;
        println!(
            "gallop from masks {:.2} (filtered {:.2}), from strokes {:.2} ({:.2})",
            error(&masks, false),
            error(&masks, true),
            error(&drawn, false),
            error(&drawn, true)
        );
        assert!(error(&drawn, true) < error(&masks, true) + 1.5);
    }
}

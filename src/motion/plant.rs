//! Feet that stand still while they stand.
//!
//! Each foot gets a horizontal displacement D(t) and a turn about the vertical. During a contact D undoes the slide of the
//! sole,
//!   D' = −s,   mean of D over the contact = 0                                                                       (1)
//! so the foot stays where it is on average and may still roll from heel to toe; the turn does the same for the foot's
//! direction. Between contacts both go over from one to the next without jumps in value or rate, and a rate left over from a
//! contact fades soon, so nothing pops. The pelvis rises and sinks smoothly with the standing feet so that
//! legs keep their lengths; `two_bone` does the rest with a damped knee, which is let go outside the contacts.
//!
//! After Kovar, Schreiner and Gleicher (2002), "Footskate cleanup for motion capture editing", SCA. Departures: the sole
//! is held where it touches, not at two fixed points; the pelvis only goes up and down; legs keep their length; the height
//! of a standing foot is left to a few millimetres.
//! Fails when: a generated foot slides farther than the leg reaches; then it still slides and is counted.
//! Checked against generated walks, runs, starts, stops and bends, whose feet are followed by forward kinematics.

use std::ops::Range;

use nalgebra::Vector3;

use super::contact::FootTrack;
use super::two_bone::{LEGS, reach};
use crate::body::{Clip, Joint, Placement};
use crate::math::rotation::exp;

/// Standard deviation of the smoothing of the pelvis' height, seconds.
const PELVIS_S: f64 = 0.04;
/// λ of a standing leg's knee, metres. Smaller lets nearly straight knees pop, larger lets the foot's height go.
const DAMPING_M: f64 = 0.15;
/// Time after and before a contact in which the knee is let go and rates fade. Shorter jerks, longer changes the swing.
const RELEASE_S: f64 = 0.12;

/// A clip with its feet planted.
#[derive(Clone, Debug)]
pub struct Planted {
    pub clip: Clip,
    /// Frames in which the left and the right foot stand.
    pub contacts: [Vec<Range<usize>>; 2],
    /// Frames of a contact whose foot is out of the leg's reach.
    pub unreached: usize,
}

/// Turn about the vertical and displacement (x, z in metres) of one foot in every frame.
type Correction = Vec<Vector3<f64>>;

/// Plants the feet of a clip whose floor is y = 0.
pub fn plant_feet(clip: &Clip) -> Planted {
    let feet = [Joint::LAnkle, Joint::RAnkle].map(|ankle| FootTrack::new(clip, ankle));
    let contacts = feet.each_ref().map(|foot| foot.contacts(clip));
    let corrections: [Correction; 2] = std::array::from_fn(|side| correction(clip, &feet[side], &contacts[side]));
    let shift = |c: &Vector3<f64>| Vector3::new(c.y, 0.0, c.z);
    let targets: [Vec<Vector3<f64>>; 2] =
        std::array::from_fn(|side| feet[side].ankles.iter().zip(&corrections[side]).map(|(a, c)| a + shift(c)).collect());
    let lift = pelvis_lift(clip, &targets, &contacts);
    let mut planted = Planted { clip: clip.clone(), contacts, unreached: 0 };
    for (frame, pose) in planted.clip.poses.iter_mut().enumerate() {
        pose.root.y += lift[frame];
        for (side, leg) in LEGS.into_iter().enumerate() {
            let foot = exp(&Vector3::new(0.0, corrections[side][frame].x, 0.0)) * feet[side].world_from_foot[frame];
            let hold = hold(&planted.contacts[side], frame, RELEASE_S * clip.fps);
            let met = reach(pose, &clip.offsets, leg, &targets[side][frame], &foot, DAMPING_M / hold);
            planted.unreached += usize::from(!met && hold == 1.0);
        }
    }
    planted
}

fn stands(contacts: &[Range<usize>], frame: usize) -> bool {
    contacts.iter().any(|c| c.contains(&frame))
}

/// 1 in a contact, 0 from `release` frames on before and after it.
fn hold(contacts: &[Range<usize>], frame: usize, release: f64) -> f64 {
    let away = |c: &Range<usize>| c.start.saturating_sub(frame).max((frame + 1).saturating_sub(c.end));
    let nearest = contacts.iter().map(away).min().unwrap_or(usize::MAX);
    1.0 - rise((nearest as f64 / release).min(1.0))
}

/// From 0 to 1 with no rate and no acceleration at the ends.
fn rise(t: f64) -> f64 {
    t * t * t * (t * (6.0 * t - 15.0) + 10.0)
}

/// From 0 at rate 1 back to 0 at rate 0, with no acceleration at the ends; 0 beyond 1.
fn fade(t: f64) -> f64 {
    if t < 1.0 { t * (1.0 - t * t * (6.0 + t * (3.0 * t - 8.0))) } else { 0.0 }
}

/// Equation (1) in the contacts and the way between them.
fn correction(clip: &Clip, foot: &FootTrack, contacts: &[Range<usize>]) -> Correction {
    let release = RELEASE_S * clip.fps;
    let turns = spread(clip.poses.len(), contacts, release, |c| centred(c, |k| Vector3::new(-foot.turn(k), 0.0, 0.0)));
    let mut turned = foot.clone();
    for (frame, sole) in turned.soles.iter_mut().enumerate() {
        let (turn, ankle) = (exp(&Vector3::new(0.0, turns[frame].x, 0.0)), foot.ankles[frame]);
        *sole = sole.map(|p| ankle + turn * (p - ankle));
    }
    let shifts = spread(clip.poses.len(), contacts, release, |c| {
        centred(c, |k| {
            let slide = turned.slide(k);
            Vector3::new(0.0, -slide.x, -slide.z)
        })
    });
    turns.iter().zip(&shifts).map(|(t, s)| t + s).collect()
}

/// Running sum of `step` over a contact's frames, its mean taken off.
fn centred(contact: Range<usize>, step: impl Fn(usize) -> Vector3<f64>) -> Vec<Vector3<f64>> {
    let mut sums = vec![Vector3::zeros()];
    for frame in contact.start..contact.end - 1 {
        sums.push(sums[sums.len() - 1] + step(frame));
    }
    let mean = sums.iter().sum::<Vector3<f64>>() / sums.len() as f64;
    sums.iter().map(|s| s - mean).collect()
}

/// Values held in the contacts, and the way from one to the next; the first and last value stay outside them.
fn spread(frames: usize, contacts: &[Range<usize>], release: f64, held: impl Fn(Range<usize>) -> Vec<Vector3<f64>>) -> Correction {
    let mut found = vec![Vector3::zeros(); frames];
    let mut before: Option<(usize, Vector3<f64>, Vector3<f64>)> = None;
    for contact in contacts {
        let values = held(contact.clone());
        let last = values.len() - 1;
        let (first_rate, last_rate) = (values[1.min(last)] - values[0], values[last] - values[last.saturating_sub(1)]);
        let span = contact.start - before.map_or(0, |b| b.0);
        let fading = release.min(0.5 * span as f64);
        for k in 1..span {
            let (gone, left) = (k as f64, (span - k) as f64);
            let into = values[0] - first_rate * (fading * fade(left / fading));
            found[contact.start - span + k] = match before {
                Some((_, value, rate)) => {
                    let out = value + rate * (fading * fade(gone / fading));
                    out.lerp(&into, rise(gone / span as f64))
                }
                None => into,
            };
        }
        if before.is_none() && contact.start > 0 {
            found[0] = values[0];
        }
        found[contact.clone()].copy_from_slice(&values);
        before = Some((contact.end - 1, values[last], last_rate));
    }
    if let Some((from, value, rate)) = before {
        for (k, rest) in found[from..].iter_mut().enumerate().skip(1) {
            *rest = value + rate * (release * fade(k as f64 / release));
        }
    }
    found
}

/// How far the pelvis goes up in every frame so that standing legs keep their length.
fn pelvis_lift(clip: &Clip, targets: &[Vec<Vector3<f64>>; 2], contacts: &[Vec<Range<usize>>; 2]) -> Vec<f64> {
    let rise = |frame: usize, side: usize, placed: &Placement| {
        let [hip, _, ankle] = LEGS[side];
        let kept = (placed.position(hip) - placed.position(ankle)).norm();
        rise_to(&(placed.position(hip) - targets[side][frame]), kept)
    };
    let wanted = clip.poses.iter().enumerate().map(|(frame, pose)| {
        let placed = clip.place(pose);
        let standing = (0..2).filter(|&side| stands(&contacts[side], frame));
        let rises: Vec<f64> = standing.filter_map(|side| rise(frame, side, &placed)).collect();
        (!rises.is_empty()).then(|| rises.iter().sum::<f64>() / rises.len() as f64)
    });
    smooth(&filled(&wanted.collect::<Vec<_>>()), PELVIS_S * clip.fps)
}

/// Rise of the hip after which it is `long` from the target; the one that changes less.
fn rise_to(hip_from_target: &Vector3<f64>, long: f64) -> Option<f64> {
    let across = hip_from_target.xz().norm_squared();
    (long * long > across).then(|| (long * long - across).sqrt() - hip_from_target.y)
}

/// Straight lines over the gaps, the ends held, zero where there is nothing.
fn filled(values: &[Option<f64>]) -> Vec<f64> {
    let known: Vec<(usize, f64)> = values.iter().enumerate().filter_map(|(i, v)| Some((i, (*v)?))).collect();
    let (Some(first), Some(last)) = (known.first(), known.last()) else { return vec![0.0; values.len()] };
    let mut found = vec![first.1; values.len()];
    found[last.0..].fill(last.1);
    for w in known.windows(2) {
        let ((i, a), (j, b)) = (w[0], w[1]);
        (i..j).for_each(|k| found[k] = a + (b - a) * (k - i) as f64 / (j - i) as f64);
    }
    found
}

/// Gaussian average with `sigma` in samples, cut at three of them; the ends average what there is.
fn smooth(values: &[f64], sigma: f64) -> Vec<f64> {
    let reach = (3.0 * sigma).ceil() as usize;
    let average = |i: usize| {
        let near = i.saturating_sub(reach)..(i + reach + 1).min(values.len());
        let weigh = |k: usize| (-0.5 * ((k as f64 - i as f64) / sigma).powi(2)).exp();
        near.clone().map(|k| weigh(k) * values[k]).sum::<f64>() / near.map(weigh).sum::<f64>()
    };
    (0..values.len()).map(average).collect()
}

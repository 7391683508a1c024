//! Feet that stand still while they stand.
//!
//! Each foot gets a displacement D(t) and a turn about the vertical. During a contact D undoes the slide of the sole,
//!   D' = −s,   mean height of what touches = floor,   mean of D over the contact = 0 else                           (1)
//! so the foot stays where it is on average and may still roll from heel to toe; the turn does the same for the foot's
//! direction. Between contacts both go from one to the next by the quintic that agrees in value and rate and has no
//! acceleration at its ends: nothing pops. The pelvis rises and sinks smoothly with the standing feet so that legs keep
//! their lengths, as a nearly straight knee would bend by many degrees for a millimetre; `two_bone` does the rest.
//!
//! After Kovar, Schreiner and Gleicher (2002), "Footskate cleanup for motion capture editing", SCA. Departures: the sole
//! is held where it touches, not at two fixed points; the pelvis only goes up and down; legs keep their length.
//! Fails when: a generated foot slides farther than the leg reaches; then it still slides and is counted.
//! Checked against walks with slides put in and the feet of generated ones.

use std::ops::Range;

use nalgebra::{Vector3, Vector4};

use super::contact::FootTrack;
use super::two_bone::{LEGS, reach};
use crate::body::{Clip, Joint};
use crate::math::rotation::exp;

/// Standard deviation of the smoothing of the pelvis' height, seconds.
const PELVIS_S: f64 = 0.06;
/// The pelvis stays this part of the leg's length closer than it reaches.
const SLACK: f64 = 5e-4;

/// A clip with its feet planted.
#[derive(Clone, Debug)]
pub struct Planted {
    pub clip: Clip,
    /// Frames in which the left and the right foot stand.
    pub contacts: [Vec<Range<usize>>; 2],
    /// Frames of a contact whose foot is out of the leg's reach.
    pub unreached: usize,
}

/// Displacement (x, y, z in metres) and turn about the vertical of one foot in every frame.
type Correction = Vec<Vector4<f64>>;

/// Plants the feet of a clip whose floor is y = 0.
pub fn plant_feet(clip: &Clip) -> Planted {
    let feet = [Joint::LAnkle, Joint::RAnkle].map(|ankle| FootTrack::new(clip, ankle));
    let contacts = feet.each_ref().map(|foot| foot.contacts(clip));
    let corrections: [Correction; 2] = std::array::from_fn(|side| correction(clip, &feet[side], &contacts[side]));
    let targets: [Vec<Vector3<f64>>; 2] =
        std::array::from_fn(|side| feet[side].ankles.iter().zip(&corrections[side]).map(|(a, c)| a + c.xyz()).collect());
    let lift = pelvis_lift(clip, &targets, &contacts);
    let mut planted = Planted { clip: clip.clone(), contacts, unreached: 0 };
    for (frame, pose) in planted.clip.poses.iter_mut().enumerate() {
        pose.root.y += lift[frame];
        for side in 0..2 {
            let foot = exp(&Vector3::new(0.0, corrections[side][frame].w, 0.0)) * feet[side].world_from_foot[frame];
            let met = reach(pose, &clip.offsets, LEGS[side], &targets[side][frame], &foot);
            planted.unreached += usize::from(!met && stands(&planted.contacts[side], frame));
        }
    }
    planted
}

fn stands(contacts: &[Range<usize>], frame: usize) -> bool {
    contacts.iter().any(|c| c.contains(&frame))
}

/// Equation (1) in the contacts, quintics between them.
fn correction(clip: &Clip, foot: &FootTrack, contacts: &[Range<usize>]) -> Correction {
    let frames = clip.poses.len();
    let turned = |turns: &dyn Fn(usize) -> f64| {
        let mut turned = foot.clone();
        for frame in 0..frames {
            let turn = exp(&Vector3::new(0.0, turns(frame), 0.0));
            let ankle = foot.ankles[frame];
            turned.soles[frame] = foot.soles[frame].map(|p| ankle + turn * (p - ankle));
        }
        turned
    };
    let turns = spread(frames, contacts, |c| centred(c, |k| Vector4::new(0.0, 0.0, 0.0, -foot.turn(k))));
    let turned = turned(&|frame| turns[frame].w);
    let shifts = spread(frames, contacts, |c| {
        let mut held = centred(c.clone(), |k| -turned.slide(k).push(0.0));
        let height = c.clone().map(|k| turned.height_m(k) + held[k - c.start].y).sum::<f64>() / c.len() as f64;
        held.iter_mut().for_each(|h| h.y -= height);
        held
    });
    turns.iter().zip(&shifts).map(|(t, s)| t + s).collect()
}

/// Running sum of `step` over a contact's frames, its mean taken off.
fn centred(contact: Range<usize>, step: impl Fn(usize) -> Vector4<f64>) -> Vec<Vector4<f64>> {
    let mut sums = vec![Vector4::zeros()];
    for frame in contact.start..contact.end - 1 {
        sums.push(sums[sums.len() - 1] + step(frame));
    }
    let mean = sums.iter().sum::<Vector4<f64>>() / sums.len() as f64;
    sums.iter().map(|s| s - mean).collect()
}

/// Values held in the contacts, and the way from one to the next; the first and last value stay outside them.
fn spread(frames: usize, contacts: &[Range<usize>], held: impl Fn(Range<usize>) -> Vec<Vector4<f64>>) -> Correction {
    let mut found = vec![Vector4::zeros(); frames];
    let mut before: Option<(usize, Vector4<f64>, Vector4<f64>)> = None;
    for contact in contacts {
        let values = held(contact.clone());
        let last = values.len() - 1;
        let (first_rate, last_rate) = (values[1.min(last)] - values[0], values[last] - values[last.saturating_sub(1)]);
        match before {
            Some((from, value, rate)) => {
                let span = contact.start - from;
                for k in 1..span {
                    found[from + k] = quintic(k as f64 / span as f64, span as f64, (value, rate), (values[0], first_rate));
                }
            }
            None => found[..contact.start].fill(values[0]),
        }
        found[contact.clone()].copy_from_slice(&values);
        before = Some((contact.end - 1, values[last], last_rate));
    }
    if let Some((from, value, _)) = before {
        found[from + 1..].fill(value);
    }
    found
}

/// From (value, rate) to (value, rate) with no acceleration at the ends, at part `t` of `span` frames.
fn quintic(t: f64, span: f64, from: (Vector4<f64>, Vector4<f64>), to: (Vector4<f64>, Vector4<f64>)) -> Vector4<f64> {
    let (t3, t4, t5) = (t.powi(3), t.powi(4), t.powi(5));
    let rise = 10.0 * t3 - 15.0 * t4 + 6.0 * t5;
    let (out, into) = (t - 6.0 * t3 + 8.0 * t4 - 3.0 * t5, -4.0 * t3 + 7.0 * t4 - 3.0 * t5);
    from.0 * (1.0 - rise) + to.0 * rise + (from.1 * out + to.1 * into) * span
}

/// How far the pelvis goes up in every frame so that standing legs keep their length.
fn pelvis_lift(clip: &Clip, targets: &[Vec<Vector3<f64>>; 2], contacts: &[Vec<Range<usize>>; 2]) -> Vec<f64> {
    let frames = clip.poses.len();
    let (mut wanted, mut highest) = (vec![None; frames], vec![f64::INFINITY; frames]);
    for frame in 0..frames {
        let placed = clip.place(&clip.poses[frame]);
        let mut sum = (0.0, 0.0);
        for side in 0..2 {
            let [hip, knee, ankle] = LEGS[side];
            let to_hip = placed.position(hip) - targets[side][frame];
            let long = clip.offsets[knee as usize].norm() + clip.offsets[ankle as usize].norm();
            highest[frame] = rise_to(&to_hip, long * (1.0 - SLACK)).unwrap_or(0.0).min(highest[frame]);
            if stands(&contacts[side], frame) {
                let kept = (placed.position(hip) - placed.position(ankle)).norm();
                sum = (sum.0 + rise_to(&to_hip, kept).unwrap_or(0.0), sum.1 + 1.0);
            }
        }
        wanted[frame] = (sum.1 > 0.0).then(|| sum.0 / sum.1);
    }
    let lift = smooth(&filled(&wanted), PELVIS_S * clip.fps);
    // Where a leg is still too short the pelvis sinks, and around that place too.
    let reach = (3.0 * PELVIS_S * clip.fps).ceil() as usize;
    let excess: Vec<f64> = lift.iter().zip(&highest).map(|(l, h)| (l - h).max(0.0)).collect();
    let around = |i: usize| excess[i.saturating_sub(reach)..(i + reach + 1).min(frames)].iter().copied().fold(0.0, f64::max);
    let sink = smooth(&(0..frames).map(around).collect::<Vec<f64>>(), PELVIS_S * clip.fps);
    lift.iter().zip(&sink).map(|(l, s)| l - s).collect()
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
        let (from, to) = (i.saturating_sub(reach), (i + reach + 1).min(values.len()));
        let (mut sum, mut weight) = (0.0, 0.0);
        for k in from..to {
            let w = (-0.5 * ((k as f64 - i as f64) / sigma).powi(2)).exp();
            (sum, weight) = (sum + w * values[k], weight + w);
        }
        sum / weight
    };
    (0..values.len()).map(average).collect()
}

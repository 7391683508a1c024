//! How unsteadily a person's carrier moves.
//!
//! The carrier takes what of the root's motion the model's components do not hold. How much that is for somebody who is not in the
//! model, its own people tell: each against the model of the others, with α in the leading components of all,
//!   e = r − r̄' − P' U'ᵀ (α − ᾱ'),                                                                                    (1)
//! ᾱ', U' mean and axes of the others' α, r̄', P' mean and loadings of their root channels. The standard deviation of accelerations
//! is the median over all cycles (some recordings are shaken) of the root mean square of (e₊ − 2 e + e₋) / h², h the time between frames:
//! 1.9 m/s² and 12 rad/s² for recorded walks, 2.9 and 20 for recorded runs. Runs gain a twentieth over the values of [`STEADY`], and
//! their standard deviations hold better.
//! Departure: the paper smooths the root with a weight of its choice.
//! Fails when: the database has one subject, or shows the same motion many times; [`STEADY`] is the least.
//! Checked against made-up people whose roots differ by a known oscillation.

use nalgebra::DVectorView;
use rayon::prelude::*;

use crate::math::order::quantile;
use crate::motion_model::{Member, Model, ROOT_CHANNELS, SAMPLES};

/// Standard deviations of a carrier's accelerations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Accelerations {
    pub linear_m_s2: f64,
    pub angular_rad_s2: f64,
}

/// Of a steady walk; less lets the carrier cut corners.
pub const STEADY: Accelerations = Accelerations { linear_m_s2: 1.35, angular_rad_s2: 5.4 };

/// So many times the components used tell the axes of the others.
const TELLING: usize = 2;

/// Those of somebody who is not in `model`, of which the fit uses so many `components`, seen every `frame_s` seconds.
pub fn accelerations(model: &Model, components: usize, frame_s: f64) -> Accelerations {
    let weights = model.leading_weights(TELLING * components);
    let weighed = |(m, weights): (&Member, DVectorView<f64>)| Member { vector: weights.into_owned(), ..m.clone() };
    let members: Vec<Member> = model.members.iter().zip(weights.column_iter()).map(weighed).collect();
    let left_out = |subject: &&str| {
        let others = members.iter().filter(|m| m.subject != **subject).cloned().collect();
        let Ok(others) = Model::from_members(model.activity, model.synthetic, model.mean_rotations, others) else { return Vec::new() };
        let others = others.truncated(components);
        let own = members.iter().filter(|m| m.subject == **subject);
        own.map(|m| unsteadiness(m, (&m.root - others.root(others.member_weights(m).as_slice())).as_slice(), model, frame_s)).collect()
    };
    let all: Vec<[f64; 2]> = model.subjects().par_iter().flat_map_iter(left_out).collect();
    let median = |kind: usize| quantile(all.iter().map(|squares| squares[kind].sqrt()).collect(), 0.5).unwrap_or(0.0);
    Accelerations { linear_m_s2: median(1).max(STEADY.linear_m_s2), angular_rad_s2: median(0).max(STEADY.angular_rad_s2) }
}

/// Mean squares of the accelerations of root channels `e` in the member's time: rad²/s⁴ and m²/s⁴, by axis.
fn unsteadiness(m: &Member, e: &[f64], model: &Model, frame_s: f64) -> [f64; 2] {
    let sample_s = m.duration_s / SAMPLES as f64;
    let step = ((frame_s / sample_s).round() as usize).clamp(1, SAMPLES / 4);
    let h = step as f64 * sample_s;
    let inside = if model.activity.is_cyclic() { 0..SAMPLES } else { step..SAMPLES - step };
    let count = 3.0 * inside.len() as f64;
    let mut sums = [0.0; 2];
    for sample in inside {
        let at = |k: usize, channel: usize| e[k % SAMPLES * ROOT_CHANNELS + channel];
        for channel in 0..ROOT_CHANNELS {
            let (before, now, after) = (at(sample + SAMPLES - step, channel), at(sample, channel), at(sample + step, channel));
            let unit = if channel < 3 { 1.0 } else { m.hip_height_m };
            sums[channel / 3] += (unit * (after - 2.0 * now + before) / (h * h)).powi(2);
        }
    }
    sums.map(|sum| sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::Activity;
    use nalgebra::{DVector, UnitQuaternion};
    use std::f64::consts::TAU;

    /// Six people whose joints differ along one axis, and roots by an oscillation that joints do not tell: `sway` m to the left or right at
    /// twice the cycle's frequency, `list` rad at the cycle's.
    fn model(sway: f64, list: f64) -> Model {
        let member = |i: usize| {
            let sign = [1.0, 1.0, -1.0, -1.0, 1.0, -1.0][i];
            let vector = DVector::from_fn(SAMPLES * crate::body::DOF, |k, _| i as f64 * 0.01 * (k as f64).sin());
            let root = DVector::from_fn(SAMPLES * ROOT_CHANNELS, |k, _| {
                let phase = (k / ROOT_CHANNELS) as f64 / SAMPLES as f64;
                match k % ROOT_CHANNELS {
                    0 => sign * list * (TAU * phase).sin(),
                    3 => sign * sway / 0.9 * (2.0 * TAU * phase).sin(),
                    _ => 0.0,
                }
            });
            let (subject, source) = (i.to_string(), String::new());
            Member { subject, source, parameter: 1.0, hip_height_m: 0.9, duration_s: 1.0, vector, root }
        };
        Model::from_members(Activity::Walking, true, [UnitQuaternion::identity(); 26], (0..6).map(member).collect()).unwrap()
    }

    #[test]
    fn oscillations_that_the_others_do_not_tell_come_back() {
        let found = accelerations(&model(0.1, 0.6), 1, 0.01);
        // One regression on five others adds its own part to each person's oscillation.
        let sway = 0.1 * (2.0 * TAU).powi(2) / 6f64.sqrt();
        let list = 0.6 * TAU.powi(2) / 6f64.sqrt();
        assert!((1.0..1.6).contains(&(found.linear_m_s2 / sway)), "{found:?} {sway}");
        assert!((1.0..1.6).contains(&(found.angular_rad_s2 / list)), "{found:?} {list}");
        assert!((found.linear_m_s2 / sway - found.angular_rad_s2 / list).abs() < 2e-3);
        // Seen every tenth of a second an oscillation of 2 Hz keeps sinc² of its acceleration.
        let seldom = accelerations(&model(0.1, 0.6), 1, 0.1);
        let kept = ((TAU / 10.0).sin() / (TAU / 10.0)).powi(2);
        assert!((seldom.linear_m_s2 / found.linear_m_s2 - kept).abs() < 5e-3, "{seldom:?} {kept}");
    }

    #[test]
    fn people_alike_are_as_a_steady_walk() {
        assert_eq!(accelerations(&model(0.0, 0.0), 1, 0.03), STEADY);
        let mut alone = model(0.1, 0.6);
        alone.members.iter_mut().for_each(|m| m.subject = "one".into());
        assert_eq!(accelerations(&alone, 1, 0.03), STEADY);
    }
}

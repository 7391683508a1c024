//! Parametric walk after Boulic, Magnenat-Thalmann and Thalmann (1990), "A global human walking model with real-time
//! kinematic personification", The Visual Computer 6: 344-358.
//!
//! Relative velocity RV = v/H (1/s), cycle frequency f = 0.743 √RV, support share of the cycle 0.752 − 0.143 f. Angles are
//! functions of the phase t from the side's own heel strike and of RV, through control points.
//!
//! Departures: hip and knee curves as said beside them; lengths are divided by the hip-joint height H = 0.53 stature, not
//! thigh + shank; the foot is laid flat, the toes bend and the hip's amplitude is fitted to the stride in `stride`, from
//! where height and progress of the root also come; the thorax angle is taken against the carrier, so the spine undoes
//! the pelvis. Checked: published frequencies and strides, amplitude of the bob, hip, knee and ankle against the means and
//! spreads of people at three speeds, feet neither sinking nor sliding.
//! Fails below 2 km/h (the paper's own lower zone) and above RV = 3, where people run.

use std::f64::consts::TAU;

use super::stride::Gait;
use super::variation::Channel;
use crate::math::curves::Pchip;

/// Mid-range RV of the database, about which a subject's own slope over speed turns.
pub(super) const REFERENCE_RV: f64 = 1.5;

pub(super) fn frequency_hz(rv: f64) -> f64 {
    0.743 * rv.sqrt()
}

/// Share of the cycle during which a foot stands.
pub(super) fn support(frequency_hz: f64) -> f64 {
    0.752 - 0.143 * frequency_hz
}

/// Population angle in degrees at the side's own phase.
pub(super) fn population(channel: Channel, t: f64, rv: f64) -> f64 {
    let t = t.rem_euclid(1.0);
    let c = ((rv - 1.3) / 1.7).max(0.0);
    match channel {
        Channel::HipFlexion => curve(&hip(rv, c), t),
        Channel::Knee => curve(&knee(rv, c), t),
        Channel::Ankle => curve(&ankle(rv, c), t),
        Channel::HipAdduction => 0.0,
        Channel::HipRotation => 1.4 * rv - 8.5,
        Channel::Shoulder => {
            let s = 9.88 * rv;
            3.0 - 0.5 * s - s * (TAU * t).cos()
        }
        Channel::ShoulderAbduction => 7.0,
        Channel::Elbow => curve(&elbow(rv, c), t),
        Channel::Tilt => {
            let a = if rv > 0.5 { 2.0 } else { 8.0 * rv * (1.0 - rv) };
            a - a * (TAU * (2.0 * t - 0.1)).sin()
        }
        Channel::List => pelvic_list(1.66 * rv, t),
        Channel::Yaw => 4.0 * rv * (TAU * t).cos(),
        Channel::Lean => 1.0 + rv,
        Channel::Bend => 0.0,
        Channel::Torsion => -curve(&[(0.1, 4.0 / 3.0 * rv), (0.4, -1.5 * rv), (0.6, -4.0 / 3.0 * rv), (0.9, 1.5 * rv)], t),
    }
}

fn curve(points: &[(f64, f64)], t: f64) -> f64 {
    Pchip::periodic(points).at(t)
}

/// Departure: at low speed farthest back at 54 instead of 50 % of the cycle, as in people, and no larger at high speed,
/// where `stride` scales it anyway.
fn hip(rv: f64, c: f64) -> [(f64, f64); 3] {
    match rv {
        _ if rv < 0.5 => [(-0.08, 50.0 * rv), (0.54, -30.0 * rv), (0.92, 50.0 * rv)],
        _ if rv < 1.3 => [(-0.08, 25.0), (0.54, -15.0), (0.92, 25.0)],
        _ => [(0.2 * c - 0.08, 25.0), (0.54 - 0.09 * c, -15.0), (0.92, 25.0)],
    }
}

/// Departure: the paper's knee is straight in stance at low speed and swings to 70 degrees; people yield to the load
/// (15 to 20 degrees at 15 % of the cycle, more when faster) and swing to 60 to 65.
fn knee(rv: f64, c: f64) -> [(f64, f64); 4] {
    let load = (6.0 + 7.0 * rv).min(25.0);
    let peak = if rv < 0.5 { 110.0 * rv } else { (48.0 + 8.0 * rv).min(66.0) };
    [(0.15 - 0.02 * c, load), (0.4, 5.0), (0.70 - 0.02 * c, peak), (1.0 - 0.02 * c, 3.0 + 5.0 * c)]
}

fn ankle(rv: f64, c: f64) -> [(f64, f64); 5] {
    let off = support(frequency_hz(rv));
    match rv {
        _ if rv < 0.5 => [(0.0, -3.0), (0.08, -30.0 * rv - 3.0), (0.5, 22.0 * rv - 3.0), (off, -34.0 * rv - 3.0), (0.85, -3.0)],
        _ => [(0.0, 5.0 * c - 3.0), (0.08, 4.0 * c - 18.0), (0.5 - 0.1 * c, 8.0 - 3.0 * c), (off, -20.0 - 8.0 * c), (0.85, 5.0 * c - 3.0)],
    }
}

fn elbow(rv: f64, c: f64) -> [(f64, f64); 3] {
    let b = (rv - 0.5) / 0.8;
    match rv {
        _ if rv < 0.5 => [(0.05, 6.0 * rv + 3.0), (0.5, 34.0 * rv + 3.0), (0.9, 10.0 * rv + 3.0)],
        _ if rv < 1.3 => [(0.05, 6.0 + 8.0 * b), (0.5 + 0.01 * b, 20.0 + 24.0 * b), (0.9, 8.0 + 9.0 * b)],
        _ => [(0.05, 14.0 - 6.0 * c), (0.51 + 0.04 * c, 44.0 + 26.0 * c), (0.9 - 0.1 * c, 17.0 - 6.0 * c)],
    }
}

fn pelvic_list(a: f64, t: f64) -> f64 {
    match t {
        _ if t < 0.15 => -a + a * (TAU * t * 10.0 / 3.0).cos(),
        _ if t < 0.5 => -a - a * (TAU * (t - 0.15) * 10.0 / 7.0).cos(),
        _ if t < 0.65 => a - a * (TAU * (t - 0.5) * 10.0 / 3.0).cos(),
        _ => a + a * (TAU * (t - 0.65) * 10.0 / 7.0).cos(),
    }
}

/// How the feet meet the floor at `speed`.
pub(super) fn gait(speed: f64, rv: f64, cycle_s: f64) -> Gait {
    // The faster, the sooner.
    let heel_rises = (0.38 - 0.05 * (rv - 1.0)).clamp(0.30, 0.40);
    Gait {
        cycle_s,
        stride_m: speed * cycle_s,
        support: support(1.0 / cycle_s),
        leads: (0.0, 0.40),
        carries_until: 0.30,
        laid_flat: (0.01, 0.09),
        heel_rises: (heel_rises, heel_rises + 0.13),
        lets_go: (-0.12, 0.12),
        bounces: false,
        // A fifth more than the published 0.03 RV H.
        most_bob_m: 0.036 * speed,
        sway,
        clearance_m: 0.010,
        step_width: 1.0,
    }
}

/// To the left, in units of H; the body leans over the standing foot.
fn sway(t: f64) -> f64 {
    -0.032 * (TAU * (t - 0.1)).sin()
}

//! Parametric walk after Boulic, Magnenat-Thalmann and Thalmann (1990), "A global human walking model with real-time
//! kinematic personification", The Visual Computer 6: 344-358; algorithms.md 3.1 and 3.6.
//!
//! Relative velocity RV = v/H (1/s), cycle frequency f = 0.743 √RV, support share of the cycle 0.752 − 0.143 f. Angles are
//! functions of the phase t from the side's own heel strike and of RV, through control points.
//!
//! Departures: lengths are divided by the hip-joint height H = 0.53 stature, not thigh + shank; the foot is laid flat
//! between foot-flat and heel-off by the ankle, and the toes bend while the heel is up; the hip's amplitude is scaled so
//! that the standing foot travels one stride per cycle; the height of the root and its progress follow from the standing
//! feet; the thorax angle is taken against the carrier, so the spine undoes the pelvis.
//! Fails below 2 km/h (the paper's own lower zone) and above RV = 3, where people run.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

use super::SyntheticSubject;
use super::ground;
use super::posture::{Angles, Side, Soles, above_zero};
use super::variation::{Channel, TRACKS, Tracks, phase, track};
use crate::math::curves::{Pchip, low_pass, smooth_step};
use crate::math::rotation::log;
use crate::motion_model::cycle::{RootSample, SAMPLES};

/// Mid-range RV of the database, about which a subject's own slope over speed turns.
pub(super) const REFERENCE_RV: f64 = 1.5;
/// Harmonics kept of the root's path: fewer lose the dip at heel strike, more keep the jitter of changing contact points.
const ROOT_HARMONICS: usize = 6;
/// Phase until which the front foot carries the root alone: its heel rises soon after.
const LEADS_UNTIL: f64 = 0.40;
/// Weights of hip, knee and ankle in keeping the toes on the floor: more ankle leaves the foot standing on its tip.
const WILLING: Vector3<f64> = Vector3::new(1.0, 1.0, 0.25);
/// Shares of hip flexion, knee flexion and dorsiflexion in lifting a swinging foot.
const LIFT: Vector3<f64> = Vector3::new(0.3, 0.6, 0.8);
/// Height of the sole over the floor in mid swing, at least.
const CLEARANCE_M: f64 = 0.012;
/// How far the toes bend up, radians.
const TOE_LIMIT: f64 = 0.6;

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

fn hip(rv: f64, c: f64) -> [(f64, f64); 3] {
    match rv {
        _ if rv < 0.5 => [(-0.1, 50.0 * rv), (0.5, -30.0 * rv), (0.9, 50.0 * rv)],
        _ if rv < 1.3 => [(-0.1, 25.0), (0.5, -15.0), (0.9, 25.0)],
        _ => [(0.2 * c - 0.1, 5.0 * c + 25.0), (0.5, -15.0), (0.9, 6.0 * c + 25.0)],
    }
}

/// Departure: the paper's knee is straight in stance at low speed and swings to 70 degrees; people yield to the load
/// (15 to 20 degrees at 15 % of the cycle, more when faster) and swing to 60 to 65.
fn knee(rv: f64, c: f64) -> [(f64, f64); 4] {
    let load = (6.0 + 7.0 * rv).min(25.0);
    let peak = if rv < 0.5 { 124.0 * rv } else { 62.0 + 3.0 * c };
    [(0.15 - 0.02 * c, load), (0.4, 5.0), (0.74 - 0.04 * c, peak), (1.0 - 0.02 * c, 3.0 + 5.0 * c)]
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

/// Postures and root of one cycle. `tracks` hold the subject's angles; `cycle_s` the duration.
pub(super) fn cycle(subject: &SyntheticSubject, tracks: &Tracks, speed: f64, cycle_s: f64) -> (Vec<Angles>, Vec<RootSample>) {
    let support = support(1.0 / cycle_s);
    let stride_m = speed * cycle_s;
    // The stride is nearly proportional to the hip's amplitude: a few secant steps close it.
    let mut gain = 1.0;
    let mut angles = angles(subject, tracks, support, gain);
    let mut path = leading_path(subject, &angles);
    for _ in 0..3 {
        gain *= (stride_m / path.stride_m).clamp(0.5, 2.0);
        angles = self::angles(subject, tracks, support, gain);
        path = leading_path(subject, &angles);
    }
    for side in 0..2 {
        push_off(subject, &mut angles, &path, side, support);
        clear_floor(subject, &mut angles, &path, side, support);
    }
    let h = subject.hip_height_m;
    let drift = |i: usize| path.ahead_m[i] - path.stride_m * phase(i);
    let mean = (0..SAMPLES).map(drift).sum::<f64>() / SAMPLES as f64;
    let root = (0..SAMPLES).map(|i| RootSample {
        rotation: log(&angles[i].carrier_from_root()),
        position: Vector3::new(sway(phase(i)), path.height_m[i] / h - 1.0, (drift(i) - mean) / h),
    });
    let root = root.collect();
    (angles, root)
}

/// Root over one cycle, metres.
struct Path {
    height_m: Vec<f64>,
    ahead_m: Vec<f64>,
    stride_m: f64,
}

/// Height and progress as the leading foot dictates, from its heel strike until its heel rises; in between smoothly on.
fn leading_path(subject: &SyntheticSubject, angles: &[Angles]) -> Path {
    let soles: Vec<Soles> = angles.iter().map(|a| subject.soles(a).0).collect();
    let leads = |t: f64| if t < LEADS_UNTIL { 1.0 } else { 0.0 };
    let contact: Vec<_> = (0..SAMPLES).map(|i| [leads(own_phase(i, 0)), leads(own_phase(i, 1))]).collect();
    let bridged = |values: Vec<Option<f64>>| {
        let known: Vec<_> = values.iter().enumerate().filter_map(|(i, v)| Some((phase(i), (*v)?))).collect();
        let curve = Pchip::periodic(&known);
        let all: Vec<_> = (0..SAMPLES).map(|i| curve.at(phase(i))).collect();
        low_pass(&all, ROOT_HARMONICS)
    };
    let height_m = bridged(ground::heights(&soles, &contact));
    let steps = bridged(ground::steps(&soles, &contact).into_iter().map(|s| Some(s?.z)).collect());
    let mut ahead_m = vec![0.0; SAMPLES];
    for i in 1..SAMPLES {
        ahead_m[i] = ahead_m[i - 1] + steps[i - 1];
    }
    Path { height_m, ahead_m, stride_m: steps.iter().sum() }
}

/// While the heel is up the toes stay where they were planted: hip and ankle give way. The correction fades in swing.
fn push_off(subject: &SyntheticSubject, angles: &mut [Angles], path: &Path, side: usize, support: f64) {
    let strike = if side == 0 { SAMPLES / 2 } else { 0 };
    let ahead = |k: usize| path.ahead_m[k % SAMPLES] + path.stride_m * (k / SAMPLES) as f64;
    let planted = strike + (LEADS_UNTIL * 0.8 * SAMPLES as f64) as usize;
    let toe_z = |angles: &Angles| subject.soles(angles).0[side][2].z;
    let planted_z = ahead(planted) + toe_z(&angles[planted % SAMPLES]);
    let mut last = Vector3::zeros();
    for k in planted + 1..strike + SAMPLES {
        let (i, t) = (k % SAMPLES, (k - strike) as f64 / SAMPLES as f64);
        if t <= support {
            let fade_in = smooth_step(phase(planted - strike), LEADS_UNTIL + 0.05, t);
            last = fade_in * stand_on_toes(subject, &angles[i], side, [planted_z - ahead(k), -path.height_m[i]]);
        }
        turn(&mut angles[i].sides[side], &(last * (1.0 - smooth_step(support, support + 0.25, t))));
        bend_toes(subject, &mut angles[i], side, t, support);
    }
}

/// Turns of hip, knee and ankle with the smallest weighted norm that put the toe tip at `target` z, and the lower of ball
/// and toe tip at its y: Gauss-Newton, damped because a foot on its tip cannot push the body higher.
fn stand_on_toes(subject: &SyntheticSubject, angles: &Angles, side: usize, target: [f64; 2]) -> Vector3<f64> {
    let miss = |by: &Vector3<f64>| {
        let mut angles = *angles;
        turn(&mut angles.sides[side], by);
        bend_toes(subject, &mut angles, side, 0.5, 1.0);
        let [_, ball, toe] = subject.soles(&angles).0[side];
        Vector2::new(toe.z - target[0], ball.y.min(toe.y) - target[1])
    };
    let mut by = Vector3::zeros();
    for _ in 0..8 {
        let here = miss(&by);
        let jacobian = Matrix2x3::from_columns(&[0, 1, 2].map(|k| (miss(&(by + Vector3::ith(k, 1e-4))) - here) / 1e-4));
        let spread = jacobian * Matrix3::from_diagonal(&WILLING);
        let Some(inverse) = (spread * jacobian.transpose() + Matrix2::identity() * 1e-4).try_inverse() else { break };
        let step = spread.transpose() * inverse * here;
        by -= step * (0.2 / step.norm().max(0.2));
    }
    by
}

fn turn(leg: &mut Side, by: &Vector3<f64>) {
    leg.hip_flexion += by.x;
    leg.knee += by.y;
    leg.ankle += by.z;
}

/// A swinging foot that would touch the floor is lifted by ankle, knee and hip.
fn clear_floor(subject: &SyntheticSubject, angles: &mut [Angles], path: &Path, side: usize, support: f64) {
    // The heel comes down by itself at the end of the swing; ball and toes must not.
    let lowest = |angles: &Angles| subject.soles(angles).0[side][1..].iter().map(|p| p.y).fold(f64::INFINITY, f64::min);
    for _ in 0..2 {
        let lift = |i: usize| {
            let swing = (own_phase(i, side) - support - 0.04) / (0.96 - support);
            let wanted = CLEARANCE_M * (std::f64::consts::PI * swing.clamp(0.0, 1.0)).sin().sqrt();
            let lack = if swing > 0.0 { (wanted - path.height_m[i] - lowest(&angles[i])).max(0.0) } else { 0.0 };
            let mut moved = angles[i];
            turn(&mut moved.sides[side], &(LIFT * 1e-3));
            let rate = (lowest(&moved) - lowest(&angles[i])) / 1e-3;
            lack / rate.max(0.1 * subject.hip_height_m)
        };
        let lifts: Vec<f64> = (0..SAMPLES).map(lift).collect();
        for (i, angles) in angles.iter_mut().enumerate() {
            // The widened maximum keeps the lift smooth and still enough where it is needed.
            let near = |reach: usize| (0..=2 * reach).map(move |k| (i + SAMPLES + k - reach) % SAMPLES);
            let widest = |i: usize| (0..=8).map(|k| lifts[(i + SAMPLES + k - 4) % SAMPLES]).fold(0.0, f64::max);
            let smooth = near(4).map(widest).sum::<f64>() / 9.0;
            turn(&mut angles.sides[side], &(LIFT * smooth));
        }
    }
}

/// To the left, in units of H; the body leans over the standing foot.
fn sway(t: f64) -> f64 {
    -0.032 * (TAU * (t - 0.1)).sin()
}

/// Phase of a sample from the side's own heel strike.
fn own_phase(sample: usize, side: usize) -> f64 {
    phase((sample + if side == 0 { SAMPLES / 2 } else { 0 }) % SAMPLES)
}

/// Angles with the hip's swing multiplied by `gain`, feet under the body, flat in mid stance.
fn angles(subject: &SyntheticSubject, tracks: &Tracks, support: f64, gain: f64) -> Vec<Angles> {
    let mut mean = [0.0; TRACKS];
    for sample in tracks {
        for (m, y) in mean.iter_mut().zip(sample) {
            *m += y / SAMPLES as f64;
        }
    }
    let at = |(i, sample): (usize, &[f64; TRACKS])| {
        let mut sample = *sample;
        for side in 0..2 {
            let hip = track(Channel::HipFlexion, side);
            sample[hip] = mean[hip] + gain * (sample[hip] - mean[hip]);
        }
        let mut angles = Angles::from_tracks(&sample);
        for side in 0..2 {
            let sign = if side == 0 { 1.0 } else { -1.0 };
            let adduction = sample[track(Channel::HipAdduction, side)] - mean[track(Channel::HipAdduction, side)];
            let foot_from_hip = sign * (0.5 * subject.step_width - subject.hip_breadth) - sway(phase(i));
            angles.sides[side].leg_lateral = foot_from_hip.asin() - sign * 0.3 * adduction.to_radians();
            let t = own_phase(i, side);
            let flat = smooth_step(0.01, 0.09, t) * (1.0 - smooth_step(0.34, 0.48, t));
            angles.sides[side].ankle -= flat * subject.soles(&angles).1[side];
            bend_toes(subject, &mut angles, side, t, support);
        }
        angles
    };
    tracks.iter().enumerate().map(at).collect()
}

/// Toes stay level while the heel is up, as far as they bend, and stretch after toe-off.
fn bend_toes(subject: &SyntheticSubject, angles: &mut Angles, side: usize, t: f64, support: f64) {
    let heel_up = above_zero(-subject.soles(angles).1[side], 0.03);
    let standing = smooth_step(0.2, 0.3, t) * (1.0 - smooth_step(support, support + 0.15, t));
    angles.sides[side].toe = standing * TOE_LIMIT * (heel_up / TOE_LIMIT).tanh();
}

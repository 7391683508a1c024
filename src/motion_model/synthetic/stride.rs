//! Walking and running cycles whose feet keep to the floor.
//!
//! From a subject's angles over the cycle: each foot is laid flat between foot-flat and heel-off by the ankle, the toes
//! bend while the heel is up, the hip's amplitude is scaled so that the standing foot travels one stride per cycle, the
//! root follows the standing feet (ground.rs; a runner's root bounces under gravity), what still slides is taken up
//! by small turns of hip, knee and ankle, and a swinging foot is lifted over the floor.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

use super::posture::{Angles, FOOT_LENGTH, Side, Soles, above_zero};
use super::variation::{Channel, TRACKS, Tracks, phase, track};
use super::{GRAVITY, SyntheticSubject, ground};
use crate::math::curves::{Pchip, hermite, low_pass, smooth_step};
use crate::math::rotation::log;
use crate::motion_model::cycle::{RootSample, SAMPLES};

/// Harmonics kept of the root's path: fewer lose the dip at heel strike, more keep the jitter of changing contact points.
const ROOT_HARMONICS: usize = 8;
/// Share of the feet's own surging that the root follows: the published curves alone would halve the speed at heel
/// strike, where people lose a tenth.
const SURGE: f64 = 0.3;
/// Long strides of walkers reach back more than forward: shift of the hip, degrees per unit of gain.
const FARTHER_BACK_DEG: f64 = 5.0;
/// Weights of hip, knee and ankle in keeping the toes on the floor: more ankle leaves the foot standing on its tip.
const WILLING: Vector3<f64> = Vector3::new(1.0, 1.5, 0.25);
/// Shares of hip flexion, knee flexion and dorsiflexion in lifting a swinging foot.
const LIFT: Vector3<f64> = Vector3::new(0.25, 0.45, 0.50);
const LIFT_HEEL: Vector3<f64> = Vector3::new(0.5, 1.0, 0.0);
/// How far the ankle stretches at push-off, radians.
const PLANTARFLEXION_LIMIT: f64 = 0.55;
/// How far it bends while the heel is up: more lets the solver put the foot down heel first.
const DORSIFLEXION_LIMIT: f64 = 0.48;
/// How deep a walker's foot may sink into the floor before the knee gives: less makes straight knees jerk.
const SINKS_M: f64 = 0.008;
/// From which miss on a foot that cannot stand on its toes is left flat.
const OUT_OF_REACH_M: f64 = 0.03;
/// Toe tip before the root in mid stance, and how much people differ in it at most, fractions of stature: farther ahead
/// the front leg pulls the body down at heel strike, farther behind the rear leg cannot push off.
const TOE_AHEAD: f64 = 0.085;
const TOE_AHEAD_SPREAD: f64 = 0.02;
/// Where the iterations that place a foot stop.
const CLOSE_ENOUGH_M: f64 = 1e-4;
/// How much lower than at take-off a runner lands at most.
const MOST_DROP_M: f64 = 0.05;
/// A leg that carries does not stretch beyond this, radians.
const KNEE_LIMIT: f64 = 0.10;
/// How far the toes bend up, radians.
const TOE_LIMIT: f64 = 0.6;

/// How the feet meet the floor. Phases count from the foot's own strike.
pub(super) struct Gait {
    pub cycle_s: f64,
    pub stride_m: f64,
    /// Share of the cycle that a foot stands.
    pub support: f64,
    /// From and until when a foot says how fast the root goes.
    pub leads: (f64, f64),
    /// Until when it also says how high: later it is the heel's turn to rise.
    pub carries_until: f64,
    pub laid_flat: (f64, f64),
    pub heel_rises: (f64, f64),
    /// From and until when a foot lets go of the floor, after the end of its support.
    pub lets_go: (f64, f64),
    /// The root's height obeys gravity between the steps instead of following the feet.
    pub bounces: bool,
    /// The root of a walker rises and falls by this much at most, metres.
    pub most_bob_m: f64,
    /// Sway to the left in units of H.
    pub sway: fn(f64) -> f64,
    /// Height of the sole over the floor in mid swing, at least; metres.
    pub clearance_m: f64,
    /// Factor on the subject's step width in walking.
    pub step_width: f64,
}

/// Postures and root of one cycle. `tracks` hold the subject's angles; `cycle_s` the duration.
pub(super) fn cycle(subject: &SyntheticSubject, tracks: &Tracks, gait: &Gait) -> (Vec<Angles>, Vec<RootSample>) {
    // The stride is nearly proportional to the hip's amplitude: a few secant steps close it.
    let (mut gain, mut lean) = (1.0, [0.0; 2]);
    let mut angles = angles(subject, tracks, gait, gain, lean);
    let mut path = leading_path(subject, gait, &angles);
    for _ in 0..2 {
        gain *= (gait.stride_m / path.stride_m).clamp(0.5, 2.0);
        if !gait.bounces {
            lean = [0, 1].map(|side| lean[side] + too_far_ahead(subject, &angles, side));
        }
        angles = self::angles(subject, tracks, gait, gain, lean);
        path = leading_path(subject, gait, &angles);
    }
    for side in 0..2 {
        plant(subject, &mut angles, &path, side, gait);
        clear_floor(subject, &mut angles, &path, side, gait);
    }
    let h = subject.hip_height_m;
    let drift = |i: usize| path.ahead_m[i] - path.stride_m * phase(i);
    let mean = (0..SAMPLES).map(drift).sum::<f64>() / SAMPLES as f64;
    let root = (0..SAMPLES).map(|i| RootSample {
        rotation: log(&angles[i].carrier_from_root()),
        position: Vector3::new((gait.sway)(phase(i)), path.height_m[i] / h - 1.0, (drift(i) - mean) / h),
    });
    let root = root.collect();
    (angles, root)
}

/// By how much the hip must extend so that the foot stands under the body in mid stance as far ahead as in other people.
fn too_far_ahead(subject: &SyntheticSubject, angles: &[Angles], side: usize) -> f64 {
    let middle = (0..SAMPLES).find(|&i| own_phase(i, side) == 0.24).unwrap_or(0);
    let ahead = subject.sole(&angles[middle], side)[2].z / subject.stature_m - TOE_AHEAD;
    (ahead - TOE_AHEAD_SPREAD * (ahead / TOE_AHEAD_SPREAD).tanh()) * subject.stature_m / subject.hip_height_m
}

/// Root over one cycle, metres.
struct Path {
    height_m: Vec<f64>,
    ahead_m: Vec<f64>,
    stride_m: f64,
}

/// Height and progress as the leading foot dictates, from its heel strike until its heel rises; in between smoothly on.
fn leading_path(subject: &SyntheticSubject, gait: &Gait, angles: &[Angles]) -> Path {
    let soles: Vec<Soles> = angles.iter().map(|a| [0, 1].map(|side| subject.sole(a, side))).collect();
    let contact = |from: f64, until: f64| -> Vec<[f64; 2]> {
        let stands = |i, side| if (from..until).contains(&own_phase(i, side)) { 1.0 } else { 0.0 };
        (0..SAMPLES).map(|i| [stands(i, 0), stands(i, 1)]).collect()
    };
    let bridged = |values: Vec<Option<f64>>| {
        let known: Vec<_> = values.iter().enumerate().filter_map(|(i, v)| Some((phase(i), (*v)?))).collect();
        let curve = Pchip::periodic(&known);
        let all: Vec<_> = (0..SAMPLES).map(|i| curve.at(phase(i))).collect();
        low_pass(&all, ROOT_HARMONICS)
    };
    let heights = ground::heights(&soles, &contact(gait.leads.0, gait.carries_until));
    let height_m = if gait.bounces { bounce(gait, &heights) } else { calmed(bridged(heights), gait.most_bob_m) };
    let steps = bridged(ground::steps(&soles, &contact(gait.leads.0, gait.leads.1)).into_iter().map(|s| Some(s?.z)).collect());
    let mut ahead_m = vec![0.0; SAMPLES];
    for i in 1..SAMPLES {
        ahead_m[i] = ahead_m[i - 1] + steps[i - 1];
    }
    let stride_m: f64 = steps.iter().sum();
    let drift: Vec<_> = ahead_m.iter().enumerate().map(|(i, z)| z - stride_m * phase(i)).collect();
    let ahead_m = low_pass(&drift, 3).iter().enumerate().map(|(i, z)| SURGE * z + stride_m * phase(i)).collect();
    Path { height_m, ahead_m, stride_m }
}

/// Heights with a bob of at most `most_m`. What is taken off the bob lowers the root by a quarter, so that the front leg
/// still reaches the floor; the knees give in mid stance.
fn calmed(height_m: Vec<f64>, most_m: f64) -> Vec<f64> {
    let (min, max) = height_m.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &y| (a.min(y), b.max(y)));
    let mean = height_m.iter().sum::<f64>() / height_m.len() as f64;
    let kept = (most_m / (max - min)).min(1.0);
    height_m.iter().map(|y| mean + kept * (y - mean) - 0.25 * (1.0 - kept) * (max - min)).collect()
}

/// Root height of a runner: a parabola under gravity while no foot stands, a cubic while one does that continues it
/// in height and speed. Level and drop (a runner lands lower than it takes off) by least squares against
/// the height that the standing legs give.
fn bounce(gait: &Gait, heights: &[Option<f64>]) -> Vec<f64> {
    let (stance_s, flight_s) = (gait.support * gait.cycle_s, (0.5 - gait.support) * gait.cycle_s);
    let shape = |drop: f64, i: usize| {
        let (up, down) = (0.5 * GRAVITY * flight_s - drop / flight_s, 0.5 * GRAVITY * flight_s + drop / flight_s);
        let s = phase(i).rem_euclid(0.5) * gait.cycle_s - stance_s;
        let stance = || hermite(&[-stance_s, -drop, -down], &[0.0, 0.0, up], s);
        if s < 0.0 { stance() } else { up * s - 0.5 * GRAVITY * s * s }
    };
    let known: Vec<_> = heights.iter().enumerate().filter_map(|(i, h)| Some((i, (*h)?))).collect();
    let mean = |value: &dyn Fn(usize, f64) -> f64| known.iter().map(|&(i, h)| value(i, h)).sum::<f64>() / known.len() as f64;
    let effect = |i: usize| shape(1.0, i) - shape(0.0, i);
    let (gap, slope) = (mean(&|i, h| h - shape(0.0, i)), mean(&|i, _| effect(i)));
    let covariance = mean(&|i, h| (h - shape(0.0, i) - gap) * (effect(i) - slope));
    let drop = (covariance / mean(&|i, _| (effect(i) - slope).powi(2))).clamp(0.0, MOST_DROP_M);
    let level = gap - drop * slope;
    (0..SAMPLES).map(|i| level + shape(drop, i)).collect()
}

/// A standing foot stays where it is: the hip gives way while the foot is flat, hip, knee and ankle while the heel is up.
/// Before heel strike and after toe-off the correction fades.
fn plant(subject: &SyntheticSubject, angles: &mut [Angles], path: &Path, side: usize, gait: &Gait) {
    let strike = if side == 0 { SAMPLES / 2 } else { 0 };
    let at = |k: usize| (strike + k) % SAMPLES;
    let ahead = |k: usize| path.ahead_m[at(k)] + path.stride_m * ((strike + k) / SAMPLES) as f64;
    let flat: Vec<usize> = (0..SAMPLES).filter(|&k| (gait.laid_flat.1..gait.heel_rises.0).contains(&phase(k))).collect();
    let toe_z = flat.iter().map(|&k| ahead(k) + subject.sole(&angles[at(k)], side)[2].z).sum::<f64>() / flat.len() as f64;
    let correction = |k: usize| {
        let rise = smooth_step(gait.heel_rises.0 - 0.02, gait.heel_rises.1 - 0.02, phase(k));
        let target = [toe_z - ahead(k), -path.height_m[at(k)]];
        let hold = hold_flat(subject, &angles[at(k)], side, phase(k), target, gait);
        let stand = if rise > 0.0 { stand_on_toes(subject, &angles[at(k)], side, target, gait).unwrap_or(hold) } else { hold };
        hold.lerp(&stand, rise)
    };
    let turns: Vec<_> = (0..=(gait.support * SAMPLES as f64) as usize).map(correction).collect();
    let turns = smoothed(&turns);
    let (first, last) = (turns[0], turns[turns.len() - 1]);
    for k in 0..SAMPLES {
        let t = phase(k);
        let fade_out = 1.0 - smooth_step(gait.support + gait.lets_go.0, gait.support + gait.lets_go.1, t);
        let by = turns.get(k).unwrap_or(&last) * fade_out + first * smooth_step(0.85, 1.0, t);
        turn(&mut angles[at(k)].sides[side], &by);
        bend_toes(&mut angles[at(k)], side, t, gait);
    }
}

/// Mean over seven neighbours, near ones more: a stretched leg and a bent one may both reach, and the change from one to the
/// other takes time.
fn smoothed(turns: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let weights = [1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0];
    let at = |k: usize| turns[k.saturating_sub(3).min(turns.len() - 1)];
    (0..turns.len()).map(|k| weights.iter().enumerate().map(|(j, w)| at(k + j) * (w / 16.0)).sum()).collect()
}

/// Turn of the hip (and of the knee, as far as the root's path asks for it), undone at the ankle, that puts the toe
/// tip at `target` z, or the heel where it must be for that, and the lowest sole point at its y.
fn hold_flat(subject: &SyntheticSubject, angles: &Angles, side: usize, t: f64, target: [f64; 2], gait: &Gait) -> Vector3<f64> {
    let toe_share = smooth_step(0.03, 0.12, t);
    let of_hip_and_knee = |v: &Vector2<f64>| Vector3::new(v.x, v.y, v.y - v.x);
    let miss = |v: &Vector2<f64>| {
        let mut angles = *angles;
        turn(&mut angles.sides[side], &of_hip_and_knee(v));
        let [heel, ball, toe] = subject.sole(&angles, side);
        let z = toe_share * toe.z + (1.0 - toe_share) * (heel.z + FOOT_LENGTH * subject.stature_m) - target[0];
        let sinks_m = if gait.bounces { 0.0 } else { SINKS_M };
        Vector2::new(z, heel.y.min(ball.y).min(toe.y) + sinks_m - target[1])
    };
    let mut v = Vector2::zeros();
    for _ in 0..6 {
        let here = miss(&v);
        // A walker's root follows the leg: the knee only gives where the foot would sink deep.
        let knee_gives = gait.bounces || here.y < 0.0 || v.y > 0.0;
        if here.x.abs() < CLOSE_ENOUGH_M && (!knee_gives || here.y.abs() < CLOSE_ENOUGH_M) {
            break;
        }
        let by_hip = (miss(&(v + Vector2::x() * 1e-4)) - here) / 1e-4;
        let most = if gait.bounces { KNEE_LIMIT - angles.sides[side].knee } else { 0.0 };
        let mut step = Vector2::new(here.x / by_hip.x.max(0.3 * subject.hip_height_m), 0.0);
        if knee_gives {
            let by_knee = (miss(&(v + Vector2::y() * 1e-4)) - here) / 1e-4;
            let jacobian = Matrix2::from_columns(&[by_hip, by_knee]);
            let normal = jacobian.transpose() * jacobian + Matrix2::identity() * 1e-4;
            let Some(inverse) = normal.try_inverse() else { break };
            let both = inverse * jacobian.transpose() * here;
            // A stretched leg that is still too short only turns at the hip.
            let stretched = Vector2::new(step.x, (v.y - most).max(0.0));
            step = if v.y - both.y < most { stretched } else { both };
        }
        v -= step * (0.2 / step.norm().max(0.2));
    }
    of_hip_and_knee(&v)
}

/// Turns of hip, knee and ankle with the smallest weighted norm that put the toe tip at `target` z, and the lowest sole
/// point at its y: Gauss-Newton, damped because a foot on its tip cannot push the body higher;
/// `None` where that is out of reach.
fn stand_on_toes(subject: &SyntheticSubject, angles: &Angles, side: usize, target: [f64; 2], gait: &Gait) -> Option<Vector3<f64>> {
    let miss = |by: &Vector3<f64>| {
        let mut angles = *angles;
        turn(&mut angles.sides[side], by);
        bend_toes(&mut angles, side, gait.heel_rises.1.min(gait.support), gait);
        let [heel, ball, toe] = subject.sole(&angles, side);
        Vector2::new(toe.z - target[0], heel.y.min(ball.y).min(toe.y) - target[1])
    };
    let mut by = Vector3::zeros();
    for _ in 0..8 {
        let here = miss(&by);
        if here.norm() < CLOSE_ENOUGH_M {
            break;
        }
        let jacobian = Matrix2x3::from_columns(&[0, 1, 2].map(|k| (miss(&(by + Vector3::ith(k, 1e-4))) - here) / 1e-4));
        let spread = jacobian * Matrix3::from_diagonal(&WILLING);
        let Some(inverse) = (spread * jacobian.transpose() + Matrix2::identity() * 1e-4).try_inverse() else { break };
        let step = spread.transpose() * inverse * here;
        by -= step * (0.2 / step.norm().max(0.2));
        by.y = by.y.max((KNEE_LIMIT - angles.sides[side].knee).min(0.0));
        let ankle = angles.sides[side].ankle;
        by.z = (ankle + by.z).clamp(-PLANTARFLEXION_LIMIT, DORSIFLEXION_LIMIT.max(ankle)) - ankle;
    }
    (miss(&by).norm() < OUT_OF_REACH_M).then_some(by)
}

fn turn(leg: &mut Side, by: &Vector3<f64>) {
    leg.hip_flexion += by.x;
    leg.knee += by.y;
    leg.ankle += by.z;
}

/// A swinging foot that would touch the floor is lifted by ankle, knee and hip.
fn clear_floor(subject: &SyntheticSubject, angles: &mut [Angles], path: &Path, side: usize, gait: &Gait) {
    let lowest = |angles: &Angles| {
        let [heel, ball, toe] = subject.sole(angles, side).map(|p| p.y);
        // A walker's heel comes down by itself at the end of the swing, and dorsiflexion would only lower it.
        if gait.bounces && heel < ball.min(toe) { (heel, LIFT_HEEL) } else { (ball.min(toe), LIFT) }
    };
    for _ in 0..2 {
        let lift = |i: usize| {
            let swing = (own_phase(i, side) - gait.support - 0.04) / (0.99 - gait.support);
            let wanted = gait.clearance_m * (std::f64::consts::PI * swing.clamp(0.0, 1.0)).sin().sqrt();
            let (height, way) = lowest(&angles[i]);
            let lack = if (0.0..1.0).contains(&swing) { (wanted - path.height_m[i] - height).max(0.0) } else { 0.0 };
            let mut moved = angles[i];
            turn(&mut moved.sides[side], &(way * 1e-3));
            let rate = (lowest(&moved).0 - height) / 1e-3;
            way * (lack / rate.max(0.1 * subject.hip_height_m))
        };
        let lifts: Vec<_> = (0..SAMPLES).map(lift).collect();
        for (i, angles) in angles.iter_mut().enumerate() {
            // The widened maximum keeps the lift smooth and still enough where it is needed.
            let widest = |i: usize| (0..=6).map(|k| lifts[(i + SAMPLES + k - 3) % SAMPLES]).fold(Vector3::zeros(), |a, b| a.sup(&b));
            let smooth = (0..=6).map(|k| widest((i + SAMPLES + k - 3) % SAMPLES)).sum::<Vector3<f64>>() / 7.0;
            turn(&mut angles.sides[side], &smooth);
        }
    }
}

/// Phase of a sample from the side's own heel strike.
fn own_phase(sample: usize, side: usize) -> f64 {
    phase((sample + if side == 0 { SAMPLES / 2 } else { 0 }) % SAMPLES)
}

/// Angles with the hip's swing multiplied by `gain`, its middle put back by `lean`, feet under the body, flat in mid stance.
fn angles(subject: &SyntheticSubject, tracks: &Tracks, gait: &Gait, gain: f64, lean: [f64; 2]) -> Vec<Angles> {
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
            sample[hip] = mean[hip] + gain * (sample[hip] - mean[hip]) - if gait.bounces { 0.0 } else { FARTHER_BACK_DEG * (gain - 1.0) };
        }
        let mut angles = Angles::from_tracks(&sample, &subject.offsets);
        for side in 0..2 {
            angles.sides[side].hip_flexion -= lean[side];
            let sign = if side == 0 { 1.0 } else { -1.0 };
            // A standing foot does not turn.
            angles.sides[side].toe_out = -mean[track(Channel::HipRotation, side)].to_radians();
            let adduction = sample[track(Channel::HipAdduction, side)] - mean[track(Channel::HipAdduction, side)];
            let foot_x = sign * 0.5 * gait.step_width * subject.step_width - (gait.sway)(phase(i)) - sign * 0.1 * adduction.to_radians();
            let mut leg = angles.lower_leg(side);
            for _ in 0..2 {
                let [heel, _, toe] = leg.sole(&subject.offsets, subject.stature_m);
                angles.sides[side].leg_lateral += foot_x - 0.5 * (heel.x + toe.x) / subject.hip_height_m;
                leg.tilt(angles.sides[side].leg_lateral);
            }
            let t = own_phase(i, side);
            let flat = smooth_step(gait.laid_flat.0, gait.laid_flat.1, t) * (1.0 - smooth_step(gait.heel_rises.0, gait.heel_rises.1, t));
            angles.sides[side].ankle -= flat * leg.foot_pitch();
            bend_toes(&mut angles, side, t, gait);
        }
        angles
    };
    tracks.iter().enumerate().map(at).collect()
}

/// Toes stay level while the heel is up, as far as they bend, and stretch after toe-off.
fn bend_toes(angles: &mut Angles, side: usize, t: f64, gait: &Gait) {
    let (rises, off) = (gait.heel_rises.0, gait.support);
    let standing = smooth_step(rises - 0.12, rises - 0.02, t) * (1.0 - smooth_step(off, off + 0.15, t));
    let bent = |pitch: f64| TOE_LIMIT * (above_zero(-pitch, 0.03) / TOE_LIMIT).tanh();
    angles.sides[side].toe = if standing > 0.0 { standing * bent(angles.foot_pitch(side)) } else { 0.0 };
}

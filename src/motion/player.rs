//! Plays a person's gait in real time: `next(dt)` is the pose dt later, at a speed, bend and manner that may change at any
//! moment.
//!
//! Everything that is steered runs after its target as a critically damped spring, solved exactly for any dt:
//!   x(t) = x* + (x0 − x* + c t) e^{−ωt},   c = ẋ0 + ω (x0 − x*)                                                   (1)
//! so speeds and their changes are continuous; a ramp is followed 2/ω late, which [`Profile`](super::Profile) undoes.
//! Phase and path follow: Δμ = f(v) Δt, Δψ = κ v Δt, and the root goes the chord of its arc.
//!
//! Walking becomes running where the Froude number v²/(g H) reaches 1/2 (Alexander 1989), a little above on the way up and
//! below on the way down, and is blended over one cycle: rotations on the shorter way, cycles per second geometrically, the
//! running cycle shifted to where its legs agree best. In a bend of curvature κ the whole person leans inward by
//!   tan φ = v² κ / g                                                                                               (2)
//! about the ground line under the path, as the force through the feet must; the root stays over the path, and the ankles
//! give way so that the soles stay flat.
//! Fails when: bends are tighter than a few steps; people then pivot on one foot.
//! Checked against differences of positions and angles at halved steps, path curvature by finite differences, and (2)
//! measured on the poses.

use nalgebra::{UnitQuaternion, Vector3};

use super::gait::{Gait, Posture, aligning_phase};
use crate::body::{Joint, Pose};
use crate::math::rotation::{exp, log};

pub const GRAVITY_M_S2: f64 = 9.81;
/// 1/ω of (1). Shorter shows every corner of a profile as a jerk, longer rounds it over more steps.
pub const RESPONSE_S: f64 = 0.2;
/// Froude number of the walk-run transition, and how far to both sides of its speed the change is made.
const TRANSITION_FROUDE: f64 = 0.5;
const HYSTERESIS: f64 = 0.05;
/// Cycles that a change of gait takes.
const CHANGE_CYCLES: f64 = 1.0;
/// Slower than this a person stands, and sets out with the right foot.
const STANDS_M_S: f64 = 1e-6;
/// Hardest start and stop, m/s²: targets farther away are approached at this rate.
pub const ACCELERATION_M_S2: f64 = 4.0;

/// A number that follows its target smoothly, equation (1).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Eased {
    pub target: f64,
    value: f64,
    rate: f64,
}

impl Eased {
    pub fn at(value: f64) -> Eased {
        Eased { target: value, value, rate: 0.0 }
    }

    pub fn value(&self) -> f64 {
        self.value
    }

    fn advance(&mut self, dt_s: f64) {
        let omega = 1.0 / RESPONSE_S;
        let away = self.value - self.target;
        let c = self.rate + omega * away;
        let decay = (-omega * dt_s).exp();
        self.value = self.target + (away + c * dt_s) * decay;
        self.rate = (self.rate - omega * c * dt_s) * decay;
    }
}

/// One gait, or walking and running of the same body.
#[derive(Clone, Debug)]
pub struct Gaits {
    pub slow: Gait,
    fast: Option<Fast>,
}

#[derive(Clone, Debug)]
struct Fast {
    gait: Gait,
    /// Phase of the fast gait minus that of the slow one.
    shift: f64,
    transition_m_s: f64,
}

impl Gaits {
    pub fn one(gait: Gait) -> Gaits {
        Gaits { slow: gait, fast: None }
    }

    /// Walking below and running above the transition speed.
    pub fn walk_and_run(walk: Gait, run: Gait) -> Gaits {
        let transition_m_s = (TRANSITION_FROUDE * GRAVITY_M_S2 * walk.hip_height_m).sqrt();
        let shift = aligning_phase(&walk, &run, transition_m_s);
        Gaits { slow: walk, fast: Some(Fast { gait: run, shift, transition_m_s }) }
    }

    pub fn fast(&self) -> Option<&Gait> {
        self.fast.as_ref().map(|f| &f.gait)
    }

    /// Speed about which walking and running change; `None` for one gait.
    pub fn transition_m_s(&self) -> Option<f64> {
        self.fast.as_ref().map(|f| f.transition_m_s)
    }
}

/// A person on the way. Set the targets at any time; no step allocates.
#[derive(Clone, Debug)]
pub struct Player<'a> {
    gaits: &'a Gaits,
    pub target_speed_m_s: f64,
    /// Curvature of the path to come, 1/m: positive to the left, zero straight on.
    pub target_curvature: f64,
    /// Amounts of the changes of [`Gait::add_change`], for both gaits; set their `target`.
    pub amounts: Vec<Eased>,
    speed: Eased,
    curvature: Eased,
    /// Direction of the path: angle about +y from +z.
    heading: f64,
    /// Where the root is over the floor, without its motion within the cycle.
    ground: Vector3<f64>,
    phase: f64,
    /// 0 slow, 1 fast, and the way between.
    change: f64,
    to_fast: bool,
}

impl<'a> Player<'a> {
    /// Already under way at `speed_m_s` along +z, at the beginning of a cycle; at zero speed standing.
    pub fn new(gaits: &'a Gaits, speed_m_s: f64, curvature: f64) -> Player<'a> {
        let speed_m_s = speed_m_s.max(0.0);
        let to_fast = gaits.fast.as_ref().is_some_and(|f| speed_m_s > f.transition_m_s);
        let changes = gaits.slow.changes().max(gaits.fast().map_or(0, Gait::changes));
        let phase = if speed_m_s < STANDS_M_S { gaits.slow.start_phase() } else { 0.0 };
        Player {
            gaits,
            target_speed_m_s: speed_m_s,
            target_curvature: curvature,
            amounts: vec![Eased::default(); changes],
            speed: Eased::at(speed_m_s),
            curvature: Eased::at(curvature),
            heading: 0.0,
            ground: Vector3::zeros(),
            phase,
            change: if to_fast { 1.0 } else { 0.0 },
            to_fast,
        }
    }

    /// The pose `dt_s` later, in a y-up world whose floor is y = 0.
    pub fn next(&mut self, dt_s: f64) -> Pose {
        self.advance(dt_s);
        self.pose()
    }

    pub fn speed_m_s(&self) -> f64 {
        self.speed.value
    }

    pub fn phase(&self) -> f64 {
        self.phase
    }

    pub fn heading(&self) -> f64 {
        self.heading
    }

    /// Position over the floor without the motion within the cycle.
    pub fn ground(&self) -> Vector3<f64> {
        self.ground
    }

    /// Share of the fast gait in the posture.
    pub fn running(&self) -> f64 {
        let u = self.change;
        u * u * u * (u * (6.0 * u - 15.0) + 10.0)
    }

    /// Inward lean, equation (2); positive to the left.
    pub fn lean(&self) -> f64 {
        (self.speed.value.powi(2) * self.curvature.value / GRAVITY_M_S2).atan()
    }

    fn advance(&mut self, dt_s: f64) {
        let (v0, curvature0, f0) = (self.speed.value, self.curvature.value, self.frequency_hz());
        let hardest = ACCELERATION_M_S2 * dt_s;
        self.speed.target += (self.target_speed_m_s.max(0.0) - self.speed.target).clamp(-hardest, hardest);
        self.speed.advance(dt_s);
        self.speed.value = self.speed.value.max(0.0);
        self.curvature.target = self.target_curvature;
        self.curvature.advance(dt_s);
        self.amounts.iter_mut().for_each(|a| a.advance(dt_s));
        let way = 0.5 * (v0 + self.speed.value) * dt_s;
        let turn = 0.5 * (curvature0 + self.curvature.value) * way;
        let chord = if turn.abs() < 1e-9 { way } else { way * (0.5 * turn).sin() / (0.5 * turn) };
        let direction = self.heading + 0.5 * turn;
        self.ground += Vector3::new(direction.sin(), 0.0, direction.cos()) * chord;
        self.heading += turn;
        let cycles = 0.5 * (f0 + self.frequency_hz()) * dt_s;
        self.phase = if self.speed.value < STANDS_M_S { self.gaits.slow.start_phase() } else { (self.phase + cycles).rem_euclid(1.0) };
        self.change_gait(cycles);
    }

    /// A change once begun is finished before the next one.
    fn change_gait(&mut self, cycles: f64) {
        let Some(fast) = &self.gaits.fast else { return };
        let v = self.speed.value / fast.transition_m_s;
        if self.change == 0.0 {
            self.to_fast = v > 1.0 + HYSTERESIS;
        } else if self.change == 1.0 {
            self.to_fast = v > 1.0 - HYSTERESIS;
        }
        let step = cycles / CHANGE_CYCLES;
        self.change = (self.change + if self.to_fast { step } else { -step }).clamp(0.0, 1.0);
    }

    fn frequency_hz(&self) -> f64 {
        let of = |gait: &Gait| gait.frequency_hz(self.speed.value) * gait.cadence_factor(self.amounts.iter().map(|a| a.value));
        match (&self.gaits.fast, self.running()) {
            (Some(fast), share) if share > 0.0 => of(&self.gaits.slow).powf(1.0 - share) * of(&fast.gait).powf(share),
            _ => of(&self.gaits.slow),
        }
    }

    /// The pose now.
    pub fn pose(&self) -> Pose {
        let share = self.running();
        let amounts = || self.amounts.iter().map(|a| a.value);
        let slow = || self.gaits.slow.posture(self.speed.value, self.phase, amounts());
        let posture = match &self.gaits.fast {
            Some(f) if share > 0.0 => {
                let fast = f.gait.posture(self.speed.value, self.phase + f.shift, amounts());
                if share < 1.0 { between(&slow(), &fast, share) } else { fast }
            }
            _ => slow(),
        };
        self.carried(posture)
    }

    fn carried(&self, posture: Posture) -> Pose {
        let Posture { mut joints, carrier_from_root, root } = posture;
        let hip_height_m = self.gaits.slow.hip_height_m;
        let lean = self.lean();
        let leaning_from_upright = exp(&Vector3::new(0.0, 0.0, -lean));
        if lean != 0.0 {
            for (hip, knee, ankle) in [(Joint::LHip, Joint::LKnee, Joint::LAnkle), (Joint::RHip, Joint::RKnee, Joint::RAnkle)] {
                let joint = |j: Joint| joints[j as usize - 1];
                let carrier_from_shank = carrier_from_root * joint(Joint::Sacroiliac) * joint(hip) * joint(knee);
                let flat = carrier_from_shank.inverse() * leaning_from_upright.inverse() * carrier_from_shank;
                joints[ankle as usize - 1] = flat * joint(ankle);
            }
        }
        let at = leaning_from_upright * (Vector3::new(root.x, 1.0 + root.y, root.z) * hip_height_m);
        let inward = Vector3::new(lean.sin() * hip_height_m, 0.0, 0.0);
        let world_from_carrier = exp(&Vector3::new(0.0, self.heading, 0.0));
        Pose {
            root: self.ground + world_from_carrier * (at - inward),
            world_from_root: world_from_carrier * leaning_from_upright * carrier_from_root,
            joints,
        }
    }
}

fn between(a: &Posture, b: &Posture, part: f64) -> Posture {
    let turn = |a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>| a * exp(&(log(&(a.inverse() * b)) * part));
    Posture {
        joints: std::array::from_fn(|k| turn(&a.joints[k], &b.joints[k])),
        carrier_from_root: turn(&a.carrier_from_root, &b.carrier_from_root),
        root: a.root.lerp(&b.root, part),
    }
}

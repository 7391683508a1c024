//! What makes synthetic people differ from one another, and their cycles from one cycle to the next.
//!
//! Every track (one anatomical angle of one side, or of the trunk) of a subject keeps, at all speeds,
//!   y(t) = m + g (f(t + τ, s_ref + σ (s − s_ref)) − m) + o + Σ_{k≤3} a_k cos 2πkt + b_k sin 2πkt          (1)
//! with f the population's curve, m its mean over the cycle, and o, g, τ, σ, a, b drawn once; a cycle adds harmonics
//! k ≤ 4 of its own. Numbers come from ChaCha12 streams keyed by subject, activity, parameter and repeat, so that any cycle
//! can be computed alone.

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha12Rng;
use rand_chacha::rand_core::SeedableRng;

use crate::motion_model::cycle::{Activity, SAMPLES};

/// Anatomical angles that follow their own curves; those of a side come first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub(super) enum Channel {
    HipFlexion,
    HipAdduction,
    HipRotation,
    Knee,
    Ankle,
    Shoulder,
    ShoulderAbduction,
    Elbow,
    Tilt,
    List,
    Yaw,
    Lean,
    Bend,
    Torsion,
}

pub(super) const SIDE_CHANNELS: usize = 8;
pub(super) const TRACKS: usize = 2 * SIDE_CHANNELS + 6;

/// One value per sample, track and cycle, degrees.
pub(super) type Tracks = Vec<[f64; TRACKS]>;

impl Channel {
    pub(super) const ALL: [Channel; SIDE_CHANNELS + 6] = [
        Channel::HipFlexion,
        Channel::HipAdduction,
        Channel::HipRotation,
        Channel::Knee,
        Channel::Ankle,
        Channel::Shoulder,
        Channel::ShoulderAbduction,
        Channel::Elbow,
        Channel::Tilt,
        Channel::List,
        Channel::Yaw,
        Channel::Lean,
        Channel::Bend,
        Channel::Torsion,
    ];

    /// Standard deviation between people, degrees. Leg angles: recreational runners of the BMC data (3.8); the others
    /// rounded guesses of the same order, hip rotation without the share that is marker placement.
    fn spread_deg(self) -> f64 {
        use Channel::*;
        match self {
            HipFlexion => 5.2,
            HipAdduction => 2.7,
            HipRotation => 4.0,
            Knee => 7.4,
            Ankle => 5.4,
            Shoulder => 8.0,
            ShoulderAbduction => 4.0,
            Elbow => 12.0,
            Tilt => 4.0,
            List => 1.5,
            Yaw => 3.0,
            Lean => 4.0,
            Bend => 1.5,
            Torsion => 3.0,
        }
    }

    /// Standard deviation of the gain between people. Arm swing differs far more than legs do.
    fn gain_spread(self) -> f64 {
        match self {
            Channel::Shoulder => 0.30,
            Channel::Elbow => 0.25,
            Channel::Torsion => 0.25,
            _ => 0.10,
        }
    }

    fn is_of_a_side(self) -> bool {
        (self as usize) < SIDE_CHANNELS
    }
}

/// The track of a channel; `side` 0 is left, 1 is right, ignored for the trunk.
pub(super) fn track(channel: Channel, side: usize) -> usize {
    let c = channel as usize;
    if c < SIDE_CHANNELS { side * SIDE_CHANNELS + c } else { c + SIDE_CHANNELS }
}

/// The numbers of equation (1) for one track.
#[derive(Clone, Debug)]
struct Variation {
    offset_deg: f64,
    gain: f64,
    shift: f64,
    slope: f64,
    harmonics: Vec<[f64; 2]>,
}

/// One person's way of moving, kept over all speeds and lengths.
#[derive(Clone, Debug)]
pub(super) struct Style {
    tracks: Vec<Variation>,
}

impl Style {
    /// The population's mean.
    pub(super) fn neutral() -> Style {
        let none = Variation { offset_deg: 0.0, gain: 1.0, shift: 0.0, slope: 1.0, harmonics: Vec::new() };
        Style { tracks: vec![none; TRACKS] }
    }

    pub(super) fn draw(rng: &mut ChaCha12Rng) -> Style {
        let mut tracks = Style::neutral().tracks;
        let tilt_deg = 0.7 * Channel::Tilt.spread_deg() * normal(rng);
        for channel in Channel::ALL {
            let common = Variation::draw(channel, rng);
            let asymmetry = 0.10 * normal(rng);
            for side in 0..2 {
                let sign = if side == 0 { 0.5 } else { -0.5 };
                let mut own = common.clone();
                if channel.is_of_a_side() {
                    own.gain *= 1.0 + sign * asymmetry;
                    own.offset_deg *= 1.0 + sign * asymmetry;
                }
                // A pelvis that leans forward flexes the hip by as much: the thighs keep their place under the body.
                match channel {
                    Channel::Tilt => own.offset_deg = tilt_deg,
                    Channel::HipFlexion => own.offset_deg = tilt_deg + 0.5 * own.offset_deg,
                    _ => {}
                }
                tracks[track(channel, side)] = own;
            }
        }
        Style { tracks }
    }

    /// Equation (1) over a cycle: `population(channel, own_phase, parameter)` in degrees, `own_phase` from the side's own
    /// heel strike, half a cycle later on the left when `half_cycle_apart`.
    pub(super) fn tracks(
        &self,
        parameter: f64,
        reference: f64,
        half_cycle_apart: bool,
        population: impl Fn(Channel, f64, f64) -> f64,
    ) -> Tracks {
        let mut tracks = vec![[0.0; TRACKS]; SAMPLES];
        for channel in Channel::ALL {
            for side in 0..if channel.is_of_a_side() { 2 } else { 1 } {
                let own = &self.tracks[track(channel, side)];
                let delay = if half_cycle_apart && channel.is_of_a_side() && side == 0 { 0.5 } else { 0.0 };
                let at = reference + own.slope * (parameter - reference);
                let shift = if half_cycle_apart { own.shift } else { 0.0 };
                let curve: Vec<f64> = (0..SAMPLES).map(|i| population(channel, phase(i) + delay + shift, at)).collect();
                let mean = curve.iter().sum::<f64>() / SAMPLES as f64;
                for (i, y) in curve.iter().enumerate() {
                    let detail = turned_sum(&own.harmonics, &turns(own.harmonics.len(), phase(i) + delay));
                    tracks[i][track(channel, side)] = mean + own.gain * (y - mean) + own.offset_deg + detail;
                }
            }
        }
        tracks
    }
}

impl Variation {
    fn draw(channel: Channel, rng: &mut ChaCha12Rng) -> Variation {
        let spread = channel.spread_deg();
        Variation {
            offset_deg: 0.7 * spread * normal(rng),
            gain: (1.0 + channel.gain_spread() * normal(rng)).clamp(0.3, 1.9),
            shift: 0.01 * normal(rng),
            slope: 1.0 + 0.1 * normal(rng),
            harmonics: harmonics(3, 0.3 * spread, rng),
        }
    }
}

const NOISE_HARMONICS: usize = 4;

/// Adds one cycle's own harmonics, a quarter of the spread between people.
pub(super) fn add_cycle_noise(tracks: &mut Tracks, rng: &mut ChaCha12Rng) {
    let turns: Vec<_> = (0..tracks.len()).map(|i| turns(NOISE_HARMONICS, phase(i))).collect();
    for channel in Channel::ALL {
        for side in 0..if channel.is_of_a_side() { 2 } else { 1 } {
            let own = harmonics(NOISE_HARMONICS, 0.25 * channel.spread_deg(), rng);
            for (sample, turns) in tracks.iter_mut().zip(&turns) {
                sample[track(channel, side)] += turned_sum(&own, turns);
            }
        }
    }
}

pub(super) fn phase(sample: usize) -> f64 {
    sample as f64 / SAMPLES as f64
}

/// Random harmonics whose sum has standard deviation `spread` over the cycle.
fn harmonics(count: usize, spread: f64, rng: &mut ChaCha12Rng) -> Vec<[f64; 2]> {
    let each = spread / (count as f64).sqrt();
    (0..count).map(|_| [each * normal(rng), each * normal(rng)]).collect()
}

/// Sine and cosine of the first harmonics' angles.
fn turns(count: usize, phase: f64) -> Vec<(f64, f64)> {
    (1..=count).map(|k| (TAU * k as f64 * phase).sin_cos()).collect()
}

fn turned_sum(harmonics: &[[f64; 2]], turns: &[(f64, f64)]) -> f64 {
    harmonics.iter().zip(turns).map(|([a, b], (sin, cos))| a * cos + b * sin).sum()
}

/// Numbers of one subject's body (`None`) or of its way of doing one activity.
pub(super) fn subject_rng(seed: u64, activity: Option<Activity>) -> ChaCha12Rng {
    stream(seed, activity.map_or(0, |a| a as u64 + 1))
}

/// Numbers of one cycle; parameters that differ by a millimetre (per second) are different.
pub(super) fn cycle_rng(seed: u64, activity: Activity, parameter: f64, repeat: u32) -> ChaCha12Rng {
    let parameter = (parameter * 1000.0).round() as u64;
    stream(seed, (activity as u64 + 1) << 56 | (parameter & 0xff_ffff) << 32 | u64::from(repeat))
}

fn stream(seed: u64, stream: u64) -> ChaCha12Rng {
    // "muybridg" as a number: keeps these streams apart from other users of small seeds.
    let mut rng = ChaCha12Rng::seed_from_u64(0x6d75_7962_7269_6467 ^ seed);
    rng.set_stream(stream);
    rng
}

/// Standard normal deviate by Box and Muller.
pub(super) fn normal(rng: &mut ChaCha12Rng) -> f64 {
    let radius = (-2.0 * (1.0 - uniform(rng)).ln()).sqrt();
    radius * (TAU * uniform(rng)).cos()
}

/// Uniform in [0, 1).
pub(super) fn uniform(rng: &mut ChaCha12Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 * 2f64.powi(-53)
}

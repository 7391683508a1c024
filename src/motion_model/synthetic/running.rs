//! Parametric run: legs after measured means, speed trends, arms, flight.
//!
//! Hip, knee and ankle in the sagittal plane: Fourier series of the mean curves of 23 recreational runners at about
//! 2.5 m/s, "BMC-RIC running" by R. Fukuchi, M. Duarte and R. Ferber (github.com/regifukuchi/BMC-RIC-running-biomechanics,
//! CC BY 4.0, commit 2daebfed). Changes made: mean over the subjects, signs, a series of 6 harmonics.
//! Speed enters as the equivalent speed k in km/h of a person with H = 0.87 m: hip range and knee peak grow by 2.5 degrees
//! per km/h, the stance share falls from 0.42 at 6 to 0.35 at 12 km/h, cadence f = 1.05 (v/H)^0.2 Hz. The root's
//! height is ballistic in flight. Pelvis, trunk and arms are own curves (elbows near 90 degrees).
//! Fails well outside 5 to 14 km/h. Checked: peaks against the source's, gravity in flight, feet on and off the floor.

use std::f64::consts::TAU;

use super::stride::Gait;
use super::variation::Channel;
use crate::math::curves::Pchip;

/// v/H (1/s) of the measured runners: 2.5 m/s at H = 0.87 m; a subject's own slope over speed turns about it.
pub(super) const REFERENCE_RV: f64 = 2.5 / 0.87;
/// Stance share of the measured runners, by the rule for 9 km/h.
const MEASURED_SUPPORT: f64 = 0.385;

/// Mean and harmonics (cosine, sine) in degrees.
struct Series {
    mean: f64,
    harmonics: [[f64; 2]; 6],
}

const HIP: Series =
    Series { mean: 12.35, harmonics: [[18.40, -11.72], [-4.78, 2.09], [-2.01, 1.14], [0.05, -0.30], [-0.13, -0.08], [0.18, -0.10]] };
const KNEE: Series =
    Series { mean: 42.49, harmonics: [[-10.68, -26.18], [-15.99, 17.02], [-3.18, 1.99], [-0.77, 1.02], [-0.39, 0.22], [0.01, 0.01]] };
const ANKLE: Series =
    Series { mean: 2.22, harmonics: [[10.88, 5.60], [-8.65, 2.53], [-1.41, -2.91], [0.59, -0.56], [-0.19, -0.50], [0.10, -0.41]] };

impl Series {
    fn at(&self, t: f64) -> f64 {
        let term = |(k, [a, b]): (usize, &[f64; 2])| {
            let (sin, cos) = (TAU * (k + 1) as f64 * t).sin_cos();
            a * cos + b * sin
        };
        self.mean + self.harmonics.iter().enumerate().map(term).sum::<f64>()
    }

    /// With its swings about the mean multiplied.
    fn scaled(&self, t: f64, factor: f64) -> f64 {
        self.mean + factor * (self.at(t) - self.mean)
    }
}

pub(super) fn frequency_hz(rv: f64) -> f64 {
    1.05 * rv.powf(0.2)
}

/// Speed in km/h of a person with H = 0.87 m at the same v/H.
fn equivalent_kmh(rv: f64) -> f64 {
    rv * 0.87 * 3.6
}

/// Share of the cycle during which a foot stands.
pub(super) fn support(rv: f64) -> f64 {
    (0.42 - 0.07 * (equivalent_kmh(rv) - 6.0) / 6.0).clamp(0.30, 0.45)
}

/// Population angle in degrees at the side's own phase.
pub(super) fn population(channel: Channel, t: f64, rv: f64) -> f64 {
    let faster = equivalent_kmh(rv) - 9.0;
    let wave = |amplitude: f64, peak: f64| amplitude * (TAU * (t - peak)).cos();
    let leg = |series: &Series, growth: f64| series.scaled(measured_phase(t, support(rv)), 1.0 + growth * faster);
    match channel {
        Channel::HipFlexion => leg(&HIP, 2.5 / 48.0),
        Channel::Knee => leg(&KNEE, 2.5 / 48.5),
        Channel::Ankle => leg(&ANKLE, 0.03),
        Channel::HipAdduction => 0.0,
        Channel::HipRotation => -5.0,
        Channel::Shoulder => -12.0 + wave(24.0 + 2.0 * faster, 0.45),
        Channel::ShoulderAbduction => 14.0,
        Channel::Elbow => 88.0 + wave(12.0, 0.45),
        Channel::Tilt => 6.0 + 0.8 * faster + 1.5 * (2.0 * TAU * (t - 0.4)).cos(),
        Channel::List => -wave(3.5, 0.15),
        Channel::Yaw => wave(5.0, -0.1),
        Channel::Lean => 7.0 + 0.6 * faster,
        Channel::Bend => wave(1.5, 0.2),
        Channel::Torsion => -wave(8.0 + 0.5 * faster, -0.05),
    }
}

/// The measured phase at which a runner with this support is at phase `t`: toe-off matches toe-off.
fn measured_phase(t: f64, support: f64) -> f64 {
    let bump = Pchip::periodic(&[(0.0, 0.0), (support, 1.0)]);
    t + (MEASURED_SUPPORT - support) * bump.at(t)
}

/// How the feet meet the floor at `speed`.
pub(super) fn gait(speed: f64, rv: f64, cycle_s: f64) -> Gait {
    let support = support(rv);
    Gait {
        cycle_s,
        stride_m: speed * cycle_s,
        support,
        leads: (0.05, support - 0.05),
        carries_until: support - 0.05,
        laid_flat: (0.0, 0.07),
        heel_rises: (0.45 * support, 0.70 * support),
        lets_go: (0.0, 0.15),
        bounces: true,
        most_bob_m: f64::INFINITY,
        sway,
        clearance_m: 0.03,
        step_width: 0.4,
    }
}

fn sway(t: f64) -> f64 {
    -0.012 * (TAU * (t + 0.06)).sin()
}

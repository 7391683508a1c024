//! How often a gait cycle repeats at a speed: f = a V^b with V = v/H in 1/s (Inman's law is a = 0.743, b = 0.5).
//!
//! Fitted per activity by least squares in log space on the model's own members ("adapted Inman law" of the style paper,
//! §5.1, whose constants were not published). For jumps v is the length, and the law is that of f·√H, because flights of
//! geometrically similar bodies take times that go with √H.
//! Fails when: the members have one speed only; then b is the prior's and a alone is fitted.

use serde::{Deserialize, Serialize};

use super::cycle::Activity;
use super::model::Member;

/// Spread (standard deviation) of log V below which the slope is not fitted: it would be noise.
const SPREAD_FOR_SLOPE: f64 = 0.1;
/// Members below this V are left out of the fit: a jump on the spot has no logarithm worth fitting.
const SMALLEST_V: f64 = 0.2;

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CadenceLaw {
    pub activity: Activity,
    pub a: f64,
    pub b: f64,
}

impl CadenceLaw {
    /// Walking: Inman and Boulic; running: stride rates of van Oeveren 2017; jumps: about 1.5 s from start to rest.
    pub fn prior(activity: Activity) -> CadenceLaw {
        let (a, b) = match activity {
            Activity::Walking => (0.743, 0.5),
            Activity::Running => (1.05, 0.2),
            Activity::Jumping => (0.63, 0.0),
        };
        CadenceLaw { activity, a, b }
    }

    /// Fit to the members of a model; members that hardly move forward are left out.
    pub fn fit(activity: Activity, members: &[Member]) -> CadenceLaw {
        let prior = CadenceLaw::prior(activity);
        let points: Vec<(f64, f64)> = members
            .iter()
            .filter(|m| m.parameter > SMALLEST_V * m.hip_height_m && m.duration_s > 0.0)
            .map(|m| ((m.parameter / m.hip_height_m).ln(), (prior.scale(m.hip_height_m) / m.duration_s).ln()))
            .collect();
        if points.is_empty() {
            return prior;
        }
        let n = points.len() as f64;
        let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p.0 / n, y + p.1 / n));
        let variance = points.iter().map(|p| (p.0 - x).powi(2)).sum::<f64>() / n;
        let covariance = points.iter().map(|p| (p.0 - x) * (p.1 - y)).sum::<f64>() / n;
        let b = if variance.sqrt() < SPREAD_FOR_SLOPE { prior.b } else { covariance / variance };
        CadenceLaw { activity, a: (y - b * x).exp(), b }
    }

    /// Cycles (jumps) per second at `parameter` (m/s, for jumps m) for a body with this hip height.
    pub fn frequency_hz(&self, parameter: f64, hip_height_m: f64) -> f64 {
        self.a * (parameter / hip_height_m).max(SMALLEST_V).powf(self.b) / self.scale(hip_height_m)
    }

    /// √H where the law is that of f·√H.
    fn scale(&self, hip_height_m: f64) -> f64 {
        if self.activity.is_cyclic() { 1.0 } else { hip_height_m.sqrt() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;

    fn member(parameter: f64, hip_height_m: f64, duration_s: f64) -> Member {
        let (subject, source) = ("a".to_string(), "a".to_string());
        Member { subject, source, parameter, hip_height_m, duration_s, vector: DVector::zeros(0), root: DVector::zeros(0) }
    }

    #[test]
    fn recovers_a_law_and_keeps_the_slope_without_spread() {
        let law = |v: f64, h: f64| 0.8 * (v / h).powf(0.4);
        let members: Vec<Member> = [(0.8, 0.9), (1.2, 0.8), (1.9, 1.0)].map(|(v, h)| member(v, h, 1.0 / law(v, h))).to_vec();
        let fitted = CadenceLaw::fit(Activity::Walking, &members);
        assert!((fitted.a - 0.8).abs() < 1e-12 && (fitted.b - 0.4).abs() < 1e-12, "{fitted:?}");
        let one_speed = CadenceLaw::fit(Activity::Walking, &members[..1]);
        assert_eq!(one_speed.b, 0.5);
        assert!((one_speed.frequency_hz(0.8, 0.9) - law(0.8, 0.9)).abs() < 1e-12);
    }

    #[test]
    fn jumps_of_a_larger_body_take_longer_by_the_root_of_its_size() {
        let law = CadenceLaw::fit(Activity::Jumping, &[member(0.8, 0.9, 1.4)]);
        assert!((law.frequency_hz(0.8, 0.9) - 1.0 / 1.4).abs() < 1e-12);
        assert!((law.frequency_hz(0.8, 0.9) / law.frequency_hz(1.6, 1.8) - 2f64.sqrt()).abs() < 1e-12);
    }
}

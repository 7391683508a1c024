//! The rhythm of a clip: pass band, verdict, and the unwrapped phase of the silhouettes.
//!
//! The band of PC1's peak ([`crate::math::spectrum`]) filters PC1 and PC2. r_k is the correlation of p_k with itself
//! filtered. `usable`: r ≥ 0.6 for PC1 and PC2, r ≤ 0.3 for the next three, PC2 a quarter period from PC1 (45 to 135
//! degrees), and either two periods or a closed loop of one; else `sketch` for masks and `not usable` for strokes
//! (Favreau et al. 2004, section 5.2). The phase condition and the loop are ours: a slow drift has high r too.
//! Checked against waves of known phase, drift and noise.

use serde::{Deserialize, Serialize};

use super::eigen::Eigenimages;
use crate::math::spectrum::{Peak, band_pass, correlation, peak, phase_lag};

/// Least correlation of the first two components, most of the others.
pub const RHYTHMIC: f64 = 0.6;
pub const UNRHYTHMIC: f64 = 0.3;
/// Components that the verdict looks at.
pub const JUDGED: usize = 5;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    Usable,
    Sketch,
    NotUsable,
}

impl Verdict {
    pub fn words(self) -> &'static str {
        match self {
            Verdict::Usable => "usable",
            Verdict::Sketch => "sketch",
            Verdict::NotUsable => "not usable",
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rhythm {
    /// `None` where PC1 has no peak.
    pub peak: Option<Peak>,
    /// Frames per period of the silhouette.
    pub period_frames: Option<f64>,
    /// r of PC1 … PC5, fewer where the clip has fewer.
    pub correlations: Vec<f64>,
    /// By how much PC2 runs after PC1 at the peak, degrees.
    pub lag_deg: Option<f64>,
    pub verdict: Verdict,
    /// Why, one clause each; empty for `usable`.
    pub reasons: Vec<String>,
}

/// Rhythm of the coefficients; `strokes` where the silhouettes were drawn, the last resort.
pub fn rhythm(eigen: &Eigenimages, strokes: bool) -> Rhythm {
    let series: Vec<Vec<f64>> = (0..JUDGED.min(eigen.coefficients.ncols())).map(|k| eigen.series(k)).collect();
    judge(&series, strokes)
}

fn judge(series: &[Vec<f64>], strokes: bool) -> Rhythm {
    let found = series.first().and_then(|s| peak(s));
    let mut reasons = Vec::new();
    let (mut correlations, mut lag_deg, mut period_frames) = (Vec::new(), None, None);
    match (&found, series) {
        (Some(peak), [first, second, ..]) => {
            correlations = series.iter().map(|s| correlation(s, &band_pass(s, peak.band))).collect();
            let lag = phase_lag(first, second, peak.centre as usize).to_degrees();
            (lag_deg, period_frames) = (Some(lag), Some(first.len() as f64 / peak.centre));
            for (k, r) in correlations.iter().enumerate() {
                if k < 2 && *r < RHYTHMIC {
                    reasons.push(format!("PC{} keeps r = {r:.2} in the band, {RHYTHMIC} is needed", k + 1));
                } else if k >= 2 && *r > UNRHYTHMIC {
                    reasons.push(format!("PC{} has r = {r:.2} in the band, {UNRHYTHMIC} is allowed", k + 1));
                }
            }
            if !(45.0..=135.0).contains(&lag.abs()) {
                reasons.push(format!("PC2 runs {lag:.0} degrees after PC1, a quarter period (90) is needed"));
            }
            if peak.centre < 2.0 && !closes(first, second) {
                reasons.push("one period only, and it does not close: a drift (--detrend 3 takes it away), not a rhythm".into());
            }
        }
        _ => reasons.push("PC1 has no peak: nothing repeats".into()),
    }
    let verdict = match (reasons.is_empty(), strokes) {
        (true, _) => Verdict::Usable,
        (false, false) => Verdict::Sketch,
        (false, true) => Verdict::NotUsable,
    };
    Rhythm { peak: found, period_frames, correlations, lag_deg, verdict, reasons }
}

/// Whether the last frame is followed by the first one at the usual step.
fn closes(first: &[f64], second: &[f64]) -> bool {
    let step = |a: usize, b: usize| (first[a] - first[b]).hypot(second[a] - second[b]);
    let mut steps: Vec<f64> = (1..first.len()).map(|t| step(t, t - 1)).collect();
    steps.sort_by(f64::total_cmp);
    step(0, first.len() - 1) <= 2.5 * steps[steps.len() / 2]
}

impl Rhythm {
    /// The coefficients that drive keys and animation, one row of `components` per frame: the first two filtered with
    /// `filter`, where there is a peak; the others as they are.
    pub fn points(&self, eigen: &Eigenimages, components: usize, filter: bool) -> Vec<Vec<f64>> {
        let columns: Vec<Vec<f64>> = (0..components.min(eigen.coefficients.ncols()))
            .map(|k| match &self.peak {
                Some(peak) if filter && k < 2 => band_pass(&eigen.series(k), peak.band),
                _ => eigen.series(k),
            })
            .collect();
        (0..eigen.frames()).map(|t| columns.iter().map(|c| c[t]).collect()).collect()
    }

    /// Silhouette periods passed at every frame, increasing on the whole: the unwrapped angle of the filtered PC1 and PC2
    /// over a turn. `None` without a peak.
    pub fn turns(&self, eigen: &Eigenimages) -> Option<Vec<f64>> {
        self.peak?;
        let points = self.points(eigen, 2, true);
        (points.first()?.len() == 2).then(|| unwrapped_turns(&points))
    }
}

fn unwrapped_turns(points: &[Vec<f64>]) -> Vec<f64> {
    let mut turns = Vec::with_capacity(points.len());
    let mut last = 0.0f64;
    for p in points {
        let turn = p[1].atan2(p[0]) / std::f64::consts::TAU;
        last = if turns.is_empty() { turn } else { turn + (last - turn).round() };
        turns.push(last);
    }
    let forward = turns.last().zip(turns.first()).is_none_or(|(b, a)| b >= a);
    if forward { turns } else { turns.iter().map(|t| -t).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use std::f64::consts::TAU;

    fn wave(n: usize, cycles: f64, phase: f64) -> Vec<f64> {
        (0..n).map(|t| 1.4 * (TAU * cycles * t as f64 / n as f64 - phase).cos()).collect()
    }

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        (0..n).map(|_| 3.4 * (random.random::<f64>() - 0.5)).collect()
    }

    #[test]
    fn two_waves_a_quarter_apart_are_usable() {
        let found = judge(&[wave(100, 7.0, 0.2), wave(100, 7.0, 0.2 + 1.5), wave(100, 14.0, 0.0), wave(100, 21.0, 0.0)], false);
        assert_eq!((found.verdict, found.period_frames), (Verdict::Usable, Some(100.0 / 7.0)));
        assert!((found.lag_deg.unwrap() - 1.5f64.to_degrees()).abs() < 1e-6);
        assert!(found.correlations[0] > 0.999 && found.correlations[2] < 1e-6);
    }

    #[test]
    fn noise_drift_and_waves_in_phase_are_not() {
        let noisy = judge(&[noise(100, 1), noise(100, 2), noise(100, 3)], false);
        let drift: Vec<f64> = (0..100).map(|t| t as f64 / 30.0 - 1.66).collect();
        let bend: Vec<f64> = drift.iter().map(|d| d * d - 0.9).collect();
        let drifting = judge(&[drift, bend], false);
        let in_phase = judge(&[wave(100, 7.0, 0.0), wave(100, 7.0, 0.1)], true);
        assert_eq!([noisy.verdict, drifting.verdict, in_phase.verdict], [Verdict::Sketch, Verdict::Sketch, Verdict::NotUsable]);
        assert!(in_phase.reasons[0].contains("6 degrees"), "{:?}", in_phase.reasons);
        assert!(judge(&[vec![0.0; 9]], true).reasons[0].contains("nothing repeats"));
    }

    #[test]
    fn one_closed_stride_of_eleven_photographs_is_usable() {
        let found = judge(&[wave(11, 1.0, 0.0), wave(11, 1.0, 1.57)], false);
        assert_eq!(found.verdict, Verdict::Usable, "{:?}", found.reasons);
    }

    #[test]
    fn turns_count_periods_in_either_direction() {
        for sign in [1.0, -1.0] {
            let points: Vec<Vec<f64>> = (0..60).map(|t| TAU * 0.07 * f64::from(t) * sign).map(|a| vec![a.cos(), a.sin()]).collect();
            let turns = unwrapped_turns(&points);
            assert!((turns[59] - turns[0] - 0.07 * 59.0).abs() < 1e-9);
        }
    }
}

//! Discrete spectrum of a short signal: peak, pass band, band-pass, correlation, phase.
//!
//! X_k = Σ_t x_t exp(−2πi k t/n), frequencies k/n cycles per sample.
//! Peak of Favreau et al. (2004), equation (20): peak(f) = 1/(1 + ((f−f0)/(fb−f0))²), f0 = argmax |X|, fb the nearest
//! frequency with half of its amplitude (between bins: linear); the band f0 ± 3|fb−f0| ends where peak = 10 %.
//! The direct sum, O(n²): clips have hundreds of frames. Checked against cv::dft and r = √(energy in band / energy).

use std::f64::consts::TAU;

/// [re, im] of X_k, k = 0 … n/2.
pub fn spectrum(signal: &[f64]) -> Vec<[f64; 2]> {
    let n = signal.len();
    let table: Vec<(f64, f64)> = (0..n).map(|i| (TAU * i as f64 / n as f64).sin_cos()).collect();
    let bin = |k: usize| {
        signal.iter().enumerate().fold([0.0; 2], |[re, im], (t, x)| {
            let (sin, cos) = table[k * t % n];
            [re + x * cos, im - x * sin]
        })
    };
    if n == 0 { Vec::new() } else { (0..=n / 2).map(bin).collect() }
}

/// |X_k|, the mean taken away first.
pub fn amplitudes(signal: &[f64]) -> Vec<f64> {
    let mean = signal.iter().sum::<f64>() / signal.len().max(1) as f64;
    let centred: Vec<f64> = signal.iter().map(|x| x - mean).collect();
    spectrum(&centred).iter().map(|[re, im]| re.hypot(*im)).collect()
}

/// The fundamental of a signal and the band around it; frequencies in bins (cycles per signal).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Peak {
    pub centre: f64,
    /// |fb − f0|.
    pub half_width: f64,
    /// f0 ± 3 half widths, not below the first bin.
    pub band: [f64; 2],
}

impl Peak {
    /// Equation (20), 1 at the centre.
    pub fn at(&self, frequency: f64) -> f64 {
        1.0 / (1.0 + ((frequency - self.centre) / self.half_width).powi(2))
    }
}

/// The peak of the largest amplitude above frequency 0; `None` for signals that do not vary.
pub fn peak(signal: &[f64]) -> Option<Peak> {
    let amplitude = amplitudes(signal);
    let scale = signal.iter().map(|x| x.abs()).fold(0.0, f64::max) * signal.len() as f64;
    let top = (1..amplitude.len()).max_by(|&a, &b| amplitude[a].total_cmp(&amplitude[b]).then(b.cmp(&a)))?;
    if amplitude[top] <= 1e-12 * scale {
        return None;
    }
    let half = amplitude[top] / 2.0;
    let crossing = |bins: &mut dyn Iterator<Item = usize>| {
        let mut before = amplitude[top];
        for (steps, k) in bins.enumerate() {
            if amplitude[k] <= half {
                return Some(steps as f64 + (before - half) / (before - amplitude[k]));
            }
            before = amplitude[k];
        }
        None
    };
    let above = crossing(&mut (top + 1..amplitude.len()));
    let below = crossing(&mut (0..top).rev());
    let half_width = [above, below].into_iter().flatten().reduce(f64::min)?;
    let centre = top as f64;
    Some(Peak { centre, half_width, band: [(centre - 3.0 * half_width).max(1.0), centre + 3.0 * half_width] })
}

/// The part of the signal between two frequencies (bins, both inclusive), without its mean.
pub fn band_pass(signal: &[f64], band: [f64; 2]) -> Vec<f64> {
    let n = signal.len();
    let kept: Vec<(usize, [f64; 2])> =
        spectrum(signal).into_iter().enumerate().skip(1).filter(|(k, _)| (band[0]..=band[1]).contains(&(*k as f64))).collect();
    let sample = |t: usize| {
        kept.iter().map(move |(k, [re, im])| {
            let (sin, cos) = (TAU * (k * t % n) as f64 / n as f64).sin_cos();
            // Bins other than Nyquist's stand for two.
            let both = if 2 * k == n { 1.0 } else { 2.0 };
            both * (re * cos - im * sin) / n as f64
        })
    };
    (0..n).map(|t| sample(t).sum()).collect()
}

/// Pearson's correlation; 0 where one of them does not vary.
pub fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().min(b.len()).max(1) as f64;
    let mean = |v: &[f64]| v.iter().sum::<f64>() / n;
    let (ma, mb) = (mean(a), mean(b));
    let [ab, aa, bb] = a.iter().zip(b).fold([0.0; 3], |[ab, aa, bb], (x, y)| {
        let (x, y) = (x - ma, y - mb);
        [ab + x * y, aa + x * x, bb + y * y]
    });
    let scale = a.iter().chain(b).fold(0.0f64, |m, v| m.max(v.abs()));
    if aa.min(bb) <= n * (1e-12 * scale).powi(2) { 0.0 } else { ab / (aa * bb).sqrt() }
}

/// By how much `b` runs after `a` at bin `k`, radians in (−π, π].
pub fn phase_lag(a: &[f64], b: &[f64], k: usize) -> f64 {
    let at = |s: &[f64]| spectrum(s).get(k).copied().unwrap_or([0.0; 2]);
    let ([ar, ai], [br, bi]) = (at(a), at(b));
    (ai * br - ar * bi).atan2(ar * br + ai * bi)
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{self, Mat};
    use opencv::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        (0..n).map(|_| random.random::<f64>() - 0.3).collect()
    }

    #[test]
    fn spectrum_and_band_pass_match_opencv() {
        for n in [45, 64] {
            let x = noise(n, 3);
            let signal = Mat::from_slice(&x).unwrap().try_clone().unwrap();
            let mut theirs = Mat::default();
            core::dft(&signal, &mut theirs, core::DFT_COMPLEX_OUTPUT, 0).unwrap();
            let mut bins = theirs.data_typed::<core::Vec2d>().unwrap().to_vec();
            for (ours, theirs) in spectrum(&x).iter().zip(&bins) {
                assert!((ours[0] - theirs[0]).abs() < 1e-9 && (ours[1] - theirs[1]).abs() < 1e-9);
            }
            for (k, bin) in bins.iter_mut().enumerate() {
                let frequency = k.min(n - k) as f64;
                if !(4.5..=11.0).contains(&frequency) {
                    *bin = core::Vec2d::default();
                }
            }
            let masked = Mat::from_slice(&bins).unwrap().try_clone().unwrap();
            let mut back = Mat::default();
            core::dft(&masked, &mut back, core::DFT_INVERSE | core::DFT_SCALE | core::DFT_REAL_OUTPUT, 0).unwrap();
            let ours = band_pass(&x, [4.5, 11.0]);
            assert!(ours.iter().zip(back.data_typed::<f64>().unwrap()).all(|(a, b)| (a - b).abs() < 1e-12));
            assert!(ours.iter().any(|v| v.abs() > 0.05));
        }
    }

    #[test]
    fn correlation_with_the_filtered_self_is_the_root_of_the_energy_in_band() {
        let x = noise(73, 5);
        let filtered = band_pass(&x, [2.0, 9.0]);
        let mean = x.iter().sum::<f64>() / 73.0;
        let energy = |v: &mut dyn Iterator<Item = f64>| v.map(|a| a * a).sum::<f64>();
        let share = energy(&mut filtered.iter().copied()) / energy(&mut x.iter().map(|a| a - mean));
        assert!((correlation(&x, &filtered) - share.sqrt()).abs() < 1e-12 && share > 0.05 && share < 0.9);
        assert_eq!(correlation(&x, &vec![1.0; 73]), 0.0);
    }

    #[test]
    fn peak_and_phase_of_a_known_wave() {
        let wave = |phase: f64| -> Vec<f64> { (0..120).map(|t| 3.0 + (TAU * 7.0 * t as f64 / 120.0 - phase).cos()).collect() };
        let found = peak(&wave(0.0)).unwrap();
        assert!(found.centre == 7.0 && (found.half_width - 0.5).abs() < 1e-9);
        assert!((found.band[0] - 5.5).abs() < 1e-9 && (found.band[1] - 8.5).abs() < 1e-9);
        assert!((found.at(8.5) - 0.1).abs() < 1e-9 && found.at(7.0) == 1.0);
        for lag in [-1.2, 0.4, std::f64::consts::FRAC_PI_2] {
            assert!((phase_lag(&wave(0.3), &wave(0.3 + lag), 7) - lag).abs() < 1e-9);
        }
        assert_eq!(peak(&[2.5; 30]), None);
        assert_eq!(peak(&[1.0]), None);
        // Two neighbouring bins: the half amplitude lies between bins on the steeper side.
        let beat: Vec<f64> = (0..100).map(|t| (TAU * 5.0 * t as f64 / 100.0).cos() + 0.8 * (TAU * 6.0 * t as f64 / 100.0).cos()).collect();
        assert!((peak(&beat).unwrap().half_width - 0.5).abs() < 1e-9);
    }
}

//! Curves of one variable: monotone cubic interpolation and low-pass of a period.
//!
//! PCHIP: between neighbours a cubic Hermite segment whose slope at a point is the weighted harmonic mean of the two
//! secants, 0 at a local extremum (Fritsch and Butland 1984), so that the curve never overshoots its points.
//! Ends of an open curve are flat. Checked against SciPy's `PchipInterpolator`.

use std::f64::consts::TAU;

/// A monotone piecewise cubic through points of increasing x.
#[derive(Clone, Debug)]
pub struct Pchip {
    points: Vec<[f64; 3]>,
    period: Option<f64>,
}

impl Pchip {
    /// Through `(x, y)` once; constant beyond the ends, where it arrives flat.
    pub fn open(points: &[(f64, f64)]) -> Pchip {
        let mut with_slopes: Vec<_> = points.iter().map(|&(x, y)| [x, y, 0.0]).collect();
        for k in 1..points.len().max(1) - 1 {
            with_slopes[k][2] = slope(points[k - 1], points[k], points[k + 1]);
        }
        Pchip { points: with_slopes, period: None }
    }

    /// Through `(x, y)` and its repetitions at distance 1; a last point one period after the first repeats it.
    pub fn periodic(points: &[(f64, f64)]) -> Pchip {
        let n = points.iter().filter(|p| p.0 < points[0].0 + 1.0 - 1e-9).count();
        let at = |k: usize| {
            let (x, y) = points[k % n];
            (x + (k / n) as f64 - 1.0, y)
        };
        let with_slopes = (n - 1..=2 * n).map(|k| {
            let (x, y) = at(k);
            [x, y, slope(at(k - 1), at(k), at(k + 1))]
        });
        Pchip { points: with_slopes.collect(), period: Some(1.0) }
    }

    pub fn at(&self, x: f64) -> f64 {
        let (first, last) = match (self.points.first(), self.points.last()) {
            (Some(first), Some(last)) => (first, last),
            _ => return 0.0,
        };
        let x = match self.period {
            Some(period) => last[0] - (last[0] - x).rem_euclid(period),
            None => x.clamp(first[0], last[0]),
        };
        let right = self.points.partition_point(|p| p[0] < x).clamp(1, self.points.len().max(2) - 1);
        match self.points.get(right) {
            Some(b) => hermite(&self.points[right - 1], b, x),
            None => first[1],
        }
    }
}

fn slope(before: (f64, f64), here: (f64, f64), after: (f64, f64)) -> f64 {
    let (h0, h1) = (here.0 - before.0, after.0 - here.0);
    let (d0, d1) = ((here.1 - before.1) / h0, (after.1 - here.1) / h1);
    if d0 * d1 <= 0.0 {
        return 0.0;
    }
    let (w0, w1) = (2.0 * h1 + h0, h1 + 2.0 * h0);
    (w0 + w1) / (w0 / d0 + w1 / d1)
}

/// The cubic through two points `[x, y, slope]`.
pub fn hermite(a: &[f64; 3], b: &[f64; 3], x: f64) -> f64 {
    let h = b[0] - a[0];
    let t = (x - a[0]) / h;
    let (t2, t3) = (t * t, t * t * t);
    a[1] * (2.0 * t3 - 3.0 * t2 + 1.0) + a[2] * h * (t3 - 2.0 * t2 + t) + b[1] * (3.0 * t2 - 2.0 * t3) + b[2] * h * (t3 - t2)
}

/// Smooth step from 0 at `from` to 1 at `to`, with zero first and second derivatives at both.
pub fn smooth_step(from: f64, to: f64, x: f64) -> f64 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * t * (t * (6.0 * t - 15.0) + 10.0)
}

/// Keeps the mean and the first `harmonics` harmonics of one period of equidistant samples.
pub fn low_pass(period: &[f64], harmonics: usize) -> Vec<f64> {
    let n = period.len() as f64;
    let mean = period.iter().sum::<f64>() / n;
    let mut kept = vec![mean; period.len()];
    let turns: Vec<(f64, f64)> = (0..period.len()).map(|i| (TAU * i as f64 / n).sin_cos()).collect();
    for k in 1..=harmonics {
        let turn = |i: usize| turns[k * i % period.len()];
        let a = period.iter().enumerate().map(|(i, y)| y * turn(i).1).sum::<f64>() * 2.0 / n;
        let b = period.iter().enumerate().map(|(i, y)| y * turn(i).0).sum::<f64>() * 2.0 / n;
        for (i, y) in kept.iter_mut().enumerate() {
            *y += a * turn(i).1 + b * turn(i).0;
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    const KNEE: [(f64, f64); 4] = [(0.17, 3.0), (0.4, 25.0), (0.75, 70.0), (1.0, 3.0)];

    /// `scipy.interpolate.PchipInterpolator` (1.17) on three repetitions of KNEE.
    const SCIPY: [(f64, f64); 5] =
        [(0.0, 3.0), (0.3, 12.670652917116229), (0.55, 48.03034551206502), (0.9, 26.584), (1.3, 12.670652917116247)];

    #[test]
    fn periodic_pchip_matches_scipy() {
        let curve = Pchip::periodic(&KNEE);
        for (t, y) in SCIPY {
            assert!((curve.at(t) - y).abs() < 1e-9, "{t}: {} {y}", curve.at(t));
            assert!((curve.at(t - 3.0) - y).abs() < 1e-9, "{t}");
        }
    }

    #[test]
    fn a_repeated_last_point_changes_nothing() {
        let [a, b] = [Pchip::periodic(&[(-0.1, 25.0), (0.5, -15.0), (0.9, 25.0)]), Pchip::periodic(&[(-0.1, 25.0), (0.5, -15.0)])];
        for k in 0..20 {
            let t = f64::from(k) / 20.0;
            assert!((a.at(t) - b.at(t)).abs() < 1e-12 && a.at(t).is_finite());
        }
    }

    #[test]
    fn open_pchip_passes_through_its_points_and_never_overshoots() {
        let points = [(0.0, 0.0), (1.0, 1.0), (1.5, 4.0), (4.0, 5.0)];
        let curve = Pchip::open(&points);
        assert!(points.iter().all(|&(x, y)| (curve.at(x) - y).abs() < 1e-12));
        let values: Vec<f64> = (-10..=50).map(|k| curve.at(f64::from(k) / 10.0)).collect();
        assert!(values.windows(2).all(|w| w[1] >= w[0] - 1e-12) && values[0] == 0.0 && values[60] == 5.0);
    }

    #[test]
    fn low_pass_keeps_low_and_drops_high_harmonics() {
        let wave = |k: f64, i: usize| (TAU * k * i as f64 / 100.0 + 0.3).sin();
        let mixed: Vec<f64> = (0..100).map(|i| 2.0 + wave(1.0, i) + 0.5 * wave(3.0, i) + wave(7.0, i)).collect();
        for (i, y) in low_pass(&mixed, 3).iter().enumerate() {
            assert!((y - 2.0 - wave(1.0, i) - 0.5 * wave(3.0, i)).abs() < 1e-12);
        }
    }

    #[test]
    fn smooth_step_has_the_slope_of_its_closed_form() {
        // d/dx = 30 t² (1 − t)² / (b − a)
        for k in 0..=10 {
            let t = f64::from(k) / 10.0;
            let x = 2.0 + 3.0 * t;
            let slope = (smooth_step(2.0, 5.0, x + 1e-6) - smooth_step(2.0, 5.0, x - 1e-6)) / 2e-6;
            assert!((slope - 10.0 * t * t * (1.0 - t) * (1.0 - t)).abs() < 1e-6);
        }
    }
}

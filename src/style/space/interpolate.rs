//! Cubic interpolation between knots at unequal times, as weights of four samples.
//!
//! Hermite's cubic with the slope of the parabola through three knots (Bessel):
//!   m_i = (h_i d_{i−1} + h_{i−1} d_i)/(h_{i−1} + h_i),  h_i = t_{i+1} − t_i,  d_i = (v_{i+1} − v_i)/h_i.        (1)
//! Exact for quadratics, O(h³) else; at the ends of an open curve the slope is the secant's. Weights, not values, so that all
//! curves of a posture share them. Checked against quadratics, and the order of convergence on a sine.

/// The interval of increasing `times` that holds `t`, which is inside.
fn interval(times: &[f64], t: f64) -> usize {
    times.partition_point(|&knot| knot <= t).clamp(1, times.len() - 1) - 1
}

/// Four samples, their weights, and how many cycles ahead (−1, 0, 1) each is. `times` are the knots from 0 on, increasing; of a
/// cyclic curve the last is the first again, and its sample is number 0. `t` outside is moved to the ends.
pub fn at(times: &[f64], cyclic: bool, t: f64) -> ([usize; 4], [f64; 4], [f64; 4]) {
    let last = times.len() - 1;
    let i = interval(times, t);
    let h = times[i + 1] - times[i];
    let u = ((t - times[i]) / h).clamp(0.0, 1.0);
    let (u2, u3) = (u * u, u * u * u);
    let mut weights = [0.0, 2.0 * u3 - 3.0 * u2 + 1.0, 3.0 * u2 - 2.0 * u3, 0.0];
    let before = if i > 0 { Some(times[i] - times[i - 1]) } else { cyclic.then(|| times[last] - times[last - 1]) };
    let after = if i + 2 <= last { Some(times[i + 2] - times[i + 1]) } else { cyclic.then(|| times[1] - times[0]) };
    slope(&mut weights, 0, before, Some(h), (u3 - 2.0 * u2 + u) * h);
    slope(&mut weights, 1, Some(h), after, (u3 - u2) * h);
    let samples = [i as isize - 1, i as isize, i as isize + 1, i as isize + 2];
    if !cyclic {
        return (samples.map(|k| k.clamp(0, last as isize) as usize), weights, [0.0; 4]);
    }
    let count = last as isize;
    (samples.map(|k| k.rem_euclid(count) as usize), weights, samples.map(|k| k.div_euclid(count) as f64))
}

/// Adds `factor` times the slope (1) at sample `middle` + 1 of four to the weights; a missing neighbour leaves the secant.
fn slope(weights: &mut [f64; 4], middle: usize, before: Option<f64>, after: Option<f64>, factor: f64) {
    let (a, b) = match (before, after) {
        (Some(before), Some(after)) => (after / (before + after), before / (before + after)),
        (Some(_), None) => (1.0, 0.0),
        _ => (0.0, 1.0),
    };
    if let Some(before) = before {
        weights[middle] -= factor * a / before;
        weights[middle + 1] += factor * a / before;
    }
    if let Some(after) = after {
        weights[middle + 1] -= factor * b / after;
        weights[middle + 2] += factor * b / after;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    fn value(times: &[f64], cyclic: bool, t: f64, f: impl Fn(f64) -> f64) -> f64 {
        let (samples, weights, _) = at(times, cyclic, t);
        samples.iter().zip(weights).map(|(&s, w)| w * f(times[s])).sum()
    }

    #[test]
    fn quadratics_are_exact_inside_and_knots_everywhere() {
        let times = [0.0, 0.1, 0.35, 0.4, 0.8, 1.0];
        let f = |t: f64| 3.0 - 2.0 * t + 5.0 * t * t;
        for t in [0.1, 0.17, 0.35, 0.39, 0.4, 0.77] {
            assert!((value(&times, false, t, f) - f(t)).abs() < 1e-12, "{t}");
        }
        assert!(times.iter().all(|&t| (value(&times, false, t, f) - f(t)).abs() < 1e-12));
        assert_eq!(value(&times, false, 1.7, f), f(1.0));
    }

    #[test]
    fn a_sine_converges_with_the_third_order_or_better_around_the_wrap() {
        let worst = |n: usize| {
            // Unequal knots: every interval's length swings by a third.
            let times: Vec<f64> = (0..=n).map(|k| k as f64 / n as f64 + 0.05 * (TAU * k as f64 / n as f64).sin()).collect();
            let f = |t: f64| (TAU * t + 0.4).sin();
            (0..1000).map(|k| (value(&times, true, k as f64 / 1000.0, f) - f(k as f64 / 1000.0)).abs()).fold(0.0, f64::max)
        };
        let (coarse, fine) = (worst(20), worst(40));
        assert!(fine < coarse / 7.0 && fine < 5e-4, "{coarse} {fine}");
    }

    #[test]
    fn wraps_count_the_cycles() {
        let times = [0.0, 0.25, 0.5, 0.75, 1.0];
        assert_eq!(at(&times, true, 0.9).0, [2, 3, 0, 1]);
        assert_eq!(at(&times, true, 0.9).2, [0.0, 0.0, 1.0, 1.0]);
        assert_eq!(at(&times, true, 0.1).2, [-1.0, 0.0, 0.0, 0.0]);
        assert_eq!(at(&times, false, 0.1).0, [0, 0, 1, 2]);
    }
}

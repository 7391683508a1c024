//! Natural cubic splines of vectors over one variable.
//!
//! Second derivatives M_i at the knots solve, with h_i = x_{i+1} − x_i and M_0 = M_n = 0,
//!   h_{i-1} M_{i-1} + 2(h_{i-1}+h_i) M_i + h_i M_{i+1} = 6[(y_{i+1}−y_i)/h_i − (y_i−y_{i-1})/h_{i-1}]      (1)
//! (Press et al., Numerical Recipes, 3.3). One knot is a constant, two a line; beyond the ends the spline goes on straight.
//! Checked against the closed form of three knots, continuity of two derivatives, and convergence on a sine.

use nalgebra::DVector;

#[derive(Clone, Debug)]
pub struct Spline {
    x: Vec<f64>,
    y: Vec<DVector<f64>>,
    second: Vec<DVector<f64>>,
}

impl Spline {
    /// Through `y[i]` at `x[i]`; `None` unless there is a knot, x increases strictly and all y have one length.
    pub fn natural(x: Vec<f64>, y: Vec<DVector<f64>>) -> Option<Spline> {
        let length = y.first()?.len();
        let increasing = x.windows(2).all(|w| w[0] < w[1]) && x.iter().all(|v| v.is_finite());
        if x.len() != y.len() || !increasing || y.iter().any(|v| v.len() != length) {
            return None;
        }
        let second = second_derivatives(&x, &y);
        Some(Spline { x, y, second })
    }

    /// First and last knot.
    pub fn range(&self) -> (f64, f64) {
        (self.x[0], self.x[self.x.len() - 1])
    }

    /// All knots, smallest first.
    pub fn knots(&self) -> &[f64] {
        &self.x
    }

    pub fn at(&self, x: f64) -> DVector<f64> {
        let last = self.x.len() - 1;
        if last == 0 {
            return self.y[0].clone();
        }
        if x < self.x[0] {
            return &self.y[0] + self.slope(0, 0.0) * (x - self.x[0]);
        }
        if x > self.x[last] {
            return &self.y[last] + self.slope(last - 1, 1.0) * (x - self.x[last]);
        }
        let i = self.x[1..last].partition_point(|&knot| knot <= x);
        let h = self.x[i + 1] - self.x[i];
        let (b, a) = ((x - self.x[i]) / h, (self.x[i + 1] - x) / h);
        let bend = &self.second[i] * (a.powi(3) - a) + &self.second[i + 1] * (b.powi(3) - b);
        &self.y[i] * a + &self.y[i + 1] * b + bend * (h * h / 6.0)
    }

    /// Derivative in interval `i` at its start (`b` = 0) or end (`b` = 1).
    fn slope(&self, i: usize, b: f64) -> DVector<f64> {
        let h = self.x[i + 1] - self.x[i];
        let a = 1.0 - b;
        let bend = &self.second[i + 1] * (3.0 * b * b - 1.0) - &self.second[i] * (3.0 * a * a - 1.0);
        (&self.y[i + 1] - &self.y[i]) / h + bend * (h / 6.0)
    }
}

/// Equation (1) by elimination of the tridiagonal system.
fn second_derivatives(x: &[f64], y: &[DVector<f64>]) -> Vec<DVector<f64>> {
    let n = x.len();
    let mut second = vec![DVector::zeros(y[0].len()); n];
    let mut upper = vec![0.0; n];
    for i in 1..n.saturating_sub(1) {
        let (h0, h1) = (x[i] - x[i - 1], x[i + 1] - x[i]);
        let right = ((&y[i + 1] - &y[i]) / h1 - (&y[i] - &y[i - 1]) / h0) * 6.0;
        let pivot = 2.0 * (h0 + h1) - h0 * upper[i - 1];
        upper[i] = h1 / pivot;
        second[i] = (right - &second[i - 1] * h0) / pivot;
    }
    for i in (1..n.saturating_sub(1)).rev() {
        let next = &second[i + 1] * upper[i];
        second[i] -= next;
    }
    second
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scalar(x: &[f64], y: &[f64]) -> Spline {
        Spline::natural(x.to_vec(), y.iter().map(|&v| DVector::from_element(1, v)).collect()).unwrap()
    }

    #[test]
    fn three_knots_have_the_closed_form() {
        // M_1 = 3 (y0 − 2 y1 + y2) / (2 h²): at the first middle y = (y0+y1)/2 − h² M_1/16.
        let s = scalar(&[0.0, 0.4, 0.8], &[1.0, 3.0, 2.0]);
        let m = 3.0 * (1.0 - 6.0 + 2.0) / (2.0 * 0.16);
        assert!((s.at(0.2)[0] - (2.0 - 0.16 * m / 16.0)).abs() < 1e-12);
        assert_eq!(s.at(0.4)[0], 3.0);
    }

    #[test]
    fn is_smooth_at_knots_and_straight_beyond() {
        let s = scalar(&[0.0, 1.0, 1.5, 4.0], &[0.0, 2.0, -1.0, 1.0]);
        let derivative = |x: f64, h: f64| (s.at(x + h)[0] - s.at(x)[0]) / h;
        for knot in [0.0, 1.0, 1.5, 4.0] {
            assert!((derivative(knot, 1e-6) - derivative(knot, -1e-6)).abs() < 1e-4, "{knot}");
        }
        assert!((s.at(6.0)[0] - 2.0 * s.at(5.0)[0] + s.at(4.0)[0]).abs() < 1e-12);
        assert!((s.at(-2.0)[0] - 2.0 * s.at(-1.0)[0] + s.at(0.0)[0]).abs() < 1e-12);
    }

    #[test]
    fn converges_with_the_fourth_power_on_a_sine() {
        // sin has no curvature at 0 and π, so the natural ends cost no order.
        let error = |n: usize| {
            let x: Vec<f64> = (0..=n).map(|i| std::f64::consts::PI * i as f64 / n as f64).collect();
            let s = scalar(&x, &x.iter().map(|v| v.sin()).collect::<Vec<_>>());
            (0..1000).map(|i| std::f64::consts::PI * i as f64 / 1000.0).map(|v| (s.at(v)[0] - v.sin()).abs()).fold(0.0, f64::max)
        };
        let ratio = error(8) / error(16);
        assert!((14.0..18.5).contains(&ratio), "{ratio}");
    }

    #[test]
    fn few_knots_and_bad_knots() {
        assert_eq!(scalar(&[2.0], &[5.0]).at(9.0)[0], 5.0);
        assert!((scalar(&[0.0, 2.0], &[1.0, 2.0]).at(3.0)[0] - 2.5).abs() < 1e-15);
        assert!(Spline::natural(vec![1.0, 1.0], vec![DVector::zeros(1), DVector::zeros(1)]).is_none());
        assert!(Spline::natural(vec![], vec![]).is_none());
    }
}

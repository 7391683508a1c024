//! Lens models: from the ideal image point (x, y) = (X/Z, Y/Z) to the one that the lens draws, and back.
//!
//! Brown-Conrady with OpenCV's rational denominator, r^2 = x^2 + y^2:
//!   g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
//!   x' = g x + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = g y + p1 (r^2 + 2 y^2) + 2 p2 x y.                 (1)
//! Fisheye (Kannala and Brandt 2006, PAMI 28(8), in OpenCV's form), theta = atan r:
//!   (x', y') = (x, y) theta_d / r,   theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).   (2)
//! The inverse of (1) is a Newton iteration, that of (2) a bracketed one; neither has an answer beyond the radius where its
//! model first folds over, and rays at 90 degrees or more from the axis have no ideal image point at all.
//! Checked against cv::projectPoints, cv::undistortPoints and their fisheye twins, Jacobians against central differences.

use nalgebra::{Matrix2, SMatrix, Vector2};
use std::f64::consts::FRAC_PI_2;

/// What a lens does to the ideal image point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// k1, k2, p1, p2, k3, k4, k5, k6 of (1), OpenCV's order.
    BrownConrady([f64; 8]),
    /// k1, k2, k3, k4 of (2).
    Fisheye([f64; 4]),
}

/// Steps in which the way to a point is searched for the fold of the model; a fold and its return within one step go unseen.
const FOLD_STEPS: u32 = 8;
const FISHEYE_STEPS: u32 = 48;

impl Lens {
    /// No distortion.
    pub const IDEAL: Lens = Lens::BrownConrady([0.0; 8]);

    /// From OpenCV's terms: 4, 5 or 8, or more (thin prism, tilt) where all further ones are zero; `None` otherwise.
    pub fn brown_conrady(terms: &[f64]) -> Option<Lens> {
        let known = matches!(terms.len(), 4 | 5 | 8 | 12 | 14) && terms.iter().skip(8).all(|t| *t == 0.0);
        known.then(|| Lens::BrownConrady(std::array::from_fn(|k| terms.get(k).copied().unwrap_or(0.0))))
    }

    /// From the four terms of OpenCV's fisheye module; `None` for another number of terms.
    pub fn fisheye(terms: &[f64]) -> Option<Lens> {
        Some(Lens::Fisheye(terms.try_into().ok()?))
    }

    /// OpenCV's terms: 5 or, with a denominator, 8 of Brown-Conrady; 4 of a fisheye lens.
    pub fn terms(&self) -> &[f64] {
        match self {
            Lens::BrownConrady(t) if t[5..] == [0.0; 3] => &t[..5],
            Lens::BrownConrady(t) => t,
            Lens::Fisheye(t) => t,
        }
    }

    pub fn is_fisheye(&self) -> bool {
        matches!(self, Lens::Fisheye(_))
    }

    /// The drawn image point of an ideal one, and its Jacobian.
    pub fn distort(&self, ideal: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        match self {
            Lens::BrownConrady(terms) => brown_conrady(terms, ideal),
            Lens::Fisheye(terms) => fisheye(terms, ideal),
        }
    }

    /// Derivative of the drawn image point by the terms, in their order; columns beyond the model's terms are zero.
    pub fn jacobian_by_terms(&self, ideal: &Vector2<f64>) -> SMatrix<f64, 2, 8> {
        let mut jacobian = SMatrix::<f64, 2, 8>::zeros();
        match self {
            Lens::BrownConrady(terms) => {
                let (x, y, r2) = (ideal.x, ideal.y, ideal.norm_squared());
                let [above, below] = fraction(terms, r2);
                let powers = Vector2::new(x, y) / below;
                for (column, power) in [(0, r2), (1, r2 * r2), (4, r2 * r2 * r2)] {
                    jacobian.set_column(column, &(powers * power));
                }
                for (column, power) in [(5, r2), (6, r2 * r2), (7, r2 * r2 * r2)] {
                    jacobian.set_column(column, &(-powers * (power * above / below)));
                }
                jacobian.set_column(2, &Vector2::new(2.0 * x * y, r2 + 2.0 * y * y));
                jacobian.set_column(3, &Vector2::new(r2 + 2.0 * x * x, 2.0 * x * y));
            }
            Lens::Fisheye(_) => {
                let r = ideal.norm();
                if r > 0.0 {
                    let theta = r.atan();
                    for column in 0..4 {
                        jacobian.set_column(column, &(ideal * (theta.powi(2 * column as i32 + 3) / r)));
                    }
                }
            }
        }
        jacobian
    }

    /// The ideal image point of a drawn one; `None` where the model has none.
    pub fn undistort(&self, drawn: &Vector2<f64>) -> Option<Vector2<f64>> {
        match self {
            Lens::BrownConrady(terms) => undistort_brown_conrady(terms, drawn),
            Lens::Fisheye(terms) => undistort_fisheye(terms, drawn),
        }
    }
}

/// Numerator and denominator of g in (1).
fn fraction(terms: &[f64; 8], r2: f64) -> [f64; 2] {
    let [k1, k2, _, _, k3, k4, k5, k6] = *terms;
    [1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))]
}

/// g of (1) and its derivative by r^2.
fn radial(terms: &[f64; 8], r2: f64) -> [f64; 2] {
    let [k1, k2, _, _, k3, k4, k5, k6] = *terms;
    let [above, below] = fraction(terms, r2);
    let above_slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3);
    let below_slope = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6);
    let g = above / below;
    [g, (above_slope - g * below_slope) / below]
}

fn brown_conrady(terms: &[f64; 8], ideal: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let (p1, p2) = (terms[2], terms[3]);
    let (x, y) = (ideal.x, ideal.y);
    let r2 = x * x + y * y;
    let [g, slope] = radial(terms, r2);
    let slope = 2.0 * slope;
    let value = Vector2::new(x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y);
    let cross = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
    let jacobian =
        Matrix2::new(g + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x, cross, cross, g + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x);
    (value, jacobian)
}

fn undistort_brown_conrady(terms: &[f64; 8], drawn: &Vector2<f64>) -> Option<Vector2<f64>> {
    let mut at = *drawn;
    for _ in 0..30 {
        let (value, jacobian) = brown_conrady(terms, &at);
        let step = jacobian.try_inverse()? * (drawn - value);
        at += step;
        if step.norm() < 1e-13 {
            break;
        }
    }
    let (value, jacobian) = brown_conrady(terms, &at);
    // Both eigenvalues of the symmetric Jacobian are positive on this side of the fold only.
    let unfolded = jacobian.determinant() > 0.0 && jacobian.trace() > 0.0 && rises_until(terms, at.norm_squared());
    ((value - drawn).norm() < 1e-9 && unfolded).then_some(at)
}

/// Whether r g(r^2) rises all the way to this radius, without a pole.
fn rises_until(terms: &[f64; 8], r2: f64) -> bool {
    let [k1, k2, _, _, k3, k4, k5, k6] = *terms;
    // Polynomials that cannot bend so much by there need no search.
    let steepest = r2 * (3.0 * k1.abs() + r2 * (5.0 * k2.abs() + r2 * 7.0 * k3.abs()));
    let plain = [k4, k5, k6] == [0.0; 3] && steepest < 1.0;
    plain
        || (1..=FOLD_STEPS).all(|k| {
            let share = f64::from(k) / f64::from(FOLD_STEPS);
            let r2 = r2 * share * share;
            let [g, slope] = radial(terms, r2);
            fraction(terms, r2)[1] > 0.0 && g + 2.0 * r2 * slope > 0.0
        })
}

/// theta_d of (2) and its derivative.
fn fisheye_angle(terms: &[f64; 4], theta: f64) -> [f64; 2] {
    let [k1, k2, k3, k4] = *terms;
    let t2 = theta * theta;
    let value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
    [value, 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))]
}

fn fisheye(terms: &[f64; 4], ideal: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let r = ideal.norm();
    // The scale theta_d / r, and its derivative by r, divided by r; series near the axis, where both are 0 / 0.
    let (scale, slope) = if r < 1e-4 {
        let bend = terms[0] - 1.0 / 3.0;
        (1.0 + bend * r * r, 2.0 * bend)
    } else {
        let [angle, angle_slope] = fisheye_angle(terms, r.atan());
        let scale = angle / r;
        (scale, (angle_slope / (1.0 + r * r) - scale) / (r * r))
    };
    (ideal * scale, Matrix2::identity() * scale + ideal * ideal.transpose() * slope)
}

fn undistort_fisheye(terms: &[f64; 4], drawn: &Vector2<f64>) -> Option<Vector2<f64>> {
    let wanted = drawn.norm();
    if wanted < 1e-12 {
        return Some(*drawn);
    }
    let theta = fisheye_root(terms, wanted)?;
    (theta < FRAC_PI_2 - 1e-9).then(|| drawn * (theta.tan() / wanted))
}

/// The smallest angle below 90 degrees drawn at `wanted`, if the model rises all the way there.
fn fisheye_root(terms: &[f64; 4], wanted: f64) -> Option<f64> {
    let grid = |k: u32| FRAC_PI_2 * f64::from(k) / f64::from(FISHEYE_STEPS);
    let stop = (1..=FISHEYE_STEPS).find(|&k| {
        let [value, slope] = fisheye_angle(terms, grid(k));
        value >= wanted || slope <= 0.0
    })?;
    let (mut low, mut high) = (grid(stop - 1), grid(stop));
    let mut theta = 0.5 * (low + high);
    for _ in 0..60 {
        let [value, slope] = fisheye_angle(terms, theta);
        if value < wanted && slope > 0.0 {
            low = theta;
        } else {
            high = theta;
        }
        let newton = theta + (wanted - value) / slope;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - theta).abs() < 1e-15 {
            break;
        }
        theta = next;
    }
    let [value, slope] = fisheye_angle(terms, theta);
    ((value - wanted).abs() < 1e-10 && slope > 0.0).then_some(theta)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plain lens, one of 120 degrees as action cameras have, and two fisheye lenses (the second from a published calibration).
    pub(crate) fn lenses() -> [Lens; 4] {
        [
            Lens::BrownConrady([-0.31, 0.12, 1.3e-3, -0.9e-3, -0.02, 0.0, 0.0, 0.0]),
            Lens::BrownConrady([0.61, 0.052, 1e-4, -2e-4, 0.0012, 0.93, 0.21, 0.0093]),
            Lens::Fisheye([-0.02, 0.003, -0.004, 0.0008]),
            Lens::Fisheye([0.2783471016021346, 0.6964790605940689, -1.7636165117280103, 1.9185066948675424]),
        ]
    }

    /// Ideal points up to `reach` from the axis, with the axis itself.
    fn points(reach: f64) -> impl Iterator<Item = Vector2<f64>> {
        (0..60).map(f64::from).map(move |i| Vector2::new((2.4 * i).cos(), (2.4 * i).sin()) * (reach * i / 59.0))
    }

    #[test]
    fn jacobians_meet_central_differences() {
        for lens in lenses() {
            for p in points(0.9) {
                let (_, jacobian) = lens.distort(&p);
                let h = 1e-6;
                for k in 0..2 {
                    let e = Vector2::ith(k, h);
                    let numeric = (lens.distort(&(p + e)).0 - lens.distort(&(p - e)).0) / (2.0 * h);
                    assert!((numeric - jacobian.column(k)).norm() < 1e-8, "{lens:?} {p}: {numeric} {jacobian}");
                }
                let by_terms = lens.jacobian_by_terms(&p);
                let moved = |k: usize, h: f64| {
                    let mut lens = lens;
                    match &mut lens {
                        Lens::BrownConrady(terms) => terms[k] += h,
                        Lens::Fisheye(terms) => terms[k] += h,
                    }
                    lens.distort(&p).0
                };
                for k in 0..if lens.is_fisheye() { 4 } else { 8 } {
                    let numeric = (moved(k, h) - moved(k, -h)) / (2.0 * h);
                    // The series near the axis drops terms below 1e-16, which h divides.
                    assert!((numeric - by_terms.column(k)).norm() < 1e-8, "{lens:?} {p} term {k}: {numeric} {by_terms}");
                }
            }
        }
    }

    #[test]
    fn undistortion_inverts_the_lens_to_wide_angles() {
        let reach = [0.75, 1.75, 30.0, 1.2];
        for (lens, reach) in lenses().into_iter().zip(reach) {
            for p in points(reach) {
                let back = lens.undistort(&lens.distort(&p).0).unwrap_or_else(|| panic!("{lens:?} loses {p}"));
                assert!((back - p).norm() < 1e-9 * (1.0 + p.norm_squared()), "{lens:?} {p} {back}");
            }
        }
    }

    #[test]
    fn nothing_is_found_beyond_the_fold_or_beyond_a_right_angle() {
        // x (1 - 0.3 x^2) never exceeds 0.703.
        let barrel = Lens::BrownConrady([-0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert!(barrel.undistort(&Vector2::new(0.69, 0.0)).is_some() && barrel.undistort(&Vector2::new(0.72, 0.0)).is_none());
        // Rises again beyond the fold: 0.9 is drawn by an ideal point near 1.9 only, which a real lens never draws there.
        let again = Lens::BrownConrady([-0.5, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert!((again.distort(&Vector2::new(2.14, 0.0)).0.x - 1.73).abs() < 0.1);
        assert!(again.undistort(&Vector2::new(1.73, 0.0)).is_none());
        let wide = Lens::Fisheye([0.0; 4]);
        assert!((wide.undistort(&Vector2::new(0.0, 1.5)).unwrap().y - 1.5f64.tan()).abs() < 1e-9);
        assert!(wide.undistort(&Vector2::new(0.0, 1.58)).is_none());
        // theta (1 - 0.3 theta^2) never exceeds 0.703 either.
        let folding = Lens::Fisheye([-0.3, 0.0, 0.0, 0.0]);
        assert!(folding.undistort(&Vector2::new(0.69, 0.0)).is_some() && folding.undistort(&Vector2::new(0.71, 0.0)).is_none());
    }

    #[test]
    fn terms_are_counted() {
        let eight = Lens::brown_conrady(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]).unwrap();
        assert_eq!(eight.terms(), [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]);
        assert_eq!(Lens::brown_conrady(&[0.1, 0.2, 0.3, 0.4]).unwrap().terms(), [0.1, 0.2, 0.3, 0.4, 0.0]);
        let mut twelve = [0.0; 12];
        twelve[0] = -0.1;
        assert_eq!(Lens::brown_conrady(&twelve).unwrap().terms(), [-0.1, 0.0, 0.0, 0.0, 0.0]);
        twelve[9] = 1e-3;
        assert_eq!((Lens::brown_conrady(&twelve), Lens::brown_conrady(&[0.0; 6]), Lens::fisheye(&[0.0; 5])), (None, None, None));
    }
}

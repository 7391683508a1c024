//! Rotation vectors: exponential and logarithm, left Jacobian, weighted mean.
//!
//! R(v) = exp([v]×), and to first order R(v + dv) = exp([J_l(v) dv]×) R(v) with
//!   J_l(v) = I + (1−cos φ)/φ² [v]× + (φ−sin φ)/φ³ [v]×²,  φ = |v|.                                   (1)
//! Checked against central differences.

use nalgebra::{Matrix3, UnitQuaternion, Vector3, Vector4};

/// The matrix of the cross product: `hat(v) * x == v.cross(&x)`.
pub fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    v.cross_matrix()
}

/// Rotation by the vector `v`, radians about its direction.
pub fn exp(v: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(*v)
}

/// The rotation vector of `q`, of length at most π.
pub fn log(q: &UnitQuaternion<f64>) -> Vector3<f64> {
    // nalgebra's scaled_axis does not choose the shorter way for w < 0.
    if q.w < 0.0 { UnitQuaternion::new_unchecked(-q.into_inner()).scaled_axis() } else { q.scaled_axis() }
}

/// Left Jacobian of the exponential map, equation (1).
pub fn left_jacobian(v: &Vector3<f64>) -> Matrix3<f64> {
    let angle2 = v.norm_squared();
    let (a, b) = if angle2 < 1e-8 {
        (0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0)
    } else {
        let angle = angle2.sqrt();
        ((1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
    };
    let k = hat(v);
    Matrix3::identity() + k * a + k * k * b
}

/// The rotation with the smallest sum of squared angles to `rotations` (Karcher mean); `None` for an empty slice.
pub fn mean(rotations: &[UnitQuaternion<f64>]) -> Option<UnitQuaternion<f64>> {
    let first = *rotations.first()?;
    // The sum of the quaternions is near it already.
    let sum: Vector4<f64> = rotations.iter().map(|q| q.coords * q.coords.dot(&first.coords).signum()).sum();
    let mut mean = UnitQuaternion::try_new(sum.into(), 1e-9).unwrap_or(first);
    for _ in 0..50 {
        let step = rotations.iter().map(|q| log(&(mean.inverse() * q))).sum::<Vector3<f64>>() / rotations.len() as f64;
        mean = UnitQuaternion::new_normalize((mean * exp(&step)).into_inner());
        // The next one would be smaller by the square of the spread.
        if step.norm() < 1e-10 {
            break;
        }
    }
    Some(mean)
}

/// The smallest rotation that carries direction `from` onto direction `to`.
///
/// Opposite directions have no unique answer; then it turns by π about any axis perpendicular to `from`.
pub fn between(from: &Vector3<f64>, to: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(from, to).unwrap_or_else(|| {
        let helper = if from.x.abs() < 0.9 * from.norm() { Vector3::x() } else { Vector3::y() };
        exp(&(from.cross(&helper).normalize() * std::f64::consts::PI))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn left_jacobian_matches_central_differences() {
        for v in [Vector3::zeros(), Vector3::new(1e-5, 2e-5, 0.0), Vector3::new(0.3, -0.8, 1.1), Vector3::new(2.0, 1.5, -1.0)] {
            let jacobian = left_jacobian(&v);
            for k in 0..3 {
                let h = 1e-6 * Vector3::ith(k, 1.0);
                let numeric = log(&(exp(&(v + h)) * exp(&(v - h)).inverse())) / 2e-6;
                assert!((numeric - jacobian.column(k)).norm() < 1e-8, "{v:?} column {k}");
            }
        }
    }

    #[test]
    fn log_takes_the_short_way() {
        let q = exp(&Vector3::new(0.0, 3.0, 0.0));
        let flipped = UnitQuaternion::new_unchecked(-q.into_inner());
        assert!((log(&flipped) - Vector3::new(0.0, 3.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn mean_of_symmetric_rotations_is_their_centre() {
        let centre = exp(&Vector3::new(0.4, 0.2, -0.9));
        let around: Vec<_> = (0..3).flat_map(|k| [1.0, -1.0].map(|s| centre * exp(&(Vector3::ith(k, 0.5) * s)))).collect();
        assert!(mean(&around).unwrap().angle_to(&centre) < 1e-9);
        assert!(mean(&[]).is_none());
    }

    #[test]
    fn between_carries_directions_even_opposite_ones() {
        for (a, b) in [(Vector3::x(), Vector3::new(0.1, 2.0, -1.0)), (Vector3::y(), -Vector3::y())] {
            assert!((between(&a, &b) * a.normalize() - b.normalize()).norm() < 1e-9);
        }
    }
}

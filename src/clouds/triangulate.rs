//! World points with covariance.
//!
//! X(u, v, d) is [`Rectification::world_from_pixel`]; with its Jacobian J,
//!   Σ = J diag(σ_p², σ_p², σ_d²) Jᵀ.                                                                (1)

use super::cloud::{Cloud, CloudPoint};
use crate::rig::rectify::{Plane, Rectification};
use nalgebra::{Matrix3, Vector3};

/// Standard deviation of where in its window a disparity belongs, px: about half of the smallest window.
const PIXEL_SIGMA_PX: f64 = 1.0;

/// Points of all known disparities of the reference view; `sigma` and `confidence` are pictures of the same size.
pub fn triangulate(rectification: &Rectification, disparity: &Plane, sigma: &Plane, confidence: &Plane, grey: &Plane) -> Cloud {
    let known = disparity.enumerate_pixels().filter(|(_, _, d)| d.0[0] > 0.0);
    let point = |(u, v, d): (u32, u32, &image::Luma<f32>)| {
        let at = [f64::from(u), f64::from(v), f64::from(d.0[0])];
        let grey = grey.get_pixel(u, v).0[0].round().clamp(0.0, 255.0) as u8;
        CloudPoint {
            position: rectification.world_from_pixel(at[0], at[1], at[2]),
            colour: [grey; 3],
            confidence: f64::from(confidence.get_pixel(u, v).0[0]),
            covariance: covariance(rectification, at, f64::from(sigma.get_pixel(u, v).0[0])),
        }
    };
    Cloud { points: known.map(point).collect() }
}

/// Equation (1).
pub fn covariance(rectification: &Rectification, [u, v, d]: [f64; 3], sigma_d_px: f64) -> Matrix3<f64> {
    let jacobian = rectification.world_jacobian(u, v, d);
    let sigma = Vector3::new(PIXEL_SIGMA_PX, PIXEL_SIGMA_PX, sigma_d_px);
    jacobian * Matrix3::from_diagonal(&sigma.component_mul(&sigma)) * jacobian.transpose()
}

//! World points with covariance.
//!
//! X(u, v, d) is [`Rectification::world_from_pixel`]; with its Jacobian J,
//!   Σ = J diag(σ_p², σ_p², σ_d²) Jᵀ,                                                                (1)
//! σ_d of each pixel from [`super::subpixel`]. Confidence: 1 / (1 + (σ_d / 0.1 px)²).

use super::cloud::{Cloud, CloudPoint};
use super::subpixel::Refined;
use crate::rig::rectify::{Plane, Rectification};
use nalgebra::{Matrix3, Vector3};

/// Standard deviation of where in its window a disparity belongs, px: about half of the smallest window.
const PIXEL_SIGMA_PX: f64 = 1.0;

/// σ_d at which the confidence is a half, px: the median on footage with 2 grey levels of noise.
const HALF_CONFIDENCE_PX: f64 = 0.1;

/// Points of all known disparities of a part of the reference view whose first pixel is `corner`; `grey` is the whole picture.
pub fn triangulate(rectification: &Rectification, refined: &Refined, corner: [usize; 2], grey: &Plane) -> Cloud {
    let point = |(u, v, d): (u32, u32, &image::Luma<f32>)| {
        let sigma_px = f64::from(refined.sigma_px.get_pixel(u, v).0[0]);
        let [u, v] = [u + corner[0] as u32, v + corner[1] as u32];
        let at = [f64::from(u), f64::from(v), f64::from(d.0[0])];
        let grey = grey.get_pixel(u, v).0[0].round().clamp(0.0, 255.0) as u8;
        CloudPoint {
            position: rectification.world_from_pixel(at[0], at[1], at[2]),
            colour: [grey; 3],
            confidence: 1.0 / (1.0 + (sigma_px / HALF_CONFIDENCE_PX).powi(2)),
            covariance: covariance(rectification, at, sigma_px),
        }
    };
    Cloud { points: known(&refined.disparity).map(point).collect() }
}

/// The pixels that become points, in their order.
pub fn known(disparity: &Plane) -> impl Iterator<Item = (u32, u32, &image::Luma<f32>)> {
    disparity.enumerate_pixels().filter(|(_, _, d)| d.0[0] > 0.0)
}

/// Equation (1).
pub fn covariance(rectification: &Rectification, [u, v, d]: [f64; 3], sigma_d_px: f64) -> Matrix3<f64> {
    let jacobian = rectification.world_jacobian(u, v, d);
    let sigma = Vector3::new(PIXEL_SIGMA_PX, PIXEL_SIGMA_PX, sigma_d_px);
    jacobian * Matrix3::from_diagonal(&sigma.component_mul(&sigma)) * jacobian.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::rectify::rectify;
    use crate::rig::rectify::tests::random_rig;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    #[test]
    fn covariance_meets_the_spread_of_noisy_triangulations() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let rectification = rectify(&random_rig(&mut random, false), &[0, 1, 2]).unwrap();
        let at = [300.0, 200.0, rectification.disparity(3.0)];
        // Uniform noise of standard deviation s has half-width s sqrt 3.
        let mut noise = |sigma: f64| (random.random::<f64>() - 0.5) * 2.0 * sigma * 3f64.sqrt();
        let draws: Vec<Vector3<f64>> = (0..20000)
            .map(|_| rectification.world_from_pixel(at[0] + noise(PIXEL_SIGMA_PX), at[1] + noise(PIXEL_SIGMA_PX), at[2] + noise(0.3)))
            .collect();
        let mean = draws.iter().sum::<Vector3<f64>>() / draws.len() as f64;
        let spread = draws.iter().map(|x| (x - mean) * (x - mean).transpose()).sum::<Matrix3<f64>>() / draws.len() as f64;
        let expected = covariance(&rectification, at, 0.3);
        assert!((spread - expected).norm() < 0.05 * expected.norm(), "{spread} {expected}");
    }
}

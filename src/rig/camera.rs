//! Pinhole camera with Brown-Conrady distortion (OpenCV's model).
//!
//! x_in_camera = R x_in_world + t,  (x, y) = (X/Z, Y/Z),  r² = x² + y²,
//!   x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2x²),
//!   y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2y²) + 2 p2 x y,
//!   u = fx x' + s y' + cx,  v = fy y' + cy.                                                         (1)
//! The inverse is a Newton iteration; it fails beyond the radius where (1) folds over.
//! Checked against cv::projectPoints and cv::undistortPoints.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Point2, Rotation3, Vector2, Vector3};

/// One calibrated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    pub name: String,
    /// Image width and height, pixels.
    pub size_px: [u32; 2],
    /// Camera matrix K, pixels.
    pub matrix: Matrix3<f64>,
    /// k1, k2, p1, p2, k3.
    pub distortion: [f64; 5],
    pub camera_from_world: Rotation3<f64>,
    /// World origin in the camera, metres: `x_in_camera = camera_from_world * x_in_world + translation`.
    pub translation: Vector3<f64>,
}

impl Camera {
    /// Optical centre in the world, metres.
    pub fn centre(&self) -> Vector3<f64> {
        -(self.camera_from_world.inverse() * self.translation)
    }

    /// A world point in the camera frame, metres.
    pub fn camera_point(&self, x_in_world: &Vector3<f64>) -> Vector3<f64> {
        self.camera_from_world * x_in_world + self.translation
    }

    /// Pixel of a world point; `None` behind the camera (nearer than 1 mm in depth).
    pub fn project(&self, x_in_world: &Vector3<f64>) -> Option<Point2<f64>> {
        let p = self.camera_point(x_in_world);
        (p.z > 1e-3).then(|| self.distorted_pixel(&Vector2::new(p.x / p.z, p.y / p.z)))
    }

    /// Pixel of a world point and its derivative for the point, pixels per metre; `None` behind the camera.
    pub fn project_with_jacobian(&self, x_in_world: &Vector3<f64>) -> Option<(Point2<f64>, Matrix2x3<f64>)> {
        let p = self.camera_point(x_in_world);
        if p.z <= 1e-3 {
            return None;
        }
        let normalised = Vector2::new(p.x / p.z, p.y / p.z);
        let perspective = Matrix2x3::new(1.0, 0.0, -normalised.x, 0.0, 1.0, -normalised.y) / p.z;
        let lens = self.distort(&normalised).1;
        let pixels = self.matrix.fixed_view::<2, 2>(0, 0);
        Some((self.distorted_pixel(&normalised), pixels * lens * perspective * self.camera_from_world.matrix()))
    }

    /// Pixel of the normalised image point (X/Z, Y/Z).
    pub fn distorted_pixel(&self, normalised: &Vector2<f64>) -> Point2<f64> {
        let d = self.distort(normalised).0;
        let m = &self.matrix;
        Point2::new(m[(0, 0)] * d.x + m[(0, 1)] * d.y + m[(0, 2)], m[(1, 1)] * d.y + m[(1, 2)])
    }

    /// Normalised image point (X/Z, Y/Z) of a pixel, distortion removed; `None` where the distortion has no inverse.
    pub fn normalise(&self, pixel: &Point2<f64>) -> Option<Vector2<f64>> {
        let m = &self.matrix;
        let y = (pixel.y - m[(1, 2)]) / m[(1, 1)];
        let wanted = Vector2::new((pixel.x - m[(0, 2)] - m[(0, 1)] * y) / m[(0, 0)], y);
        let mut at = wanted;
        for _ in 0..30 {
            let (value, jacobian) = self.distort(&at);
            let step = jacobian.lu().solve(&(wanted - value))?;
            at += step;
            if step.norm() < 1e-13 {
                break;
            }
        }
        let (value, jacobian) = self.distort(&at);
        // Both eigenvalues of the symmetric Jacobian are positive on this side of the fold only.
        let before_fold = jacobian.determinant() > 0.0 && jacobian.trace() > 0.0;
        ((value - wanted).norm() < 1e-9 && before_fold).then_some(at)
    }

    /// Unit direction in the world of the ray through a pixel; `None` where the distortion has no inverse.
    pub fn ray(&self, pixel: &Point2<f64>) -> Option<Vector3<f64>> {
        let n = self.normalise(pixel)?;
        Some(self.camera_from_world.inverse() * Vector3::new(n.x, n.y, 1.0).normalize())
    }

    /// Distorted normalised point and its Jacobian, equation (1).
    fn distort(&self, n: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let (x, y) = (n.x, n.y);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3));
        let value =
            Vector2::new(x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y);
        let cross = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = Matrix2::new(
            radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (value, jacobian)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::calib3d;
    use opencv::core::{Mat, Point2d, Point3d, Vector as CvVector};

    fn camera() -> Camera {
        Camera {
            name: "cam_00".into(),
            size_px: [640, 480],
            matrix: Matrix3::new(553.5, 0.0, 318.0, 0.0, 549.0, 239.2, 0.0, 0.0, 1.0),
            distortion: [-0.31, 0.12, 1.3e-3, -0.9e-3, -0.02],
            camera_from_world: Rotation3::from_scaled_axis(Vector3::new(1.62, -0.02, 0.05)),
            translation: Vector3::new(0.1, 0.95, 0.05),
        }
    }

    fn cv_matrix(camera: &Camera) -> Mat {
        let m = &camera.matrix;
        let rows: Vec<[f64; 3]> = (0..3).map(|r| [m[(r, 0)], m[(r, 1)], m[(r, 2)]]).collect();
        Mat::from_slice_2d(&rows).unwrap()
    }

    fn grid_px() -> impl Iterator<Item = Point2<f64>> {
        (0..=8).flat_map(|i| (0..=6).map(move |k| Point2::new(639.0 / 8.0 * f64::from(i), 479.0 / 6.0 * f64::from(k))))
    }

    #[test]
    fn projection_matches_opencv() {
        let camera = camera();
        let points: Vec<_> =
            (0..60).map(f64::from).map(|i| Vector3::new((i * 0.7).sin(), 3.0 + (i * 0.3).cos(), 1.0 + 0.8 * (i * 1.1).sin())).collect();
        let objects: CvVector<Point3d> = points.iter().map(|p| Point3d::new(p.x, p.y, p.z)).collect();
        let rotation = camera.camera_from_world.scaled_axis();
        let mut pixels = CvVector::<Point2d>::new();
        calib3d::project_points_def(
            &objects,
            &Mat::from_slice(rotation.as_slice()).unwrap(),
            &Mat::from_slice(camera.translation.as_slice()).unwrap(),
            &cv_matrix(&camera),
            &Mat::from_slice(&camera.distortion).unwrap(),
            &mut pixels,
        )
        .unwrap();
        for (point, expected) in points.iter().zip(pixels) {
            let pixel = camera.project(point).unwrap();
            assert!((pixel - Point2::new(expected.x, expected.y)).norm() < 1e-9, "{point:?}: {pixel:?}, OpenCV {expected:?}");
        }
    }

    #[test]
    fn normalise_matches_opencv_and_inverts_the_distortion() {
        let camera = camera();
        let pixels: CvVector<Point2d> = grid_px().map(|p| Point2d::new(p.x, p.y)).collect();
        let mut expected = CvVector::<Point2d>::new();
        let criteria = opencv::core::TermCriteria::new(3, 200, 1e-14).unwrap();
        let none = Mat::default();
        let distortion = Mat::from_slice(&camera.distortion).unwrap();
        calib3d::undistort_points_iter(&pixels, &mut expected, &cv_matrix(&camera), &distortion, &none, &none, criteria).unwrap();
        for (pixel, expected) in grid_px().zip(expected) {
            let n = camera.normalise(&pixel).unwrap();
            assert!((n - Vector2::new(expected.x, expected.y)).norm() < 1e-9, "{pixel:?}: {n:?}, OpenCV {expected:?}");
            assert!((camera.distorted_pixel(&n) - pixel).norm() < 1e-9);
        }
    }

    #[test]
    fn rays_pass_through_their_points_and_points_behind_have_no_pixel() {
        let camera = camera();
        let point = Vector3::new(0.4, 3.1, 1.2);
        let ray = camera.ray(&camera.project(&point).unwrap()).unwrap();
        assert!(((point - camera.centre()).normalize() - ray).norm() < 1e-12);
        assert!(camera.project(&Vector3::new(0.4, -3.1, 1.2)).is_none());
    }

    #[test]
    fn pixels_beyond_the_fold_of_the_distortion_have_no_inverse() {
        // x (1 - 0.3 x²) never exceeds 0.703.
        let camera = Camera { distortion: [-0.3, 0.0, 0.0, 0.0, 0.0], ..camera() };
        assert!(camera.normalise(&Point2::new(318.0 + 553.5 * 0.69, 239.2)).is_some());
        assert!(camera.normalise(&Point2::new(318.0 + 553.5 * 0.72, 239.2)).is_none());
    }
}

//! One camera: pose, camera matrix and lens.
//!
//! x_in_camera = R x_in_world + t,  (x, y) = (X/Z, Y/Z),  (x', y') = lens(x, y),
//!   u = fx x' + s y' + cx,  v = fy y' + cy.
//! Checked against OpenCV's projection and undistortion, pinhole and fisheye.

use super::Lens;
use nalgebra::{Matrix2x3, Matrix3, Point2, Rotation3, Vector2, Vector3};

/// One calibrated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    pub name: String,
    /// Image width and height, pixels.
    pub size_px: [u32; 2],
    /// Camera matrix K, pixels.
    pub matrix: Matrix3<f64>,
    pub lens: Lens,
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
        let lens = self.lens.distort(&normalised).1;
        let pixels = self.matrix.fixed_view::<2, 2>(0, 0);
        Some((self.distorted_pixel(&normalised), pixels * lens * perspective * self.camera_from_world.matrix()))
    }

    /// Pixel of the normalised image point (X/Z, Y/Z).
    pub fn distorted_pixel(&self, normalised: &Vector2<f64>) -> Point2<f64> {
        let d = self.lens.distort(normalised).0;
        let m = &self.matrix;
        Point2::new(m[(0, 0)] * d.x + m[(0, 1)] * d.y + m[(0, 2)], m[(1, 1)] * d.y + m[(1, 2)])
    }

    /// Normalised image point (X/Z, Y/Z) of a pixel, distortion removed; `None` where there is none: beyond the lens model's
    /// reach, or at 90 degrees and more from the axis.
    pub fn normalise(&self, pixel: &Point2<f64>) -> Option<Vector2<f64>> {
        let m = &self.matrix;
        let y = (pixel.y - m[(1, 2)]) / m[(1, 1)];
        self.lens.undistort(&Vector2::new((pixel.x - m[(0, 2)] - m[(0, 1)] * y) / m[(0, 0)], y))
    }

    /// Angles between the rays through the middles of opposite edges of the picture, horizontal and vertical, radians; `None`
    /// where an edge has no ray.
    pub fn field_of_view(&self) -> [Option<f64>; 2] {
        let [w, h] = self.size_px.map(f64::from);
        let (cx, cy) = (self.matrix[(0, 2)], self.matrix[(1, 2)]);
        let edges = [[Point2::new(-0.5, cy), Point2::new(w - 0.5, cy)], [Point2::new(cx, -0.5), Point2::new(cx, h - 0.5)]];
        edges.map(|[a, b]| Some(self.ray(&a)?.angle(&self.ray(&b)?)))
    }

    /// How far the lens moves the picture's corners away from the principal point, pixels: that of the corner moved most,
    /// negative for a barrel.
    pub fn corner_shift_px(&self) -> f64 {
        let m = &self.matrix;
        let [w, h] = self.size_px.map(|s| f64::from(s) - 1.0);
        let centre = Point2::new(m[(0, 2)], m[(1, 2)]);
        let shift = |corner: Point2<f64>| {
            let y = (corner.y - centre.y) / m[(1, 1)];
            let ideal = Vector2::new((corner.x - centre.x - m[(0, 1)] * y) / m[(0, 0)], y);
            (self.distorted_pixel(&ideal) - centre).norm() - (corner - centre).norm()
        };
        let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)].map(|(x, y)| shift(Point2::new(x, y)));
        corners.into_iter().fold(0.0, |most: f64, s| if s.abs() > most.abs() { s } else { most })
    }

    /// Unit direction in the world of the ray through a pixel; `None` where [`Self::normalise`] has none.
    pub fn ray(&self, pixel: &Point2<f64>) -> Option<Vector3<f64>> {
        let n = self.normalise(pixel)?;
        Some(self.camera_from_world.inverse() * Vector3::new(n.x, n.y, 1.0).normalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::calib3d;
    use opencv::core::{Mat, Point2d, Point3d, TermCriteria, Vector as CvVector};
    use opencv::prelude::MatTraitConst;

    fn camera(lens: Lens) -> Camera {
        Camera {
            name: "cam_00".into(),
            size_px: [640, 480],
            matrix: Matrix3::new(353.5, 0.0, 318.0, 0.0, 349.0, 239.2, 0.0, 0.0, 1.0),
            lens,
            camera_from_world: Rotation3::from_scaled_axis(Vector3::new(1.62, -0.02, 0.05)),
            translation: Vector3::new(0.1, 0.95, 0.05),
        }
    }

    fn cameras() -> [Camera; 4] {
        [
            Lens::BrownConrady([-0.11, 0.02, 1.3e-3, -0.9e-3, -0.002, 0.0, 0.0, 0.0]),
            Lens::BrownConrady([0.61, 0.052, 1e-4, -2e-4, 0.0012, 0.93, 0.21, 0.0093]),
            Lens::Fisheye([-0.02, 0.003, -0.004, 0.0008]),
            Lens::Fisheye([0.2783471016021346, 0.6964790605940689, -1.7636165117280103, 1.9185066948675424]),
        ]
        .map(camera)
    }

    fn cv_matrix(camera: &Camera) -> Mat {
        let m = &camera.matrix;
        let rows: Vec<[f64; 3]> = (0..3).map(|r| [m[(r, 0)], m[(r, 1)], m[(r, 2)]]).collect();
        Mat::from_slice_2d(&rows).unwrap()
    }

    fn column(numbers: &[f64]) -> Mat {
        Mat::new_rows_cols_with_data(numbers.len() as i32, 1, numbers).unwrap().try_clone().unwrap()
    }

    fn grid_px() -> impl Iterator<Item = Point2<f64>> {
        (0..=8).flat_map(|i| (0..=6).map(move |k| Point2::new(639.0 / 8.0 * f64::from(i), 479.0 / 6.0 * f64::from(k))))
    }

    #[test]
    fn projection_matches_opencv() {
        for camera in cameras() {
            let points: Vec<_> =
                (0..60).map(f64::from).map(|i| Vector3::new((i * 0.7).sin(), 3.0 + (i * 0.3).cos(), 1.0 + 0.8 * (i * 1.1).sin())).collect();
            let objects: CvVector<Point3d> = points.iter().map(|p| Point3d::new(p.x, p.y, p.z)).collect();
            let (rotation, translation) =
                (column(camera.camera_from_world.scaled_axis().as_slice()), column(camera.translation.as_slice()));
            let (matrix, terms) = (cv_matrix(&camera), column(camera.lens.terms()));
            let mut pixels = CvVector::<Point2d>::new();
            if camera.lens.is_fisheye() {
                calib3d::fisheye_project_points_vec_def(&objects, &mut pixels, &rotation, &translation, &matrix, &terms).unwrap();
            } else {
                calib3d::project_points_def(&objects, &rotation, &translation, &matrix, &terms, &mut pixels).unwrap();
            }
            for (point, expected) in points.iter().zip(pixels) {
                let pixel = camera.project(point).unwrap();
                assert!((pixel - Point2::new(expected.x, expected.y)).norm() < 1e-9, "{point:?}: {pixel:?}, OpenCV {expected:?}");
            }
        }
    }

    #[test]
    fn normalise_matches_opencv_and_inverts_the_distortion() {
        for camera in cameras() {
            let pixels: CvVector<Point2d> = grid_px().map(|p| Point2d::new(p.x, p.y)).collect();
            let mut expected = CvVector::<Point2d>::new();
            let criteria = TermCriteria::new(3, 1000, 1e-14).unwrap();
            let (none, matrix, terms) = (Mat::default(), cv_matrix(&camera), column(camera.lens.terms()));
            if camera.lens.is_fisheye() {
                calib3d::fisheye_undistort_points(&pixels, &mut expected, &matrix, &terms, &none, &none, criteria).unwrap();
            } else {
                calib3d::undistort_points_iter(&pixels, &mut expected, &matrix, &terms, &none, &none, criteria).unwrap();
            }
            for (pixel, expected) in grid_px().zip(expected) {
                let n = camera.normalise(&pixel).unwrap();
                assert!((n - Vector2::new(expected.x, expected.y)).norm() < 1e-8, "{pixel:?}: {n:?}, OpenCV {expected:?}");
                assert!((camera.distorted_pixel(&n) - pixel).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn the_projections_jacobian_meets_central_differences() {
        for camera in cameras() {
            let point = Vector3::new(0.9, 2.1, 1.7);
            let (pixel, jacobian) = camera.project_with_jacobian(&point).unwrap();
            assert_eq!(Some(pixel), camera.project(&point));
            for k in 0..3 {
                let step = Vector3::ith(k, 1e-6);
                let numeric = (camera.project(&(point + step)).unwrap() - camera.project(&(point - step)).unwrap()) / 2e-6;
                assert!((numeric - jacobian.column(k)).norm() < 1e-5, "{numeric} {jacobian}");
            }
        }
    }

    #[test]
    fn rays_pass_through_their_points_and_points_behind_have_no_pixel() {
        for camera in cameras() {
            let point = Vector3::new(0.4, 3.1, 1.2);
            let ray = camera.ray(&camera.project(&point).unwrap()).unwrap();
            assert!(((point - camera.centre()).normalize() - ray).norm() < 1e-12);
            assert!(camera.project(&Vector3::new(0.4, -3.1, 1.2)).is_none());
        }
    }

    #[test]
    fn fields_and_corner_shifts_have_their_closed_forms() {
        let ideal = camera(Lens::IDEAL);
        let [wide, high] = ideal.field_of_view().map(Option::unwrap);
        assert!((wide - ((318.5 / 353.5f64).atan() + (321.5 / 353.5f64).atan())).abs() < 1e-12);
        assert!((high - ((239.7 / 349.0f64).atan() + (240.3 / 349.0f64).atan())).abs() < 1e-12);
        assert!(ideal.corner_shift_px().abs() < 1e-9);
        // The farthest corner, at r from the centre with fx = fy, is drawn at f atan(r / f).
        let mut fisheye = camera(Lens::Fisheye([0.0; 4]));
        fisheye.matrix[(1, 1)] = 353.5;
        let r = 321f64.hypot(239.8);
        assert!((fisheye.corner_shift_px() - (353.5 * (r / 353.5).atan() - r)).abs() < 1e-9);
        let [wide, _] = fisheye.field_of_view().map(Option::unwrap);
        assert!((wide - 640.0 / 353.5).abs() < 1e-12);
        fisheye.matrix[(0, 0)] = 180.0;
        assert_eq!(fisheye.field_of_view()[0], None);
    }

    #[test]
    fn pixels_at_a_right_angle_have_no_ray() {
        let camera = camera(Lens::Fisheye([0.0; 4]));
        let at = |angle_deg: f64| Point2::new(318.0 + 353.5 * angle_deg.to_radians(), 239.2);
        let ray = camera.ray(&at(85.0)).unwrap();
        let axis = camera.camera_from_world.inverse() * Vector3::z();
        assert!((ray.angle(&axis).to_degrees() - 85.0).abs() < 1e-9);
        assert!(camera.ray(&at(90.5)).is_none() && camera.normalise(&at(110.0)).is_none());
    }
}

use super::*;
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

/// Three cameras at about 1.5 m height that look along +y, somewhere near an L or near a line.
pub(crate) fn random_rig(random: &mut ChaCha8Rng, in_line: bool) -> Rig {
    let mut around = |size: f64| (random.random::<f64>() - 0.5) * 2.0 * size;
    let looking = Matrix3::from_rows(&[Vector3::x().transpose(), -Vector3::z().transpose(), Vector3::y().transpose()]);
    let mut places = vec![Vector3::new(around(0.1), around(0.1), 1.5)];
    let first = places[0];
    let side = if around(1.0) > 0.0 { 0.2 } else { -0.2 };
    places.push(first + Vector3::new(side + around(0.05), around(0.03), around(0.05)));
    if in_line {
        let b = places[1] - first;
        places.push(first + b * (1.6 + around(0.4)) + Vector3::new(0.0, 0.0, around(0.01)));
    } else {
        places.push(first + Vector3::new(around(0.08), around(0.03), side.signum() * (0.2 + around(0.05))));
    }
    let camera = |(k, centre): (usize, Vector3<f64>), around: &mut dyn FnMut(f64) -> f64| {
        let turn = Rotation3::new(Vector3::new(around(0.08), around(0.08), around(0.08)));
        let camera_from_world = turn * Rotation3::from_matrix_unchecked(looking);
        Camera {
            name: format!("cam_{k:02}"),
            size_px: [640, 480],
            matrix: Matrix3::new(
                550.0 + around(30.0),
                0.0,
                320.0 + around(10.0),
                0.0,
                550.0 + around(30.0),
                240.0 + around(10.0),
                0.0,
                0.0,
                1.0,
            ),
            lens: crate::rig::Lens::BrownConrady([around(0.1), around(0.02), around(1e-3), around(1e-3), 0.0, 0.0, 0.0, 0.0]),
            camera_from_world,
            translation: -(camera_from_world * centre),
        }
    };
    let cameras = places.into_iter().enumerate().map(|place| camera(place, &mut around)).collect();
    Rig { cameras, up: super::super::Up::Z }
}

fn random_point(random: &mut ChaCha8Rng) -> Vector3<f64> {
    let mut around = |size: f64| (random.random::<f64>() - 0.5) * 2.0 * size;
    Vector3::new(around(0.8), 3.5 + around(1.5), 1.5 + around(0.8))
}

/// The relation (2) through the raw cameras: raw projection, back through the view's lens model, equal disparities.
fn check(rectification: &Rectification, rig: &Rig, random: &mut ChaCha8Rng) {
    for _ in 0..50 {
        let x = random_point(random);
        let pixels: Vec<Vector2<f64>> = rectification
            .views
            .iter()
            .enumerate()
            .map(|(k, view)| rectification.rectified_pixel(k, &rig.cameras[view.index].project(&x).unwrap()).unwrap())
            .collect();
        let step = rectification.views[1].step;
        let d = (pixels[1] - pixels[0]).dot(&step) / step.norm_squared();
        assert!(d > 1.0);
        for (pixel, view) in pixels.iter().zip(&rectification.views) {
            assert!((pixel - (pixels[0] + view.step * d)).norm() < 1e-9, "{pixel} {} {d}", view.step);
        }
        assert!((rectification.world_from_pixel(pixels[0].x, pixels[0].y, d) - x).norm() < 1e-9);
    }
}

#[test]
fn random_triangles_become_an_ideal_l() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for _ in 0..6 {
        let rig = random_rig(&mut random, false);
        let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
        let steps: Vec<_> = rectification.views.iter().map(|v| v.step.map(f64::abs)).collect();
        assert!((steps[1] - Vector2::x()).norm() < 1e-12 && (steps[2] - Vector2::y()).norm() < 1e-12, "{steps:?}");
        assert!((rectification.pixel_from_plane.determinant() - 1.0).abs() < 1e-12);
        check(&rectification, &rig, &mut random);
    }
}

#[test]
fn fisheye_cameras_become_an_ideal_l_too() {
    let mut random = ChaCha8Rng::seed_from_u64(8);
    let mut rig = random_rig(&mut random, false);
    for camera in &mut rig.cameras {
        // 180 degrees across the width: the rim has no place on a plane.
        camera.matrix[(0, 0)] *= 0.37;
        camera.matrix[(1, 1)] *= 0.37;
        camera.lens = crate::rig::Lens::Fisheye([-0.02, 0.004, -0.003, 0.0005]);
    }
    let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
    check(&rectification, &rig, &mut random);
    let [width, height] = rectification.size_px;
    let widest = (2.0 * 1.7321 * rectification.focal_px) as u32 + 3;
    assert!((640..=widest).contains(&width) && (480..=widest).contains(&height), "{width} x {height}");
    for view in 0..3 {
        let camera = &rectification.views[view].camera;
        let value = |x: f64, y: f64| 128.0 + 60.0 * (x / 17.0).sin() + 50.0 * (y / 23.0).cos();
        let raw = GrayImage::from_fn(640, 480, |x, y| Luma([value(f64::from(x), f64::from(y)).round() as u8]));
        let warped = rectification.warp(view, &raw);
        let mut known = 0;
        for (u, v, p) in warped.enumerate_pixels().filter(|(_, _, p)| !p.0[0].is_nan()) {
            let at = Vector2::new(f64::from(u), f64::from(v));
            // Through the ray and the world point, not through the map.
            let x = rectification.world_from_pixel(at.x, at.y, rectification.disparity(3.0));
            let from_reference = rectification.views[view].step * rectification.disparity(3.0);
            let pixel = rectification.project(view, &x).unwrap() - from_reference;
            assert!((pixel - at).norm() < 1e-9);
            let raw_at = camera.project(&(x + camera.centre() - rectification.views[0].camera.centre())).unwrap();
            if raw_at.x > 2.0 && raw_at.y > 2.0 && raw_at.x < 637.0 && raw_at.y < 477.0 {
                assert!((f64::from(p.0[0]) - value(raw_at.x, raw_at.y)).abs() < 1.2);
                known += 1;
            }
        }
        assert!(known > 200_000, "view {view} shows {known} pixels");
    }
}

#[test]
fn cameras_near_a_line_keep_their_own_steps() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for _ in 0..6 {
        let mut rig = random_rig(&mut random, true);
        // Onto the plane that the rectification takes: the group is exact there.
        let rectification = match rectify(&rig, &[0, 1, 2]) {
            Err(RectifyError::OffPlane(..)) => continue,
            other => other.unwrap(),
        };
        let n = rectification.plane_from_world.inverse() * Vector3::z();
        let reference = rig.cameras[rectification.views[0].index].centre();
        for camera in &mut rig.cameras {
            let off = n * (camera.centre() - reference).dot(&n);
            assert!(off.norm() <= PLANE_TOLERANCE_M);
            camera.translation += camera.camera_from_world * off;
        }
        let exact = rectify(&rig, &[0, 1, 2]).unwrap();
        assert!((exact.views[1].step.norm() - 1.0).abs() < 1e-12);
        assert!(exact.views[2].step.norm() < 1.0 + 1e-12);
        check(&exact, &rig, &mut random);
    }
}

#[test]
fn pairs_work_and_jacobians_meet_central_differences() {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..6 {
        let rig = random_rig(&mut random, false);
        for cameras in [&[0, 1][..], &[2, 0], &[1, 2, 0]] {
            let r = rectify(&rig, cameras).unwrap();
            check(&r, &rig, &mut random);
            let at = Vector3::new(300.0, 250.0, r.disparity(2.5));
            let jacobian = r.world_jacobian(at.x, at.y, at.z);
            for k in 0..3 {
                let (a, b) = (at + Vector3::ith(k, 1e-3), at - Vector3::ith(k, 1e-3));
                let numeric = (r.world_from_pixel(a.x, a.y, a.z) - r.world_from_pixel(b.x, b.y, b.z)) / 2e-3;
                assert!((numeric - jacobian.column(k)).norm() < 1e-6 * numeric.norm());
            }
        }
    }
}

#[test]
fn a_pair_has_the_epipolar_geometry_and_depth_of_opencv() {
    use opencv::{calib3d, core, prelude::*};
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let mat = |m: &[f64], rows: i32| core::Mat::new_rows_cols_with_data(rows, m.len() as i32 / rows, m).unwrap().try_clone().unwrap();
    for _ in 0..10 {
        let rig = random_rig(&mut random, false);
        let [a, b] = [&rig.cameras[0], &rig.cameras[1]];
        let r = b.camera_from_world * a.camera_from_world.inverse();
        let t = b.translation - r * a.translation;
        let rows = |m: &Matrix3<f64>| mat(m.transpose().as_slice(), 3);
        let (mut r1, mut r2, mut p1, mut p2, mut q): (core::Mat, core::Mat, core::Mat, core::Mat, core::Mat) = Default::default();
        calib3d::stereo_rectify(
            &rows(&a.matrix),
            &mat(a.lens.terms(), 1),
            &rows(&b.matrix),
            &mat(b.lens.terms(), 1),
            core::Size::new(640, 480),
            &rows(r.matrix()),
            &mat(t.as_slice(), 3),
            &mut r1,
            &mut r2,
            &mut p1,
            &mut p2,
            &mut q,
            calib3d::CALIB_ZERO_DISPARITY,
            -1.0,
            core::Size::default(),
            None,
            None,
        )
        .unwrap();
        let pixel = |camera: &Camera, r: &core::Mat, p: &core::Mat, x: &Vector3<f64>| {
            let raw = camera.project(x).unwrap();
            let source = core::Mat::from_slice(&[core::Point2d::new(raw.x, raw.y)]).unwrap().try_clone().unwrap();
            let mut out = core::Mat::default();
            let criteria = core::TermCriteria::new(3, 100, 1e-14).unwrap();
            calib3d::undistort_points_iter(&source, &mut out, &rows(&camera.matrix), &mat(camera.lens.terms(), 1), r, p, criteria).unwrap();
            let p = *out.at::<core::Point2d>(0).unwrap();
            Vector2::new(p.x, p.y)
        };
        let ours = rectify(&rig, &[0, 1]).unwrap();
        let p2 = |i, j| *p2.at_2d::<f64>(i, j).unwrap();
        // OpenCV splits the rotation between the views, so axes and depths are those of its own plane: compare in the world.
        let x = random_point(&mut random);
        let (u, v) = (
            pixel(a, &r1, &p1, &x),
            pixel(
                b,
                &r2,
                &core::Mat::from_slice_2d(&[
                    [p2(0, 0), p2(0, 1), p2(0, 2), p2(0, 3)],
                    [p2(1, 0), p2(1, 1), p2(1, 2), p2(1, 3)],
                    [0.0, 0.0, 1.0, 0.0],
                ])
                .unwrap(),
                &x,
            ),
        );
        assert!((u.y - v.y).abs() < 1e-6, "OpenCV's rows differ: {u} {v}");
        let theirs = p2(0, 3).abs() / (u.x - v.x).abs();
        let rectified = Matrix3::from_fn(|i, j| *r1.at_2d::<f64>(i as i32, j as i32).unwrap());
        assert!((theirs - (rectified * a.camera_point(&x)).z).abs() < 1e-6);
        let pixels = [0, 1].map(|k| ours.rectified_pixel(k, &rig.cameras[ours.views[k].index].project(&x).unwrap()).unwrap());
        assert!((pixels[0].y - pixels[1].y).abs() < 1e-9);
        let point = ours.world_from_pixel(pixels[0].x, pixels[0].y, (pixels[1].x - pixels[0].x).abs());
        assert!(((rectified * a.camera_point(&point)).z - theirs).abs() < 1e-6);
        // The same baseline direction in the world: both planes contain the epipolar lines.
        let along = rectified.transpose() * Vector3::x();
        let e1 = a.camera_from_world * (ours.plane_from_world.inverse() * (ours.plane_from_pixel * Vector2::x()).push(0.0));
        assert!(along.cross(&e1).norm() < 1e-6);
    }
}

#[test]
fn warped_pictures_show_points_where_they_belong() {
    let mut random = ChaCha8Rng::seed_from_u64(6);
    let rig = random_rig(&mut random, false);
    let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
    for view in 0..3 {
        // A smooth picture of the direction: bicubic reading must agree with the formula.
        let value = |x: f64, y: f64| 128.0 + 60.0 * (x / 17.0).sin() + 50.0 * (y / 23.0).cos();
        let raw = GrayImage::from_fn(640, 480, |x, y| Luma([value(f64::from(x), f64::from(y)).round() as u8]));
        let warped = rectification.warp(view, &raw);
        let mut known = 0;
        for (u, v, p) in warped.enumerate_pixels().filter(|(_, _, p)| !p.0[0].is_nan()) {
            let at = rectification.raw_pixel(view, &Vector2::new(f64::from(u), f64::from(v))).unwrap();
            if at.x > 2.0 && at.y > 2.0 && at.x < 637.0 && at.y < 477.0 {
                assert!((f64::from(p.0[0]) - value(at.x, at.y)).abs() < 1.2);
                known += 1;
            }
        }
        assert!(known > 200_000, "view {view} shows {known} pixels");
        let white = GrayImage::from_pixel(rectification.size_px[0], rectification.size_px[1], Luma([255]));
        let back = rectification.unwarp(view, &white, [0, 0]);
        assert!(back.iter().filter(|&&v| v == 255).count() > 300_000);
    }
}

#[test]
fn the_way_back_is_the_lenss_inverse() {
    let mut rig = random_rig(&mut ChaCha8Rng::seed_from_u64(9), false);
    rig.cameras[0].lens = crate::rig::Lens::BrownConrady([-0.25, 0.08, 1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0]);
    rig.cameras[1].lens = crate::rig::Lens::BrownConrady([0.2, -0.05, -1e-3, 1e-3, 0.01, 0.0, 0.0, 0.0]);
    rig.cameras[2].lens = crate::rig::Lens::Fisheye([-0.02, 0.004, -0.003, 0.0005]);
    let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
    for (k, view) in rectification.views.iter().enumerate() {
        let off = |(i, found): (usize, &[f32; 2])| {
            let exact = rectification.rectified_pixel(k, &Point2::new((i % 640) as f64, (i / 640) as f64)).unwrap();
            (Vector2::new(found[0].into(), found[1].into()) - exact).norm()
        };
        let most = view.back_map.iter().enumerate().map(off).fold(0.0, f64::max);
        assert!(most < if view.camera.lens.is_fisheye() { 1e-4 } else { 0.01 }, "{}: {most} px", view.camera.name);
    }
}

#[test]
fn impossible_groups_are_refused_and_groups_cover_every_camera() {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let mut rig = random_rig(&mut random, false);
    assert!(matches!(rectify(&rig, &[0]), Err(RectifyError::Count(1))));
    assert!(matches!(rectify(&rig, &[0, 0]), Err(RectifyError::Count(2))));
    assert!(matches!(rectify(&rig, &[0, 9]), Err(RectifyError::Count(2))));
    let mut twin = rig.cameras[0].clone();
    twin.name = "twin".into();
    rig.cameras.push(twin);
    assert!(matches!(rectify(&rig, &[0, 3]), Err(RectifyError::Baseline(..))));
    // Move the fourth beside the first: four cameras make two groups that cover all.
    rig.cameras[3].translation += Vector3::new(0.0, 0.25, 0.0);
    let found = groups(&rig).unwrap();
    assert_eq!(found.len(), 2);
    let covered: std::collections::BTreeSet<usize> = found.iter().flat_map(|g| g.views.iter().map(|v| v.index)).collect();
    assert_eq!(covered.len(), 4);
    let turned = Rotation3::new(Vector3::new(0.0, 2.0, 0.0)) * rig.cameras[1].camera_from_world;
    rig.cameras[1].camera_from_world = turned;
    assert!(matches!(rectify(&rig, &[0, 1]), Err(RectifyError::Directions(..))));
}

#[test]
fn pictures_without_their_lens_are_opencvs() {
    use opencv::{calib3d, core, prelude::*};
    let mut camera = random_rig(&mut ChaCha8Rng::seed_from_u64(3), false).cameras.swap_remove(0);
    let terms = [-0.28, 0.09, 1e-3, -2e-3, 0.0];
    camera.lens = crate::rig::Lens::brown_conrady(&terms).unwrap();
    let shade = |x: u32, y: u32| 128.0 + 60.0 * (f64::from(x) / 9.0).sin() + 50.0 * (f64::from(y) / 7.0).cos();
    let picture = GrayImage::from_fn(640, 480, |x, y| Luma([shade(x, y).round() as u8]));
    let ours = without_lens(&camera, &picture);
    let mat = |m: &[f64], rows: i32| core::Mat::new_rows_cols_with_data(rows, m.len() as i32 / rows, m).unwrap().try_clone().unwrap();
    let raw = core::Mat::new_rows_cols_with_data(480, 640, picture.as_raw()).unwrap();
    let mut theirs = core::Mat::default();
    let matrix = mat(camera.matrix.transpose().as_slice(), 3);
    calib3d::undistort(&raw, &mut theirs, &matrix, &mat(&terms, 1), &matrix).unwrap();
    // OpenCV's places are rounded to 1/32 px; at the very border it mixes black in.
    let inside =
        ours.enumerate_pixels().zip(theirs.data_bytes().unwrap()).filter(|((x, y, _), _)| (8..632).contains(x) && (8..472).contains(y));
    let differences: Vec<u8> = inside.map(|((_, _, ours), theirs)| ours.0[0].abs_diff(*theirs)).collect();
    assert!(differences.iter().all(|d| *d <= 2), "{:?}", differences.iter().max());
    let moved = ours.iter().zip(picture.iter()).filter(|(a, b)| a.abs_diff(**b) > 10).count();
    assert!(moved > 640 * 480 / 3, "{moved}");
}

use super::bundle::*;
use super::*;
use crate::math::arrow::ArrowProblem;
use crate::rig::Lens;
use nalgebra::{DVector, Matrix3, Rotation3, UnitQuaternion, Vector2, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, Point2f, Point3f, Size, TermCriteria, Vector as CvVector};
use opencv::prelude::MatTraitConst;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SIZE: [u32; 2] = [640, 480];

fn normal(rng: &mut impl Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random::<f64>().max(1e-300), rng.random());
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

fn true_cameras(lens: Lens) -> Vec<Camera> {
    let camera = |name: &str, f: f64, turn: [f64; 3], centre: [f64; 3]| {
        let rotation = Rotation3::from_scaled_axis(Vector3::from(turn));
        Camera {
            name: name.into(),
            size_px: SIZE,
            matrix: Matrix3::new(f, 0.0, 322.0, 0.0, 1.01 * f, 236.0, 0.0, 0.0, 1.0),
            lens,
            camera_from_world: rotation,
            translation: -(rotation * Vector3::from(centre)),
        }
    };
    vec![
        camera("a", 550.0, [0.0; 3], [0.0; 3]),
        camera("b", 560.0, [0.02, -0.12, 0.01], [0.3, 0.01, -0.02]),
        camera("c", 540.0, [-0.1, 0.01, -0.02], [0.01, -0.3, 0.03]),
    ]
}

/// Boards before the cameras, at many angles; `rig_from_board`.
fn true_boards(count: usize, rng: &mut impl Rng) -> Vec<Isometry3<f64>> {
    let mut around = |size: f64| (rng.random::<f64>() * 2.0 - 1.0) * size;
    (0..count)
        .map(|_| {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::new(around(0.6), around(0.6), around(0.4)));
            let centre = Vector3::new(0.1 + around(0.25), around(0.2), 1.3 + around(0.35));
            Isometry3::from_parts((centre - turn * Vector3::new(0.16, 0.1, 0.0)).into(), turn)
        })
        .collect()
}

/// What the cameras see, with noise; boards that stick out are seen in part, and those with few corners not at all.
fn seen(cameras: &[Camera], boards: &[Isometry3<f64>], target: &Target, sigma_px: f64, rng: &mut impl Rng) -> Vec<Detection> {
    let mut detections = Vec::new();
    for (view, board) in boards.iter().enumerate() {
        for (camera, c) in cameras.iter().enumerate() {
            let corners: Vec<_> = (0..target.points.len())
                .filter_map(|id| Some((id, pixel(c, board, &target.point(id))?)))
                .filter(|(_, p)| (0.0..f64::from(SIZE[0] - 1)).contains(&p.x) && (0.0..f64::from(SIZE[1] - 1)).contains(&p.y))
                .map(|(id, p)| (id, p + Vector2::new(normal(rng), normal(rng)) * sigma_px))
                .collect();
            if corners.len() >= FEWEST_CORNERS {
                detections.push(Detection { camera, view, corners });
            }
        }
    }
    detections
}

fn named(cameras: &[Camera]) -> Vec<Uncalibrated> {
    cameras.iter().map(|c| Uncalibrated { name: c.name.clone(), size_px: c.size_px, known: None }).collect()
}

fn brown() -> Lens {
    Lens::BrownConrady([-0.12, 0.05, 6e-4, -4e-4, 0.0, 0.0, 0.0, 0.0])
}

const PLAIN: CalibrateOptions = CalibrateOptions { lens: LensKind::Brown, k3: false, fix_aspect: false };

#[test]
fn jacobians_meet_central_differences() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let target = Target::chessboard(4, 3, 0.05);
    for lens in [Lens::BrownConrady([-0.2, 0.08, 1e-3, -2e-3, 0.03, 0.0, 0.0, 0.0]), Lens::Fisheye([0.02, -0.01, 0.004, -0.001])] {
        let solution = Solution { cameras: true_cameras(lens), boards: true_boards(4, &mut rng) };
        let terms: &[usize] = if lens.is_fisheye() { &[0, 1, 2, 3] } else { &[0, 1, 2, 3, 4] };
        for one_focal in [false, true] {
            let detections = seen(&solution.cameras, &solution.boards, &target, 2.0, &mut rng);
            let views = (0..4)
                .map(|v| {
                    let own = detections.iter().filter(|d| d.view == v);
                    own.map(|d| Sighting { camera: d.camera, corners: d.corners.clone() }).collect()
                })
                .collect();
            // 1 px of Huber's loss: some residuals on each side.
            let bundle = Bundle { target: &target, views, layout: Layout::new(Some(terms), one_focal), huber_px: 1.0 };
            let equations = (&bundle).linearise(&solution);
            let (locals, shareds) = (equations.local.size(), equations.shared.nrows());
            assert_eq!((locals, shareds), (24, 3 * bundle.layout.count + 12));
            let columns: Vec<DVector<f64>> = (0..locals + shareds).map(|k| numeric_column(&bundle, &solution, k)).collect();
            let weighted = residuals(&bundle, &solution);
            for (k, column) in columns.iter().enumerate() {
                let analytic = if k < locals { equations.local_gradient[k] } else { equations.shared_gradient[k - locals] };
                let numeric = column.dot(&weighted.component_mul(&huber_weights(&weighted, 1.0)));
                assert!((numeric - analytic).abs() < 1e-6 * column.norm() * weighted.norm(), "gradient {k}: {numeric} {analytic}");
                for (j, other) in columns.iter().enumerate().take(k + 1) {
                    let analytic = match (k < locals, j < locals) {
                        (true, _) => equations.local.get(k, j),
                        (false, true) => equations.border[(j, k - locals)],
                        (false, false) => equations.shared[(k - locals, j - locals)],
                    };
                    let numeric = column.dot(&other.component_mul(&huber_weights(&weighted, 1.0)));
                    assert!((numeric - analytic).abs() < 1e-6 * column.norm() * other.norm(), "{k} {j}: {numeric} {analytic}");
                }
            }
        }
    }
}

/// All residuals one below the other.
fn residuals(bundle: &Bundle, solution: &Solution) -> DVector<f64> {
    let sightings = bundle.views.iter().enumerate().flat_map(|(v, seen)| seen.iter().map(move |s| (v, s)));
    let all: Vec<f64> = sightings.flat_map(|(v, s)| bundle.residuals(solution, v, s)).flat_map(|r| r.unwrap().data.0[0]).collect();
    DVector::from_vec(all)
}

/// Weights of corners, once for each coordinate.
fn huber_weights(residuals: &DVector<f64>, huber_px: f64) -> DVector<f64> {
    DVector::from_fn(residuals.len(), |i, _| (huber_px / residuals.rows(i / 2 * 2, 2).norm()).min(1.0))
}

fn numeric_column(bundle: &Bundle, solution: &Solution, k: usize) -> DVector<f64> {
    let (locals, last) = (6 * bundle.views.len(), solution.cameras.len() - 1);
    let shareds = bundle.layout.offset(last) + bundle.layout.width(last);
    let moved = |h: f64| {
        let (mut y, mut z) = (DVector::zeros(locals), DVector::zeros(shareds));
        if k < locals {
            y[k] = h
        } else {
            z[k - locals] = h
        }
        residuals(bundle, &bundle.retract(solution, &y, &z))
    };
    // Pixels are linear in the intrinsics.
    let of_pose = k < locals || (1..=last).any(|c| (0..6).any(|i| k - locals == bundle.layout.offset(c) + bundle.layout.count + i));
    let h = if of_pose { 1e-5 } else { 1e-2 };
    (moved(h) - moved(-h)) / (2.0 * h)
}

#[test]
fn exact_corners_give_the_cameras_back() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let target = Target::chessboard(9, 6, 0.04);
    for (lens, kind, k3) in [
        (brown(), LensKind::Brown, false),
        (Lens::BrownConrady([-0.3, 0.12, 1e-3, -1e-3, 0.05, 0.0, 0.0, 0.0]), LensKind::Brown, true),
        (Lens::Fisheye([-0.02, 0.01, 0.0, 0.0]), LensKind::Fisheye, false),
        (Lens::Fisheye([0.05, -0.02, 0.01, -0.003]), LensKind::Fisheye, true),
    ] {
        let cameras = true_cameras(lens);
        let boards = true_boards(14, &mut rng);
        let detections = seen(&cameras, &boards, &target, 0.0, &mut rng);
        let options = CalibrateOptions { lens: kind, k3, fix_aspect: false };
        let found = calibrate(&named(&cameras), &target, &detections, &options).unwrap();
        assert!(found.rejected.is_empty() && found.rms_px < 1e-6, "{lens:?}: {} px", found.rms_px);
        for (a, b) in found.rig.cameras.iter().zip(&cameras) {
            assert!((a.matrix - b.matrix).amax() < 1e-3, "{lens:?}: {}", a.matrix - b.matrix);
            let turned = (a.camera_from_world.matrix() - b.camera_from_world.matrix()).norm();
            assert!((a.centre() - b.centre()).norm() < 1e-6 && turned < 1e-6, "{lens:?}: {} {turned}", a.centre() - b.centre());
        }
        let board = found.boards[&5];
        assert!((board.translation.vector - boards[5].translation.vector).norm() < 1e-5);
    }
}

/// Detections of one camera as OpenCV takes them.
fn for_opencv(detections: &[Detection], target: &Target, camera: usize) -> (CvVector<CvVector<Point3f>>, CvVector<CvVector<Point2f>>) {
    let own = || detections.iter().filter(move |d| d.camera == camera);
    let object =
        |d: &Detection| d.corners.iter().map(|(id, _)| target.point(*id)).map(|p| Point3f::new(p.x as f32, p.y as f32, 0.0)).collect();
    let image = |d: &Detection| d.corners.iter().map(|(_, p)| Point2f::new(p.x as f32, p.y as f32)).collect();
    (own().map(object).collect(), own().map(image).collect())
}

#[test]
fn one_camera_alone_is_calibrated_as_by_opencv() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let target = Target::chessboard(9, 6, 0.04);
    let cameras = &true_cameras(brown())[..1];
    let mut detections = seen(cameras, &true_boards(12, &mut rng), &target, 0.3, &mut rng);
    // OpenCV takes single precision.
    detections.iter_mut().flat_map(|d| &mut d.corners).for_each(|(_, p)| *p = p.map(|v| f64::from(v as f32)));
    let ours = calibrate(&named(cameras), &target, &detections, &PLAIN).unwrap();
    assert_eq!(ours.quality[0].corners_rejected, 0);
    let (objects, images) = for_opencv(&detections, &target, 0);
    let (mut matrix, mut lens) = (Mat::default(), Mat::default());
    let (mut turns, mut places) = (CvVector::<Mat>::new(), CvVector::<Mat>::new());
    let criteria = TermCriteria::new(3, 200, 1e-12).unwrap();
    let size = Size::new(640, 480);
    let flags = calib3d::CALIB_FIX_K3;
    let rms = calib3d::calibrate_camera(&objects, &images, size, &mut matrix, &mut lens, &mut turns, &mut places, flags, criteria).unwrap();
    assert!((ours.rms_px - rms).abs() < 1e-6 * rms, "{} px, OpenCV {rms} px", ours.rms_px);
    let camera = &ours.rig.cameras[0];
    for (r, c) in [(0, 0), (1, 1), (0, 2), (1, 2)] {
        let expected = *matrix.at_2d::<f64>(r as i32, c as i32).unwrap();
        assert!((camera.matrix[(r, c)] - expected).abs() < 1e-3, "{} {expected}", camera.matrix[(r, c)]);
    }
    for (k, term) in camera.lens.terms()[..4].iter().enumerate() {
        assert!((term - lens.at::<f64>(k as i32).unwrap()).abs() < 1e-5, "{k}: {term}");
    }
}

#[test]
fn the_stated_uncertainty_is_the_spread_over_noise() {
    let target = Target::chessboard(9, 6, 0.04);
    let cameras = true_cameras(brown());
    let boards = true_boards(10, &mut ChaCha8Rng::seed_from_u64(11));
    let runs = 60;
    let mut squares = Vec::new();
    let (mut baseline_square, mut sigma_sum) = (0.0, 0.0);
    for seed in 0..runs {
        let mut rng = ChaCha8Rng::seed_from_u64(100 + seed);
        let found = calibrate(&named(&cameras), &target, &seen(&cameras, &boards, &target, 0.2, &mut rng), &PLAIN).unwrap();
        let truth = |p: &Parameter| {
            let (c, f) = (&cameras[p.camera], &found.rig.cameras[p.camera]);
            let turn = (f.camera_from_world.inverse() * c.camera_from_world).scaled_axis();
            match p.name {
                "fx_px" => c.matrix[(0, 0)],
                "fy_px" => c.matrix[(1, 1)],
                "cx_px" => c.matrix[(0, 2)],
                "cy_px" => c.matrix[(1, 2)],
                "k1" | "k2" | "p1" | "p2" => c.lens.terms()[["k1", "k2", "p1", "p2"].iter().position(|n| *n == p.name).unwrap()],
                "turn_x" => turn.x,
                "turn_y" => turn.y,
                "turn_z" => turn.z,
                "shift_x_m" => c.translation.x,
                "shift_y_m" => c.translation.y,
                _ => c.translation.z,
            }
        };
        let errors: Vec<f64> = found.parameters.iter().map(|p| ((p.value - truth(p)) / p.sigma).powi(2)).collect();
        squares.resize(errors.len(), 0.0);
        squares.iter_mut().zip(errors).for_each(|(sum, e)| *sum += e);
        let (_, _, baseline_m, sigma_m) = found.baselines_m()[2];
        baseline_square += ((baseline_m - (cameras[1].centre() - cameras[2].centre()).norm()) / sigma_m).powi(2);
        sigma_sum += found.sigma_px;
    }
    let spreads: Vec<f64> = squares.iter().map(|s: &f64| (s / runs as f64).sqrt()).collect();
    assert_eq!(spreads.len(), 3 * 8 + 12);
    let pooled = (squares.iter().sum::<f64>() / (runs as usize * squares.len()) as f64).sqrt();
    // Of one parameter over 60 runs the spread itself scatters by 9 %.
    assert!((0.9..1.1).contains(&pooled) && spreads.iter().all(|s| (0.75..1.3).contains(s)), "{pooled} {spreads:?}");
    assert!((0.75..1.3).contains(&(baseline_square / runs as f64).sqrt()));
    assert!((sigma_sum / runs as f64 / 0.2 - 1.0).abs() < 0.02);
}

#[test]
fn wrong_detections_are_named_and_the_rest_is_kept() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let target = Target::chessboard(9, 6, 0.04);
    let cameras = true_cameras(brown());
    let clean = seen(&cameras, &true_boards(15, &mut rng), &target, 0.1, &mut rng);
    let mut detections = clean.clone();
    let at = |camera: usize, view: usize| clean.iter().position(|d| (d.camera, d.view) == (camera, view)).unwrap();
    // Upside down, shifted by a column, another view's, and one corner 3 px off.
    let (flipped, shifted, stale, touched) = (at(1, 3), at(2, 4), at(0, 8), at(1, 10));
    detections[flipped].corners.iter_mut().for_each(|(id, _)| *id = 53 - *id);
    detections[shifted].corners.retain(|(id, _)| id % 9 < 8);
    detections[shifted].corners.iter_mut().for_each(|(id, _)| *id += 1);
    detections[stale].corners = clean[at(0, 2)].corners.clone();
    detections[touched].corners[20].1.x += 3.0;
    let found = calibrate(&named(&cameras), &target, &detections, &PLAIN).unwrap();
    let named_wrong: Vec<_> = found.rejected.iter().map(|r| (r.camera, r.view)).collect();
    assert_eq!(named_wrong, [(1, 3), (2, 4), (0, 8)]);
    assert_eq!(found.quality.iter().map(|q| q.corners_rejected).collect::<Vec<_>>(), [0, 1, 0]);
    let reference = calibrate(&named(&cameras), &target, &clean, &PLAIN).unwrap();
    for (a, b) in found.parameters.iter().zip(&reference.parameters) {
        assert!((a.value - b.value).abs() < 2.0 * b.sigma, "{}: {} {}", a.name, a.value, b.value);
    }
}

#[test]
fn boards_that_hide_their_turn_are_turned_alike() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let cameras = true_cameras(brown());
    for (columns, rows) in [(8, 6), (6, 6)] {
        let target = Target::chessboard(columns, rows, 0.045);
        let boards = true_boards(12, &mut rng);
        let clean = seen(&cameras, &boards, &target, 0.1, &mut rng);
        let mut detections = clean.clone();
        for d in &mut detections {
            let turn = &target.turns[rng.random_range(0..target.turns.len())];
            d.corners.iter_mut().for_each(|(id, _)| *id = turn.relabelled[*id]);
        }
        let found = calibrate(&named(&cameras), &target, &detections, &PLAIN).unwrap();
        assert!(found.rejected.is_empty(), "{columns}x{rows}: {:?}", found.rejected);
        for (a, b) in found.rig.cameras.iter().zip(&cameras) {
            assert!((a.centre() - b.centre()).norm() < 2e-3, "{columns}x{rows}");
        }
        // A board that stands still says nothing about its turn.
        let still = seen(&cameras, &vec![boards[0]; 6], &target, 0.1, &mut rng);
        let error = start::place_cameras(&mut cameras.clone(), &target, &still.iter().collect::<Vec<_>>()).unwrap_err();
        assert!(matches!(error, CalibrateError::Unlinked { .. }), "{error}");
    }
}

#[test]
fn views_that_cannot_calibrate_are_refused_with_the_remedy() {
    let mut rng = ChaCha8Rng::seed_from_u64(13);
    let target = Target::chessboard(9, 6, 0.04);
    let cameras = true_cameras(brown());
    let names = named(&cameras);
    let boards = true_boards(12, &mut rng);
    // All parallel to one plane: the board slides over a tilted table.
    let table = UnitQuaternion::from_scaled_axis(Vector3::new(0.5, 0.2, 0.0));
    let sliding: Vec<_> = boards
        .iter()
        .map(|b| Isometry3::from_parts(b.translation, table * UnitQuaternion::from_scaled_axis(Vector3::z() * 0.3 * b.translation.z)))
        .collect();
    for parallel in [&sliding, &vec![boards[0]; 12]] {
        let error = calibrate(&names, &target, &seen(&cameras, parallel, &target, 0.2, &mut rng), &PLAIN).unwrap_err();
        assert!(matches!(error, CalibrateError::Unobserved { .. } | CalibrateError::Singular { .. }), "{error}");
        assert!(error.to_string().contains("tilted by 20 to 45 degrees"));
    }
    let all = seen(&cameras, &boards, &target, 0.2, &mut rng);
    // Camera c sees boards at other times only.
    let apart: Vec<_> = all.iter().filter(|d| (d.camera == 2) == (d.view >= 6)).cloned().collect();
    let error = calibrate(&names, &target, &apart, &PLAIN).unwrap_err();
    assert_eq!(error.to_string().split(':').next(), Some("c"), "{error}");
    let rarely: Vec<_> = all.iter().filter(|d| d.camera != 1 || d.view < 2).cloned().collect();
    assert_eq!(calibrate(&names, &target, &rarely, &PLAIN).unwrap_err(), CalibrateError::TooFewViews { camera: "b".into(), views: 2 });
    assert_eq!(calibrate(&[], &target, &[], &PLAIN).unwrap_err(), CalibrateError::NoCameras);
}

#[test]
fn chains_of_cameras_hold_together_and_the_floor_is_the_world() {
    let mut rng = ChaCha8Rng::seed_from_u64(17);
    let target = Target::chessboard(9, 6, 0.04);
    let cameras = true_cameras(brown());
    let mut boards = true_boards(18, &mut rng);
    // The last board lies on the floor, z into it.
    boards[17] = Isometry3::new(Vector3::new(-0.1, 0.05, 1.4), Vector3::new(0.8, 0.1, 0.0));
    // a and c never see a board together.
    let chained: Vec<_> = seen(&cameras, &boards, &target, 0.05, &mut rng)
        .into_iter()
        .filter(|d| d.camera == 1 || d.view % 2 == usize::from(d.camera == 2))
        .collect();
    let found = calibrate(&named(&cameras), &target, &chained, &PLAIN).unwrap();
    assert!((found.rig.cameras[2].centre() - cameras[2].centre()).norm() < 2e-3);
    let world = found.on_board(17).unwrap();
    assert!(found.on_board(40).is_none());
    for (placed, truth) in world.cameras.iter().zip(&cameras) {
        let on_board = boards[17].inverse_transform_point(&truth.centre().into());
        let expected = Vector3::new(on_board.x, -on_board.y, -on_board.z);
        assert!((placed.centre() - expected).norm() < 5e-3 && placed.centre().z > 0.5, "{} {expected}", placed.centre());
    }
}

#[test]
fn known_intrinsics_are_kept_and_make_few_views_enough() {
    let mut rng = ChaCha8Rng::seed_from_u64(19);
    let target = Target::chessboard(9, 6, 0.04);
    let cameras = true_cameras(brown());
    // Parallel boards, which could not tell focal lengths.
    let board = true_boards(1, &mut rng)[0];
    let boards: Vec<_> = (0..4).map(|k| nalgebra::Translation3::new(0.02 * f64::from(k), 0.0, 0.1) * board).collect();
    let detections = seen(&cameras, &boards, &target, 0.1, &mut rng);
    let mut known = named(&cameras);
    known.iter_mut().zip(&cameras).for_each(|(k, c)| k.known = Some((c.matrix, c.lens)));
    let found = calibrate(&known, &target, &detections, &PLAIN).unwrap();
    for (a, b) in found.rig.cameras.iter().zip(&cameras) {
        assert_eq!((a.matrix, a.lens), (b.matrix, b.lens));
        assert!((a.centre() - b.centre()).norm() < 6e-3);
    }
    assert_eq!(found.parameters.len(), 12);
    let alone = calibrate(&known[..1], &target, &detections.into_iter().filter(|d| d.camera == 0).collect::<Vec<_>>(), &PLAIN).unwrap();
    assert!(alone.parameters.is_empty() && alone.boards.len() == 4);
    assert!((alone.boards[&2].translation.vector - boards[2].translation.vector).norm() < 6e-3);
}

//! Calibration from pictures to the rig file: rendered boards with known truth, real boards beside OpenCV's own calibration
//! and another tool's, bad input.

use assert_cmd::Command;
use image::{GrayImage, Luma};
use muybridge::footage::board::{Board, Detector, find_chessboard_by};
use muybridge::io::calib_toml::read_rig;
use muybridge::io::images::read_grey;
use muybridge::rig::calibrate::{CalibrateOptions, Calibration, Detection, Target, Uncalibrated, calibrate};
use muybridge::rig::{Camera, Lens, Rig};
use nalgebra::{Isometry3, Matrix3, Point2, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, Point2f, Point3f, Size, TermCriteria, Vector};
use opencv::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};

const SIZE: [u32; 2] = [480, 360];
const SQUARE_M: f64 = 0.04;
/// In this view the board lies on the floor.
const FLOOR: usize = 13;

fn data(name: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/calibration").join(name);
    if !folder.exists() {
        println!("skipped: no {}", folder.display());
        return None;
    }
    Some(folder)
}

/// Two cameras side by side and one above, in the frame of a level camera: x right, y down, z forward.
fn true_rig() -> Vec<Camera> {
    let camera = |name: &str, focal_px: f64, turn: [f64; 3], centre: [f64; 3]| {
        let rotation = Rotation3::from_scaled_axis(Vector3::from(turn));
        Camera {
            name: name.into(),
            size_px: SIZE,
            matrix: Matrix3::new(focal_px, 0.0, 241.0, 0.0, 1.004 * focal_px, 177.0, 0.0, 0.0, 1.0),
            lens: Lens::BrownConrady([-0.11, 0.03, 4e-4, -6e-4, 0.0, 0.0, 0.0, 0.0]),
            camera_from_world: rotation,
            translation: -(rotation * Vector3::from(centre)),
        }
    };
    vec![
        camera("left", 420.0, [0.0; 3], [0.0; 3]),
        camera("right", 425.0, [0.01, -0.1, 0.02], [0.3, 0.0, 0.01]),
        camera("top", 415.0, [-0.09, 0.02, -0.01], [0.02, -0.3, 0.0]),
    ]
}

/// World from board; the first ones at all angles, the last on the floor.
fn true_boards() -> Vec<Isometry3<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut around = |size: f64| (2.0 * rng.random::<f64>() - 1.0) * size;
    let middle = Vector3::new(4.0, 2.5, 0.0) * SQUARE_M;
    let mut boards: Vec<_> = (0..FLOOR)
        .map(|_| {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::new(around(0.7), around(0.7), around(0.3)));
            let centre = Vector3::new(0.14 + around(0.2), -0.12 + around(0.12), 1.1 + around(0.2));
            Isometry3::from_parts(Translation3::from(centre - turn * middle), turn)
        })
        .collect();
    let lying = UnitQuaternion::from_scaled_axis(Vector3::x() * 1.05);
    boards.push(Isometry3::from_parts(Translation3::from(Vector3::new(0.12, -0.05, 1.2) - lying * middle), lying));
    boards
}

/// Rays of a picture's pixels, 4 by 4 in each.
fn rays(camera: &Camera) -> Vec<Vector3<f64>> {
    let at = |k: u32| (f64::from(k) + 0.5) / 4.0 - 0.5;
    let ray = |x: u32, y: u32| camera.ray(&Point2::new(at(x), at(y))).unwrap();
    (0..4 * SIZE[1]).flat_map(|y| (0..4 * SIZE[0]).map(move |x| (x, y))).map(|(x, y)| ray(x, y)).collect()
}

/// A chessboard before a grey wall, blurred by the pixels, with noise of 1.5 grey levels.
fn picture(camera: &Camera, rays: &[Vector3<f64>], board: &Isometry3<f64>, rng: &mut impl Rng) -> GrayImage {
    let board_from_world = board.inverse();
    let turn = board_from_world.rotation;
    let from = board_from_world.transform_point(&camera.centre().into());
    let grey = |ray: &Vector3<f64>| {
        let direction = turn * ray;
        let distance = -from.z / direction.z;
        let [u, v] = [0, 1].map(|k| (from[k] + distance * direction[k]) / SQUARE_M + 1.0);
        match (distance > 0.0, (0.0..10.0).contains(&u) && (0.0..7.0).contains(&v)) {
            (true, true) if (u.floor() + v.floor()) % 2.0 == 0.0 => 35.0,
            (true, _) if (-0.7..10.7).contains(&u) && (-0.7..7.7).contains(&v) => 215.0,
            _ => 120.0,
        }
    };
    GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| {
        let rows = (0..4).flat_map(|i| rays[((4 * y + i) * 4 * SIZE[0] + 4 * x) as usize..][..4].iter());
        let noise = (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
        Luma([(rows.map(grey).sum::<f64>() / 16.0 + 1.5 * noise).round().clamp(0.0, 255.0) as u8])
    })
}

/// Pictures of all cameras, `left/view_000.png` and so on.
fn film(folder: &Path, boards: &[Isometry3<f64>]) {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for camera in true_rig() {
        let rays = rays(&camera);
        std::fs::create_dir_all(folder.join(&camera.name)).unwrap();
        for (view, board) in boards.iter().enumerate() {
            picture(&camera, &rays, board, &mut rng).save(folder.join(format!("{}/view_{view:03}.png", camera.name))).unwrap();
        }
    }
}

fn run(arguments: &[&str], folder: &Path) -> std::process::Output {
    Command::cargo_bin("muybridge").unwrap().args(arguments).current_dir(folder).output().unwrap()
}

/// The three cameras with the board as it is, and more arguments.
fn run_calibrate(folder: &Path, more: &[&str]) -> std::process::Output {
    run(&[&["calibrate", "left", "right", "top", "--board", "9x6", "--square", "0.04"], more].concat(), folder)
}

/// The board's frame as the world: x along the rows, z out of the board, towards the cameras.
fn world_of(board: &Isometry3<f64>) -> Isometry3<f64> {
    UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI) * board.inverse()
}

/// Relative position in mm and turn in degrees of camera k seen from camera 0, ours less the truth.
fn relative_errors(rig: &[Camera], truth: &[Camera], k: usize) -> (f64, f64) {
    let relative = |rig: &[Camera]| {
        let turn = rig[k].camera_from_world * rig[0].camera_from_world.inverse();
        (turn, rig[0].camera_point(&rig[k].centre()))
    };
    let ((turn, place), (true_turn, true_place)) = (relative(rig), relative(truth));
    let angle = UnitQuaternion::from_rotation_matrix(&turn).angle_to(&UnitQuaternion::from_rotation_matrix(&true_turn));
    (1e3 * (place - true_place).norm(), angle.to_degrees())
}

/// Largest distance over the picture between where two cameras draw the same ray, px.
fn lens_difference_px(a: &Camera, b: &Camera) -> f64 {
    let [width, height] = a.size_px.map(|s| f64::from(s - 1));
    let grid = (0..9).flat_map(|i| (0..7).map(move |k| Point2::new(width * f64::from(i) / 8.0, height * f64::from(k) / 6.0)));
    grid.filter_map(|p| Some((b.distorted_pixel(&a.normalise(&p)?) - p).norm())).fold(0.0, f64::max)
}

#[test]
fn rendered_boards_give_the_rig_back() {
    let folder = tempfile::tempdir().unwrap();
    let (truth, boards) = (true_rig(), true_boards());
    film(folder.path(), &boards);
    let output = run_calibrate(folder.path(), &["--floor-view", "13", "-o", "out/Calib.toml"]);
    let (said, complained) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(output.status.success(), "{complained}");
    assert!(said.contains("chessboard, 9x6 inner corners, squares of 40 mm") && !said.contains("where the floor is"), "{said}");
    let rig = read_rig(&folder.path().join("out/Calib.toml")).unwrap();
    let world = world_of(&boards[FLOOR]);
    for (k, (found, camera)) in rig.cameras.iter().zip(&truth).enumerate() {
        assert_eq!((&found.name, found.size_px), (&camera.name, SIZE));
        let centre = world.transform_point(&camera.centre().into()).coords;
        assert!((found.centre() - centre).norm() < 2e-3 && found.centre().z > 0.3, "{} {centre}", found.centre());
        let (place_mm, turn_deg) = relative_errors(&rig.cameras, &truth, k);
        assert!(place_mm < 0.6 && turn_deg < 0.1, "{}: {place_mm} mm, {turn_deg} deg", camera.name);
        assert!((found.matrix - camera.matrix).amax() < 1.0, "{}", found.matrix);
    }
    let json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(folder.path().join("out/Calib_calibration.json")).unwrap()).unwrap();
    assert!(json["rms_px"].as_f64().unwrap() < 0.06, "{}", json["rms_px"]);
    let (parameters, covariance) = (json["parameters"].as_array().unwrap(), json["covariance"].as_array().unwrap());
    assert_eq!((parameters.len(), covariance.len(), covariance[0].as_array().unwrap().len()), (36, 36, 36));
    let sigma = parameters[0]["sigma"].as_f64().unwrap();
    assert!((sigma - covariance[0][0].as_f64().unwrap().sqrt()).abs() < 1e-12 && sigma > 0.01 && sigma < 0.5);
    let picture = image::open(folder.path().join("out/Calib_calibration.png")).unwrap().into_rgb8();
    let orange = picture.pixels().filter(|p| p[0] > 180 && p[1] < 140 && p[2] < 60).count();
    assert!(orange > 1000, "residuals are drawn: {orange}");
    // OpenCV, from its own corners in the same pictures: no camera of ours is further from the truth.
    let board = Board::chessboard(9, 6, SQUARE_M).unwrap();
    let target = board.target().unwrap();
    for (k, camera) in truth.iter().enumerate() {
        let picture = |view: usize| read_grey(&folder.path().join(format!("{}/view_{view:03}.png", camera.name))).unwrap();
        let found: Vec<Detection> = (0..=FLOOR).filter_map(|view| board.detect(&picture(view), &target, k, view).unwrap()).collect();
        let theirs = opencv_camera(&by_corner_sub_pix(&found, k, picture), &target, SIZE);
        let (ours_px, theirs_px) = (lens_difference_px(camera, &rig.cameras[k]), lens_difference_px(camera, &theirs));
        println!("{}: largest error over the picture {ours_px:.3} px, cv::calibrateCamera {theirs_px:.3} px", camera.name);
        assert!(ours_px < theirs_px.min(1.0), "{}", camera.name);
    }
    other_ways_of_giving_the_same(folder.path());
}

/// One and more threads write the same; globs, and cameras that miss some views, and known intrinsics.
fn other_ways_of_giving_the_same(folder: &Path) {
    let bytes = |name: &str| std::fs::read(folder.join(name)).unwrap();
    assert!(run_calibrate(folder, &["--floor-view", "13", "--threads", "1", "-o", "one/Calib.toml"]).status.success());
    for name in ["Calib.toml", "Calib_calibration.png", "Calib_calibration.json"] {
        assert!(bytes(&format!("out/{name}")) == bytes(&format!("one/{name}")), "{name}");
    }
    std::fs::remove_file(folder.join("top/view_003.png")).unwrap();
    std::fs::remove_file(folder.join("left/view_005.png")).unwrap();
    let globs =
        ["calibrate", "left/view*.png", "right/view*.png", "top/view*.png", "--board", "9x6", "--square", "0.04", "-o", "globs.toml"];
    let output = run(&globs, folder);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("warning: the world is left's frame"), "{said}");
    let rig = read_rig(&folder.join("globs.toml")).unwrap();
    assert_eq!((rig.cameras[0].translation, rig.cameras[0].camera_from_world), (Vector3::zeros(), Rotation3::identity()));
    let (place_mm, turn_deg) = relative_errors(&rig.cameras, &true_rig(), 2);
    assert!(place_mm < 0.6 && turn_deg < 0.1, "{place_mm} mm {turn_deg} deg");
    // Known intrinsics are kept, three views are enough.
    let arguments = ["--every", "2", "--intrinsics", "out/Calib.toml", "-o", "known.toml"];
    let output = run_calibrate(folder, &arguments);
    assert!(output.status.success(), "{}", String::from_utf8(output.stderr).unwrap());
    let (known, before) = (read_rig(&folder.join("known.toml")).unwrap(), read_rig(&folder.join("out/Calib.toml")).unwrap());
    assert!(known.cameras.iter().zip(&before.cameras).all(|(a, b)| a.matrix == b.matrix && a.lens == b.lens));
    let (place_mm, _) = relative_errors(&known.cameras, &true_rig(), 1);
    assert!(place_mm < 1.0, "{place_mm}");
}

#[test]
fn bad_footage_is_refused_in_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let boards = true_boards();
    // All in one plane: the board slides over a table.
    let slide = |k: usize| Translation3::from(boards[0].rotation * Vector3::new(0.03, 0.02, 0.0) * (k as f64 - 2.0)) * boards[0];
    film(folder.path(), &(0..5).map(slide).collect::<Vec<_>>());
    let refused = |more: &[&str], parts: &[&str]| {
        let output = run(&[&["calibrate"], more].concat(), folder.path());
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{more:?}: {message}");
        let errors: Vec<_> = message.lines().skip_while(|line| line.starts_with("views: ")).collect();
        assert!(errors.len() == 1 && parts.iter().all(|part| errors[0].contains(part)), "{parts:?} in {message}");
        assert!(!folder.path().join("Calib.toml").exists() && !folder.path().join("Calib_calibration.json").exists());
    };
    let board = ["--board", "9x6", "--square", "0.04"];
    refused(&[&["left", "right", "top"], &board[..]].concat(), &["the views do not determine its", "tilted by 20 to 45 degrees"]);
    refused(&["left", "right", "--board", "10x7", "--square", "0.04"], &["left: none of 5 pictures shows", "give --board 9x6"]);
    refused(&["left", "right", "--board", "8x6", "--square", "0.04"], &["left: none of 5 pictures shows", "give --board 9x6"]);
    refused(&["left", "right", "--board", "9x6", "--square", "40"], &["squares of 40 m are impossible", "in metres"]);
    refused(&[&["left", "nowhere"], &board[..]].concat(), &["nowhere: is no folder, no video and no glob"]);
    refused(&[&["left/view_000.png", "right"], &board[..]].concat(), &["view_000.png: is a single picture", "glob in quotes"]);
    refused(&[&["left", "left"], &board[..]].concat(), &["left: is given for two cameras"]);
    refused(&["left", "--board", "9x6", "--square", "0.04", "--charuco", "5X5_9", "--marker", "0.02"], &["5X5_9 is no dictionary"]);
    // The cameras see the board at different times.
    film(&folder.path().join("good"), &boards[..6]);
    let good = folder.path().join("good");
    for view in 0..6 {
        let name = |k: usize| good.join(format!("right/view_{k:03}.png"));
        std::fs::rename(name(view), name(view + 20)).unwrap();
    }
    refused(&[&["good/left", "good/right", "good/top"], &board[..]].concat(), &["right: see no board at the same time as left, top"]);
    refused(
        &[&["good/left", "good/top", "--floor-view", "7"], &board[..]].concat(),
        &["--floor-view 7 cannot be the world", "views with a board: 0, 1"],
    );
    std::fs::write(good.join("top/view_002.png"), b"no picture").unwrap();
    refused(&[&["good/left", "good/top"], &board[..]].concat(), &["view_002.png: is neither"]);
}

/// Our detections with the corners of cv::cornerSubPix, which most users take.
fn by_corner_sub_pix(detections: &[Detection], camera: usize, image: impl Fn(usize) -> GrayImage) -> Vec<Detection> {
    let detection = |d: &Detection| {
        let image = image(d.view);
        let mut pixels = image_points(d);
        let mat = Mat::new_rows_cols_with_bytes::<u8>(image.height() as i32, image.width() as i32, &image).unwrap();
        let criteria = TermCriteria::new(3, 50, 1e-4).unwrap();
        opencv::imgproc::corner_sub_pix(&mat, &mut pixels, Size::new(5, 5), Size::new(-1, -1), criteria).unwrap();
        let corners = d.corners.iter().zip(&pixels).map(|((id, _), p)| (*id, Point2::new(p.x.into(), p.y.into()))).collect();
        Detection { corners, ..*d }
    };
    detections.iter().filter(|d| d.camera == camera).map(detection).collect()
}

fn object_points(d: &Detection, target: &Target) -> Vector<Point3f> {
    d.corners.iter().map(|(id, _)| target.point(*id)).map(|p| Point3f::new(p.x as f32, p.y as f32, 0.0)).collect()
}

fn image_points(d: &Detection) -> Vector<Point2f> {
    d.corners.iter().map(|(_, p)| Point2f::new(p.x as f32, p.y as f32)).collect()
}

/// cv::calibrateCamera with our lens terms; the pose is left out.
fn opencv_camera(detections: &[Detection], target: &Target, size_px: [u32; 2]) -> Camera {
    let objects: Vector<Vector<Point3f>> = detections.iter().map(|d| object_points(d, target)).collect();
    let images: Vector<Vector<Point2f>> = detections.iter().map(image_points).collect();
    let (mut matrix, mut lens) = (Mat::default(), Mat::default());
    let (mut turns, mut places) = (Vector::<Mat>::new(), Vector::<Mat>::new());
    let size = Size::new(size_px[0] as i32, size_px[1] as i32);
    let criteria = TermCriteria::new(3, 200, 1e-12).unwrap();
    let flags = calib3d::CALIB_FIX_K3;
    calib3d::calibrate_camera(&objects, &images, size, &mut matrix, &mut lens, &mut turns, &mut places, flags, criteria).unwrap();
    camera_of(&matrix, &lens, size_px)
}

fn camera_of(matrix: &Mat, lens: &Mat, size_px: [u32; 2]) -> Camera {
    Camera {
        name: String::new(),
        size_px,
        matrix: Matrix3::from_row_slice(matrix.data_typed().unwrap()),
        lens: Lens::brown_conrady(lens.data_typed().unwrap()).unwrap(),
        camera_from_world: Rotation3::identity(),
        translation: Vector3::zeros(),
    }
}

/// cv::calibrateCamera on each and cv::stereoCalibrate on both from there, all free but k3: the cameras, the first in the
/// origin, and the RMS. Detections are of the same corners in the same views.
fn opencv_stereo(first: &[Detection], second: &[Detection], target: &Target, size_px: [u32; 2]) -> (Vec<Camera>, f64) {
    let objects: Vector<Vector<Point3f>> = first.iter().map(|d| object_points(d, target)).collect();
    let images = [first, second].map(|list| list.iter().map(image_points).collect::<Vector<Vector<Point2f>>>());
    let mut starts = [first, second].map(|list| {
        let camera = opencv_camera(list, target, size_px);
        let rows: Vec<[f64; 3]> = camera.matrix.row_iter().map(|r| [r[0], r[1], r[2]]).collect();
        (Mat::from_slice_2d(&rows).unwrap(), Mat::from_slice(camera.lens.terms()).unwrap().try_clone().unwrap())
    });
    let [(k1, d1), (k2, d2)] = &mut starts;
    let (mut turn, mut place, mut essential, mut fundamental) = (Mat::default(), Mat::default(), Mat::default(), Mat::default());
    let size = Size::new(size_px[0] as i32, size_px[1] as i32);
    let flags = calib3d::CALIB_USE_INTRINSIC_GUESS | calib3d::CALIB_FIX_K3;
    let criteria = TermCriteria::new(3, 300, 1e-12).unwrap();
    let rms = calib3d::stereo_calibrate(
        &objects,
        &images[0],
        &images[1],
        k1,
        d1,
        k2,
        d2,
        size,
        &mut turn,
        &mut place,
        &mut essential,
        &mut fundamental,
        flags,
        criteria,
    )
    .unwrap();
    let mut cameras = vec![camera_of(k1, d1, size_px), camera_of(k2, d2, size_px)];
    cameras[1].camera_from_world = Rotation3::from_matrix_unchecked(Matrix3::from_row_slice(turn.data_typed().unwrap()));
    cameras[1].translation = Vector3::from_column_slice(place.data_typed().unwrap());
    (cameras, rms)
}

fn uncalibrated(names: &[&str], size_px: [u32; 2]) -> Vec<Uncalibrated> {
    names.iter().map(|name| Uncalibrated { name: (*name).into(), size_px, known: None }).collect()
}

/// The corners that both cameras see in the same views, in the same order.
fn common(detections: &[Detection], first: usize, second: usize) -> (Vec<Detection>, Vec<Detection>) {
    let mut pairs = (Vec::new(), Vec::new());
    for a in detections.iter().filter(|d| d.camera == first) {
        let Some(b) = detections.iter().find(|d| (d.camera, d.view) == (second, a.view)) else { continue };
        let pixel = |d: &Detection, id: usize| d.corners.iter().find(|c| c.0 == id).map(|c| c.1);
        let ids: Vec<usize> = a.corners.iter().map(|c| c.0).filter(|id| pixel(b, *id).is_some()).collect();
        let only = |d: &Detection| Detection { corners: ids.iter().filter_map(|id| Some((*id, pixel(d, *id)?))).collect(), ..d.clone() };
        pairs.0.push(only(a));
        pairs.1.push(only(b));
    }
    pairs
}

/// What took part in a calibration, as detections.
fn used(result: &Calibration) -> Vec<Detection> {
    let detection = |s: &muybridge::rig::calibrate::FittedSighting| Detection {
        camera: s.camera,
        view: s.view,
        corners: s.corners.iter().map(|c| (c.id, c.pixel)).collect(),
    };
    result.sightings.iter().map(detection).collect()
}

#[test]
fn the_rendered_laboratory_is_nearer_to_its_truth_than_by_opencv() {
    let Some(folder) = data("phantom_lab") else { return };
    let Rig { cameras: truth, .. } = read_rig(&folder.join("truth/Calib.toml")).unwrap();
    let board = Board::chessboard(9, 6, SQUARE_M).unwrap();
    let target = board.target().unwrap();
    let names = ["cam_00", "cam_01", "cam_02"];
    let mut detections = Vec::new();
    for (k, name) in names.iter().enumerate() {
        for view in 0..18 {
            let image = read_grey(&folder.join(format!("{name}/{view:06}.png"))).unwrap();
            detections.extend(board.detect(&image, &target, k, view).unwrap());
        }
    }
    assert_eq!(detections.len(), 54);
    let result = calibrate(&uncalibrated(&names, [640, 480]), &target, &detections, &CalibrateOptions::default()).unwrap();
    let classic: Vec<Vec<Detection>> = (0..3)
        .map(|k| by_corner_sub_pix(&detections, k, |view| read_grey(&folder.join(format!("{}/{view:06}.png", names[k]))).unwrap()))
        .collect();
    println!("            f error      c error    picture   centre   rotation   (ours | calibrateCamera and stereoCalibrate)");
    for k in 1..3 {
        let (theirs, _) = opencv_stereo(&classic[0], &classic[k], &target, [640, 480]);
        let pair = |all: &[Camera]| vec![all[0].clone(), all[k].clone()];
        let (ours, truth) = (pair(&result.rig.cameras), pair(&truth));
        let row = |cameras: &[Camera]| {
            let error =
                |place: (usize, usize)| (0..2).map(|i| (cameras[i].matrix[place] - truth[i].matrix[place]).abs()).fold(0.0, f64::max);
            let lens_px = (0..2).map(|i| lens_difference_px(&truth[i], &cameras[i])).fold(0.0, f64::max);
            let (place_mm, turn_deg) = relative_errors(cameras, &truth, 1);
            [error((0, 0)).max(error((1, 1))), error((0, 2)).max(error((1, 2))), lens_px, place_mm, turn_deg]
        };
        let (a, b) = (row(&ours), row(&theirs));
        println!("0-{k} ours    {:8.3} px {:8.3} px {:6.3} px {:6.3} mm {:7.4} deg", a[0], a[1], a[2], a[3], a[4]);
        println!("0-{k} OpenCV  {:8.3} px {:8.3} px {:6.3} px {:6.3} mm {:7.4} deg", b[0], b[1], b[2], b[3], b[4]);
        assert!(a[0] < b[0] && a[1] < b[1] && a[2] < b[2] && a[3] < b[3].max(0.1) && a[4] < b[4].max(0.02));
        assert!(a[0] < 0.3 && a[1] < 0.4 && a[2] < 0.6 && a[3] < 0.15 && a[4] < 0.03);
    }
    for (p, value) in result.parameters.iter().filter(|p| p.name.ends_with("_px")).map(|p| {
        let m = &truth[p.camera].matrix;
        (
            p,
            match p.name {
                "fx_px" => m[(0, 0)],
                "fy_px" => m[(1, 1)],
                "cx_px" => m[(0, 2)],
                _ => m[(1, 2)],
            },
        )
    }) {
        assert!((p.value - value).abs() < 4.0 * p.sigma, "{} of camera {}: {} +- {}, true {value}", p.name, p.camera, p.value, p.sigma);
    }
}

#[test]
fn real_pairs_leave_no_more_than_opencvs_stereo_calibration() {
    let Some(folder) = data("opencv-stereo-chessboard") else { return };
    let board = Board::chessboard(9, 6, 0.025).unwrap();
    let target = board.target().unwrap();
    let (mut fitted, mut plain) = (Vec::new(), Vec::new());
    for (k, side) in ["left", "right"].into_iter().enumerate() {
        for view in (1..15).filter(|v| *v != 10) {
            let image = read_grey(&folder.join(format!("{side}{view:02}.jpg"))).unwrap();
            fitted.extend(board.detect(&image, &target, k, view).unwrap());
            let corners = find_chessboard_by(Detector::SectorBased, &image, 9, 6).unwrap();
            plain.extend(corners.map(|corners| Detection { camera: k, view, corners }));
        }
    }
    for (name, detections) in [("fitted", fitted), ("findChessboardCornersSB", plain)] {
        let names = uncalibrated(&["left", "right"], [640, 480]);
        let ours = calibrate(&names, &target, &detections, &CalibrateOptions::default()).unwrap();
        // The same corners for both: those that both cameras have, until none is put aside.
        let (mut ours, mut first, mut second) = (ours, Vec::new(), Vec::new());
        for _ in 0..6 {
            (first, second) = common(&used(&ours), 0, 1);
            ours = calibrate(&names, &target, &[first.clone(), second.clone()].concat(), &CalibrateOptions::default()).unwrap();
            if used(&ours).len() == 2 * first.len() && ours.quality.iter().all(|q| q.corners_rejected == 0) {
                break;
            }
        }
        assert!(ours.rejected.is_empty() && ours.quality.iter().all(|q| q.corners_rejected == 0), "{name}");
        let (cameras, rms_px) = opencv_stereo(&first, &second, &target, [640, 480]);
        let baseline = |cameras: &[Camera]| (cameras[0].centre() - cameras[1].centre()).norm() / 0.025;
        println!(
            "{name}: {} views, {} corners, ours {:.4} px, stereoCalibrate {rms_px:.4} px; baseline {:.4} and {:.4} squares",
            first.len(),
            ours.quality[0].corners,
            ours.rms_px,
            baseline(&ours.rig.cameras),
            baseline(&cameras)
        );
        assert!((ours.rms_px / rms_px - 1.0).abs() < 0.01, "{name}: {} {rms_px}", ours.rms_px);
        assert!((baseline(&ours.rig.cameras) - baseline(&cameras)).abs() < 0.003);
        for (a, b) in ours.rig.cameras.iter().zip(&cameras) {
            assert!(lens_difference_px(a, b) < 0.2, "{name}: {}", lens_difference_px(a, b));
        }
    }
}

#[test]
fn four_real_cameras_agree_with_another_tools_solution() {
    let Some(folder) = data("caliscope-4cam/charuco_calibration") else { return };
    let table: toml::Table = std::fs::read_to_string(folder.join("camera_array.toml")).unwrap().parse().unwrap();
    let numbers = |value: &toml::Value| -> Vec<f64> {
        let flat = |v: &toml::Value| v.as_array().map_or_else(|| vec![v.clone()], Clone::clone);
        value.as_array().unwrap().iter().flat_map(flat).map(|n| n.as_float().unwrap()).collect()
    };
    let theirs: Vec<Camera> = (0..4)
        .map(|k| {
            let camera = &table["cameras"][&k.to_string()];
            Camera {
                name: format!("cam_{k}"),
                size_px: [1280, 720],
                matrix: Matrix3::from_row_slice(&numbers(&camera["matrix"])),
                lens: Lens::brown_conrady(&numbers(&camera["distortions"])).unwrap(),
                camera_from_world: Rotation3::from_matrix_unchecked(Matrix3::from_row_slice(&numbers(&camera["rotation"]))),
                translation: Vector3::from_column_slice(&numbers(&camera["translation"])),
            }
        })
        .collect();
    let temporary = tempfile::tempdir().unwrap();
    let known = temporary.path().join("known.toml");
    muybridge::io::calib_toml::write_rig(&known, &Rig { cameras: theirs.clone(), up: muybridge::rig::Up::Z }).unwrap();
    let videos: Vec<PathBuf> = (0..4).map(|k| folder.join(format!("calibration/extrinsic/cam_{k}.mp4"))).collect();
    let mut command = Command::cargo_bin("muybridge").unwrap();
    command.arg("calibrate").args(&videos).args(["--board", "4x5", "--square", "0.054", "--charuco", "4X4_1000", "--marker", "0.0405"]);
    let output = command.arg("--intrinsics").arg(&known).arg("-o").arg(temporary.path().join("Calib.toml")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8(output.stderr).unwrap());
    let ours = read_rig(&temporary.path().join("Calib.toml")).unwrap().cameras;
    println!("{}", String::from_utf8(output.stdout).unwrap().lines().take(7).collect::<Vec<_>>().join("\n"));
    for (i, k) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
        let of = |rig: &[Camera]| (rig[i].centre() - rig[k].centre()).norm();
        let pair = |rig: &[Camera]| vec![rig[i].clone(), rig[k].clone()];
        let (place_mm, turn_deg) = relative_errors(&pair(&ours), &pair(&theirs), 1);
        println!(
            "{i}-{k}: baseline {:.4} m, ratio {:.4}, centre {place_mm:.1} mm and rotation {turn_deg:.2} deg apart",
            of(&ours),
            of(&ours) / of(&theirs)
        );
        assert!((of(&ours) / of(&theirs) - 1.0).abs() < 0.025 && turn_deg < 1.2, "{i}-{k}");
    }
}

#[test]
fn boards_of_calib_are_made_again_and_found() {
    let folder = tempfile::tempdir().unwrap();
    let calib = Path::new(env!("CARGO_MANIFEST_DIR")).join("calib");
    let boards: [(&str, &[&str], Board); 2] = [
        ("chessboard_9x6_25mm.png", &["--board", "9x6", "--square", "0.025"], Board::chessboard(9, 6, 0.025).unwrap()),
        (
            "charuco_7x5_35mm.png",
            &["--board", "7x5", "--square", "0.035", "--charuco", "5X5_50", "--marker", "0.026"],
            Board::charuco([7, 5], 0.035, 0.026, "5X5_50", false).unwrap(),
        ),
    ];
    for (name, arguments, board) in boards {
        assert!(run(&[&["rig", "board"], arguments, &["-o", name]].concat(), folder.path()).status.success());
        let made = std::fs::read(folder.path().join(name)).unwrap();
        if std::env::var_os("REGENERATE").is_some() {
            std::fs::write(calib.join(name), &made).unwrap();
        }
        assert!(made == std::fs::read(calib.join(name)).unwrap(), "{name} is not what the program makes; REGENERATE=1 writes it anew");
        assert!(made.len() < 100_000, "{name}: {} bytes", made.len());
        let target = board.target().unwrap();
        let found = board.find(&read_grey(&calib.join(name)).unwrap(), &target).unwrap().unwrap();
        assert_eq!(found.len(), target.points.len());
        // All corners lie on the grid of squares.
        let side_px = (board.square_m() / 0.0254 * 300.0).round();
        let (origin_id, origin) = found[0];
        for (id, pixel) in &found {
            let expected = (target.points[*id] - target.points[origin_id]) / board.square_m() * side_px;
            assert!((pixel - origin - expected).norm() < 0.05, "{name}: {id} {:?}", pixel - origin - Vector2::from(expected));
        }
    }
    let svg = run(&["rig", "board", "--board", "9x6", "--square", "0.025", "-o", "b.svg"], folder.path());
    assert!(svg.status.success() && std::fs::read_to_string(folder.path().join("b.svg")).unwrap().contains("width=\"280mm\""));
    let other = run(&["rig", "board", "--board", "9x6", "--square", "0.025", "-o", "b.jpg"], folder.path());
    assert_eq!(other.status.code(), Some(1));
}

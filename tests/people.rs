//! Clouds of a person that the phantom renders: against the known surface, against OpenCV, and under bad light.

use std::path::Path;

use crate::common::walk_across;
use image::GrayImage;
use muybridge::body::{Placement, Pose, PosedSurface, place};
use muybridge::clouds::{CloudError, CloudOptions, CloudRig, FrameCloud};
use muybridge::io::calib_toml::read_rig;
use muybridge::phantom::{Scene, Stage, View, depth, distance_to_skin, mask, render, render_stage};
use muybridge::rig::{Lens, Rig};
use nalgebra::{Matrix3, Vector3};
use opencv::core::{CV_32F, CV_32FC1, Mat, Point3f, Scalar, Size, Vec3f};
use opencv::{calib3d, imgproc, prelude::*};

/// One frame of a walk, seen by every camera, with the empty stage.
struct Take {
    rig: Rig,
    scene: Scene,
    pose: Pose,
    images: Vec<GrayImage>,
    stages: Vec<GrayImage>,
}

fn lab() -> Rig {
    read_rig(&Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml")).unwrap()
}

/// The lab's rig with a third of its baselines.
fn short() -> Rig {
    let mut rig = lab();
    let centre = rig.cameras[0].centre();
    for camera in &mut rig.cameras {
        let moved = centre + (camera.centre() - centre) / 3.0;
        camera.translation = -(camera.camera_from_world * moved);
    }
    rig
}

fn film(rig: Rig, seed: u64, noise_grey: f64) -> Take {
    let (shape, poses) = walk_across(&rig, seed, 1.2, 30.0, 1.0);
    let pose = poses[7 + seed as usize % 7].clone();
    let mut scene = Scene::new(Stage::around(&rig, &[poses[0].root, poses[30].root]), &shape);
    (scene.noise_grey, scene.seed) = (noise_grey, seed);
    let views: Vec<View> = rig.cameras.iter().enumerate().map(|(i, c)| View::new(&scene.stage, c, i)).collect();
    let images = views.iter().map(|view| render(&scene, view, &pose, 0)).collect();
    let stages = views.iter().map(|view| render_stage(&scene, view)).collect();
    Take { rig, scene, pose, images, stages }
}

impl Take {
    fn placed(&self) -> Placement {
        place(&self.scene.offsets, &self.pose)
    }

    fn view(&self, camera: usize) -> View {
        View::new(&self.scene.stage, &self.rig.cameras[camera], camera)
    }

    fn cloud(&self) -> FrameCloud {
        let options = CloudOptions::default();
        CloudRig::new(&self.rig, Some(&self.stages), &options).unwrap().frame(&self.images, &options).unwrap()
    }

    /// Distances of every tenth point to the skin, sorted, metres.
    fn distances(&self, points: &[Vector3<f64>]) -> Vec<f64> {
        let skin = PosedSurface::new(&self.scene.surface, &self.placed());
        let mut distances: Vec<f64> = points.iter().step_by(10).map(|x| distance_to_skin(&skin, x)).collect();
        distances.sort_by(f64::total_cmp);
        distances
    }
}

fn positions(found: &FrameCloud) -> Vec<Vector3<f64>> {
    found.cloud.points.iter().map(|p| p.position).collect()
}

/// StereoSGBM and reprojectImageTo3D of cameras 0 and 1; points on the true silhouette only, in the world.
fn semi_global(take: &Take) -> Vec<Vector3<f64>> {
    let [a, b] = [&take.rig.cameras[0], &take.rig.cameras[1]];
    let matrix = |m: &Matrix3<f64>| {
        Mat::from_slice_2d(&[[m[(0, 0)], m[(0, 1)], m[(0, 2)]], [m[(1, 0)], m[(1, 1)], m[(1, 2)]], [m[(2, 0)], m[(2, 1)], m[(2, 2)]]])
            .unwrap()
    };
    let b_from_a = b.camera_from_world * a.camera_from_world.inverse();
    let t = b.translation - b_from_a * a.translation;
    let lens = [a, b].map(|c| {
        let Lens::BrownConrady(terms) = c.lens else { panic!("not a fisheye rig") };
        (matrix(&c.matrix), Mat::from_slice(&terms).unwrap().try_clone().unwrap())
    });
    let size = Size::new(640, 480);
    let [mut r1, mut r2, mut p1, mut p2, mut q] = [0; 5].map(|_| Mat::default());
    let (rotation, translation) = (matrix(b_from_a.matrix()), Mat::from_slice_2d(&[[t.x], [t.y], [t.z]]).unwrap());
    calib3d::stereo_rectify(
        &lens[0].0,
        &lens[0].1,
        &lens[1].0,
        &lens[1].1,
        size,
        &rotation,
        &translation,
        &mut r1,
        &mut r2,
        &mut p1,
        &mut p2,
        &mut q,
        calib3d::CALIB_ZERO_DISPARITY,
        0.0,
        size,
        None,
        None,
    )
    .unwrap();
    let rectified = |k: usize, image: &GrayImage, r: &Mat, p: &Mat| {
        let (mut x, mut y, mut out) = (Mat::default(), Mat::default(), Mat::default());
        calib3d::init_undistort_rectify_map(&lens[k].0, &lens[k].1, r, p, size, CV_32FC1, &mut x, &mut y).unwrap();
        let raw = Mat::new_rows_cols_with_data(480, 640, image.as_raw()).unwrap();
        imgproc::remap(&raw, &mut out, &x, &y, imgproc::INTER_LINEAR, opencv::core::BORDER_CONSTANT, Scalar::default()).unwrap();
        out
    };
    let (left, right) = (rectified(0, &take.images[0], &r1, &p1), rectified(1, &take.images[1], &r2, &p2));
    let mut matcher = calib3d::StereoSGBM::create(0, 144, 5, 200, 800, 1, 0, 10, 100, 2, calib3d::StereoSGBM_MODE_SGBM).unwrap();
    let (mut steps, mut disparity, mut space) = (Mat::default(), Mat::default(), Mat::default());
    matcher.compute(&left, &right, &mut steps).unwrap();
    steps.convert_to(&mut disparity, CV_32F, 1.0 / 16.0, 0.0).unwrap();
    calib3d::reproject_image_to_3d(&disparity, &mut space, &q, false, -1).unwrap();
    let r1 = Matrix3::from_row_slice(r1.data_typed::<f64>().unwrap());
    let silhouette = mask(&take.scene, &take.view(0), &take.pose);
    let known = space.data_typed::<Vec3f>().unwrap().iter().zip(disparity.data_typed::<f32>().unwrap()).filter(|(_, d)| **d > 0.0);
    let world = known.map(|(x, _)| {
        let Point3f { x, y, z } = Point3f::new(x[0], x[1], x[2]);
        a.camera_from_world.inverse() * (r1.transpose() * Vector3::new(x, y, z).cast() - a.translation)
    });
    let on_person = |x: &Vector3<f64>| {
        a.project(x).is_some_and(|p| {
            let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < 639.5 && p.y < 479.5;
            inside && silhouette.get_pixel(p.x.round() as u32, p.y.round() as u32).0[0] > 0
        })
    };
    world.filter(on_person).collect()
}

#[test]
fn clouds_lie_on_the_skin_and_nearer_to_it_than_semi_global_matching() {
    for (rig, seed) in [(lab(), 21), (short(), 22)] {
        let take = film(rig, seed, 2.0);
        let found = take.cloud();
        let (ours, theirs) = (take.distances(&positions(&found)), take.distances(&semi_global(&take)));
        let at = |sorted: &[f64], q: f64| 1e3 * sorted[(q * sorted.len() as f64) as usize];
        println!(
            "distance to the skin, median and 95 %: {:.1}, {:.1} mm of {} points; StereoSGBM {:.1}, {:.1} mm of {}",
            at(&ours, 0.5),
            at(&ours, 0.95),
            ours.len(),
            at(&theirs, 0.5),
            at(&theirs, 0.95),
            theirs.len()
        );
        assert!(ours.len() > 500 && at(&ours, 0.5) < 0.6 * at(&theirs, 0.5) && at(&ours, 0.95) < at(&theirs, 0.95));
        // The silhouette, and how much of it has points.
        let truth = mask(&take.scene, &take.view(0), &take.pose);
        let found_mask = found.masks[0].as_ref().unwrap();
        let count =
            |f: &dyn Fn(bool, bool) -> bool| truth.iter().zip(found_mask.iter()).filter(|(t, m)| f(**t > 0, **m > 0)).count() as f64;
        let overlap = count(&|t, m| t && m) / count(&|t, m| t || m);
        println!("intersection over union {overlap:.3}");
        assert!(overlap > 0.9, "{overlap}");
    }
}

/// Share of the reference's disparities on the person that are off by more than 1 px, and their number. The truth is the
/// skin's depth where all four pixels around are the person's.
fn off(take: &Take, cameras: &[usize]) -> (f64, usize) {
    let rig = Rig { cameras: cameras.iter().map(|k| take.rig.cameras[*k].clone()).collect(), up: take.rig.up };
    let pick = |images: &[GrayImage]| -> Vec<GrayImage> { cameras.iter().map(|k| images[*k].clone()).collect() };
    let options = CloudOptions::default();
    let ready = CloudRig::new(&rig, Some(&pick(&take.stages)), &options).unwrap();
    let found = ready.frame(&pick(&take.images), &options).unwrap();
    let group = &ready.groups[0].0;
    let (map, silhouette) = (depth(&take.scene, &take.view(0), &take.pose), mask(&take.scene, &take.view(0), &take.pose));
    let (camera, step) = (&take.rig.cameras[0], group.views[1].step);
    let (mut count, mut wrong) = (0, 0);
    for (u, v, d) in found.disparity.enumerate_pixels().filter(|(_, _, d)| d.0[0] > 0.0) {
        let Some(raw) = group.raw_pixel(0, &nalgebra::Vector2::new(u.into(), v.into())) else { continue };
        let (x, y) = (raw.x as u32, raw.y as u32);
        let corners = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
        if corners.iter().any(|(x, y)| silhouette.get_pixel(*x, *y).0[0] == 0) {
            continue;
        }
        let ray = camera.ray(&raw).unwrap();
        let disparity = |&(x, y): &(u32, u32)| {
            let point = camera.centre() + ray * (f64::from(map.get_pixel(x, y).0[0]) / (camera.camera_from_world * ray).z);
            (group.project(1, &point).unwrap() - group.project(0, &point).unwrap()).dot(&step) / step.norm_squared()
        };
        // Where a step between limbs lies within the pixel, either side is right.
        let least = corners.iter().map(|c| (f64::from(d.0[0]) - disparity(c)).abs()).fold(f64::INFINITY, f64::min);
        (count, wrong) = (count + 1, wrong + usize::from(least > 1.0));
    }
    (wrong as f64 / count as f64, count)
}

#[test]
fn three_views_are_off_less_often_than_pairs() {
    let (mut three, mut pairs) = (0.0, 0.0);
    for seed in [21, 22, 23] {
        let take = film(lab(), seed, 2.0);
        let (all, points) = off(&take, &[0, 1, 2]);
        let ((right, of_right), (upper, of_upper)) = (off(&take, &[0, 1]), off(&take, &[0, 2]));
        println!("seed {seed}: {all:.4} of {points}; pairs {right:.4} of {of_right}, {upper:.4} of {of_upper}");
        assert!(points > 9_000 && 10 * points > 9 * of_right.max(of_upper));
        (three, pairs) = (three + all, pairs + 0.5 * (right + upper));
    }
    assert!(pairs > 0.0 && three < 0.7 * pairs, "{three} {pairs}");
}

/// Variance of the errors within 3 sigma over that of a normal distribution cut there, and the part beyond.
fn spread(z: &[f64]) -> [f64; 2] {
    let within: Vec<f64> = z.iter().copied().filter(|z| z.abs() < 3.0).collect();
    let variance = within.iter().map(|z| z * z).sum::<f64>() / within.len() as f64 / 0.973;
    [variance, 1.0 - within.len() as f64 / z.len() as f64]
}

#[test]
fn covariances_tell_the_errors_of_depth() {
    let (mut all, mut near, mut far) = (Vec::new(), Vec::new(), Vec::new());
    let mut by_sigma = Vec::new();
    for (rig, seed, noise) in [(lab(), 31, 1.5), (lab(), 32, 3.0), (short(), 33, 2.0)] {
        let take = film(rig, seed, noise);
        let found = take.cloud();
        let camera = &take.rig.cameras[0];
        let (map, silhouette) = (depth(&take.scene, &take.view(0), &take.pose), mask(&take.scene, &take.view(0), &take.pose));
        let axis = camera.camera_from_world.inverse() * Vector3::z();
        let mut z = Vec::new();
        for point in &found.cloud.points {
            let pixel = camera.project(&point.position).unwrap();
            let (x, y, wx, wy) = (pixel.x as u32, pixel.y as u32, pixel.x.fract(), pixel.y.fract());
            let corners = [(0, 0, (1.0 - wx) * (1.0 - wy)), (1, 0, wx * (1.0 - wy)), (0, 1, (1.0 - wx) * wy), (1, 1, wx * wy)];
            if corners.iter().any(|(dx, dy, _)| silhouette.get_pixel(x + dx, y + dy).0[0] == 0) {
                continue;
            }
            let truth: f64 = corners.iter().map(|(dx, dy, w)| w * f64::from(map.get_pixel(x + dx, y + dy).0[0])).sum();
            let sigma = axis.dot(&(point.covariance * axis)).sqrt();
            z.push((camera.camera_point(&point.position).z - truth) / sigma);
            by_sigma.push((point.confidence, z[z.len() - 1]));
        }
        let [variance, beyond] = spread(&z);
        println!("seed {seed}, noise {noise}: variance {variance:.2}, beyond 3 sigma {beyond:.3}, {} points", z.len());
        assert!(z.len() > 10_000 && (0.7..1.4).contains(&variance) && beyond < 0.06);
        if take.rig.cameras[1].centre().x < 0.2 {
            near.extend(z.clone())
        } else {
            far.extend(z.clone())
        }
        all.extend(z);
    }
    by_sigma.sort_by(|a, b| a.0.total_cmp(&b.0));
    let classes: Vec<f64> =
        by_sigma.chunks(by_sigma.len() / 4 + 1).map(|c| spread(&c.iter().map(|p| p.1).collect::<Vec<_>>())[0]).collect();
    println!("all {:.2?}, short rig {:.2?}, lab {:.2?}, classes of sigma {classes:.2?}", spread(&all), spread(&near), spread(&far));
    assert!((0.8..1.2).contains(&spread(&all)[0]) && classes.iter().all(|v| (0.7..1.35).contains(v)));
}

#[test]
fn an_exposure_of_seven_tenths_in_one_camera_changes_little() {
    let mut take = film(lab(), 41, 2.0);
    let equal = take.distances(&positions(&take.cloud()));
    for picture in [&mut take.images[1], &mut take.stages[1]] {
        picture.iter_mut().for_each(|v| *v = (0.7 * f64::from(*v)).round() as u8);
    }
    let darker = take.distances(&positions(&take.cloud()));
    let middle = |d: &[f64]| d[d.len() / 2];
    println!("median {:.2} mm of {}, darker {:.2} mm of {}", 1e3 * middle(&equal), equal.len(), 1e3 * middle(&darker), darker.len());
    assert!(middle(&darker) < 1.25 * middle(&equal) && darker.len() as f64 > 0.9 * equal.len() as f64);
}

#[test]
fn a_black_view_is_named() {
    let mut take = film(lab(), 51, 2.0);
    let options = CloudOptions::default();
    let ready = CloudRig::new(&take.rig, Some(&take.stages), &options).unwrap();
    // A covered lens still has the sensor's noise.
    take.images[2].iter_mut().enumerate().for_each(|(i, v)| *v = [0, 2, 1, 3][i * 7919 % 4]);
    let error = ready.frame(&take.images, &options).unwrap_err();
    assert!(matches!(&error, CloudError::Blank { camera, .. } if *camera == take.rig.cameras[2].name), "{error}");
    assert!(error.to_string().contains("uncover the lens"), "{error}");
    take.stages[1].fill(7);
    assert!(matches!(CloudRig::new(&take.rig, Some(&take.stages), &options), Err(CloudError::Blank { .. })));
}

#[test]
fn hands_and_feet_stay_when_lone_points_go() {
    use muybridge::body::Joint;
    let take = film(lab(), 61, 2.0);
    let options = CloudOptions::default();
    let ready = CloudRig::new(&take.rig, Some(&take.stages), &options).unwrap();
    let found = ready.frame(&take.images, &options).unwrap();
    let (group, _) = &ready.groups[0];
    let placed = take.placed();
    let at_extremities = |x: &Vector3<f64>| {
        [Joint::LWrist, Joint::RWrist, Joint::LAnkle, Joint::RAnkle].iter().any(|j| (placed.position(*j) - x).norm() < 0.18)
    };
    let known = found.disparity.enumerate_pixels().filter(|(_, _, d)| d.0[0] > 0.0);
    let before = known.filter(|(u, v, d)| at_extremities(&group.world_from_pixel((*u).into(), (*v).into(), d.0[0].into()))).count();
    let after = positions(&found).iter().filter(|x| at_extremities(x)).count();
    println!("{after} of {before} points at hands and feet");
    assert!(before > 1500 && after as f64 > 0.97 * before as f64);
    // And they are the person's: nothing flies.
    let distances = take.distances(&positions(&found));
    let flying = distances.iter().filter(|d| **d > 0.05).count();
    println!("{flying} of {} points farther than 5 cm from the skin", distances.len());
    assert!((flying as f64) < 0.005 * distances.len() as f64);
}

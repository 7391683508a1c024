//! The fit on measurements made without pictures, whose truth is a state of the model itself.

use std::sync::Arc;

use crate::common::across;
use muybridge::body::{Joint, NODES, Pose, PosedSurface, Shape, Surface, place};
use muybridge::clouds::{Cloud, CloudPoint};
use muybridge::fit::curve::Curve;
use muybridge::fit::problem::{Frame, Free, Known, Problem, Settings, Target};
use muybridge::fit::state::{Carrier, Posture, State};
use muybridge::fit::{Checkpoint, Checkpoints, FitOptions, Observation, PointResidual, Silhouette, contest, fit, resume};
use muybridge::math::arrow::{LmOptions, minimise};
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, Model, synthetic};
use muybridge::phantom::{Figure, SightOptions, joint_errors, sighting, staging};
use muybridge::rig::rectify::groups;
use muybridge::rig::{Camera, Lens, Rig, Up};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

/// Distance of the walkers from the cameras, metres.
const DISTANCE_M: f64 = 3.6;

/// Half of the embedded database: quick to build and still with a style for every person.
fn model() -> Model {
    let cycles: Vec<_> = (1..=synthetic::subjects(Activity::Walking))
        .flat_map(|seed| [0.9, 1.2, 1.5, 1.8].map(|v| synthetic::subject(Activity::Walking, seed).cycle(v, 0)))
        .collect();
    Model::build(Activity::Walking, true, &cycles).unwrap()
}

/// Three cameras in an L of 0.3 m, 1 m above the floor, looking along y.
fn rig() -> Rig {
    let camera_from_world = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0));
    let camera = |(x, z): (f64, f64)| Camera {
        name: format!("{x} {z}"),
        size_px: [640, 480],
        matrix: Matrix3::new(550.0, 0.0, 319.5, 0.0, 550.0, 239.5, 0.0, 0.0, 1.0),
        lens: Lens::BrownConrady([-0.05, 0.0, 1e-4, -1e-4, 0.0, 0.0, 0.0, 0.0]),
        camera_from_world,
        translation: -(camera_from_world * Vector3::new(x, 0.0, z)),
    };
    Rig { cameras: [(0.0, 1.0), (0.3, 1.0), (0.0, 1.3)].map(camera).to_vec(), up: Up::Z }
}

/// A walk along x, a little towards the cameras, with weights of one standard deviation.
fn walker(curve: &Curve, frames: usize, fps: f64) -> State {
    let shape = Shape::template(1.74);
    let forward = Vector3::new(0.95, -0.3, 0.0).normalize();
    let axes = Matrix3::from_columns(&[Vector3::z().cross(&forward), Vector3::z(), forward]);
    let carriers = (0..frames).map(|t| {
        let time_s = (t as f64 - 0.5 * (frames - 1) as f64) / fps;
        Carrier {
            position: Vector3::new(0.0, DISTANCE_M, shape.hip_height_m()) + forward * (1.2 * time_s),
            world_from_carrier: UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
            phase: 0.4 + 0.9 * time_s,
        }
    });
    let weights = curve.eigenvalues.iter().enumerate().map(|(i, lambda)| lambda.sqrt() * if i % 3 == 1 { -1.0 } else { 1.0 });
    State { carriers: carriers.collect(), weights: weights.collect(), shape, posture: Posture::default(), deviations: Vec::new() }
}

fn positions(shape: &Shape, poses: &[Pose]) -> Vec<[Vector3<f64>; NODES]> {
    let offsets = shape.offsets();
    poses.iter().map(|p| place(&offsets, p).positions).collect()
}

fn poses(state: &State, curve: &Curve) -> Vec<Pose> {
    (0..state.carriers.len()).map(|t| state.pose(curve, t)).collect()
}

/// What the rig sees of a body: points and silhouettes of frames with number, time and pose.
fn observed(rig: &Rig, shape: &Shape, frames: &[(usize, f64, &Pose)]) -> Vec<Observation> {
    let (surface, offsets) = (Surface::new(shape), shape.offsets());
    let group = &groups(rig).unwrap()[0];
    let sight = SightOptions { step_px: 4, ..SightOptions::default() };
    let observe = |&(number, time_s, pose): &(usize, f64, &Pose)| {
        let figure = Figure::new(&surface, &offsets, &place(&offsets, pose));
        let points = sighting::points(&figure, group, number, &sight).into_iter();
        let point = |(position, covariance)| CloudPoint { position, colour: [0; 3], confidence: 1.0, covariance };
        let silhouettes = sighting::masks(&figure, rig, number, &sight).iter().map(|mask| Some(Silhouette::new(mask))).collect();
        Observation { number, time_s, cloud: Cloud { points: points.map(point).collect() }, silhouettes: Arc::new(silhouettes) }
    };
    frames.par_iter().map(observe).collect()
}

#[test]
fn a_walk_of_the_model_comes_back_from_noisy_points_and_masks() {
    let (model, rig, fps) = (model(), rig(), 20.0);
    let curve = Curve::new(&model, 8);
    let truth = walker(&curve, 26, fps);
    let true_poses = poses(&truth, &curve);
    let numbered: Vec<_> = true_poses.iter().enumerate().map(|(t, pose)| (t, t as f64 / fps, pose)).collect();
    let observations = observed(&rig, &truth.shape, &numbered);
    let (surface, offsets) = (Surface::new(&truth.shape), truth.shape.offsets());
    let floor = true_poses.iter().map(|p| staging::lowest_m(&surface, &place(&offsets, p), rig.up)).fold(f64::INFINITY, f64::min);
    let options = FitOptions { components: 8, ..FitOptions::default() };
    let kept = std::cell::RefCell::new(Vec::new());
    let keep = |stage: usize, at: &Checkpoint| kept.borrow_mut().push((stage, at.clone()));
    let watched = Checkpoints { load: &|_| None, save: &keep };
    let found = resume(&observations, &rig, &[&model], Some(floor), &options, &watched, &|_| true).unwrap();
    let errors = joint_errors(&positions(found.shape(), &found.poses), &positions(&truth.shape, &true_poses));
    assert!(errors.absolute_m < 0.012 && errors.swapped_over_straight > 3.0, "{errors:?}");
    for (a, b) in found.state.carriers.iter().zip(&truth.carriers) {
        let apart = (a.phase - b.phase + 0.5).rem_euclid(1.0) - 0.5;
        assert!(apart.abs() < 0.02 && (a.position - b.position).norm() < 0.03, "{apart} {}", a.position - b.position);
        assert!(a.world_from_carrier.angle_to(&b.world_from_carrier) < 0.08);
    }
    // Ten frames in which nothing was seen, and points that are no numbers.
    let mut gaps = observations.clone();
    for o in &mut gaps[9..19] {
        (o.cloud, o.silhouettes) = (Cloud::default(), Arc::new(vec![None; rig.cameras.len()]));
    }
    let nowhere = CloudPoint { position: Vector3::repeat(f64::NAN), ..gaps[3].cloud.points[0].clone() };
    gaps[3].cloud.points.push(nowhere);
    let bridged = fit(&gaps, &rig, &[&model], Some(floor), &options, &|_| true).unwrap();
    let errors = joint_errors(&positions(bridged.shape(), &bridged.poses), &positions(&truth.shape, &true_poses));
    assert!(bridged.poses.len() == 26 && errors.absolute_m < 0.03 && errors.swapped_over_straight > 2.0, "{errors:?}");
    // The last stage ends where joints are still.
    let kept = kept.into_inner();
    let places = |state: &State| positions(&state.shape, &poses(state, &curve)).concat();
    let [(before, _), (after, end)] = [2, 1].map(|k| &kept[kept.len() - k]).map(|(_, at)| (places(&at.state), at));
    let moved_m = (before.iter().zip(&after).map(|(a, b)| (a - b).norm_squared()).sum::<f64>() / after.len() as f64).sqrt();
    assert!(end.rounds > 1 && moved_m > 1e-5 && moved_m < 5e-4 && (moved_m - end.moved_m).abs() < 1e-9, "{moved_m} {}", end.moved_m);
    // Stopped late and taken up again, it ends as if nothing had been.
    let until = &kept[..kept.len() * 9 / 10];
    let (last, more) = (|stage: usize| until.iter().rev().find(|k| k.0 == stage).map(|k| k.1.clone()), std::cell::Cell::new(0));
    let again = Checkpoints { load: &last, save: &|_, _| more.set(more.get() + 1) };
    let again = resume(&observations, &rig, &[&model], Some(floor), &options, &again, &|_| true).unwrap();
    assert!(more.get() > 0 && more.get() < kept.len() / 5 + 1, "{} of {}", more.get(), kept.len());
    assert_eq!(format!("{:?} {:?}", again.state, again.iterations), format!("{:?} {:?}", found.state, found.iterations));
    // One standard deviation each: a fit that says nothing would be off by 1.
    let off = |i: usize| (found.state.weights[i] - truth.weights[i]) / curve.eigenvalues[i].sqrt();
    let rms = ((0..8).map(|i| off(i).powi(2)).sum::<f64>() / 8.0).sqrt();
    assert!(rms < 0.4, "{rms}: {:?}", (0..8).map(off).collect::<Vec<_>>());
}

/// A jump of 80 cm, a run and a walk by people outside the models: with all models at hand each gets its own, and then the same fit as
/// with that model alone.
#[test]
fn what_people_do_is_found_by_evidence() {
    let rig = rig();
    let models = Activity::ALL.map(|activity| Model::build(activity, true, &synthetic::database(activity)).unwrap());
    let models = models.each_ref();
    let options = FitOptions { points: 200, rays: 40, deviations: false, ..FitOptions::default() };
    for (k, (activity, parameter)) in [(Activity::Jumping, 0.8), (Activity::Running, 2.6), (Activity::Walking, 1.3)].into_iter().enumerate()
    {
        let subject = synthetic::subject(activity, 1000 + k as u64);
        let (cycle, shape) = (subject.cycle(parameter, 0), subject.shape());
        let length = if activity.is_cyclic() { Length::Seconds(1.2) } else { Length::Cycles(1) };
        let clip = play_cycle(&cycle, &shape.offsets(), 20.0, length);
        let poses = across(&rig, &clip, &shape);
        let seen = staging::longest_run_in_view(&rig, &shape, &poses);
        let frames: Vec<_> = seen.clone().map(|t| (t, t as f64 / 20.0, &poses[t])).collect();
        let observations = observed(&rig, &shape, &frames);
        let found = fit(&observations, &rig, &models, Some(0.0), &options, &|_| true).unwrap();
        println!("{activity}: {:?} of {} frames", found.candidates, frames.len());
        assert_eq!(models[found.model].activity, activity, "{:?}", found.candidates);
        let second = contest::runner_up(&found.candidates).unwrap();
        let costs = [found.model, second].map(|k| found.candidates[k].costs[0]);
        assert!(costs[1] > 1.3 * costs[0], "{activity}: {costs:?}");
        let errors = joint_errors(&positions(found.shape(), &found.poses), &positions(&shape, &poses[seen]));
        // Strangers to the model, who may not leave it here.
        assert!(errors.absolute_m < 0.05 && errors.swapped_over_straight > 2.0, "{activity}: {errors:?}");
        if activity == Activity::Running {
            let alone = fit(&observations, &rig, &[models[found.model]], Some(0.0), &options, &|_| true).unwrap();
            assert_eq!(format!("{:?}", alone.state), format!("{:?}", found.state));
        }
    }
}

/// Points of the skin as seen from the middle of the cameras, exact.
fn exact_points(skin: &PosedSurface, figure: &Figure, eye: &Vector3<f64>, about: &Vector3<f64>) -> Vec<Target> {
    let mut seen = figure.seen_from(eye);
    let grid = (-14..15).flat_map(|i| (-34..35).map(move |k| (0.04 * f64::from(i), 0.028 * f64::from(k))));
    let rays = grid.map(|(x, z)| (about + Vector3::new(x, 0.0, z) - eye).normalize());
    let hit = |ray: Vector3<f64>| {
        let mut along = seen.first_hit(&ray)?;
        for _ in 0..20 {
            let here = skin.evaluate(&(eye + ray * along));
            along -= here.distance() / (here.gradient.normalize().dot(&ray)).min(-0.1);
        }
        let x = eye + ray * along;
        (skin.distance(&x).abs() < 1e-12).then_some(Target::Point { x, covariance: Matrix3::zeros() })
    };
    rays.filter_map(hit).collect()
}

#[test]
fn exact_points_give_exact_weights_when_nothing_else_pulls() {
    let model = model();
    let curve = Curve::new(&model, 10);
    let truth = walker(&curve, 12, 10.0);
    let eye = Vector3::new(0.1, 0.0, 1.1);
    let (surface, offsets) = (Surface::new(&truth.shape), truth.shape.offsets());
    let frame = |t: usize| {
        let placement = place(&offsets, &truth.pose(&curve, t));
        let skin = PosedSurface::new(&surface, &placement);
        let figure = Figure::new(&surface, &offsets, &placement);
        let targets = exact_points(&skin, &figure, &eye, &placement.position(Joint::Root));
        Frame { time_s: 0.1 * t as f64, targets, outsides: Arc::default() }
    };
    let frames: Vec<Frame> = (0..truth.carriers.len()).map(frame).collect();
    assert!(frames.iter().all(|f| f.targets.len() > 100), "{:?}", frames.iter().map(|f| f.targets.len()).collect::<Vec<_>>());
    // Weights so large that the priors, which stay at 1, do not count.
    let none = 1e9;
    let settings = Settings {
        residual: PointResidual::Distance,
        at_skin: true,
        model_m: 0.05,
        point_weight: 1e14,
        ray_weight: 1.0,
        outside_weight: 0.0,
        acceleration: none,
        angular_acceleration: none,
        phase_acceleration: none,
        tilt: none,
        stature: none,
        length: none,
        arm_length: none,
        width: none,
        posture: none,
        wrist: none,
        deviation: none,
        turn_acceleration: none,
    };
    let known = Known { viewpoint: eye, up: Vector3::z(), stature_m: 1.74, floor_m: None };
    let free = Free { rotation: true, phase: true, weights: true, ..Free::default() };
    let mut state = truth.clone();
    state.weights.fill(0.0);
    for carrier in &mut state.carriers {
        carrier.position += Vector3::new(0.01, -0.015, 0.01);
        carrier.phase += 0.01;
    }
    for _ in 0..40 {
        let problem = Problem::new(&curve, &frames, &settings, free, &known, &state);
        state = minimise(problem, state, &LmOptions { max_iterations: 4, relative_cost: 1e-14 }).0;
    }
    for ((found, expected), lambda) in state.weights.iter().zip(&truth.weights).zip(&curve.eigenvalues) {
        assert!((found - expected).abs() < 1e-6 * lambda.sqrt(), "{found} {expected} {}", lambda.sqrt());
    }
}

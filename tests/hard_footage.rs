//! Footage with something wrong in it, through the program: what can be tracked is, with the frames named that were left to their
//! neighbours; the rest is one sentence.

use std::collections::BTreeMap;
use std::fs;
use std::sync::OnceLock;

use crate::common::{half_lab, walk_across};
use assert_cmd::Command;
use image::GrayImage;
use muybridge::body::{Pose, Shape};
use muybridge::io::calib_toml;
use muybridge::io::joints_csv;
use muybridge::phantom::{Scene, Stage, View, mask, render, render_stage};
use muybridge::rig::Rig;
use nalgebra::Vector3;

const FPS: f64 = 15.0;
const FRAMES: usize = 18;

/// A walk before half a lab's pixels, and others before the same stage.
struct Film {
    rig: Rig,
    stages: Vec<GrayImage>,
    /// Per camera, one picture per frame.
    frames: Vec<Vec<GrayImage>>,
    /// The same with a child in the background, and with a second person beside the first.
    child: Vec<Vec<GrayImage>>,
    pair: Vec<Vec<GrayImage>>,
}

fn film() -> &'static Film {
    static FILM: OnceLock<Film> = OnceLock::new();
    FILM.get_or_init(|| {
        let rig = half_lab();
        let (shape, poses) = walk_across(&rig, 7, 1.2, FPS, (FRAMES - 1) as f64 / FPS);
        let middle = poses[FRAMES / 2].root;
        let level = |v: Vector3<f64>| v - rig.up.direction() * v.dot(&rig.up.direction());
        let behind = level(middle - rig.cameras[0].centre()).normalize() * 1.7;
        let ahead = level(poses[FRAMES - 1].root - poses[0].root).normalize() * 0.85;
        let small = Shape::template(1.2);
        let shorter = rig.up.direction() * (small.hip_height_m() - shape.hip_height_m());
        let standing = Pose { root: middle + behind + ahead + shorter, ..poses[0].clone() };
        let path: Vec<_> = poses.iter().map(|p| p.root).chain([standing.root]).collect();
        let stage = Stage::around(&rig, &path);
        let (scene, other) = (Scene::new(stage.clone(), &shape), Scene::new(stage, &small));
        let views: Vec<View> = rig.cameras.iter().enumerate().map(|(k, camera)| View::new(&scene.stage, camera, k)).collect();
        let each = |of: &dyn Fn(&View, usize) -> GrayImage| -> Vec<Vec<GrayImage>> {
            views.iter().map(|view| (0..FRAMES).map(|t| of(view, t)).collect()).collect()
        };
        let over = |front: (&Scene, &Pose), back: GrayImage, view: &View, t: usize| {
            let (body, picture) = (mask(front.0, view, front.1), render(front.0, view, front.1, t));
            GrayImage::from_fn(back.width(), back.height(), |x, y| if body[(x, y)].0[0] > 0 { picture[(x, y)] } else { back[(x, y)] })
        };
        let beside = |t: usize| Pose { root: poses[t].root + ahead * if t < FRAMES / 2 { 1.0 } else { -1.0 }, ..poses[t].clone() };
        Film {
            stages: views.iter().map(|view| render_stage(&scene, view)).collect(),
            frames: each(&|view, t| render(&scene, view, &poses[t], t)),
            child: each(&|view, t| over((&scene, &poses[t]), render(&other, view, &standing, t), view, t)),
            pair: each(&|view, t| over((&scene, &beside(t)), render(&scene, view, &poses[t], t), view, t)),
            rig,
        }
    })
}

/// What `track` said and wrote.
struct Tracked {
    code: i32,
    said: String,
    joints: BTreeMap<usize, Vec<Vector3<f64>>>,
    /// Numbers of the frames without a cloud.
    unseen: Vec<usize>,
}

fn track(frames: &[Vec<GrayImage>]) -> Tracked {
    let place = tempfile::tempdir().unwrap();
    let (session, output) = (place.path().join("walk"), place.path().join("out"));
    fs::create_dir(&session).unwrap();
    calib_toml::write_rig(&session.join("Calib.toml"), &film().rig).unwrap();
    fs::write(session.join("muybridge.toml"), format!("fps = {FPS}\nactivity = \"walking\"\n")).unwrap();
    for (k, camera) in film().rig.cameras.iter().enumerate() {
        fs::create_dir(session.join(&camera.name)).unwrap();
        film().stages[k].save(session.join(format!("{}_background.png", camera.name))).unwrap();
        for (number, frame) in frames[k].iter().enumerate() {
            frame.save(session.join(format!("{}/{number:06}.png", camera.name))).unwrap();
        }
    }
    let done =
        Command::cargo_bin("muybridge").unwrap().arg("track").arg(&session).arg("-o").arg(&output).arg("--no-report").output().unwrap();
    let said = String::from_utf8([done.stdout, done.stderr].concat()).unwrap();
    let code = done.status.code().unwrap();
    if code != 0 {
        let errors = said.lines().filter(|line| line.starts_with("error: ")).count();
        assert!(errors == 1 && !output.exists() && !said.contains("panicked"), "{said}");
        return Tracked { code, said, joints: BTreeMap::new(), unseen: Vec::new() };
    }
    let report: serde_json::Value = serde_json::from_slice(&fs::read(output.join("fit.json")).unwrap()).unwrap();
    let frames = report["frames"].as_array().unwrap();
    let unseen = frames.iter().filter(|f| f["status"] == "no cloud, from its neighbours").map(|f| f["frame"].as_u64().unwrap() as usize);
    let joints = joints_csv::read(&output.join("joints.csv")).unwrap();
    let joints = joints.into_iter().map(|(frame, positions)| (frame, positions.to_vec())).collect();
    Tracked { code, said, joints, unseen: unseen.collect() }
}

fn undisturbed() -> &'static Tracked {
    static TRACKED: OnceLock<Tracked> = OnceLock::new();
    TRACKED.get_or_init(|| track(&film().frames))
}

/// Mean distance of all joints in all frames from those of the undisturbed footage, metres.
fn off_m(tracked: &Tracked) -> f64 {
    assert!(tracked.code == 0 && undisturbed().unseen.is_empty(), "{}", tracked.said);
    assert_eq!(tracked.joints.len(), FRAMES, "{}", tracked.said);
    let pairs = tracked.joints.iter().flat_map(|(t, found)| found.iter().zip(&undisturbed().joints[t]));
    let distances: Vec<f64> = pairs.map(|(a, b)| (a - b).norm()).filter(|d| d.is_finite()).collect();
    let mean = distances.iter().sum::<f64>() / distances.len() as f64;
    println!("{:.1} mm off, {}", 1e3 * mean, tracked.said.lines().last().unwrap_or_default());
    mean
}

fn refused(frames: &[Vec<GrayImage>], parts: &[&str]) {
    let tracked = track(frames);
    assert!(tracked.code == 1 && parts.iter().all(|part| tracked.said.contains(part)), "{parts:?} in {}", tracked.said);
}

/// The pictures of a camera from frame `first` on as under a cap.
fn capped(camera: usize, first: usize) -> Vec<Vec<GrayImage>> {
    let mut frames = film().frames.clone();
    frames[camera][first..].iter_mut().for_each(|picture| picture.fill(1));
    frames
}

#[test]
fn a_camera_that_is_black_is_named() {
    let name = &film().rig.cameras[1].name;
    refused(&capped(1, 0), &[&format!("frame 0: the picture of {name} shows nothing"), "uncover the lens, or leave this camera out"]);
}

#[test]
fn a_camera_that_turns_black_leaves_its_frames_to_their_neighbours() {
    let tracked = track(&capped(2, FRAMES - 5));
    assert!(off_m(&tracked) < 0.04);
    assert_eq!(tracked.unseen, (FRAMES - 5..FRAMES).collect::<Vec<_>>());
    let name = &film().rig.cameras[2].name;
    let said = format!("warning: nothing is taken from 5 of {FRAMES} frames, the first is frame {}: the picture of {name}", FRAMES - 5);
    assert!(tracked.said.contains(&said), "{}", tracked.said);
}

#[test]
fn ten_frames_without_the_person_are_bridged() {
    let mut frames = film().frames.clone();
    for (pictures, stage) in frames.iter_mut().zip(&film().stages) {
        pictures[4..14].fill(stage.clone());
    }
    let tracked = track(&frames);
    assert!(off_m(&tracked) < 0.06);
    assert_eq!(tracked.unseen, (4..14).collect::<Vec<_>>());
}

#[test]
fn somebody_in_the_background_does_not_take_over() {
    assert!(off_m(&track(&film().child)) < 0.02);
}

#[test]
fn two_people_are_told_of() {
    refused(&film().pair, &["frames show two people or more", "keep one person on the stage"]);
}

#[test]
fn a_single_frame_is_one_sentence() {
    let one: Vec<Vec<GrayImage>> = film().frames.iter().map(|pictures| pictures[..1].to_vec()).collect();
    refused(&one, &["too few frames for a motion, 1 where 5 or more are needed; give it the whole sequence"]);
}

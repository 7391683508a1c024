//! `muybridge check` on footage of the phantom with one thing wrong at a time: it names the thing and the remedy.

use crate::common::{half_lab, walk_across};
use assert_cmd::Command;
use image::{GrayImage, Luma, imageops};
use muybridge::footage::check::masks;
use muybridge::footage::epipolar::pair_matches;
use muybridge::footage::misfit::{Change, Fault, diagnose};
use muybridge::footage::person::{Doubt, Person, measure};
use muybridge::io::calib_toml;
use muybridge::motion_model::{Activity, synthetic};
use muybridge::phantom::{Scene, Stage, View, render, render_stage};
use muybridge::rig::{Camera, Rig, Up};
use nalgebra::{Rotation3, Vector3};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

const FPS: f64 = 30.0;
const SUBJECT: u64 = 7;
const FRAMES: usize = 14;
/// Poses per frame; camera 2 is also filmed one of them late.
const PARTS: usize = 4;

/// A walk before a small lab rig.
struct Footage {
    rig: Rig,
    stages: Vec<GrayImage>,
    /// Per camera, one picture per frame.
    frames: Vec<Vec<GrayImage>>,
    /// Camera 2 at a quarter of a frame after its frames.
    late: Vec<GrayImage>,
}

fn footage() -> &'static Footage {
    static FOOTAGE: OnceLock<Footage> = OnceLock::new();
    FOOTAGE.get_or_init(film)
}

fn film() -> Footage {
    let rig = half_lab();
    let (shape, poses) = walk_across(&rig, SUBJECT, 1.3, FPS * PARTS as f64, FRAMES as f64 / FPS);
    let path: Vec<_> = poses.iter().map(|p| p.root).collect();
    let scene = Scene::new(Stage::around(&rig, &path), &shape);
    let views: Vec<View> = rig.cameras.iter().enumerate().map(|(k, camera)| View::new(&scene.stage, camera, k)).collect();
    let take = |view: &View, part: usize| (0..FRAMES).map(|k| render(&scene, view, &poses[PARTS * k + part], PARTS * k + part)).collect();
    Footage {
        stages: views.iter().map(|view| render_stage(&scene, view)).collect(),
        frames: views.iter().map(|view| take(view, 0)).collect(),
        late: take(&views[2], 1),
        rig,
    }
}

/// A copy of the footage that a test may spoil.
#[derive(Clone)]
struct Take {
    rig: Rig,
    stages: Vec<GrayImage>,
    frames: Vec<Vec<GrayImage>>,
}

fn take() -> Take {
    let f = footage();
    Take { rig: f.rig.clone(), stages: f.stages.clone(), frames: f.frames.clone() }
}

impl Take {
    /// Changes every picture of a camera.
    fn change(mut self, camera: usize, change: impl Fn(&GrayImage) -> GrayImage) -> Take {
        self.stages[camera] = change(&self.stages[camera]);
        self.frames[camera].iter_mut().for_each(|frame| *frame = change(frame));
        self
    }

    fn cameras(mut self, change: impl Fn(usize, &mut Camera)) -> Take {
        self.rig.cameras.iter_mut().enumerate().for_each(|(k, camera)| change(k, camera));
        self
    }

    /// Exit code, and all that was said.
    fn check(&self) -> (i32, String) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("walk");
        fs::create_dir(&path).unwrap();
        calib_toml::write_rig(&path.join("Calib.toml"), &self.rig).unwrap();
        fs::write(path.join("muybridge.toml"), format!("fps = {FPS}\n")).unwrap();
        for (k, camera) in self.rig.cameras.iter().enumerate() {
            fs::create_dir(path.join(&camera.name)).unwrap();
            put(&self.stages[k], &path.join(format!("{}_background.png", camera.name)));
            for (number, frame) in self.frames[k].iter().enumerate() {
                put(frame, &path.join(format!("{}/{number:06}.png", camera.name)));
            }
        }
        let output = Command::cargo_bin("muybridge").unwrap().arg("check").arg(&path).output().unwrap();
        (output.status.code().unwrap(), String::from_utf8([output.stdout, output.stderr].concat()).unwrap())
    }

    fn refused(&self, parts: &[&str]) {
        let (code, text) = self.check();
        let errors: Vec<_> = text.lines().filter(|l| l.starts_with("error: ")).collect();
        assert!(code == 1 && errors.len() == 1 && parts.iter().all(|part| errors[0].contains(part)), "{parts:?} in {text}");
    }

    fn warned(&self, parts: &[&str]) -> String {
        let (code, text) = self.check();
        let warned = |part: &&str| text.lines().any(|l| l.starts_with("warning: ") && l.contains(*part));
        assert!(code == 0 && parts.iter().all(warned) && text.contains("usable, with these warnings"), "{parts:?} in {text}");
        text
    }

    fn ready(&self) {
        let (code, text) = self.check();
        assert!(code == 0 && text.contains("\nready\n") && !text.contains("warning"), "{text}");
    }
}

/// A picture as a file; those of the good footage are written once and linked.
fn put(image: &GrayImage, path: &Path) {
    static WRITTEN: OnceLock<Vec<(&GrayImage, PathBuf)>> = OnceLock::new();
    let written = WRITTEN.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("check");
        fs::create_dir_all(&folder).unwrap();
        let all = footage().frames.iter().flatten().chain(&footage().stages).chain(&footage().late);
        let written: Vec<_> = all.enumerate().map(|(k, image)| (image, folder.join(format!("{k}.png")))).collect();
        written.iter().for_each(|(image, path)| image.save(path).unwrap());
        written
    });
    match written.iter().find(|(known, _)| *known == image) {
        Some((_, file)) => std::os::unix::fs::symlink(file, path).unwrap(),
        None => image.save(path).unwrap(),
    }
}

fn turn(camera: &mut Camera, axis_deg: [f64; 3]) {
    let turn = Rotation3::from_scaled_axis(Vector3::from(axis_deg) * 1f64.to_radians());
    camera.camera_from_world = turn * camera.camera_from_world;
    camera.translation = turn * camera.translation;
}

/// Offset and standard deviation of a camera from the page.
fn offset(text: &str, camera: &str) -> (f64, f64) {
    let line =
        text.lines().find(|l| l.starts_with(camera) && l.ends_with(" frames") && l.contains(" +- ")).unwrap_or_else(|| panic!("{text}"));
    let (frames, sigma) = line[camera.len() + 1..line.len() - 7].split_once(" +- ").unwrap();
    (frames.trim().parse().unwrap(), sigma.parse().unwrap())
}

#[test]
fn good_footage_is_ready_under_any_exposure() {
    take().ready();
    take()
        .change(1, |i| GrayImage::from_fn(i.width(), i.height(), |x, y| Luma([(f64::from(i.get_pixel(x, y).0[0]) * 1.3).min(255.0) as u8])))
        .ready();
}

#[test]
fn a_turned_camera_is_named_with_its_angle() {
    take()
        .cameras(|k, c| {
            if k == 2 {
                turn(c, [0.5, 0.6, 0.2])
            }
        })
        .refused(&["cam_02 is turned by 0.8 degrees (or moved) against the calibration: calibrate again"]);
    take()
        .cameras(|k, c| {
            if k == 1 {
                turn(c, [0.3, 0.0, 0.0])
            }
        })
        .warned(&["cam_01 is turned by 0.3 degrees"]);
}

#[test]
fn turns_are_measured() {
    for (k, axis_deg) in [(0, [0.0, 0.9, 0.4]), (1, [2.0, -1.0, 0.5]), (2, [0.0, 0.0, 5.0])] {
        let mut rig = footage().rig.clone();
        turn(&mut rig.cameras[k], axis_deg);
        let found = diagnose(&rig, &footage().stages).unwrap().unwrap();
        let Fault::Turned { cameras, angle_deg } = &found else { panic!("{found:?}") };
        let expected = Vector3::from(axis_deg).norm();
        assert!(cameras[0] == k && (angle_deg - expected).abs() < 0.1 + 0.03 * expected, "{axis_deg:?}: {found:?}");
    }
    assert_eq!(diagnose(&footage().rig, &footage().stages).unwrap(), None);
}

#[test]
fn a_rig_that_no_single_camera_explains_is_called_wrong() {
    let wrong = take().cameras(|k, c| turn(c, [[1.5, 0.0, 4.0], [-2.0, 1.0, 0.0], [0.0, -3.0, -4.0]][k]));
    wrong.refused(&["the calibration does not fit these pictures", "is this Calib.toml of this rig"]);
}

#[test]
fn exchanged_pictures_are_named() {
    let order = |order: [usize; 3]| {
        let all = take();
        Take { stages: order.map(|k| all.stages[k].clone()).to_vec(), frames: order.map(|k| all.frames[k].clone()).to_vec(), ..all }
    };
    order([1, 0, 2]).refused(&["the pictures of cam_00 and cam_01 are exchanged; rename cam_00 to cam_01 and cam_01 to cam_00"]);
    let cycle = diagnose(&footage().rig, &order([1, 2, 0]).stages).unwrap();
    assert_eq!(cycle, Some(Fault::Permuted { seen_by: vec![1, 2, 0] }));
}

#[test]
fn mirrored_and_rotated_pictures_are_named() {
    let changed = |camera: Option<usize>, change: fn(&GrayImage) -> GrayImage| {
        let mut stages = footage().stages.clone();
        stages.iter_mut().enumerate().filter(|(k, _)| camera.is_none_or(|c| c == *k)).for_each(|(_, s)| *s = change(s));
        diagnose(&footage().rig, &stages).unwrap()
    };
    let found = |camera, change| Some(Fault::Changed { camera, change });
    assert_eq!(changed(Some(1), imageops::flip_horizontal), found(Some(1), Change::Mirrored));
    assert_eq!(changed(Some(0), imageops::flip_vertical), found(Some(0), Change::Flipped));
    assert_eq!(changed(Some(2), imageops::rotate180), found(Some(2), Change::Rotated(2)));
    assert_eq!(changed(None, imageops::flip_horizontal), found(None, Change::Mirrored));
}

#[test]
fn quarter_turns_of_square_pictures_are_named() {
    let mut rig = footage().rig.clone();
    let [width, height] = rig.cameras[0].size_px;
    let left = (width - height) / 2;
    rig.cameras.iter_mut().for_each(|c| {
        c.size_px = [height, height];
        c.matrix[(0, 2)] -= f64::from(left);
    });
    let square = |image: &GrayImage| imageops::crop_imm(image, left, 0, height, height).to_image();
    let mut stages: Vec<_> = footage().stages.iter().map(square).collect();
    assert_eq!(diagnose(&rig, &stages).unwrap(), None);
    stages[1] = imageops::rotate90(&stages[1]);
    assert_eq!(diagnose(&rig, &stages).unwrap(), Some(Fault::Changed { camera: Some(1), change: Change::Rotated(1) }));
    stages[1] = imageops::rotate180(&stages[1]);
    assert_eq!(diagnose(&rig, &stages).unwrap(), Some(Fault::Changed { camera: Some(1), change: Change::Rotated(3) }));
}

#[test]
fn a_view_without_texture_is_named() {
    let noise = |x: u32, y: u32| ((x * x * 31 + y * y * 17 + x * y * 7) % 5) as u8;
    take()
        .change(1, |i| GrayImage::from_fn(i.width(), i.height(), |x, y| Luma([2 + noise(x, y)])))
        .refused(&["cam_01: shows nothing but an even grey", "lens cap"]);
    let blurred = take().change(2, |i| imageops::blur(i, 4.0));
    let (_, text) = blurred.check();
    assert!(text.contains("cam_02: shows ") && text.contains("of the detail that the other cameras see; focus its lens"), "{text}");
}

#[test]
fn a_late_camera_is_measured_and_refused_above_half_a_frame() {
    let mut late = take();
    late.frames[1].drain(..3);
    late.frames[0].truncate(FRAMES - 3);
    late.frames[2].truncate(FRAMES - 3);
    late.refused(&["cam_01: its pictures were taken 3.0", " ms) after", "cut the first 3 frames of cam_00 and cam_02"]);
    let mut quarter = take();
    quarter.frames[2] = footage().late.clone();
    let mut early = quarter.clone();
    early.frames[2].pop();
    early.frames[..2].iter_mut().for_each(|frames| drop(frames.remove(0)));
    early.refused(&["cam_02: its pictures were taken 0.7", "before", "cut the first frame of cam_02"]);
    let text = quarter.warned(&["cam_02: its pictures were taken 0.2"]);
    for (camera, expected) in [("cam_00:", 0.0), ("cam_01:", 0.0), ("cam_02:", 0.25)] {
        let (frames, sigma) = offset(&text, camera);
        assert!((frames - expected).abs() < 0.03 + 3.0 * sigma && sigma < 0.05, "{camera} {frames} +- {sigma}");
    }
}

#[test]
fn footage_without_motion_tells_no_times() {
    let mut still = take();
    still.frames.iter_mut().for_each(|frames| {
        frames.drain(1..);
        frames.extend(vec![frames[0].clone(); 7]);
    });
    still.warned(&["nothing moves in these pictures", "cam_01: the motion does not tell when its pictures were taken"]);
}

/// The person as the rig sees them at some instants.
fn person(rig: &Rig) -> Person {
    let sets: Vec<Vec<GrayImage>> = [3, 6, 9].map(|k| footage().frames.iter().map(|frames| frames[k].clone()).collect()).to_vec();
    let masks: Vec<_> = sets.iter().map(|set| masks(set, &footage().stages)).collect();
    let borrowed: Vec<&[GrayImage]> = sets.iter().map(Vec::as_slice).collect();
    measure(rig, &pair_matches(rig, &borrowed, Some(&masks)), &masks).unwrap()
}

#[test]
fn wrong_units_show_on_the_person() {
    let right = person(&footage().rig);
    let stature_m = synthetic::subject(Activity::Walking, SUBJECT).stature_m;
    assert!((right.height_m - stature_m).abs() < 0.06 * stature_m && right.feet_m.abs() < 0.12, "{right:?}");
    assert_eq!(right.doubt(&footage().rig), None);
    for (factor, expected) in [(0.1, 10.0), (10.0, 0.1), (1.0 / 0.3048, 0.3048)] {
        let rig = take().cameras(|_, c| c.translation *= factor).rig;
        let Some(Doubt::Units { height_m, scale }) = person(&rig).doubt(&rig) else { panic!("{factor}") };
        assert!(scale == expected && (height_m - factor * right.height_m).abs() < 0.02 * height_m, "{factor}: {height_m} {scale}");
    }
    take().cameras(|_, c| c.translation *= 0.1).refused(&["the person would be 0.1", "rig convert --scale 10"]);
}

#[test]
fn wrong_up_axes_show_on_the_person() {
    // The same rig in a world turned about x.
    let world = |deg: f64| take().cameras(|_, c| c.camera_from_world *= Rotation3::from_scaled_axis(Vector3::x() * -deg.to_radians())).rig;
    let doubt = |rig: &Rig| person(rig).doubt(rig);
    assert_eq!(doubt(&world(-90.0)), Some(Doubt::Up { axis: 1, positive: true }));
    assert_eq!(doubt(&world(90.0)), Some(Doubt::Up { axis: 1, positive: false }));
    assert_eq!(doubt(&world(180.0)), Some(Doubt::UpsideDown));
    assert_eq!(doubt(&Rig { up: Up::Y, ..world(-90.0) }), None);
    let wrong = Take { rig: world(-90.0), ..take() };
    wrong.refused(&["the person stands along the world's y axis but z is up", "write up = \"y\" under [metadata]"]);
}

#[test]
fn real_sessions_are_ready() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/footage");
    if !data.exists() {
        println!("skipped: no {}", data.display());
        return;
    }
    for session in fs::read_dir(&data).unwrap().map(|e| e.unwrap().path()).filter(|p| p.is_dir()) {
        let output = Command::cargo_bin("muybridge").unwrap().args(["check", session.to_str().unwrap()]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && text.ends_with("\nready\n") && !text.contains("warning"), "{text}");
        for camera in ["cam_00:", "cam_01:", "cam_02:"] {
            let (frames, sigma) = offset(&text, camera);
            assert!(frames.abs() < 0.02 + 3.0 * sigma && sigma < 0.05, "{}: {camera} {frames} +- {sigma}", session.display());
        }
    }
}

//! `muybridge check` on footage of the phantom with one thing wrong at a time: it names the thing and the remedy.

use assert_cmd::Command;
use image::{GrayImage, Luma, imageops};
use muybridge::footage::misfit::{Change, Fault, diagnose};
use muybridge::io::calib_toml;
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, synthetic};
use muybridge::phantom::{Scene, Stage, View, render, render_stage, staging};
use muybridge::rig::{Camera, Rig, Up};
use nalgebra::{Rotation3, Vector3};
use std::fs;
use std::path::Path;
use std::sync::OnceLock;

const FPS: f64 = 30.0;
const FRAMES: usize = 16;
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
    let mut rig = calib_toml::read_rig(&Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml")).unwrap();
    rig.cameras.iter_mut().for_each(halve);
    let subject = synthetic::subject(Activity::Walking, 7);
    let (shape, fps) = (subject.shape(), FPS * PARTS as f64);
    let clip = play_cycle(&subject.cycle(1.3, 0), &shape.offsets(), fps, Length::Seconds(FRAMES as f64 / FPS));
    let heading = staging::crossing_heading(&rig);
    let start = staging::cross_the_view(&rig, &clip, &shape, heading).unwrap();
    let poses = staging::poses_in_world(&clip, &shape, rig.up, start, heading);
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

/// The camera with pictures of half the size.
fn halve(camera: &mut Camera) {
    camera.size_px = camera.size_px.map(|s| s / 2);
    for (row, column) in [(0, 0), (1, 1), (0, 2), (1, 2)] {
        camera.matrix[(row, column)] /= 2.0;
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
            self.stages[k].save(path.join(format!("{}_background.png", camera.name))).unwrap();
            for (number, frame) in self.frames[k].iter().enumerate() {
                frame.save(path.join(format!("{}/{number:06}.png", camera.name))).unwrap();
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

    fn warned(&self, part: &str) {
        let (code, text) = self.check();
        assert!(code == 0 && text.lines().any(|l| l.starts_with("warning: ") && l.contains(part)), "{part} in {text}");
        assert!(text.contains("usable, with these warnings"), "{text}");
    }

    fn ready(&self) {
        let (code, text) = self.check();
        assert!(code == 0 && text.contains("\nready\n") && !text.contains("warning"), "{text}");
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
                turn(c, [0.25, 0.0, 0.0])
            }
        })
        .warned("cam_01 is turned by 0.2 degrees");
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
    order([1, 2, 0]).refused(&["mixed up; rename cam_00 to cam_01, cam_01 to cam_02, cam_02 to cam_00"]);
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
    take().change(1, imageops::flip_horizontal).refused(&["the pictures of cam_01 are mirrored left to right"]);
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
    late.refused(&["cam_01: its pictures were taken ", " frames (100 ms) after", "cut the first 3 frames of cam_00 and cam_02"]);
    let mut quarter = take();
    quarter.frames[2] = footage().late.clone();
    let mut early = quarter.clone();
    early.frames[2].pop();
    early.frames[..2].iter_mut().for_each(|frames| drop(frames.remove(0)));
    early.refused(&["cam_02: its pictures were taken 0.7", "before", "cut the first frame of cam_02"]);
    quarter.warned("cam_02: its pictures were taken 0.2");
    let text = quarter.check().1;
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
    still.warned("nothing moves in these pictures");
    still.warned("cam_01: the motion does not tell when its pictures were taken");
}

#[test]
fn wrong_units_and_axes_show_on_the_person() {
    let scaled = |factor: f64| take().cameras(|_, c| c.translation *= factor);
    scaled(0.1).refused(&["the person would be 0.1", "rig convert --scale 10"]);
    scaled(10.0).refused(&["the person would be 1", "rig convert --scale 0.1"]);
    // The same rig in a world turned by `turn`.
    let world = |turn: Rotation3<f64>| take().cameras(|_, c| c.camera_from_world *= turn.inverse());
    let about_x = |deg: f64| Rotation3::from_scaled_axis(Vector3::x() * deg.to_radians());
    world(about_x(-90.0)).refused(&["the person stands along the world's y axis but z is up", "write up = \"y\" under [metadata]"]);
    world(about_x(90.0)).refused(&["the person stands along the world's -y axis", "calibrate with a board on the floor"]);
    world(about_x(180.0)).refused(&["the person stands on their head", "z axis points down"]);
    let mut y_up = world(about_x(-90.0));
    y_up.rig.up = Up::Y;
    y_up.ready();
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

//! A study of short sessions of a phantom, and the program run on it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use muybridge::body::Shape;
use muybridge::io::{bvh, calib_toml};
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, synthetic};
use muybridge::rig::Rig;

pub const FRAMES: usize = 6;
/// As small as a person can be followed in.
const SCALE: f64 = 0.25;

pub fn muybridge(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_muybridge"));
    command.args(arguments).stdin(Stdio::null());
    command
}

pub fn succeed(arguments: &[&str]) -> String {
    let output = muybridge(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The phantom's rig with smaller pictures.
fn small_rig() -> Rig {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml");
    let mut rig = calib_toml::read_rig(&path).unwrap();
    for camera in &mut rig.cameras {
        camera.size_px = camera.size_px.map(|s| (f64::from(s) * SCALE) as u32);
        for (row, column) in [(0, 0), (1, 1)] {
            camera.matrix[(row, column)] *= SCALE;
        }
        for row in [0, 1] {
            camera.matrix[(row, 2)] = (camera.matrix[(row, 2)] + 0.5) * SCALE - 0.5;
        }
    }
    rig
}

/// Footage of somebody walking to cut sessions from, and a model file beside it; made once for all tests.
pub static FILM: LazyLock<PathBuf> = LazyLock::new(|| {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("study-{}", std::process::id()));
    let film = folder.join("film");
    let subject = synthetic::subject(Activity::Walking, 7);
    let length = Length::Seconds((FRAMES + 3) as f64 / 12.0);
    let clip = play_cycle(&subject.cycle(1.3, 0), &Shape::template(1.7).offsets(), 12.0, length);
    bvh::write_clip(&folder.join("walk.bvh"), &clip, None).unwrap();
    calib_toml::write_rig(&folder.join("rig.toml"), &small_rig()).unwrap();
    succeed(&["render", text(&folder.join("walk.bvh")), "--rig", text(&folder.join("rig.toml")), "--fps", "12", "-o", text(&film)]);
    succeed(&["model", "synthetic", "--activity", "walking", "-o", text(&film.join("walking.npz"))]);
    film
});

/// A session of the film's frames from `first` on.
pub fn cut(first: usize, session: &Path) {
    for camera in ["cam_00", "cam_01", "cam_02"] {
        fs::create_dir_all(session.join(camera)).unwrap();
        let background = format!("{camera}_background.png");
        fs::copy(FILM.join(&background), session.join(&background)).unwrap();
        for frame in first..first + FRAMES {
            let name = format!("{camera}/{frame:06}.png");
            fs::copy(FILM.join(&name), session.join(&name)).unwrap();
        }
    }
    fs::copy(FILM.join("Calib.toml"), session.join("Calib.toml")).unwrap();
}

/// A study whose model and frame rate stand in its own `muybridge.toml`.
pub fn study(folder: &Path, sessions: &[&str]) -> PathBuf {
    let study = folder.join("study");
    for (first, name) in sessions.iter().enumerate() {
        cut(first, &study.join(name));
    }
    fs::create_dir(study.join("models")).unwrap();
    fs::copy(FILM.join("walking.npz"), study.join("models/walking.npz")).unwrap();
    fs::write(study.join("muybridge.toml"), "fps = 12\nmodel = \"models/walking.npz\"\n").unwrap();
    study
}

pub fn batch(study: &Path, results: &Path, more: &[&str]) -> Output {
    muybridge(&["batch", text(study), "-o", text(results), "--threads", "2"]).args(more).output().unwrap()
}

pub fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

pub fn status(results: &Path, session: &str) -> serde_json::Value {
    serde_json::from_slice(&fs::read(results.join(session).join("status.json")).unwrap()).unwrap()
}

pub fn state(results: &Path, session: &str) -> String {
    status(results, session)["state"].as_str().unwrap().to_string()
}

/// All files that must not depend on when and how often a batch ran: all but states, logs and what is in work.
pub fn outputs(results: &Path) -> BTreeMap<String, Vec<u8>> {
    let name = |path: &Path| path.strip_prefix(results).unwrap().to_str().unwrap().to_string();
    let named = files_below(results).into_iter().map(|path| (name(&path), path));
    let compared = named.filter(|(name, _)| !name.starts_with(".work/") && !name.starts_with("logs/") && !name.ends_with("status.json"));
    compared.map(|(name, path)| (name, fs::read(path).unwrap())).collect()
}

/// Waits until `done` or fails after a time that only a hang takes.
pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    for _ in 0..6000 {
        if done() {
            return;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    panic!("{what} takes forever");
}

/// All files below a folder.
pub fn files_below(folder: &Path) -> Vec<PathBuf> {
    let entries = folder.read_dir().unwrap().map(|e| e.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

//! What several test files have in common.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
use muybridge::body::{Clip, Pose, Shape};
use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::{calib_toml, read_clip};
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, Cycle, Label, segment, synthetic};
use muybridge::phantom::staging;
use muybridge::rig::Rig;
use rayon::prelude::*;

/// A folder of the recordings beside the project; `None`, said, where they are not.
pub fn mocap(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap").join(folder);
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
    }
    path.exists().then_some(path)
}

/// The cycles of one recording, named after its file; none where it is a pose of one frame or cannot be cut.
pub fn cut(entry: &Entry, activity: Activity) -> Vec<Cycle> {
    let read = match read_clip(&entry.path) {
        Err(error) if error.to_string().contains("one frame is no motion") => return Vec::new(),
        read => read.unwrap(),
    };
    let label = Label {
        subject: entry.subject.clone(),
        source: entry.path.file_stem().unwrap().to_string_lossy().into_owned(),
        activity,
        parameter: entry.parameter,
        start_s: entry.start_s,
        end_s: entry.end_s,
    };
    segment(&read.clip, &label).map(|s| s.cycles).unwrap_or_default()
}

/// The cycles of all recordings in a folder beside the project; `None`, said, where it is not.
pub fn cycles(folder: &str, activity: Activity) -> Option<Vec<Cycle>> {
    Some(find_motions(&[mocap(folder)?], None).unwrap().par_iter().flat_map(|entry| cut(entry, activity)).collect())
}

/// The phantom's lab with pictures of half the size.
pub fn half_lab() -> Rig {
    let mut rig = calib_toml::read_rig(&Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml")).unwrap();
    for camera in &mut rig.cameras {
        camera.size_px = camera.size_px.map(|s| s / 2);
        [(0, 0), (1, 1), (0, 2), (1, 2)].into_iter().for_each(|at| camera.matrix[at] /= 2.0);
    }
    rig
}

/// A synthetic person's walk across the view of a rig, in the rig's world.
pub fn walk_across(rig: &Rig, person: u64, speed_m_s: f64, fps: f64, seconds: f64) -> (Shape, Vec<Pose>) {
    let subject = synthetic::subject(Activity::Walking, person);
    let shape = subject.shape();
    let clip = play_cycle(&subject.cycle(speed_m_s, 0), &shape.offsets(), fps, Length::Seconds(seconds));
    let poses = across(rig, &clip, &shape);
    (shape, poses)
}

/// The poses of a motion across the view of a rig, in the rig's world.
pub fn across(rig: &Rig, clip: &Clip, shape: &Shape) -> Vec<Pose> {
    let heading = staging::crossing_heading(rig);
    let start = staging::cross_the_view(rig, clip, shape, heading).unwrap();
    staging::poses_in_world(clip, shape, rig.up, start, heading)
}

/// Runs the program: whether it succeeded, what it said, what it complained of.
pub fn run(arguments: &[&str]) -> (bool, String, String) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.success(), text(&output.stdout), text(&output.stderr))
}

/// A file of a folder as an argument.
pub fn path(folder: &Path, name: &str) -> String {
    folder.join(name).to_string_lossy().into_owned()
}

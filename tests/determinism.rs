//! The same input gives the same bytes, every time and with any number of threads.

use std::collections::BTreeMap;
use std::path::Path;

use assert_cmd::Command;
use muybridge::body::Shape;
use muybridge::io::{bvh, calib_toml};
use muybridge::motion::{Length, play, synthesize};
use muybridge::motion_model::{Activity, Model, synthetic};
use muybridge::style::{Method, Population, Style};

fn run(arguments: &[&str]) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Content of every file of a folder by name.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = folder.read_dir().unwrap().map(|e| e.unwrap().path());
    entries.map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(&path).unwrap())).collect()
}

/// Runs `command -o OUT` with one and with four threads; the files must agree. The first lot is returned.
fn same_with_any_number_of_threads(folder: &Path, command: &[&str]) -> BTreeMap<String, Vec<u8>> {
    let [one, four] = ["1", "4"].map(|threads| {
        let output = folder.join(format!("{}_{threads}", command[0]));
        run(&[&["--threads", threads], command, &["-o", output.to_str().unwrap()]].concat());
        files(&output)
    });
    assert!(one.keys().eq(four.keys()) && one.len() > 1, "{:?} {:?}", one.keys(), four.keys());
    for (name, bytes) in &one {
        assert!(four[name] == *bytes && !bytes.is_empty(), "{name} differs");
    }
    one
}

/// Two cycles of a synthetic person at each speed, as motion files.
fn recordings(folder: &Path, people: &[u64], speeds_m_s: &[f64]) {
    let model = Model::build(Activity::Walking, true, &synthetic::database(Activity::Walking)).unwrap();
    let population = Population::new(&model, model.components(0.9));
    let shape = Shape::template(1.7);
    for person in people {
        for speed_m_s in speeds_m_s {
            let cycle = synthetic::subject(Activity::Walking, *person).cycle(*speed_m_s, 0);
            let style = Style::of_cycles(&model, "", &[cycle]).unwrap();
            let synthesis = synthesize(&model, &population, Method::Default, &style, *speed_m_s, shape.hip_height_m()).unwrap();
            let clip = play(&model, &synthesis, &shape.offsets(), 60.0, Length::Cycles(4));
            bvh::write_clip(&folder.join(format!("p{person}/walk_{speed_m_s:.1}.bvh")), &clip, None).unwrap();
        }
    }
}

#[test]
fn a_model_built_from_motion_files_does_not_depend_on_threads() {
    let dir = tempfile::tempdir().unwrap();
    let mocap = dir.path().join("mocap");
    recordings(&mocap, &[31, 32, 33], &[0.9, 1.3]);
    let built = ["1", "4", "4"].map(|threads| {
        let path = dir.path().join("model.npz");
        let [mocap, file] = [&mocap, &path].map(|p| p.to_str().unwrap());
        run(&["--threads", threads, "model", "build", mocap, "--activity", "walking", "-o", file]);
        std::fs::read(path).unwrap()
    });
    assert!(built[0] == built[1] && built[1] == built[2]);
}

#[test]
fn the_embedded_models_are_the_same_bytes_every_time() {
    let dir = tempfile::tempdir().unwrap();
    for activity in ["walking", "running", "jumping"] {
        let written = ["1", "4"].map(|threads| {
            let path = dir.path().join("model.npz");
            run(&["--threads", threads, "model", "synthetic", "--activity", activity, "-o", path.to_str().unwrap()]);
            std::fs::read(path).unwrap()
        });
        assert!(written[0] == written[1], "{activity}");
    }
}

/// A walk of 12 frames before the lab's rig at half its resolution.
#[test]
fn clouds_and_tracks_do_not_depend_on_threads() {
    let dir = tempfile::tempdir().unwrap();
    recordings(dir.path(), &[41], &[1.2]);
    let mut rig = calib_toml::read_rig(&Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml")).unwrap();
    for camera in &mut rig.cameras {
        camera.size_px = camera.size_px.map(|n| n / 2);
        // Integer pixels are pixel centres: two of the old pixels share one new.
        for (axis, c) in [(0, (0, 2)), (1, (1, 2))] {
            camera.matrix[(axis, axis)] *= 0.5;
            camera.matrix[c] = (camera.matrix[c] + 0.5) / 2.0 - 0.5;
        }
    }
    let [calib, motion, session] = ["rig.toml", "p41/walk_1.2.bvh", "walk"].map(|name| dir.path().join(name));
    calib_toml::write_rig(&calib, &rig).unwrap();
    let [calib, motion, walk] = [&calib, &motion, &session].map(|p| p.to_str().unwrap());
    run(&["render", motion, "--rig", calib, "--fps", "15", "--from", "0.5", "--to", "1.25", "-o", walk]);
    let clouds = same_with_any_number_of_threads(dir.path(), &["clouds", walk]);
    assert_eq!(clouds.len(), 12);
    let tracked = same_with_any_number_of_threads(dir.path(), &["track", walk]);
    assert!(["fit.json", "joints.csv", "motion.bvh", "style.json"].iter().all(|name| tracked.contains_key(*name)));
}

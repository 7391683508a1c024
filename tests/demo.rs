//! `muybridge demo` as a newcomer runs it, on a short take: its errors, its files, the same figures with any number of threads.

use std::collections::HashMap;
use std::path::Path;

use assert_cmd::Command;

/// Runs the demo on 20 frames: two thirds of a second, a little more than one step.
fn demo(output: &Path, threads: &str) -> (bool, String, String) {
    let mut command = Command::cargo_bin("muybridge").unwrap();
    let done = command.args(["demo", "--frames", "20", "--threads", threads, "-o"]).arg(output).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (done.status.success(), text(&done.stdout), text(&done.stderr))
}

/// Values of errors.csv by quantity, and the values beside them by quantity and name.
fn errors(csv: &str) -> (HashMap<String, f64>, HashMap<(String, String), f64>) {
    let (mut values, mut beside) = (HashMap::new(), HashMap::new());
    for line in csv.lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        values.insert(fields[0].to_string(), fields[1].parse().unwrap());
        if !fields[3].is_empty() {
            beside.insert((fields[0].to_string(), fields[3].to_string()), fields[4].parse().unwrap());
        }
    }
    (values, beside)
}

/// Speed over the floor of a BVH, and its frames per second, from its text alone.
fn speed_and_rate(bvh: &Path) -> (f64, f64) {
    let text = std::fs::read_to_string(bvh).unwrap();
    let motion: Vec<&str> = text.split("MOTION").nth(1).unwrap().lines().filter(|l| !l.trim().is_empty()).collect();
    let frame_s: f64 = motion[1].trim_start_matches("Frame Time:").trim().parse().unwrap();
    let root = |line: &str| -> Vec<f64> { line.split_whitespace().take(3).map(|v| v.parse().unwrap()).collect() };
    let (first, last) = (root(motion[2]), root(motion[motion.len() - 1]));
    (((last[0] - first[0]).powi(2) + (last[2] - first[2]).powi(2)).sqrt() / (frame_s * (motion.len() - 3) as f64), 1.0 / frame_s)
}

#[test]
fn the_whole_job_ends_near_the_truth_and_does_not_depend_on_threads() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("demo");
    let (done, table, progress) = demo(&output, "2");
    assert!(done, "{progress}");
    assert!(table.contains("seconds per stage") && table.contains("pictures/overlay_cam_00.png") && progress.contains("fit: done in"));

    let csv = std::fs::read_to_string(output.join("errors.csv")).unwrap();
    let (values, beside) = errors(&csv);
    let value = |quantity: &str| values[quantity];
    let other = |quantity: &str, name: &str| beside[&(quantity.to_string(), name.to_string())];
    assert!(value("cloud to true skin; median") < 6.0, "{csv}");
    assert!(value("cloud points over 50 mm off the body") < 1.0, "{csv}");
    // The mean motion at the right place misses these by far: see the row of the average person.
    let joints = "joints; pelvis moved together";
    assert!(value("joints; absolute") < 30.0 && value(joints) < 30.0, "{csv}");
    assert!(value(joints) < other("at 5 km/h; joints", "average person"), "{csv}");
    assert!(value("hip angle") < 3.0 && value("knee angle") < 5.0, "{csv}");
    assert!(value("legs; error with sides exchanged over own") > 5.0, "{csv}");
    assert!(value("phase") < 0.05 && value("speed") < 3.0 && value("cadence") < 5.0, "{csv}");
    assert!(value("height") < 25.0 && value("hip height") < 25.0, "{csv}");
    let weights = "weights; equation (6)";
    assert!(value(weights) < 0.7 * other(weights, "to other people"), "{csv}");
    for kmh in [3, 4, 5, 6, 7] {
        let [angles, joints] = ["angles", "joints"].map(|what| format!("at {kmh} km/h; {what}"));
        assert!(value(&joints) < 0.85 * other(&joints, "average person"), "{csv}");
        // What footage and fit add to the error of generating from the truth itself.
        assert!(value(&angles) < other(&angles, "true style") + 2.0 && value(&angles) < 0.65 * other(&angles, "average person"), "{csv}");
        let (speed, fps) = speed_and_rate(&output.join(format!("generated/walking_{kmh}kmh.bvh")));
        assert!((speed * 3.6 / f64::from(kmh) - 1.0).abs() < 0.01 && (fps - 60.0).abs() < 0.01, "{kmh}: {speed} {fps}");
    }

    for name in ["overlay_cam_00", "cloud", "phase", "root", "weights", "depth", "angles", "speeds"] {
        let picture = std::fs::read(output.join(format!("pictures/{name}.png"))).unwrap();
        assert!(picture.starts_with(b"\x89PNG") && picture.len() > 5000, "{name}");
    }
    for name in ["table.txt", "clouds/000010.ply", "track/motion.bvh", "track/joints.csv", "track/style.json", "session/Calib.toml"] {
        assert!(output.join(name).exists(), "{name}");
    }
    assert!(table.contains(&std::fs::read_to_string(output.join("table.txt")).unwrap()));

    // Again in its place, with another number of threads.
    std::fs::write(output.join("left over"), "").unwrap();
    let (done, _, progress) = demo(&output, "1");
    assert!(done, "{progress}");
    assert!(std::fs::read_to_string(output.join("errors.csv")).unwrap() == csv);
    assert!(!output.join("left over").exists());
    assert_eq!(folder.path().read_dir().unwrap().count(), 1, "nothing is left beside the folder");
}

#[test]
fn a_folder_of_others_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("work");
    std::fs::create_dir(&output).unwrap();
    std::fs::write(output.join("thesis.txt"), "years").unwrap();
    let (done, _, error) = demo(&output, "1");
    assert!(!done && error.contains("exists already and is no demo's folder"), "{error}");
    assert_eq!(std::fs::read_to_string(output.join("thesis.txt")).unwrap(), "years");
    assert_eq!(folder.path().read_dir().unwrap().count(), 1);
}

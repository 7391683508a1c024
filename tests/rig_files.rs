//! `muybridge rig` on files of every form, from the command line.

use assert_cmd::Command;
use std::path::{Path, PathBuf};

fn muybridge(args: &[&str]) -> (i32, String, String) {
    let output = Command::cargo_bin("muybridge").unwrap().args(["--threads", "1"]).args(args).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap(), text(&output.stdout), text(&output.stderr))
}

fn lab() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/lab.toml")
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn show_says_and_draws_the_rig() {
    let folder = tempfile::tempdir().unwrap();
    let picture = folder.path().join("rig.png");
    let (code, out, err) = muybridge(&["rig", "show", text(&lab()), "-o", text(&picture)]);
    assert_eq!((code, err.as_str()), (0, ""));
    for part in [
        "lab.toml (Calib.toml): 3 cameras, z up",
        "cam_00  640 x 480 px, focal length 555.0 x 555.0 px, field of view 61.3 x 47.4 deg",
        "at (0.000, 0.000, 1.100) m, 1.100 m above the world's zero, looks 3.0 deg down",
        "cam_00 - cam_01: 0.3000 m apart",
        "stereo cam_00 + cam_01 + cam_02: an L, baseline 0.3005 m",
    ] {
        assert!(out.contains(part), "{part}\n{out}");
    }
    let drawn = image::open(&picture).unwrap().into_rgb8();
    assert!(drawn.pixels().filter(|p| p.0 == [0, 158, 115]).count() > 500, "the third camera's colour");
}

#[test]
fn a_rig_survives_the_way_through_opencvs_form() {
    let folder = tempfile::tempdir().unwrap();
    let [yaml, there, again] = ["rig.yml", "there.toml", "again.toml"].map(|name| folder.path().join(name));
    for [from, to] in [[&lab(), &yaml], [&yaml, &there], [&lab(), &again]] {
        assert_eq!(muybridge(&["rig", "convert", text(from), "-o", text(to)]).0, 0);
    }
    assert!(std::fs::read_to_string(&yaml).unwrap().starts_with("%YAML:1.0"));
    let [there, again] = [there, again].map(|path| muybridge::io::calib_toml::read_rig(&path).unwrap());
    for (a, b) in there.cameras.iter().zip(&again.cameras) {
        assert!((a.camera_from_world.matrix() - b.camera_from_world.matrix()).norm() < 1e-14);
        assert_eq!((&a.name, a.matrix, a.lens, a.translation, a.size_px), (&b.name, b.matrix, b.lens, b.translation, b.size_px));
    }
}

#[test]
fn millimetres_and_other_tools_are_refused_with_the_command_that_helps() {
    let folder = tempfile::tempdir().unwrap();
    let (session, path) = (folder.path(), folder.path().join("Calib.toml"));
    let metres = std::fs::read_to_string(lab()).unwrap();
    let millimetres = metres.replace("translation = [ -0.296196, 1.09726, 0.062526 ]", "translation = [ -296.196, 1097.26, 62.526 ]");
    let millimetres = millimetres.replace("[ -0.001917, 1.098491, 0.057569 ]", "[ -1.917, 1098.491, 57.569 ]");
    std::fs::write(&path, millimetres.replace("[ -0.007853, 1.395213, 0.127097 ]", "[ -7.853, 1395.213, 127.097 ]")).unwrap();
    let (code, _, err) = muybridge(&["rig", "show", text(&path)]);
    assert!(code == 1 && err.contains("muybridge rig convert FILE --scale 0.001 -o Calib.toml"), "{err}");
    let (code, out, _) = muybridge(&["rig", "show", text(&path), "--scale", "0.001"]);
    assert!(code == 0 && out.contains("cam_00 - cam_01: 0.3000 m apart"), "{out}");

    std::fs::write(&path, "%YAML:1.0\n---\nK_1: 3\n").unwrap();
    let (code, _, err) = muybridge(&["check", text(session)]);
    assert!(code == 1 && err.contains("convert it first: muybridge rig convert Calib.toml"), "{err}");
    let (code, _, err) = muybridge(&["rig", "convert", text(&path), "-o", text(&path), "--size", "640"]);
    assert!(code == 2 && err.contains("such as 1920x1080"), "{err}");
}

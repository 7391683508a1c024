//! Bad input: one sentence on stderr that names file, place and remedy, exit code 1, and nothing written.

use assert_cmd::Command;
use image::{GrayImage, Luma};
use std::fs;
use std::path::{Path, PathBuf};

const SIZE: [u32; 2] = [160, 120];
const FRAMES: u32 = 4;

/// Three cameras side by side before a textured wall 3 m away, a bright square that moves.
fn picture(camera: u32, frame: Option<u32>) -> GrayImage {
    GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| {
        // 0.3 m at 3 m and 150 px focal length are 15 px.
        let (wall_x, wall_y) = (x + 15 * u32::from(camera == 1), y + 15 * u32::from(camera == 2));
        let (u, v) = (f64::from(wall_x), f64::from(wall_y));
        let grey = 110.0 + 30.0 * (0.31 * u + 0.002 * u * v).sin() + 30.0 * (0.27 * v - 0.003 * u * u).cos();
        let inside = frame.is_some_and(|f| (60 + 8 * f..90 + 8 * f).contains(&wall_x) && (40..90).contains(&wall_y));
        Luma([if inside { 240 - (wall_x * wall_y % 7) as u8 } else { grey as u8 }])
    })
}

fn calib() -> String {
    let centres = ["0.0, 0.0, 0.0", "-0.3, 0.0, 0.0", "0.0, -0.3, 0.0"];
    let camera = |(k, translation): (usize, &&str)| {
        format!(
            "[cam_{k:02}]\nsize = [160, 120]\nmatrix = [[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]]\n\
             distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.0, 0.0]\ntranslation = [{translation}]\n\n"
        )
    };
    centres.iter().enumerate().map(camera).collect()
}

/// A good session; `extension` is the pictures'.
fn session(extension: &str) -> (tempfile::TempDir, PathBuf) {
    let study = tempfile::tempdir().unwrap();
    let session = study.path().join("walk");
    fs::create_dir(&session).unwrap();
    fs::write(session.join("Calib.toml"), calib()).unwrap();
    fs::write(session.join("muybridge.toml"), "fps = 25.0\n").unwrap();
    for camera in 0..3 {
        let folder = session.join(format!("cam_{camera:02}"));
        fs::create_dir(&folder).unwrap();
        for frame in 0..FRAMES {
            picture(camera, Some(frame)).save(folder.join(format!("{frame:06}.{extension}"))).unwrap();
        }
        picture(camera, None).save(session.join(format!("cam_{camera:02}_background.png"))).unwrap();
    }
    (study, session)
}

fn check(session: &Path) -> std::process::Output {
    Command::cargo_bin("muybridge").unwrap().arg("check").arg(session).output().unwrap()
}

/// Runs a command, which must fail with exactly one line on stderr after notes and progress, holding all of `parts`.
fn fails(arguments: &[&str], parts: &[&str]) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {message}");
    let said = |line: &&str| ["note: ", "frames: ", "clouds: "].iter().any(|start| line.starts_with(start));
    let errors: Vec<_> = message.lines().skip_while(said).collect();
    assert!(errors.len() == 1 && errors[0].starts_with("error: "), "{arguments:?}: {message}");
    assert!(parts.iter().all(|part| errors[0].contains(part)), "{parts:?} in {message}");
}

fn refused(session: &Path, parts: &[&str]) {
    fails(&["check", text(session)], parts);
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Neither `path` nor a temporary of it is there.
fn nothing_written(path: &Path) {
    let left: Vec<_> = path.parent().unwrap().read_dir().unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(!path.exists() && left.iter().all(|name| !name.to_str().unwrap().starts_with('.')), "{left:?}");
}

/// `clouds` and `track` refuse the session.
fn unusable(session: &Path, parts: &[&str]) {
    let output = session.with_file_name("out");
    for command in ["clouds", "track"] {
        fails(&[command, text(session), "-o", text(&output)], parts);
        nothing_written(&output);
    }
}

fn truncate(path: &Path) {
    let whole = fs::read(path).unwrap();
    fs::write(path, &whole[..whole.len() / 2]).unwrap();
}

#[test]
fn a_good_session_passes() {
    for extension in ["png", "jpg"] {
        let (_study, session) = session(extension);
        let output = check(&session);
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        assert!(text.contains("4 frames (0 to 3), 25 frames/s, 0.12 s"), "{text}");
        assert!(text.contains("baseline cam_00 to cam_01: 0.3000 m"), "{text}");
        assert!(!text.contains("calibration does not fit") && !text.contains("nobody"), "{text}");
    }
}

#[test]
fn a_missing_camera_folder_is_refused() {
    let (_study, session) = session("png");
    fs::remove_dir_all(session.join("cam_01")).unwrap();
    refused(&session, &["walk: no folder cam_01", "put the pictures of cam_01 there, or remove [cam_01] from Calib.toml"]);
}

#[test]
fn a_missing_camera_table_is_refused() {
    let (_study, session) = session("png");
    let text = calib();
    fs::write(session.join("Calib.toml"), &text[..text.find("[cam_02]").unwrap()]).unwrap();
    refused(&session, &["cam_02: is footage of a camera that Calib.toml does not know", "add its table [cam_02]"]);
}

#[test]
fn unequal_counts_are_refused() {
    let (_study, session) = session("png");
    fs::remove_file(session.join("cam_02/000003.png")).unwrap();
    refused(&session, &["cam_00 4, cam_01 4, cam_02 3", "cam_02 has no frame 3"]);
}

#[test]
fn a_frame_missing_in_one_camera_is_refused() {
    let (_study, session) = session("png");
    fs::rename(session.join("cam_01/000001.png"), session.join("cam_01/000009.png")).unwrap();
    refused(&session, &["frame 1 is missing in cam_01 but not in cam_00", "add it, or remove it from every camera"]);
}

#[test]
fn a_frame_missing_in_all_cameras_was_dropped() {
    let (_study, session) = session("png");
    for camera in ["cam_00", "cam_01", "cam_02"] {
        fs::remove_file(session.join(camera).join("000001.png")).unwrap();
    }
    let output = check(&session);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && text.contains("3 frames (0 to 3)") && text.contains("dropped frames"), "{text}");
}

#[test]
fn truncated_pictures_are_refused() {
    for extension in ["png", "jpg"] {
        let (_study, session) = session(extension);
        let name = format!("cam_01/000002.{extension}");
        truncate(&session.join(&name));
        refused(&session, &[&name, "is truncated", "copy it again"]);
        unusable(&session, &[&name, "is truncated", "copy it again"]);
    }
}

#[test]
fn a_video_that_ends_early_is_refused() {
    let (_study, session) = session("png");
    for camera in 0..3 {
        let name = format!("cam_{camera:02}");
        fs::remove_dir_all(session.join(&name)).unwrap();
        write_video(&session.join(name).with_extension("avi"), camera);
    }
    let output = check(&session);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    truncate(&session.join("cam_01.avi"));
    refused(&session, &["cam_01.avi: ends early, after ", " of 24 frames"]);
}

fn write_video(path: &Path, camera: u32) {
    use opencv::prelude::*;
    let fourcc = opencv::videoio::VideoWriter::fourcc('M', 'J', 'P', 'G').unwrap();
    let size = opencv::core::Size::new(SIZE[0] as i32, SIZE[1] as i32);
    let mut writer = opencv::videoio::VideoWriter::new(path, fourcc, 25.0, size, false).unwrap();
    for frame in 0..24 {
        let image = picture(camera, Some(frame / 6));
        writer.write(&opencv::core::Mat::new_rows_cols_with_data(SIZE[1] as i32, SIZE[0] as i32, image.as_raw()).unwrap()).unwrap();
    }
    writer.release().unwrap();
}

#[test]
fn millimetres_are_refused() {
    let (_study, session) = session("png");
    fs::write(session.join("Calib.toml"), calib().replace("-0.3", "-300.0")).unwrap();
    let parts = ["Calib.toml: cam_00 and cam_01 are 300.0 m apart", "millimetres; divide all translations by 1000"];
    refused(&session, &parts);
    unusable(&session, &parts);
}

#[test]
fn an_empty_stage_is_refused() {
    let (_study, session) = session("png");
    for camera in 0..3 {
        for frame in 0..FRAMES {
            picture(camera, None).save(session.join(format!("cam_{camera:02}/{frame:06}.png"))).unwrap();
        }
    }
    refused(&session, &["walk: no person in view"]);
    unusable(&session, &["walk: nobody is in view in any of the 4 frames", "check that the pictures show a person"]);
}

#[test]
fn a_calibration_that_does_not_fit_is_refused() {
    let (_study, session) = session("png");
    fs::write(session.join("Calib.toml"), calib().replacen("[0.0, 150.0, 60.0]", "[0.0, 150.0, 66.0]", 1)).unwrap();
    refused(&session, &["walk: cam_00", "against the calibration: calibrate again"]);
}

#[test]
fn a_session_without_calibration_is_refused() {
    let (_study, session) = session("png");
    fs::remove_file(session.join("Calib.toml")).unwrap();
    refused(&session, &["Calib.toml"]);
    unusable(&session, &["Calib.toml"]);
}

/// The embedded model of an activity as a file.
fn model(folder: &Path, activity: &str) -> PathBuf {
    let path = folder.join(format!("{activity}.npz"));
    let arguments = ["model", "synthetic", "--activity", activity, "-o", text(&path)];
    assert!(Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap().status.success());
    path
}

/// The archive with `from` replaced by `to` of the same length, and only the arrays that `kept` names.
fn rewrite(archive: &Path, to_path: &Path, [from, to]: [&str; 2], kept: impl Fn(&str) -> bool) {
    use std::io::{Read, Write};
    let mut old = zip::ZipArchive::new(fs::File::open(archive).unwrap()).unwrap();
    let mut new = zip::ZipWriter::new(fs::File::create(to_path).unwrap());
    for i in 0..old.len() {
        let mut entry = old.by_index(i).unwrap();
        if !kept(entry.name()) {
            continue;
        }
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        while let Some(at) = bytes.windows(from.len()).position(|w| w == from.as_bytes()) {
            bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
        }
        let options = zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Stored);
        new.start_file(entry.name(), options).unwrap();
        new.write_all(&bytes).unwrap();
    }
    new.finish().unwrap();
}

#[test]
fn files_that_are_no_model_of_this_skeleton_are_refused() {
    let (study, session) = session("png");
    let good = model(study.path(), "jumping");
    let [skeleton, edited, foreign, cut, words] =
        ["skeleton", "edited", "foreign", "cut", "words"].map(|n| study.path().join(n).with_extension("npz"));
    rewrite(&good, &skeleton, ["muybridge-hanim-78", "muybridge-hanim-99"], |_| true);
    rewrite(&good, &edited, ["synthetic_1", "synthetic_9"], |_| true);
    rewrite(&good, &foreign, ["not in it", "not in it"], |name| name.starts_with("mean"));
    fs::write(&words, "walking\n").unwrap();
    fs::copy(&good, &cut).unwrap();
    truncate(&cut);
    let output = study.path().join("out");
    for (file, part) in [
        (&skeleton, "is a model of another skeleton (muybridge-hanim-99), muybridge-hanim-78 is needed; build it again"),
        (&edited, "is damaged: "),
        (&foreign, "is no model file of muybridge (it holds no array `header`)"),
        (&cut, "is no model file of muybridge (not an .npz archive"),
        (&words, "is no model file of muybridge (not an .npz archive"),
    ] {
        fails(&["model", "info", text(file)], &[text(file), part]);
        fails(&["model", "validate", text(file), "-o", text(&output)], &[text(file), part]);
        fails(&["track", text(&session), "--model", text(file), "-o", text(&output)], &[text(file), part]);
        fails(&["generate", "--model", text(file), "--style", "any.json", "--at", "1", "-o", text(&output)], &[text(file), part]);
        nothing_written(&output);
    }
}

#[test]
fn a_style_of_another_model_is_refused() {
    let study = tempfile::tempdir().unwrap();
    let [jumping, running] = ["jumping", "running"].map(|activity| model(study.path(), activity));
    let read = muybridge::io::model_npz::read_model(&running).unwrap();
    let cycles: Vec<_> = read.members.iter().take(4).map(|m| read.cycle_of(m)).collect();
    let hash = muybridge::io::model_npz::model_hash(&read);
    let style = muybridge::style::Style::of_cycles(&read, &hash, &cycles).unwrap();
    let [path, output] = ["style.json", "out"].map(|name| study.path().join(name));
    muybridge::io::style_json::write_style(&path, &style).unwrap();
    let generate =
        |model: &Path| ["generate", "--model", text(model), "--style", text(&path), "--at", "1", "-o", text(&output)].map(String::from);
    let arguments = generate(&jumping);
    fails(&arguments.each_ref().map(String::as_str), &["style.json was made with another model than", "use the model it was made with"]);
    nothing_written(&output);
    assert!(Command::cargo_bin("muybridge").unwrap().args(generate(&running)).output().unwrap().status.success());
}

#[test]
fn motion_files_with_errors_are_refused_with_their_place() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let study = tempfile::tempdir().unwrap();
    let good = fs::read_to_string(root.join("fixtures/mocap/tiny.bvh")).unwrap();
    let bad = study.path().join("bad.bvh");
    let line = 1 + good.lines().position(|l| l.contains("CHANNELS 3")).unwrap();
    fs::write(&bad, good.replacen("CHANNELS 3", "CHANNELS three", 1)).unwrap();
    let (walking, nan) = (model(study.path(), "walking"), root.join("fixtures/mocap/nan.mot"));
    let output = study.path().join("out");
    for (file, parts) in [(&bad, vec![format!("bad.bvh:{line}: ")]), (&nan, vec!["nan.mot:10: column knee_angle_l holds NaN".into()])] {
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        let rig = root.join("calib/phantom_lab.toml");
        fails(&["render", text(file), "--rig", text(&rig), "-o", text(&output)], &parts);
        fails(&["model", "build", text(file), "--activity", "walking", "-o", text(&output)], &parts);
        fails(&["generate", "--model", text(&walking), "--style", text(file), "--at", "1", "-o", text(&output)], &parts);
        nothing_written(&output);
    }
}

#[test]
fn wrong_usage_exits_with_2() {
    for arguments in [
        &["track"][..],
        &["model", "build"],
        &["clouds", "walk", "--voxel", "wide"],
        &["fly"],
        &["track", "a", "-o", "b", "--variance", "2"],
    ] {
        let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
}

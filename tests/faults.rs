//! Full disks, disks that can only be read, small file limits, files that vanish, clocks that jump: one sentence with a remedy and exit
//! code 1, no file that is not whole, and everything else goes on.
//!
//! Disks are tmpfs in a mount namespace of their own, which goes with the last process in it; only root may mount them.

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, SystemTime};

use crate::study::*;
use muybridge::body::Shape;
use muybridge::io::bvh;
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, synthetic};

/// Whether this user may mount.
fn can_mount() -> bool {
    let works = Command::new("unshare").args(["-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]).stderr(Stdio::null()).status();
    let can = works.is_ok_and(|status| status.success());
    if !can {
        eprintln!("notice: no tmpfs can be mounted here (only root can), so there is no full disk and none to read from only");
    }
    can
}

/// Runs bash's `script` with `place` on a tmpfs of its own with these mount options; what is there at the end is copied into `kept`.
/// The script has the program as `$MB`.
fn on_disk(place: &Path, options: &str, kept: &Path, script: &str) -> Output {
    fs::create_dir_all(place).unwrap();
    let run = format!(
        "mount -t tmpfs -o {options} tmpfs \"$PLACE\" || exit 99\n( {script}\n)\ncode=$?\nmkdir -p \"$KEPT\"; cp -a \"$PLACE/.\" \"$KEPT\"; exit $code"
    );
    let mut command = Command::new("unshare");
    command.args(["-m", "bash", "-c", &run]).stdin(Stdio::null());
    command.env("PLACE", place).env("KEPT", kept).env("MB", env!("CARGO_BIN_EXE_muybridge"));
    command.output().unwrap()
}

/// The one line of the error.
fn error_of(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    let errors: Vec<&str> = text.lines().filter(|line| line.starts_with("error: ")).collect();
    assert!(output.status.code() == Some(1) && errors.len() == 1 && text.ends_with(&format!("{}\n", errors[0])), "{output:?}");
    errors[0].to_string()
}

/// Files below a folder by name, with their bytes.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let name = |path: &Path| path.strip_prefix(folder).unwrap().to_str().unwrap().to_string();
    files_below(folder).into_iter().map(|path| (name(&path), fs::read(&path).unwrap())).collect()
}

/// Those of [`commands`] that every test can afford.
const SHORT: [&str; 3] = ["model build", "generate", "track"];

/// Recordings of three people, and commands that write files of all kinds to `$PLACE/out`.
fn commands(place: &Path) -> Vec<(&'static str, String)> {
    let (session, mocap) = (place.join("session"), place.join("mocap"));
    cut(0, &session);
    fs::write(session.join("muybridge.toml"), "fps = 12\n").unwrap();
    for seed in [3, 4, 5] {
        let cycle = synthetic::subject(Activity::Walking, seed).cycle(1.2, 0);
        let clip = play_cycle(&cycle, &Shape::template(1.7).offsets(), 60.0, Length::Cycles(3));
        bvh::write_clip(&mocap.join(format!("p{seed}/walk.bvh")), &clip, None).unwrap();
    }
    let film = text(FILM.parent().unwrap());
    let (session, mocap) = (text(&session), text(&mocap));
    let model = format!("{film}/film/walking.npz");
    vec![
        ("model build", format!("\"$MB\" model build {mocap} --activity walking -o \"$PLACE/out/m.npz\"")),
        ("model info", format!("\"$MB\" model info {model} -o \"$PLACE/out\"")),
        ("generate", format!("\"$MB\" generate --model {model} --style {mocap}/p3/walk.bvh --at 1,1.2 --strips -o \"$PLACE/out\"")),
        ("clouds", format!("\"$MB\" clouds {session} -o \"$PLACE/out\"")),
        ("track", format!("\"$MB\" track {session} -o \"$PLACE/out\" --pictures")),
        ("render", format!("\"$MB\" render {film}/walk.bvh --rig {film}/rig.toml --fps 12 -o \"$PLACE/out\"")),
    ]
}

#[test]
fn a_full_disk_is_one_sentence_and_no_file_is_half_written() {
    if !can_mount() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    for (name, script) in commands(place.path()) {
        let at = |part: &str| place.path().join(format!("{part} of {name}"));
        let (whole, cut_off) = (at("whole"), at("cut off"));
        let output = on_disk(&at("disk"), "size=100m", &whole, &script);
        assert!(output.status.success(), "{name}: {output:?}");
        let whole = contents(&whole);
        // Half of what is to be written fits.
        let kib = whole.values().map(|bytes| bytes.len().div_ceil(4096) * 4).sum::<usize>() / 2;
        let output = on_disk(&at("disk"), &format!("size={kib}k"), &cut_off, &script);
        let error = error_of(&output);
        assert!(error.contains("no space is left on the disk; make room there") && error.contains(text(&at("disk"))), "{name}: {error}");
        let left = contents(&cut_off);
        assert!(left.len() < whole.len(), "{name}: {:?}", left.keys());
        for (file, bytes) in &left {
            assert!(whole.get(file) == Some(bytes), "{name}: {file} is half written or left over");
        }
    }
}

#[test]
fn a_disk_that_can_only_be_read_is_one_sentence() {
    if !can_mount() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one"]);
    let batch = ("batch", format!("\"$MB\" batch {} -o \"$PLACE/out\"", text(&study)));
    for (name, script) in commands(place.path()).into_iter().filter(|(name, _)| SHORT.contains(name)).chain([batch]) {
        let disk = place.path().join("disk");
        let script = format!("mkdir \"$PLACE/out\"; mount -o remount,ro \"$PLACE\"; {script}");
        let output = on_disk(&disk, "size=1m", &place.path().join(format!("kept of {name}")), &script);
        let error = error_of(&output);
        assert!(error.contains("the disk can only be read; write to another one") && error.contains(text(&disk)), "{name}: {error}");
    }
}

/// A study's disk that fills up: the sessions say so, and with more room the same command goes on to the same bytes.
#[test]
fn a_batch_on_a_full_disk_goes_on_when_there_is_room() {
    if !can_mount() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one", "two"]);
    let calm = place.path().join("calm");
    assert!(batch(&study, &calm, &[]).status.success());
    let kept = place.path().join("kept");
    let run = format!("\"$MB\" batch {} -o \"$PLACE/out\" --threads 1", text(&study));
    let script =
        format!("{run} > \"$PLACE.first\" 2>&1; echo $? > \"$PLACE.code\"; mount -o remount,size=100m \"$PLACE\"; {run} --retry-failed");
    let disk = place.path().join("disk");
    // Results of one session are larger.
    let output = on_disk(&disk, "size=1m", &kept, &script);
    let beside = |name: &str| fs::read_to_string(disk.with_extension(name)).unwrap();
    let first = beside("first");
    assert!(beside("code") == "1\n" && first.contains("error: "), "{first}");
    for session in ["one", "two"] {
        let line = first.lines().find(|line| line.starts_with(&format!("{session}: failed: "))).unwrap_or_else(|| panic!("{first}"));
        assert!(line.contains("no space is left on the disk; make room there"), "{first}");
    }
    assert!(output.status.success(), "{}", said(&output));
    assert!(outputs(&kept.join("out")) == outputs(&calm));
}

/// Commands under a limit of 100 KiB per file, whose signal would end them without a word.
#[test]
fn a_limit_on_the_size_of_files_is_one_sentence() {
    let place = tempfile::tempdir().unwrap();
    for (name, script) in commands(place.path()).into_iter().filter(|(name, _)| SHORT.contains(name)) {
        let folder = place.path().join(format!("limited {name}"));
        let mut command = Command::new("bash");
        command.args(["-c", &format!("ulimit -f 100; {script}")]).stdin(Stdio::null());
        let output = command.env("PLACE", &folder).env("MB", env!("CARGO_BIN_EXE_muybridge")).output().unwrap();
        if output.status.success() {
            let largest = contents(&folder).values().map(Vec::len).max();
            assert!(largest < Some(100 << 10), "{name}: {largest:?}");
            continue;
        }
        let error = error_of(&output);
        assert!(error.contains("raise the limit (ulimit -f)") && error.contains("limited"), "{name}: {error}");
        let left = if folder.exists() { contents(&folder) } else { BTreeMap::new() };
        assert!(left.iter().all(|(file, bytes)| !file.contains(".writing") && bytes.len() <= 100 << 10), "{name}: {:?}", left.keys());
    }
}

#[test]
fn a_full_or_closed_standard_output_is_no_panic() {
    let model = FILM.join("walking.npz");
    let output = muybridge(&["model", "info", text(&model)]).stdout(fs::File::create("/dev/full").unwrap()).output().unwrap();
    let error = error_of(&output);
    assert!(error.contains("cannot write to standard output: no space is left"), "{error}");
    // Whoever closes a pipe has what he wants.
    let mut child = muybridge(&["model", "info", text(&model)]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(child.wait().unwrap().success() && said.is_empty(), "{said}");
}

/// One frame more than is read at once is looked at while the first ones are worked on.
#[test]
fn a_frame_that_vanishes_in_mid_run_fails_its_session_only() {
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["a", "b"]);
    let session = study.join("a");
    for camera in ["cam_00", "cam_01", "cam_02"] {
        for frame in 0..FRAMES + 3 {
            let name = format!("{camera}/{frame:06}.png");
            fs::copy(FILM.join(&name), session.join(&name)).unwrap();
        }
    }
    let results = place.path().join("results");
    let arguments = ["--threads", "1", "batch", text(&study), "-o", text(&results)];
    let run = muybridge(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let work = results.join(".work/a");
    until("the first frame's cloud", || work.is_dir() && files_below(&work).iter().any(|p| p.extension().is_some_and(|e| e == "frame")));
    fs::remove_file(session.join("cam_01/000008.png")).unwrap();
    let output = run.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    let reason = status(&results, "a")["reason"].as_str().unwrap().to_string();
    assert!(reason.contains("cam_01 has no frame 8"), "{reason}");
    assert_eq!(state(&results, "b"), "done");

    // Put back, it is worked on by itself.
    fs::copy(FILM.join("cam_01/000008.png"), session.join("cam_01/000008.png")).unwrap();
    let again = batch(&study, &results, &[]);
    assert!(again.status.success() && said(&again).matches(": done in").count() == 1, "{}", said(&again));
}

/// `model build` lists its files before it reads them, one after another with one thread: while the first, a pipe, keeps it waiting,
/// the second vanishes.
fn build_while_one_vanishes(mocap: &Path, output: &Path, first: &[u8]) -> Output {
    let pipe = mocap.join("p1/a.bvh");
    fs::create_dir_all(mocap.join("p1")).unwrap();
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let arguments = ["--threads", "1", "model", "build", text(mocap), "--activity", "walking", "-o", text(output)];
    let run = muybridge(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // Opens when it reads.
    let mut writer = fs::File::options().write(true).open(&pipe).unwrap();
    fs::remove_file(mocap.join("p2/walk.bvh")).unwrap();
    writer.write_all(first).unwrap();
    drop(writer);
    run.wait_with_output().unwrap()
}

#[test]
fn a_recording_that_vanishes_in_mid_run_is_left_out() {
    let place = tempfile::tempdir().unwrap();
    let (mocap, others) = (place.path().join("mocap"), place.path().join("others"));
    for seed in [2, 3, 4, 5] {
        let cycle = synthetic::subject(Activity::Walking, seed).cycle(1.2, 0);
        let clip = play_cycle(&cycle, &Shape::template(1.7).offsets(), 60.0, Length::Cycles(3));
        for folder in [&mocap, &others].into_iter().take(if seed == 2 { 1 } else { 2 }) {
            bvh::write_clip(&folder.join(format!("p{seed}/walk.bvh")), &clip, None).unwrap();
        }
    }
    let models = place.path().join("models");
    let vanished = mocap.join("p2/walk.bvh");
    let output = build_while_one_vanishes(&mocap, &models.join("m.npz"), b"no motion");
    let told = said(&output);
    assert!(output.status.success(), "{told}");
    let line = format!("left out: {}: cannot be read: ", vanished.display());
    assert_eq!(told.lines().filter(|l| l.starts_with("left out: ") && l.contains("walk.bvh")).count(), 1, "{told}");
    assert!(told.contains(&line) && told.contains("No such file"), "{told}");
    succeed(&["model", "build", text(&others), "--activity", "walking", "-o", text(&place.path().join("others.npz"))]);
    assert!(fs::read(models.join("m.npz")).unwrap() == fs::read(place.path().join("others.npz")).unwrap());
    assert_eq!(files_below(&models).len(), 1);
}

#[test]
fn where_all_recordings_vanish_there_is_no_model() {
    let place = tempfile::tempdir().unwrap();
    let (mocap, output) = (place.path().join("mocap"), place.path().join("models/m.npz"));
    let clip =
        play_cycle(&synthetic::subject(Activity::Walking, 2).cycle(1.2, 0), &Shape::template(1.7).offsets(), 60.0, Length::Cycles(3));
    bvh::write_clip(&mocap.join("p2/walk.bvh"), &clip, None).unwrap();
    let error = error_of(&build_while_one_vanishes(&mocap, &output, b""));
    assert!(error.contains("none of 2 motions can be used for walking; ") && error.contains("a.bvh"), "{error}");
    assert!(!output.parent().unwrap().exists());
}

/// Times of files and in status files are told and never asked.
#[test]
fn a_clock_that_jumps_changes_nothing() {
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one", "two"]);
    let results = place.path().join("results");
    assert!(batch(&study, &results, &[]).status.success());
    let before = outputs(&results);
    let now = SystemTime::now();
    let century = Duration::from_secs(100 * 365 * 86_400);
    for (time, unix_s) in [(now + century, u64::MAX), (SystemTime::UNIX_EPOCH, 0)] {
        for path in files_below(&study).into_iter().chain(files_below(&results)) {
            fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
        }
        for session in ["one", "two"] {
            let mut edited = status(&results, session);
            edited["started_unix_s"] = unix_s.into();
            edited["seconds"] = (-1e9).into();
            fs::write(results.join(session).join("status.json"), edited.to_string()).unwrap();
        }
        let again = batch(&study, &results, &[]);
        assert!(again.status.success() && said(&again).contains("nothing to do"), "{}", said(&again));
        let shown = succeed(&["batch", "status", text(&study), "-o", text(&results)]);
        assert!(shown.contains("2 sessions: 2 done"), "{shown}");

        // One that runs since the year 2126 or 1970, whose process is gone, as its lock tells.
        let mut running = status(&results, "two");
        running["state"] = "running".into();
        fs::write(results.join("two/status.json"), running.to_string()).unwrap();
        let shown = succeed(&["batch", "status", text(&study), "-o", text(&results)]);
        assert!(shown.contains("1 done, 1 pending") && shown.contains("interrupted"), "{shown}");
        let resumed = batch(&study, &results, &[]);
        assert!(said(&resumed).contains("two: done in") && !said(&resumed).contains("one: done in"), "{}", said(&resumed));
        assert!(outputs(&results) == before);
    }
}

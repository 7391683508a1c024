//! A study of short sessions, some of them broken, through `muybridge batch`: everything else is done, a second run does
//! nothing, an edit redoes one session, and kills at any moment change no byte.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::study::*;

/// Ends a process as the system does when memory is short.
fn kill(process: u32) {
    assert!(Command::new("kill").args(["-9", &process.to_string()]).status().unwrap().success());
}

const GOOD: [&str; 3] = ["a/walk_1", "a/walk_2", "a/walk_10, \"b\""];

#[test]
fn a_study_with_broken_sessions() {
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &GOOD);
    for broken in ["b/cut", "b/no_rig", "b/option"] {
        cut(0, &study.join(broken));
    }
    let picture = study.join("b/cut/cam_01/000002.png");
    fs::write(&picture, &fs::read(&picture).unwrap()[..500]).unwrap();
    fs::remove_file(study.join("b/no_rig/Calib.toml")).unwrap();
    fs::write(study.join("b/option/muybridge.toml"), "pictures = \"yes\"\n").unwrap();
    let results = place.path().join("results");

    // Everything that can be done is done, the others say why not.
    let first = batch(&study, &results, &[]);
    assert_eq!(first.status.code(), Some(1), "{}", said(&first));
    let told = said(&first);
    for words in [
        "6 sessions: 3 done, 3 failed",
        "b/cut     cam_01/000002.png: is truncated",
        "b/no_rig  Calib.toml: cannot be read",
        "b/option  muybridge.toml: line 1: ",
        "error: 3 of 6 sessions failed",
    ] {
        assert!(told.contains(words), "{words}: {told}");
    }
    let undisturbed = outputs(&results);
    let summary = String::from_utf8(undisturbed["summary.csv"].clone()).unwrap();
    let starts = ["a/walk_1,done,,6,", "a/walk_2,done,,6,", "\"a/walk_10, \"\"b\"\"\",done,,6,", "b/cut,failed,"];
    assert!(summary.lines().skip(1).zip(starts).all(|(line, start)| line.starts_with(start)), "natural order: {summary}");
    assert!(!undisturbed.keys().any(|name| name.starts_with("b/")), "a failed session has no outputs");
    let direct = place.path().join("direct");
    succeed(&["track", text(&study.join(GOOD[1])), "-o", text(&direct)]);
    for (name, bytes) in outputs(&direct) {
        assert!(undisturbed[&format!("{}/{name}", GOOD[1])] == bytes, "{name} is not what track writes");
    }

    // The same command again does nothing and says so.
    let states = || GOOD.map(|s| fs::read(results.join(s).join("status.json")).unwrap());
    let before = states();
    let again = batch(&study, &results, &[]);
    assert!(said(&again).contains("nothing to do") && again.status.code() == Some(1), "{}", said(&again));
    assert!(states() == before && outputs(&results) == undisturbed);
    let list = succeed(&["batch", "list", text(&study), "-o", text(&results)]);
    assert!(list.contains("0 of 6 sessions to run") && list.contains("b/cut           failed   "), "{list}");

    // A mended session, an edited picture and a changed option redo exactly their sessions.
    fs::write(&picture, fs::read(FILM.join("cam_01/000002.png")).unwrap()).unwrap();
    fs::copy(FILM.join("cam_02/000001.png"), study.join("a/walk_1/cam_02/000000.png")).unwrap();
    fs::write(study.join(GOOD[2]).join("muybridge.toml"), "variance = 0.9\n").unwrap();
    let list = succeed(&["batch", "list", text(&study), "-o", text(&results)]);
    let lines =
        ["walk_1        run      inputs changed", "\"b\"  run      options changed", "cut           run      inputs changed", "3 of 6"];
    for line in lines {
        assert!(list.contains(line), "{line}: {list}");
    }
    let edited = said(&batch(&study, &results, &[]));
    assert_eq!(edited.matches(": done in").count(), 3, "{edited}");
    let after = states();
    assert_eq!([0, 1, 2].map(|i| before[i] == after[i]), [false, true, false]);
    let now = outputs(&results);
    for (session, same) in [(GOOD[0], false), (GOOD[1], true), (GOOD[2], false)] {
        let file = format!("{session}/fit.json");
        assert_eq!(now[&file] == undisturbed[&file], same, "{session}");
    }
}

#[test]
fn killed_at_any_moment_and_resumed_gives_the_same_bytes() {
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one", "two"]);
    let calm = place.path().join("calm");
    let output = batch(&study, &calm, &[]);
    assert!(output.status.success(), "{}", said(&output));
    let undisturbed = outputs(&calm);

    let results = place.path().join("results");
    for pause_ms in [150, 420, 800, 1300] {
        let mut run = start(&study, &results);
        std::thread::sleep(Duration::from_millis(pause_ms));
        run.kill().unwrap();
        run.wait().unwrap();
        // What is there at that moment is whole.
        for session in ["one", "two"] {
            let folder = results.join(session);
            let there =
                folder.read_dir().map_or(0, |entries| entries.filter(|e| e.as_ref().is_ok_and(|e| e.file_name() != "status.json")).count());
            let done = folder.join("status.json").exists() && state(&results, session) == "done";
            assert_eq!(there > 0, done, "{session} after {pause_ms} ms");
        }
    }
    let output = batch(&study, &results, &[]);
    assert!(output.status.success(), "{}", said(&output));
    assert!(outputs(&results) == undisturbed);
    assert_eq!(results.join(".work").read_dir().unwrap().count(), 0, "nothing is left of the work");
}

fn start(study: &Path, results: &Path) -> Child {
    let mut command = muybridge(&["batch", text(study), "-o", text(results), "--threads", "2"]);
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Processes that `parent` started, by /proc.
fn children(parent: u32) -> Vec<u32> {
    let processes = fs::read_dir("/proc").unwrap().filter_map(|e| e.unwrap().file_name().to_str()?.parse::<u32>().ok());
    let parent_of = |process: &u32| {
        let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
        stat.rsplit(')').next().and_then(|rest| rest.split_whitespace().nth(1)?.parse::<u32>().ok())
    };
    processes.filter(|process| parent_of(process) == Some(parent)).collect()
}

#[test]
fn a_killed_worker_fails_its_session_only_and_two_batches_share_the_work() {
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one", "two"]);
    let results = place.path().join("results");
    let mut run = start(&study, &results);
    until("the start of a worker", || !children(run.id()).is_empty());
    kill(children(run.id())[0]);
    assert_eq!(run.wait().unwrap().code(), Some(1));
    let states = ["one", "two"].map(|s| state(&results, s));
    assert!(states.contains(&"done".to_string()) && states.contains(&"failed".to_string()), "{states:?}");
    let failed = if states[0] == "failed" { "one" } else { "two" };
    let reason = status(&results, failed)["reason"].as_str().unwrap().to_string();
    assert!(reason.contains("killed by signal 9") && reason.contains("--retry-failed"), "{reason}");
    let again = said(&batch(&study, &results, &["--retry-failed"]));
    assert!(again.contains(&format!("{failed}: done in")) && again.matches(": done in").count() == 1, "{again}");

    // Two at once on the same study: every session is worked on once, and both end well.
    let shared = place.path().join("shared");
    let runs = [(); 2].map(|()| {
        let mut command = muybridge(&["batch", text(&study), "-o", text(&shared), "--threads", "1"]);
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    });
    let ended = runs.map(|run| run.wait_with_output().unwrap());
    assert!(ended.iter().all(|o| o.status.success()), "{}{}", said(&ended[0]), said(&ended[1]));
    let done = ended.iter().map(|o| said(o).matches(": done in").count()).sum::<usize>();
    assert_eq!(done, 2, "{}{}", said(&ended[0]), said(&ended[1]));
    assert!(outputs(&shared) == outputs(&results));
}

#[test]
fn a_stopped_track_goes_on_with_the_frames_it_has() {
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one"]);
    let (session, work) = (study.join("one"), place.path().join("work"));
    let track = |output: &str, options: &[&str]| {
        let output = place.path().join(output);
        succeed(&[&["track", text(&session), "-o", text(&output)], options].concat());
        outputs(&output)
    };
    let plain = track("plain", &[]);
    let options = ["--work", text(&work)];
    assert!(track("first", &options) == plain);
    let kept: Vec<PathBuf> = files_below(&work);
    let of = |name: &str| kept.iter().find(|p| p.ends_with(name)).unwrap_or_else(|| panic!("no {name} in {kept:?}"));
    let stages = kept.iter().filter(|p| p.extension().is_some_and(|e| e == "fit")).count();
    assert!(kept.len() - stages == FRAMES && stages > 3, "{kept:?}");

    // Some are missing, one is cut off: those alone are made again.
    let untouched = fs::metadata(of("000005.frame")).unwrap().modified().unwrap();
    fs::remove_file(of("000000.frame")).unwrap();
    fs::write(of("000002.frame"), &fs::read(of("000002.frame")).unwrap()[..1000]).unwrap();
    let last = kept.iter().filter(|p| p.extension().is_some_and(|e| e == "fit")).max().unwrap();
    fs::remove_file(last).unwrap();
    fs::write(of("02.fit"), "no stage").unwrap();
    assert!(track("second", &options) == plain);
    assert!(fs::metadata(of("000002.frame")).unwrap().len() > 1000 && of("000000.frame").exists() && last.exists());
    assert_eq!(fs::metadata(of("000005.frame")).unwrap().modified().unwrap(), untouched);

    // They are really what the work goes on with: the fit gets another frame's cloud, and a stage begins elsewhere.
    fs::copy(of("000005.frame"), of("000003.frame")).unwrap();
    let third = track("third", &options);
    assert!(third["fit.json"] != plain["fit.json"]);
    fs::copy(of("00.fit"), of("01.fit")).unwrap();
    for stage in kept.iter().filter(|p| p.extension().is_some_and(|e| e == "fit") && !p.ends_with("01.fit")) {
        fs::remove_file(stage).unwrap();
    }
    assert!(track("fourth", &options)["fit.json"] != third["fit.json"]);

    // What was found in other footage is not taken.
    fs::copy(FILM.join("cam_00/000001.png"), session.join("cam_00/000002.png")).unwrap();
    let edited = track("fifth", &options);
    assert!(edited["fit.json"] != plain["fit.json"] && work.read_dir().unwrap().count() == 4);
}

/// Whether a Slurm answers here; `tests/slurm/cluster start` starts one.
fn slurm_answers() -> bool {
    Command::new("sinfo").arg("--noheader").stderr(Stdio::null()).output().is_ok_and(|o| o.status.success() && !o.stdout.is_empty())
}

#[test]
fn a_slurm_array_gives_the_same_bytes_and_takes_only_what_is_missing() {
    if !slurm_answers() {
        eprintln!("notice: no Slurm answers here; `eval \"$(tests/slurm/cluster start)\"` starts one");
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one", "g/it's two"]);
    cut(0, &study.join("broken"));
    fs::remove_file(study.join("broken/cam_02/000003.png")).unwrap();
    let local = place.path().join("local");
    assert_eq!(batch(&study, &local, &[]).status.code(), Some(1));

    let results = place.path().join("results of Slurm");
    let submit = || said(&batch(&study, &results, &["--engine", "slurm", "--jobs", "2"]));
    let first = submit();
    assert!(first.contains("3 of 3 sessions submitted as 3 tasks of job"), "{first}");
    let second = submit();
    assert!(second.contains("nothing to submit"), "{second}");
    until("the array", || results.join("summary.csv").exists());
    assert!(outputs(&results) == outputs(&local));
    assert!(status(&results, "one")["slurm_task"].as_str().is_some_and(|task| task.contains('_')));
    let shown = succeed(&["batch", "status", text(&study), "-o", text(&results)]);
    assert!(shown.contains("3 sessions: 2 done, 1 failed") && shown.contains("broken"), "{shown}");

    // Mended: only that one is submitted.
    fs::copy(FILM.join("cam_02/000003.png"), study.join("broken/cam_02/000003.png")).unwrap();
    fs::remove_file(results.join("summary.csv")).unwrap();
    let third = submit();
    assert!(third.contains("1 of 3 sessions submitted as 1 tasks"), "{third}");
    until("the second array", || results.join("summary.csv").exists());
    assert_eq!(state(&results, "broken"), "done");
}

#[test]
fn the_rule_file_for_snakemake_runs_a_study() {
    let answers = Command::new("snakemake").arg("--version").output().is_ok_and(|o| o.status.success());
    if !answers {
        eprintln!("notice: no snakemake here; `pip install snakemake` in a virtual environment on the PATH brings it");
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let study = study(place.path(), &["one", "g/it's two"]);
    let local = place.path().join("local");
    assert!(batch(&study, &local, &[]).status.success());
    let results = place.path().join("results");
    let rules = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/Snakefile");
    let snakemake = || {
        let config = [
            format!("study={}", text(&study)),
            format!("results={}", text(&results)),
            format!("muybridge={}", env!("CARGO_BIN_EXE_muybridge")),
        ];
        let mut command = Command::new("snakemake");
        command.args(["-s", text(&rules), "--cores", "2", "--keep-going", "--config"]).args(config).current_dir(place.path());
        command.output().unwrap()
    };
    let first = snakemake();
    assert!(first.status.success(), "{}", said(&first));
    assert!(outputs(&results) == outputs(&local));
    let before = fs::read(results.join("one/status.json")).unwrap();

    // Edited and broken: that one is run again and fails, the other is left as it is.
    fs::write(study.join("g/it's two/cam_00/000003.png"), "no picture").unwrap();
    let second = snakemake();
    assert!(!second.status.success() && said(&second).contains("000003.png"), "{}", said(&second));
    assert_eq!((state(&results, "g/it's two"), fs::read(results.join("one/status.json")).unwrap()), ("failed".into(), before));
}

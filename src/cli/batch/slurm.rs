//! A batch as one job array of Slurm and a dependent job that writes the summary.
//!
//! Task i of n works through the lines i, i + n, i + 2n … of a list of sessions with the same program, options and files as a
//! batch on one machine; `n` is the number of sessions unless the cluster's MaxArraySize is smaller. Only what is missing and
//! not waiting in the queue already is submitted. Account, partition, time limit and so on are asked for through Slurm's own
//! environment variables (SBATCH_ACCOUNT, SBATCH_PARTITION, SBATCH_TIMELIMIT, …).

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use muybridge::io::session::Session;
use muybridge::io::status_json::{self, Key, State, Status};
use muybridge::io::write_atomic;
use rayon::prelude::*;

use super::study::{Plan, Study, StudySession};

/// Tasks at once, so that one study does not fill a cluster.
const AT_ONCE: u16 = 32;
/// Slurm's own default.
const MAX_ARRAY_SIZE: usize = 1001;
/// Room above the largest need measured so far: frames differ.
const HEADROOM: f64 = 1.3;
/// The summary reads one small file per session.
const SUMMARY_MB: u32 = 200;

/// What to ask Slurm for.
pub struct Ask {
    pub threads: usize,
    pub at_once: Option<u16>,
    pub memory_mb: Option<u32>,
}

/// Some lines of a list of sessions.
#[derive(Clone, Debug, PartialEq)]
pub struct Share {
    pub list: PathBuf,
    index: usize,
    stride: usize,
}

pub fn parse_share(text: &str) -> Result<Share, String> {
    let mut parts = text.rsplitn(3, ',');
    let mut number = || parts.next().and_then(|p| p.parse::<usize>().ok());
    match (number(), number(), parts.next()) {
        (Some(stride), Some(index), Some(list)) if index < stride => Ok(Share { list: list.into(), index, stride }),
        _ => Err("must be FILE,INDEX,STRIDE".into()),
    }
}

impl Share {
    pub fn names(&self) -> Result<Vec<String>> {
        let text = std::fs::read_to_string(&self.list)?;
        Ok(text.lines().skip(self.index).step_by(self.stride).map(String::from).collect())
    }
}

/// Submits what is missing of the sessions.
pub fn submit(study: &Study, sessions: &[StudySession], ask: &Ask) -> Result<()> {
    let folder = study.results.join(".work/slurm");
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    let queued = queued(&folder)?;
    let missing =
        |s: &&StudySession| !queued.contains(&s.name) && !study.is_busy(&s.name) && matches!(study.plan(s, &study.key(s)), Plan::Run(_));
    let wanted: Vec<&StudySession> = sessions.par_iter().filter(missing).collect();
    let waiting = sessions.iter().filter(|s| queued.contains(&s.name)).count();
    if wanted.is_empty() {
        println!("nothing to submit: {waiting} of {} sessions wait in Slurm, the others are settled or running", sessions.len());
        return Ok(());
    }
    for session in wanted.iter().filter(|s| status_json::read(&study.result(&s.name)).is_none()) {
        status_json::write(&study.result(&session.name), &Status::pending(&session.name, &session.folder, &Key::default()))?;
    }
    let list = new_list(&folder, &wanted)?;
    let tasks = wanted.len().min(max_array_size()?);
    let memory_mb = ask.memory_mb.unwrap_or_else(|| memory_mb(study, &wanted, ask.threads));
    let array = sbatch(&array_job(study, &list, tasks, memory_mb, ask))?;
    write_atomic(&list.with_extension("job"), format!("{array} {tasks}\n").as_bytes())?;
    let summary = sbatch(&summary_job(study, &list, &array))?;
    println!(
        "{} of {} sessions submitted as {tasks} tasks of job {array}, {} threads and {memory_mb} MB each; job {summary} writes the summary",
        wanted.len(),
        sessions.len(),
        ask.threads
    );
    println!("`muybridge batch status {}` tells how far they are", study.folder.display());
    Ok(())
}

/// Sessions of earlier submissions whose tasks wait or run; lists that are through are removed.
fn queued(folder: &Path) -> Result<BTreeSet<String>> {
    let tasks = run(Command::new("squeue").args(["--noheader", "--array", "--format", "%F %K"]))?;
    let alive: BTreeSet<&str> = tasks.lines().map(str::trim).collect();
    let mut names = BTreeSet::new();
    for entry in folder.read_dir()? {
        let list = entry?.path();
        let Ok(job) = std::fs::read_to_string(list.with_extension("job")) else { continue };
        let Some((id, stride)) = job.trim().split_once(' ').and_then(|(id, n)| Some((id, n.parse::<usize>().ok()?))) else { continue };
        if list.extension().is_none_or(|e| e != "list") {
            continue;
        }
        for index in (0..stride).filter(|index| alive.contains(format!("{id} {index}").as_str())) {
            names.extend(Share { list: list.clone(), index, stride }.names()?);
        }
    }
    Ok(names)
}

/// A new list of sessions, with a number that no other submission has.
fn new_list(folder: &Path, sessions: &[&StudySession]) -> Result<PathBuf> {
    let text: String = sessions.iter().map(|s| format!("{}\n", s.name)).collect();
    let mut number = 1;
    loop {
        let path = folder.join(format!("{number}.list"));
        match std::fs::File::create_new(&path) {
            Ok(_) => {
                write_atomic(&path, text.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
                return Ok(path);
            }
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(error).with_context(|| format!("cannot write {}", path.display())),
        }
    }
}

fn max_array_size() -> Result<usize> {
    let config = run(Command::new("scontrol").args(["show", "config"]))?;
    let line = config.lines().find_map(|line| line.trim().strip_prefix("MaxArraySize"));
    Ok(line.and_then(|rest| rest.trim_start_matches([' ', '=']).parse().ok()).unwrap_or(MAX_ARRAY_SIZE).max(2) - 1)
}

/// Memory for one session: the most that any session of the study took, else an estimate from the pictures.
fn memory_mb(study: &Study, wanted: &[&StudySession], threads: usize) -> u32 {
    let all = study.sessions().unwrap_or_default();
    let done = all.iter().map(|s| study.status(s)).filter(|s| s.state == State::Done);
    let measured = done.filter_map(|s| s.peak_memory_mb).fold(0.0, f64::max);
    let need = if measured > 0.0 { measured } else { wanted.par_iter().map(|s| estimate_mb(s, threads)).reduce(|| BASE_MB, f64::max) };
    ((HEADROOM * need / 100.0).ceil() * 100.0) as u32
}

// A session without any measured before it: 153 MB were seen for 10 frames of three 160x120 cameras with one thread, 245 MB for
// 12 frames of three 640x480 cameras, 290 MB with two threads.
/// Program, model and fit, 10⁶ bytes.
const BASE_MB: f64 = 200.0;
/// Bytes for every pixel of a camera: the stage, and what each thread has in work.
const PER_PIXEL: f64 = 70.0;
const PER_PIXEL_AND_THREAD: f64 = 50.0;
/// Bytes for every pixel of every frame: masks, their distance fields and clouds.
const PER_PIXEL_AND_FRAME: f64 = 4.0;

fn estimate_mb(session: &StudySession, threads: usize) -> f64 {
    let Ok((session, _)) = Session::open(&session.folder, None) else { return BASE_MB };
    let pixels: f64 = session.rig.cameras.iter().map(|c| f64::from(c.size_px[0]) * f64::from(c.size_px[1])).sum();
    let per_pixel = PER_PIXEL + PER_PIXEL_AND_THREAD * threads as f64 + PER_PIXEL_AND_FRAME * session.frame_count as f64;
    BASE_MB + 1e-6 * pixels * per_pixel
}

/// Arguments of sbatch, and the script.
struct Job {
    arguments: Vec<String>,
    script: PathBuf,
    text: String,
}

fn array_job(study: &Study, list: &Path, tasks: usize, memory_mb: u32, ask: &Ask) -> Job {
    let at_once = ask.at_once.unwrap_or(AT_ONCE);
    let options = [
        "--job-name=muybridge".to_string(),
        format!("--array=0-{}%{at_once}", tasks - 1),
        format!("--cpus-per-task={}", ask.threads),
        format!("--mem={memory_mb}M"),
    ];
    let share = format!("{},\"$SLURM_ARRAY_TASK_ID\",{tasks}", quoted(&list.display().to_string()));
    let text = script(study, "--threads \"$SLURM_CPUS_PER_TASK\" batch", &format!("--jobs 1 --share {share}"));
    job(list, "array", options.to_vec(), text)
}

fn summary_job(study: &Study, list: &Path, array: &str) -> Job {
    let options = ["--job-name=muybridge-summary".to_string(), format!("--dependency=afterany:{array}"), format!("--mem={SUMMARY_MB}M")];
    job(list, "summary", options.to_vec(), script(study, "batch summary", ""))
}

fn job(list: &Path, kind: &str, mut arguments: Vec<String>, text: String) -> Job {
    let script = list.with_extension(format!("{kind}.sh"));
    // A task says little; each session has its own log.
    arguments.push(format!("--output={}", list.with_extension(format!("{kind}.%A_%a.out")).display()));
    Job { arguments, script, text }
}

fn script(study: &Study, verb: &str, rest: &str) -> String {
    let path = |path: &Path| quoted(&path.display().to_string());
    let program = std::env::current_exe().unwrap_or_else(|_| "muybridge".into());
    format!("#!/bin/sh\nexec {} {verb} {} -o {} {rest}\n", path(&program), path(&study.folder), path(&study.results))
}

/// As the shell takes it literally.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// Submits a job and returns its number.
fn sbatch(job: &Job) -> Result<String> {
    write_atomic(&job.script, job.text.as_bytes()).with_context(|| format!("cannot write {}", job.script.display()))?;
    let answer = run(Command::new("sbatch").arg("--parsable").args(&job.arguments).arg(&job.script))?;
    let id = answer.trim().split(';').next().unwrap_or_default().to_string();
    ensure!(!id.is_empty() && id.chars().all(|c| c.is_ascii_digit()), "sbatch answers {answer:?}, not with the number of a job");
    Ok(id)
}

/// What a program of Slurm prints.
fn run(command: &mut Command) -> Result<String> {
    let name = command.get_program().to_string_lossy().into_owned();
    let output = command.output().with_context(|| format!("{name} cannot be started; --engine slurm works where Slurm's commands do"))?;
    let says = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{name} failed: {}", says.lines().filter(|l| !l.trim().is_empty()).collect::<Vec<_>>().join(" "));
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_divide_a_list_and_hostile_names_stay_names() {
        let folder = tempfile::tempdir().unwrap();
        let names: Vec<String> = (0..7).map(|i| format!("it's, \"{i}\" $HOME")).collect();
        let sessions: Vec<StudySession> = names.iter().map(|n| StudySession { name: n.clone(), folder: n.into() }).collect();
        let list = new_list(folder.path(), &sessions.iter().collect::<Vec<_>>()).unwrap();
        assert_ne!(list, new_list(folder.path(), &[]).unwrap());
        let share = |i: usize| parse_share(&format!("{},{i},3", list.display())).unwrap().names().unwrap();
        let mut all: Vec<String> = (0..3).flat_map(share).collect();
        assert_eq!(share(1), [names[1].clone(), names[4].clone()]);
        all.sort();
        assert_eq!(all, names);
        assert!(["a,1", "a,3,3", "a,x,3", ""].iter().all(|text| parse_share(text).is_err()));
        let echoed = Command::new("sh").args(["-c", &format!("printf %s {}", quoted(&names[0]))]).output().unwrap();
        assert_eq!(String::from_utf8_lossy(&echoed.stdout), names[0]);
    }
}

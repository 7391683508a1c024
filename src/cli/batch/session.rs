//! One session of a study, under its lock and in a process of its own.
//!
//! The supervisor holds the lock and hands it on to the process that works, as its output, so that the session stays locked
//! while either lives. The worker ends when the supervisor does. All it writes lies in the session's working folder; when it
//! succeeds that folder's outputs and the status `done` become the session's results by one rename.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail};
use clap::Args;
use muybridge::io::status_json::{self, Key, State, Status};
use muybridge::io::{with_remedy, write_atomic};

use super::study::{Plan, Study, StudySession};
use crate::cli::track::{self, TrackArgs};
use crate::cli::{executable, interrupt, whole};

/// How often the supervisor looks at its worker; longer waits leave cores idle after short sessions.
const GLANCE: Duration = Duration::from_millis(5);
/// Footage that changes while it is worked on is begun again so many times.
const ATTEMPTS: usize = 3;
/// What the worker reports besides its outputs.
const MEMORY_FILE: &str = "peak_memory_mb";
/// Exit code of a worker whose supervisor is gone.
const ORPHANED: i32 = 130;

/// How the work on a session ended.
#[derive(Debug)]
pub enum Ended {
    Done(Status),
    Failed(Status),
    /// There was nothing to do.
    Unchanged(Plan),
    /// Somebody else works on it.
    Busy,
    Interrupted,
}

/// Runs a session with so many threads unless its results are there already.
pub fn settle(study: &Study, session: &StudySession, threads: usize) -> Result<Ended> {
    let log_path = study.log(&session.name);
    let Some(log) = lock(&log_path)? else { return Ok(Ended::Busy) };
    for _ in 0..ATTEMPTS {
        let key = study.key(session);
        match study.plan(session, &key) {
            Plan::Run(_) => {}
            settled => return Ok(Ended::Unchanged(settled)),
        }
        let begun = begin(study, session, &key)?;
        match work(study, session, &log, threads, begun)? {
            None => return Ok(Ended::Interrupted),
            // What changed meanwhile may be why it failed, and what it failed on is not there any more.
            Some(_) if study.key(session) != key => {}
            Some(ended) => return Ok(ended),
        }
    }
    bail!("{}: changes while it is worked on; run the same command again when all is copied", session.folder.display())
}

/// The open log under an exclusive lock; `None` where another process has it. File systems without locks do without.
fn lock(path: &Path) -> Result<Option<File>> {
    let failed = || format!("cannot write {}", path.display());
    whole::create(path.parent().unwrap_or(Path::new(".")))?;
    let log = File::options().create(true).read(true).append(true).open(path).map_err(with_remedy).with_context(failed)?;
    match log.try_lock() {
        Ok(()) => Ok(Some(log)),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(error)) => {
            eprintln!("warning: {}: cannot be locked ({error}); do not run two batches on this study at once", path.display());
            Ok(Some(log))
        }
    }
}

/// Moves earlier results away and says that the session runs.
fn begin(study: &Study, session: &StudySession, key: &Key) -> Result<Status> {
    let (result, work) = (study.result(&session.name), study.work(&session.name));
    whole::create(&work)?;
    retire(&result, &work)?;
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let status = Status {
        state: State::Running,
        host: Some(host()),
        process: Some(std::process::id()),
        slurm_task: slurm_task(),
        started_unix_s: Some(seconds),
        ..Status::pending(&session.name, &session.folder, key)
    };
    status_json::write(&result, &status)?;
    Ok(status)
}

/// Takes results away whole, out of sight first.
fn retire(result: &Path, work: &Path) -> Result<()> {
    let old = work.join("old");
    let gone = |path: &Path| if path.exists() { std::fs::remove_dir_all(path) } else { Ok(()) };
    gone(&old).with_context(|| format!("cannot remove {}", old.display()))?;
    if result.exists() {
        std::fs::rename(result, &old).with_context(|| format!("cannot replace {}", result.display()))?;
    }
    gone(&old).with_context(|| format!("cannot remove {}", old.display()))
}

/// The work itself and what it led to; `None` when Ctrl-C came.
fn work(study: &Study, session: &StudySession, log: &File, threads: usize, begun: Status) -> Result<Option<Ended>> {
    let (result, work) = (study.result(&session.name), study.work(&session.name));
    let out = work.join("out");
    if out.exists() {
        std::fs::remove_dir_all(&out).with_context(|| format!("cannot remove {}", out.display()))?;
    }
    head(log, session).map_err(with_remedy).with_context(|| format!("cannot write {}", study.log(&session.name).display()))?;
    let clock = Instant::now();
    let worker = start(session, &work, log, threads)?;
    let Some(exit) = wait(worker)? else {
        status_json::write(&result, &Status { state: State::Pending, reason: Some("interrupted".into()), ..begun })?;
        return Ok(None);
    };
    let memory = std::fs::read_to_string(work.join(MEMORY_FILE)).ok().and_then(|text| text.trim().parse().ok());
    let ended = Status { seconds: Some(clock.elapsed().as_secs_f64()), peak_memory_mb: memory, ..begun };
    if exit.success() {
        let status = Status { state: State::Done, ..ended };
        status_json::write(&out, &status)?;
        retire(&result, &work)?;
        std::fs::rename(&out, &result).with_context(|| format!("cannot write {}", result.display()))?;
        std::fs::remove_dir_all(&work).with_context(|| format!("cannot remove {}", work.display()))?;
        return Ok(Some(Ended::Done(status)));
    }
    let reason = reason(log, exit, &study.log(&session.name));
    // The row names the session already.
    let folder = session.folder.display().to_string();
    let reason = reason.replace(&format!("{folder}: "), "").replace(&format!("{folder}/"), "");
    let status = Status { state: State::Failed, reason: Some(reason), ..ended };
    // In this order: where the disk is full it makes the room for the status.
    std::fs::remove_dir_all(&work).with_context(|| format!("cannot remove {}", work.display()))?;
    status_json::write(&result, &status)?;
    Ok(Some(Ended::Failed(status)))
}

/// Begins the log anew. On a disk that fills up later the block of these lines still takes the worker's reason.
fn head(mut log: &File, session: &StudySession) -> std::io::Result<()> {
    log.set_len(0)?;
    writeln!(log, "muybridge {}, {}", env!("CARGO_PKG_VERSION"), session.folder.display())
}

/// The worker: this program with [`WorkerArgs`].
fn start(session: &StudySession, work: &Path, log: &File, threads: usize) -> Result<Child> {
    let program = executable();
    let failed = || format!("cannot start {}", program.display());
    let mut command = Command::new(&program);
    command.arg("--threads").arg(threads.to_string()).args(["batch", "worker"]).arg(&session.folder).arg(work);
    command.stdin(Stdio::piped()).stdout(log.try_clone().with_context(failed)?).stderr(log.try_clone().with_context(failed)?);
    command.spawn().with_context(failed)
}

/// Waits for the worker; on Ctrl-C ends it and returns `None`.
fn wait(mut worker: Child) -> Result<Option<ExitStatus>> {
    let pipe = worker.stdin.take();
    loop {
        if interrupt::came() {
            drop(pipe);
            worker.wait().context("the worker is lost")?;
            return Ok(None);
        }
        if let Some(exit) = worker.try_wait().context("the worker is lost")? {
            // A Ctrl-C reaches both; the worker may be the faster one.
            std::thread::sleep(GLANCE);
            return Ok((!interrupt::came()).then_some(exit));
        }
        std::thread::sleep(GLANCE);
    }
}

/// Why a worker failed: its last error, or what ended it.
fn reason(log: &File, exit: ExitStatus, path: &Path) -> String {
    let mut bytes = Vec::new();
    let mut log = log;
    let read = log.rewind().and_then(|()| log.read_to_end(&mut bytes));
    let text = read.map_or(String::new(), |_| String::from_utf8_lossy(&bytes).into_owned());
    if let Some(error) = text.lines().rev().find_map(|line| line.strip_prefix("error: ")) {
        return error.to_string();
    }
    let mut lines = text.lines();
    if lines.any(|line| line.contains("panicked at")) {
        let message = lines.next().unwrap_or_default();
        return format!("a bug in the program: {message}; {} has the details, please report it", path.display());
    }
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&exit) {
        let remedy =
            if signal == 9 { "; most often that is the system out of memory: run again with fewer --jobs and --retry-failed" } else { "" };
        return format!("the process was killed by signal {signal}{remedy}");
    }
    format!("the process ended with {exit}; {} has what it said", path.display())
}

fn host() -> String {
    std::fs::read_to_string("/proc/sys/kernel/hostname").map_or("unknown".into(), |name| name.trim().to_string())
}

/// The task of a Slurm array that this process is.
fn slurm_task() -> Option<String> {
    let part = |name: &str| std::env::var(name).ok();
    Some(format!("{}_{}", part("SLURM_ARRAY_JOB_ID")?, part("SLURM_ARRAY_TASK_ID")?))
}

#[derive(Args)]
pub struct WorkerArgs {
    /// Session folder
    session: PathBuf,
    /// Working folder, made by the supervisor
    work: PathBuf,
}

/// The whole job on one session, for the supervisor that started this process.
pub fn worker(args: &WorkerArgs) -> Result<()> {
    end_with_the_supervisor();
    track::run(&TrackArgs::of(&args.session, args.work.join("out"), args.work.clone()))?;
    let path = args.work.join(MEMORY_FILE);
    write_atomic(&path, peak_memory_mb().map_or(String::new(), |mb| mb.to_string()).as_bytes())
        .with_context(|| format!("cannot write {}", path.display()))
}

/// Nothing is ever written to the worker's input: it ends when the supervisor has ended or wants this process to end.
fn end_with_the_supervisor() {
    std::thread::spawn(|| {
        let _ = std::io::stdin().read(&mut [0]);
        std::process::exit(ORPHANED);
    });
}

/// The most memory this process ever had, 10⁶ bytes; `None` where the system does not tell.
fn peak_memory_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some((kibibytes * 1.024e-3).round())
}

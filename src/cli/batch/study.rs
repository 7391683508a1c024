//! The sessions of a study, and what is to be done about each.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use muybridge::io::content::{self, RIG_FILE};
use muybridge::io::session_config;
use muybridge::io::status_json::{self, Key, State, Status};
use muybridge::io::video::is_video_name;

/// Names in the results folder that no session can have.
const RESERVED: [&str; 3] = ["logs", "summary.csv", "index.html"];

/// A folder of sessions with the folder of their results.
pub struct Study {
    pub folder: PathBuf,
    pub results: PathBuf,
    /// What identifies this program.
    pub program: String,
    /// Whether sessions that failed are tried again though nothing changed.
    pub retry: bool,
}

/// One session of a study.
#[derive(Clone, Debug, PartialEq)]
pub struct StudySession {
    /// Path below the study, parts joined by `/`.
    pub name: String,
    pub folder: PathBuf,
}

/// What is to be done about a session.
#[derive(Clone, Debug, PartialEq)]
pub enum Plan {
    /// To be run, and why.
    Run(String),
    /// The results are those of this key.
    Done,
    /// Failed with this key; why.
    Failed(String),
}

impl Study {
    /// `results` is `study/results` without a word about it; it need not be there yet.
    pub fn open(study: &Path, results: Option<&Path>, retry: bool) -> Result<Study> {
        ensure!(study.is_dir(), "{}: is not a folder; give the folder that holds the session folders", study.display());
        let folder = study.canonicalize().with_context(|| study.display().to_string())?;
        let results = results.map_or_else(|| Ok(folder.join("results")), std::path::absolute)?;
        let results = results.canonicalize().unwrap_or(results);
        let program = content::program(&super::super::executable());
        Ok(Study { folder, results, program, retry })
    }

    /// All sessions below the study, in natural order. A folder with footage (`cam…` folders or videos) is one, broken or
    /// not, and so is a folder with a rig file that has no sessions below it.
    pub fn sessions(&self) -> Result<Vec<StudySession>> {
        let mut found = Vec::new();
        self.search(&self.folder, &mut Vec::new(), &mut found)?;
        let itself = found.iter().any(|s| s.name.is_empty());
        ensure!(!itself, "{}: is a session itself; run `muybridge track` on it, or give the folder above", self.folder.display());
        ensure!(
            !found.is_empty(),
            "{}: no session below it; a session folder holds {RIG_FILE} and the cameras' footage",
            self.folder.display()
        );
        let reserved = found.iter().find(|s| s.name.split('/').next().is_some_and(|part| RESERVED.contains(&part)));
        if let Some(session) = reserved {
            anyhow::bail!("{}: a batch writes a file of this name itself; rename the folder", session.folder.display());
        }
        found.sort_by(|a, b| natord::compare(&a.name, &b.name).then_with(|| a.name.cmp(&b.name)));
        Ok(found)
    }

    /// `above` are the real folders on the way, against links that lead back.
    fn search(&self, folder: &Path, above: &mut Vec<PathBuf>, found: &mut Vec<StudySession>) -> Result<()> {
        let failed = || format!("{}: cannot be read", folder.display());
        let real = folder.canonicalize().with_context(failed)?;
        if real == self.results || above.contains(&real) {
            return Ok(());
        }
        let entries = folder.read_dir().with_context(failed)?.map(|e| e.map(|e| e.path())).collect::<std::io::Result<Vec<_>>>();
        let entries: Vec<PathBuf> = entries.with_context(failed)?.into_iter().filter(|p| !name(p).starts_with('.')).collect();
        let before = found.len();
        if !entries.iter().any(|path| is_footage(path)) {
            above.push(real);
            for below in entries.iter().filter(|path| path.is_dir()) {
                self.search(below, above, found)?;
            }
            above.pop();
            if found.len() > before || !entries.iter().any(|path| name(path) == RIG_FILE) {
                return Ok(());
            }
        }
        let below = folder.strip_prefix(&self.folder).unwrap_or(folder);
        let parts: Vec<_> = below.components().map(|c| c.as_os_str().to_string_lossy()).collect();
        found.push(StudySession { name: parts.join("/"), folder: folder.to_path_buf() });
        Ok(())
    }

    /// Where a session's results go.
    pub fn result(&self, session: &str) -> PathBuf {
        self.results.join(session)
    }

    /// What an unfinished session keeps.
    pub fn work(&self, session: &str) -> PathBuf {
        self.results.join(".work").join(session)
    }

    /// What the last run of a session said; its lock too.
    pub fn log(&self, session: &str) -> PathBuf {
        self.results.join("logs").join(format!("{session}.log"))
    }

    /// The key that a session's results would have now.
    pub fn key(&self, session: &StudySession) -> Key {
        let config = session_config::read(&session.folder).map_err(|error| error.to_string());
        content::key(&session.folder, &config, &self.program)
    }

    /// What is to be done about a session with this key.
    pub fn plan(&self, session: &StudySession, key: &Key) -> Plan {
        let Some(status) = status_json::read(&self.result(&session.name)) else { return Plan::Run("never run".into()) };
        match status.state {
            State::Pending => Plan::Run(status.reason.unwrap_or("never run".into())),
            State::Running => Plan::Run("interrupted".into()),
            State::Done | State::Failed if status.key != *key => Plan::Run(difference(&status.key, key)),
            State::Done => Plan::Done,
            State::Failed if self.retry => Plan::Run("failed before".into()),
            State::Failed => Plan::Failed(status.reason.unwrap_or_default()),
        }
    }

    /// Whether somebody works on the session: the log is locked by the process that does, and by nobody once that has ended,
    /// however it ended. Where the file system has no locks nobody seems to work on anything.
    pub fn is_busy(&self, session: &str) -> bool {
        let log = File::options().read(true).write(true).open(self.log(session));
        log.is_ok_and(|log| matches!(log.try_lock(), Err(std::fs::TryLockError::WouldBlock)))
    }

    /// Where a session stands, by its status file and its lock.
    pub fn status(&self, session: &StudySession) -> Status {
        let never = || Status::pending(&session.name, &session.folder, &Key::default());
        // Names and places are the study's, whatever the file says.
        let here = |status| Status { session: session.name.clone(), folder: session.folder.clone(), ..status };
        let status = status_json::read(&self.result(&session.name)).map_or_else(never, here);
        if status.state == State::Running && !self.is_busy(&session.name) {
            let reason = "interrupted: killed, out of memory or out of time; run the same command to go on";
            return Status { state: State::Pending, reason: Some(reason.into()), ..status };
        }
        status
    }
}

fn difference(before: &Key, now: &Key) -> String {
    let parts = [
        ("inputs", before.inputs_hash != now.inputs_hash),
        ("options", before.options_hash != now.options_hash),
        ("model", before.model_hash != now.model_hash),
        ("program", before.version != now.version),
    ];
    let changed: Vec<&str> = parts.iter().filter(|(_, changed)| *changed).map(|(what, _)| *what).collect();
    format!("{} changed", changed.join(" and "))
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A camera's folder or video: `cam` and digits.
fn is_footage(path: &Path) -> bool {
    let name = if path.is_dir() { name(path) } else { path.file_stem().unwrap_or_default().to_string_lossy().into_owned() };
    let digits = name.strip_prefix("cam").map(|rest| rest.trim_start_matches(['_', '-']));
    (path.is_dir() || is_video_name(path)) && digits.is_some_and(|d| !d.is_empty() && d.chars().all(|c| c.is_ascii_digit()))
}

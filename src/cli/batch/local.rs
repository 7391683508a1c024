//! The sessions of a batch on this machine, several at once.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Result, ensure};
use muybridge::io::status_json::{self, Key, Status};

use super::session::{Ended, settle};
use super::study::{Plan, Study, StudySession};
use crate::cli::interrupt;

/// How often a session that another batch works on is looked at.
const PATIENCE: Duration = Duration::from_millis(200);

/// What became of the chosen sessions.
#[derive(Debug, Default)]
pub struct Outcome {
    /// Now.
    pub done: usize,
    /// Now.
    pub failed: usize,
    /// One sentence per session that failed, now or before.
    pub failures: Vec<String>,
    pub interrupted: bool,
}

impl Outcome {
    /// An error where a session failed or none was looked at any more.
    pub fn verdict(&self) -> Result<()> {
        ensure!(!self.interrupted, "interrupted; run the same command to go on");
        ensure!(self.failures.is_empty(), "{} of the sessions failed: {}", self.failures.len(), self.failures.join("; "));
        Ok(())
    }
}

/// Works through the sessions, `jobs` at once with an equal part of `threads` each. Sessions that another batch works on come
/// last and are waited for.
pub fn work(study: &Study, sessions: &[StudySession], jobs: usize, threads: usize) -> Result<Outcome> {
    for session in sessions.iter().filter(|s| status_json::read(&study.result(&s.name)).is_none()) {
        if !study.is_busy(&session.name) {
            status_json::write(&study.result(&session.name), &Status::pending(&session.name, &session.folder, &Key::default()))?;
        }
    }
    let jobs = jobs.min(sessions.len()).max(1);
    let desk = Desk { study, sessions, threads: (threads / jobs).max(1), next: AtomicUsize::new(0), outcome: Mutex::default() };
    std::thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| desk.serve());
        }
    });
    let mut outcome = desk.outcome.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner());
    outcome.interrupted = interrupt::came();
    Ok(outcome)
}

/// What the threads of a batch share.
struct Desk<'a> {
    study: &'a Study,
    sessions: &'a [StudySession],
    /// Of each worker.
    threads: usize,
    next: AtomicUsize,
    outcome: Mutex<Outcome>,
}

impl Desk<'_> {
    fn serve(&self) {
        let mut busy = Vec::new();
        while let Some(session) = self.sessions.get(self.next.fetch_add(1, Ordering::Relaxed)) {
            if interrupt::came() {
                return;
            }
            if !self.attend(session) {
                eprintln!("{}: another batch works on it; waiting for that at the end", session.name);
                busy.push(session);
            }
        }
        while !busy.is_empty() && !interrupt::came() {
            std::thread::sleep(PATIENCE);
            busy.retain(|session| !self.attend(session));
        }
    }

    /// Settles a session and tells how; `false` while another batch works on it.
    fn attend(&self, session: &StudySession) -> bool {
        let ended = settle(self.study, session, self.threads);
        if matches!(ended, Ok(Ended::Busy)) {
            return false;
        }
        let mut outcome = self.outcome.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let fail = |outcome: &mut Outcome, reason: &str| outcome.failures.push(format!("{}: {reason}", session.name));
        match ended {
            Ok(Ended::Done(status)) => {
                outcome.done += 1;
                println!("{}: done in {:.1} s", session.name, status.seconds.unwrap_or(0.0));
            }
            Ok(Ended::Failed(status)) => {
                let reason = status.reason.unwrap_or_default();
                outcome.failed += 1;
                println!("{}: failed: {reason}", session.name);
                fail(&mut outcome, &reason);
            }
            Ok(Ended::Unchanged(Plan::Failed(reason))) => fail(&mut outcome, &reason),
            Ok(Ended::Unchanged(_) | Ended::Busy | Ended::Interrupted) => {}
            Err(error) => {
                outcome.failed += 1;
                println!("{}: failed: {error:#}", session.name);
                fail(&mut outcome, &format!("{error:#}"));
            }
        }
        true
    }
}

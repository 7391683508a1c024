//! What a batch says about its sessions: what would run, where each stands, and how the study ended.

use anyhow::{Context, Result, bail};
use muybridge::io::status_json::{self, COLUMNS, State, Status};
use muybridge::io::write_atomic;
use muybridge::report;
use rayon::prelude::*;

use super::study::{Plan, Study, StudySession};

/// Failures that the table names one by one; summary.csv has them all.
const NAMED: usize = 40;

/// Prints what a batch would do with each session, and why.
pub fn list(study: &Study, names: bool) -> Result<()> {
    let sessions = study.sessions()?;
    if names {
        sessions.iter().for_each(|s| println!("{}", s.name));
        return Ok(());
    }
    let plans: Vec<[String; 2]> = sessions.par_iter().map(|session| words(study, session)).collect();
    let width = sessions.iter().map(|s| s.name.chars().count()).max().unwrap_or(0);
    for (session, [action, why]) in sessions.iter().zip(&plans) {
        println!("{:width$}  {action:7}  {why}", session.name);
    }
    let to_run = plans.iter().filter(|[action, _]| action == "run").count();
    println!("{to_run} of {} sessions to run", sessions.len());
    Ok(())
}

fn words(study: &Study, session: &StudySession) -> [String; 2] {
    if study.is_busy(&session.name) {
        return ["running".into(), place(&study.status(session))];
    }
    match study.plan(session, &study.key(session)) {
        Plan::Run(why) => ["run".into(), why],
        Plan::Done => ["done".into(), "nothing changed since".into()],
        Plan::Failed(reason) => ["failed".into(), format!("{reason} (nothing changed since; --retry-failed runs it again)")],
    }
}

/// Where a session runs.
fn place(status: &Status) -> String {
    let slurm = status.slurm_task.as_ref().map_or(String::new(), |task| format!(", Slurm task {task}"));
    format!("on {}, process {}{slurm}", status.host.as_deref().unwrap_or("?"), status.process.unwrap_or(0))
}

/// Prints where each session stands.
pub fn status(study: &Study) -> Result<()> {
    let sessions = study.sessions()?;
    let statuses: Vec<Status> = sessions.iter().map(|s| study.status(s)).collect();
    let width = sessions.iter().map(|s| s.name.chars().count()).max().unwrap_or(0);
    for status in &statuses {
        let note = match status.state {
            State::Running => place(status),
            State::Done => format!("{:.1} s", status.seconds.unwrap_or(0.0)),
            State::Pending | State::Failed => status.reason.clone().unwrap_or_default(),
        };
        println!("{}", format!("{:width$}  {:7}  {note}", status.session, status.state.name()).trim_end());
    }
    println!("{}", counts(&statuses));
    Ok(())
}

fn counts(statuses: &[Status]) -> String {
    let count = |state: State| statuses.iter().filter(|s| s.state == state).count();
    let states = [State::Done, State::Failed, State::Running, State::Pending];
    let parts = states.map(|state| (count(state), state.name()));
    let some: Vec<String> = parts.iter().filter(|(n, _)| *n > 0).map(|(n, name)| format!("{n} {name}")).collect();
    format!("{} sessions: {}", statuses.len(), some.join(", "))
}

/// The columns of summary.csv that the page shows.
const SHOWN: std::ops::Range<usize> = 3..8;

/// Writes the study's page.
fn write_page(study: &Study, statuses: &[Status]) -> Result<()> {
    let values: Vec<Vec<String>> = statuses.iter().map(|s| status_json::row(&study.results, s)[SHOWN].to_vec()).collect();
    let reports: Vec<String> = statuses.iter().map(|s| format!("{}/report.html", s.session)).collect();
    let thumbnails: Vec<_> = statuses.iter().map(|s| std::fs::read(study.result(&s.session).join("thumbnail.jpg")).ok()).collect();
    let rows = statuses.iter().enumerate().map(|(i, status)| report::study::StudyRow {
        session: &status.session,
        state: status.state.name(),
        reason: status.reason.as_deref(),
        report: study.results.join(&reports[i]).exists().then_some(reports[i].as_str()),
        thumbnail: thumbnails[i].as_deref(),
        values: values[i].clone(),
    });
    let title = study.folder.file_name().unwrap_or_default().to_string_lossy();
    let page = report::study::Study { title: &title, columns: COLUMNS[SHOWN].to_vec(), rows: rows.collect() };
    let path = study.results.join("index.html");
    write_atomic(&path, report::study::html(&page).as_bytes()).with_context(|| format!("cannot write {}", path.display()))
}

/// Writes index.html and, when all else is in place, summary.csv of all sessions; prints counts and failures. An error where a
/// chosen session failed or is not done.
pub fn summarise(study: &Study, all: &[StudySession], chosen: &[StudySession]) -> Result<()> {
    let mut statuses: Vec<Status> = all.iter().map(|s| study.status(s)).collect();
    write_page(study, &statuses)?;
    status_json::write_summary(&study.results, &statuses)?;
    statuses.retain(|status| chosen.iter().any(|s| s.name == status.session));
    println!("{}, in {}", counts(&statuses), study.results.display());
    let failed: Vec<&Status> = statuses.iter().filter(|s| s.state == State::Failed).collect();
    let width = failed.iter().map(|s| s.session.chars().count()).max().unwrap_or(0);
    for status in failed.iter().take(NAMED) {
        println!("  {:width$}  {}", status.session, status.reason.as_deref().unwrap_or_default());
    }
    if failed.len() > NAMED {
        println!("  and {} more, in summary.csv", failed.len() - NAMED);
    }
    let open = statuses.iter().filter(|s| matches!(s.state, State::Pending | State::Running)).count();
    match (failed.len(), open) {
        (0, 0) => Ok(()),
        (0, open) => bail!("{open} of {} sessions are not done; run the same command to go on", statuses.len()),
        (failed, _) => bail!(
            "{failed} of {} sessions failed; mend what the reasons say and run the same command again (--retry-failed where nothing needs mending)",
            statuses.len()
        ),
    }
}

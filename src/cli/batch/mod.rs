//! `muybridge batch`: every session of a study, whatever breaks on the way.
//!
//! Each session is worked on by a process of its own under a lock of its own ([`session`]), here or as a task of a Slurm array
//! ([`slurm`]). Results count by what they were made of ([`muybridge::io::content`]), so the same command does what is missing,
//! and nothing when nothing is.

mod local;
mod session;
mod slurm;
mod study;
mod table;

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use clap::{Args, Subcommand, ValueEnum};

use study::{Study, StudySession};

#[derive(Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct BatchArgs {
    #[command(subcommand)]
    command: Option<BatchCommand>,
    #[command(flatten)]
    place: Option<PlaceArgs>,
    #[command(flatten)]
    run: RunArgs,
}

#[derive(Subcommand)]
enum BatchCommand {
    /// What a batch would do with every session, and why
    List {
        #[command(flatten)]
        place: PlaceArgs,
        /// Only the names, for scripts
        #[arg(long)]
        names: bool,
    },
    /// Where every session stands
    Status(PlaceArgs),
    /// Writes summary.csv and index.html anew and fails where a session failed
    Summary(PlaceArgs),
    #[command(hide = true)]
    Worker(session::WorkerArgs),
}

#[derive(Args)]
struct PlaceArgs {
    /// Folder with the sessions, at any depth
    study: PathBuf,
    /// Folder for one folder per session and summary.csv; STUDY/results without it
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

#[derive(Args)]
struct RunArgs {
    /// Where to work: on this machine, or as a job array of the Slurm that answers here
    #[arg(long, default_value = "local")]
    engine: Engine,
    /// Sessions at once; one per thread here and 32 tasks in Slurm without it
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    jobs: Option<u16>,
    /// Only the session of this name; repeats
    #[arg(long, value_name = "SESSION")]
    only: Vec<String>,
    /// Also run again what failed, though nothing changed
    #[arg(long)]
    retry_failed: bool,
    /// Memory to ask Slurm for, 10⁶ bytes per session; what earlier sessions needed without it
    #[arg(long, value_name = "MB")]
    memory: Option<u32>,
    /// Only these lines of a list of names: FILE,INDEX,STRIDE
    #[arg(long, hide = true, value_parser = slurm::parse_share, conflicts_with = "only")]
    share: Option<slurm::Share>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Engine {
    Local,
    Slurm,
}

pub fn run(args: &BatchArgs, threads: Option<usize>) -> Result<()> {
    match &args.command {
        Some(BatchCommand::List { place, names }) => table::list(&place.open(false)?, *names),
        Some(BatchCommand::Status(place)) => table::status(&place.open(false)?),
        Some(BatchCommand::Summary(place)) => {
            let study = place.open(false)?;
            let sessions = study.sessions()?;
            table::summarise(&study, &sessions, &sessions)
        }
        Some(BatchCommand::Worker(args)) => session::worker(args),
        None => {
            let place = args.place.as_ref().context("give the study's folder")?;
            batch(&place.open(args.run.retry_failed)?, &args.run, threads)
        }
    }
}

impl PlaceArgs {
    fn open(&self, retry: bool) -> Result<Study> {
        Study::open(&self.study, self.output.as_deref(), retry)
    }
}

fn batch(study: &Study, args: &RunArgs, threads: Option<usize>) -> Result<()> {
    let all = study.sessions()?;
    let chosen = choose(&all, args)?;
    if args.engine == Engine::Slurm {
        let ask = slurm::Ask { threads: threads.unwrap_or(1), at_once: args.jobs, memory_mb: args.memory };
        return slurm::submit(study, &chosen, &ask);
    }
    let threads = threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, |n| n.get()));
    let outcome = local::work(study, &chosen, args.jobs.map_or(threads, usize::from), threads)?;
    if args.share.is_some() {
        // The summary is the dependent job's.
        return outcome.verdict();
    }
    ensure!(!outcome.interrupted, "interrupted; run the same command to go on");
    if outcome.done + outcome.failed == 0 {
        println!("nothing to do: nothing changed since the last run");
    }
    table::summarise(study, &all, &chosen).and(outcome.verdict())
}

/// The sessions that the command line names, all without a name.
fn choose(all: &[StudySession], args: &RunArgs) -> Result<Vec<StudySession>> {
    let names = match &args.share {
        Some(share) => share.names().with_context(|| share.list.display().to_string())?,
        None if args.only.is_empty() => return Ok(all.to_vec()),
        None => args.only.clone(),
    };
    for name in &names {
        ensure!(all.iter().any(|s| s.name == *name), "{name}: no such session; `muybridge batch list STUDY` names them");
    }
    Ok(all.iter().filter(|s| names.contains(&s.name)).cloned().collect())
}

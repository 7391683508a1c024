//! One file per subcommand: load, call the library, save, report.

mod check;
mod disparity;
mod progress;

use anyhow::Result;
use clap::{Parser, Subcommand};

#[derive(Parser)]
#[command(name = "muybridge", version, about = "Video to editable 3D motion")]
pub struct Cli {
    /// Threads to use; all cores without it. Results do not depend on it.
    #[arg(long, global = true)]
    threads: Option<usize>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// What is wrong with a session and what to do, before any long work
    Check(check::CheckArgs),
    /// Disparities of one rectified pair or triple of pictures
    Disparity(disparity::DisparityArgs),
}

/// OpenCV and FFmpeg print about damaged files on stderr, where our own one sentence belongs; their own variables decide.
pub fn silence_opencv() {
    for (variable, quiet) in [("OPENCV_LOG_LEVEL", "SILENT"), ("OPENCV_FFMPEG_LOGLEVEL", "-8")] {
        if std::env::var_os(variable).is_none() {
            // SAFETY: called first in main, while there is no other thread that could read the environment.
            unsafe { std::env::set_var(variable, quiet) };
        }
    }
}

/// Runs the command line.
pub fn run(cli: Cli) -> Result<()> {
    rayon::ThreadPoolBuilder::new().num_threads(cli.threads.unwrap_or(0)).build_global()?;
    match cli.command {
        Command::Check(args) => check::run(&args),
        Command::Disparity(args) => disparity::run(&args),
    }
}

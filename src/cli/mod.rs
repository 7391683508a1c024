//! One file per subcommand: load, call the library, save, report.

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
    /// Disparities of one rectified pair or triple of pictures
    Disparity(disparity::DisparityArgs),
}

/// Runs the command line.
pub fn run(cli: Cli) -> Result<()> {
    rayon::ThreadPoolBuilder::new().num_threads(cli.threads.unwrap_or(0)).build_global()?;
    match cli.command {
        Command::Disparity(args) => disparity::run(&args),
    }
}

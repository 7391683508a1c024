//! One file per subcommand: load, call the library, save, report.
mod animal;
mod batch;
mod bench;
mod blend;
mod board;
mod calibrate;
mod check;
mod clouds;
mod demo;
mod disparity;
mod generate;
mod interrupt;
mod manner;
mod model;
mod motions;
mod observe;
mod outputs;
mod profile;
mod progress;
mod render;
mod rig;
pub mod say;
mod track;
mod track_report;
mod whole;

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
    /// The whole main job on footage of a phantom, with its errors against the known truth
    Demo(demo::DemoArgs),
    /// What is wrong with a session and what to do, before any long work
    Check(check::CheckArgs),
    /// A rig from pictures of a chessboard or ChArUco board
    Calibrate(calibrate::CalibrateArgs),
    /// The person's point cloud in every frame of a session, as PLY files
    Clouds(clouds::CloudsArgs),
    /// Disparities of one rectified pair or triple of pictures
    Disparity(disparity::DisparityArgs),
    /// Rig files in words and a picture and from one form to another; boards to calibrate with
    #[command(subcommand)]
    Rig(rig::RigCommand),
    /// Motion databases and their PCA models
    #[command(subcommand)]
    Model(model::ModelCommand),
    /// The same person at other speeds or jump lengths
    Generate(Box<generate::GenerateArgs>),
    /// Motions in a vector space: mixed, with less or more of an attribute, caricatured, varied
    #[command(subcommand)]
    Blend(blend::BlendCommand),
    /// A session's footage to the person's motion, style and size
    Track(track::TrackArgs),
    /// Every session of a study, whatever breaks on the way; results that are there already are kept
    Batch(batch::BatchArgs),
    /// From one video of an animal to its motion
    #[command(subcommand)]
    Animal(animal::AnimalCommand),
    /// Accuracy and time beside OpenCV's, against known truth
    #[command(subcommand)]
    Bench(bench::BenchCommand),
    /// Phantom footage of a motion file before a rig, with its truth
    Render(render::RenderArgs),
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

/// A write beyond the largest allowed file (`ulimit -f`) shall be an error of that write, with its sentence, not the silent end of
/// the program.
pub fn outlive_file_limits() {
    #[cfg(unix)]
    // SAFETY: ignoring a signal runs no code of ours.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
}

/// Runs the command line.
pub fn run(cli: Cli) -> Result<()> {
    rayon::ThreadPoolBuilder::new().num_threads(cli.threads.unwrap_or(0)).build_global()?;
    // The cores are rayon's; OpenCV's own pool would only take turns with it.
    opencv::core::set_num_threads(1)?;
    interrupt::catch();
    match cli.command {
        Command::Demo(args) => demo::run(&args),
        Command::Batch(args) => batch::run(&args, cli.threads),
        Command::Check(args) => check::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Clouds(args) => clouds::run(&args),
        Command::Disparity(args) => disparity::run(&args),
        Command::Track(args) => track::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Rig(command) => rig::run(&command),
        Command::Animal(command) => animal::run(&command),
        Command::Bench(command) => bench::run(&command),
        Command::Model(command) => model::run(command),
        Command::Generate(args) => generate::run(*args),
        Command::Blend(command) => blend::run(command),
    }
}

/// This program, also when its file was replaced since it began.
fn executable() -> std::path::PathBuf {
    let running = std::path::Path::new("/proc/self/exe");
    if running.exists() { running.to_path_buf() } else { std::env::current_exe().unwrap_or_else(|_| "muybridge".into()) }
}

fn positive(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0).ok_or("must be a positive number".into())
}

/// A part of a whole, above 0 and up to 1.
fn part(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|v: &f64| *v > 0.0 && *v <= 1.0).ok_or("must be above 0 and at most 1".into())
}

//! `muybridge clouds`: a session's point clouds as PLY files.

use super::progress;
use anyhow::{Context, Result, bail};
use muybridge::clouds::{CloudOptions, CloudRig};
use muybridge::io::ply::write_ply;
use muybridge::io::session::Session;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct CloudsArgs {
    /// Session folder with Calib.toml and one folder or video per camera.
    session: PathBuf,
    /// Folder for 000000.ply and so on.
    #[arg(short, long, default_value = "clouds")]
    output: PathBuf,
    /// Frames per second of pictures.
    #[arg(long)]
    fps: Option<f64>,
    /// Nothing nearer to the cameras is looked for, metres.
    #[arg(long, value_name = "M")]
    nearest: Option<f64>,
    /// Keep one point per cube of this side, metres.
    #[arg(long, value_name = "M")]
    voxel: Option<f64>,
}

pub fn run(args: &CloudsArgs) -> Result<()> {
    let mut options = CloudOptions { voxel_m: args.voxel, ..CloudOptions::default() };
    options.nearest_m = args.nearest.unwrap_or(options.nearest_m);
    if args.voxel.is_some_and(|side| side.is_nan() || side <= 0.0) {
        bail!("--voxel must be a length above 0 m");
    }
    let (session, notices) = Session::open(&args.session, args.fps)?;
    notices.iter().for_each(|notice| eprintln!("note: {notice}"));
    if session.backgrounds.is_none() {
        eprintln!("note: no pictures of the empty stage (NAME_background.png), so the clouds hold the stage too");
    }
    let rig = CloudRig::new(&session.rig, session.backgrounds.as_deref(), &options)
        .with_context(|| format!("the rig of {}", args.session.display()))?;
    let progress = progress::bar("clouds", session.frame_count as u64);
    let (mut points, mut seen) = (0, 0);
    for frame in session.frames() {
        let frame = frame?;
        let cloud = rig.frame(&frame.images, &options).with_context(|| format!("frame {}", frame.number))?.cloud;
        write_ply(&args.output.join(format!("{:06}.ply", frame.number)), &cloud)?;
        points += cloud.points.len();
        seen += usize::from(!cloud.points.is_empty());
        progress.inc(1);
    }
    progress.finish();
    if seen == 0 {
        bail!(
            "{}: nobody is in view in any of the {} frames; check that the pictures show a person that the stage pictures do not",
            args.session.display(),
            session.frame_count
        );
    }
    println!("{seen} of {} frames with a person, {} points per frame, in {}", session.frame_count, points / seen, args.output.display());
    Ok(())
}

//! `muybridge clouds`: a session's point clouds as PLY files.

use super::{observe::observe, whole};
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
    let stage = session.stages()?;
    let rig = CloudRig::new(&session.rig, Some(&stage), &options).with_context(|| format!("the rig of {}", args.session.display()))?;
    let partial = whole::beside(&args.output)?;
    let (mut points, mut seen) = (0, 0);
    observe(&session, &rig, &options, None, |frame, found| {
        write_ply(&partial.path().join(format!("{:06}.ply", frame.number)), &found.cloud)?;
        points += found.cloud.points.len();
        seen += usize::from(!found.cloud.points.is_empty());
        Ok(())
    })?;
    whole::publish(partial, &args.output)?;
    println!(
        "{seen} of {} frames with a person, {} points per frame, in {}",
        session.frame_count,
        points / seen.max(1),
        args.output.display()
    );
    Ok(())
}

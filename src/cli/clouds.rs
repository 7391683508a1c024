//! `muybridge clouds`: a session's point clouds as PLY files.

use super::progress;
use anyhow::{Context, Result, bail};
use image::GrayImage;
use muybridge::clouds::{CloudOptions, CloudRig};
use muybridge::footage::foreground::{spread, stage_from_frames};
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
    let stage = stage_pictures(&session)?;
    let rig = CloudRig::new(&session.rig, Some(&stage), &options).with_context(|| format!("the rig of {}", args.session.display()))?;
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

/// The session's empty-stage pictures, or else the median of each camera's frames over time.
pub(super) fn stage_pictures(session: &Session) -> Result<Vec<GrayImage>> {
    if let Some(pictures) = &session.backgrounds {
        return Ok(pictures.clone());
    }
    eprintln!("note: no pictures of the empty stage (NAME_background.png); taking the median over time, which needs a person who walks on");
    let wanted = spread(session.frame_count, STAGE_FRAMES);
    let mut cameras: Vec<Vec<GrayImage>> = vec![Vec::new(); session.rig.cameras.len()];
    for (index, frame) in session.frames().enumerate() {
        let frame = frame?;
        if wanted.contains(&index) {
            cameras.iter_mut().zip(frame.images).for_each(|(camera, image)| camera.push(image));
        }
    }
    cameras.iter().map(|frames| stage_from_frames(frames).context("the session has no frames")).collect()
}

/// Enough for a median that a person who covers a place in a third of the frames does not reach; more only cost memory.
const STAGE_FRAMES: usize = 31;

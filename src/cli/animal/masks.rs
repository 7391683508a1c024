//! `muybridge animal masks`: silhouettes from rectangles.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use image::RgbImage;
use muybridge::animal::masks::{Mark, MaskError, MaskOptions, silhouettes};
use muybridge::io::animal_clip::{read_clip, write_masks};
use muybridge::io::animal_json::{self, MasksRecord};
use muybridge::report::animal::mask_sheet;
use serde::{Deserialize, Serialize};

use super::super::{interrupt, progress, whole};
use super::{FrameRange, Placed, Switch, replace, save};

#[derive(clap::Args)]
pub struct MasksArgs {
    /// A video, or a folder of PNG or JPEG pictures
    video: PathBuf,
    #[command(flatten)]
    choices: MaskChoices,
    /// Folder for one black and white PNG per frame
    #[arg(short, long)]
    output: PathBuf,
    /// A picture of twelve frames with the silhouettes' outlines
    #[arg(long, value_name = "PNG")]
    sheet: Option<PathBuf>,
}

#[derive(Clone, Debug, Default, clap::Args, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MaskChoices {
    /// A rectangle inside the animal, on the first frame or on FRAME; may be given several times
    #[arg(long, value_name = "[FRAME:]x,y,w,h", required = true)]
    subject: Vec<Placed>,
    /// A rectangle beside the animal
    #[arg(long, value_name = "[FRAME:]x,y,w,h", required = true)]
    background: Vec<Placed>,
    /// Edge-aware smoothing of the silhouettes
    #[arg(long, value_enum, default_value_t = Switch::On)]
    smooth: Switch,
    /// Use what moves against the scenery; off for animals that stand still or scenery close to the camera
    #[arg(long, value_enum, default_value_t = Switch::On)]
    motion: Switch,
    /// Learn the colours anew every so many frames; 0 keeps the rectangles' colours
    #[arg(long, value_name = "FRAMES")]
    update_every: Option<usize>,
    /// Only these frames, FIRST:LAST
    #[arg(long, value_name = "A:B")]
    frames: Option<FrameRange>,
}

pub fn run(args: &MasksArgs) -> Result<()> {
    let frames = make(&args.video, &args.choices, &args.output)?;
    if let Some(path) = &args.sheet {
        let masks = muybridge::io::animal_clip::read_masks(&args.output, None)?;
        save(path, &mask_sheet(&frames, &masks, 12)?)?;
    }
    Ok(())
}

/// Writes the masks of a clip; returns its frames.
pub fn make(video: &Path, choices: &MaskChoices, output: &Path) -> Result<Vec<RgbImage>> {
    let clip = read_clip(video, choices.frames.map(FrameRange::pair))?;
    clip.notices.iter().for_each(|n| eprintln!("notice: {n}"));
    let first = choices.frames.map_or(0, |r| r.pair().0);
    let mark = |subject: bool| {
        move |p: &Placed| {
            // `x,y,w,h` is on the clip's first used frame, FRAME:… counts as the video does.
            let frame = if p.frame == 0 {
                0
            } else {
                p.frame.checked_sub(first).with_context(|| format!("frame {} of a rectangle is before --frames", p.frame))?
            };
            anyhow::Ok(Mark { frame, subject, rectangle: p.rectangle })
        }
    };
    let marks: Vec<Mark> =
        choices.subject.iter().map(mark(true)).chain(choices.background.iter().map(mark(false))).collect::<Result<_>>()?;
    let defaults = MaskOptions::default();
    let options = MaskOptions {
        smooth: choices.smooth == Switch::On,
        motion: choices.motion == Switch::On,
        update_every: choices.update_every.unwrap_or(defaults.update_every),
    };
    let progress = progress::bar("masks", clip.frames.len() as u64);
    let mut goes_on = || {
        progress.inc(1);
        !interrupt::came()
    };
    let found = silhouettes(&clip.frames, &marks, &options, &mut goes_on);
    if matches!(found, Err(MaskError::Stopped)) {
        interrupt::check()?;
    }
    let found = found.with_context(|| video.display().to_string())?;
    progress.finish();
    let missing: Vec<String> = (0..found.regions.len()).filter(|t| found.regions[*t].is_none()).map(|t| (t + first).to_string()).collect();
    if missing.len() == clip.frames.len() {
        bail!("{}: no silhouette in any frame", video.display());
    }
    if !missing.is_empty() {
        eprintln!("notice: no silhouette in frame {}; their masks are black", shortened(&missing));
    }
    let seconds: Vec<String> = (0..found.regions.len())
        .filter(|t| found.regions[*t].is_some_and(|r| r.second_px.is_some()))
        .map(|t| (t + first).to_string())
        .collect();
    if !seconds.is_empty() {
        eprintln!(
            "notice: a second region half as large or larger in frame {}; the one nearest to the frame before is followed",
            shortened(&seconds)
        );
    }
    let partial = whole::beside(output)?;
    write_masks(partial.path(), &found.masks)?;
    let record = MasksRecord { video: video.into(), fps: clip.fps, regions: found.regions, path_px: found.path_px };
    animal_json::write(partial.path(), &record)?;
    replace::<MasksRecord>(partial, output)?;
    println!("{} masks in {}", found.masks.len(), output.display());
    Ok(clip.frames)
}

fn shortened(list: &[String]) -> String {
    let more = if list.len() > 8 { format!(" and {} more", list.len() - 8) } else { String::new() };
    list[..list.len().min(8)].join(", ") + &more
}

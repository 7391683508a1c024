//! `muybridge animal analyse`: eigenimages, spectrum, verdict.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use muybridge::animal::analysis::{Analysis, analyse};
use muybridge::animal::rhythm::JUDGED;
use muybridge::io::animal_clip::{read_masks, write_masks};
use muybridge::io::animal_json::{self, AnalysisRecord, MasksRecord};
use muybridge::report::animal::{coefficients, eigenimages, plane, spectrum};
use serde::{Deserialize, Serialize};

use super::super::{positive, whole};
use super::{FrameRange, Switch, replace, save};

#[derive(clap::Args)]
pub struct AnalyseArgs {
    /// Folder of masks: `animal masks`' own or any other segmenter's black and white PNGs
    masks: PathBuf,
    #[command(flatten)]
    choices: AnalyseChoices,
    /// Folder for analysis.json, the silhouettes' windows and pictures
    #[arg(short, long)]
    output: PathBuf,
}

#[derive(Clone, Debug, Default, clap::Args, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AnalyseChoices {
    /// Band-pass the first two components for keys and animation; off for clean rendered clips
    #[arg(long, value_enum, default_value_t = Switch::On)]
    filter: Switch,
    /// The pictures are drawn strokes (white, or opaque on transparent), not masks
    #[arg(long)]
    pub strokes: bool,
    /// Take away every pixel's polynomial trend of this degree: 2 or 3 for an animal that turns or comes nearer
    #[arg(long, default_value_t = 0, value_name = "DEGREE", value_parser = clap::value_parser!(u8).range(0..=9))]
    detrend: u8,
    /// Only these frames, FIRST:LAST
    #[arg(long, value_name = "A:B")]
    frames: Option<FrameRange>,
    /// Frames per second; else the masks' record's, else 30
    #[arg(long, value_parser = positive)]
    fps: Option<f64>,
}

pub fn run(args: &AnalyseArgs) -> Result<()> {
    make(&args.masks, &args.choices, &args.output)
}

pub fn make(masks: &Path, choices: &AnalyseChoices, output: &Path) -> Result<()> {
    let images = read_masks(masks, choices.frames.map(FrameRange::pair))?;
    let first_frame = choices.frames.map_or(0, |r| r.pair().0);
    let found = analyse(&images, choices.strokes, usize::from(choices.detrend)).with_context(|| masks.display().to_string())?;
    let seconds = found.regions.iter().filter(|r| r.second_px.is_some()).count();
    if seconds > 0 {
        eprintln!("notice: {seconds} frames show a second region half as large or larger; the nearest one is followed");
    }
    // Masks of other segmenters come without a record.
    let from_masks = masks.join("masks.json").exists().then(|| animal_json::read::<MasksRecord>(masks)).transpose()?;
    let fps = choices.fps.or(from_masks.as_ref().and_then(|m| m.fps)).unwrap_or_else(|| {
        eprintln!("notice: the frame rate is not known; 30 frames per second are assumed (--fps)");
        30.0
    });
    let path_px = from_masks.and_then(|m| m.path_px.get(first_frame..first_frame + images.len())?.iter().copied().collect());
    let record = record_of(&found, fps, choices, first_frame, path_px);
    print!("{}", table(&record));
    let partial = whole::beside(output)?;
    animal_json::write(partial.path(), &record)?;
    write_masks(&partial.path().join("windows"), &found.windows)?;
    pictures(partial.path(), &found, &record)?;
    replace::<AnalysisRecord>(partial, output)
}

fn record_of(found: &Analysis, fps: f64, choices: &AnalyseChoices, first_frame: usize, path_px: Option<Vec<[f64; 2]>>) -> AnalysisRecord {
    let shown = JUDGED.min(found.eigen.coefficients.ncols());
    AnalysisRecord {
        fps,
        strokes: choices.strokes,
        filter: choices.filter == Switch::On,
        trend_degree: usize::from(choices.detrend),
        first_frame,
        window_px: found.eigen.size_px,
        rhythm: found.rhythm.clone(),
        explained: (0..shown).map(|k| found.eigen.explained(k)).collect(),
        coefficients: (0..found.eigen.frames()).map(|t| (0..shown).map(|k| found.eigen.coefficients[(t, k)]).collect()).collect(),
        regions: found.regions.clone(),
        path_px,
    }
}

/// The verdict with its numbers.
pub fn table(record: &AnalysisRecord) -> String {
    let rhythm = &record.rhythm;
    let mut text = format!("{} frames, window {}x{}\n", record.regions.len(), record.window_px[0], record.window_px[1]);
    text += "component   variance   r in band\n";
    for (k, share) in record.explained.iter().enumerate() {
        let r = rhythm.correlations.get(k).map_or_else(|| "-".to_string(), |r| format!("{r:.2}"));
        // Writing to a string cannot fail.
        let _ = writeln!(text, "PC{:<8} {:>8.1} %   {r:>9}", k + 1, 100.0 * share);
    }
    if let (Some(period), Some(lag)) = (rhythm.period_frames, rhythm.lag_deg) {
        let _ = writeln!(text, "a silhouette every {period:.1} frames ({:.2} Hz), PC2 {lag:.0} degrees after PC1", record.fps / period);
    }
    let _ = writeln!(text, "verdict: {}", rhythm.verdict.words());
    for reason in &rhythm.reasons {
        let _ = writeln!(text, "  {reason}");
    }
    text
}

fn pictures(folder: &Path, found: &Analysis, record: &AnalysisRecord) -> Result<()> {
    let points = found.rhythm.points(&found.eigen, 2, record.filter);
    save(&folder.join("eigenimages.png"), &eigenimages(&found.eigen, 3)?)?;
    save(&folder.join("plane.png"), &plane(&points, &[], &[])?)?;
    save(&folder.join("spectrum.png"), &spectrum(&found.eigen, &found.rhythm, record.fps)?)?;
    let filtered = record.filter.then_some(&points[..]);
    save(&folder.join("coefficients.png"), &coefficients(&found.eigen, filtered, record.fps)?)
}

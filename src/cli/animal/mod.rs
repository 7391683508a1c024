//! `muybridge animal`: from one video of an animal to its motion.

mod analyse;
mod animate;
mod keys;
mod masks;
mod page;
mod run;
mod sketch;
mod transfer;

use std::path::Path;
use std::str::FromStr;

use anyhow::{Context, Result, bail};
use image::RgbImage;
use muybridge::animal::analysis::COMPONENTS;
use muybridge::animal::creature::Creature;
use muybridge::animal::eigen::{Eigenimages, eigenimages};
use muybridge::animal::masks::Rectangle;
use muybridge::io::animal_clip::read_masks;
use muybridge::io::animal_json::{self, AnalysisRecord, KeysRecord, Record};
use muybridge::io::{creature_bvh, glb};
use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use super::whole;

#[derive(clap::Subcommand)]
pub enum AnimalCommand {
    /// Silhouettes of every frame from a few rectangles
    Masks(masks::MasksArgs),
    /// Principal components of the silhouettes, their rhythm, and whether the clip is usable
    Analyse(analyse::AnalyseArgs),
    /// The key images that an artist is to set poses for
    Keys(keys::KeysArgs),
    /// The artist's key poses in the clip's rhythm, as BVH and GLB
    Animate(animate::AnimateArgs),
    /// Another clip of the same species, animated by the poses of a former one
    Transfer(transfer::TransferArgs),
    /// All stages by one TOML file, each only when something it depends on has changed
    Run(run::RunArgs),
    /// A local page to draw rectangles and strokes on the frames
    Sketch(sketch::SketchArgs),
}

pub fn run(command: &AnimalCommand) -> Result<()> {
    match command {
        AnimalCommand::Masks(args) => masks::run(args),
        AnimalCommand::Analyse(args) => analyse::run(args),
        AnimalCommand::Keys(args) => keys::run(args),
        AnimalCommand::Animate(args) => animate::run(args),
        AnimalCommand::Transfer(args) => transfer::run(args),
        AnimalCommand::Run(args) => run::run(args),
        AnimalCommand::Sketch(args) => sketch::run(args),
    }
}

/// `x,y,w,h` on the first frame, `FRAME:x,y,w,h` on another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Placed {
    frame: usize,
    rectangle: Rectangle,
}

impl FromStr for Placed {
    type Err = String;

    fn from_str(text: &str) -> Result<Placed, String> {
        let wrong = || format!("'{text}' is no rectangle; write x,y,width,height or FRAME:x,y,width,height in whole pixels");
        let (frame, rest) = match text.split_once(':') {
            Some((frame, rest)) => (frame.trim().parse().map_err(|_| wrong())?, rest),
            None => (0, text),
        };
        let numbers: Vec<u32> = rest.split(',').map(|n| n.trim().parse().map_err(|_| wrong())).collect::<Result<_, _>>()?;
        match numbers[..] {
            [x, y, width, height] if width > 0 && height > 0 => Ok(Placed { frame, rectangle: Rectangle { x, y, width, height } }),
            _ => Err(wrong()),
        }
    }
}

impl TryFrom<String> for Placed {
    type Error = String;

    fn try_from(text: String) -> Result<Placed, String> {
        text.parse()
    }
}

impl From<Placed> for String {
    fn from(p: Placed) -> String {
        let Rectangle { x, y, width, height } = p.rectangle;
        format!("{}:{x},{y},{width},{height}", p.frame)
    }
}

/// `A:B`, frames A to B, both inclusive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct FrameRange {
    from: usize,
    to: usize,
}

impl FromStr for FrameRange {
    type Err = String;

    fn from_str(text: &str) -> Result<FrameRange, String> {
        let range = text.split_once(':').and_then(|(a, b)| Some(FrameRange { from: a.trim().parse().ok()?, to: b.trim().parse().ok()? }));
        range.filter(|r| r.from <= r.to).ok_or_else(|| format!("'{text}' is no range of frames; write FIRST:LAST"))
    }
}

impl TryFrom<String> for FrameRange {
    type Error = String;

    fn try_from(text: String) -> Result<FrameRange, String> {
        text.parse()
    }
}

impl From<FrameRange> for String {
    fn from(r: FrameRange) -> String {
        format!("{}:{}", r.from, r.to)
    }
}

impl FrameRange {
    fn pair(self) -> (usize, usize) {
        (self.from, self.to)
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Switch {
    #[default]
    On,
    Off,
}

/// Puts a finished stage in the place of `folder`: new, empty, or of the same stage.
fn replace<R: Record>(partial: TempDir, folder: &Path) -> Result<()> {
    if folder.exists() {
        let failed = || format!("cannot read {}", folder.display());
        let occupied = folder.read_dir().with_context(failed)?.next().is_some();
        if occupied && !folder.join(R::FILE).exists() {
            bail!(
                "{} exists already and is no folder of `muybridge animal {}`; remove it or choose another one with -o",
                folder.display(),
                R::STAGE
            );
        }
        std::fs::remove_dir_all(folder).with_context(|| format!("cannot replace {}", folder.display()))?;
    }
    whole::publish(partial, folder)
}

/// An analysis read back: its record, the silhouettes' windows and their components.
struct Analysed {
    record: AnalysisRecord,
    windows: Vec<image::GrayImage>,
    eigen: Eigenimages,
}

fn read_analysis(folder: &Path) -> Result<Analysed> {
    let record: AnalysisRecord = animal_json::read(folder)?;
    let windows = read_masks(&folder.join("windows"), None)?;
    if windows.len() != record.regions.len() {
        bail!(
            "{}: {} windows where analysis.json has {} frames; run `muybridge animal analyse` again",
            folder.display(),
            windows.len(),
            record.regions.len()
        );
    }
    let eigen = eigenimages(&windows, COMPONENTS, record.trend_degree)?;
    Ok(Analysed { record, windows, eigen })
}

impl Analysed {
    fn points(&self, components: usize) -> Vec<Vec<f64>> {
        self.record.rhythm.points(&self.eigen, components, self.record.filter)
    }
}

/// The chosen keys, and their places among the analysed frames.
fn read_keys(folder: &Path, analysed: &Analysed) -> Result<(KeysRecord, Vec<usize>)> {
    let record: KeysRecord = animal_json::read(folder)?;
    let first = analysed.record.first_frame;
    let places: Option<Vec<usize>> = record.keys.iter().map(|k| k.checked_sub(first).filter(|p| *p < analysed.windows.len())).collect();
    let places = places
        .with_context(|| format!("{}: its keys are not frames of this analysis; run `muybridge animal keys` again", folder.display()))?;
    Ok((record, places))
}

/// A creature from GLB or BVH.
fn read_creature(path: &Path) -> Result<Creature> {
    match path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase().as_str() {
        "glb" => Ok(glb::read(path)?),
        "bvh" => Ok(creature_bvh::read(path)?),
        _ => bail!("{}: skeletons and poses are read from .glb and .bvh files", path.display()),
    }
}

fn save(path: &Path, picture: &RgbImage) -> Result<()> {
    Ok(muybridge::report::save(path, picture)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_and_ranges_are_read_and_written() {
        let rectangle = Rectangle { x: 10, y: 20, width: 30, height: 40 };
        assert_eq!("10,20, 30,40".parse(), Ok(Placed { frame: 0, rectangle }));
        assert_eq!("7:10,20,30,40".parse(), Ok(Placed { frame: 7, rectangle }));
        assert_eq!(String::from(Placed { frame: 7, rectangle }), "7:10,20,30,40");
        assert!(["1,2,3", "1,2,3,0", "a:1,2,3,4", "-1,2,3,4", ""].iter().all(|t| t.parse::<Placed>().is_err()));
        assert_eq!("3:9".parse(), Ok(FrameRange { from: 3, to: 9 }));
        assert!(["9:3", "3", "3:", "x:1"].iter().all(|t| t.parse::<FrameRange>().is_err()));
    }
}

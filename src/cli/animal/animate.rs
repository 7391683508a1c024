//! `muybridge animal animate`: key poses in the clip's rhythm.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use image::imageops;
use muybridge::animal::blend::PoseSpace;
use muybridge::animal::creature::{Creature, Motion, Posture};
use muybridge::animal::path::{by_contact, by_region, travel};
use muybridge::animal::region::Region;
use muybridge::animal::render::{View, shaded};
use muybridge::animal::switching::{Weights, single, switched};
use muybridge::io::{creature_bvh, glb, write_atomic};
use muybridge::report::animal::{keys_and_poses, tile, weights as weights_picture};
use muybridge::report::strip;
use serde::{Deserialize, Serialize};

use super::super::whole;
use super::{read_analysis, read_creature, read_keys, save};

#[derive(clap::Args)]
pub struct AnimateArgs {
    /// Folder of `animal analyse`
    analysis: PathBuf,
    /// Folder of `animal keys`
    keys: PathBuf,
    #[command(flatten)]
    choices: AnimateChoices,
    /// Folder for motion.bvh, motion.glb, weights.csv and pictures
    #[arg(short, long)]
    output: PathBuf,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Travel {
    /// Forward so that feet on the ground stay
    #[default]
    Feet,
    /// As the silhouette went across the scenery
    Region,
    /// On the spot
    None,
}

#[derive(Clone, Debug, Default, clap::Args, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AnimateChoices {
    /// The template with a pose set on each of its frames, GLB or BVH
    #[arg(long, value_name = "FILE")]
    pub poses: PathBuf,
    /// The animation of the file that holds the poses, where it has several
    #[arg(long)]
    motion: Option<String>,
    /// Keep the weights between 0 and 1 with sum 1
    #[arg(long)]
    clamp: bool,
    /// How the animal gets forward
    #[arg(long, value_enum, default_value_t = Travel::Feet)]
    travel: Travel,
}

impl AnimateChoices {
    pub fn clamp(&self) -> bool {
        self.clamp
    }
}

pub fn run(args: &AnimateArgs) -> Result<()> {
    make(&args.analysis, &args.keys, &args.choices, &args.output)
}

pub fn make(analysis: &Path, keys: &Path, choices: &AnimateChoices, output: &Path) -> Result<()> {
    let analysed = read_analysis(analysis)?;
    let (record, places) = read_keys(keys, &analysed)?;
    let creature = glb::read(&keys.join("template.glb"))?;
    let poses = read_poses(&creature, choices, places.len())?;
    let points = analysed.points(record.components);
    let weights = if record.doubled { switched(&points, &places, choices.clamp)? } else { single(&points, &places, choices.clamp)? };
    let tiles = record.keys.iter().zip(&places).map(|(k, p)| (tile(&analysed.windows[*p]), format!("frame {k}"))).collect();
    let way = way_of(&analysed.record.regions, analysed.record.path_px.clone());
    write(output, &Animation { creature, poses, weights, keys: record.keys, tiles, fps: analysed.record.fps, way, choices })
}

/// The posed template's poses, one per key.
pub fn read_poses(template: &Creature, choices: &AnimateChoices, keys: usize) -> Result<Vec<Posture>> {
    let path = choices.poses.display();
    ensure!(!choices.poses.as_os_str().is_empty(), "no poses are given; set them on the template's frames and name the file");
    let posed = read_creature(&choices.poses)?;
    let names: Vec<&str> = posed.motions.iter().map(|m| m.name.as_str()).collect();
    let motion = match (&choices.motion, posed.motions.as_slice()) {
        (Some(name), list) => {
            list.iter().find(|m| m.name == *name).with_context(|| format!("{path}: no animation '{name}'; it has {}", names.join(", ")))?
        }
        (None, [only]) => only,
        (None, []) => bail!("{path}: holds no animation; export the frames of the template with it"),
        (None, list) => list
            .iter()
            .find(|m| m.name == "keys")
            .with_context(|| format!("{path}: several animations ({}); choose with --motion", names.join(", ")))?,
    };
    let found = motion.postures.len();
    ensure!(found == keys, "{path}: {found} frames where the template has {keys}, one per key image; export exactly these frames");
    motion.postures.iter().map(|p| template.posture_from(&posed, p)).collect::<Result<_, _>>().with_context(|| path.to_string())
}

/// The silhouette's way and its length, pixels.
pub struct Way {
    centres_px: Vec<[f64; 2]>,
    length_px: f64,
    /// Whether the camera's turns are taken out.
    registered: bool,
}

pub fn way_of(regions: &[Region], path_px: Option<Vec<[f64; 2]>>) -> Way {
    let mut lengths: Vec<u32> = regions.iter().map(|r| r.bounds_px[2] - r.bounds_px[0] + 1).collect();
    lengths.sort_unstable();
    Way {
        length_px: lengths.get(lengths.len() / 2).copied().map_or(1.0, f64::from),
        registered: path_px.is_some(),
        centres_px: path_px.unwrap_or_else(|| regions.iter().map(|r| r.centre_px).collect()),
    }
}

/// All that an animation's folder is made of.
pub struct Animation<'a> {
    pub creature: Creature,
    pub poses: Vec<Posture>,
    pub weights: Weights,
    /// Frame numbers of the keys.
    pub keys: Vec<usize>,
    /// The key images with captions.
    pub tiles: Vec<(image::RgbImage, String)>,
    pub fps: f64,
    pub way: Way,
    pub choices: &'a AnimateChoices,
}

pub fn write(output: &Path, a: &Animation) -> Result<()> {
    let space = PoseSpace::new(&a.poses).context("there is no key pose")?;
    let mut postures: Vec<Posture> = a.weights.rows.iter().map(|w| space.blend(w)).collect();
    let in_place = postures.clone();
    match a.choices.travel {
        Travel::Feet => travel(&a.creature, &mut postures, &by_contact(&a.creature, &in_place)),
        Travel::Region => {
            if !a.way.registered {
                eprintln!("notice: the masks come without the camera's turns; the way is the one across the picture");
            }
            let length = a.creature.bounds().map_or(a.creature.span(), |[low, high]| high.z - low.z);
            travel(&a.creature, &mut postures, &by_region(&a.way.centres_px, length / a.way.length_px));
        }
        Travel::None => {}
    }
    let partial = whole::beside(output)?;
    let folder = partial.path();
    creature_bvh::write(&folder.join("motion.bvh"), &a.creature, &postures, a.fps)?;
    let mut creature = a.creature.clone();
    creature.motions = vec![Motion::at_rate("motion", a.fps, postures)];
    glb::write(&folder.join("motion.glb"), &creature)?;
    let facts = serde_json::json!({
        "fps": a.fps, "frames": in_place.len(), "up": "+y", "forward": "+z", "unit": "the template's (metres for glTF)", "keys": a.keys,
        "travel": a.choices.travel, "rotations": "BVH: degrees, ZXY, zero = the template's rest pose with the world's axes",
    });
    let json = folder.join("motion.json");
    write_atomic(&json, format!("{facts:#}\n").as_bytes()).with_context(|| format!("cannot write {}", json.display()))?;
    let csv = folder.join("weights.csv");
    write_atomic(&csv, weights_csv(a).as_bytes()).with_context(|| format!("cannot write {}", csv.display()))?;
    save(&folder.join("weights.png"), &weights_picture(&a.weights.rows, &a.keys, a.fps)?)?;
    let view = View::side(&a.creature, [480, 360]);
    let seen = |p: &Posture| imageops::resize(&shaded(&a.creature, p, &view, [255; 3]), 240, 180, imageops::FilterType::Triangle);
    let poses: Vec<_> = a.poses.iter().map(seen).collect();
    save(&folder.join("keys_and_poses.png"), &keys_and_poses(&a.tiles, &poses, 4)?)?;
    let shown: Vec<usize> = (0..16.min(in_place.len())).map(|i| i * in_place.len().min(48) / 16.min(in_place.len())).collect();
    let film: Vec<_> = shown.iter().map(|t| (seen(&in_place[*t]), format!("{:.2} s", *t as f64 / a.fps))).collect();
    save(&folder.join("motion.png"), &strip(&film, 4, 240)?)?;
    publish(partial, output)?;
    println!("{} frames at {} per second in {}", in_place.len(), a.fps, output.display());
    Ok(())
}

fn publish(partial: tempfile::TempDir, output: &Path) -> Result<()> {
    let occupied = output.exists() && output.read_dir().map(|mut e| e.next().is_some()).unwrap_or(true);
    ensure!(
        !occupied || output.join("weights.csv").exists(),
        "{} exists already and is no folder of `muybridge animal animate`; remove it or choose another one with -o",
        output.display()
    );
    if output.exists() {
        std::fs::remove_dir_all(output).with_context(|| format!("cannot replace {}", output.display()))?;
    }
    whole::publish(partial, output)
}

/// `frame,time_s,set,key_FRAME…,sum`.
fn weights_csv(a: &Animation) -> String {
    let names: Vec<String> = a.keys.iter().map(|k| format!("key_{k}")).collect();
    let mut text = format!("frame,time_s,set,{},sum\n", names.join(","));
    for (t, (row, set)) in a.weights.rows.iter().zip(&a.weights.sets).enumerate() {
        let values: Vec<String> = row.iter().map(|w| format!("{w:.6}")).collect();
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{t},{:.6},{set},{},{:.6}", t as f64 / a.fps, values.join(","), row.iter().sum::<f64>());
    }
    text
}

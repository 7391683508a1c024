//! `muybridge animal keys`: key images, alternates, and the template for the artist.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, Result, bail, ensure};
use muybridge::animal::ambiguity::{candidates, stride_order};
use muybridge::animal::creature::{Creature, Motion, Posture};
use muybridge::animal::horse::horse;
use muybridge::animal::keys::select;
use muybridge::io::animal_clip::write_mask;
use muybridge::io::animal_json::{self, Alternate, KeysRecord};
use muybridge::io::{creature_bvh, glb};
use muybridge::math::rbf::squared_distance;
use muybridge::report::animal::{plane, tile};
use muybridge::report::strip;
use serde::{Deserialize, Serialize};

use super::super::whole;
use super::{Analysed, read_analysis, read_creature, replace, save};

/// Key poses are a frame apart at this rate.
pub const TEMPLATE_FPS: f64 = 24.0;

#[derive(clap::Args)]
pub struct KeysArgs {
    /// Folder of `animal analyse`
    analysis: PathBuf,
    #[command(flatten)]
    choices: KeyChoices,
    /// Folder for keys.json, the key images, a contact sheet and the template
    #[arg(short, long)]
    output: PathBuf,
}

/// KEY=FRAME.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Named {
    key: usize,
    frame: usize,
}

impl FromStr for Named {
    type Err = String;

    fn from_str(text: &str) -> Result<Named, String> {
        let pair = text.split_once('=').and_then(|(a, b)| Some(Named { key: a.trim().parse().ok()?, frame: b.trim().parse().ok()? }));
        pair.ok_or_else(|| format!("'{text}' names no alternate; write KEY=FRAME, both frame numbers"))
    }
}

impl TryFrom<String> for Named {
    type Error = String;

    fn try_from(text: String) -> Result<Named, String> {
        text.parse()
    }
}

impl From<Named> for String {
    fn from(n: Named) -> String {
        format!("{}={}", n.key, n.frame)
    }
}

#[derive(Clone, Debug, clap::Args, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct KeyChoices {
    /// Number of key images that are chosen; --double makes it twice as many
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u16).range(2..=64))]
    keys: u16,
    /// Number of components that drive the animation
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=10))]
    components: u16,
    /// For walks and other symmetric gaits: every key's silhouette in the other half of the stride too, and switching models
    #[arg(long)]
    double: bool,
    /// Not this frame as an alternate: the next candidate is proposed; may be given several times
    #[arg(long, value_name = "FRAME", requires = "double")]
    reject: Vec<usize>,
    /// This frame as the alternate of a key
    #[arg(long, value_name = "KEY=FRAME", requires = "double")]
    alternate: Vec<Named>,
    /// The artist's skeleton, GLB or BVH; else the built-in horse
    #[arg(long, value_name = "FILE")]
    template: Option<PathBuf>,
}

impl Default for KeyChoices {
    fn default() -> KeyChoices {
        KeyChoices { keys: 4, components: 2, double: false, reject: Vec::new(), alternate: Vec::new(), template: None }
    }
}

impl KeyChoices {
    /// The template, for those who resolve it against another folder.
    pub fn template_mut(&mut self) -> &mut Option<PathBuf> {
        &mut self.template
    }
}

pub fn run(args: &KeysArgs) -> Result<()> {
    make(&args.analysis, &args.choices, &args.output)
}

pub fn make(analysis: &Path, choices: &KeyChoices, output: &Path) -> Result<()> {
    let analysed = read_analysis(analysis)?;
    let template = choices.template.as_deref().map_or_else(|| Ok(horse()), read_creature)?;
    let points = analysed.points(usize::from(choices.components));
    let chosen = select(&points, usize::from(choices.keys)).with_context(|| analysis.display().to_string())?;
    let found = if choices.double { alternates(&analysed, &points, &chosen.frames, choices)? } else { Vec::new() };
    let first = analysed.record.first_frame;
    let others: Vec<usize> = found.iter().map(|a| a.frame - first).collect();
    let order = if choices.double {
        ensure!(chosen.frames.len().is_multiple_of(2), "switching models need an even number of keys; give --keys 4 or 6");
        stride_order(&chosen.frames, &others, analysed.record.rhythm.turns(&analysed.eigen).as_deref())
    } else {
        chosen.frames.clone()
    };
    let record = KeysRecord {
        keys: order.iter().map(|k| k + first).collect(),
        components: points[0].len(),
        doubled: choices.double,
        condition: chosen.condition,
        exact: chosen.exact,
        bound: chosen.bound,
        alternates: found,
    };
    print!("{}", words(&record));
    let partial = whole::beside(output)?;
    animal_json::write(partial.path(), &record)?;
    write_keys(partial.path(), &analysed, &points, &record, &chosen.frames)?;
    write_template(partial.path(), template, &record)?;
    replace::<KeysRecord>(partial, output)
}

fn alternates(analysed: &Analysed, points: &[Vec<f64>], keys: &[usize], choices: &KeyChoices) -> Result<Vec<Alternate>> {
    let first = analysed.record.first_frame;
    let turns = analysed.record.rhythm.turns(&analysed.eigen);
    if let Some(named) = choices.alternate.iter().find(|n| !keys.iter().any(|k| k + first == n.key)) {
        let list: Vec<String> = keys.iter().map(|k| (k + first).to_string()).collect();
        bail!("--alternate {}={}: {} is no key; the keys are frames {}", named.key, named.frame, named.key, list.join(", "));
    }
    let mut found: Vec<Alternate> = Vec::new();
    for &key in keys {
        let named = choices.alternate.iter().find(|n| n.key == key + first).map(|n| n.frame);
        let free = |f: &usize| !choices.reject.contains(&(f + first)) && !keys.contains(f) && !found.iter().any(|a| a.frame == f + first);
        let frame = match named {
            Some(frame) => {
                let inside = frame.checked_sub(first).filter(|f| *f < points.len() && *f != key);
                inside.with_context(|| format!("frame {frame} cannot be the alternate of key {}", key + first))?
            }
            None => candidates(points, turns.as_deref(), key).into_iter().find(free).with_context(|| {
                format!(
                    "key {} has no silhouette in the other half of a stride; take a longer part of the clip, or leave --double out",
                    key + first
                )
            })?,
        };
        found.push(Alternate { key: key + first, frame: frame + first, distance: squared_distance(&points[key], &points[frame]).sqrt() });
    }
    Ok(found)
}

/// The choice in words.
pub fn words(record: &KeysRecord) -> String {
    let list: Vec<String> = record.keys.iter().map(|k| k.to_string()).collect();
    let mut text = format!("keys: frames {}\ncondition number {:.4}, ", list.join(", "), record.condition);
    text +=
        &if record.exact { "the smallest there is\n".into() } else { format!("by a heuristic; no choice is below {:.4}\n", record.bound) };
    for a in &record.alternates {
        text += &format!(
            "key {} looks like frame {} of the other half of the stride (distance {:.2}); --reject {} asks for another\n",
            a.key, a.frame, a.distance, a.frame
        );
    }
    text
}

fn write_keys(folder: &Path, analysed: &Analysed, points: &[Vec<f64>], record: &KeysRecord, chosen: &[usize]) -> Result<()> {
    let first = analysed.record.first_frame;
    let mut tiles = Vec::new();
    for (i, key) in record.keys.iter().enumerate() {
        let window = &analysed.windows[key - first];
        write_mask(&folder.join(format!("key_{}_frame_{key:06}.png", i + 1)), window)?;
        tiles.push((tile(window), format!("key {}: frame {key}", i + 1)));
    }
    save(&folder.join("keys.png"), &strip(&tiles, 4, 240)?)?;
    let others: Vec<usize> = record.alternates.iter().map(|a| a.frame - first).collect();
    save(&folder.join("plane.png"), &plane(points, chosen, &others)?)?;
    if !record.alternates.is_empty() {
        let shown = |frame: usize, what: &str| (tile(&analysed.windows[frame - first]), format!("{what} {frame}"));
        let keys = record.alternates.iter().map(|a| shown(a.key, "key"));
        let pairs: Vec<_> = keys.chain(record.alternates.iter().map(|a| shown(a.frame, "alternate"))).collect();
        save(&folder.join("alternates.png"), &strip(&pairs, record.alternates.len(), 240)?)?;
    }
    Ok(())
}

/// The skeleton at rest, one frame per key, for the artist to pose.
fn write_template(folder: &Path, template: Creature, record: &KeysRecord) -> Result<()> {
    let mut creature = template.with_sticks();
    let poses: Vec<Posture> = vec![creature.rest(); record.keys.len()];
    creature_bvh::write(&folder.join("template.bvh"), &creature, &poses, TEMPLATE_FPS)?;
    creature.motions = vec![Motion::at_rate("keys", TEMPLATE_FPS, poses)];
    Ok(glb::write(&folder.join("template.glb"), &creature)?)
}

//! `muybridge animal transfer`: another clip of the same species, animated by the keys and poses of a former one.

use std::path::PathBuf;

use anyhow::{Context, Result};
use muybridge::animal::analysis::{analyse, fitted_windows};
use muybridge::animal::switching::{single_over, switched_over};
use muybridge::io::animal_clip::read_masks;
use muybridge::io::animal_json::{self, MasksRecord};
use muybridge::io::glb;
use muybridge::math::spectrum::{band_pass, correlation, peak};
use muybridge::report::animal::tile;

use super::super::positive;
use super::animate::{AnimateChoices, Animation, read_poses, way_of, write};
use super::{read_analysis, read_keys};

#[derive(clap::Args)]
pub struct TransferArgs {
    /// Folder of `animal analyse` of the former clip
    analysis: PathBuf,
    /// Folder of `animal keys` of the former clip
    keys: PathBuf,
    /// Masks of the new clip
    masks: PathBuf,
    #[command(flatten)]
    choices: AnimateChoices,
    /// The animal goes the other way than in the former clip
    #[arg(long)]
    mirror: bool,
    /// Frames per second of the new clip; else its masks' record's, else 30
    #[arg(long, value_parser = positive)]
    fps: Option<f64>,
    /// Folder for motion.bvh, motion.glb, weights.csv and pictures
    #[arg(short, long)]
    output: PathBuf,
}

pub fn run(args: &TransferArgs) -> Result<()> {
    let known = read_analysis(&args.analysis)?;
    let (record, places) = read_keys(&args.keys, &known)?;
    let creature = glb::read(&args.keys.join("template.glb"))?;
    let poses = read_poses(&creature, &args.choices, places.len())?;
    let masks = read_masks(&args.masks, None)?;
    let own = analyse(&masks, false, 0).with_context(|| args.masks.display().to_string())?;
    let windows = fitted_windows(&masks, &known.windows, args.mirror)?;
    let raw: Vec<Vec<f64>> = windows.iter().map(|w| known.eigen.project(w)[..record.components].to_vec()).collect();
    let points = filtered(&raw, known.record.filter);
    let basis = known.points(record.components);
    let nodes: Vec<Vec<f64>> = places.iter().map(|k| basis[*k].clone()).collect();
    let clamp = args.choices.clamp();
    let weights = if record.doubled { switched_over(&points, &nodes, clamp)? } else { single_over(&points, &nodes, clamp)? };
    let from_masks: Option<MasksRecord> = args.masks.join("masks.json").exists().then(|| animal_json::read(&args.masks)).transpose()?;
    let fps = args.fps.or(from_masks.as_ref().and_then(|m| m.fps)).unwrap_or(30.0);
    let tiles = record.keys.iter().zip(&places).map(|(k, p)| (tile(&known.windows[*p]), format!("former frame {k}"))).collect();
    let path_px = from_masks.and_then(|m| m.path_px.into_iter().collect());
    let way = way_of(&own.regions, path_px);
    write(&args.output, &Animation { creature, poses, weights, keys: record.keys, tiles, fps, way, choices: &args.choices })
}

/// The first two coefficients in the band of the new clip's own peak; how much of them that keeps is told.
fn filtered(points: &[Vec<f64>], filter: bool) -> Vec<Vec<f64>> {
    let series = |k: usize| -> Vec<f64> { points.iter().filter_map(|p| p.get(k).copied()).collect() };
    let Some(found) = peak(&series(0)).filter(|_| filter) else { return points.to_vec() };
    let mut result = points.to_vec();
    for k in 0..points.first().map_or(0, Vec::len).min(2) {
        let own = series(k);
        // The band has no mean; the animal's build does.
        let mean = own.iter().sum::<f64>() / own.len() as f64;
        let passed = band_pass(&own, found.band);
        println!(
            "PC{}: r = {:.2} in the band of {:.1} frames a silhouette",
            k + 1,
            correlation(&own, &passed),
            own.len() as f64 / found.centre
        );
        result.iter_mut().zip(passed).for_each(|(p, v)| p[k] = v + mean);
    }
    result
}

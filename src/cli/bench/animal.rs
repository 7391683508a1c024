//! `muybridge bench animal`: the animal paper's synthetic study, on the ellipsoid horse and on other people's rigs.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use muybridge::animal::analysis::{Analysis, analyse};
use muybridge::animal::creature::{Creature, Motion};
use muybridge::animal::horse::{Gait, horse};
use muybridge::animal::keys::select;
use muybridge::animal::study::{StudyError, Take, filmed, one_model, sketch_horse, switching_models};
use muybridge::io::glb;
use muybridge::report::animal::{eigenimages, plane, spectrum};

use super::super::interrupt;

#[derive(clap::Args)]
pub struct AnimalArgs {
    /// Skinned quadrupeds with motions named Walk and Gallop
    rigs: Vec<PathBuf>,
    /// Frames of every clip, 25 per second
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u16).range(20..=2000))]
    frames: u16,
    /// Folder for pictures of eigenimages, component planes and spectra
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// The paper's figures: variance of PC1 … PC4 in percent, r of PC1 … PC5.
const PAPER: [(&str, [f64; 4], &str); 3] = [
    ("walk", [33.7, 23.7, 11.4, 8.56], ".99 .94 <.01 .05 <.01"),
    ("canter", [32.5, 14.5, 9.17, 8.78], ".94 .89 .08 <.01 .01"),
    ("gallop", [31.1, 19.9, 11.0, 8.33], ".90 .92 .01 <.01 <.01"),
];

pub fn run(args: &AnimalArgs) -> Result<()> {
    println!("angle errors about the line of sight, degrees, mean (sd); poses of the keys are the truth's; {} frames", args.frames);
    let horse = horse();
    for gait in Gait::ALL {
        interrupt::check()?;
        let motion = horse.motions.iter().find(|m| m.name == gait.name()).context("the horse has lost a gait")?;
        let (take, analysis) = filmed(&horse, motion, usize::from(args.frames))?;
        heading(&format!("ellipsoid horse, {}", gait.name()), &analysis);
        if let Some((_, variance, r)) = PAPER.iter().find(|p| p.0 == gait.name()) {
            println!("  the paper's: variance {} %, r {r}", variance.map(|v| format!("{v}")).join(" "));
        }
        for filter in [false, true] {
            table(&horse, &take, &analysis, filter)?;
        }
        beside_strokes(&horse, &take, &analysis, gait)?;
        pictures(args.pictures.as_deref(), &format!("horse_{}", gait.name()), &analysis)?;
    }
    for path in &args.rigs {
        rig(path, args)?;
    }
    search_time()
}

fn heading(name: &str, analysis: &Analysis) {
    let rhythm = &analysis.rhythm;
    let variance: Vec<String> = (0..4).map(|k| format!("{:.1}", 100.0 * analysis.eigen.explained(k))).collect();
    let r: Vec<String> = rhythm.correlations.iter().map(|r| format!("{r:.2}")).collect();
    println!("\n{name}: variance {} %, r {}, {}", variance.join(" "), r.join(" "), rhythm.verdict.words());
}

fn table(creature: &Creature, take: &Take, analysis: &Analysis, filter: bool) -> Result<()> {
    println!("  filter {}", if filter { "on" } else { "off" });
    println!("    keys   1 component    2             3             4             5");
    for keys in 2..=5 {
        let mut line = format!("    {keys}   ");
        for components in 1..=5 {
            interrupt::check()?;
            line += &match one_model(creature, take, analysis, keys, components, filter) {
                Ok(found) => format!("{:>6.2} ({:>4.2}) ", found.error.mean_deg, found.error.sd_deg),
                Err(StudyError::Keys(_)) => format!("{:>14}", "-"),
                Err(e) => return Err(e.into()),
            };
        }
        println!("{}", line.trim_end());
    }
    match switching_models(creature, take, analysis, filter) {
        Ok(found) => println!(
            "    4+4 keys, 2 components, switching: {:.2} ({:.2}), frames {:?}",
            found.error.mean_deg, found.error.sd_deg, found.keys
        ),
        Err(e) => println!("    4+4 keys, switching: {e}"),
    }
    Ok(())
}

/// The same from masks and from strokes; a walk with switching models.
fn beside_strokes(horse: &Creature, take: &Take, masks: &Analysis, gait: Gait) -> Result<()> {
    let drawn = analyse(&sketch_horse(horse, take, 2.0), true, 0)?;
    for (name, analysis) in [("masks", masks), ("strokes", &drawn)] {
        let found =
            if gait == Gait::Walk { switching_models(horse, take, analysis, true) } else { one_model(horse, take, analysis, 4, 2, true) };
        let r: Vec<String> = analysis.rhythm.correlations.iter().map(|r| format!("{r:.2}")).collect();
        match found {
            Ok(found) => println!(
                "  from {name}: r {}, {}, keys {:?}, error {:.2} ({:.2})",
                r.join(" "),
                analysis.rhythm.verdict.words(),
                found.keys,
                found.error.mean_deg,
                found.error.sd_deg
            ),
            Err(e) => println!("  from {name}: r {}, {}: {e}", r.join(" "), analysis.rhythm.verdict.words()),
        }
    }
    Ok(())
}

fn rig(path: &Path, args: &AnimalArgs) -> Result<()> {
    let creature = glb::read(path)?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    for gait in ["Walk", "Gallop"] {
        interrupt::check()?;
        let wanted = |m: &&Motion| m.name == gait || m.name.ends_with(&format!("|{gait}"));
        let motion = creature.motions.iter().find(wanted).with_context(|| format!("{}: no motion named {gait}", path.display()))?;
        let (take, analysis) = filmed(&creature, motion, usize::from(args.frames))?;
        heading(&format!("{name}, {gait} ({:.2} s a stride)", motion.duration_s()), &analysis);
        table(&creature, &take, &analysis, false)?;
        pictures(args.pictures.as_deref(), &format!("{name}_{gait}"), &analysis)?;
    }
    Ok(())
}

fn pictures(folder: Option<&Path>, name: &str, analysis: &Analysis) -> Result<()> {
    let Some(folder) = folder else { return Ok(()) };
    let points = analysis.rhythm.points(&analysis.eigen, 2, false);
    let keys = select(&points, 4)?.frames;
    let save = |what: &str, picture| muybridge::report::save(&folder.join(format!("{name}_{what}.png")), &picture);
    save("eigenimages", eigenimages(&analysis.eigen, 3)?)?;
    save("plane", plane(&points, &keys, &[])?)?;
    save("spectrum", spectrum(&analysis.eigen, &analysis.rhythm, 25.0)?)?;
    Ok(())
}

/// The exact search on a noisy circle of the cheetah's 137 frames.
fn search_time() -> Result<()> {
    let noise = |t: usize, k: usize| ((t * 7919 + k * 104_729) % 1009) as f64 / 1009.0 - 0.5;
    let points: Vec<Vec<f64>> = (0..137)
        .map(|t| {
            let a = std::f64::consts::TAU * t as f64 / 17.7;
            vec![1.4 * a.cos() + 0.3 * noise(t, 1), 1.4 * a.sin() + 0.3 * noise(t, 2)]
        })
        .collect();
    println!();
    for keys in [4, 5, 8] {
        let begun = Instant::now();
        let found = select(&points, keys)?;
        let how = if found.exact { "exact".to_string() } else { format!("heuristic, no set is below {:.4}", found.bound) };
        println!(
            "{keys} keys of 137 frames: condition {:.4}, {how}, {} sets evaluated, {:.2} s",
            found.condition,
            found.evaluations,
            begun.elapsed().as_secs_f64()
        );
    }
    Ok(())
}

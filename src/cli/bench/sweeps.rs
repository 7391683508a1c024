//! `muybridge bench sweeps`: how the fit bears noise, rigs, frame rates, lost frames, clutter and headings, on phantoms with
//! measurements made without pictures (`phantom::sighting`); how many random walks it starts on correctly.

use std::f64::consts::TAU;

use anyhow::Result;
use clap::{Args, ValueEnum};
use muybridge::fit::{Candidate, FitOptions};
use muybridge::math::order::quantile;
use muybridge::motion_model::{Activity, Model};
use muybridge::phantom::SightOptions;
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

use super::super::{interrupt, track::NamedModel};
use super::takes::{LRig, Score, Walk, score};

#[derive(Args)]
pub struct SweepsArgs {
    /// Tables to print; all without it
    #[arg(long, value_enum, value_delimiter = ',')]
    only: Vec<Table>,
    /// Random walks of the table of starts
    #[arg(long, default_value_t = 100)]
    starts: u64,
    /// Different people per cell of the other tables
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..))]
    people: u64,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Table {
    Noise,
    Cameras,
    Baseline,
    Rate,
    Dropped,
    Clutter,
    Heading,
    Activities,
    Starts,
}

/// People from here on are not in the embedded database.
const STRANGERS: u64 = 1000;

pub fn run(args: &SweepsArgs) -> Result<()> {
    let embedded = NamedModel::embedded()?;
    let models: Vec<&Model> = embedded.iter().map(|m| &m.model).collect();
    let wanted = |table| args.only.is_empty() || args.only.contains(&table);
    println!(
        "phantom walks of 1.5 s at 1.3 m/s, people outside the models (embedded synthetic, all three compete), mean of {} per row",
        args.people
    );
    println!("{:<34}{:>10}{:>10}{:>8}", "", "joints mm", "legs deg", "right");
    let base = Walk::default();
    let sight = |sight: SightOptions| Walk { sight, ..Walk::default() };
    let rig = |rig: LRig| Walk { rig, ..Walk::default() };
    let mut rows: Vec<(Table, String, Walk)> = Vec::new();
    for px in [0.05, 0.15, 0.3, 0.6, 1.0] {
        rows.push((Table::Noise, format!("disparity noise {px} px"), sight(SightOptions { disparity_px: px, ..base.sight })));
    }
    for px in [0.0, 2.0, 4.0] {
        rows.push((Table::Noise, format!("outline noise {px} px"), sight(SightOptions { outline_px: px, ..base.sight })));
    }
    for cameras in [2, 3] {
        rows.push((Table::Cameras, format!("{cameras} cameras"), rig(LRig { cameras, ..base.rig })));
    }
    for baseline_m in [0.05, 0.1, 0.2, 0.4, 0.6] {
        rows.push((Table::Baseline, format!("baseline {baseline_m} m"), rig(LRig { baseline_m, ..base.rig })));
    }
    for fps in [12.0, 15.0, 20.0, 30.0, 60.0] {
        rows.push((Table::Rate, format!("{fps} frames/s"), Walk { fps, ..base.clone() }));
    }
    for dropped in [0.1, 0.2, 0.3] {
        rows.push((Table::Dropped, format!("{:.0} % of frames dropped", 100.0 * dropped), Walk { dropped, ..base.clone() }));
    }
    for clutter in [0.1, 0.2, 0.3] {
        rows.push((Table::Clutter, format!("{:.0} % clutter points", 100.0 * clutter), sight(SightOptions { clutter, ..base.sight })));
    }
    for k in 0..8 {
        let degrees = 45 * k;
        rows.push((Table::Heading, format!("heading {degrees} deg"), Walk { heading: Some(TAU * f64::from(k) / 8.0), ..base.clone() }));
    }
    for (_, name, walk) in rows.iter().filter(|(table, ..)| wanted(*table)) {
        cell(name, walk, args.people, &models)?;
    }
    if wanted(Table::Activities) {
        activities(args.people, &models)?;
    }
    if wanted(Table::Starts) {
        starts(args.starts, &models)?;
    }
    Ok(())
}

/// One row: the walk by several people with noise of their own.
fn cell(name: &str, walk: &Walk, people: u64, models: &[&Model]) -> Result<()> {
    let mut scores = Vec::new();
    for k in 0..people {
        interrupt::check()?;
        let sight = SightOptions { seed: 1 + k, ..walk.sight };
        let take = Walk { subject: STRANGERS + k, begin: 0.37 * k as f64, sight, ..walk.clone() }.film()?;
        scores.extend(score(&take, models, &FitOptions::default())?);
    }
    let mean = |of: fn(&Score) -> f64| scores.iter().map(of).sum::<f64>() / scores.len() as f64;
    let right = scores.iter().filter(|s| s.right).count();
    println!("{name:<34}{:>10.1}{:>10.2}{:>8}", mean(|s| s.joints_mm), mean(|s| s.legs_deg), format!("{right}/{people}"));
    Ok(())
}

fn activities(people: u64, models: &[&Model]) -> Result<()> {
    for speed in [2.2, 2.8, 3.3] {
        let run = Walk { activity: Activity::Running, parameter: speed, seconds: 1.2, ..Walk::default() };
        cell(&format!("run at {speed} m/s"), &run, people, models)?;
    }
    for length in [0.4, 0.8, 1.2] {
        let jump = Walk { activity: Activity::Jumping, parameter: length, seconds: 3.0, ..Walk::default() };
        cell(&format!("jump of {:.0} cm", 100.0 * length), &jump, people, models)?;
    }
    Ok(())
}

/// A walk of anybody at any speed in any direction before any rig of the usual kind.
fn random_walk(seed: u64) -> Walk {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut between = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
    let rig = LRig {
        cameras: 3,
        baseline_m: between(0.15, 0.45),
        height_m: between(0.8, 1.5),
        focal_px: between(450.0, 620.0),
        mirrored: between(0.0, 1.0) < 0.5,
        turn: between(-0.02, 0.02),
    };
    Walk {
        subject: STRANGERS + seed,
        parameter: between(0.85, 1.9),
        heading: Some(between(0.0, TAU)),
        begin: between(0.0, 1.0),
        seconds: between(1.1, 1.7),
        dropped: between(0.0, 0.15),
        rig,
        sight: SightOptions { seed, clutter: between(0.0, 0.05), disparity_px: between(0.1, 0.3), ..SightOptions::default() },
        ..Walk::default()
    }
}

fn starts(count: u64, models: &[&Model]) -> Result<()> {
    let (mut started, mut errors, mut angles) = (0, Vec::new(), Vec::new());
    for seed in 0..count {
        interrupt::check()?;
        let walk = random_walk(seed);
        match walk.film().and_then(|take| score(&take, models, &FitOptions::default())) {
            Ok(Some(found)) => {
                if found.started() {
                    started += 1;
                    errors.push(found.joints_mm);
                    angles.push(found.legs_deg);
                } else {
                    let costs: Vec<String> = found.candidates.iter().map(Candidate::to_string).collect();
                    let what =
                        format!("{:.0} mm, {:.1} deg, right {}, costs {}", found.joints_mm, found.legs_deg, found.right, costs.join(", "));
                    missed(seed, &walk, &what);
                }
            }
            Ok(None) => missed(seed, &walk, "nobody found"),
            Err(error) => missed(seed, &walk, &error.to_string()),
        }
    }
    let at = |values: &[f64], q: f64| quantile(values.to_vec(), q).unwrap_or(f64::NAN);
    println!(
        "{started} of {count} random walks start correctly; of these the median is {:.1} mm and {:.2} deg, the 95th percentile {:.1} mm and {:.2} deg",
        at(&errors, 0.5),
        at(&angles, 0.5),
        at(&errors, 0.95),
        at(&angles, 0.95)
    );
    Ok(())
}

fn missed(seed: u64, walk: &Walk, what: &str) {
    println!(
        "  seed {seed} ({:.2} m/s, heading {:.0} deg, {:.1} s): {what}",
        walk.parameter,
        walk.heading.unwrap_or_default().to_degrees(),
        walk.seconds
    );
}

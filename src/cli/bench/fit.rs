//! `muybridge bench fit`: what each ingredient of the fit is worth on sessions whose true joints are known.
//!
//! Scores over all frames and the joints of `phantom::truth` that the truth has; varying: each joint's constant offset in
//! the person's frame removed, since other skeletons have other joint centres.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use clap::Args;
use muybridge::body::{NODES, place};
use muybridge::clouds::{CloudOptions, CloudRig};
use muybridge::fit::{self, Fit, FitOptions, Observation, PointResidual};
use muybridge::io::{joints_csv, model_npz::read_model, session::Session};
use muybridge::motion_model::{Activity, Model};
use muybridge::phantom::{joint_errors, truth};
use muybridge::rig::Rig;
use nalgebra::Vector3;

use super::super::{interrupt, motions::ActivityName, observe, track::NamedModel};

#[derive(Args)]
pub struct FitArgs {
    /// Session folders with truth/joints.csv
    #[arg(required = true)]
    sessions: Vec<PathBuf>,
    /// Motion model (.npz) of `muybridge model build`; the embedded synthetic one without it
    #[arg(long)]
    model: Option<PathBuf>,
    /// Which embedded model to use
    #[arg(long, default_value = "walking", conflicts_with = "model")]
    activity: ActivityName,
}

/// One row of the table.
struct Variant {
    name: &'static str,
    /// The third camera stays dark.
    two_cameras: bool,
    silhouettes: bool,
    options: FitOptions,
}

fn variants() -> Vec<Variant> {
    let whole = FitOptions::default();
    let of = |name, options| Variant { name, two_cameras: false, silhouettes: true, options };
    vec![
        of("all", whole),
        Variant { two_cameras: true, ..of("two cameras", whole) },
        Variant { silhouettes: false, ..of("no silhouettes", whole) },
        of("lengths of the template", FitOptions { lengths: false, ..whole }),
        of("10 weights", FitOptions { components: 10, ..whole }),
        of("30 weights", FitOptions { components: 30, ..whole }),
        of("no turns of single joints", FitOptions { deviations: false, ..whole }),
        of("points along lines of sight", FitOptions { residual: PointResidual::Ray, ..whole }),
        of("T - F of the paper", FitOptions { residual: PointResidual::Field, ..whole }),
        of("10 weights, no turns", FitOptions { components: 10, deviations: false, ..whole }),
    ]
}

pub fn run(args: &FitArgs) -> Result<()> {
    let model: Model = match &args.model {
        Some(path) => read_model(path)?,
        None => NamedModel::synthetic(Activity::from(args.activity))?.model,
    };
    println!("{:<22}{:<28}{:>10}{:>12}{:>10}{:>8}{:>10}", "session", "fit", "joints mm", "varying mm", "legs deg", "legs", "joints: sd");
    args.sessions.iter().try_for_each(|folder| ablate(folder, &model).with_context(|| folder.display().to_string()))
}

/// What a rig saw.
struct Seen {
    rig: Rig,
    observations: Vec<Observation>,
    floor_m: Option<f64>,
}

fn ablate(folder: &Path, model: &Model) -> Result<()> {
    let (session, _) = Session::open(folder, None)?;
    let path = folder.join("truth/joints.csv");
    ensure!(path.exists(), "no truth/joints.csv; `muybridge render` makes footage with its truth");
    let known = joints_csv::read(&path)?;
    let three = look(&session, session.rig.cameras.len())?;
    let two = if session.rig.cameras.len() > 2 { Some(look(&session, 2)?) } else { None };
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    for variant in variants() {
        interrupt::check()?;
        let seen = match (&two, variant.two_cameras) {
            (Some(two), true) => two,
            (None, true) => continue,
            _ => &three,
        };
        let found = fitted(seen, model, &variant)?;
        println!("{name:<22}{:<28}{}", variant.name, row(&found, seen, &known)?);
    }
    Ok(())
}

/// Clouds and silhouettes of the session's first `cameras` cameras.
fn look(session: &Session, cameras: usize) -> Result<Seen> {
    let options = CloudOptions::default();
    let mut part = session.clone();
    part.rig.cameras.truncate(cameras);
    part.cameras.truncate(cameras);
    part.backgrounds.iter_mut().for_each(|b| b.truncate(cameras));
    let rig = CloudRig::new(&part.rig, Some(&part.stages()?), &options)?;
    let observations = observe::observe(&part, &rig, &options, None, |_, _| Ok(()))?;
    Ok(Seen { floor_m: rig.floor_m(&part.rig.up.direction()), rig: part.rig, observations })
}

fn fitted(seen: &Seen, model: &Model, variant: &Variant) -> Result<Fit> {
    let mut observations = seen.observations.clone();
    if !variant.silhouettes {
        observations.iter_mut().flat_map(|o| Arc::make_mut(&mut o.silhouettes)).for_each(|s| *s = None);
    }
    Ok(fit::fit(&observations, &seen.rig, &[model], seen.floor_m, &variant.options, &|_| !interrupt::came())?)
}

fn row(fit: &Fit, seen: &Seen, known: &joints_csv::Joints) -> Result<String> {
    let offsets = fit.shape().offsets();
    let (mut found, mut wanted, mut sigmas) = (Vec::new(), Vec::new(), Vec::new());
    for (t, observation) in seen.observations.iter().enumerate() {
        let Some(truth) = known.get(&observation.number) else { continue };
        found.push(place(&offsets, &fit.poses[t]).positions);
        wanted.push(*truth);
        let spread = |u: &fit::Uncertainty| truth::SCORED.map(|j| u.frames[t].joints_m[j as usize].norm());
        sigmas.extend(fit.uncertainty.as_ref().map(spread).into_iter().flatten());
    }
    let complete = |p: &[Vector3<f64>; NODES]| truth::SCORED.iter().all(|j| p[*j as usize].iter().all(|v| v.is_finite()));
    ensure!(!wanted.is_empty() && wanted.iter().all(complete), "truth/joints.csv lacks frames or one of the thirteen scored joints");
    let errors = joint_errors(&found, &wanted);
    Ok(format!(
        "{:>10.1}{:>12.1}{:>10.2}{:>8}{:>10.1}",
        1e3 * errors.absolute_m,
        1e3 * truth::varying_m(&found, &wanted, &fit.up),
        0.5 * (errors.angles[0] + errors.angles[1]).to_degrees(),
        if errors.swapped_over_straight > 1.0 { "right" } else { "swapped" },
        1e3 * sigmas.iter().sum::<f64>() / sigmas.len() as f64
    ))
}

//! `muybridge demo`: the whole main job on footage that the phantom renders, and its errors against the known truth.

mod errors;
mod pictures;
mod table;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use muybridge::body::{Clip, Pose};
use muybridge::fit::FitOptions;
use muybridge::io::ply::write_ply;
use muybridge::io::session::Session;
use muybridge::io::{bvh, calib_toml, write_atomic};
use muybridge::motion::{Length, Synthesis, play, play_cycle, synthesize};
use muybridge::motion_model::synthetic::{self, SyntheticSubject};
use muybridge::motion_model::{Activity, Cycle};
use muybridge::phantom::{Scene, Stage, staging};
use muybridge::rig::Rig;
use muybridge::style::{Method, Population, Style};
use tempfile::TempDir;

use super::check;
use super::render::{Take, write_session};
use super::track::{self, NamedModel, Tracked};
use super::track_report;
use super::whole;

/// A person the embedded database (seeds 1 to 9) does not hold.
const SUBJECT: u64 = 1000;
/// Between the speeds of the database, m/s.
const SPEED_M_S: f64 = 1.30;
const FPS: f64 = 30.0;
/// Speeds to generate, km/h.
const WANTED_KMH: [f64; 5] = [3.0, 4.0, 5.0, 6.0, 7.0];
const GENERATED_FPS: f64 = 60.0;
const GENERATED_CYCLES: usize = 4;
/// A cloud is written for every frame with a number that this divides.
const CLOUD_EVERY: usize = 10;
/// Says that a folder is a demo's and may be replaced by the next one.
const MARKER: &str = "demo.json";
const PROGRAM: &str = "muybridge demo";
const RIG: &str = include_str!("../../../calib/phantom_lab.toml");

#[derive(clap::Args)]
pub struct DemoArgs {
    /// Folder for everything; an earlier demo there is replaced
    #[arg(short, long, value_name = "DIR", default_value = "demo")]
    output: PathBuf,
    /// Frames to film
    #[arg(long, default_value_t = 45, hide = true, value_parser = clap::value_parser!(u16).range(10..))]
    frames: u16,
}

/// The person that is filmed.
struct Truth {
    subject: SyntheticSubject,
    cycle: Cycle,
    /// In the rig's world, one per frame.
    poses: Vec<Pose>,
    /// Of the cycle, one per frame, unwrapped.
    phases: Vec<f64>,
}

/// One generated motion.
struct Generated {
    kmh: f64,
    synthesis: Synthesis,
    clip: Clip,
}

/// How long the stages took.
#[derive(Default)]
struct Clock(Vec<(&'static str, f64)>);

impl Clock {
    fn time<T>(&mut self, stage: &'static str, work: impl FnOnce() -> Result<T>) -> Result<T> {
        let begun = Instant::now();
        let done = work()?;
        self.0.push((stage, begun.elapsed().as_secs_f64()));
        Ok(done)
    }
}

pub fn run(args: &DemoArgs) -> Result<()> {
    replaceable(&args.output)?;
    let partial = whole::beside(&args.output)?;
    let text = demonstrate(partial.path(), args.frames.into())?;
    replace(&args.output, partial)?;
    print!("\n{text}");
    where_to_look(&args.output);
    Ok(())
}

/// Renders, checks, tracks, generates, measures; returns the table.
fn demonstrate(folder: &Path, frames: usize) -> Result<String> {
    let mut clock = Clock::default();
    let rig = calib_toml::parse_rig(RIG, Path::new("calib/phantom_lab.toml"))?;
    let truth = film(&rig, frames)?;
    let session_folder = folder.join("session");
    clock.time("render", || render(&session_folder, &rig, &truth))?;
    let (session, _) = Session::open(&session_folder, None)?;
    clock.time("check", || announce(&session))?;
    let models = clock.time("models", NamedModel::embedded)?;
    let seen = clock.time("clouds", || {
        track::look(&session, None, |_, frame, found| {
            if frame.number.is_multiple_of(CLOUD_EVERY) {
                write_ply(&folder.join(format!("clouds/{:06}.ply", frame.number)), &found.cloud)?;
            }
            Ok(())
        })
    })?;
    let tracked = clock.time("fit", || track::fit_to(&session, seen, &models, &FitOptions::default(), None))?;
    let model = &models[tracked.fit.model];
    let generated = clock.time("style and new speeds", || generate(folder, &session, &models, &tracked))?;
    let rows = clock.time("errors and pictures", || {
        let rows = errors::rows(&truth, model, &tracked, &generated)?;
        track::draw(&folder.join("pictures"), &session.rig, &model.model, &tracked)?;
        pictures::draw(&folder.join("pictures"), &truth, &model.model, &tracked, &generated)?;
        Ok(rows)
    })?;
    let text = table::text(&rows, errors::NOTES, &clock.0);
    write_atomic(&folder.join("table.txt"), text.as_bytes())?;
    write_atomic(&folder.join("errors.csv"), table::csv(&rows).as_bytes())?;
    write_atomic(&folder.join(MARKER), marker(&truth).as_bytes())?;
    Ok(text)
}

/// A walk across the view, cut to what every camera sees whole.
fn film(rig: &Rig, frames: usize) -> Result<Truth> {
    let subject = synthetic::subject(Activity::Walking, SUBJECT);
    let (cycle, shape) = (subject.cycle(SPEED_M_S, 0), subject.shape());
    let clip = play_cycle(&cycle, &shape.offsets(), FPS, Length::Seconds((frames - 1) as f64 / FPS));
    let heading = staging::crossing_heading(rig);
    let Some(start) = staging::cross_the_view(rig, &clip, &shape, heading) else {
        bail!("the walk finds no place before the phantom's rig");
    };
    let poses = staging::poses_in_world(&clip, &shape, rig.up, start, heading);
    let run = staging::longest_run_in_view(rig, &shape, &poses);
    let phases = run.clone().map(|frame| frame as f64 / FPS / cycle.duration_s).collect();
    Ok(Truth { subject, cycle, poses: poses[run].to_vec(), phases })
}

fn render(folder: &Path, rig: &Rig, truth: &Truth) -> Result<()> {
    let path: Vec<_> = truth.poses.iter().map(|p| p.root).collect();
    let scene = Scene::new(Stage::around(rig, &path), &truth.subject.shape());
    write_session(folder, &Take { scene: &scene, rig, poses: &truth.poses, fps: FPS, depth_every: None })
}

fn announce(session: &Session) -> Result<()> {
    let warnings = check::look(session)?.warnings(session);
    warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    Ok(())
}

/// Writes what `track` and `generate` write; returns the motions made.
fn generate(folder: &Path, session: &Session, models: &[NamedModel], tracked: &Tracked) -> Result<Vec<Generated>> {
    track::write(&folder.join("track"), session, models, tracked)?;
    track_report::write(&folder.join("track"), session, models, tracked)?;
    let model = &models[tracked.fit.model];
    let offsets = tracked.fit.shape().offsets();
    let one = |kmh: f64| {
        let synthesis = at_speed(model, &tracked.style, kmh / 3.6)?;
        let clip = play(&model.model, &synthesis, &offsets, GENERATED_FPS, Length::Cycles(GENERATED_CYCLES));
        bvh::write_clip(&folder.join(format!("generated/walking_{kmh}kmh.bvh")), &clip, None)?;
        Ok(Generated { kmh, synthesis, clip })
    };
    WANTED_KMH.into_iter().map(one).collect()
}

/// As `muybridge generate` does it without options.
fn at_speed(model: &NamedModel, style: &Style, speed_m_s: f64) -> Result<Synthesis> {
    let population = Population::new(&model.model, style.weights.len());
    Ok(synthesize(&model.model, &population, Method::Default, style, speed_m_s, style.hip_height_m)?)
}

fn marker(truth: &Truth) -> String {
    let facts = serde_json::json!({
        "program": PROGRAM,
        "version": env!("CARGO_PKG_VERSION"),
        "synthetic": true,
        "subject": truth.subject.name,
        "speed_m_s": SPEED_M_S,
        "stature_m": truth.subject.stature_m,
        "hip_height_m": truth.subject.hip_height_m,
        "frames": truth.poses.len(),
        "fps": FPS,
    });
    format!("{facts:#}\n")
}

/// An error where `output` holds anything but an earlier demo.
fn replaceable(output: &Path) -> Result<()> {
    ensure!(output.file_name().is_some(), "{}: name a folder of its own with -o", output.display());
    let occupied = output.exists() && output.read_dir().map(|mut entries| entries.next().is_some()).unwrap_or(true);
    let ours = std::fs::read_to_string(output.join(MARKER)).is_ok_and(|text| text.contains(PROGRAM));
    ensure!(!occupied || ours, "{}: exists already and is no demo's folder; remove it or choose another with -o", output.display());
    Ok(())
}

/// Puts the finished folder in the place of an earlier one.
fn replace(output: &Path, partial: TempDir) -> Result<()> {
    let earlier = whole::beside(output)?;
    if output.exists() {
        std::fs::rename(output, earlier.path().join("demo")).with_context(|| format!("cannot replace {}", output.display()))?;
    }
    whole::publish(partial, output)
}

fn where_to_look(output: &Path) {
    println!("\nThe person is synthetic and so is the model; the footage was rendered with a known truth. Look at");
    for (path, what) in [
        ("pictures/overlay_cam_00.png", "the recovered skeleton over the footage"),
        ("pictures/cloud.png", "a point cloud with the recovered body"),
        ("pictures/depth.png", "depths measured in one frame"),
        ("pictures/angles.png", "recovered and true joint angles over the cycle"),
        ("pictures/speeds.png", "the same person at five speeds"),
        ("generated/*.bvh", "the five motions, for Blender and others"),
        ("track/report.html", "all of it on one page, with gait table and a view to turn about"),
        ("track/motion.bvh", "the recovered motion; joints.csv and style.json beside it"),
        ("clouds/*.ply", "point clouds, for MeshLab and others"),
        ("session/", "the footage with its truth, a session for `muybridge check`, `clouds` and `track`"),
    ] {
        println!("  {:<42} {what}", output.join(path).display());
    }
}

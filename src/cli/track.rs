//! `muybridge track`: a session's footage to the person's motion, style and size.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::Args;
use image::GrayImage;
use muybridge::body::{Clip, NODES, Placement, Pose, PosedSurface, place};
use muybridge::clouds::{CloudOptions, CloudRig, FrameCloud};
use muybridge::fit::{self, Fit, FitOptions, Observation};
use muybridge::footage::FrameSet;
use muybridge::io::outputs_json::Source;
use muybridge::io::{fit_json, joints_csv, model_npz, session::Session, style_json};
use muybridge::math::euler::Order;
use muybridge::motion_model::{Activity, Model, synthetic};
use muybridge::phantom;
use muybridge::report;
use muybridge::rig::{Rig, Up};
use muybridge::style::Style;
use nalgebra::{DVector, Rotation3, UnitQuaternion, Vector3};

use super::motions::{ActivityName, file_name};
use super::outputs::{Names, Writer};
use super::{interrupt, observe};

/// Frames in the strip of overlays.
const STRIP: usize = 6;

#[derive(Args)]
pub struct TrackArgs {
    /// Session folder with Calib.toml and one folder or video per camera
    session: PathBuf,
    /// Motion model (.npz) of `muybridge model build`; the embedded synthetic one without it
    #[arg(long)]
    model: Option<PathBuf>,
    /// Which embedded model to use
    #[arg(long, default_value = "walking", conflicts_with = "model")]
    activity: ActivityName,
    /// Folder for style.json, joints.csv, uncertainty.csv, motion.bvh, motion.glb, joints.trc, joints.c3d, angles.mot, outputs.json, fit.json
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Frames per second of pictures
    #[arg(long)]
    fps: Option<f64>,
    /// Part of the model's variance that the last stage of the fit uses; 20 components without it
    #[arg(long, value_parser = super::part)]
    variance: Option<f64>,
    /// Also draw the result into DIR/pictures
    #[arg(long)]
    pictures: bool,
}

/// A model with what the outputs say of it.
pub struct NamedModel {
    pub model: Model,
    pub name: String,
    pub hash: String,
}

impl NamedModel {
    pub fn new(model: Model, name: String) -> NamedModel {
        let hash = model_npz::model_hash(&model);
        NamedModel { model, name, hash }
    }

    /// The embedded synthetic database's.
    pub fn synthetic(activity: Activity) -> Result<NamedModel> {
        let model = Model::build(activity, true, &synthetic::database(activity))?;
        Ok(NamedModel::new(model, format!("embedded synthetic {activity} model")))
    }
}

/// A fit with the session it belongs to.
pub struct Tracked {
    pub fit: Fit,
    pub observations: Vec<Observation>,
    /// The pictures of all cameras for each frame of the strips: index of the frame, pictures.
    pub pictures: Vec<(usize, Vec<GrayImage>)>,
}

pub fn run(args: &TrackArgs) -> Result<()> {
    let model = match &args.model {
        Some(path) => NamedModel::new(model_npz::read_model(path)?, path.display().to_string()),
        None => NamedModel::synthetic(args.activity.into())?,
    };
    if model.model.synthetic {
        eprintln!(
            "note: the model is synthetic; for figures that mean something build one from motion capture with `muybridge model build`"
        );
    }
    let (session, notices) = Session::open(&args.session, args.fps)?;
    notices.iter().for_each(|notice| eprintln!("note: {notice}"));
    let mut options = FitOptions::default();
    if let Some(variance) = args.variance {
        options.components = model.model.components(variance);
    }
    let tracked = track(&session, &model, &options)?;
    write(&args.output, &session, &model, &tracked)?;
    if args.pictures {
        draw(&args.output.join("pictures"), &session.rig, &model, &tracked)?;
    }
    summary(&args.output, &tracked.fit);
    Ok(())
}

/// Clouds of a session and the fit to them.
pub fn track(session: &Session, model: &NamedModel, options: &FitOptions) -> Result<Tracked> {
    fit_to(session, look(session, |_, _, _| Ok(()))?, model, options)
}

/// What the cameras saw in all frames.
pub struct Seen {
    observations: Vec<Observation>,
    pictures: Vec<(usize, Vec<GrayImage>)>,
    floor_m: Option<f64>,
}

/// Clouds of a session; `each` sees every frame, in order.
pub fn look(session: &Session, mut each: impl FnMut(&CloudRig, &FrameSet, &FrameCloud) -> Result<()>) -> Result<Seen> {
    let cloud_options = CloudOptions::default();
    let stage = session.stages()?;
    let rig =
        CloudRig::new(&session.rig, Some(&stage), &cloud_options).with_context(|| format!("the rig of {}", session.folder.display()))?;
    let step = session.frame_count.div_ceil(STRIP).max(1);
    let (mut pictures, mut index) = (Vec::new(), 0);
    let observations = observe::observe(session, &rig, &cloud_options, |frame, found| {
        if index % step == 0 {
            pictures.push((index, frame.images.clone()));
        }
        index += 1;
        each(&rig, frame, found)
    })?;
    Ok(Seen { observations, pictures, floor_m: rig.floor_m(&session.rig.up.direction()) })
}

/// The fit to what was seen of a session.
pub fn fit_to(session: &Session, seen: Seen, model: &NamedModel, options: &FitOptions) -> Result<Tracked> {
    let Seen { observations, pictures, floor_m } = seen;
    let bar = super::progress::bar("fit", 100);
    let done = std::cell::Cell::new(0);
    let fit = fit::fit(&observations, &session.rig, &model.model, floor_m, options, &|share| {
        let percent = (100.0 * share) as u64;
        bar.inc(percent.saturating_sub(done.replace(percent)));
        !interrupt::came()
    })
    .with_context(|| session.folder.display().to_string())?;
    bar.finish();
    Ok(Tracked { fit, observations, pictures })
}

/// Writes the files of a tracked session.
pub fn write(folder: &Path, session: &Session, model: &NamedModel, tracked: &Tracked) -> Result<()> {
    let Tracked { fit, observations, .. } = tracked;
    let placements = placements(fit);
    let frames: Vec<(usize, f64)> = observations.iter().map(|o| (o.number, o.time_s)).collect();
    let positions: Vec<[Vector3<f64>; NODES]> = placements.iter().map(|p| p.positions).collect();
    joints_csv::write(&folder.join("joints.csv"), &frames, &positions)?;
    let sigmas: Vec<_> = fit.uncertainty.iter().flat_map(|u| &u.frames).map(|f| f.joints_m).collect();
    joints_csv::write_sigmas(&folder.join("uncertainty.csv"), &frames, &sigmas)?;
    let (clip, clip_from_rig) = clip(fit, &session.rig, observations, session.fps)?;
    let source = Source { motion: file_name(&session.folder), model: model.name.clone(), model_hash: model.hash.clone() };
    let mut files = Writer::new(folder, fit.shape(), Some(clip_from_rig), Order::ZXY, source);
    files.motion(&Names::tracked(), &model.model.activity.to_string(), &clip)?;
    files.finish()?;
    style_json::write_style(&folder.join("style.json"), &style(fit, model))?;
    let report = folder.join("fit.json");
    fit_json::write(&report, fit, observations, &model.name, &model.hash).with_context(|| report.display().to_string())
}

fn placements(fit: &Fit) -> Vec<Placement> {
    let offsets = fit.shape().offsets();
    fit.poses.iter().map(|pose| place(&offsets, pose)).collect()
}

/// The person's style with its covariance.
pub fn style(fit: &Fit, model: &NamedModel) -> Style {
    let weights = DVector::from_column_slice(&fit.state.weights);
    let hip_height = fit.shape().hip_height_m();
    let rows = 0..weights.len();
    let covariance =
        rows.clone().map(|i| rows.clone().map(|j| fit.uncertainty.as_ref().map_or(f64::NAN, |u| u.shared[(i, j)])).collect()).collect();
    let style = Style::of_weights(&model.model, &model.hash, &weights, fit.parameter(model.model.activity), hip_height, fit.cadence_hz);
    Style { covariance: Some(covariance), shape: Some(fit.shape().clone()), ..style }
}

/// The fitted poses in a y-up world, one per 1/fps second, dropped frames filled in; and the rotation into that world.
fn clip(fit: &Fit, rig: &Rig, observations: &[Observation], fps: f64) -> Result<(Clip, Rotation3<f64>)> {
    ensure!(!fit.poses.is_empty(), "the fit has no frames");
    let clip_from_rig = match rig.up {
        Up::Y => Rotation3::identity(),
        Up::Z => Rotation3::new(Vector3::x() * -std::f64::consts::FRAC_PI_2),
    };
    let turn = UnitQuaternion::from_rotation_matrix(&clip_from_rig);
    let turned = |pose: &Pose| Pose { root: turn * pose.root, world_from_root: turn * pose.world_from_root, ..pose.clone() };
    let mut poses = vec![turned(&fit.poses[0])];
    for (pair, numbers) in fit.poses.windows(2).zip(observations.windows(2)) {
        let gap = (numbers[1].number - numbers[0].number).max(1);
        poses.extend((1..=gap).map(|k| turned(&pair[0].towards(&pair[1], k as f64 / gap as f64))));
    }
    let shape = fit.shape();
    Ok((Clip { fps, poses, offsets: shape.offsets(), hip_height_m: shape.hip_height_m() }, clip_from_rig))
}

/// Overlays for each camera, the cloud with the body of the middle frame, curves of phase and root, and the weights among
/// the model's.
pub fn draw(folder: &Path, rig: &Rig, model: &NamedModel, tracked: &Tracked) -> Result<()> {
    let Tracked { fit, observations, pictures } = tracked;
    let placements = placements(fit);
    let (surface, offsets) = (muybridge::body::Surface::new(fit.shape()), fit.shape().offsets());
    for (k, camera) in rig.cameras.iter().enumerate() {
        let mut tiles = Vec::new();
        for (index, views) in pictures {
            let (placement, o) = (&placements[*index], &observations[*index]);
            let outline = phantom::silhouette(&surface, &offsets, placement, camera);
            let Some(picture) = views.get(k) else { continue };
            let drawn = report::overlay(picture, camera, &placement.positions, Some(&outline))?;
            tiles.push((drawn, format!("frame {}, {:.2} s", o.number, o.time_s)));
        }
        report::save(&folder.join(format!("overlay_{}.png", camera.name)), &report::strip(&tiles, 3, 640)?)?;
    }
    let middle = placements.len() / 2;
    let skin = PosedSurface::new(&surface, &placements[middle]);
    let dot = |x: Vector3<f64>| report::CloudDot { x, distance_m: skin.distance(&x) };
    let dots: Vec<_> = observations[middle].cloud.points.iter().map(|p| dot(p.position)).collect();
    let title = format!("Cloud and body, frame {}", observations[middle].number);
    report::save(&folder.join("cloud.png"), &report::cloud_and_body(&dots, &placements[middle].positions, rig.up, &title)?)?;
    draw_curves(folder, tracked)?;
    let covariance = fit.uncertainty.as_ref().map(|u| [[u.shared[(0, 0)], u.shared[(0, 1)]], [u.shared[(1, 0)], u.shared[(1, 1)]]]);
    let known = covariance.filter(|_| fit.state.weights.len() > 1);
    let picture = report::clusters(&model.model, &fit.state.weights, known, "This person among the model's subjects")?;
    Ok(report::save(&folder.join("weights.png"), &picture)?)
}

/// Two standard deviations either way of a normal hold 95 %.
const BAND: f64 = 1.96;

/// Phase, and root position and heading, over time with bands of 95 %.
fn draw_curves(folder: &Path, tracked: &Tracked) -> Result<()> {
    let Tracked { fit, observations, .. } = tracked;
    let sigmas = |k: usize| -> Vec<f64> { fit.uncertainty.iter().flat_map(|u| &u.frames).map(|f| BAND * f.local[k]).collect() };
    let series = |label: &str, colour: usize, band: Vec<f64>, value: &dyn Fn(usize) -> f64| {
        let points = observations.iter().enumerate().map(|(t, o)| [o.time_s, value(t)]).collect();
        report::Curve { label: label.to_string(), points, dashed: false, colour, band }
    };
    let carriers = &fit.state.carriers;
    let phase = series("phase", 0, sigmas(6), &|t| carriers[t].phase);
    let picture = report::curves("Phase, with its 95 % band", "time (s)", "phase (cycles)", &[phase])?;
    report::save(&folder.join("phase.png"), &picture)?;
    let start = carriers[0].position;
    let axes = ["x", "y", "z"].iter().enumerate();
    let root: Vec<_> = axes.map(|(k, name)| series(name, k, sigmas(3 + k), &|t| carriers[t].position[k] - start[k])).collect();
    let picture = report::curves("Carrier of the root, with its 95 % bands", "time (s)", "way since the first frame (m)", &root)?;
    Ok(report::save(&folder.join("root.png"), &picture)?)
}

/// Costs of the two half-cycle hypotheses closer than this leave open which leg is which.
const UNDECIDED: f64 = 1.3;

fn summary(folder: &Path, fit: &Fit) {
    if fit.hypotheses[1] < UNDECIDED * fit.hypotheses[0] {
        eprintln!(
            "warning: with left and right legs exchanged the cost is {:.0} against {:.0}; look at the pictures (--pictures) before you trust the sides",
            fit.hypotheses[1], fit.hypotheses[0]
        );
    }
    let shape = fit.shape();
    let observed = fit.weight_uncertainty().iter().filter(|u| **u < 0.5).count();
    println!(
        "{} frames at {:.2} m/s and {:.2} cycles/s, stature {:.2} m, {:.1} mm from the points; {observed} of {} weights known to half the population's spread; in {}",
        fit.poses.len(),
        fit.speed_m_s,
        fit.cadence_hz,
        shape.stature_m,
        1e3 * fit.rms_m(),
        fit.state.weights.len(),
        folder.display()
    );
}

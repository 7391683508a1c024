//! `muybridge track`: a session's footage to the person's motion, style and size.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::Args;
use image::GrayImage;
use muybridge::body::{Clip, NODES, Placement, Pose, PosedSurface, place};
use muybridge::clouds::{CloudOptions, CloudRig, FrameCloud};
use muybridge::fit::{self, Checkpoints, Fit, FitOptions, Observation, own_motion};
use muybridge::footage::FrameSet;
use muybridge::io::fit_json::ModelName;
use muybridge::io::outputs_json::Source;
use muybridge::io::session_config::{self, SessionConfig};
use muybridge::io::{content, fit_checkpoint, fit_json, joints_csv, model_npz, session::Session, style_json};
use muybridge::math::euler::Order;
use muybridge::motion_model::{Activity, Model, synthetic};
use muybridge::phantom::{self, DepthMap};
use muybridge::report::{self, track::UNDECIDED, walk::BAND};
use muybridge::rig::{Rig, Up};
use muybridge::style::{Pace, Style};
use nalgebra::{DVector, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::motions::{ActivityName, file_name};
use super::outputs::{Names, Writer};
use super::{interrupt, observe, track_report};

/// Frames in the strip of overlays.
const STRIP: usize = 6;

#[derive(Args, Default)]
pub struct TrackArgs {
    /// Session folder with Calib.toml and one folder or video per camera
    session: PathBuf,
    /// Motion model (.npz) of `muybridge model build`; given several times, the one that explains the footage best is taken. Without it
    /// the embedded synthetic ones compete: walking, running, jumping
    #[arg(long, value_name = "FILE")]
    model: Vec<PathBuf>,
    /// Which embedded model to use
    #[arg(long, conflicts_with = "model")]
    activity: Option<ActivityName>,
    /// Folder for style.json, joints.csv, uncertainty.csv, motion.bvh, motion.glb, joints.trc, joints.c3d, angles.mot, outputs.json, fit.json
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Folder that keeps what is found frame by frame, so that a run that was stopped goes on from there
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Frames per second of pictures
    #[arg(long)]
    fps: Option<f64>,
    /// Part of the model's variance that the last stage of the fit uses; 20 components without it
    #[arg(long, value_parser = super::part)]
    variance: Option<f64>,
    /// Also draw the result into DIR/pictures
    #[arg(long)]
    pictures: bool,
    /// Leave out report.html, thumbnail.jpg, gait.csv and angles_cycle.csv
    #[arg(long)]
    no_report: bool,
    /// Also write a recording for the viewer of rerun.io: cameras, pictures, clouds, body, skeleton and curves
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "FILE")]
    rrd: Option<PathBuf>,
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

    /// All embedded models.
    pub fn embedded() -> Result<Vec<NamedModel>> {
        Activity::ALL.into_par_iter().map(NamedModel::synthetic).collect()
    }

    fn read(path: &Path) -> Result<NamedModel> {
        Ok(NamedModel::new(model_npz::read_model(path)?, file_name(path)))
    }

    fn report_name(&self) -> ModelName {
        ModelName { model: self.name.clone(), model_hash: self.hash.clone(), activity: self.model.activity }
    }
}

/// A fit with the session it belongs to.
pub struct Tracked {
    pub fit: Fit,
    pub style: Style,
    pub observations: Vec<Observation>,
    /// The pictures of all cameras for each frame of the strips: index of the frame, pictures.
    pub pictures: Vec<(usize, Vec<GrayImage>)>,
    /// Number of the middle frame, and the person's depths there in the reference view, metres; NaN where unknown.
    pub depth: Option<(usize, DepthMap)>,
}

impl TrackArgs {
    /// A session with the options of its `muybridge.toml`.
    pub fn of(session: &Path, output: PathBuf, work: PathBuf) -> TrackArgs {
        TrackArgs { session: session.into(), output, work: Some(work), ..TrackArgs::default() }
    }

    /// What the command line says, and where it says nothing what `muybridge.toml` says.
    fn config(&self) -> Result<SessionConfig> {
        let given = SessionConfig {
            fps: self.fps,
            model: self.model.clone(),
            activity: self.activity.map(Into::into),
            variance: self.variance,
            pictures: self.pictures.then_some(true),
        };
        Ok(given.or(session_config::read(&self.session)?))
    }
}

pub fn run(args: &TrackArgs) -> Result<()> {
    let config = args.config()?;
    let mut models = config.model.iter().map(|path| NamedModel::read(path)).collect::<Result<Vec<_>>>()?;
    if models.is_empty() || models.iter().any(|model| model.model.synthetic) {
        eprintln!(
            "note: the model is synthetic; for figures that mean something build one from motion capture with `muybridge model build`"
        );
    }
    let (session, notices) = Session::open(&args.session, args.fps)?;
    notices.iter().for_each(|notice| eprintln!("note: {notice}"));
    let options = FitOptions { variance: config.variance, ..FitOptions::default() };
    // Embedded models take a second, in which one core would wait.
    let embedded = || match config.activity {
        _ if !models.is_empty() => Ok(Vec::new()),
        Some(activity) => Ok(vec![NamedModel::synthetic(activity)?]),
        None => NamedModel::embedded(),
    };
    let (seen, embedded) = rayon::join(|| look(&session, args.work.as_deref(), |_, _, _| Ok(())), embedded);
    let (seen, embedded) = (seen?, embedded?);
    models.extend(embedded);
    let hashes: Vec<&str> = models.iter().map(|m| m.hash.as_str()).collect();
    let kept = args.work.as_ref().map(|work| kept_folder(work, "fit", &session, &format!("{hashes:?} {options:?} {}", session.fps)));
    let tracked = fit_to(&session, seen, &models, &options, kept.transpose()?.as_deref())?;
    write(&args.output, &session, &models, &tracked)?;
    if !args.no_report {
        track_report::write(&args.output, &session, &models, &tracked)?;
    }
    if config.pictures == Some(true) {
        draw(&args.output.join("pictures"), &session.rig, &models[tracked.fit.model].model, &tracked)?;
    }
    #[cfg(feature = "rerun")]
    if let Some(path) = &args.rrd {
        record(path, &session, &tracked)?;
    }
    summary(&args.output, &models, &tracked.fit);
    Ok(())
}

/// A track as a recording for rerun's viewer.
#[cfg(feature = "rerun")]
fn record(path: &Path, session: &Session, tracked: &Tracked) -> Result<()> {
    let mut recording =
        report::recording::Recording::of_track(&file_name(&session.folder), &session.rig, &tracked.fit, &tracked.observations)?;
    for frame in session.frames() {
        recording.pictures(&session.rig, &frame?)?;
    }
    muybridge::io::write_atomic(path, &recording.bytes()?).with_context(|| format!("cannot write {}", path.display()))
}

/// What the cameras saw in all frames.
pub struct Seen {
    observations: Vec<Observation>,
    pictures: Vec<(usize, Vec<GrayImage>)>,
    depth: Option<(usize, DepthMap)>,
    floor_m: Option<f64>,
}

/// Clouds of a session; `each` sees every frame, in order. In the folder `work` they are kept until the next run.
pub fn look(session: &Session, work: Option<&Path>, mut each: impl FnMut(&CloudRig, &FrameSet, &FrameCloud) -> Result<()>) -> Result<Seen> {
    let cloud_options = CloudOptions::default();
    let kept = work.map(|work| kept_folder(work, "clouds", session, &format!("{cloud_options:?}"))).transpose()?;
    let stage = session.stages()?;
    let rig =
        CloudRig::new(&session.rig, Some(&stage), &cloud_options).with_context(|| format!("the rig of {}", session.folder.display()))?;
    let step = session.frame_count.div_ceil(STRIP).max(1);
    let (mut pictures, mut depth, mut index) = (Vec::new(), None, 0);
    let observations = observe::observe(session, &rig, &cloud_options, kept.as_deref(), |frame, found| {
        if index % step == 0 {
            pictures.push((index, frame.images.clone()));
        }
        if index == session.frame_count / 2 {
            depth = depth_of(&rig, found).map(|map| (frame.number, map));
        }
        index += 1;
        each(&rig, frame, found)
    })?;
    Ok(Seen { observations, pictures, depth, floor_m: rig.floor_m(&session.rig.up.direction()) })
}

/// Depths in the reference view, metres.
fn depth_of(rig: &CloudRig, found: &FrameCloud) -> Option<DepthMap> {
    let (rectification, _) = rig.groups.first().filter(|_| !found.disparity.is_empty())?;
    let mut map = found.disparity.clone();
    map.pixels_mut().for_each(|d| d.0[0] = if d.0[0] > 0.0 { rectification.depth(d.0[0].into()) as f32 } else { f32::NAN });
    Some(map)
}

/// The folder below `work` for what this program finds in this footage with these options.
fn kept_folder(work: &Path, kind: &str, session: &Session, options: &str) -> Result<PathBuf> {
    let parts = [&content::inputs_hash(&session.folder), &content::program(&super::executable()), options];
    Ok(work.join(format!("{kind}-{}", &blake3::hash(parts.join("\n").as_bytes()).to_hex()[..16])))
}

/// The fit to what was seen of a session; in the folder `kept` its state is kept after every iteration.
pub fn fit_to(session: &Session, seen: Seen, models: &[NamedModel], options: &FitOptions, kept: Option<&Path>) -> Result<Tracked> {
    let Seen { observations, pictures, depth, floor_m } = seen;
    let bar = super::progress::bar("fit", 100);
    let done = std::cell::Cell::new(0);
    let checkpoints = Checkpoints {
        load: &|stage| fit_checkpoint::read(kept?, stage),
        save: &|stage, at| {
            // A disk that is full stops the outputs, which say so.
            let _ = kept.map(|folder| fit_checkpoint::write(folder, stage, at));
        },
    };
    let given: Vec<&Model> = models.iter().map(|m| &m.model).collect();
    let fit = fit::resume(&observations, &session.rig, &given, floor_m, options, &checkpoints, &|share| {
        let percent = (100.0 * share) as u64;
        bar.inc(percent.saturating_sub(done.replace(percent)));
        !interrupt::came()
    })
    .with_context(|| session.folder.display().to_string())?;
    bar.finish();
    let style = style(&fit, &models[fit.model]);
    Ok(Tracked { fit, style, observations, pictures, depth })
}

/// Writes the files of a session that was tracked with the best of these models.
pub fn write(folder: &Path, session: &Session, models: &[NamedModel], tracked: &Tracked) -> Result<()> {
    let Tracked { fit, style, observations, .. } = tracked;
    let model = &models[fit.model];
    let placements = placements(fit);
    let frames: Vec<(usize, f64)> = observations.iter().map(|o| (o.number, o.time_s)).collect();
    let positions: Vec<[Vector3<f64>; NODES]> = placements.iter().map(|p| p.positions).collect();
    let motion = || -> Result<()> {
        let (clip, clip_from_rig) = clip(fit, &session.rig, observations, session.fps)?;
        let source = Source { motion: file_name(&session.folder), model: model.name.clone(), model_hash: model.hash.clone() };
        let mut files = Writer::new(folder, fit.shape(), Some(clip_from_rig), Order::ZXY, source);
        files.motion(&Names::tracked(), &model.model.activity.to_string(), &clip)?;
        files.finish()
    };
    let numbers = || -> Result<()> {
        joints_csv::write(&folder.join("joints.csv"), &frames, &positions)?;
        let sigmas: Vec<_> = fit.uncertainty.iter().flat_map(|u| &u.frames).map(|f| f.joints_m).collect();
        joints_csv::write_sigmas(&folder.join("uncertainty.csv"), &frames, &sigmas)?;
        style_json::write_style(&folder.join("style.json"), style)?;
        let report = folder.join("fit.json");
        let names: Vec<ModelName> = models.iter().map(NamedModel::report_name).collect();
        fit_json::write(&report, fit, observations, &names).with_context(|| report.display().to_string())
    };
    let (numbers, motion) = rayon::join(numbers, motion);
    numbers.and(motion)
}

fn placements(fit: &Fit) -> Vec<Placement> {
    let offsets = fit.shape().offsets();
    fit.poses.iter().map(|pose| place(&offsets, pose)).collect()
}

/// The person's style with its covariance.
pub fn style(fit: &Fit, model: &NamedModel) -> Style {
    let weights = DVector::from_column_slice(&fit.state.weights);
    let rows = 0..weights.len();
    let covariance =
        rows.clone().map(|i| rows.clone().map(|j| fit.uncertainty.as_ref().map_or(f64::NAN, |u| u.shared[(i, j)])).collect()).collect();
    let parameter = fit.parameter(model.model.activity);
    let pace = Pace { parameter, hip_height_m: fit.shape().hip_height_m(), frequency_hz: fit.cadence_hz };
    let departure = own_motion::departure(fit, &model.model);
    let style = Style::of_tracked(&model.model, &model.hash, &weights, pace, departure);
    Style { covariance: Some(covariance), shape: Some(fit.shape().clone()), ..style }
}

/// The fitted poses in a y-up world, one per 1/fps second, dropped frames filled in; and the rotation into that world.
pub(super) fn clip(fit: &Fit, rig: &Rig, observations: &[Observation], fps: f64) -> Result<(Clip, Rotation3<f64>)> {
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
pub fn draw(folder: &Path, rig: &Rig, model: &Model, tracked: &Tracked) -> Result<()> {
    let Tracked { fit, style, observations, pictures, .. } = tracked;
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
    let (weights, covariance) = style.place();
    let picture = report::clusters(model, weights, covariance, "This person among the model's subjects")?;
    Ok(report::save(&folder.join("weights.png"), &picture)?)
}

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

fn summary(folder: &Path, models: &[NamedModel], fit: &Fit) {
    let model = &models[fit.model];
    if let Some(second) = fit::contest::runner_up(&fit.candidates) {
        let (costs, name) = ([fit.model, second].map(|k| fit.candidates[k].costs[0]), &models[second].name);
        if costs[1] < UNDECIDED * costs[0] {
            eprintln!(
                "warning: the model may be the wrong one: {name} costs {:.0} against {:.0} for {}; name the right one with --model or --activity",
                costs[1], costs[0], model.name
            );
        }
        println!("{}: {}; it costs {:.0}, the next best, {name}, {:.0}", model.model.activity, model.name, costs[0], costs[1]);
    }
    let [best, other] = fit.half_cycles();
    if other < UNDECIDED * best {
        eprintln!(
            "warning: with left and right legs exchanged the cost is {other:.0} against {best:.0}; look at the report before you trust the sides"
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

//! `muybridge render`: phantom footage of a motion file before a rig.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use image::{ColorType, ImageEncoder, ImageFormat, codecs::png::PngEncoder};
use rayon::prelude::*;

use super::{interrupt, progress, whole};
use muybridge::body::{Clip, Pose, Shape, place};
use muybridge::io::{calib_toml, joints_csv, read_clip, write_atomic};
use muybridge::phantom::{DepthMap, Scene, Stage, View, depth, mask, render, render_stage, staging};
use muybridge::rig::Rig;

#[derive(Args)]
pub struct RenderArgs {
    /// Motion file: BVH, ASF/AMC or MOT
    motion: PathBuf,
    /// Rig, Calib.toml form; the floor of its world must be at height 0
    #[arg(long)]
    rig: PathBuf,
    /// Session folder to write; must not exist or be empty
    #[arg(short, long)]
    output: PathBuf,
    /// Floor point under the first root position, metres; without it the motion crosses the view and frames that leave it are cut
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y")]
    start: Option<[f64; 2]>,
    /// Way of travel in degrees from the world's x axis towards y (y-up worlds: z towards x); without it from left to right
    #[arg(long, allow_hyphen_values = true)]
    heading: Option<f64>,
    /// Frames per second of the footage
    #[arg(long, default_value_t = 30.0)]
    fps: f64,
    /// Stature of the subject in metres; without it the motion's own
    #[arg(long)]
    stature: Option<f64>,
    /// First second of the motion to film
    #[arg(long, default_value_t = 0.0)]
    from: f64,
    /// Last second of the motion to film; without it the end
    #[arg(long)]
    to: Option<f64>,
    /// Sensor noise, grey levels
    #[arg(long, default_value_t = 2.0)]
    noise: f64,
    /// Seed of the sensor noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Also write true depth maps and masks of every N-th frame of every camera
    #[arg(long, value_name = "N")]
    depth_every: Option<usize>,
}

fn parse_point(text: &str) -> Result<[f64; 2], String> {
    let numbers: Vec<f64> = text.split(',').map_while(|t| t.trim().parse().ok()).collect();
    match numbers[..] {
        [x, y] if x.is_finite() && y.is_finite() && text.split(',').count() == 2 => Ok([x, y]),
        _ => Err("two numbers, such as -1.2,3".into()),
    }
}

/// Footage to be rendered.
pub struct Take<'a> {
    pub scene: &'a Scene,
    pub rig: &'a Rig,
    /// One per frame, in the rig's world.
    pub poses: &'a [Pose],
    pub fps: f64,
    /// True depth maps and masks of every N-th frame.
    pub depth_every: Option<usize>,
}

pub fn run(args: &RenderArgs) -> Result<()> {
    for (name, value) in [("--fps", Some(args.fps)), ("--stature", args.stature)] {
        ensure!(value.is_none_or(|v| v.is_finite() && v > 0.0), "{name} must be a number above 0");
    }
    ensure!(args.noise.is_finite() && args.noise >= 0.0, "--noise must be 0 or more grey levels");
    ensure!(args.depth_every != Some(0), "--depth-every must be 1 or more");
    let rig = calib_toml::read_rig(&args.rig)?;
    let read = read_clip(&args.motion)?;
    read.notices.iter().for_each(|notice| eprintln!("notice: {notice}"));
    let shape = args.stature.map_or_else(|| staging::subject_of(&read.clip), Shape::template);
    let clip = staging::resample(&read.clip, args.fps, args.from, args.to.unwrap_or(f64::INFINITY));
    ensure!(!clip.poses.is_empty(), "{}: nothing between --from and --to; the motion is shorter", args.motion.display());
    let poses = stage(args, &rig, &clip, &shape)?;
    let path: Vec<_> = poses.iter().map(|p| p.root).collect();
    let mut scene = Scene::new(Stage::around(&rig, &path), &shape);
    scene.noise_grey = args.noise;
    scene.seed = args.seed;
    write_session(&args.output, &Take { scene: &scene, rig: &rig, poses: &poses, fps: args.fps, depth_every: args.depth_every })?;
    println!(
        "{}: {} frames of {} cameras, {} frames/s, stature {:.2} m",
        args.output.display(),
        poses.len(),
        rig.cameras.len(),
        args.fps,
        shape.stature_m
    );
    Ok(())
}

/// Poses in the rig's world, where the user wants them or across the view.
fn stage(args: &RenderArgs, rig: &Rig, clip: &Clip, shape: &Shape) -> Result<Vec<Pose>> {
    let heading = args.heading.map_or_else(|| staging::crossing_heading(rig), f64::to_radians);
    if let Some(start) = args.start {
        return Ok(staging::poses_in_world(clip, shape, rig.up, start, heading));
    }
    let Some(start) = staging::cross_the_view(rig, clip, shape, heading) else {
        bail!("{}: no place within 5 m shows the whole subject to every camera; give --start and --heading", args.rig.display());
    };
    let poses = staging::poses_in_world(clip, shape, rig.up, start, heading);
    let run = staging::longest_run_in_view(rig, shape, &poses);
    if run.len() < poses.len() {
        let (from, to) = (args.from + run.start as f64 / args.fps, args.from + run.end.saturating_sub(1) as f64 / args.fps);
        eprintln!("notice: only {from:.2} s to {to:.2} s of the motion is in view of every camera; the rest is cut");
    }
    Ok(poses[run].to_vec())
}

/// Renders and writes a session folder with its truth; it appears whole or not at all.
pub fn write_session(folder: &Path, take: &Take) -> Result<()> {
    for camera in &take.rig.cameras {
        let height = camera.centre().dot(&take.rig.up.direction());
        ensure!(height > 0.0, "{}: stands {:.2} m below the floor; the floor of the rig's world must be at height 0", camera.name, -height);
    }
    let occupied = folder.exists() && folder.read_dir().map(|mut entries| entries.next().is_some()).unwrap_or(true);
    ensure!(!occupied, "{}: exists already; remove it or choose another folder with -o", folder.display());
    let partial = whole::beside(folder)?;
    write_truth(partial.path(), take)?;
    write_pictures(partial.path(), take)?;
    whole::publish(partial, folder)
}

fn write_truth(folder: &Path, take: &Take) -> Result<()> {
    calib_toml::write_rig(&folder.join("Calib.toml"), take.rig)?;
    write_atomic(&folder.join("muybridge.toml"), format!("fps = {:?}\n", take.fps).as_bytes())?;
    let frames: Vec<_> = (0..take.poses.len()).map(|i| (i, i as f64 / take.fps)).collect();
    let positions: Vec<_> = take.poses.iter().map(|pose| place(&take.scene.offsets, pose).positions).collect();
    joints_csv::write(&folder.join("truth/joints.csv"), &frames, &positions)?;
    Ok(())
}

/// Every picture of every camera, over all cores.
fn write_pictures(folder: &Path, take: &Take) -> Result<()> {
    let cameras = take.rig.cameras.iter().enumerate();
    let views: Vec<View> = cameras.map(|(i, camera)| View::new(&take.scene.stage, camera, i)).collect();
    for view in &views {
        let path = folder.join(format!("{}_background.png", view.camera.name));
        write_grey(&path, &render_stage(take.scene, view))?;
    }
    let pictures: Vec<_> = (0..take.poses.len()).flat_map(|frame| views.iter().map(move |view| (frame, view))).collect();
    let progress = progress::bar("render", pictures.len() as u64);
    pictures.par_iter().try_for_each(|(frame, view)| {
        interrupt::check()?;
        write_frame(folder, take, view, *frame)?;
        progress.inc(1);
        anyhow::Ok(())
    })?;
    progress.finish();
    Ok(())
}

fn write_frame(folder: &Path, take: &Take, view: &View, frame: usize) -> Result<()> {
    let (pose, name) = (&take.poses[frame], &view.camera.name);
    write_grey(&folder.join(name).join(format!("{frame:06}.png")), &render(take.scene, view, pose, frame))?;
    if take.depth_every.is_some_and(|n| frame.is_multiple_of(n)) {
        write_depth(&folder.join(format!("truth/depth_{name}/{frame:06}.png")), &depth(take.scene, view, pose))?;
        write_grey(&folder.join(format!("truth/mask_{name}/{frame:06}.png")), &mask(take.scene, view, pose))?;
    }
    Ok(())
}

fn write_grey(path: &Path, image: &image::GrayImage) -> Result<()> {
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, ImageFormat::Png)?;
    write_atomic(path, png.get_ref()).with_context(|| format!("cannot write {}", path.display()))
}

/// 16 bit, 0.1 mm per step, 0 = nothing or farther than 6.5535 m.
fn write_depth(path: &Path, map: &DepthMap) -> Result<()> {
    let step = |metres: &f32| if *metres < 6.5535 { (metres * 1e4).round() as u16 } else { 0 };
    let bytes: Vec<u8> = map.iter().flat_map(|d| step(d).to_ne_bytes()).collect();
    let mut png = Vec::new();
    PngEncoder::new(&mut png).write_image(&bytes, map.width(), map.height(), ColorType::L16.into())?;
    write_atomic(path, &png).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use muybridge::io::session::Session;
    use muybridge::rig::{Camera, Up};
    use nalgebra::{Matrix3, Rotation3, Vector3};

    /// Two small cameras 1 m above the floor of a y-up world, looking along -z.
    fn rig() -> Rig {
        let camera = |name: &str, x: f64| Camera {
            name: name.into(),
            size_px: [96, 72],
            matrix: Matrix3::new(80.0, 0.0, 47.5, 0.0, 80.0, 35.5, 0.0, 0.0, 1.0),
            lens: muybridge::rig::Lens::BrownConrady([-0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
            camera_from_world: Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
            translation: Vector3::new(-x, 1.0, 0.0),
        };
        Rig { cameras: vec![camera("cam_00", 0.0), camera("cam_01", 0.2)], up: Up::Y }
    }

    fn two_steps(shape: &Shape) -> Clip {
        let root = shape.offsets()[0];
        let poses = [0.0, 0.5].map(|z| Pose::rest(root + Vector3::new(0.0, 0.0, z))).to_vec();
        Clip { fps: 2.0, poses, offsets: shape.offsets(), hip_height_m: shape.hip_height_m() }
    }

    #[test]
    fn session_opens_as_footage_with_its_truth_and_is_not_overwritten() {
        let (rig, shape) = (rig(), Shape::template(1.6));
        let heading = staging::crossing_heading(&rig);
        let start = staging::cross_the_view(&rig, &two_steps(&shape), &shape, heading).unwrap();
        let poses = staging::poses_in_world(&two_steps(&shape), &shape, rig.up, start, heading);
        let scene = Scene::new(Stage::around(&rig, &[poses[0].root, poses[1].root]), &shape);
        let take = Take { scene: &scene, rig: &rig, poses: &poses, fps: 2.0, depth_every: Some(2) };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("study/walk");
        write_session(&path, &take).unwrap();

        let (session, _) = Session::open(&path, None).unwrap();
        assert_eq!((session.fps, session.frame_count, session.rig.up), (2.0, 2, Up::Y));
        let view = View::new(&scene.stage, &rig.cameras[1], 1);
        assert_eq!(session.frame(1).unwrap().images[1], render(&scene, &view, &poses[1], 1));
        assert_eq!(session.backgrounds.unwrap()[1], render_stage(&scene, &view));
        let joints = std::fs::read_to_string(path.join("truth/joints.csv")).unwrap();
        let pelvis = joints.lines().find(|l| l.starts_with("1,0.500000,pelvis,")).unwrap();
        let z: f64 = pelvis.rsplit(',').next().unwrap().parse().unwrap();
        assert!((z - poses[1].root.z).abs() < 1e-5);

        let map = image::open(path.join("truth/depth_cam_01/000000.png")).unwrap().into_luma16();
        let truth = depth(&scene, &view, &poses[0]);
        let seen = truth.iter().zip(map.iter()).filter(|(d, _)| **d < 6.5);
        assert!(seen.clone().count() > 1000);
        assert!(seen.clone().all(|(d, steps)| (d - *steps as f32 * 1e-4).abs() < 6e-5));
        assert!(!path.join("truth/depth_cam_01/000001.png").exists());

        let error = write_session(&path, &take).unwrap_err().to_string();
        assert!(error.contains("exists already"), "{error}");
        assert_eq!(path.parent().unwrap().read_dir().unwrap().count(), 1);
    }

    #[test]
    fn a_rig_below_the_floor_is_refused_before_anything_is_written() {
        let mut rig = rig();
        rig.cameras[1].translation.y = -1.0;
        let shape = Shape::template(1.6);
        let scene = Scene::new(Stage::around(&rig, &[Vector3::new(0.0, 0.9, -3.0)]), &shape);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("walk");
        let error = write_session(&path, &Take { scene: &scene, rig: &rig, poses: &[], fps: 30.0, depth_every: None }).unwrap_err();
        assert!(error.to_string().starts_with("cam_01: stands 1.00 m below the floor"), "{error}");
        assert_eq!(folder.path().read_dir().unwrap().count(), 0);
    }

    #[test]
    fn points_are_two_numbers() {
        assert_eq!(parse_point("-1.2, 3"), Ok([-1.2, 3.0]));
        assert!(["1", "1,2,3", "a,b", "1,NaN", ""].iter().all(|t| parse_point(t).is_err()));
    }
}

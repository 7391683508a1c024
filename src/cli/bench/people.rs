//! `muybridge bench clouds`: our clouds of people and OpenCV's StereoSGBM of the same rectified pairs against the truth.
//!
//! On the body: reference pixels between four pixels of the true mask. Depth error: along the camera's axis. A point is off
//! the person when its pixel in the reference camera is not in the true mask. Before cleaning: every match on a pixel whose
//! grey value changed against the stage; after: the cloud.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use image::{GrayImage, ImageBuffer, Luma, Rgb, RgbImage};
use muybridge::clouds::{CloudOptions, CloudRig, FrameCloud};
use muybridge::footage::{FrameSet, regions};
use muybridge::io::images::read_grey;
use muybridge::io::session::Session;
use muybridge::math::order::quantile;
use muybridge::rig::Rig;
use muybridge::rig::rectify::{Plane, Rectification};
use nalgebra::{Point2, Vector2, Vector3};
use opencv::{calib3d, core::Mat, prelude::*};

use super::super::interrupt;

#[derive(clap::Args)]
pub struct PeopleArgs {
    /// Session folders with truth/depth_CAM and truth/mask_CAM of the reference camera, as `muybridge render --depth-every` writes them
    #[arg(required = true)]
    sessions: Vec<PathBuf>,
    /// Folder for pictures of the disparity errors of every frame and method
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// True depth of a raw pixel is in steps of this, metres; 0 is nothing.
const DEPTH_STEP_M: f64 = 1e-4;
/// Farther than this from the true mask is no matter of the outline, px.
const FAR_PX: u32 = 3;

type DepthSteps = ImageBuffer<Luma<u16>, Vec<u16>>;

pub fn run(args: &PeopleArgs) -> Result<()> {
    println!("depth errors on the body's pixels; share of points off the person (far: more than {FAR_PX} px) before and after cleaning;");
    println!("common: median mm and >1px share of the method and of all views, on the pixels that both have;");
    println!("z: variance of depth error / sigma within 3 sigma, {} threads, OpenCV 1", rayon::current_num_threads());
    println!(
        "{:<22}{:<18}{:>8}{:>9}{:>8}{:>9}{:>8}{:>9}{:>7}{:>7}{:>6}{:>7}{:>8}{:>12}{:>12}",
        "session",
        "method",
        "med mm",
        "density",
        ">1px",
        "kept",
        ">1px",
        "off bef",
        "aft",
        "far",
        "z",
        "IoU",
        "ms",
        "common: it",
        "all views"
    );
    args.sessions.iter().try_for_each(|folder| bench(folder, args.pictures.as_deref()).with_context(|| folder.display().to_string()))
}

/// What is known of one frame of the reference camera.
struct Truth {
    mask: GrayImage,
    depth: Option<DepthSteps>,
}

/// Sums over frames.
#[derive(Default)]
struct Score {
    errors_m: Vec<f64>,
    body: usize,
    matched: usize,
    matched_off: usize,
    kept: usize,
    kept_off: usize,
    before: [usize; 2],
    after: [usize; 3],
    normalised: Vec<f64>,
    both: usize,
    either: usize,
    seconds: Vec<f64>,
    /// Errors in metres and px of this method and of all views together, where both have a disparity.
    common: Vec<[[f64; 2]; 2]>,
}

fn bench(folder: &Path, pictures: Option<&Path>) -> Result<()> {
    let (session, _) = Session::open(folder, None)?;
    let options = CloudOptions::default();
    let stages = session.stages()?;
    let full = CloudRig::new(&session.rig, Some(&stages), &options)?;
    let (group, _) = full.groups.first().context("the rig has no group")?;
    let order: Vec<usize> = group.views.iter().map(|v| v.index).collect();
    let truths = truths(&session, order[0])?;
    let frames: Vec<FrameSet> =
        session.frames().filter(|f| f.as_ref().map_or(true, |f| truths[f.number].is_some())).collect::<Result<_, _>>()?;
    let mut subsets = if order.len() > 2 { vec![order.clone()] } else { Vec::new() };
    subsets.extend(order[1..].iter().map(|&other| vec![order[0], other]));
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let mut together: Vec<FrameCloud> = Vec::new();
    let mut off: Vec<f64> = Vec::new();
    for cameras in subsets {
        let rig = Rig { cameras: cameras.iter().map(|&k| session.rig.cameras[k].clone()).collect(), up: session.rig.up };
        let stage: Vec<GrayImage> = cameras.iter().map(|&k| stages[k].clone()).collect();
        let ready = CloudRig::new(&rig, Some(&stage), &options)?;
        let label = cameras.iter().map(|&k| session.rig.cameras[k].name.trim_start_matches("cam_")).collect::<Vec<_>>().join("-");
        let (mut ours, mut sgbm) = (Score::default(), Score::default());
        for (i, frame) in frames.iter().enumerate() {
            interrupt::check()?;
            let Some(truth) = &truths[frame.number] else { continue };
            let images: Vec<GrayImage> = cameras.iter().map(|&k| frame.images[k].clone()).collect();
            let begun = Instant::now();
            let found = ready.frame(&images, &options)?;
            ours.seconds.push(begun.elapsed().as_secs_f64());
            let full = together.get(i).map(|all| (group, &all.matched));
            ours.add(&ready.groups[0].0, truth, &found.matched, &found, full);
            ours.add_cloud(&ready.groups[0].0, truth, &found);
            if let (Some(pictures), true) = (pictures, truth.depth.is_some()) {
                let path = pictures.join(format!("{name}_{label}_{:06}.png", frame.number));
                let picture = error_picture(&ready.groups[0].0, truth, &images[0], &found);
                picture.save(&path).with_context(|| format!("cannot write {}", path.display()))?;
            }
            if cameras.len() == 2 {
                let begun = Instant::now();
                let theirs = semi_global(&ready.groups[0].0, &images, options.nearest_m)?;
                sgbm.seconds.push(begun.elapsed().as_secs_f64());
                sgbm.add(&ready.groups[0].0, truth, &theirs, &found, full);
            } else {
                together.push(found);
            }
        }
        println!("{}", ours.row(&name, &format!("ours {label}")));
        off.push(ours.kept_off as f64 / ours.kept.max(1) as f64);
        if cameras.len() == 2 {
            println!("{}", sgbm.row(&name, &format!("StereoSGBM {label}")));
        }
    }
    if let [all, pairs @ ..] = &off[..]
        && order.len() > 2
    {
        let pairs = pairs.iter().sum::<f64>() / pairs.len() as f64;
        println!("{name:<22}points kept off by more than 1 px: all views / mean of the pairs {:.2}", all / pairs);
    }
    Ok(())
}

/// By frame number; `None` where there is no true mask.
fn truths(session: &Session, camera: usize) -> Result<Vec<Option<Truth>>> {
    let name = &session.rig.cameras[camera].name;
    let last = session.frame_numbers.last().copied().unwrap_or(0);
    let read = |number: usize| {
        let path = |what: &str| session.folder.join(format!("truth/{what}_{name}/{number:06}.png"));
        if !path("mask").exists() {
            return Ok(None);
        }
        let open = |path: PathBuf| image::open(&path).map(|i| i.into_luma16()).with_context(|| format!("cannot read {}", path.display()));
        let depth = path("depth").exists().then(|| open(path("depth"))).transpose()?;
        Ok(Some(Truth { mask: read_grey(&path("mask"))?, depth }))
    };
    let truths: Vec<Option<Truth>> = (0..=last).map(read).collect::<Result<_>>()?;
    let any = truths.iter().flatten().any(|t| t.depth.is_some());
    ensure!(any, "no truth/mask_{name} with truth/depth_{name}; `muybridge render --depth-every N` makes footage with its truth");
    Ok(truths)
}

impl Truth {
    fn on_person(&self, raw: &Point2<f64>) -> bool {
        let (x, y) = (raw.x.round(), raw.y.round());
        let inside = x >= 0.0 && y >= 0.0 && x < f64::from(self.mask.width()) && y < f64::from(self.mask.height());
        inside && self.mask.get_pixel(x as u32, y as u32).0[0] > 127
    }

    /// World point that a raw pixel of the camera shows, if it lies between four pixels of the person.
    fn body_point(&self, group: &Rectification, raw: &Point2<f64>) -> Option<Vector3<f64>> {
        let depth = self.depth.as_ref()?;
        let (x, y) = (raw.x.floor(), raw.y.floor());
        if x < 0.0 || y < 0.0 || x + 1.0 >= f64::from(depth.width()) || y + 1.0 >= f64::from(depth.height()) {
            return None;
        }
        let (mut z, wx, wy) = (0.0, raw.x - x, raw.y - y);
        for (dx, dy, weight) in [(0, 0, (1.0 - wx) * (1.0 - wy)), (1, 0, wx * (1.0 - wy)), (0, 1, (1.0 - wx) * wy), (1, 1, wx * wy)] {
            let (x, y) = (x as u32 + dx, y as u32 + dy);
            if self.mask.get_pixel(x, y).0[0] <= 127 || depth.get_pixel(x, y).0[0] == 0 {
                return None;
            }
            z += weight * f64::from(depth.get_pixel(x, y).0[0]) * DEPTH_STEP_M;
        }
        let camera = &group.views[0].camera;
        let ray = camera.ray(raw)?;
        Some(camera.centre() + ray * (z / (camera.camera_from_world * ray).z))
    }
}

/// Disparity of a world point in the reference view.
fn disparity_of(group: &Rectification, x: &Vector3<f64>) -> Option<f64> {
    let step = group.views[1].step;
    Some((group.project(1, x)? - group.project(0, x)?).dot(&step) / step.norm_squared())
}

/// Errors in metres and px of a plane of disparities at a raw pixel that shows `x`.
fn errors_at(group: &Rectification, plane: &Plane, raw: &Point2<f64>, x: &Vector3<f64>) -> Option<[f64; 2]> {
    let at = group.rectified_pixel(0, raw)?.map(f64::round);
    let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < f64::from(plane.width()) && at.y < f64::from(plane.height());
    let d = if inside { f64::from(plane.get_pixel(at.x as u32, at.y as u32).0[0]) } else { f64::NAN };
    let estimate = group.world_from_pixel(at.x, at.y, d);
    let camera = &group.views[0].camera;
    let error_m = (camera.camera_point(&estimate).z - camera.camera_point(x).z).abs();
    (d > 0.0).then_some([error_m, (d - disparity_of(group, x)?).abs()])
}

impl Score {
    /// Disparities of the whole reference view, and what cleaning left of ours.
    fn add(&mut self, group: &Rectification, truth: &Truth, matched: &Plane, found: &FrameCloud, all: Option<(&Rectification, &Plane)>) {
        let camera = &group.views[0].camera;
        for (u, v, d) in matched.enumerate_pixels() {
            let at = Vector2::new(f64::from(u), f64::from(v));
            let Some(raw) = group.raw_pixel(0, &at) else { continue };
            if d.0[0] > 0.0 && found.changed.get_pixel(u, v).0[0] > 0 {
                self.before[0] += 1;
                self.before[1] += usize::from(!truth.on_person(&raw));
            }
            let Some(x) = truth.body_point(group, &raw) else { continue };
            let Some(expected) = disparity_of(group, &x) else { continue };
            self.body += 1;
            let off = |d: f32| (f64::from(d) - expected).abs() > 1.0;
            if d.0[0] > 0.0 {
                let estimate = group.world_from_pixel(at.x, at.y, d.0[0].into());
                let error_m = (camera.camera_point(&estimate).z - camera.camera_point(&x).z).abs();
                self.errors_m.push(error_m);
                self.matched += 1;
                self.matched_off += usize::from(off(d.0[0]));
                let mine = [error_m, (f64::from(d.0[0]) - expected).abs()];
                self.common.extend(all.and_then(|(full, plane)| Some([mine, errors_at(full, plane, &raw, &x)?])));
            }
            let kept = found.disparity.get_pixel(u, v).0[0];
            self.kept += usize::from(kept > 0.0);
            self.kept_off += usize::from(kept > 0.0 && off(kept));
        }
    }

    fn add_cloud(&mut self, group: &Rectification, truth: &Truth, found: &FrameCloud) {
        let view = &group.views[0];
        let near = regions::dilate(&truth.mask, FAR_PX);
        let near = Truth { mask: near, depth: None };
        let axis = view.camera.camera_from_world.inverse() * Vector3::z();
        for point in &found.cloud.points {
            let Some(raw) = view.camera.project(&point.position) else { continue };
            self.after[0] += 1;
            self.after[1] += usize::from(!truth.on_person(&raw));
            self.after[2] += usize::from(!near.on_person(&raw));
            if let Some(x) = truth.body_point(group, &raw) {
                self.normalised.push(axis.dot(&(point.position - x)) / axis.dot(&(point.covariance * axis)).sqrt());
            }
        }
        if let Some(mask) = &found.masks[view.index] {
            let pairs = || mask.iter().zip(truth.mask.iter()).map(|(a, b)| (*a > 127, *b > 127));
            self.both += pairs().filter(|(a, b)| *a && *b).count();
            self.either += pairs().filter(|(a, b)| *a || *b).count();
        }
    }

    fn row(&self, session: &str, method: &str) -> String {
        let percent =
            |part: usize, whole: usize| if whole == 0 { "-".into() } else { format!("{:.2}", 100.0 * part as f64 / whole as f64) };
        let median = |values: &[f64]| quantile(values.to_vec(), 0.5).unwrap_or(f64::NAN);
        let common = |k: usize| -> String {
            if self.common.is_empty() {
                return "-".into();
            }
            let errors_m: Vec<f64> = self.common.iter().map(|c| c[k][0]).collect();
            let off = self.common.iter().filter(|c| c[k][1] > 1.0).count();
            format!("{:.2} {}", 1e3 * median(&errors_m), percent(off, self.common.len()))
        };
        let within: Vec<f64> = self.normalised.iter().copied().filter(|z| z.abs() < 3.0).collect();
        let variance = within.iter().map(|z| z * z).sum::<f64>() / within.len() as f64;
        format!(
            "{session:<22}{method:<18}{:>8.2}{:>9}{:>8}{:>9}{:>8}{:>9}{:>7}{:>7}{:>6}{:>7}{:>8.1}{:>12}{:>12}",
            1e3 * median(&self.errors_m),
            percent(self.matched, self.body),
            percent(self.matched_off, self.matched),
            percent(if self.either > 0 { self.kept } else { 0 }, if self.either > 0 { self.body } else { 0 }),
            percent(self.kept_off, if self.either > 0 { self.kept } else { 0 }),
            percent(self.before[1], self.before[0]),
            percent(self.after[1], self.after[0]),
            percent(self.after[2], self.after[0]),
            if within.is_empty() { "-".into() } else { format!("{variance:.2}") },
            if self.either > 0 { format!("{:.3}", self.both as f64 / self.either as f64) } else { "-".into() },
            1e3 * median(&self.seconds),
            common(0),
            common(1)
        )
    }
}

/// The searched part of the reference view: disparity errors from -2 px (blue) to 2 px (red) on the body, white without a
/// disparity; magenta: cloud points off the person; grey: everything else.
fn error_picture(group: &Rectification, truth: &Truth, reference: &GrayImage, found: &FrameCloud) -> RgbImage {
    let plane = group.warp(0, reference);
    let colour = |u: u32, v: u32| {
        let grey = plane.get_pixel(u, v).0[0].clamp(0.0, 255.0) as u8;
        let at = Vector2::new(f64::from(u), f64::from(v));
        let Some(raw) = group.raw_pixel(0, &at) else { return Rgb([grey; 3]) };
        let (d, kept) = (found.matched.get_pixel(u, v).0[0], found.disparity.get_pixel(u, v).0[0]);
        let expected = truth.body_point(group, &raw).and_then(|x| disparity_of(group, &x));
        let Some(expected) = expected else {
            return if kept > 0.0 && !truth.on_person(&raw) { Rgb([255, 0, 255]) } else { Rgb([grey; 3]) };
        };
        if d.is_nan() {
            return Rgb([255; 3]);
        }
        let error = ((f64::from(d) - expected) / 2.0).clamp(-1.0, 1.0);
        let strength = (255.0 * error.abs().sqrt()) as u8;
        let rest = grey / 2;
        if error > 0.0 { Rgb([rest.saturating_add(strength), rest, rest]) } else { Rgb([rest, rest, rest.saturating_add(strength)]) }
    };
    RgbImage::from_fn(group.size_px[0], group.size_px[1], colour)
}

/// OpenCV's disparities of a rectified pair in the reference view, NaN where it has none.
fn semi_global(group: &Rectification, images: &[GrayImage], nearest_m: f64) -> Result<Plane> {
    let planes: Vec<Plane> = (0..2).map(|k| group.warp(k, &images[group.views[k].index])).collect();
    let step = group.views[1].step;
    // The matcher wants the other view's content to the left: rows along the baseline, mirrored where it points right.
    let upright = step.x.abs() > step.y.abs();
    let mirrored = step.x + step.y > 0.0;
    let [width, height] = group.size_px.map(|s| s as i32);
    let [across, down] = if upright { [width, height] } else { [height, width] };
    let place = |x: i32, y: i32| {
        let x = if mirrored { across - 1 - x } else { x };
        if upright { (x as u32, y as u32) } else { (y as u32, x as u32) }
    };
    let mat = |plane: &Plane| -> Result<Mat> {
        let value = |i: i32| {
            let (x, y) = place(i % across, i / across);
            plane.get_pixel(x, y).0[0].max(0.0).round().min(255.0) as u8
        };
        let values: Vec<u8> = (0..across * down).map(value).collect();
        Ok(Mat::new_rows_cols_with_data(down, across, &values)?.try_clone()?)
    };
    let disparities = (group.disparity(nearest_m).ceil() as i32 / 16 + 1) * 16;
    let mut matcher = calib3d::StereoSGBM::create(0, disparities, 5, 200, 800, 1, 0, 10, 100, 2, calib3d::StereoSGBM_MODE_SGBM)?;
    let mut found = Mat::default();
    matcher.compute(&mat(&planes[0])?, &mat(&planes[1])?, &mut found)?;
    let found = found.data_typed::<i16>()?;
    let mut plane = Plane::from_pixel(width as u32, height as u32, Luma([f32::NAN]));
    for (i, d) in found.iter().enumerate().filter(|(_, d)| **d > 0) {
        let (x, y) = place(i as i32 % across, i as i32 / across);
        plane.put_pixel(x, y, Luma([f32::from(*d) / 16.0]));
    }
    Ok(plane)
}

//! `muybridge bench stereo`: the matcher against OpenCV's StereoBM and StereoSGBM, in accuracy on Middlebury's scenes and in
//! time on rendered textures, all in one process.
//!
//! Times are the fastest of several rounds in which all contestants take turns, so that another load on the machine hits all.

use super::super::interrupt;
use anyhow::{Context, Result, ensure};
use muybridge::clouds::stereo::{StereoOptions, StereoView, disparity_map};
use muybridge::rig::rectify::Plane;
use nalgebra::{Matrix2, Vector2};
use opencv::calib3d::{StereoBM, StereoSGBM, StereoSGBM_MODE_SGBM, StereoSGBM_MODE_SGBM_3WAY};
use opencv::core::{Mat, transpose};
use opencv::imgcodecs::{IMREAD_GRAYSCALE, IMREAD_UNCHANGED, imread};
use opencv::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(clap::Args)]
pub struct StereoArgs {
    /// Folder with Middlebury scenes: view1.png, view5.png, disp1.png, disp5.png or im2.png, im6.png, disp2, disp6 each
    folder: PathBuf,
    /// Rounds of each time measurement
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u16).range(1..))]
    rounds: u16,
}

pub fn run(args: &StereoArgs) -> Result<()> {
    let scenes = scenes(&args.folder)?;
    ensure!(!scenes.is_empty(), "{}: no stereo scene below; give the folder that holds Middlebury's", args.folder.display());
    let short = accuracy(&scenes)?;
    println!();
    times(args.rounds.into())?;
    println!("\n{short} accuracy comparisons fall short");
    Ok(())
}

/// One rectified pair or triple with its truth.
struct Scene {
    name: String,
    left: PathBuf,
    right: PathBuf,
    /// A third view at twice the baseline.
    third: Option<PathBuf>,
    /// The left view's disparities and, if known, the right's (else what is hidden follows from the left's); pixels are
    /// value / scale.
    truth: [Option<PathBuf>; 2],
    scale: f32,
}

/// Divisors of the disparity pictures, by Middlebury's year and size: full, half and third size hold 1, 2 and 3 steps per
/// pixel, the quarter-size sets of 2003 four and those of 2001 eight.
const SCALES: [(&str, f32); 6] =
    [("middlebury-2005", 3.0), ("middlebury-2006", 2.0), ("teddy", 4.0), ("cones", 4.0), ("middlebury-2view", 8.0), ("aloe", 1.0)];

fn scenes(folder: &Path) -> Result<Vec<Scene>> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(folder) = open.pop() {
        let entries = std::fs::read_dir(&folder).with_context(|| format!("cannot read {}", folder.display()))?;
        let mut paths: Vec<PathBuf> = entries.map(|e| Ok(e?.path())).collect::<Result<_>>()?;
        paths.sort();
        open.extend(paths.into_iter().rev().filter(|p| p.is_dir()));
        let file = |name: &str| Some(folder.join(name)).filter(|p| p.exists());
        let either = |stem: &str| file(&format!("{stem}.png")).or_else(|| file(&format!("{stem}.pgm")));
        let layouts = [
            [file("view1.png"), file("view5.png"), file("disp1.png"), file("disp5.png")],
            [file("im2.png"), file("im6.png"), either("disp2"), either("disp6")],
            [file("aloeL.jpg"), file("aloeR.jpg"), file("aloeGT.png"), None],
        ];
        for [left, right, truth, other] in layouts {
            let (Some(left), Some(right), Some(truth)) = (left, right, truth) else { continue };
            let path = folder.to_string_lossy().into_owned();
            let Some((_, scale)) = SCALES.iter().find(|(part, _)| path.contains(part)) else { continue };
            let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if let Some(middle) = file("im4.png") {
                let third = Some(right.clone());
                found.push(Scene {
                    name: name.clone(),
                    left: left.clone(),
                    right: middle,
                    third,
                    truth: [Some(truth.clone()), None],
                    scale: 2.0 * scale,
                });
            }
            found.push(Scene { name, left, right, third: None, truth: [Some(truth), other], scale: *scale });
        }
    }
    found.sort_by(|a, b| (a.third.is_some(), &a.name).cmp(&(b.third.is_some(), &b.name)));
    Ok(found)
}

/// 8-bit picture as rows of numbers.
struct Grey {
    mat: Mat,
    width: usize,
}

impl Grey {
    fn read(path: &Path, flags: i32) -> Result<Self> {
        let mat = imread(path, flags)?;
        ensure!(!mat.empty() && mat.depth() == 0, "{}: is no 8-bit picture", path.display());
        Ok(Self { width: mat.cols() as usize, mat })
    }

    /// Values of the first channel.
    fn values(&self) -> Result<Vec<f32>> {
        let channels = self.mat.channels() as usize;
        Ok(self.mat.data_bytes()?.iter().step_by(channels).map(|v| f32::from(*v)).collect())
    }

    fn plane(&self) -> Result<Plane> {
        Plane::from_raw(self.width as u32, self.mat.rows() as u32, self.values()?).context("a picture with gaps between its rows")
    }
}

/// Share of the truth's pixels with a disparity, share of those wrong by more than 1 px, and their mean error, px.
struct Score {
    density: f64,
    bad: f64,
    mean_px: f64,
}

fn score(found: &[f32], truth: &[f32], counts: &[bool]) -> Score {
    let errors = || (0..truth.len()).filter(|&i| counts[i] && found[i] > 0.0).map(|i| f64::from((found[i] - truth[i]).abs()));
    let matched = errors().count().max(1) as f64;
    Score {
        density: errors().count() as f64 / counts.iter().filter(|c| **c).count().max(1) as f64,
        bad: errors().filter(|e| *e > 1.0).count() as f64 / matched,
        mean_px: errors().sum::<f64>() / matched,
    }
}

/// Pixels whose truth the right view shares, and which lie in it.
fn visible(truth: &[f32], right: &[f32], width: usize) -> Vec<bool> {
    let shared = |i: usize| {
        let x = ((i % width) as f32 - truth[i]).round();
        x >= 0.0 && (right[i / width * width + x as usize] - truth[i]).abs() <= 1.0
    };
    (0..truth.len()).map(|i| truth[i] > 0.0 && shared(i)).collect()
}

/// Disparities that the right view has where the left's truth leads, the nearest wherever several pixels meet; 0 where none.
fn seen_from_right(truth: &[f32], width: usize) -> Vec<f32> {
    let mut right = vec![0.0f32; truth.len()];
    for (truth, right) in truth.chunks_exact(width).zip(right.chunks_exact_mut(width)) {
        for (x, &d) in truth.iter().enumerate().filter(|(_, d)| **d > 0.0) {
            let place = x as f32 - d;
            // A surface seen more slantwise from the left leaves gaps: both neighbours of its place are covered.
            for place in [place.floor(), place.ceil()].into_iter().filter(|p| *p >= 0.0) {
                right[place as usize] = right[place as usize].max(d);
            }
        }
    }
    right
}

/// Prints the table; how many comparisons fall short.
fn accuracy(scenes: &[Scene]) -> Result<usize> {
    println!("share of visible pixels matched, share of those off by more than 1 px, mean error in px;");
    println!("common: share off by more than 1 px on the pixels that StereoBM matched too");
    println!("{:<20}{:>22}{:>22}{:>22}{:>18}", "scene", "ours", "StereoBM", "StereoSGBM", "common ours/BM");
    let mut short = 0;
    for scene in scenes {
        interrupt::check()?;
        let [left, right] = [&scene.left, &scene.right].map(|p| Grey::read(p, IMREAD_GRAYSCALE));
        let (left, right) = (left?, right?);
        let known = |path: &Option<PathBuf>| -> Result<Option<Vec<f32>>> {
            let Some(path) = path else { return Ok(None) };
            Ok(Some(Grey::read(path, IMREAD_UNCHANGED)?.values()?.iter().map(|v| v / scene.scale).collect()))
        };
        let truth = known(&scene.truth[0])?.unwrap_or_default();
        ensure!(
            truth.len() == left.width * left.mat.rows() as usize,
            "{}: the truth has another size than the views",
            scene.left.display()
        );
        let right_truth = known(&scene.truth[1])?.unwrap_or_else(|| seen_from_right(&truth, left.width));
        let counts = visible(&truth, &right_truth, left.width);
        let disparities = (truth.iter().copied().fold(0.0, f32::max) as usize / 16 + 1) * 16;
        let views = [view(left.plane()?, [0.0, 0.0]), view(right.plane()?, [-1.0, 0.0])];
        let two = ours(&views, disparities);
        let semi_global = score(&opencv_sgbm(disparities, StereoSGBM_MODE_SGBM)?.run(&left.mat, &right.mat)?, &truth, &counts);
        let block = opencv_bm(disparities)?.run(&left.mat, &right.mat)?;
        let cells = |s: &Score| format!("{:>9.3} {:>6.2} % {:>5.3}", s.density, 100.0 * s.bad, s.mean_px);
        if let Some(third) = &scene.third {
            let [first, second] = views;
            let three = score(
                &ours(&[first, second, view(Grey::read(third, IMREAD_GRAYSCALE)?.plane()?, [-2.0, 0.0])], disparities),
                &truth,
                &counts,
            );
            let (two, block) = (score(&two, &truth, &counts), score(&block, &truth, &counts));
            println!("{:<20}{}{}{}", format!("{}, 3 views", scene.name), cells(&three), cells(&block), cells(&semi_global));
            println!("{:<20}{}   three / two views in mean error: {:.2}", "  two of them", cells(&two), three.mean_px / two.mean_px);
            short += usize::from(
                three.mean_px > semi_global.mean_px || three.mean_px > 0.7 * two.mean_px || three.density < 0.95 * semi_global.density,
            );
            continue;
        }
        let both: Vec<bool> = (0..truth.len()).map(|i| counts[i] && two[i] > 0.0 && block[i] > 0.0).collect();
        let common = [&two, &block].map(|d| score(d, &truth, &both).bad);
        let (two, block) = (score(&two, &truth, &counts), score(&block, &truth, &counts));
        let last = format!("{:.2} % {:.2} %", 100.0 * common[0], 100.0 * common[1]);
        println!("{:<20}{}{}{}{:>18}", scene.name, cells(&two), cells(&block), cells(&semi_global), last);
        short += usize::from(two.density < block.density || common[0] > common[1]);
    }
    Ok(short)
}

fn view(plane: Plane, step: [f64; 2]) -> StereoView {
    StereoView { plane, step: step.into() }
}

/// Our disparities of the first view, 0 where there is none.
fn ours(views: &[StereoView], disparities: usize) -> Vec<f32> {
    let found = disparity_map(views, [0, disparities - 1], &StereoOptions::default());
    found.iter().map(|d| if d.is_nan() { 0.0 } else { *d }).collect()
}

/// OpenCV's matchers, with the same checks.
enum Peer {
    Bm(opencv::core::Ptr<StereoBM>),
    Sgbm(opencv::core::Ptr<StereoSGBM>),
}

fn opencv_bm(disparities: usize) -> Result<Peer> {
    let mut bm = StereoBM::create(disparities as i32, 15)?;
    bm.set_uniqueness_ratio(10)?;
    bm.set_disp12_max_diff(1)?;
    bm.set_speckle_window_size(100)?;
    bm.set_speckle_range(2)?;
    Ok(Peer::Bm(bm))
}

fn opencv_sgbm(disparities: usize, mode: i32) -> Result<Peer> {
    Ok(Peer::Sgbm(StereoSGBM::create(0, disparities as i32, 5, 200, 800, 1, 0, 10, 100, 2, mode)?))
}

impl Peer {
    fn compute(&mut self, left: &Mat, right: &Mat) -> Result<Mat> {
        let mut found = Mat::default();
        match self {
            Peer::Bm(bm) => bm.compute(left, right, &mut found)?,
            Peer::Sgbm(sgbm) => sgbm.compute(left, right, &mut found)?,
        }
        Ok(found)
    }

    fn run(&mut self, left: &Mat, right: &Mat) -> Result<Vec<f32>> {
        Ok(self.compute(left, right)?.data_typed::<i16>()?.iter().map(|d| f32::from(*d).max(0.0) / 16.0).collect())
    }
}

/// A triple of views in an L and in a row, of a box before a wall, rendered from a band-limited texture.
struct Triple {
    reference: Plane,
    right: Plane,
    upper: Plane,
    further: Plane,
}

impl Triple {
    fn new(width: u32, height: u32) -> Self {
        let texture = |x: f64, y: f64| {
            let wave = |a: f64, b: f64, c: f64| (a * x + b * y + c).sin();
            let fine =
                wave(0.9, 0.31, 0.3) + wave(-0.43, 0.83, 1.1) + wave(1.37, -0.71, 2.0) + wave(0.23, 1.19, 0.7) + wave(0.61, 0.57, 1.9);
            128.0 + 18.0 * fine + 20.0 * wave(0.171, 0.093, 0.0) * wave(0.077, -0.139, 2.0)
        };
        let (w, h) = (f64::from(width), f64::from(height));
        let draw = |step: [f64; 2]| {
            Plane::from_fn(width, height, |x, y| {
                let (x, y) = (f64::from(x), f64::from(y));
                let at = |d: f64| (x - step[0] * d, y - step[1] * d);
                let ((u, v), (wall_u, wall_v)) = (at(24.0), at(14.0));
                let inside = (u / w - 0.5).abs() < 0.2 && (v / h - 0.5).abs() < 0.35;
                image::Luma([(if inside { texture(u + 500.0, v) } else { texture(wall_u, wall_v) }).round() as f32])
            })
        };
        Self { reference: draw([0.0, 0.0]), right: draw([-1.0, 0.0]), upper: draw([0.0, 1.0]), further: draw([-2.0, 0.0]) }
    }

    fn l_shape(&self) -> [StereoView; 3] {
        [view(self.reference.clone(), [0.0, 0.0]), view(self.right.clone(), [-1.0, 0.0]), view(self.upper.clone(), [0.0, 1.0])]
    }

    fn row(&self) -> [StereoView; 3] {
        [view(self.reference.clone(), [0.0, 0.0]), view(self.right.clone(), [-1.0, 0.0]), view(self.further.clone(), [-2.0, 0.0])]
    }
}

fn mat(plane: &Plane) -> Result<Mat> {
    let values: Vec<u8> = plane.iter().map(|v| *v as u8).collect();
    Ok(Mat::new_rows_cols_with_data(plane.height() as i32, plane.width() as i32, &values)?.try_clone()?)
}

fn transposed(plane: &Plane) -> Result<Mat> {
    let mut out = Mat::default();
    transpose(&mat(plane)?, &mut out)?;
    Ok(out)
}

/// Fastest of some rounds of each contestant, ms; they take turns.
fn fastest<const N: usize>(rounds: usize, mut contestants: [&mut dyn FnMut() -> Result<()>; N]) -> Result<[f64; N]> {
    let mut best = [f64::INFINITY; N];
    for _ in 0..rounds {
        interrupt::check()?;
        for (contestant, best) in contestants.iter_mut().zip(&mut best) {
            let begun = Instant::now();
            contestant()?;
            *best = best.min(1e3 * begun.elapsed().as_secs_f64());
        }
    }
    Ok(best)
}

fn matched(views: &[StereoView], disparities: usize, radius: usize) -> Result<()> {
    std::hint::black_box(disparity_map(views, [0, disparities - 1], &StereoOptions { radius, ..StereoOptions::default() }));
    Ok(())
}

fn times(rounds: usize) -> Result<()> {
    let pool = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let (one, two) = (pool(1)?, pool(2)?);
    let radius = StereoOptions::default().radius;
    let triple = Triple::new(640, 480);
    let (l_shape, row) = (triple.l_shape(), triple.row());
    let (left, right) = (mat(&triple.reference)?, mat(&triple.right)?);
    // The other arm of the L turned on its side, mirrored so that content moves left.
    let (upright, upper) = (transposed(&triple.upper)?, transposed(&triple.reference)?);
    let (mut bm, mut sgbm) = (opencv_bm(64)?, opencv_sgbm(64, StereoSGBM_MODE_SGBM_3WAY)?);
    let best = fastest(
        rounds,
        [
            &mut || one.install(|| matched(&l_shape, 64, radius)),
            &mut || two.install(|| matched(&l_shape, 64, radius)),
            &mut || one.install(|| matched(&row, 64, radius)),
            &mut || one.install(|| matched(&l_shape[..2], 64, radius)),
            &mut || {
                bm.compute(&left, &right)?;
                bm.compute(&upright, &upper).map(|_| ())
            },
            &mut || sgbm.compute(&left, &right).map(|_| ()),
        ],
    )?;
    let [three, on_two, in_row, pair, two_bm, semi_global] = best;
    println!("640x480, 64 disparities, one thread, ms of the fastest of {rounds} rounds");
    println!("{:<44}{three:>8.1}", "ours, three views in an L");
    println!("{:<44}{on_two:>8.1}   {:.2} times as fast", "ours, three views in an L, two threads", three / on_two);
    println!("{:<44}{in_row:>8.1}   half-pixel disparities", "ours, three views in a row");
    println!("{:<44}{pair:>8.1}", "ours, two views");
    println!("{:<44}{two_bm:>8.1}   ours takes {:.2} of it", "OpenCV, two StereoBM maps", three / two_bm);
    println!("{:<44}{semi_global:>8.1}   ours takes {:.2} of it", "OpenCV, one StereoSGBM map (3WAY)", three / semi_global);
    println!();
    growth(rounds.div_ceil(3), &one)
}

/// How the time of three views in an L grows with pixels, disparities and windows.
fn growth(rounds: usize, one: &rayon::ThreadPool) -> Result<()> {
    println!("ours, three views in an L, one thread{:>15}{:>14}", "ms", "ns per pixel");
    let row = |width: u32, height: u32, disparities: usize, radius: usize| -> Result<f64> {
        let views = Triple::new(width, height).l_shape();
        let [ms] = fastest(rounds, [&mut || one.install(|| matched(&views, disparities, radius))])?;
        let per_pixel_ns = 1e6 * ms / f64::from(width * height);
        let title = format!("{width}x{height}, {disparities} disparities, window {}", 2 * radius + 1);
        println!("{title:<44}{ms:>8.1}{per_pixel_ns:>14.1}");
        Ok(per_pixel_ns)
    };
    for (width, height) in [(320, 240), (640, 480), (1280, 960)] {
        row(width, height, 64, 2)?;
    }
    let by_disparities: Vec<[f64; 2]> =
        [32, 64, 128, 256].into_iter().map(|d| Ok([d as f64, row(640, 480, d, 2)?])).collect::<Result<_>>()?;
    let by_window: Vec<f64> = [1, 2, 3, 5, 7].into_iter().map(|radius| row(640, 480, 64, radius)).collect::<Result<_>>()?;
    let (fixed, each) = line(&by_disparities);
    let off = by_disparities.iter().map(|[d, t]| (fixed + each * d - t).abs() / t).fold(0.0, f64::max);
    println!("per pixel {fixed:.1} ns and {each:.3} ns per disparity, within {:.0} % of each of the four", 100.0 * off);
    let slowest = by_window.iter().copied().fold(0.0, f64::max);
    let quickest = by_window.iter().copied().fold(f64::INFINITY, f64::min);
    println!("from window 3 to 15 within {:.0} %", 100.0 * (slowest / quickest - 1.0));
    Ok(())
}

/// Offset and slope of the line through (x, y) with the least squared errors relative to y.
fn line(points: &[[f64; 2]]) -> (f64, f64) {
    let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
    for [x, y] in points {
        let row = Vector2::new(1.0, *x) / *y;
        normal += row * row.transpose();
        right += row;
    }
    let solution = normal.try_inverse().map_or(right, |inverse| inverse * right);
    (solution.x, solution.y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_near_surface_hides_from_the_right_view_does_not_count() {
        // A near strip of disparity 5 at 10..14 before a wall of 2: the right view has it at 5..9, so the wall's 7 to 9 are hidden
        // behind it (seen at 5 to 7) with nothing between, and 0 and 1 leave the picture.
        let truth: Vec<f32> = (0..20).map(|x| if (10..14).contains(&x) { 5.0 } else { 2.0 }).collect();
        let counts = visible(&truth, &seen_from_right(&truth, 20), 20);
        let hidden: Vec<usize> = (0..20).filter(|x| !counts[*x]).collect();
        assert_eq!(hidden, [0, 1, 7, 8, 9]);
    }

    #[test]
    fn a_line_is_found_again() {
        let (offset, slope) = line(&[32.0, 64.0, 128.0, 256.0].map(|x| [x, 15.0 + 0.25 * x]));
        assert!((offset - 15.0).abs() < 1e-9 && (slope - 0.25).abs() < 1e-9);
    }
}

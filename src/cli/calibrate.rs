//! `muybridge calibrate`: a rig from views of a board.

use super::board::BoardOptions;
use super::{interrupt, progress};
use anyhow::{Context, Result, bail, ensure};
use image::GrayImage;
use muybridge::footage::board::{Board, BoardError};
use muybridge::io::calib_toml::write_rig;
use muybridge::io::calib_views::{self, CameraViews};
use muybridge::io::calibration_json::{self, Source};
use muybridge::io::{RigReading, read_rig_files};
use muybridge::report;
use muybridge::rig::Rig;
use muybridge::rig::calibrate::{CalibrateOptions, Calibration, Detection, LensKind, Target, Uncalibrated, calibrate};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Pictures held at once.
const AT_ONCE: usize = 32;
/// Pictures in which other board sizes are tried where none has the board.
const TRIED_PICTURES: usize = 4;
/// Below this part of the picture, distortion at the edges is extrapolated.
const POOR_COVERAGE: f64 = 0.4;

/// Principal points of real cameras are nearer to the centre than this part of the longer side.
const FAR_OFF_CENTRE: f64 = 0.1;
/// Lines about single detections.
const MOST_LINES: usize = 20;

#[derive(clap::Args)]
pub struct CalibrateArgs {
    /// One folder, glob in quotes or video per camera; the cameras are called by their names
    #[arg(required = true, value_name = "CAM")]
    cameras: Vec<PathBuf>,
    #[command(flatten)]
    board: BoardOptions,
    /// Number of the view in which the board lies on the floor; it becomes the world, z up
    #[arg(long, value_name = "N")]
    floor_view: Option<usize>,
    /// Use only views whose number is a multiple of this, of long videos
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Lens model
    #[arg(long, value_enum, default_value_t = Lens::Brown)]
    lens: Lens,
    /// Free k3 too (fisheye: k3 and k4), for wide lenses with corners up to the edges
    #[arg(long)]
    k3: bool,
    /// Square pixels: one focal length for both directions
    #[arg(long)]
    fix_aspect: bool,
    /// Keep the camera matrices and lenses of this rig file (of any form), by the cameras' names; only poses are found
    #[arg(long, value_name = "RIG", conflicts_with_all = ["k3", "fix_aspect"])]
    intrinsics: Option<PathBuf>,
    /// The ChArUco board is white where others are black; without it both are tried
    #[arg(long, requires = "charuco")]
    inverted: bool,
    /// Rig file to write; _calibration.png and _calibration.json appear beside it
    #[arg(short, long, default_value = "Calib.toml")]
    output: PathBuf,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Lens {
    Brown,
    Fisheye,
}

pub fn run(args: &CalibrateArgs) -> Result<()> {
    let board = args.board.board(args.inverted)?;
    let target = board.target()?;
    let cameras = calib_views::open(&args.cameras)?;
    let every = args.every as usize;
    let bar = progress::bar("views", cameras.iter().map(|c| c.count(every) as u64).sum());
    let looks =
        cameras.iter().enumerate().map(|(k, camera)| look(&board, &target, camera, k, every, &bar)).collect::<Result<Vec<Look>>>()?;
    bar.finish();
    let uncalibrated = uncalibrated(&cameras, &looks, args.intrinsics.as_deref())?;
    let detections: Vec<Detection> = looks.iter().flat_map(|look| look.detections.clone()).collect();
    let lens = if matches!(args.lens, Lens::Fisheye) { LensKind::Fisheye } else { LensKind::Brown };
    let options = CalibrateOptions { lens, k3: args.k3, fix_aspect: args.fix_aspect };
    let result = calibrate(&uncalibrated, &target, &detections, &options)?;
    let (rig, world) = world(&result, args.floor_view, &detections)?;
    print(&board, &looks, &result);
    write(&args.output, &rig, &result, &board, &world, &looks)?;
    warnings(&result, &world, args.floor_view.is_none()).iter().for_each(|warning| println!("warning: {warning}"));
    println!("written: {}, {}, {}", args.output.display(), beside(&args.output, "png").display(), beside(&args.output, "json").display());
    Ok(())
}

fn uncalibrated(cameras: &[CameraViews], looks: &[Look], intrinsics: Option<&Path>) -> Result<Vec<Uncalibrated>> {
    let read = |path: &Path| read_rig_files(&[path.to_path_buf()], &RigReading::default()).map(|read| read.rig);
    let rig = intrinsics.map(|path| anyhow::Ok((path, read(path)?))).transpose()?;
    let one = |(camera, look): (&CameraViews, &Look)| {
        let (name, size_px) = (camera.name.clone(), look.size_px);
        let Some((path, rig)) = &rig else { return Ok(Uncalibrated { name, size_px, known: None }) };
        let known = rig.cameras.iter().find(|c| c.name == name).with_context(|| {
            let names = rig.cameras.iter().map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ");
            format!("{}: has no camera {name}, only {names}; rename its tables or the footage", path.display())
        })?;
        let ([width, height], [w, h]) = (size_px, known.size_px);
        ensure!(known.size_px == size_px, "{}: {name} is for pictures of {w}x{h} px, these have {width}x{height}", path.display());
        Ok(Uncalibrated { name, size_px, known: Some((known.matrix, known.lens)) })
    };
    cameras.iter().zip(looks).map(one).collect()
}

/// What was seen of the board in one camera's footage.
struct Look {
    size_px: [u32; 2],
    pictures: usize,
    /// Numbers of the pictures without a board.
    without: Vec<usize>,
    detections: Vec<Detection>,
}

fn look(board: &Board, target: &Target, camera: &CameraViews, index: usize, every: usize, bar: &progress::Progress) -> Result<Look> {
    let mut look = Look { size_px: [0; 2], pictures: 0, without: Vec::new(), detections: Vec::new() };
    let mut kept = Vec::new();
    camera.for_chunks(every, AT_ONCE, |part| {
        interrupt::check()?;
        let found = part
            .par_iter()
            .map(|(number, image)| board.detect(image, target, index, *number).inspect(|_| bar.inc(1)))
            .collect::<Result<Vec<_>, BoardError>>()?;
        for ((number, image), found) in part.into_iter().zip(found) {
            look.size_px = image.dimensions().into();
            look.pictures += 1;
            match found {
                Some(detection) => look.detections.push(detection),
                None => look.without.push(number),
            }
            if kept.len() < TRIED_PICTURES {
                kept.push(image);
            }
        }
        anyhow::Ok(())
    })?;
    ensure!(look.pictures > 0, "{}: holds no picture whose number is a multiple of {every}", camera.name);
    if look.detections.is_empty() {
        let hint =
            other_size(board, &kept)?.unwrap_or_else(|| "is it whole in the picture, sharp and evenly lit, and --board its size".into());
        bail!("{}: none of {} pictures shows a {board}; {hint}", camera.name, look.pictures);
    }
    Ok(look)
}

/// The size that the board seems to have, where that is not the one given.
fn other_size(board: &Board, pictures: &[GrayImage]) -> Result<Option<String>> {
    let Board::Chessboard { columns, rows, square_m } = *board else { return Ok(None) };
    let size = |[x, y]: [usize; 2]| [columns + x - 1, rows + y - 1];
    let sizes = [[0, 0], [0, 1], [1, 0], [1, 2], [2, 1], [2, 2]].map(size);
    // A picture that shows another board takes OpenCV seconds, so that sizes are looked for at once, and in all before the next picture.
    for picture in pictures {
        let shown = |[c, r]: &[usize; 2]| {
            let other = Board::chessboard(*c, *r, square_m).ok()?;
            let found = other.target().and_then(|target| other.find(picture, &target));
            found.map(|corners| corners.map(|_| [*c, *r])).transpose()
        };
        if let Some([c, r]) = sizes.par_iter().find_map_first(shown).transpose()? {
            return Ok(Some(format!("they show {c}x{r} inner corners, so give --board {c}x{r}")));
        }
    }
    Ok(None)
}

/// The rig in its world, and the world in words.
fn world(result: &Calibration, floor_view: Option<usize>, detections: &[Detection]) -> Result<(Rig, String)> {
    let Some(view) = floor_view else {
        let first = &result.rig.cameras[0].name;
        return Ok((result.rig.clone(), format!("{first}'s frame: x right, y down, z forward")));
    };
    let seen = if detections.iter().any(|d| d.view == view) { "its detections were put aside" } else { "no camera sees the board in it" };
    let rig = result.on_board(view).with_context(|| {
        let usable = result.boards.keys().map(usize::to_string).collect::<Vec<_>>().join(", ");
        format!("--floor-view {view} cannot be the world, {seen}; views with a board: {usable}")
    })?;
    Ok((rig, format!("the board of view {view}: x along its rows, z up out of it")))
}

fn print(board: &Board, looks: &[Look], result: &Calibration) {
    println!("{board}");
    println!(
        "{:<12} {:>9} {:>8} {:>8} {:>9} {:>9}  focal length, centre (px)",
        "camera", "pictures", "views", "corners", "RMS px", "coverage"
    );
    for (k, camera) in result.rig.cameras.iter().enumerate() {
        let (q, m) = (&result.quality[k], &camera.matrix);
        let sigma = |name: &str| result.parameters.iter().find(|p| p.camera == k && p.name.starts_with(name)).map_or(0.0, |p| p.sigma);
        println!(
            "{:<12} {:>9} {:>8} {:>8} {:>9.3} {:>7.0} %  {:.2} x {:.2} ({:.2}), {:.2}, {:.2} ({:.2}, {:.2})",
            camera.name,
            looks[k].pictures,
            q.views,
            q.corners,
            q.rms_px,
            100.0 * q.coverage,
            m[(0, 0)],
            m[(1, 1)],
            sigma("f"),
            m[(0, 2)],
            m[(1, 2)],
            sigma("cx"),
            sigma("cy"),
        );
    }
    println!("all: {} views, RMS {:.3} px; in brackets: standard deviations", result.boards.len(), result.rms_px);
    for (i, k, baseline_m, sigma_m) in result.baselines_m() {
        let name = |k: usize| &result.rig.cameras[k].name;
        println!("baseline {} to {}: {:.2} mm ({:.2})", name(i), name(k), 1e3 * baseline_m, 1e3 * sigma_m);
    }
    for (look, camera) in looks.iter().zip(&result.rig.cameras).filter(|(look, _)| !look.without.is_empty()) {
        println!("{}: no board in {}", camera.name, numbers(&look.without));
    }
    for rejected in result.rejected.iter().take(MOST_LINES) {
        println!("put aside: {} in view {}: {}", result.rig.cameras[rejected.camera].name, rejected.view, rejected.reason);
    }
    if result.rejected.len() > MOST_LINES {
        println!("put aside: {} more, all in the JSON file", result.rejected.len() - MOST_LINES);
    }
}

/// "3, 5 to 9, 12".
fn numbers(sorted: &[usize]) -> String {
    let run = |run: &[usize]| match run {
        [first, .., last] => format!("{first} to {last}"),
        _ => run[0].to_string(),
    };
    sorted.chunk_by(|a, b| a + 1 == *b).map(run).collect::<Vec<_>>().join(", ")
}

fn warnings(result: &Calibration, world: &str, no_floor: bool) -> Vec<String> {
    let mut warnings = Vec::new();
    if no_floor {
        warnings.push(format!(
            "the world is {world}; nothing says where the floor is, so lay the board there in one view and give --floor-view (or muybridge rig convert --level --height)"
        ));
    }
    for (camera, q) in result.rig.cameras.iter().zip(&result.quality).filter(|(_, q)| q.coverage < POOR_COVERAGE) {
        let percent = 100.0 * q.coverage;
        warnings.push(format!(
            "{}: the boards cover {percent:.0} % of the picture; the lens is guessed elsewhere, so hold the board near the edges and corners too",
            camera.name
        ));
    }
    for camera in &result.rig.cameras {
        let [width, height] = camera.size_px.map(f64::from);
        let off_px = (camera.matrix[(0, 2)] - 0.5 * width).hypot(camera.matrix[(1, 2)] - 0.5 * height);
        if off_px > FAR_OFF_CENTRE * width.max(height) {
            warnings.push(format!(
                "{}: the principal point lies {off_px:.0} px from the picture's centre, which lenses hardly have; film more views at more angles, or give --intrinsics",
                camera.name
            ));
        }
    }
    warnings
}

fn write(output: &Path, rig: &Rig, result: &Calibration, board: &Board, world: &str, looks: &[Look]) -> Result<()> {
    let picture = report::calibration(result)?;
    let pictures: Vec<_> = looks.iter().map(|look| (look.pictures, look.without.clone())).collect();
    let source = Source { board: &board.to_string(), world, pictures: &pictures };
    let json = beside(output, "json");
    calibration_json::write(&json, result, &source).with_context(|| format!("cannot write {}", json.display()))?;
    report::save(&beside(output, "png"), &picture)?;
    Ok(write_rig(output, rig)?)
}

/// `Calib.toml` to `Calib_calibration.png`.
fn beside(output: &Path, extension: &str) -> PathBuf {
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    output.with_file_name(format!("{stem}_calibration.{extension}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_of_numbers_are_short() {
        assert_eq!(numbers(&[3, 5, 6, 7, 9]), "3, 5 to 7, 9");
        assert_eq!(beside(Path::new("a/Calib.toml"), "png"), Path::new("a/Calib_calibration.png"));
    }
}

//! `muybridge rig`: rig files in words and a picture, and from one form to another.

use super::board;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::{Args, Subcommand, ValueEnum};

use muybridge::io::{ReadRig, RigReading, calib_toml, read_rig_files, write_opencv_rig};
use muybridge::report;
use muybridge::rig::rectify::{self, Rectification};
use muybridge::rig::{Camera, Lens, Rig, Up};
use nalgebra::Vector3;

/// What a disparity is good for at best, px; the depth errors of `show` follow from it.
const DISPARITY_ERROR_PX: f64 = 0.16;
const DEPTHS_M: [f64; 3] = [2.0, 4.0, 6.0];

#[derive(Subcommand)]
pub enum RigCommand {
    /// The cameras of a rig file in words, and their picture
    Show(ShowArgs),
    /// A rig file in another form: Calib.toml or OpenCV's YAML
    Convert(ConvertArgs),
    /// A calibration board to print
    Board(board::BoardArgs),
}

#[derive(Args)]
pub struct RigFileArgs {
    /// Calib.toml (aniposelib, Pose2Sim, caliscope), EasyMocap's or OpenCV's intrinsics and extrinsics (one is found beside the
    /// other), Kalibr's camchain.yaml, or a folder with one of them
    #[arg(required = true, num_args = 1..=2, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Size of the pictures, px, where the file does not say it
    #[arg(long, value_parser = parse_size, value_name = "WxH")]
    size: Option<[u32; 2]>,
    /// Metres per unit of the file; 0.001 for millimetres
    #[arg(long, value_parser = super::positive, default_value_t = 1.0)]
    scale: f64,
    /// Axis of the world that points up, instead of the file's
    #[arg(long, value_enum)]
    up: Option<UpAxis>,
    /// Four distortion terms in a file of OpenCV's are a fisheye lens's
    #[arg(long)]
    fisheye: bool,
    /// Turn the world upright as the first camera stands; always done with files whose world is a camera's (Kalibr, OpenCV stereo)
    #[arg(long)]
    level: bool,
    /// Height of the first camera above the floor of such a world, metres
    #[arg(long, allow_hyphen_values = true, value_name = "METRES")]
    height: Option<f64>,
}

#[derive(Args)]
pub struct ShowArgs {
    #[command(flatten)]
    file: RigFileArgs,
    /// Picture to write, PNG
    #[arg(short, long)]
    output: Option<PathBuf>,
}

#[derive(Args)]
pub struct ConvertArgs {
    #[command(flatten)]
    file: RigFileArgs,
    /// File to write
    #[arg(short, long)]
    output: PathBuf,
    /// Form of the output; without it OpenCV's for .yml and .yaml, else Calib.toml
    #[arg(long, value_enum)]
    format: Option<Format>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum UpAxis {
    Y,
    Z,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Format {
    Calib,
    Opencv,
}

fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let parts: Vec<Option<u32>> = text.split(['x', 'X']).map(|t| t.trim().parse().ok().filter(|n| *n > 0)).collect();
    match parts[..] {
        [Some(width), Some(height)] => Ok([width, height]),
        _ => Err("width and height in px, such as 1920x1080".into()),
    }
}

pub fn run(command: &RigCommand) -> Result<()> {
    match command {
        RigCommand::Show(args) => show(args),
        RigCommand::Convert(args) => convert(args),
        RigCommand::Board(args) => board::run(args),
    }
}

fn read(args: &RigFileArgs) -> Result<ReadRig> {
    ensure!(args.height.is_none_or(f64::is_finite), "--height must be a number of metres");
    let up = args.up.map(|up| if up == UpAxis::Y { Up::Y } else { Up::Z });
    let reading = RigReading { size_px: args.size, scale: args.scale, up, fisheye: args.fisheye, level: args.level, height_m: args.height };
    let read = read_rig_files(&args.files, &reading)?;
    read.notices.iter().for_each(|notice| eprintln!("notice: {notice}"));
    Ok(read)
}

fn convert(args: &ConvertArgs) -> Result<()> {
    let read = read(&args.file)?;
    let yaml = args.output.extension().is_some_and(|e| e == "yml" || e == "yaml");
    match args.format.unwrap_or(if yaml { Format::Opencv } else { Format::Calib }) {
        Format::Calib => calib_toml::write_rig(&args.output, &read.rig)?,
        Format::Opencv => write_opencv_rig(&args.output, &read.rig)?,
    }
    println!("{}: {} cameras ({})", args.output.display(), read.rig.cameras.len(), read.form);
    Ok(())
}

fn show(args: &ShowArgs) -> Result<()> {
    let read = read(&args.file)?;
    let file = args.file.files.first().map_or(Path::new(""), PathBuf::as_path);
    let count = read.rig.cameras.len();
    let head = format!("{} ({}): {count} cameras, {} up\n", file.display(), read.form, up_name(read.rig.up));
    tell(&(head + &in_words(&read.rig)))?;
    if let Some(path) = &args.output {
        report::save(path, &report::rig_views(&read.rig)?).with_context(|| format!("cannot draw {}", path.display()))?;
        tell(&format!("\npicture: {}\n", path.display()))?;
    }
    Ok(())
}

/// To stdout; a reader that has seen enough, such as `head`, is no failure.
fn tell(text: &str) -> Result<()> {
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error).context("cannot write to stdout"),
        _ => Ok(()),
    }
}

fn up_name(up: Up) -> &'static str {
    match up {
        Up::Y => "y",
        Up::Z => "z",
    }
}

fn in_words(rig: &Rig) -> String {
    let cameras: String = rig.cameras.iter().map(|camera| camera_in_words(camera, rig.up)).collect();
    let mut text = format!("{cameras}\n");
    for (i, k, baseline_m) in rig.baselines_m() {
        let (first, second) = (&rig.cameras[i], &rig.cameras[k]);
        let angle_deg = axis(first).angle(&axis(second)).to_degrees();
        text += &format!("{} - {}: {baseline_m:.4} m apart, axes {angle_deg:.1} deg apart\n", first.name, second.name);
    }
    match rig.validate_stereo().map_err(anyhow::Error::from).and_then(|()| Ok(rectify::groups(rig)?)) {
        Ok(groups) => groups.iter().for_each(|group| text += &group_in_words(group)),
        Err(error) => text += &format!("no stereo: {error}\n"),
    }
    text
}

fn axis(camera: &Camera) -> Vector3<f64> {
    camera.camera_from_world.inverse() * Vector3::z()
}

fn camera_in_words(camera: &Camera, up: Up) -> String {
    let (m, centre) = (&camera.matrix, camera.centre());
    let pitch_deg = axis(camera).dot(&up.direction()).clamp(-1.0, 1.0).asin().to_degrees();
    let field = camera
        .field_of_view()
        .map(|angle| angle.map_or("unknown (the lens model folds inside the picture)".into(), |a| format!("{:.1}", a.to_degrees())));
    let shift_px = camera.corner_shift_px();
    format!(
        "\n{}  {} x {} px, focal length {:.1} x {:.1} px, field of view {} x {} deg, principal point ({:.1}, {:.1}) px\n  \
         {}, moves the corners {:.1} px {}\n  \
         at ({}, {}, {}) m, {} m above the world's zero, looks {:.1} deg {}\n",
        camera.name,
        camera.size_px[0],
        camera.size_px[1],
        m[(0, 0)],
        m[(1, 1)],
        field[0],
        field[1],
        m[(0, 2)],
        m[(1, 2)],
        lens_in_words(&camera.lens),
        shift_px.abs(),
        if shift_px < 0.0 { "inwards" } else { "outwards" },
        metres(centre.x),
        metres(centre.y),
        metres(centre.z),
        metres(centre.dot(&up.direction())),
        pitch_deg.abs(),
        if pitch_deg < 0.0 { "down" } else { "up" },
    )
}

/// To the millimetre, without a negative zero.
fn metres(value: f64) -> String {
    format!("{:.3}", (value * 1e3).round() / 1e3 + 0.0)
}

fn lens_in_words(lens: &Lens) -> String {
    let (name, terms): (_, &[&str]) = match lens {
        Lens::BrownConrady(_) => ("Brown-Conrady", &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]),
        Lens::Fisheye(_) => ("fisheye", &["k1", "k2", "k3", "k4"]),
    };
    let told: Vec<String> = terms.iter().zip(lens.terms()).map(|(term, value)| format!("{term} {value:.5}")).collect();
    format!("{name} lens {}", told.join(" "))
}

fn group_in_words(group: &Rectification) -> String {
    let names: Vec<&str> = group.views.iter().map(|view| view.camera.name.as_str()).collect();
    let upright = group.views.iter().skip(1).any(|view| view.step.y.abs() > view.step.x.abs());
    let shape = match (names.len(), upright) {
        (3, true) => "an L",
        (3, false) => "a row",
        (_, true) => "an upright pair",
        _ => "a pair",
    };
    let errors = DEPTHS_M.map(|z| format!("{:.1} mm at {z:.0} m", 1e3 * DISPARITY_ERROR_PX * z / group.disparity(z)));
    format!(
        "stereo {}: {shape}, baseline {:.4} m, focal length {:.1} px, pictures {} x {} px; depth error {} for {DISPARITY_ERROR_PX} px\n",
        names.join(" + "),
        group.baseline_m,
        group.focal_px,
        group.size_px[0],
        group.size_px[1],
        errors.join(", "),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_two_whole_numbers() {
        assert_eq!(parse_size("1920x1080"), Ok([1920, 1080]));
        assert!(["1920", "1920x", "0x1", "1x2x3", "a x b", "-1x2"].iter().all(|t| parse_size(t).is_err()));
    }

    #[test]
    fn depth_errors_are_those_of_triangulation() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml");
        let rig = calib_toml::read_rig(&path).unwrap();
        let group = &rectify::groups(&rig).unwrap()[0];
        // A point 4 m deep seen 0.16 px wrong.
        let d = group.disparity(4.0);
        let wrong = group.depth(d - DISPARITY_ERROR_PX) - 4.0;
        let words = group_in_words(group);
        let said: f64 = words.split("mm at 4 m").next().unwrap().trim().rsplit(' ').next().unwrap().parse().unwrap();
        assert!((said * 1e-3 - wrong).abs() < 2e-4, "{words} {wrong}");
        assert!(words.starts_with("stereo cam_00 + cam_01 + cam_02: an L"), "{words}");
        let all = in_words(&rig);
        assert!(all.contains("cam_01  640 x 480 px, focal length 549.4 x 549.9 px, field of view 6"), "{all}");
        assert!(all.contains("cam_00 - cam_02: 0.") && all.contains("m above the world's zero, looks 1.9 deg down"), "{all}");
    }
}

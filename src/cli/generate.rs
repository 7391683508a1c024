//! `muybridge generate`: the same person at other speeds or jump lengths.
use std::fmt::Write;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use muybridge::body::Shape;
use muybridge::io::manifest::find_motions;
use muybridge::io::model_npz::{model_hash, read_model};
use muybridge::io::outputs_json::Source;
use muybridge::io::style_json::read_style;
use muybridge::io::{is_motion_file, write_atomic};
use muybridge::motion::{Length, Synthesis, play, synthesize};
use muybridge::motion_model::{Activity, Cycle, Model};
use muybridge::report::generated::{self, GeneratedReport};
use muybridge::style::{Method, Metric, Population, Style};

use super::model::default_variance;
use super::motions::{file_name, read_recordings};
use super::outputs::{Made, OutputArgs};

/// Fractions of stature at which the hip joints stand.
pub const HIP_OF_STATURE: f64 = 0.53;

#[derive(Args)]
pub struct GenerateArgs {
    /// Model file (.npz)
    #[arg(long)]
    model: PathBuf,
    /// style.json of `track`, or a motion file of the person
    #[arg(long)]
    style: PathBuf,
    /// Speeds or jump lengths: 3km/h, 1.25m/s, 80cm; bare numbers are m/s, for jumps m
    #[arg(long, required = true, value_delimiter = ',')]
    at: Vec<String>,
    /// Folder for the motions
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Speed in m/s or length in m of a motion file given as --style, where it cannot be measured (treadmill)
    #[arg(long, value_name = "VALUE")]
    recorded_at: Option<String>,
    /// Stature in metres of the body that moves; the observed person's without it
    #[arg(long, value_parser = super::positive, conflicts_with = "leg_length")]
    height: Option<f64>,
    /// Hip-joint height in metres of the body that moves
    #[arg(long, value_parser = super::positive)]
    leg_length: Option<f64>,
    /// How the style is carried: `default` keeps the person's own motion and adds the change of like people, `paper` is the
    /// weighted sum of the database's people
    #[arg(long, value_enum, default_value = "default")]
    method: MethodName,
    /// Part of the variance that the components in use hold; all the style has, for `--method paper` 0.90 of walking, else 0.95
    #[arg(long, value_parser = super::part)]
    variance: Option<f64>,
    /// With `--method paper`: weigh database subjects by the true Mahalanobis distance in place of the paper's
    #[arg(long)]
    mahalanobis: bool,
    /// Gait cycles per motion
    #[arg(long, default_value_t = 4, conflicts_with = "seconds", value_parser = clap::value_parser!(u16).range(1..))]
    cycles: u16,
    /// Length of each motion in seconds
    #[arg(long, value_parser = super::positive)]
    seconds: Option<f64>,
    /// Frames per second
    #[arg(long, default_value_t = 60.0, value_parser = super::positive)]
    fps: f64,
    #[command(flatten)]
    files: OutputArgs,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum MethodName {
    Default,
    Paper,
}

fn method(args: &GenerateArgs) -> Result<Method> {
    match (args.method, args.mahalanobis) {
        (MethodName::Default, false) => Ok(Method::Default),
        (MethodName::Paper, false) => Ok(Method::Paper(Metric::Paper)),
        (MethodName::Paper, true) => Ok(Method::Paper(Metric::Mahalanobis)),
        (MethodName::Default, true) => bail!("--mahalanobis is a distance of --method paper; give both"),
    }
}

pub fn run(args: GenerateArgs) -> Result<()> {
    let model = read_model(&args.model)?;
    let values: Vec<f64> = args.at.iter().map(|v| parameter(v, model.activity)).collect::<Result<_>>()?;
    let names = file_names(model.activity, &values)?;
    let style = load_style(&args, &model)?;
    let shape = target_shape(&args, &style);
    let method = method(&args)?;
    let part = args.variance.or_else(|| (method != Method::Default).then(|| default_variance(model.activity)));
    let wanted = part.map_or(style.weights.len(), |v| model.components(v));
    let population = Population::new(&model, wanted.min(style.weights.len()));
    let length = args.seconds.map_or(Length::Cycles(args.cycles.into()), Length::Seconds);
    let mut syntheses = Vec::new();
    let mut table = String::from("file,value,unit,cycle_frequency_hz,hip_height_m,components,nearest_subject,nearest_share\n");
    let mut motions = Vec::new();
    for (value, name) in values.iter().zip(&names) {
        let synthesis = synthesize(&model, &population, method, &style, *value, shape.hip_height_m())?;
        if let Some(notice) = &synthesis.notice {
            eprintln!("notice: {name}: {notice}");
        }
        let clip = play(&model, &synthesis, &shape.offsets(), args.fps, length);
        println!("{}: {} frames, {:.3} cycles/s", args.output.join(name).display(), clip.poses.len(), synthesis.frequency_hz);
        let _ = writeln!(table, "{}", table_row(name, &model, &synthesis));
        let stem = name.trim_end_matches(".bvh").to_string();
        motions.push(Made { stem, value: *value, clip, frequency_hz: synthesis.frequency_hz });
        syntheses.push(synthesis);
    }
    let source = Source { motion: file_name(&args.style), model: file_name(&args.model), model_hash: model_hash(&model) };
    args.files.write(&args.output, &shape, source, &motions, &own_cycle(&model, &style))?;
    write_atomic(&args.output.join("generated.csv"), table.as_bytes()).with_context(|| args.output.display().to_string())?;
    let made = names.iter().zip(&syntheses).zip(&motions);
    report(&args, &model, &style, made.map(|((file, synthesis), motion)| generated::Made { file, synthesis, clip: &motion.clip }).collect())
}

/// Writes report.html.
fn report(args: &GenerateArgs, model: &Model, style: &Style, made: Vec<generated::Made>) -> Result<()> {
    let page = GeneratedReport {
        model,
        model_name: &args.model.display().to_string(),
        style,
        style_name: &args.style.display().to_string(),
        made,
        options: &[
            ("weighing", if args.mahalanobis { "Mahalanobis" } else { "the paper's" }.to_string()),
            ("frames per second", args.fps.to_string()),
        ],
    };
    let path = args.output.join("report.html");
    write_atomic(&path, page.html()?.as_bytes()).with_context(|| format!("cannot write {}", path.display()))
}

/// The person's motion as observed.
fn own_cycle(model: &Model, style: &Style) -> Cycle {
    let frequency_hz = style.cadence_factor * model.cadence().frequency_hz(style.parameter, style.hip_height_m);
    model.cycle(&style.weights, "", style.parameter, style.hip_height_m, 1.0 / frequency_hz)
}

fn table_row(name: &str, model: &Model, s: &Synthesis) -> String {
    let unit = if model.activity.is_cyclic() { "m/s" } else { "m" };
    let nearest = s.shares.iter().max_by(|a, b| a.1.total_cmp(&b.1));
    let (subject, share) = nearest.map_or(("", 0.0), |n| (n.0.as_str(), n.1));
    format!("{name},{},{unit},{:.6},{:.4},{},{subject},{share:.4}", s.parameter, s.frequency_hz, s.hip_height_m, s.weights.len())
}

fn load_style(args: &GenerateArgs, model: &Model) -> Result<Style> {
    let hash = model_hash(model);
    if is_motion_file(&args.style) {
        return style_of_motion(args, model, &hash);
    }
    let style = read_style(&args.style)?;
    if style.model_hash != hash {
        bail!("{} was made with another model than {}; use the model it was made with", args.style.display(), args.model.display());
    }
    Ok(style)
}

fn style_of_motion(args: &GenerateArgs, model: &Model, hash: &str) -> Result<Style> {
    let mut entries = find_motions(std::slice::from_ref(&args.style), None)?;
    if let Some(value) = &args.recorded_at {
        let recorded = parameter(value, model.activity)?;
        entries.iter_mut().for_each(|e| e.parameter = Some(recorded));
    }
    let recordings = read_recordings(&entries, model.activity);
    let Some(style) = Style::of_cycles(model, hash, &recordings.cycles) else {
        bail!("{} shows no whole cycle of {}{}", args.style.display(), model.activity, recordings.first_reason());
    };
    recordings.left_out.iter().for_each(|line| eprintln!("left out: {line}"));
    println!("style: {} cycles at {:.2}, nearest subject {}", recordings.cycles.len(), style.parameter, nearest(&style));
    Ok(style)
}

fn nearest(style: &Style) -> &str {
    style.neighbours.first().map_or("none", |n| &n.subject)
}

/// The observed person's body, or the same proportions at another size.
fn target_shape(args: &GenerateArgs, style: &Style) -> Shape {
    let mut shape = style.shape.clone().unwrap_or_else(|| Shape::template(style.hip_height_m / HIP_OF_STATURE));
    if let Some(height) = args.height {
        shape.stature_m = height;
    } else {
        shape.stature_m *= args.leg_length.unwrap_or(style.hip_height_m) / shape.hip_height_m();
    }
    shape
}

/// A speed in m/s or a length in m.
fn parameter(text: &str, activity: Activity) -> Result<f64> {
    let units: &[(&str, f64)] =
        if activity.is_cyclic() { &[("km/h", 1.0 / 3.6), ("m/s", 1.0), ("", 1.0)] } else { &[("cm", 0.01), ("m", 1.0), ("", 1.0)] };
    let found = units.iter().find_map(|(unit, factor)| Some(text.trim().strip_suffix(unit)?.trim().parse::<f64>().ok()? * factor));
    let known: Vec<&str> = units.iter().map(|u| u.0).filter(|u| !u.is_empty()).collect();
    match found {
        Some(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => bail!("`{text}` is no positive number with a unit of {activity} ({})", known.join(", ")),
    }
}

/// `walking_1.10.bvh` and so on, with as many decimals as keep them apart.
fn file_names(activity: Activity, values: &[f64]) -> Result<Vec<String>> {
    for decimals in 2..7 {
        let names: Vec<String> = values.iter().map(|v| format!("{activity}_{v:.decimals$}.bvh")).collect();
        if (1..names.len()).all(|i| !names[..i].contains(&names[i])) {
            return Ok(names);
        }
    }
    bail!("--at names the same value twice")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_speeds_and_lengths() {
        let walk = |t: &str| parameter(t, Activity::Walking).ok();
        assert_eq!([walk("3.6km/h"), walk("1.25 m/s"), walk("0.8")], [Some(1.0), Some(1.25), Some(0.8)]);
        assert_eq!([walk("80cm"), walk("-1"), walk("fast"), walk("nan"), walk("")], [None; 5]);
        let jump = parameter("80cm", Activity::Jumping).unwrap();
        assert!((jump - 0.8).abs() < 1e-15);
        assert!(parameter("3km/h", Activity::Jumping).is_err());
    }

    #[test]
    fn names_keep_values_apart() {
        let names = file_names(Activity::Walking, &[1.1, 3.0 / 3.6]).unwrap();
        assert_eq!(names, ["walking_1.10.bvh", "walking_0.83.bvh"]);
        assert_eq!(file_names(Activity::Walking, &[0.831, 0.834]).unwrap()[1], "walking_0.834.bvh");
        assert!(file_names(Activity::Walking, &[1.0, 1.0]).is_err());
    }
}

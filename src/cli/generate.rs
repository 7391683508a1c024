//! `muybridge generate`: the same person at other speeds or jump lengths, along a bend, or with speed that varies over time.
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use muybridge::body::{Clip, Shape};
use muybridge::io::manifest::find_motions;
use muybridge::io::model_npz::{model_hash, read_model};
use muybridge::io::outputs_json::Source;
use muybridge::io::style_json::read_style;
use muybridge::io::{is_motion_file, write_atomic};
use muybridge::motion::player::ACCELERATION_M_S2;
use muybridge::motion::{Gait, Gaits, Length, Profile, Step, Synthesis, follow, plant_feet, play, synthesize};
use muybridge::motion_model::{Activity, Model};
use muybridge::report::generated::{self, GeneratedReport};
use muybridge::style::{Method, Metric, Population, Style};

use super::manner::{Manner, MannerArgs};
use super::model::default_variance;
use super::motions::{file_name, read_recordings};
use super::outputs::{Made, OutputArgs};
use super::profile;

/// Fractions of stature at which the hip joints stand.
pub const HIP_OF_STATURE: f64 = 0.53;
/// People turn on a foot where a bend would be tighter.
const TIGHTEST_M: f64 = 0.5;

#[derive(Args)]
pub struct GenerateArgs {
    /// Model file (.npz)
    #[arg(long)]
    model: PathBuf,
    /// style.json of `track`, or a motion file of the person
    #[arg(long)]
    style: PathBuf,
    /// The same person at another speed or length, style.json or motion file, the latter with its speed where that cannot be
    /// measured: run.mot@4m/s; repeat for several
    #[arg(long, value_name = "STYLE")]
    also: Vec<String>,
    /// Speeds or jump lengths: 3km/h, 1.25m/s, 80cm; bare numbers are m/s, for jumps m
    #[arg(long, required_unless_present = "profile", value_delimiter = ',')]
    at: Vec<String>,
    /// Speed over time, straight between the given times: 0:0,2:1.4,6:3 (seconds:speed), or a CSV file with the columns
    /// time_s, speed_m_s and, for bends, radius_m
    #[arg(long, conflicts_with_all = ["at", "cycles", "seconds"])]
    profile: Option<String>,
    /// Model file of running: above the transition speed the profile is run
    #[arg(long, requires = "profile")]
    run_model: Option<PathBuf>,
    /// Running style of the person, as --style; the mean of the running model's people without it
    #[arg(long, requires = "run_model")]
    run_style: Option<PathBuf>,
    /// Speed of a motion file given as --run-style, where it cannot be measured (treadmill)
    #[arg(long, value_name = "VALUE", requires = "run_style")]
    run_recorded_at: Option<String>,
    /// Radius in metres of the bend that the path follows: positive to the left, negative to the right
    #[arg(long, value_name = "METRES", value_parser = radius, allow_negative_numbers = true)]
    turn_radius: Option<f64>,
    /// Keep the feet still while they stand
    #[arg(long)]
    plant_feet: bool,
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
    manner: MannerArgs,
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
    if !model.activity.is_cyclic() && (args.profile.is_some() || args.turn_radius.is_some() || !args.manner.is_plain()) {
        bail!("{} holds jumps; --profile, --turn-radius, --attribute and --caricature are for walking and running", args.model.display());
    }
    let values: Vec<f64> = args.at.iter().map(|v| parameter(v, model.activity)).collect::<Result<_>>()?;
    let mut style = load_style(&args.model, &model, &args.style, args.recorded_at.as_deref())?;
    for text in &args.also {
        let (path, recorded_at) = text.rsplit_once('@').map_or((text.as_str(), None), |(path, at)| (path, Some(at)));
        style = style.and(load_style(&args.model, &model, Path::new(path), recorded_at)?);
    }
    let (shape, manner) = (target_shape(&args, &style), args.manner.read()?);
    match &args.profile {
        Some(text) => {
            let profile = profile::read(text, args.turn_radius)?.with_amounts(manner.courses.clone());
            along_profile(&args, &manner, &model, &style, &shape, &profile)
        }
        None => at_values(&args, &manner, &model, &style, &shape, &values),
    }
}

fn at_values(args: &GenerateArgs, manner: &Manner, model: &Model, style: &Style, shape: &Shape, values: &[f64]) -> Result<()> {
    let names = file_names(model.activity, values)?;
    let (population, method) = (population(args, model, style)?, method(args)?);
    let length = args.seconds.map_or(Length::Cycles(args.cycles.into()), Length::Seconds);
    let mut table = String::from("file,value,unit,cycle_frequency_hz,hip_height_m,components,angle_sd_deg,nearest_subject,nearest_share\n");
    let (mut motions, mut syntheses) = (Vec::new(), Vec::new());
    for (value, name) in values.iter().zip(&names) {
        let mut synthesis = synthesize(model, &population, method, style, *value, shape.hip_height_m())?;
        if let Some(notice) = &synthesis.notice {
            eprintln!("notice: {name}: {notice}");
        }
        let clip = if args.turn_radius.is_none() && args.manner.is_plain() {
            play(model, &synthesis, &shape.offsets(), args.fps, length)
        } else {
            let mut gait = Gait::steady(model, &synthesis, &shape.offsets()).context("no gait at this speed")?;
            manner.teach(&mut gait, || Gait::typical(model, &population, shape.hip_height_m(), &shape.offsets()), *value)?;
            synthesis.frequency_hz *= gait.cadence_factor(manner.courses.iter().map(|c| c.at(0.0)));
            let seconds = length.seconds(synthesis.frequency_hz);
            let profile = Profile::steady(*value, args.turn_radius.map_or(0.0, f64::recip), seconds)?.with_amounts(manner.courses.clone());
            follow(&Gaits::one(gait), &profile, &shape.offsets(), args.fps).0
        };
        let clip = planted(args, name, clip);
        println!("{}: {} frames, {:.3} cycles/s", args.output.join(name).display(), clip.poses.len(), synthesis.frequency_hz);
        let _ = writeln!(table, "{}", table_row(name, model, &synthesis));
        let stem = name.trim_end_matches(".bvh").to_string();
        motions.push(Made { stem, value: *value, clip, frequency_hz: synthesis.frequency_hz });
        syntheses.push(synthesis);
    }
    write_files(args, model, style, shape, &motions)?;
    write_atomic(&args.output.join("generated.csv"), table.as_bytes()).with_context(|| args.output.display().to_string())?;
    let made = names.iter().zip(&syntheses).zip(&motions);
    report(args, model, style, made.map(|((file, synthesis), motion)| generated::Made { file, synthesis, clip: &motion.clip }).collect())
}

fn method_words(method: Method) -> &'static str {
    match method {
        Method::Default => "the own motion kept and changed as people like this one change",
        Method::Paper(Metric::Paper) => "the paper's, equations 6 to 8",
        Method::Paper(Metric::Mahalanobis) => "the paper's with Mahalanobis distances",
    }
}

/// Writes report.html.
fn report(args: &GenerateArgs, model: &Model, style: &Style, made: Vec<generated::Made>) -> Result<()> {
    let page = GeneratedReport {
        model,
        model_name: &file_name(&args.model),
        style,
        style_name: &file_name(&args.style),
        made,
        options: &[("method", method_words(method(args)?).to_string()), ("frames per second", args.fps.to_string())],
    };
    let path = args.output.join("report.html");
    write_atomic(&path, page.html()?.as_bytes()).with_context(|| format!("cannot write {}", path.display()))
}

/// One motion whose speed varies over time.
fn along_profile(args: &GenerateArgs, manner: &Manner, model: &Model, style: &Style, shape: &Shape, profile: &Profile) -> Result<()> {
    let own = gait(args, manner, model, style, shape)?;
    let gaits = match &args.run_model {
        Some(path) => Gaits::walk_and_run(own, running(args, manner, path, shape)?),
        None => Gaits::one(own),
    };
    let fastest_m_s = gaits.fast().unwrap_or(&gaits.slow).range_m_s().1;
    if profile.fastest_m_s() > fastest_m_s {
        eprintln!("notice: nobody in the model goes faster than {fastest_m_s:.2} m/s; beyond, steps keep their length and come more often");
    }
    if profile.steepest_m_s2() > ACCELERATION_M_S2 {
        let steepest = profile.steepest_m_s2();
        eprintln!(
            "notice: the profile changes by up to {steepest:.1} m/s per second; people manage {ACCELERATION_M_S2}, so it is followed late"
        );
    }
    let (clip, steps) = follow(&gaits, profile, &shape.offsets(), args.fps);
    let clip = planted(args, "profile.bvh", clip);
    let frames = clip.poses.len();
    // A strip shows the whole way.
    let made = Made { stem: "profile".into(), value: profile.mean_m_s(), clip, frequency_hz: 1.0 / profile.seconds() };
    write_files(args, model, style, shape, &[made])?;
    write_atomic(&args.output.join("profile.csv"), steps_csv(&steps).as_bytes()).with_context(|| args.output.display().to_string())?;
    let off = steps.iter().map(|s| (s.speed_m_s - s.wanted_m_s).abs()).fold(0.0, f64::max);
    println!("{}: {frames} frames, {:.1} s, speed within {off:.2} m/s", args.output.join("profile.bvh").display(), profile.seconds());
    Ok(())
}

fn steps_csv(steps: &[Step]) -> String {
    let mut table = String::from("frame,time_s,wanted_m_s,speed_m_s,heading_deg,lean_deg,running,phase\n");
    for (i, s) in steps.iter().enumerate() {
        let (heading, lean) = (s.heading.to_degrees(), s.lean.to_degrees());
        let (time, wanted, speed, running, phase) = (s.time_s, s.wanted_m_s, s.speed_m_s, s.running, s.phase);
        let _ = writeln!(table, "{i},{time:.6},{wanted:.4},{speed:.4},{heading:.3},{lean:.3},{running:.4},{phase:.4}");
    }
    table
}

fn gait(args: &GenerateArgs, manner: &Manner, model: &Model, style: &Style, shape: &Shape) -> Result<Gait> {
    let population = population(args, model, style)?;
    let found = Gait::of_style(model, &population, method(args)?, style, shape.hip_height_m(), &shape.offsets())?;
    let (mut gait, notice) = found.with_context(|| format!("the speeds of {} make no gait", model.activity))?;
    if let Some(notice) = notice {
        eprintln!("notice: {notice}");
    }
    let typical = || Gait::typical(model, &population, shape.hip_height_m(), &shape.offsets());
    manner.teach(&mut gait, typical, style.parameter * shape.hip_height_m() / style.hip_height_m)?;
    Ok(gait)
}

/// Running of the same body: the person's own, else that of the running model's people on average.
fn running(args: &GenerateArgs, manner: &Manner, path: &Path, shape: &Shape) -> Result<Gait> {
    let model = read_model(path)?;
    if model.activity != Activity::Running {
        bail!("{} is a model of {}, not of running", path.display(), model.activity);
    }
    if let Some(file) = &args.run_style {
        return gait(args, manner, &model, &load_style(path, &model, file, args.run_recorded_at.as_deref())?, shape);
    }
    eprintln!("notice: no --run-style, so the person runs as the people of {} do on average", path.display());
    let population = Population::new(&model, model.components(1.0));
    let typical = Gait::typical(&model, &population, shape.hip_height_m(), &shape.offsets());
    let mut gait = typical.context("the speeds of running make no gait")?;
    let (own, slowest_m_s) = (gait.clone(), gait.range_m_s().0);
    manner.teach(&mut gait, || Some(own), slowest_m_s)?;
    Ok(gait)
}

/// The motion with its feet planted where that is wanted.
fn planted(args: &GenerateArgs, name: &str, clip: Clip) -> Clip {
    if !args.plant_feet {
        return clip;
    }
    let planted = plant_feet(&clip);
    println!("{name}: {} contacts of feet planted", planted.contacts.iter().map(Vec::len).sum::<usize>());
    if planted.sliding() > 0 {
        let (count, farthest_mm) = (planted.sliding(), 1e3 * planted.farthest_m());
        eprintln!("notice: {name}: in {count} contacts the foot still slides by more than 5 mm, at most {farthest_mm:.0} mm");
    }
    planted.clip
}

fn write_files(args: &GenerateArgs, model: &Model, style: &Style, shape: &Shape, motions: &[Made]) -> Result<()> {
    let source = Source { motion: file_name(&args.style), model: file_name(&args.model), model_hash: model_hash(model) };
    args.files.write(&args.output, shape, source, motions, model, style)
}

fn population(args: &GenerateArgs, model: &Model, style: &Style) -> Result<Population> {
    let part = args.variance.or((method(args)? != Method::Default).then(|| default_variance(model.activity)));
    let wanted = part.map_or(style.weights.len(), |v| model.components(v));
    Ok(Population::new(model, wanted.min(style.weights.len())))
}

fn table_row(name: &str, model: &Model, s: &Synthesis) -> String {
    let unit = if model.activity.is_cyclic() { "m/s" } else { "m" };
    let nearest = s.shares.iter().max_by(|a, b| a.1.total_cmp(&b.1));
    let (subject, share) = nearest.map_or(("", 0.0), |n| (n.0.as_str(), n.1));
    let sd = s.angle_sd().map_or(String::new(), |sd| format!("{:.3}", sd.to_degrees()));
    format!("{name},{},{unit},{:.6},{:.4},{},{sd},{subject},{share:.4}", s.parameter, s.frequency_hz, s.hip_height_m, s.weights.len())
}

fn load_style(model_path: &Path, model: &Model, path: &Path, recorded_at: Option<&str>) -> Result<Style> {
    let hash = model_hash(model);
    if is_motion_file(path) {
        return style_of_motion(model, &hash, path, recorded_at);
    }
    let style = read_style(path)?;
    if style.model_hash != hash {
        bail!("{} was made with another model than {}; use the model it was made with", path.display(), model_path.display());
    }
    Ok(style)
}

fn style_of_motion(model: &Model, hash: &str, path: &Path, recorded_at: Option<&str>) -> Result<Style> {
    let mut entries = find_motions(&[path.to_path_buf()], None)?;
    if let Some(value) = recorded_at {
        let recorded = parameter(value, model.activity)?;
        entries.iter_mut().for_each(|e| e.parameter = Some(recorded));
    }
    let recordings = read_recordings(&entries, model.activity);
    let Some(style) = Style::of_cycles(model, hash, &recordings.cycles) else {
        bail!("{} shows no whole cycle of {}{}", path.display(), model.activity, recordings.first_reason());
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

fn radius(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(r) if r.is_finite() && r.abs() >= TIGHTEST_M => Ok(r),
        _ => Err(format!("must be a radius of {TIGHTEST_M} m or more, negative to the right")),
    }
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

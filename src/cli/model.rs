//! `muybridge model`: build, update, synthetic, info, validate.
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::model_npz::{model_hash, read_model, write_model};
use muybridge::io::write_atomic;
use muybridge::motion_model::{Activity, Model, database, synthetic};
use muybridge::report;
use muybridge::report::validation::ValidationReport;
use muybridge::style::validate::{METRICS, PairScore, Score, validate};

use super::motions::{ActivityName, TABLE, exclude, file_name, read_recordings};

/// Components whose share of the variance is printed.
const SHOWN_COMPONENTS: usize = 20;

#[derive(Subcommand)]
pub enum ModelCommand {
    /// Database and PCA from motion capture
    Build(BuildArgs),
    /// Write the embedded synthetic database as a model
    Synthetic(SyntheticArgs),
    /// A model with further recordings, without those it was built from
    Update(UpdateArgs),
    /// Subjects, parameters and explained variance of a model
    Info {
        /// Model file (.npz)
        model: PathBuf,
        /// Folder for pictures: variance held, the subjects' clusters, weights over the parameter
        #[arg(short, long, value_name = "DIR")]
        output: Option<PathBuf>,
    },
    /// Leave-one-subject-out validation
    Validate(ValidateArgs),
}

/// Motions and what of them a model takes.
#[derive(Args)]
struct RecordedArgs {
    /// Motion files (.bvh, .amc, .c3d, .trc, .mot) or folders, searched to the bottom
    #[arg(required = true, value_name = "MOCAP")]
    inputs: Vec<PathBuf>,
    /// Table of the files: file,subject,activity,speed_m_s or length_m,start_s,end_s
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// Subject or trial to leave out; repeat for several
    #[arg(long, value_name = "SUBJECT or TRIAL")]
    exclude: Vec<String>,
    /// Components that the file keeps, for less detail at less cost; those that hold 99 % of the variance without it
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u16).range(1..))]
    components: Option<u16>,
}

impl RecordedArgs {
    fn entries(&self) -> Result<Vec<Entry>> {
        exclude(find_motions(&self.inputs, self.manifest.as_deref())?, &self.exclude)
    }
}

#[derive(Args)]
pub struct BuildArgs {
    #[command(flatten)]
    recorded: RecordedArgs,
    #[arg(long)]
    activity: ActivityName,
    /// Table (CSV) of what was found in every file: cycles, speed, duration, and why anything was left out
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    /// Model file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

#[derive(Args)]
pub struct UpdateArgs {
    /// Model file (.npz); stays as it is
    model: PathBuf,
    #[command(flatten)]
    recorded: RecordedArgs,
    /// Model file to write
    #[arg(short, long, value_name = "NEW")]
    output: PathBuf,
}

#[derive(Args)]
pub struct SyntheticArgs {
    #[arg(long)]
    activity: ActivityName,
    /// Model file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

#[derive(Args)]
pub struct ValidateArgs {
    /// Model file (.npz)
    model: PathBuf,
    /// Folder for validation.csv, degrees.csv (every angle), pairs.csv (every pair of parameters) and two pictures
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Part of the variance that the components in use hold; 0.90 for walking, else 0.95
    #[arg(long, value_parser = super::part)]
    variance: Option<f64>,
}

pub fn run(command: ModelCommand) -> Result<()> {
    match command {
        ModelCommand::Build(args) => build(args),
        ModelCommand::Synthetic(args) => write_synthetic(args),
        ModelCommand::Update(args) => update(args),
        ModelCommand::Info { model: path, output } => {
            let model = read_model(&path)?;
            print!("{}", description(&path, &model));
            output.map_or(Ok(()), |folder| draw(&folder, &model))
        }
        ModelCommand::Validate(args) => run_validation(args),
    }
}

/// Part of the variance that the paper keeps.
pub fn default_variance(activity: Activity) -> f64 {
    if activity == Activity::Walking { 0.90 } else { 0.95 }
}

fn build(args: BuildArgs) -> Result<()> {
    let activity = args.activity.into();
    let entries = args.recorded.entries()?;
    let recordings = read_recordings(&entries, activity);
    if let Some(path) = &args.table {
        let text = format!("{TABLE}\n{}\n", recordings.table.join("\n"));
        write_atomic(path, text.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if recordings.cycles.is_empty() {
        bail!("none of {} motions can be used for {activity}{}", entries.len(), recordings.first_reason());
    }
    recordings.left_out.iter().for_each(|line| eprintln!("left out: {line}"));
    let found = recordings.cycles.len();
    let (cycles, thinned) = database::thin(recordings.cycles);
    for t in &thinned {
        eprintln!(
            "thinned: subject {} from {} to {} cycles, {} times the median subject's",
            t.subject,
            t.before,
            t.after,
            database::MEDIAN_MULTIPLE
        );
    }
    let model = detailed(Model::build(activity, false, &cycles)?, args.recorded.components);
    write_model(&args.output, &model)?;
    println!(
        "{found} cycles from {} files, {} stretches or files left out, {} cycles kept",
        recordings.files,
        recordings.left_out.len(),
        cycles.len()
    );
    print!("{}", description(&args.output, &model));
    Ok(())
}

fn detailed(model: Model, components: Option<u16>) -> Model {
    match components {
        Some(count) => model.truncated(count.into()),
        None => model,
    }
}

fn update(args: UpdateArgs) -> Result<()> {
    let model = read_model(&args.model)?;
    let entries = args.recorded.entries()?;
    let recordings = read_recordings(&entries, model.activity);
    recordings.left_out.iter().for_each(|line| eprintln!("left out: {line}"));
    if recordings.cycles.is_empty() {
        bail!("none of {} motions can be used for {}{}", entries.len(), model.activity, recordings.first_reason());
    }
    let updated = detailed(model.with(&recordings.cycles)?, args.recorded.components);
    write_model(&args.output, &updated)?;
    println!("{} cycles from {} files added to {} of the model", recordings.cycles.len(), recordings.files, model.members.len());
    print!("{}", description(&args.output, &updated));
    Ok(())
}

/// Pictures of a model.
fn draw(folder: &Path, model: &Model) -> Result<()> {
    let clusters = report::database_clusters(model, &format!("First weights of every cycle, {}", model.activity))?;
    for (name, picture) in [
        ("explained.png", report::model::explained(model)?),
        ("clusters.png", clusters),
        ("weights.png", report::model::coefficients(model)?),
    ] {
        let path = folder.join(name);
        report::save(&path, &picture)?;
        println!("written: {}", path.display());
    }
    Ok(())
}

fn write_synthetic(args: SyntheticArgs) -> Result<()> {
    let activity = args.activity.into();
    let model = Model::build(activity, true, &synthetic::database(activity))?;
    write_model(&args.output, &model)?;
    print!("{}", description(&args.output, &model));
    Ok(())
}

fn description(path: &Path, model: &Model) -> String {
    let unit = if model.activity.is_cyclic() { "m/s" } else { "m" };
    let (lo, hi) = model.parameter_range();
    let kind = if model.synthetic { "synthetic " } else { "" };
    let subjects = model.subjects();
    let mut text = format!(
        "{}: {kind}{}, {} cycles of {} subjects, {lo:.2} to {hi:.2} {unit}\n",
        path.display(),
        model.activity,
        model.members.len(),
        subjects.len()
    );
    let counts = [0.90, 0.95, 0.99].map(|v| format!("{} components hold {v:.2}", model.components(v))).join(", ");
    let _ = writeln!(text, "  variance: {counts}");
    let explained: Vec<String> = model.explained().iter().take(SHOWN_COMPONENTS).map(|e| format!("{e:.3}")).collect();
    let _ = writeln!(text, "  explained by 1, 2, ...: {}", explained.join(" "));
    let law = model.cadence();
    let _ = writeln!(text, "  cadence: f = {:.3} V^{:.3} Hz, scatter of members {:.1} %", law.a, law.b, 100.0 * scatter(model));
    for subject in subjects {
        let own: Vec<f64> = model.members.iter().filter(|m| m.subject == subject).map(|m| m.parameter).collect();
        let (lo, hi) = own.iter().fold((f64::MAX, f64::MIN), |(lo, hi), &p| (lo.min(p), hi.max(p)));
        let _ = writeln!(text, "  subject {subject}: {} cycles, {lo:.2} to {hi:.2} {unit}", own.len());
    }
    let _ = writeln!(text, "  hash: {}", model_hash(model));
    text
}

/// Root mean square of the members' frequency against the law, as a part.
fn scatter(model: &Model) -> f64 {
    let law = model.cadence();
    let squares = model.members.iter().map(|m| (1.0 / (m.duration_s * law.frequency_hz(m.parameter, m.hip_height_m))).ln().powi(2));
    (squares.sum::<f64>() / model.members.len() as f64).sqrt()
}

fn run_validation(args: ValidateArgs) -> Result<()> {
    let model = read_model(&args.model)?;
    if model.subjects().len() < 3 {
        bail!("{} has {} subjects; leaving one out needs at least three", args.model.display(), model.subjects().len());
    }
    let variance = args.variance.unwrap_or(default_variance(model.activity));
    let validation = validate(&model, variance)?;
    let table_of = |head: &str, scores: &[Score]| {
        let line = |s: &Score| format!("{},{},{},{:.6}\n", s.method, s.metric, s.left_out.replace(',', ";"), s.value);
        format!("{head}\n{}", scores.iter().map(line).collect::<String>())
    };
    let pair = |p: &PairScore| {
        let who = p.left_out.replace(',', ";");
        format!("{who},{:.3},{:.3},{},{:.6},{:.6}\n", p.from, p.to, p.method, p.rms_deg, p.rms_mm)
    };
    let pairs = format!("left_out,from,to,method,rms_deg,rms_mm\n{}", validation.pairs.iter().map(pair).collect::<String>());
    let (name, hash) = (file_name(&args.model), model_hash(&model));
    let page = ValidationReport { model: &model, name: &name, hash: &hash, variance, validation: &validation }.html();
    for (name, text) in [
        ("validation.csv", table_of("method,metric,left_out,value", &validation.scores)),
        ("degrees.csv", table_of("method,angle,left_out,rms_deg", &validation.angles)),
        ("pairs.csv", pairs),
        ("report.html", page),
    ] {
        let path = args.output.join(name);
        write_atomic(&path, text.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
    }
    for (metric, label) in [("eq6", "distance of equation (6)"), ("rms_deg", "RMS of the joint angles (degrees)")] {
        report::save(&args.output.join(format!("{metric}.png")), &report::model::validation(&validation.scores, metric, label)?)?;
    }
    print!("{}", table(&validation.scores));
    println!("{} cases, in {} of them too few other subjects were recorded at both parameters", validation.cases, validation.sparse_cases);
    println!("default: errors are {:.2} times their predicted standard deviations", validation.sd_ratio);
    println!("written: {}", args.output.display());
    Ok(())
}

/// Over all subjects.
fn table(scores: &[Score]) -> String {
    let mut text = format!("{:<12} {:>10} {:>12} {:>10} {:>10}\n", "method", "eq6", "mahalanobis", "rms_deg", "rms_mm");
    let all: Vec<&Score> = scores.iter().filter(|s| s.left_out == "all").collect();
    let mut methods: Vec<&str> = all.iter().map(|s| s.method).collect();
    methods.dedup();
    for method in methods {
        let [eq6, mahalanobis, deg, mm] =
            METRICS.map(|metric| all.iter().find(|s| s.method == method && s.metric == metric).map_or(f64::NAN, |s| s.value));
        let _ = writeln!(text, "{method:<12} {eq6:>10.4} {mahalanobis:>12.3} {deg:>10.2} {mm:>10.1}");
    }
    text
}

//! `muybridge model`: build, synthetic, info, validate.
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use muybridge::io::manifest::find_motions;
use muybridge::io::model_npz::{model_hash, read_model, write_model};
use muybridge::io::write_atomic;
use muybridge::motion_model::{Activity, Model, database, synthetic};
use muybridge::report::validation::ValidationReport;
use muybridge::style::validate::{Score, validate};

use super::motions::{ActivityName, exclude, read_recordings};

/// Components whose share of the variance is printed.
const SHOWN_COMPONENTS: usize = 20;

#[derive(Subcommand)]
pub enum ModelCommand {
    /// Database and PCA from motion capture
    Build(BuildArgs),
    /// Write the embedded synthetic database as a model
    Synthetic(SyntheticArgs),
    /// Subjects, parameters and explained variance of a model
    Info {
        /// Model file (.npz)
        model: PathBuf,
    },
    /// Leave-one-subject-out validation
    Validate(ValidateArgs),
}

#[derive(Args)]
pub struct BuildArgs {
    /// Motion files (.bvh, .amc, .mot) or folders, searched to the bottom
    #[arg(required = true, value_name = "MOCAP")]
    inputs: Vec<PathBuf>,
    /// Table of the files: file,subject,activity,speed_m_s or length_m,start_s,end_s
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// Subject or trial to leave out; repeat for several
    #[arg(long, value_name = "SUBJECT or TRIAL")]
    exclude: Vec<String>,
    #[arg(long)]
    activity: ActivityName,
    /// Model file to write
    #[arg(short, long, value_name = "FILE")]
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
    /// Folder for validation.csv
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
        ModelCommand::Info { model } => {
            print!("{}", description(&model, &read_model(&model)?));
            Ok(())
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
    let entries = exclude(find_motions(&args.inputs, args.manifest.as_deref())?, &args.exclude)?;
    let recordings = read_recordings(&entries, activity);
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
    let model = Model::build(activity, false, &cycles)?;
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
    let mut csv = String::from("method,metric,left_out,value\n");
    for s in &validation.scores {
        let _ = writeln!(csv, "{},{},{},{:.6}", s.method, s.metric, s.left_out.replace(',', ";"), s.value);
    }
    let path = args.output.join("validation.csv");
    write_atomic(&path, csv.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
    let (name, hash) = (args.model.display().to_string(), model_hash(&model));
    let page = ValidationReport { model: &model, name: &name, hash: &hash, variance, validation: &validation }.html();
    let report = args.output.join("report.html");
    write_atomic(&report, page.as_bytes()).with_context(|| format!("cannot write {}", report.display()))?;
    print!("{}", table(&validation.scores));
    println!("{} cases, in {} of them too few other subjects were recorded at both parameters", validation.cases, validation.sparse_cases);
    println!("written: {} and report.html beside it", path.display());
    Ok(())
}

/// Means over all subjects.
fn table(scores: &[Score]) -> String {
    let mut text = format!("{:<12} {:>10} {:>12} {:>10}\n", "method", "eq6", "mahalanobis", "rms_deg");
    let all: Vec<&Score> = scores.iter().filter(|s| s.left_out == "all").collect();
    let mut methods: Vec<&str> = all.iter().map(|s| s.method).collect();
    methods.dedup();
    for method in methods {
        let value = |metric: &str| all.iter().find(|s| s.method == method && s.metric == metric).map_or(f64::NAN, |s| s.value);
        let _ = writeln!(text, "{method:<12} {:>10.4} {:>12.3} {:>10.2}", value("eq6"), value("mahalanobis"), value("rms_deg"));
    }
    text
}

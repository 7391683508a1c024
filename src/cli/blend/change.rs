//! `muybridge blend mix / attribute / caricature / vary`: new motions of a space.
use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use muybridge::io::space_npz::read_space;
use muybridge::style::space::attributes::{direction, spread};
use muybridge::style::space::{Method, Network, Space, Vectors, manipulate};

use super::{Made, OutputArgs, finite, made, motion, named_number};

#[derive(Args)]
pub struct MixArgs {
    /// Space (.npz)
    space: PathBuf,
    /// Parts of the shape: NAME=WEIGHT,...; they are divided by their sum
    #[arg(long, required = true, value_delimiter = ',', value_parser = named_number, allow_hyphen_values = true)]
    shape: Vec<(String, f64)>,
    /// Parts of the timing; those of the shape without it
    #[arg(long, value_delimiter = ',', value_parser = named_number, allow_hyphen_values = true)]
    timing: Vec<(String, f64)>,
    #[command(flatten)]
    output: OutputArgs,
}

pub fn mix(args: &MixArgs) -> Result<()> {
    let space = read_space(&args.space)?;
    let shape = members(&space, &args.shape)?;
    let timing = if args.timing.is_empty() { shape.clone() } else { members(&space, &args.timing)? };
    let mut rows = vec![made("mix", "mix", space.mix(&shape, &timing)?)];
    let mut parts = args.shape.clone();
    parts.extend(args.timing.iter().filter(|t| !args.shape.iter().any(|s| s.0 == t.0)).cloned());
    for (name, _) in parts {
        rows.push(made(format!("part_{}", file_part(&name)), name.clone(), motion(&space, &name)?));
    }
    args.output.write(&space, &rows)
}

/// Members with their weights; a name of several members shares its weight among them.
fn members(space: &Space, named: &[(String, f64)]) -> Result<Vec<(usize, f64)>> {
    let mut all = Vec::new();
    for (name, weight) in named {
        let found = space.members_called(name)?;
        all.extend(found.iter().map(|&m| (m, weight / found.len() as f64)));
    }
    Ok(all)
}

/// A name without what a file name must not hold.
fn file_part(name: &str) -> String {
    name.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' }).collect()
}

#[derive(Clone, Copy, ValueEnum)]
enum MethodName {
    /// Least squares on all attributes of --keep at once
    Joint,
    /// Least squares on this attribute alone
    Slope,
    /// The paper's weighted sum
    Sum,
}

#[derive(Args)]
pub struct AttributeArgs {
    /// Space (.npz)
    space: PathBuf,
    /// Attribute to change
    #[arg(required_unless_present = "at", conflicts_with = "at")]
    attribute: Option<String>,
    /// Wanted values, NAME=VALUE,...: a motion that has them, by the network of basis functions
    #[arg(long, value_delimiter = ',', value_parser = named_number, allow_hyphen_values = true)]
    at: Vec<(String, f64)>,
    /// Motion to change: `mean`, a name of the space, or a motion file
    #[arg(long, default_value = "mean", conflicts_with = "at")]
    of: String,
    /// How much: standard deviations of the labels; with the method `sum`, multiples of the sum
    #[arg(long, value_delimiter = ',', default_value = "-2,-1,0,1,2", value_parser = finite, allow_hyphen_values = true)]
    by: Vec<f64>,
    #[arg(long, default_value = "joint")]
    method: MethodName,
    /// Attributes that the method `joint` holds; all others without it
    #[arg(long, value_delimiter = ',')]
    keep: Option<Vec<String>>,
    #[command(flatten)]
    output: OutputArgs,
}

pub fn attribute(args: &AttributeArgs) -> Result<()> {
    let space = read_space(&args.space)?;
    let rows = match &args.attribute {
        Some(name) => along(args, &space, name)?,
        None => wanted(args, &space)?,
    };
    args.output.write(&space, &rows)
}

/// The motion at all amounts of an attribute.
fn along(args: &AttributeArgs, space: &Space, name: &str) -> Result<Vec<Made>> {
    let attribute = space.attribute(name)?;
    let base = motion(space, &args.of)?;
    let keep: Vec<usize> = match &args.keep {
        Some(names) => names.iter().map(|n| space.attribute(n)).collect::<Result<_, _>>()?,
        None => (0..space.attributes.len()).collect(),
    };
    let (method, unit) = match args.method {
        MethodName::Joint => (Method::Joint, spread(&space.attributes[attribute]).1),
        MethodName::Slope => (Method::Slope, spread(&space.attributes[attribute]).1),
        MethodName::Sum => (Method::Sum, 1.0),
    };
    let vector = direction(space, attribute, method, &keep)?;
    let names = numbered(&args.by)?;
    let row = |(by, name): (&f64, String)| {
        made(
            format!("{}_{name}", file_part(&space.attributes[attribute].name)),
            format!("{} {by:+}", space.attributes[attribute].name),
            base.plus(&vector, by * unit, by * unit),
        )
    };
    Ok(args.by.iter().zip(names).map(row).collect())
}

/// The network's motion, under the mean.
fn wanted(args: &AttributeArgs, space: &Space) -> Result<Vec<Made>> {
    let attributes: Vec<usize> = args.at.iter().map(|(name, _)| space.attribute(name)).collect::<Result<_, _>>()?;
    if let Some(i) = (1..attributes.len()).find(|&i| attributes[..i].contains(&attributes[i])) {
        bail!("--at names {} twice", args.at[i].0);
    }
    let network = Network::new(space, &attributes)?;
    let values: Vec<f64> = args.at.iter().map(|a| a.1).collect();
    let label = if let [(name, value)] = &args.at[..] { format!("{name} {value}") } else { "as wanted".into() };
    Ok(vec![made("wanted", label, network.at(&values)), made("mean", "mean", space.mean())])
}

/// Numbers as parts of file names, all different.
fn numbered(values: &[f64]) -> Result<Vec<String>> {
    let names: Vec<String> = values.iter().map(|v| format!("{v:+}")).collect();
    match (1..names.len()).find(|&i| names[..i].contains(&names[i])) {
        Some(i) => bail!("{} is asked for twice", names[i]),
        None => Ok(names),
    }
}

#[derive(Args)]
pub struct CaricatureArgs {
    /// Space (.npz)
    space: PathBuf,
    /// Whose: a name of the space, or a motion file
    #[arg(long)]
    of: String,
    /// Degrees: 1 is the original, 0 the mean, more exaggerates, less plays down
    #[arg(long, value_delimiter = ',', default_value = "1.5,2", value_parser = finite, allow_hyphen_values = true)]
    degree: Vec<f64>,
    /// Degree of the timing; the shape's without it
    #[arg(long, value_parser = finite, allow_hyphen_values = true)]
    timing: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

/// From the bottom, as the paper draws it: the mean, the original and its caricatures.
pub fn caricature(args: &CaricatureArgs) -> Result<()> {
    let space = read_space(&args.space)?;
    let (mean, own) = (space.mean(), motion(&space, &args.of)?);
    let of = |degree: f64| manipulate::caricature(&mean, &own, degree, args.timing.unwrap_or(degree));
    let names = numbered(&args.degree)?;
    let mut rows: Vec<Made> = args
        .degree
        .iter()
        .zip(names)
        .map(|(d, name)| made(format!("caricature_{name}"), format!("caricature {d}"), of(*d)))
        .rev()
        .collect();
    rows.push(made("original", "original", own.clone()));
    rows.push(made("mean", "mean", mean.clone()));
    args.output.write(&space, &rows)
}

#[derive(Args)]
pub struct VaryArgs {
    /// Space (.npz)
    space: PathBuf,
    /// Motion to vary: `mean`, a name of the space, or a motion file
    #[arg(long, default_value = "mean")]
    of: String,
    /// People
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=1000))]
    count: u16,
    /// How different, as a part of the examples' own spread
    #[arg(long, default_value_t = 0.7, value_parser = super::super::positive)]
    spread: f64,
    /// Another number gives other people
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    output: OutputArgs,
}

pub fn vary(args: &VaryArgs) -> Result<()> {
    let space = read_space(&args.space)?;
    let base = motion(&space, &args.of)?;
    let people: Vec<Vectors> = manipulate::vary(&space, &base, args.spread, args.count.into(), args.seed);
    let digits = args.count.to_string().len();
    let rows: Vec<Made> =
        people.into_iter().enumerate().map(|(i, v)| made(format!("person_{:0digits$}", i + 1), format!("person {}", i + 1), v)).collect();
    args.output.write(&space, &rows)
}

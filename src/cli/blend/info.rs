//! `muybridge blend info`: a space in words, numbers and pictures.
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;
use muybridge::io::space_npz::read_space;
use muybridge::io::write_atomic;
use muybridge::math::pca::{Pca, components};
use muybridge::style::space::attributes::{direction, spread};
use muybridge::style::space::manipulate::eigenmotion;
use muybridge::style::space::{Method, Space};

use super::super::whole;
use super::{Made, made, save_strip};

/// Eigenmotions shown, and how far from the mean in standard deviations.
const SHOWN: usize = 3;
const AMOUNT: f64 = 2.0;
/// Attributes shown low and high; more make a picture nobody can read.
const SHOWN_ATTRIBUTES: usize = 6;

#[derive(Args)]
pub struct InfoArgs {
    /// Space (.npz)
    space: PathBuf,
    /// Folder for eigenmotions.png, attributes.png and members.csv
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

pub fn run(args: &InfoArgs) -> Result<()> {
    let space = read_space(&args.space)?;
    print!("{}", description(&args.space, &space));
    let Some(folder) = &args.output else { return Ok(()) };
    let partial = whole::beside(folder)?;
    save_strip(&partial.path().join("eigenmotions.png"), &space, &eigenmotions(&space))?;
    save_strip(&partial.path().join("attributes.png"), &space, &attributes(&space))?;
    write_atomic(&partial.path().join("members.csv"), members(&space).as_bytes()).with_context(|| folder.display().to_string())?;
    whole::publish(partial, folder)?;
    println!("written: {}", folder.display());
    Ok(())
}

/// The mean, and the mean with each of the first eigenmotions of shape taken off and added.
fn eigenmotions(space: &Space) -> Vec<Made> {
    let of = |k: usize, amount: f64| {
        let label = format!("mean {} {} s.d. of e{}", if amount < 0.0 { "-" } else { "+" }, amount.abs(), k + 1);
        eigenmotion(space, Some(k), None, amount).map(|v| made("", label, v))
    };
    let pairs = (0..SHOWN).flat_map(|k| [of(k, -AMOUNT), of(k, AMOUNT)]).flatten();
    std::iter::once(made("", "mean", space.mean())).chain(pairs).collect()
}

/// The mean with each attribute low and high; the others are held where that can be told from the labels.
fn attributes(space: &Space) -> Vec<Made> {
    let all: Vec<usize> = (0..space.attributes.len()).collect();
    let mut rows = Vec::new();
    for (k, attribute) in space.attributes.iter().enumerate().take(SHOWN_ATTRIBUTES) {
        let found = direction(space, k, Method::Joint, &all).or_else(|_| direction(space, k, Method::Slope, &[]));
        let Ok(vectors) = found else { continue };
        let amount = AMOUNT * spread(attribute).1;
        for (word, amount) in [("low", -amount), ("high", amount)] {
            rows.push(made("", format!("{} {word}", attribute.name), space.mean().plus(&vectors, amount, amount)));
        }
    }
    rows
}

pub fn description(path: &Path, space: &Space) -> String {
    let kind = space.activity.map_or("whole clips".into(), |a| a.to_string());
    let layout = space.layout;
    let timing = if layout.per_curve { "a timing for each curve" } else { "one timing for all curves" };
    let mut text = format!(
        "{}: {} motions ({kind}), {} intervals, {timing}, warped to {}\n",
        path.display(),
        space.members.len(),
        layout.intervals,
        space.members[space.reference].name
    );
    for (name, pca) in [("shape", &space.shape), ("timing", &space.timing)] {
        let _ = writeln!(text, "  {name}: {}", variance(pca));
    }
    for attribute in &space.attributes {
        let (mean, deviation, labelled) = spread(attribute);
        let _ = writeln!(text, "  attribute {}: {labelled} labels, mean {mean:.3}, standard deviation {deviation:.3}", attribute.name);
    }
    for (name, members) in by_file(space) {
        let each =
            |f: &dyn Fn(usize) -> f64| members.iter().map(|&m| f(m)).fold((f64::MAX, f64::MIN), |(lo, hi), v| (lo.min(v), hi.max(v)));
        let (fast, slow) = each(&|m| space.play(&space.members[m].vectors).duration_s());
        let (near, far) = each(&|m| space.distance_from_mean(&space.members[m].vectors).0);
        let count = members.len();
        let _ = if count == 1 {
            writeln!(text, "  {name}: {fast:.2} s, {near:.1} degrees from the mean")
        } else {
            writeln!(text, "  {name}: {count} motions of {fast:.2} to {slow:.2} s, {near:.1} to {far:.1} degrees from the mean")
        };
    }
    text
}

/// Members of each file, whose names differ by their number only.
fn by_file(space: &Space) -> Vec<(&str, Vec<usize>)> {
    let mut files: Vec<(&str, Vec<usize>)> = Vec::new();
    for (i, member) in space.members.iter().enumerate() {
        let name = member.name.rsplit_once('#').map_or(member.name.as_str(), |(file, _)| file);
        match files.last_mut().filter(|f| f.0 == name) {
            Some((_, members)) => members.push(i),
            None => files.push((name, vec![i])),
        }
    }
    files
}

fn variance(pca: &Pca) -> String {
    let total: f64 = pca.eigenvalues.iter().sum();
    if total <= 0.0 {
        return "all alike".into();
    }
    let parts: Vec<String> = pca.eigenvalues.iter().take(5).map(|l| format!("{:.0}", 100.0 * l / total)).collect();
    let counts = [0.90, 0.95].map(|v| format!("{} eigenmotions hold {v:.2}", components(&pca.eigenvalues, v))).join(", ");
    format!("{counts}; the first {} %", parts.join(", "))
}

/// Labels and the first eigenweights, in standard deviations, of all members.
fn members(space: &Space) -> String {
    let names = space.attributes.iter().map(|a| a.name.replace(',', ";"));
    let counts = [space.shape.basis.ncols().min(10), space.timing.basis.ncols().min(10)];
    let weights = (0..counts[0]).map(|k| format!("shape_{}", k + 1)).chain((0..counts[1]).map(|k| format!("timing_{}", k + 1)));
    let columns: Vec<String> = ["motion".into(), "source".into()].into_iter().chain(names).chain(weights).collect();
    let mut text = columns.join(",") + "\n";
    for (i, member) in space.members.iter().enumerate() {
        let mut cells = vec![member.name.replace(',', ";"), member.source.replace(',', ";")];
        cells.extend(space.attributes.iter().map(|a| a.labels[i].map_or(String::new(), |l| format!("{l:.4}"))));
        for (pca, x, count) in [(&space.shape, &member.vectors.shape, counts[0]), (&space.timing, &member.vectors.timing, counts[1])] {
            let change = x - &pca.mean;
            cells.extend((0..count).map(|k| format!("{:.3}", pca.basis.column(k).dot(&change) / pca.eigenvalues[k].sqrt())));
        }
        text += &(cells.join(",") + "\n");
    }
    text
}

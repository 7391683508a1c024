//! `muybridge blend`: a vector space of motions, and what can be made in it.
mod build;
mod change;
mod info;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use muybridge::body::Shape;
use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::{bvh, is_motion_file, read_clip, write_atomic};
use muybridge::motion_model::Activity;
use muybridge::report;
use muybridge::report::strips::{FROM_THE_FRONT_RIGHT, Phases, Strip, strips};
use muybridge::style::space::{Example, Space, Vectors, measure};

use super::generate::HIP_OF_STATURE;
use super::motions::read_recordings;
use super::whole;

/// Figures in a row of a strip.
const FIGURES: usize = 8;

#[derive(Subcommand)]
pub enum BlendCommand {
    /// A space from motions that do the same things: time warp, shape and timing vectors, attributes
    Build(build::BuildArgs),
    /// What a space holds, with strips of its eigenmotions and attributes
    Info(info::InfoArgs),
    /// A motion from parts of others, shape and timing apart
    Mix(change::MixArgs),
    /// Less or more of an attribute, or a motion with wanted attributes
    Attribute(change::AttributeArgs),
    /// What is one's own, exaggerated or played down
    Caricature(change::CaricatureArgs),
    /// Similar but different people, for crowds
    Vary(change::VaryArgs),
}

pub fn run(command: BlendCommand) -> Result<()> {
    match command {
        BlendCommand::Build(args) => build::run(&args),
        BlendCommand::Info(args) => info::run(&args),
        BlendCommand::Mix(args) => change::mix(&args),
        BlendCommand::Attribute(args) => change::attribute(&args),
        BlendCommand::Caricature(args) => change::caricature(&args),
        BlendCommand::Vary(args) => change::vary(&args),
    }
}

/// Where the motions go and how they are played.
#[derive(Args)]
struct OutputArgs {
    /// Folder for the motions (BVH), their strip (strip.png) and what was measured of them (motions.csv)
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Cycles per motion; open motions are played once
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..))]
    cycles: u16,
    /// Frames per second
    #[arg(long, default_value_t = 60.0, value_parser = super::positive)]
    fps: f64,
    /// Stature in metres of the body that moves; the mean of the space's without it
    #[arg(long, value_parser = super::positive)]
    height: Option<f64>,
}

/// A motion to be written: file name without ending, label in the strip.
struct Made {
    name: String,
    label: String,
    vectors: Vectors,
}

fn made(name: impl Into<String>, label: impl Into<String>, vectors: Vectors) -> Made {
    Made { name: name.into(), label: label.into(), vectors }
}

impl OutputArgs {
    /// Writes one BVH per motion, the strip of all in this order, and the table.
    fn write(&self, space: &Space, motions: &[Made]) -> Result<()> {
        let shape = Shape::template(self.height.unwrap_or(space.hip_height_m() / HIP_OF_STATURE));
        let (offsets, hip_height_m) = (shape.offsets(), shape.hip_height_m());
        let partial = whole::beside(&self.output)?;
        let mut table = String::from("file,duration_s,speed_m_s,from_mean_shape_deg,from_mean_timing_s,right_hand_height,energy_j_kg\n");
        for motion in motions {
            let blend = space.play(&motion.vectors);
            let clip = blend.clip(&offsets, hip_height_m, self.fps, self.cycles.into());
            let file = format!("{}.bvh", motion.name);
            bvh::write_clip(&partial.path().join(&file), &clip, None)?;
            let (shape_deg, timing_s) = space.distance_from_mean(&motion.vectors);
            let [hand, energy] = measure::measure(&blend);
            let (duration_s, speed) = (blend.duration_s(), blend.speed_m_s(hip_height_m));
            let _ = writeln!(table, "{file},{duration_s:.4},{speed:.4},{shape_deg:.3},{timing_s:.4},{hand:.4},{energy:.4}");
            println!(
                "{}: {duration_s:.2} s, {shape_deg:.1} degrees from the mean, right hand at {hand:.2} hip heights, energy {energy:.2} J/kg",
                self.output.join(&file).display()
            );
        }
        save_strip(&partial.path().join("strip.png"), space, motions)?;
        let path = partial.path().join("motions.csv");
        write_atomic(&path, table.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
        whole::publish(partial, &self.output)
    }
}

/// One cycle, or the whole, of every motion.
fn save_strip(path: &Path, space: &Space, motions: &[Made]) -> Result<()> {
    let shape = Shape::template(space.hip_height_m() / HIP_OF_STATURE);
    // Whole frames at both ends, fine enough for any instant.
    let play = |m: &Made| {
        let blend = space.play(&m.vectors);
        (blend.clip(&shape.offsets(), shape.hip_height_m(), 100.0 / blend.duration_s(), 1), blend)
    };
    let played: Vec<_> = motions.iter().map(play).collect();
    let mut rows = Vec::new();
    for (m, (clip, blend)) in motions.iter().zip(&played) {
        let made = Phases { clip, cycle_s: blend.duration_s() };
        rows.push(Strip { label: m.label.clone(), made, below: None, cyclic: blend.is_cyclic() });
    }
    let picture = strips(&rows, FIGURES, FROM_THE_FRONT_RIGHT, "")?.picture()?;
    Ok(report::save(path, &picture)?)
}

/// The examples of one motion file: its cycles or jumps, or the whole of it.
fn examples_of(entry: &Entry, name: &str, activity: Option<Activity>) -> Result<Vec<Example>, String> {
    let Some(activity) = activity else {
        let mut clip = read_clip(&entry.path).map_err(|e| e.to_string())?.clip;
        let frame = |time_s: f64| ((time_s * clip.fps).round() as usize).min(clip.poses.len());
        let range = entry.start_s.map_or(0, frame)..entry.end_s.map_or(clip.poses.len(), |t| (frame(t) + 1).min(clip.poses.len()));
        clip.poses = clip.poses.get(range).unwrap_or_default().to_vec();
        return Example::of_clip(name, &clip).map(|e| vec![e]).ok_or(format!("{}: no frames in the part to use", entry.path.display()));
    };
    let found = read_recordings(std::slice::from_ref(entry), activity);
    found.left_out.iter().for_each(|line| eprintln!("left out: {line}"));
    let many = found.cycles.len() > 1;
    let numbered = |i: usize| if many { format!("{name}#{}", i + 1) } else { name.to_string() };
    Ok(found.cycles.iter().enumerate().map(|(i, cycle)| Example::of_cycle(&numbered(i), cycle)).collect())
}

/// The mean of the space, a motion of it by name, or a motion file.
fn motion(space: &Space, text: &str) -> Result<Vectors> {
    if text == "mean" {
        return Ok(space.mean());
    }
    let unknown = match space.members_called(text) {
        Ok(members) => {
            let weights: Vec<(usize, f64)> = members.into_iter().map(|m| (m, 1.0)).collect();
            return Ok(space.mix(&weights, &weights)?);
        }
        Err(unknown) => unknown,
    };
    let path = PathBuf::from(text);
    if !is_motion_file(&path) {
        return Err(unknown.into());
    }
    let mut all = Vec::new();
    for entry in find_motions(&[path], None)? {
        for example in examples_of(&entry, text, space.activity).map_err(anyhow::Error::msg)? {
            all.push(space.project(&example)?);
        }
    }
    if all.is_empty() {
        bail!("{text} shows no motion of the space's kind");
    }
    let share = 1.0 / all.len() as f64;
    Ok(Vectors::sum(&space.mean(), all.iter().map(|v| (share, v))))
}

/// `NAME=NUMBER`.
fn named_number(text: &str) -> Result<(String, f64), String> {
    let (name, number) = text.rsplit_once('=').ok_or("must be NAME=NUMBER")?;
    let number = number.trim().parse().ok().filter(|v: &f64| v.is_finite()).ok_or(format!("`{number}` is not a number"))?;
    Ok((name.trim().to_string(), number))
}

fn finite(text: &str) -> Result<f64, String> {
    text.trim().parse().ok().filter(|v: &f64| v.is_finite()).ok_or("must be a number".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_names_with_numbers() {
        assert_eq!(named_number("walk#2=0.5"), Ok(("walk#2".into(), 0.5)));
        assert_eq!(named_number("a=b=-1"), Ok(("a=b".into(), -1.0)));
        assert!(named_number("walk").is_err() && named_number("walk=fast").is_err() && named_number("walk=nan").is_err());
        assert!(finite("inf").is_err() && finite(" -2").is_ok());
    }
}

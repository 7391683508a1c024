//! `muybridge blend build`: motions to a space.
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use muybridge::io::labels_csv::{Labels, read_labels};
use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::space_npz::write_space;
use muybridge::motion_model::Activity;
use muybridge::style::space::{Attribute, Example, Options, Space};
use rayon::prelude::*;

use super::super::motions::{exclude, file_name};
use super::{examples_of, info};

/// Knots per second of whole clips, unless the user says how many.
const KNOTS_PER_S: f64 = 30.0;

#[derive(Clone, Copy, ValueEnum)]
enum Cut {
    /// Gait cycles between heel strikes
    Walking,
    Running,
    /// Single jumps
    Jumping,
    /// Every clip as it is, from its first frame to its last
    Whole,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Timing {
    /// One for all joints
    Common,
    /// One for each curve
    PerCurve,
}

#[derive(Args)]
pub struct BuildArgs {
    /// Motion files (.bvh, .amc, .mot, .c3d, .trc) or folders, searched to the bottom
    #[arg(required = true, value_name = "MOTIONS")]
    inputs: Vec<PathBuf>,
    /// Table of attributes: a column `file`, the others numbers; hand-height (the right one) and energy are measured without it
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    /// Table of the files: file,subject,activity,speed_m_s or length_m,start_s,end_s
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// Subject or trial to leave out; repeat for several
    #[arg(long, value_name = "SUBJECT or TRIAL")]
    exclude: Vec<String>,
    /// What to cut the motions into
    #[arg(long, default_value = "walking")]
    activity: Cut,
    #[arg(long, default_value = "common")]
    timing: Timing,
    /// Intervals between knots of the reference; 100 for cycles and jumps, 30 a second for whole clips
    #[arg(long, value_parser = clap::value_parser!(u16).range(8..=1000))]
    knots: Option<u16>,
    /// Motion to warp the others to, by name; the one nearest to all without it
    #[arg(long, value_name = "NAME")]
    reference: Option<String>,
    /// Space to write (.npz)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

pub fn run(args: &BuildArgs) -> Result<()> {
    let activity = match args.activity {
        Cut::Walking => Some(Activity::Walking),
        Cut::Running => Some(Activity::Running),
        Cut::Jumping => Some(Activity::Jumping),
        Cut::Whole => None,
    };
    let labels = args.labels.as_deref().map(read_labels).transpose()?;
    let entries = exclude(find_motions(&args.inputs, args.manifest.as_deref())?, &args.exclude)?;
    let (examples, files) = read_examples(&entries, activity);
    if examples.len() < 2 {
        bail!(
            "{} of {} files hold motions of this kind, {} in all; a space needs at least two",
            files.len(),
            entries.len(),
            examples.len()
        );
    }
    let longest_s = examples.iter().map(|e| e.duration_s).fold(0.0, f64::max);
    let of_time = activity.is_none().then(|| ((longest_s * KNOTS_PER_S).ceil() as usize).clamp(8, 1000));
    let options = Options {
        activity,
        intervals: args.knots.map(usize::from).or(of_time),
        per_curve: args.timing == Timing::PerCurve,
        reference: args.reference.clone(),
    };
    let mut space = Space::build(&examples, &options)?;
    if let (Some(labels), Some(path)) = (labels, &args.labels) {
        add_labels(&mut space, &labels, path, &files)?;
    }
    write_space(&args.output, &space)?;
    print!("{}", info::description(&args.output, &space));
    Ok(())
}

/// Examples of all files, and for each file its name and its examples' names.
type Named = Vec<(String, Vec<String>)>;

fn read_examples(entries: &[Entry], activity: Option<Activity>) -> (Vec<Example>, Named) {
    let stem = |e: &Entry| e.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let name = |i: usize| {
        let own = stem(&entries[i]);
        let twice = entries.iter().enumerate().any(|(k, e)| k != i && e.path != entries[i].path && stem(e) == own);
        let earlier = entries[..i].iter().filter(|e| e.path == entries[i].path).count();
        let own = if twice { format!("{}/{own}", entries[i].subject) } else { own };
        if earlier > 0 { format!("{own}-{}", earlier + 1) } else { own }
    };
    let read: Vec<_> = (0..entries.len()).into_par_iter().map(|i| examples_of(&entries[i], &name(i), activity)).collect();
    let (mut examples, mut files) = (Vec::new(), Named::new());
    for (entry, found) in entries.iter().zip(read) {
        match found {
            Ok(found) if found.is_empty() => {}
            Ok(found) => {
                files.push((file_name(&entry.path), found.iter().map(|e| e.name.clone()).collect()));
                examples.extend(found);
            }
            Err(reason) => eprintln!("left out: {reason}"),
        }
    }
    (examples, files)
}

/// Labels of the members; a row that names none of them is an error.
fn add_labels(space: &mut Space, labels: &Labels, path: &Path, files: &Named) -> Result<()> {
    let file_of = |member: &str| files.iter().find(|(_, names)| names.iter().any(|n| n == member)).map_or("", |(file, _)| file.as_str());
    let rows: Vec<_> = space.members.iter().map(|m| labels.of(&m.name, file_of(&m.name))).collect();
    for row in &labels.rows {
        if !rows.iter().flatten().any(|used| used.line == row.line) {
            bail!("{} line {}: `{}` is no motion of the space; it may have been left out above", path.display(), row.line, row.motion);
        }
    }
    for (k, name) in labels.attributes.iter().enumerate() {
        let of_members = rows.iter().map(|row| row.and_then(|r| r.values[k])).collect();
        space.set_attribute(Attribute { name: name.clone(), labels: of_members });
    }
    Ok(())
}

//! Motion files to cycles, for the commands that take recordings.
use std::path::Path;

use anyhow::{Result, bail};
use clap::ValueEnum;
use muybridge::io::manifest::Entry;
use muybridge::io::read_clip;
use muybridge::math::order::quantile;
use muybridge::motion_model::{Activity, Cycle, Label, segment};
use rayon::prelude::*;

#[derive(Clone, Copy, ValueEnum)]
pub enum ActivityName {
    Walking,
    Running,
    Jumping,
}

impl From<ActivityName> for Activity {
    fn from(name: ActivityName) -> Activity {
        match name {
            ActivityName::Walking => Activity::Walking,
            ActivityName::Running => Activity::Running,
            ActivityName::Jumping => Activity::Jumping,
        }
    }
}

/// Cycles found, and one line for everything that was left out.
#[derive(Default)]
pub struct Recordings {
    pub cycles: Vec<Cycle>,
    pub files: usize,
    pub left_out: Vec<String>,
    /// One line of [`TABLE`] per motion.
    pub table: Vec<String>,
}

/// Columns of [`Recordings::table`].
pub const TABLE: &str = "file,subject,cycles,speed_m_s_or_length_m,cycle_s,hip_height_m,left_out";

impl Recordings {
    /// The end of an error message where nothing was of use.
    pub fn first_reason(&self) -> String {
        match &self.left_out[..] {
            [] => String::new(),
            [only] => format!("; {only}"),
            [first, others @ ..] => format!("; {first}; and {} more", others.len()),
        }
    }
}

/// Reads and cuts all entries of one activity; files that cannot be used are listed, the others go on.
pub fn read_recordings(entries: &[Entry], activity: Activity) -> Recordings {
    let read: Vec<_> = entries.par_iter().map(|e| cycles_of(e, activity)).collect();
    let mut recordings = Recordings::default();
    for (entry, result) in entries.iter().zip(read) {
        recordings.table.push(table_row(entry, &result));
        match result {
            Ok((cycles, rejected)) => {
                recordings.files += usize::from(!cycles.is_empty());
                recordings.cycles.extend(cycles);
                recordings.left_out.extend(rejected);
            }
            Err(reason) => recordings.left_out.push(format!("{}: {reason}", entry.path.display())),
        }
    }
    recordings
}

/// Medians over the cycles of one motion.
fn table_row(entry: &Entry, found: &Result<(Vec<Cycle>, Vec<String>), String>) -> String {
    let cell = |text: &str| text.replace([',', '\n'], ";");
    let (cycles, reasons) = match found {
        Ok((cycles, rejected)) => (&cycles[..], rejected.join("; ")),
        Err(reason) => (&[][..], reason.clone()),
    };
    let median = |of: fn(&Cycle) -> f64| quantile(cycles.iter().map(of).collect(), 0.5).map_or(String::new(), |v| format!("{v:.3}"));
    let medians = [median(|c| c.parameter), median(|c| c.duration_s), median(|c| c.hip_height_m)].join(",");
    format!("{},{},{},{medians},{}", cell(&entry.path.display().to_string()), cell(&entry.subject), cycles.len(), cell(&reasons))
}

fn cycles_of(entry: &Entry, activity: Activity) -> Result<(Vec<Cycle>, Vec<String>), String> {
    if let Some(other) = entry.activity
        && other != activity
    {
        return Err(format!("is {other}, not {activity}"));
    }
    let path = entry.path.display().to_string();
    // Readers name the file themselves; it is named once.
    let unnamed =
        |error: String| error.trim_start_matches(&format!("{path}: ")).replace(&format!("cannot read {path}: "), "cannot be read: ");
    let read = read_clip(&entry.path).map_err(|e| unnamed(e.to_string()))?;
    let label = Label {
        subject: entry.subject.clone(),
        source: file_name(&entry.path),
        activity,
        parameter: entry.parameter,
        start_s: entry.start_s,
        end_s: entry.end_s,
    };
    let segments = segment(&read.clip, &label).map_err(|e| e.to_string())?;
    Ok((segments.cycles, segments.rejected))
}

pub fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Drops the entries of excluded subjects and trials; an exclusion that matches nothing is an error.
pub fn exclude(entries: Vec<Entry>, excluded: &[String]) -> Result<Vec<Entry>> {
    let trial = |e: &Entry| e.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let matches = |e: &Entry, name: &String| *name == e.subject || *name == trial(e) || *name == file_name(&e.path);
    for name in excluded {
        if !entries.iter().any(|e| matches(e, name)) {
            bail!("--exclude {name} matches no subject and no trial");
        }
    }
    Ok(entries.into_iter().filter(|e| !excluded.iter().any(|name| matches(e, name))).collect())
}

//! Cycles and speeds found in every shared trial against those that another program found (TABLE.csv beside the data).

use std::path::{Path, PathBuf};

use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::read_clip;
use muybridge::motion_model::{Activity, Label, segment};
use rayon::prelude::*;

/// A row of TABLE.csv, in our words.
struct Expected {
    trial: String,
    activity: Activity,
    speed_m_s: f64,
    strides: usize,
}

fn expected(data: &Path) -> Vec<Expected> {
    let text = std::fs::read_to_string(data.join("TABLE.csv")).unwrap();
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        let activity = match cells[3] {
            kind if kind.contains("jump") => Activity::Jumping,
            kind if kind.contains("run") => Activity::Running,
            kind if kind.contains("walk") => Activity::Walking,
            _ => return None,
        };
        Some(Expected { trial: cells[2].into(), activity, speed_m_s: cells[4].parse().unwrap(), strides: cells[5].parse().unwrap() })
    };
    text.lines().skip(1).filter_map(row).collect()
}

/// Trial as TABLE.csv names it.
fn trial_of(entry: &Entry) -> String {
    let stem = entry.path.file_stem().unwrap().to_string_lossy().into_owned();
    if stem.starts_with("Run_") { format!("{}/{stem}", entry.subject) } else { stem }
}

#[test]
fn cycles_and_speeds_of_every_shared_trial() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap");
    if !data.is_dir() {
        println!("skipped: no ../shared/data/mocap");
        return;
    }
    let folders: Vec<PathBuf> = ["cmu-asfamc", "cmu-bvh", "hamner-running", "schreiber-walking", "bandai-namco-1"].iter().map(|f| data.join(f)).collect();
    let entries = find_motions(&folders, None).unwrap();
    let lines: Vec<String> = expected(&data).par_iter().map(|e| {
        let Some(entry) = entries.iter().find(|x| trial_of(x).ends_with(&e.trial) || e.trial.ends_with(&trial_of(x))) else {
            return format!("{:<32} {:<8} not there", e.trial, e.activity);
        };
        let found = read_clip(&entry.path).map_err(|e| e.to_string()).and_then(|read| {
            let label = Label { subject: entry.subject.clone(), source: e.trial.clone(), activity: e.activity, parameter: entry.parameter, start_s: None, end_s: None };
            segment(&read.clip, &label).map_err(|e| e.to_string())
        });
        match found {
            Err(why) => format!("{:<32} {:<8} {:>2} strides: {why}", e.trial, e.activity, e.strides),
            Ok(s) => {
                let mut v: Vec<f64> = s.cycles.iter().map(|c| c.parameter).collect();
                v.sort_by(f64::total_cmp);
                let median = v.get(v.len() / 2).copied().unwrap_or(f64::NAN);
                format!("{:<32} {:<8} {:>2} of {:>2} strides, {median:.2} for {:.2} m/s; {:?}", e.trial, e.activity, v.len(), e.strides, e.speed_m_s, s.rejected)
            }
        }
    }).collect();
    println!("{}", lines.join("\n"));
}

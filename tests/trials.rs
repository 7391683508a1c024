//! Cycles and speeds found in every shared trial against those that another program found (TABLE.csv beside the data).

use std::path::{Path, PathBuf};

use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::read_clip;
use muybridge::motion_model::{Activity, Label, segment};
use rayon::prelude::*;

/// A row of TABLE.csv, in our words.
struct Expected {
    /// Folder of the data set.
    folder: &'static str,
    subject: String,
    trial: String,
    activity: Activity,
    speed_m_s: f64,
    strides: usize,
}

const SETS: [(&str, &str); 5] = [
    ("cmu-asfamc-walk", "cmu-asfamc"),
    ("cmu-bvh-przestr", "cmu-bvh"),
    ("hamner-delp-2013-running", "hamner-running"),
    ("schreiber-moissenet-2019-walking", "schreiber-walking"),
    ("bandai-namco-1", "bandai-namco-1"),
];

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
        let (_, folder) = SETS.iter().find(|s| s.0 == cells[0])?;
        let (subject, trial) = (cells[1].to_string(), cells[2].to_string());
        Some(Expected { folder, subject, trial, activity, speed_m_s: cells[4].parse().unwrap(), strides: cells[5].parse().unwrap() })
    };
    text.lines().skip(1).filter_map(row).collect()
}

/// Cycles and mean speed, or why there are none.
type Found = Result<(usize, f64), String>;

/// What our program finds: cycles and their median speed, or why none.
fn found(entries: &[Entry], e: &Expected) -> Found {
    let is_it = |x: &&Entry| {
        let path = x.path.to_string_lossy();
        path.contains(e.folder)
            && x.path.file_stem().is_some_and(|s| s.to_string_lossy() == e.trial)
            && (e.folder != "hamner-running" || path.contains(&e.subject))
    };
    let entry = entries.iter().find(is_it).ok_or("not there")?;
    let read = read_clip(&entry.path).map_err(|e| e.to_string())?;
    let label = Label {
        subject: entry.subject.clone(),
        source: e.trial.clone(),
        activity: e.activity,
        parameter: entry.parameter,
        start_s: entry.start_s,
        end_s: entry.end_s,
    };
    let cycles = segment(&read.clip, &label).map_err(|e| e.to_string())?.cycles;
    let mut speeds: Vec<f64> = cycles.iter().map(|c| c.parameter).collect();
    speeds.sort_by(f64::total_cmp);
    Ok((speeds.len(), speeds.get(speeds.len() / 2).copied().unwrap_or(f64::NAN)))
}

#[test]
fn cycles_and_speeds_of_every_shared_trial() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap");
    if !data.is_dir() {
        println!("skipped: no ../shared/data/mocap");
        return;
    }
    let folders: Vec<PathBuf> = SETS.iter().map(|s| data.join(s.1)).collect();
    let entries = find_motions(&folders, None).unwrap();
    let rows: Vec<(Expected, Found)> = expected(&data).into_par_iter().map(|e| (found(&entries, &e), e)).map(|(f, e)| (e, f)).collect();
    for (e, found) in &rows {
        let what = match found {
            Ok((cycles, speed)) => format!("{cycles:>2} {speed:>6.2}"),
            Err(why) => why.clone(),
        };
        println!("{:<18} {:<12} {:<32} {:<8} {:>2} {:>5.2} | {what}", e.folder, e.subject, e.trial, e.activity, e.strides, e.speed_m_s);
    }
    for (folder, activity, least) in LEAST {
        let of_set: Vec<_> = rows.iter().filter(|(e, _)| e.folder == folder && e.activity == activity).collect();
        let with: Vec<_> = of_set.iter().filter_map(|(e, f)| Some((e, f.as_ref().ok().filter(|f| f.0 > 0)?))).collect();
        let near = with.iter().filter(|(e, f)| (f.1 / e.speed_m_s - 1.0).abs() < 0.1).count();
        println!("{folder} {activity}: {} of {} trials with cycles, {near} within 10 % of the speed", with.len(), of_set.len());
        // Turning walkers and the like differ: their median is over all frames, ours over the steady strides.
        assert!(with.len() >= least && (activity == Activity::Jumping || near * 10 >= with.len() * 9), "{folder} {activity}");
    }
}

/// Trials of a set that must give cycles.
const LEAST: [(&str, Activity, usize); 7] = [
    ("cmu-asfamc", Activity::Walking, 68),
    ("cmu-bvh", Activity::Walking, 5),
    ("cmu-bvh", Activity::Running, 8),
    ("cmu-bvh", Activity::Jumping, 9),
    ("hamner-running", Activity::Running, 28),
    ("schreiber-walking", Activity::Walking, 18),
    ("bandai-namco-1", Activity::Walking, 29),
];

//! Which motion files make a database: folders searched, and `subjects.csv` that says what the files hold.
//!
//! Columns `file,subject,activity,speed_m_s,length_m,start_s,end_s` in any order, all but `file` optional, empty cells
//! allowed; `file` is relative to the manifest, and below its folder in a manifest that was found there and not named.
//! A file may have several rows. A `subjects.csv` found in a folder stands for
//! the whole folder: only the files it lists are used. A trial that lies in one folder as C3D and as TRC counts once.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path, PathBuf};

use super::is_motion_file;
use super::outputs_json::Outputs;
use crate::motion_model::Activity;

const MANIFEST: &str = "subjects.csv";

/// One motion, or part of one.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    pub path: PathBuf,
    /// As the manifest says, else the name of the file's folder; folders named after the file or after what they hold
    /// (`dynamic`, `ik`) are passed over.
    pub subject: String,
    pub activity: Option<Activity>,
    /// Speed in m/s or length in m.
    pub parameter: Option<f64>,
    pub start_s: Option<f64>,
    pub end_s: Option<f64>,
}

#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path} line 1 names no column `file`")]
    NoFileColumn { path: PathBuf },
    #[error("{path} line 1: unknown column `{column}`; known are file, subject, activity, speed_m_s, length_m, start_s, end_s")]
    Column { path: PathBuf, column: String },
    #[error("{path} line {line}: {why}")]
    Row { path: PathBuf, line: usize, why: String },
    #[error("no motion file (.amc, .bvh, .c3d, .mot, .sto, .trc) in {path}")]
    Nothing { path: PathBuf },
}

/// All motions of files and folders; `manifest` is used in place of a search where it is given.
pub fn find_motions(inputs: &[PathBuf], manifest: Option<&Path>) -> Result<Vec<Entry>, ManifestError> {
    if let Some(path) = manifest {
        return read_manifest(path);
    }
    let mut entries = Vec::new();
    for input in inputs {
        let before = entries.len();
        search(input, &mut entries, &mut BTreeSet::new())?;
        if entries.len() == before {
            return Err(ManifestError::Nothing { path: input.clone() });
        }
    }
    Ok(entries)
}

fn search(path: &Path, entries: &mut Vec<Entry>, seen: &mut BTreeSet<PathBuf>) -> Result<(), ManifestError> {
    let failed = |cause| ManifestError::Read { path: path.to_path_buf(), cause };
    if !fs::metadata(path).map_err(failed)?.is_dir() {
        entries.push(plain(path));
        return Ok(());
    }
    // Folders are entered once, so that a symbolic link to a parent ends.
    if !seen.insert(fs::canonicalize(path).map_err(failed)?) {
        return Ok(());
    }
    if path.join(MANIFEST).is_file() {
        entries.extend(read_rows(&path.join(MANIFEST), true)?);
        return Ok(());
    }
    let mut children: Vec<PathBuf> = fs::read_dir(path).map_err(failed)?.filter_map(|e| Some(e.ok()?.path())).collect();
    children.sort_by(|a, b| natord::compare(&a.to_string_lossy(), &b.to_string_lossy()).then(a.cmp(b)));
    let twin = |child: &Path| is_kind(child, "trc") && children.iter().any(|c| is_kind(c, "c3d") && c.file_stem() == child.file_stem());
    // What this software wrote stands there in several formats: one of them is enough.
    let written = Outputs::of_folder(path);
    let is_copy = |child: &Path| child.file_name().is_some_and(|name| written.is_copy(&name.to_string_lossy()));
    for child in &children {
        if child.is_dir() || is_motion_file(child) && !twin(child) && !is_copy(child) {
            search(child, entries, seen)?;
        }
    }
    Ok(())
}

fn is_kind(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending))
}

/// Folders that say what they hold, not whose it is.
const KINDS: [&str; 16] =
    ["dynamic", "static", "ik", "expdata", "markers", "mocap", "trials", "data", "raw", "c3d", "trc", "mot", "bvh", "amc", "walk", "run"];

fn plain(path: &Path) -> Entry {
    Entry {
        path: path.to_path_buf(),
        subject: subject_of(path).unwrap_or_default(),
        activity: None,
        parameter: None,
        start_s: None,
        end_s: None,
    }
}

/// The nearest folder's name that can be a person's.
fn subject_of(path: &Path) -> Option<String> {
    let path = fs::canonicalize(path).ok()?;
    let stem = path.file_stem()?.to_string_lossy().into_owned();
    let folders: Vec<String> = path.parent()?.iter().rev().map(|f| f.to_string_lossy().into_owned()).collect();
    let is_person = |f: &&String| !KINDS.contains(&f.to_lowercase().as_str()) && !stem.starts_with(&format!("{f}_ik"));
    folders.iter().find(is_person).or(folders.first()).cloned()
}

/// The rows of a `subjects.csv`.
pub fn read_manifest(path: &Path) -> Result<Vec<Entry>, ManifestError> {
    read_rows(path, false)
}

/// `found`: in a folder, perhaps with data from elsewhere; its files must lie there.
fn read_rows(path: &Path, found: bool) -> Result<Vec<Entry>, ManifestError> {
    let text = fs::read_to_string(path).map_err(|cause| ManifestError::Read { path: path.to_path_buf(), cause })?;
    let mut lines = text.trim_start_matches('\u{feff}').lines();
    let columns: Vec<String> = cells(lines.next().unwrap_or_default());
    let known = ["file", "subject", "activity", "speed_m_s", "length_m", "start_s", "end_s"];
    if let Some(column) = columns.iter().find(|c| !known.contains(&c.as_str())) {
        return Err(ManifestError::Column { path: path.to_path_buf(), column: column.clone() });
    }
    if !columns.iter().any(|c| c == "file") {
        return Err(ManifestError::NoFileColumn { path: path.to_path_buf() });
    }
    let mut entries = Vec::new();
    for (i, line) in lines.enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let entry = row(path, found, &columns, &cells(line));
        entries.push(entry.map_err(|why| ManifestError::Row { path: path.to_path_buf(), line: i + 2, why })?);
    }
    Ok(entries)
}

fn cells(line: &str) -> Vec<String> {
    line.split(',').map(|c| c.trim().trim_matches('"').to_string()).collect()
}

fn row(manifest: &Path, found: bool, columns: &[String], cells: &[String]) -> Result<Entry, String> {
    if cells.len() > columns.len() {
        return Err(format!("has {} cells, the header {}", cells.len(), columns.len()));
    }
    let cell = |name: &str| {
        let at = columns.iter().position(|c| c == name)?;
        cells.get(at).filter(|c| !c.is_empty())
    };
    let number = |name: &str| -> Result<Option<f64>, String> {
        let parse = |c: &String| c.parse().ok().filter(|v: &f64| v.is_finite() && *v >= 0.0);
        cell(name).map(|c| parse(c).ok_or(format!("{name} is `{c}`, not a number from 0 on"))).transpose()
    };
    let file = cell("file").ok_or("names no file")?;
    if found && !Path::new(file).components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir)) {
        return Err(format!("`{file}` lies outside the manifest's folder; name the manifest with --manifest if that is meant"));
    }
    let path = manifest.parent().unwrap_or(Path::new("")).join(file);
    if !path.is_file() {
        return Err(format!("{} does not exist", path.display()));
    }
    let (start_s, end_s) = (number("start_s")?, number("end_s")?);
    if let (Some(start), Some(end)) = (start_s, end_s)
        && start >= end
    {
        return Err(format!("start_s {start} is not before end_s {end}"));
    }
    let found = plain(&path);
    Ok(Entry {
        subject: cell("subject").cloned().unwrap_or(found.subject.clone()),
        activity: cell("activity").map(|c| activity(c)).transpose()?,
        parameter: number("speed_m_s")?.or(number("length_m")?),
        start_s,
        end_s,
        ..found
    })
}

fn activity(name: &str) -> Result<Activity, String> {
    match name {
        "walking" => Ok(Activity::Walking),
        "running" => Ok(Activity::Running),
        "jumping" => Ok(Activity::Jumping),
        _ => Err(format!("activity is `{name}`; walking, running and jumping are known")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        folder
    }

    #[test]
    fn finds_files_in_natural_order_with_the_folder_as_subject() {
        let dir = folder(&[("12/a_10.bvh", ""), ("12/a_2.BVH", ""), ("9/x.amc", ""), ("9/x.asf", ""), ("9/notes.txt", "")]);
        let found = find_motions(&[dir.path().to_path_buf()], None).unwrap();
        let names: Vec<_> = found.iter().map(|e| (e.subject.as_str(), e.path.file_name().unwrap().to_str().unwrap())).collect();
        assert_eq!(names, [("9", "x.amc"), ("12", "a_2.BVH"), ("12", "a_10.bvh")]);
        let empty = folder(&[("notes.txt", "")]);
        assert!(matches!(find_motions(&[empty.path().to_path_buf()], None), Err(ManifestError::Nothing { .. })));
    }

    #[test]
    fn subjects_are_not_named_after_kinds_of_files_and_trials_count_once() {
        let dir = folder(&[("p7/dynamic/w.c3d", ""), ("p7/dynamic/w.trc", ""), ("p7/ik/C4/C4_ik.mot", ""), ("p8/x.trc", "")]);
        let found = find_motions(&[dir.path().to_path_buf()], None).unwrap();
        let names: Vec<_> = found.iter().map(|e| (e.subject.as_str(), e.path.file_name().unwrap().to_str().unwrap())).collect();
        assert_eq!(names, [("p7", "w.c3d"), ("p7", "C4_ik.mot"), ("p8", "x.trc")]);
    }

    #[test]
    fn a_manifest_stands_for_its_folder() {
        let rows = "file,subject,activity,speed_m_s,start_s,end_s\ns2/r.mot,s1,running,3.0,,\ns2/r.mot,,walking,,0.5,2\n";
        let dir = folder(&[("subjects.csv", rows), ("s2/r.mot", ""), ("s2/unlisted.mot", "")]);
        let found = find_motions(&[dir.path().to_path_buf()], None).unwrap();
        assert_eq!(found.len(), 2);
        assert_eq!((found[0].subject.as_str(), found[0].activity, found[0].parameter), ("s1", Some(Activity::Running), Some(3.0)));
        assert_eq!((found[1].subject.as_str(), found[1].start_s, found[1].end_s), ("s2", Some(0.5), Some(2.0)));
    }

    #[test]
    fn a_manifest_that_was_found_leads_nowhere_else_and_one_that_was_named_may() {
        let dir = folder(&[("w.bvh", ""), ("data/in/a.bvh", "")]);
        let data = dir.path().join("data");
        let outside = dir.path().join("w.bvh");
        for (file, inside) in [("../w.bvh", false), ("in/../../w.bvh", false), (outside.to_str().unwrap(), false), ("./in/a.bvh", true)] {
            fs::write(data.join(MANIFEST), format!("file\n{file}\n")).unwrap();
            let found = find_motions(std::slice::from_ref(&data), None).map_err(|e| e.to_string());
            assert_eq!(found.is_ok(), inside, "{file}: {found:?}");
            assert!(inside || found.unwrap_err().contains("line 2: ") && find_motions(&[], Some(&data.join(MANIFEST))).is_ok());
        }
    }

    #[test]
    fn errors_name_the_line() {
        let cases = [
            ("file,speed\nr.mot,1\n", "unknown column `speed`"),
            ("subject\nx\n", "no column `file`"),
            ("file,speed_m_s\n\nr.mot,fast\n", "line 3: speed_m_s is `fast`"),
            ("file\nmissing.bvh\n", "line 2"),
            ("file,start_s,end_s\nr.mot,2,1\n", "start_s 2 is not before end_s 1"),
            ("file,activity\nr.mot,hopping\n", "activity is `hopping`"),
        ];
        for (text, part) in cases {
            let dir = folder(&[("subjects.csv", text), ("r.mot", "")]);
            let error = read_manifest(&dir.path().join("subjects.csv")).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}

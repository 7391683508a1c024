//! `status.json`: where one session of a study stands. `summary.csv`: one row per session.
//!
//! The results folder of a batch holds, for a session at `group/walk_03` below the study:
//!
//! | path | content |
//! |---|---|
//! | `group/walk_03/` | what `muybridge track` writes, whole or not there, and `status.json` |
//! | `logs/group/walk_03.log` | what the last run said; locked while it runs |
//! | `summary.csv` | sessions in natural order, one row each |
//! | `index.html` | the same as a page, failures first, with links to the sessions' reports |
//! | `.work/` | what unfinished sessions keep; may be removed when no batch runs |
//!
//! `status.json` has the fields of [`Status`]; the outputs are there exactly when its `state` is `done`. Times of day, durations, hosts and memory stand
//! there and nowhere else, so everything beside it is the same bytes in every run. `summary.csv` has the columns [`COLUMNS`],
//! empty where a session has no such value; the figures are those of the session's `fit.json`.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::write_atomic;

/// Columns of `summary.csv`.
pub const COLUMNS: [&str; 12] = [
    "session",
    "state",
    "reason",
    "frames",
    "speed_m_s",
    "cadence_hz",
    "stature_m",
    "rms_distance_m",
    "inputs_hash",
    "options_hash",
    "model_hash",
    "version",
];

#[derive(Debug, thiserror::Error)]
pub enum StatusError {
    #[error("cannot write {}: {error}", path.display())]
    Write { path: PathBuf, error: std::io::Error },
}

/// How far a session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    Pending,
    Running,
    Done,
    Failed,
}

impl State {
    pub fn name(self) -> &'static str {
        match self {
            State::Pending => "pending",
            State::Running => "running",
            State::Done => "done",
            State::Failed => "failed",
        }
    }
}

/// What a session's results depend on: equal keys, equal bytes. Hashes are BLAKE3 in hexadecimal digits.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Key {
    /// Of rig file, pictures and videos: names and bytes.
    pub inputs_hash: String,
    /// Of the options in force, from whichever `muybridge.toml` they come.
    pub options_hash: String,
    /// Of the model file's bytes; `embedded` for all models of the program, `embedded walking` and so on for one.
    pub model_hash: String,
    /// Of the program: its version and the first digits of its executable's hash.
    pub version: String,
}

/// One session of a study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Path below the study, parts joined by `/`.
    pub session: String,
    pub state: State,
    /// Why it failed or waits, one sentence.
    pub reason: Option<String>,
    #[serde(flatten)]
    pub key: Key,
    /// Absolute path of the footage.
    pub folder: PathBuf,
    /// Where it runs or ran: host, process, and the task of a Slurm array if it was one.
    pub host: Option<String>,
    pub process: Option<u32>,
    pub slurm_task: Option<String>,
    /// Seconds since 1970 in UTC.
    pub started_unix_s: Option<u64>,
    /// How long it took.
    pub seconds: Option<f64>,
    /// Largest resident memory, 10⁶ bytes.
    pub peak_memory_mb: Option<f64>,
}

impl Status {
    /// A session that nobody has worked on.
    pub fn pending(session: &str, folder: &Path, key: &Key) -> Status {
        Status {
            session: session.into(),
            state: State::Pending,
            reason: None,
            key: key.clone(),
            folder: folder.into(),
            host: None,
            process: None,
            slurm_task: None,
            started_unix_s: None,
            seconds: None,
            peak_memory_mb: None,
        }
    }
}

/// Writes `status.json` into the session's folder of the results.
pub fn write(folder: &Path, status: &Status) -> Result<(), StatusError> {
    let path = folder.join("status.json");
    let failed = |error| StatusError::Write { path: path.clone(), error };
    let mut text = serde_json::to_string_pretty(status).map_err(|e| failed(e.into()))?;
    text.push('\n');
    write_atomic(&path, text.as_bytes()).map_err(failed)
}

/// The session's status; `None` where there is none, or none that can be read: such a session is to be run.
pub fn read(folder: &Path) -> Option<Status> {
    serde_json::from_slice(&std::fs::read(folder.join("status.json")).ok()?).ok()
}

/// Writes `summary.csv` into the results folder.
pub fn write_summary(results: &Path, statuses: &[Status]) -> Result<(), StatusError> {
    let path = results.join("summary.csv");
    let mut text = COLUMNS.join(",") + "\n";
    for status in statuses {
        let fields = row(results, status).map(|field| quoted(&field));
        text += &(fields.join(",") + "\n");
    }
    write_atomic(&path, text.as_bytes()).map_err(|error| StatusError::Write { path: path.clone(), error })
}

/// A session's values of [`COLUMNS`].
pub fn row(results: &Path, status: &Status) -> [String; COLUMNS.len()] {
    let done = status.state == State::Done;
    let bytes = done.then(|| std::fs::read(results.join(&status.session).join("fit.json")).ok()).flatten();
    let fit: serde_json::Value = bytes.and_then(|b| serde_json::from_slice(&b).ok()).unwrap_or_default();
    let number = |name: &str, digits: usize| fit[name].as_f64().map_or(String::new(), |v| format!("{v:.digits$}"));
    let key = &status.key;
    [
        status.session.clone(),
        status.state.name().into(),
        status.reason.clone().unwrap_or_default(),
        fit["frames"].as_array().map_or(String::new(), |frames| frames.len().to_string()),
        number("speed_m_s", 3),
        number("cadence_hz", 3),
        number("stature_m", 3),
        number("rms_distance_m", 4),
        key.inputs_hash.clone(),
        key.options_hash.clone(),
        key.model_hash.clone(),
        key.version.clone(),
    ]
}

/// A field of a CSV file, in quotes where it needs them (RFC 4180).
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failed() -> Status {
        let key =
            Key { inputs_hash: "a1".into(), options_hash: "b2".into(), model_hash: "embedded walking".into(), version: "0.1.0".into() };
        let reason = Some("cam_01/3.png: \"ends\" early, copy it".into());
        Status { state: State::Failed, reason, seconds: Some(1.5), ..Status::pending("g/walk, 3", Path::new("/s/g/walk, 3"), &key) }
    }

    #[test]
    fn comes_back_as_written_and_a_damaged_one_is_none() {
        let results = tempfile::tempdir().unwrap();
        let folder = results.path().join("g/walk, 3");
        assert_eq!(read(&folder), None);
        write(&folder, &failed()).unwrap();
        assert_eq!(read(&folder), Some(failed()));
        let json: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.join("status.json")).unwrap()).unwrap();
        assert_eq!((json["state"].as_str(), json["inputs_hash"].as_str()), (Some("failed"), Some("a1")));
        std::fs::write(folder.join("status.json"), "{\"session\": \"g").unwrap();
        assert_eq!(read(&folder), None);
    }

    #[test]
    fn rows_keep_their_columns_whatever_names_and_reasons_hold() {
        let results = tempfile::tempdir().unwrap();
        let done = Status { state: State::Done, reason: None, ..Status::pending("walk", Path::new("/s/walk"), &Key::default()) };
        std::fs::create_dir(results.path().join("walk")).unwrap();
        let fit = r#"{"speed_m_s": 1.25, "cadence_hz": 0.9, "stature_m": 1.7, "rms_distance_m": 0.0123, "frames": [1, 2, 3]}"#;
        std::fs::write(results.path().join("walk/fit.json"), fit).unwrap();
        write_summary(results.path(), &[failed(), done]).unwrap();
        let text = std::fs::read_to_string(results.path().join("summary.csv")).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[1], "\"g/walk, 3\",failed,\"cam_01/3.png: \"\"ends\"\" early, copy it\",,,,,,a1,b2,embedded walking,0.1.0");
        assert_eq!(lines[2], "walk,done,,3,1.250,0.900,1.700,0.0123,,,,");
    }
}

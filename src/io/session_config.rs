//! `muybridge.toml`: options of a session, of all sessions below a folder, or of a study.
//!
//! ```toml
//! fps = 50                   # frames per second of pictures, which do not say it themselves
//! model = "walking.npz"      # of `muybridge model build`, or a list of such files of which the best one is taken; a relative path
//!                            # is relative to this file
//! activity = "running"       # or an embedded model; not both in one file; with neither all embedded ones are tried
//! variance = 0.95            # part of the model's variance that the last stage of the fit uses
//! pictures = true            # also draw the result
//! ```
//!
//! A file holds for the folder that it is in and for all below; the nearer one wins, key by key, and an option of the command line wins over
//! all. `model` and `activity` are one choice: the nearer file's model goes before a farther one's activity, and the other way round.

use std::path::{Path, PathBuf};

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

use super::calib_toml::toml_message;
use super::session::SessionError;
use crate::motion_model::Activity;

pub const FILE: &str = "muybridge.toml";

/// Options in force for a session; `None` is the command's own choice.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SessionConfig {
    pub fps: Option<f64>,
    /// Absolute once read; of several models the one that explains the footage best is taken.
    #[serde(deserialize_with = "one_or_more")]
    pub model: Vec<PathBuf>,
    pub activity: Option<Activity>,
    /// Above 0, at most 1.
    pub variance: Option<f64>,
    pub pictures: Option<bool>,
}

impl SessionConfig {
    /// What stands here, and where nothing does what stands in `farther`.
    pub fn or(self, farther: SessionConfig) -> SessionConfig {
        let chosen = !self.model.is_empty() || self.activity.is_some();
        let (model, activity) = if chosen { (self.model, self.activity) } else { (farther.model, farther.activity) };
        SessionConfig {
            fps: self.fps.or(farther.fps),
            model,
            activity,
            variance: self.variance.or(farther.variance),
            pictures: self.pictures.or(farther.pictures),
        }
    }
}

/// The options in the session's folder and in those above it.
pub fn read(folder: &Path) -> Result<SessionConfig, SessionError> {
    let absolute = std::path::absolute(folder).map_err(|error| SessionError::Read { path: folder.into(), error })?;
    let files = absolute.ancestors().map(|place| place.join(FILE)).filter(|path| path.is_file());
    files.map(|path| read_file(&path)).try_fold(SessionConfig::default(), |near, farther| Ok(near.or(farther?)))
}

fn read_file(path: &Path) -> Result<SessionConfig, SessionError> {
    let text = std::fs::read_to_string(path).map_err(|error| SessionError::Read { path: path.into(), error })?;
    let refused = |message| SessionError::Config { path: path.into(), message };
    let found: SessionConfig = toml::from_str(&text).map_err(|e| refused(toml_message(&text, &e)))?;
    if !found.model.is_empty() && found.activity.is_some() {
        return Err(refused("model and activity exclude each other; a model file has its own activity".into()));
    }
    if found.variance.is_some_and(|v| !(v > 0.0 && v <= 1.0)) {
        return Err(refused("variance must be above 0 and at most 1".into()));
    }
    let model = found.model.iter().map(|model| path.parent().unwrap_or(Path::new("/")).join(model)).collect();
    Ok(SessionConfig { model, ..found })
}

/// A path or a list of paths.
fn one_or_more<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<PathBuf>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "model must be a file or a list of files")]
    enum Files {
        One(PathBuf),
        Several(Vec<PathBuf>),
    }
    match Files::deserialize(value)? {
        Files::One(path) => Ok(vec![path]),
        Files::Several(paths) if paths.is_empty() => Err(D::Error::custom("model is an empty list; name a file, or leave it out")),
        Files::Several(paths) => Ok(paths),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// Options of `study/group/walk` with these files at the three levels.
    fn read_levels(texts: [&str; 3]) -> Result<SessionConfig, String> {
        let place = tempfile::tempdir().unwrap();
        let folders = ["study", "study/group", "study/group/walk"].map(|f| place.path().join(f));
        for (folder, text) in folders.iter().zip(texts) {
            fs::create_dir(folder).unwrap();
            fs::write(folder.join(FILE), text).unwrap();
        }
        let relative = |m: &PathBuf| m.strip_prefix(place.path()).unwrap().to_path_buf();
        read(&folders[2]).map(|c| SessionConfig { model: c.model.iter().map(relative).collect(), ..c }).map_err(|e| e.to_string())
    }

    #[test]
    fn the_nearer_file_wins_key_by_key_and_paths_are_those_of_their_file() {
        let read = read_levels(["fps = 25\npictures = true\nmodel = \"models/a.npz\"", "fps = 50\nvariance = 0.9", "pictures = false"]);
        let expected = SessionConfig {
            fps: Some(50.0),
            model: vec!["study/models/a.npz".into()],
            activity: None,
            variance: Some(0.9),
            pictures: Some(false),
        };
        assert_eq!(read, Ok(expected));
    }

    #[test]
    fn model_and_activity_are_one_choice() {
        let nearer = read_levels(["model = \"a.npz\"", "activity = \"jumping\"", ""]).unwrap();
        assert_eq!((nearer.model, nearer.activity), (vec![], Some(Activity::Jumping)));
        let nearer = read_levels(["activity = \"jumping\"", "", "model = \"a.npz\""]).unwrap();
        assert_eq!((nearer.model, nearer.activity), (vec!["study/group/walk/a.npz".into()], None));
        let nearer = read_levels(["activity = \"jumping\"", "model = [\"a.npz\", \"../b.npz\"]", ""]).unwrap();
        assert_eq!((nearer.model, nearer.activity), (vec!["study/group/a.npz".into(), "study/group/../b.npz".into()], None));
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_its_file() {
        for (text, message) in [
            ("model = \"a.npz\"\nactivity = \"walking\"", "exclude each other"),
            ("model = []", "line 1: model is an empty list"),
            ("model = 3", "line 1: model must be a file or a list of files"),
            ("variance = 0.0", "variance must be above 0"),
            ("variance = nan", "variance must be above 0"),
            ("activity = \"swimming\"", "line 1: unknown variant `swimming`"),
            ("\npicture = true", "line 2: unknown field `picture`"),
        ] {
            let error = read_levels(["", text, ""]).unwrap_err();
            assert!(error.contains("study/group/muybridge.toml: ") && error.contains(message), "{error}");
        }
    }
}

//! `muybridge.toml`: options of a session, of all sessions below a folder, or of a study.
//!
//! ```toml
//! fps = 50                   # frames per second of pictures, which do not say it themselves
//! model = "walking.npz"      # of `muybridge model build`; a relative path is relative to this file
//! activity = "running"       # or an embedded model; not both in one file
//! variance = 0.95            # part of the model's variance that the last stage of the fit uses
//! pictures = true            # also draw the result
//! ```
//!
//! A file holds for the folder that it is in and for all below; the nearer one wins, key by key, and an option of the command line wins over
//! all. `model` and `activity` are one choice: the nearer file's model goes before a farther one's activity, and the other way round.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::calib_toml::toml_message;
use super::session::SessionError;
use crate::motion_model::Activity;

pub const FILE: &str = "muybridge.toml";

/// What people do where nothing says it.
pub const DEFAULT_ACTIVITY: Activity = Activity::Walking;

/// Options in force for a session; `None` is the command's own choice.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SessionConfig {
    pub fps: Option<f64>,
    /// Absolute once read.
    pub model: Option<PathBuf>,
    pub activity: Option<Activity>,
    /// Above 0, at most 1.
    pub variance: Option<f64>,
    pub pictures: Option<bool>,
}

impl SessionConfig {
    /// What stands here, and where nothing does what stands in `farther`.
    pub fn or(self, farther: SessionConfig) -> SessionConfig {
        let chosen = self.model.is_some() || self.activity.is_some();
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
    if found.model.is_some() && found.activity.is_some() {
        return Err(refused("model and activity exclude each other; a model file has its own activity".into()));
    }
    if found.variance.is_some_and(|v| !(v > 0.0 && v <= 1.0)) {
        return Err(refused("variance must be above 0 and at most 1".into()));
    }
    let model = found.model.as_ref().map(|model| path.parent().unwrap_or(Path::new("/")).join(model));
    Ok(SessionConfig { model, ..found })
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
        let relative =
            |c: SessionConfig| SessionConfig { model: c.model.map(|m| m.strip_prefix(place.path()).unwrap().to_path_buf()), ..c };
        read(&folders[2]).map(relative).map_err(|e| e.to_string())
    }

    #[test]
    fn the_nearer_file_wins_key_by_key_and_paths_are_those_of_their_file() {
        let read = read_levels(["fps = 25\npictures = true\nmodel = \"models/a.npz\"", "fps = 50\nvariance = 0.9", "pictures = false"]);
        let expected = SessionConfig {
            fps: Some(50.0),
            model: Some("study/models/a.npz".into()),
            activity: None,
            variance: Some(0.9),
            pictures: Some(false),
        };
        assert_eq!(read, Ok(expected));
    }

    #[test]
    fn model_and_activity_are_one_choice() {
        let nearer = read_levels(["model = \"a.npz\"", "activity = \"jumping\"", ""]).unwrap();
        assert_eq!((nearer.model, nearer.activity), (None, Some(Activity::Jumping)));
        let nearer = read_levels(["activity = \"jumping\"", "", "model = \"a.npz\""]).unwrap();
        assert_eq!((nearer.model, nearer.activity), (Some("study/group/walk/a.npz".into()), None));
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_its_file() {
        for (text, message) in [
            ("model = \"a.npz\"\nactivity = \"walking\"", "exclude each other"),
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

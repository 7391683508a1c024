//! Hashes of what results depend on: BLAKE3 over names and bytes, never over times or places.
//!
//! A session's inputs are its rig file, the pictures and videos beside it, and the pictures in the folders of its cameras;
//! notes, truths of phantoms and hidden files do not count. Broken sessions have a hash too, so that they are tried again
//! once something in them changes. Options are hashed as they are in force ([`super::session_config`]).

use std::path::{Path, PathBuf};

use super::calib_toml;
use super::images::is_image_name;
use super::session::{file_name, list};
use super::session_config::SessionConfig;
use super::status_json::Key;
use super::video::is_video_name;

/// Name of a session's rig file.
pub const RIG_FILE: &str = "Calib.toml";

/// The key of a session's results with these options, or the sentence about why they cannot be read, and this [`program`].
pub fn key(session: &Path, config: &Result<SessionConfig, String>, program: &str) -> Key {
    let (options_hash, model_hash) = match config {
        Ok(config) => (options_hash(config), model_hash(config)),
        Err(message) => (blake3::hash(message.as_bytes()).to_hex().to_string(), String::new()),
    };
    Key { inputs_hash: inputs_hash(session), options_hash, model_hash, version: program.into() }
}

fn model_hash(config: &SessionConfig) -> String {
    if config.model.is_empty() {
        return config.activity.map_or("embedded".into(), |activity| format!("embedded {activity}"));
    }
    config.model.iter().map(|path| file_hash(path)).collect::<Vec<_>>().join(" ")
}

/// What identifies the program: its version, and as long as versions are rare the executable itself.
pub fn program(executable: &Path) -> String {
    format!("{}+{}", env!("CARGO_PKG_VERSION"), file_hash(executable).get(..12).unwrap_or_default())
}

/// Hash of a session folder's inputs.
pub fn inputs_hash(session: &Path) -> String {
    let mut hasher = blake3::Hasher::new();
    for path in input_files(session) {
        let name = path.strip_prefix(session).unwrap_or(&path).as_os_str().as_encoded_bytes();
        hasher.update(&(name.len() as u64).to_le_bytes()).update(name).update(file_hash(&path).as_bytes());
    }
    hasher.finalize().to_hex().to_string()
}

/// Files and camera folders of a session, in a fixed order.
fn input_files(session: &Path) -> Vec<PathBuf> {
    let rig = calib_toml::read_rig(&session.join(RIG_FILE)).ok();
    let is_camera = |name: &str| name.starts_with("cam") || rig.iter().flat_map(|r| &r.cameras).any(|c| c.name == name);
    let mut files = Vec::new();
    for path in list(session).unwrap_or_default() {
        if path.is_dir() {
            if is_camera(&file_name(&path)) {
                let pictures = list(&path).unwrap_or_default().into_iter().filter(|p| is_image_name(p));
                files.push(path);
                files.extend(pictures);
            }
        } else if file_name(&path) == RIG_FILE || is_image_name(&path) || is_video_name(&path) {
            files.push(path);
        }
    }
    files
}

/// Hash of a file's bytes; what cannot be read has the kind of the error for a hash.
fn file_hash(path: &Path) -> String {
    if path.is_dir() {
        return "folder".into();
    }
    let mut hasher = blake3::Hasher::new();
    let read = std::fs::File::open(path).and_then(|file| hasher.update_reader(file).map(|_| ()));
    read.map_or_else(|error| format!("unreadable: {}", error.kind()), |()| hasher.finalize().to_hex().to_string())
}

fn options_hash(config: &SessionConfig) -> String {
    // Models count by their content; their names stand in fit.json.
    let names = config.model.iter().filter_map(|m| m.file_name()).map(PathBuf::from).collect();
    let named = SessionConfig { model: names, ..config.clone() };
    let text = serde_json::to_string(&named).unwrap_or_default();
    blake3::hash(text.as_bytes()).to_hex().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn session() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("cam_00")).unwrap();
        for (name, text) in [(RIG_FILE, "rig"), ("cam_00/1.png", "one"), ("cam_00/2.png", "two"), ("cam_00_background.png", "stage")] {
            fs::write(folder.path().join(name), text).unwrap();
        }
        folder
    }

    #[test]
    fn every_change_of_an_input_changes_the_hash_and_nothing_else_does() {
        let folder = session();
        let at = |name: &str| folder.path().join(name);
        let hash = || inputs_hash(folder.path());
        let start = hash();
        assert_eq!(start, inputs_hash(session().path()), "the place does not count");
        fs::create_dir(at("truth")).unwrap();
        for name in ["truth/1.png", "notes.txt", ".hidden.png", "muybridge.toml"] {
            fs::write(at(name), "x").unwrap();
        }
        assert_eq!(hash(), start);

        let mut seen = vec![start];
        let mut changed = |what: &str| {
            let now = hash();
            assert!(!seen.contains(&now), "{what}");
            seen.push(now);
        };
        fs::write(at("cam_00/2.png"), "twO").unwrap();
        changed("a byte");
        fs::rename(at("cam_00/2.png"), at("cam_00/3.png")).unwrap();
        changed("a name");
        fs::remove_file(at("cam_00/3.png")).unwrap();
        changed("a picture less");
        fs::create_dir(at("cam_01")).unwrap();
        changed("an empty camera");
        fs::remove_file(at(RIG_FILE)).unwrap();
        changed("no rig");
    }

    #[test]
    fn options_count_by_value_and_models_by_content() {
        let folder = session();
        let keyed = |config: &SessionConfig| key(folder.path(), &Ok(config.clone()), "1");
        let start = keyed(&SessionConfig::default());
        assert_eq!(start.model_hash, "embedded");
        assert_ne!(keyed(&SessionConfig { fps: Some(25.0), ..Default::default() }).options_hash, start.options_hash);
        let model = folder.path().join("m.npz");
        fs::write(&model, "a").unwrap();
        let config = SessionConfig { model: vec![model.clone()], ..Default::default() };
        let first = keyed(&config);
        fs::write(&model, "b").unwrap();
        let second = keyed(&config);
        assert!(first.model_hash != second.model_hash && first.options_hash == second.options_hash);
        assert_eq!(first.inputs_hash, start.inputs_hash);
    }
}

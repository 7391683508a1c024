//! `outputs.json`: what the motion files of a folder cannot say themselves: unit, axes, the rotation from the rig's world, and
//! where the motion came from. One for all files of a folder; no time of day.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Rotation3;
use serde::{Deserialize, Serialize};

use super::exchange::{c3d_from_clip, opensim_from_clip};
use super::sidecar::rows;
use super::write_atomic;

const NAME: &str = "outputs.json";

#[derive(Debug, thiserror::Error)]
#[error("cannot write {path}: {cause}")]
pub struct OutputsError {
    path: PathBuf,
    cause: std::io::Error,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outputs {
    pub software: String,
    /// By file name.
    pub files: BTreeMap<String, FileNote>,
}

/// Where a motion came from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Source {
    /// Session folder, style or motion file, without its path.
    pub motion: String,
    pub model: String,
    pub model_hash: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FileNote {
    pub content: String,
    pub source: Source,
    pub length_unit: String,
    pub axes: String,
    pub frames_per_second: f64,
    /// Rows of the rotation that carries the rig's world into the file's; `None` where no rig was involved.
    pub file_from_rig_world: Option<[[f64; 3]; 3]>,
}

/// The kinds of motion file written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    Bvh,
    Glb,
    Trc,
    C3d,
    Mot,
}

impl FileNote {
    /// Of a clip's file; `clip_from_rig` is the rotation from the rig's world, if any.
    pub fn new(kind: Kind, source: &Source, fps: f64, clip_from_rig: Option<&Rotation3<f64>>) -> FileNote {
        const CLIP: &str = "right-handed, y up; at heading 0 the person looks along +z, left is +x; floor at y = 0";
        const OPENSIM: &str = "right-handed, x forward at heading 0, y up, z right; floor at y = 0";
        let (content, length_unit, axes, file_from_clip) = match kind {
            Kind::Bvh => ("skeleton with H-Anim names and joint angles in degrees", "m", CLIP, Rotation3::identity()),
            Kind::Glb => ("skinned body with H-Anim joint names, one animation per motion", "m", CLIP, Rotation3::identity()),
            Kind::Trc => ("joint centres", "mm", OPENSIM, opensim_from_clip()),
            Kind::C3d => ("joint centres", "mm", "right-handed, x forward at heading 0, y left, z up; floor at z = 0", c3d_from_clip()),
            Kind::Mot => ("coordinates of Rajagopal's model, angles in degrees", "m", OPENSIM, opensim_from_clip()),
        };
        FileNote {
            content: content.into(),
            source: source.clone(),
            length_unit: length_unit.into(),
            axes: axes.into(),
            frames_per_second: fps,
            file_from_rig_world: clip_from_rig.map(|r| rows(&(file_from_clip * r))),
        }
    }
}

impl Outputs {
    /// Of a folder: what its `outputs.json` says, if this software wrote one, of files that are still there.
    pub fn of_folder(folder: &Path) -> Outputs {
        let known = std::fs::read_to_string(folder.join(NAME)).ok().and_then(|text| serde_json::from_str::<Outputs>(&text).ok());
        let mut files = known.map_or_else(BTreeMap::new, |known| known.files);
        files.retain(|name, _| folder.join(name).is_file());
        Outputs { software: concat!("muybridge ", env!("CARGO_PKG_VERSION")).into(), files }
    }

    /// Whether a file of the folder holds a motion that its BVH file holds as well.
    pub fn is_copy(&self, name: &str) -> bool {
        self.files.contains_key(name) && !name.ends_with(".bvh")
    }

    /// Writes `outputs.json` into a folder.
    pub fn write(&self, folder: &Path) -> Result<(), OutputsError> {
        let path = folder.join(NAME);
        // Plain fields and finite numbers always serialise.
        let text = serde_json::to_string_pretty(self).unwrap_or_default() + "\n";
        write_atomic(&path, text.as_bytes()).map_err(|cause| OutputsError { path, cause })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn a_rigs_up_is_every_files_up() {
        // A rig that stands on z.
        let clip_from_rig = Rotation3::new(Vector3::x() * -std::f64::consts::FRAC_PI_2);
        let up = |kind| {
            let rows = FileNote::new(kind, &Source::default(), 30.0, Some(&clip_from_rig)).file_from_rig_world.unwrap();
            rows.map(|row| row[2].round() as i32)
        };
        assert_eq!(
            [Kind::Bvh, Kind::Glb, Kind::Trc, Kind::C3d, Kind::Mot].map(up),
            [[0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0]]
        );
    }

    #[test]
    fn a_folder_keeps_the_notes_of_its_files() {
        let folder = tempfile::tempdir().unwrap();
        let mut outputs = Outputs::of_folder(folder.path());
        let source = Source { motion: "walk_p03".into(), ..Source::default() };
        for (name, kind) in [("a.bvh", Kind::Bvh), ("a.mot", Kind::Mot)] {
            outputs.files.insert(name.into(), FileNote::new(kind, &source, 30.0, None));
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        outputs.write(folder.path()).unwrap();
        assert_eq!(Outputs::of_folder(folder.path()), outputs);
        assert!(outputs.is_copy("a.mot") && !outputs.is_copy("a.bvh") && !outputs.is_copy("b.mot"));
        std::fs::remove_file(folder.path().join("a.mot")).unwrap();
        assert_eq!(Outputs::of_folder(folder.path()).files.len(), 1);
    }
}

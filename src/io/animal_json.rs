//! What the animal stages tell one another: `masks.json`, `analysis.json`, `keys.json`.
//!
//! Frames are numbered as in the whole clip. Checked by reading back.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::write_atomic;
use crate::animal::region::Region;
use crate::animal::rhythm::Rhythm;

#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error("cannot read {path}: {cause}; is it a folder of `muybridge animal {stage}`")]
    Read { path: PathBuf, stage: &'static str, cause: std::io::Error },
    #[error("{path} is no record of `muybridge animal {stage}` of this version ({why}); run that stage again")]
    Foreign { path: PathBuf, stage: &'static str, why: String },
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
}

/// A stage's record: its file's name and the command that writes it.
pub trait Record: Serialize + DeserializeOwned {
    const FILE: &'static str;
    const STAGE: &'static str;
}

/// Of `animal masks`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MasksRecord {
    pub video: PathBuf,
    pub fps: Option<f64>,
    /// `null` where nothing was found.
    pub regions: Vec<Option<Region>>,
    /// Centres of mass in the scenery, pixels of the first frame.
    pub path_px: Vec<Option<[f64; 2]>>,
}

/// Of `animal analyse`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AnalysisRecord {
    pub fps: f64,
    /// Drawn strokes, not masks.
    pub strokes: bool,
    /// Whether keys and animation use the band-passed coefficients.
    pub filter: bool,
    /// Of the polynomial that was taken from every pixel.
    pub trend_degree: usize,
    /// Number of the first analysed frame.
    pub first_frame: usize,
    pub window_px: [u32; 2],
    pub rhythm: Rhythm,
    /// Shares of the variance.
    pub explained: Vec<f64>,
    /// Of the first five components, one row per frame.
    pub coefficients: Vec<Vec<f64>>,
    pub regions: Vec<Region>,
    /// Centres of mass in the scenery, where the masks' record has all of them.
    pub path_px: Option<Vec<[f64; 2]>>,
}

/// Of `animal keys`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeysRecord {
    /// Frames of the key images; for switching models in the order of the stride.
    pub keys: Vec<usize>,
    pub components: usize,
    /// Four models switch.
    pub doubled: bool,
    /// Condition number of the kernel matrix of the keys that were chosen first.
    pub condition: f64,
    /// Whether no other choice has a smaller one; else no choice is below `bound`.
    pub exact: bool,
    pub bound: f64,
    pub alternates: Vec<Alternate>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Alternate {
    pub key: usize,
    pub frame: usize,
    /// Distance in the component plane, standard deviations.
    pub distance: f64,
}

impl Record for MasksRecord {
    const FILE: &'static str = "masks.json";
    const STAGE: &'static str = "masks";
}

impl Record for AnalysisRecord {
    const FILE: &'static str = "analysis.json";
    const STAGE: &'static str = "analyse";
}

impl Record for KeysRecord {
    const FILE: &'static str = "keys.json";
    const STAGE: &'static str = "keys";
}

/// Reads a stage's record from its folder.
pub fn read<R: Record>(folder: &Path) -> Result<R, RecordError> {
    let path = folder.join(R::FILE);
    let text = std::fs::read_to_string(&path).map_err(|cause| RecordError::Read { path: path.clone(), stage: R::STAGE, cause })?;
    serde_json::from_str(&text).map_err(|e| RecordError::Foreign { path, stage: R::STAGE, why: e.to_string() })
}

/// Writes a stage's record into its folder.
pub fn write<R: Record>(folder: &Path, record: &R) -> Result<(), RecordError> {
    let path = folder.join(R::FILE);
    let failed = |cause| RecordError::Write { path: path.clone(), cause };
    let text = serde_json::to_string_pretty(record).map_err(|e| failed(e.into()))? + "\n";
    write_atomic(&path, text.as_bytes()).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_come_back_and_foreign_ones_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let record = KeysRecord {
            keys: vec![3, 9],
            components: 2,
            doubled: false,
            condition: 1.25,
            exact: true,
            bound: 1.25,
            alternates: vec![Alternate { key: 3, frame: 16, distance: 0.1 }],
        };
        write(folder.path(), &record).unwrap();
        assert_eq!(read::<KeysRecord>(folder.path()).unwrap(), record);
        std::fs::write(folder.path().join("analysis.json"), "{\"fps\": 3}").unwrap();
        let error = read::<AnalysisRecord>(folder.path()).unwrap_err().to_string();
        assert!(error.contains("analysis.json is no record of `muybridge animal analyse`"), "{error}");
        assert!(matches!(read::<MasksRecord>(folder.path()), Err(RecordError::Read { .. })));
    }
}

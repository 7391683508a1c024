//! One motion file of any kind as a [`Clip`].

use std::path::{Path, PathBuf};

use super::asf_amc::{self, AsfAmcError};
use super::bvh::{self, BvhError};
use super::mapping::{MappingError, Recording, clip_from_recording};
use super::mot::{self, MotError};
use super::sidecar::Sidecar;
use crate::body::Clip;

#[derive(Debug, thiserror::Error)]
pub enum MocapError {
    #[error(transparent)]
    Bvh(#[from] BvhError),
    #[error(transparent)]
    AsfAmc(#[from] AsfAmcError),
    #[error(transparent)]
    Mot(#[from] MotError),
    #[error("{path}: {source}")]
    Mapping { path: PathBuf, source: MappingError },
    #[error("{path}: not a motion file that can be read; give .bvh, .amc (with its .asf beside it), .mot or .sto")]
    Kind { path: PathBuf },
}

/// A motion file's content.
#[derive(Clone, Debug)]
pub struct ReadClip {
    /// The file's name without its ending.
    pub trial: String,
    pub clip: Clip,
    /// What the user should know, one sentence each.
    pub notices: Vec<String>,
}

/// True for the endings that [`read_clip`] reads.
pub fn is_motion_file(path: &Path) -> bool {
    matches!(ending(path).as_str(), "bvh" | "amc" | "mot" | "sto")
}

/// Reads `.bvh`, `.amc` (with the `.asf` found beside it), `.mot` or `.sto`.
pub fn read_clip(path: &Path) -> Result<ReadClip, MocapError> {
    let mapped = |recording: Recording| clip_from_recording(&recording).map_err(|source| MocapError::Mapping { path: path.into(), source });
    let (mut clip, notices) = match ending(path).as_str() {
        "bvh" => mapped(bvh::read(path)?)?,
        "amc" => mapped(asf_amc::read(path)?)?,
        "mot" | "sto" => mot::read(path)?,
        _ => return Err(MocapError::Kind { path: path.into() }),
    };
    if let Some(sidecar) = Sidecar::beside(path) {
        clip.hip_height_m = sidecar.hip_height_m;
        clip.offsets[0].y = sidecar.hip_height_m - clip.offsets[crate::body::Joint::LHip as usize].y;
    }
    Ok(ReadClip { trial: path.file_stem().unwrap_or_default().to_string_lossy().into_owned(), clip, notices })
}

fn ending(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

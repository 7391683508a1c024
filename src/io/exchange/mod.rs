//! Motions for laboratories: joint centres as TRC and C3D, joint angles as MOT.
//!
//! Files of OpenSim stand on y, walk along x and have z to the right; C3D files of most laboratories stand on z, here with x
//! forward at the clip's +z and y to the left. Lengths are millimetres, of MOT metres.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::joints_csv::columns;
use super::write_atomic;
use crate::body::Clip;

pub mod c3d;
pub mod mot;
pub mod trc;

#[derive(Debug, thiserror::Error)]
#[error("cannot write {path}: {cause}")]
pub struct ExchangeError {
    path: PathBuf,
    cause: std::io::Error,
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), ExchangeError> {
    write_atomic(path, bytes).map_err(|cause| ExchangeError { path: path.into(), cause })
}

/// A clip's x left, y up, z forward as OpenSim's x forward, y up, z right.
pub fn opensim_from_clip() -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0))
}

/// The same as x forward, y left, z up.
pub fn c3d_from_clip() -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(Matrix3::new(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
}

/// Names of the joint centres in the order of the files: those of `joints.csv`.
fn labels() -> Vec<&'static str> {
    columns().map(|(_, name)| name).collect()
}

/// Joint centres of every frame in that order, millimetres.
fn centres_mm<'a>(clip: &'a Clip, file_from_clip: &'a Rotation3<f64>) -> impl Iterator<Item = Vec<Vector3<f64>>> + 'a {
    clip.poses.iter().map(move |pose| {
        let placed = clip.place(pose);
        columns().map(|(joint, _)| file_from_clip * placed.position(joint) * 1e3).collect()
    })
}

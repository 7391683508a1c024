//! Marker recordings (C3D, TRC) as clips.
//!
//! The marker set is `markers.toml` beside the file or one folder up, else the supplied set that knows most of the names.

use std::path::{Path, PathBuf};

use super::c3d::{self, C3dError};
use super::mapping::put_on_floor;
use super::trc::{self, TrcError};
use crate::body::Clip;
use crate::motion_model::markers::{IkError, MarkerSet, Markers, SetError, Solved, choose, solve};

const SET: &str = "markers.toml";
/// Beyond this r.m.s. distance of markers to the body the user is told, metres.
const FAIR_M: f64 = 0.025;

#[derive(Debug, thiserror::Error)]
pub enum MarkersError {
    #[error(transparent)]
    C3d(#[from] C3dError),
    #[error(transparent)]
    Trc(#[from] TrcError),
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path}: {cause}")]
    Set { path: PathBuf, cause: SetError },
    #[error("{path}: {cause}")]
    Ik { path: PathBuf, cause: IkError },
}

/// Reads a `.c3d` or `.trc`; with the markers come notices, one sentence each.
pub fn read(path: &Path) -> Result<(Markers, Vec<String>), MarkersError> {
    let is_c3d = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("c3d"));
    if is_c3d { Ok(c3d::read(path)?) } else { Ok(trc::read(path)?) }
}

/// The motion behind a file's markers, before it is put on the floor.
pub fn solve_file(path: &Path) -> Result<(Solved, Vec<String>), MarkersError> {
    let (markers, mut notices) = read(path)?;
    let sets = sets_for(path)?;
    let of_set = |cause| MarkersError::Set { path: path.into(), cause };
    let (set, matches) = choose(&sets, &markers.names).map_err(of_set)?;
    let solved = solve(&markers, set, &matches).map_err(|cause| MarkersError::Ik { path: path.into(), cause })?;
    notices.extend(solved.notices.iter().cloned());
    if solved.rms_m > FAIR_M {
        notices.push(format!("the markers lie {:.0} mm (r.m.s.) from where {} puts them on a body", 1e3 * solved.rms_m, set.name));
    }
    Ok((solved, notices))
}

/// Reads a `.c3d` or `.trc` as a clip on the floor y = 0.
pub fn read_clip(path: &Path) -> Result<(Clip, Vec<String>), MarkersError> {
    let (solved, notices) = solve_file(path)?;
    let mut clip = solved.clip;
    put_on_floor(&mut clip);
    Ok((clip, notices))
}

fn sets_for(path: &Path) -> Result<Vec<MarkerSet>, MarkersError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let own = [folder.join(SET), folder.join("..").join(SET)].into_iter().find(|p| p.is_file());
    let Some(own) = own else {
        return MarkerSet::supplied().map_err(|cause| MarkersError::Set { path: path.into(), cause });
    };
    let text = std::fs::read_to_string(&own).map_err(|cause| MarkersError::Read { path: own.clone(), cause })?;
    Ok(vec![MarkerSet::parse(&text).map_err(|cause| MarkersError::Set { path: own, cause })?])
}

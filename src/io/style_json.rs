//! `style.json`: a person's weights in one model.

use std::path::{Path, PathBuf};

use super::write_atomic;
use crate::motion_model::Departure;
use crate::style::Style;

#[derive(Debug, thiserror::Error)]
pub enum StyleFileError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
    #[error("{path} is no style file: {why}")]
    Parse { path: PathBuf, why: String },
}

pub fn read_style(path: &Path) -> Result<Style, StyleFileError> {
    let bytes = std::fs::read(path).map_err(|cause| StyleFileError::Read { path: path.to_path_buf(), cause })?;
    let failed = |why: String| StyleFileError::Parse { path: path.to_path_buf(), why };
    let mut style: Style = serde_json::from_slice(&bytes).map_err(|e| failed(e.to_string()))?;
    let positive = [style.hip_height_m, style.cadence_factor];
    if positive.iter().any(|v| !(v.is_finite() && *v > 0.0)) || !style.parameter.is_finite() {
        return Err(failed("parameter, hip_height_m and cadence_factor must be finite, the last two positive".into()));
    }
    if let Some(fault) = style.departure.as_ref().and_then(Departure::fault) {
        return Err(failed(fault));
    }
    let departure = style.departure.take();
    Ok(style.departing(departure))
}

pub fn write_style(path: &Path, style: &Style) -> Result<(), StyleFileError> {
    let failed = |cause| StyleFileError::Write { path: path.to_path_buf(), cause };
    let mut text = serde_json::to_string_pretty(style).map_err(|e| failed(e.into()))?;
    text.push('\n');
    write_atomic(path, text.as_bytes()).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::Activity;
    use crate::style::{Expected, Neighbour, Observation};

    #[test]
    fn comes_back_as_written_and_refuses_other_files() {
        let style = Style {
            activity: Activity::Walking,
            model_hash: "ab".into(),
            parameter: 1.1,
            hip_height_m: 0.9,
            weights: vec![0.1, -2.5e-3],
            covariance: Some(vec![vec![1e-4, 0.0], vec![0.0, 2e-4]]),
            cadence_factor: 1.02,
            expected: Some(Expected { weights: vec![0.2, -1e-3], covariance: vec![vec![3e-4, 1e-5], vec![1e-5, 4e-4]] }),
            neighbours: vec![Neighbour {
                subject: "12".into(),
                distance: 0.3,
                mahalanobis: 1.2,
                own_spread: 0.2,
                inside: false,
                log_odds: Some(-1.5),
            }],
            shape: None,
            departure: None,
            detail: None,
            also: vec![Observation { parameter: 1.4, weights: vec![0.2, 0.1], covariance: None, cadence_factor: 1.01, detail: None }],
        };
        let own = Departure { turns: [("l_knee".to_string(), vec![[0.1, 0.0, -0.02]])].into(), root_height: 0.01 };
        let style = style.departing(Some(own));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("style.json");
        write_style(&path, &style).unwrap();
        assert_eq!(read_style(&path).unwrap(), style);
        let tail = serde_json::to_string(&style).unwrap().replace("l_knee", "tail");
        std::fs::write(&path, tail).unwrap();
        assert!(read_style(&path).unwrap_err().to_string().contains("departure of a joint `tail`"));
        for text in ["{}", "no json", &serde_json::to_string(&Style { hip_height_m: 0.0, ..style }).unwrap()] {
            std::fs::write(&path, text).unwrap();
            assert!(read_style(&path).unwrap_err().to_string().contains("is no style file"));
        }
    }
}

//! TRC marker recordings (Motion Analysis, OpenSim, Pose2Sim): a table of tabs, commas where a spreadsheet wrote it.
//!
//! Empty cells, NaN in any spelling and 0 0 0 are markers not seen. The time column decides the frame rate where the header's
//! differs; the blank line before the rows may be there or not.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::c3d::metres;
use super::mapping::tidy_fps;
use crate::motion_model::markers::Markers;

#[derive(Debug, thiserror::Error)]
pub enum TrcError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path}:{line}: {what}")]
    Syntax { path: PathBuf, line: usize, what: String },
}

/// Line (from 1) and what is wrong there.
type Fault = (usize, String);

/// Reads a `.trc`; with the markers come notices, one sentence each.
pub fn read(path: &Path) -> Result<(Markers, Vec<String>), TrcError> {
    let bytes = std::fs::read(path).map_err(|cause| TrcError::Read { path: path.into(), cause })?;
    parse(&String::from_utf8_lossy(&bytes)).map_err(|(line, what)| TrcError::Syntax { path: path.into(), line, what })
}

/// Cells of a line between tabs, else commas, else blanks.
fn cells(line: &str) -> Vec<&str> {
    match ['\t', ','].into_iter().find(|c| line.contains(*c)) {
        Some(separator) => line.split(separator).map(str::trim).collect(),
        None => line.split_whitespace().collect(),
    }
}

fn separates(c: char) -> bool {
    c.is_whitespace() || c == ','
}

fn parse(text: &str) -> Result<(Markers, Vec<String>), Fault> {
    let lines: Vec<&str> = text.lines().collect();
    let at = |line: usize| lines.get(line).map(|l| cells(l)).unwrap_or_default();
    if !lines.first().is_some_and(|l| l.trim_start_matches('\u{feff}').starts_with("PathFileType")) {
        return Err((1, "does not begin with PathFileType: this is no TRC file".into()));
    }
    let words =
        |line: usize| -> Vec<&str> { lines.get(line).map(|l| l.split(separates).filter(|w| !w.is_empty()).collect()).unwrap_or_default() };
    let (fields, values) = (words(1), words(2));
    let field = |name: &str| fields.iter().position(|f| *f == name).and_then(|i| values.get(i).copied());
    let header = at(3);
    if !header.first().is_some_and(|c| c.starts_with("Frame")) {
        return Err((4, "must hold Frame#, Time and the markers' names".into()));
    }
    let names: Vec<String> = header.iter().skip(2).filter(|c| !c.is_empty()).map(|c| c.to_string()).collect();
    if names.is_empty() {
        return Err((4, "names no marker".into()));
    }
    let mut rows = Vec::new();
    for (line, text) in lines.iter().enumerate().skip(4).filter(|(_, l)| !l.trim().is_empty()) {
        // The line of X1 Y1 Z1 ... names no frame.
        if cells(text).first().is_none_or(|c| c.is_empty() || c.starts_with('X')) && rows.is_empty() {
            continue;
        }
        rows.push(row(text, names.len()).map_err(|what| (line + 1, what))?);
    }
    let mut notices = Vec::new();
    let rate = field("DataRate").and_then(|r| r.parse().ok()).filter(|r: &f64| r.is_finite() && *r > 0.0);
    let fps = frame_rate(rate, &rows, &mut notices).map_err(|what| (3, what))?;
    if let Some(declared) = field("NumFrames").and_then(|n| n.parse::<usize>().ok()).filter(|n| *n != rows.len()) {
        notices.push(format!("NumFrames is {declared} but {} rows follow", rows.len()));
    }
    let metres_per_unit = field("Units").and_then(|u| metres(u.to_string()));
    Ok((Markers { names, fps, metres_per_unit, frames: rows.into_iter().map(|(_, markers)| markers).collect() }, notices))
}

type Row = (Option<f64>, Vec<Option<Vector3<f64>>>);

/// Time and markers of a line.
fn row(text: &str, markers: usize) -> Result<Row, String> {
    let cells = cells(text);
    let end = cells.iter().rposition(|c| !c.is_empty()).map_or(0, |i| i + 1);
    if end > 2 + 3 * markers {
        return Err(format!("{end} cells where the {markers} markers need {}", 2 + 3 * markers));
    }
    let value = |at: usize| match cells.get(at).copied().unwrap_or_default() {
        "" => Ok(None),
        word => match word.parse::<f64>() {
            Ok(v) => Ok(v.is_finite().then_some(v)),
            Err(_) if word.trim_start_matches(['-', '+']).to_ascii_lowercase().starts_with("nan") => Ok(None),
            Err(_) => Err(format!("cell {} holds '{}', which is not a number", at + 1, word.chars().take(40).collect::<String>())),
        },
    };
    let marker = |m: usize| -> Result<Option<Vector3<f64>>, String> {
        let x = [value(2 + 3 * m)?, value(3 + 3 * m)?, value(4 + 3 * m)?];
        let [Some(a), Some(b), Some(c)] = x else { return Ok(None) };
        Ok(Some(Vector3::new(a, b, c)).filter(|x| *x != Vector3::zeros()))
    };
    Ok((value(1)?, (0..markers).map(marker).collect::<Result<_, _>>()?))
}

fn frame_rate(header: Option<f64>, rows: &[Row], notices: &mut Vec<String>) -> Result<f64, String> {
    let span = rows.first().and_then(|r| r.0).zip(rows.last().and_then(|r| r.0)).map(|(a, b)| b - a);
    let by_time = span.filter(|s| *s > 0.0).map(|s| tidy_fps((rows.len() - 1) as f64 / s));
    match (header, by_time) {
        (Some(rate), Some(time)) if (rate - time).abs() > 0.02 * rate => {
            notices.push(format!("DataRate is {rate} but the time column steps at {time:.3} Hz, which is used"));
            Ok(time)
        }
        (Some(rate), _) => Ok(rate),
        (None, Some(time)) => Ok(time),
        (None, None) => Err("neither DataRate nor the time column gives a frame rate".into()),
    }
}

//! C3D marker recordings (c3d.org's user guide): point data of Intel, DEC and MIPS files, integers or floats.
//!
//! An own reader: the `c3dio` crate refuses 12 of the 85 sample files that labs really have and takes room for as many frames
//! as a header claims; here the file's length bounds everything. Analog samples are stepped over.
//! Frames: TRIAL:ACTUAL_*_FIELD, else POINT:LONG_FRAMES, else the header's count, POINT:FRAMES where that is none or at its
//! limit; never more than the file holds. Points with a negative residual, not finite, or at the origin exactly were not seen.
//! Checked against `c3dio` on all files that it reads, and on one trial in six encodings.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use crate::motion_model::markers::Markers;

const BLOCK: usize = 512;

#[derive(Debug, thiserror::Error)]
pub enum C3dError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("{path}: {what}")]
    Content { path: PathBuf, what: String },
}

/// Reads the points of a `.c3d`; with them come notices, one sentence each.
pub fn read(path: &Path) -> Result<(Markers, Vec<String>), C3dError> {
    let bytes = std::fs::read(path).map_err(|cause| C3dError::Read { path: path.into(), cause })?;
    parse(&bytes).map_err(|what| C3dError::Content { path: path.into(), what })
}

/// Byte order and floats of the machine that wrote the file.
#[derive(Clone, Copy, PartialEq)]
enum Machine {
    Intel,
    Dec,
    Mips,
}

/// A file's bytes, read without ever leaving them.
struct Bytes<'a> {
    bytes: &'a [u8],
    machine: Machine,
}

impl Bytes<'_> {
    fn byte(&self, at: usize) -> Option<u8> {
        self.bytes.get(at).copied()
    }

    fn word(&self, at: usize) -> Option<u16> {
        let pair = [self.byte(at)?, self.byte(at + 1)?];
        Some(if self.machine == Machine::Mips { u16::from_be_bytes(pair) } else { u16::from_le_bytes(pair) })
    }

    fn float(&self, at: usize) -> Option<f32> {
        let four: [u8; 4] = self.bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        let [a, b, c, d] = four;
        Some(match self.machine {
            Machine::Intel => f32::from_le_bytes(four),
            Machine::Mips => f32::from_be_bytes(four),
            // VAX floats: words exchanged, exponent larger by two.
            Machine::Dec => f32::from_le_bytes([c, d, a, b]) / 4.0,
        })
    }
}

/// A parameter's place in the file.
struct Parameter {
    /// -1 characters, 1 bytes, 2 integers, 4 floats.
    kind: i8,
    dimensions: Vec<usize>,
    data: usize,
}

impl Parameter {
    fn count(&self) -> usize {
        self.dimensions.iter().product()
    }

    /// The value `index`, integers as unsigned: counts of frames pass 32767.
    fn number(&self, bytes: &Bytes, index: usize) -> Option<f64> {
        if index >= self.count() {
            return None;
        }
        match self.kind {
            1 => bytes.byte(self.data + index).map(f64::from),
            2 => bytes.word(self.data + 2 * index).map(f64::from),
            4 => bytes.float(self.data + 4 * index).map(f64::from),
            _ => None,
        }
    }

    /// The rows of an array of characters.
    fn texts(&self, bytes: &Bytes) -> Vec<String> {
        let length = self.dimensions.first().copied().unwrap_or(1).max(1);
        let all = bytes.bytes.get(self.data..self.data.saturating_add(self.count())).unwrap_or_default();
        let text = |c: &[u8]| String::from_utf8_lossy(c).trim_matches(|c: char| c.is_whitespace() || c == '\0').to_string();
        if self.kind == -1 { all.chunks(length).map(text).collect() } else { Vec::new() }
    }
}

/// Parameters by `GROUP:NAME`.
type Parameters = HashMap<String, Parameter>;

fn parse(bytes: &[u8]) -> Result<(Markers, Vec<String>), String> {
    if bytes.len() < BLOCK {
        return Err(format!("{} bytes are no C3D file, whose header alone has {BLOCK}", bytes.len()));
    }
    if bytes[1] != 0x50 {
        return Err("the second byte is not 80: this is no C3D file".into());
    }
    let section = BLOCK * usize::from(bytes[0]).saturating_sub(1);
    let machine = match bytes.get(section + 3).filter(|_| bytes[0] > 0) {
        Some(84) => Machine::Intel,
        Some(85) => Machine::Dec,
        Some(86) => Machine::Mips,
        _ => return Err("the parameter section names no processor (84 Intel, 85 DEC, 86 MIPS); the file is damaged".into()),
    };
    let bytes = Bytes { bytes, machine };
    points(&bytes, &parameters(&bytes, section))
}

/// All parameters up to the end of their section or the first record that makes no sense.
fn parameters(bytes: &Bytes, section: usize) -> Parameters {
    let mut groups: HashMap<u8, String> = HashMap::new();
    let mut found: Vec<(u8, String, Parameter)> = Vec::new();
    let mut at = section + 4;
    while let Some((next, id, name, body)) = record(bytes, at) {
        if id < 0 {
            groups.insert(id.unsigned_abs(), name);
        } else if let Some(parameter) = parameter(bytes, body) {
            found.push((id.unsigned_abs(), name, parameter));
        }
        match next {
            Some(next) => at = next,
            None => break,
        }
    }
    let group = |id: &u8| groups.get(id).map_or("", String::as_str).to_string();
    found.into_iter().rev().map(|(id, name, p)| (format!("{}:{name}", group(&id)), p)).collect()
}

/// Place of the next record, group number, name and where the record's content begins; `None` at the end.
fn record(bytes: &Bytes, at: usize) -> Option<(Option<usize>, i8, String, usize)> {
    let length = usize::from((bytes.byte(at)? as i8).unsigned_abs());
    let id = bytes.byte(at + 1)? as i8;
    if length == 0 || id == 0 {
        return None;
    }
    let name = String::from_utf8_lossy(bytes.bytes.get(at + 2..at + 2 + length)?).trim().to_ascii_uppercase();
    let link = at + 2 + length;
    let step = usize::from(bytes.word(link)?);
    Some(((step > 0).then_some(link + step), id, name, link + 2))
}

fn parameter(bytes: &Bytes, at: usize) -> Option<Parameter> {
    let kind = bytes.byte(at)? as i8;
    let rank = usize::from(bytes.byte(at + 1)?);
    let dimensions: Vec<usize> = bytes.bytes.get(at + 2..at + 2 + rank)?.iter().map(|d| usize::from(*d)).collect();
    (rank <= 7).then_some(Parameter { kind, dimensions, data: at + 2 + rank })
}

/// Where the points lie.
struct Layout {
    start: usize,
    frame_bytes: usize,
    points: usize,
    frames: usize,
    /// Of integers; `None`: floats.
    scale: Option<f64>,
}

fn points(bytes: &Bytes, parameters: &Parameters) -> Result<(Markers, Vec<String>), String> {
    let number = |name: &str, index: usize| parameters.get(name).and_then(|p| p.number(bytes, index));
    let rate = number("POINT:RATE", 0).filter(|r| *r > 0.0).or(bytes.float(20).map(f64::from));
    let fps = rate.filter(|r| (1.0..20_000.0).contains(r)).ok_or("POINT:RATE and the header hold no frame rate between 1 and 20000 Hz")?;
    let mut notices = Vec::new();
    let layout = layout(bytes, &number, &mut notices)?;
    let frame = |f: usize| (0..layout.points).map(|p| point(bytes, &layout, f, p)).collect();
    let labels = ["POINT:LABELS", "POINT:LABELS2", "POINT:LABELS3", "POINT:LABELS4"];
    let mut names: Vec<String> = labels.iter().filter_map(|l| parameters.get(*l)).flat_map(|p| p.texts(bytes)).collect();
    names.truncate(layout.points);
    names.extend((names.len()..layout.points).map(|i| format!("unnamed {}", i + 1)));
    let unit = parameters.get("POINT:UNITS").and_then(|p| p.texts(bytes).concat().parse().ok());
    Ok((Markers { names, fps, metres_per_unit: unit.and_then(metres), frames: (0..layout.frames).map(frame).collect() }, notices))
}

/// Metres in a unit's name; `None` for an unknown one.
pub(super) fn metres(unit: String) -> Option<f64> {
    match unit.trim().to_ascii_lowercase().as_str() {
        "mm" | "millimeters" | "millimetres" => Some(0.001),
        "cm" => Some(0.01),
        "m" | "meters" | "metres" => Some(1.0),
        "in" | "inch" | "inches" => Some(0.0254),
        _ => None,
    }
}

fn layout(bytes: &Bytes, number: &dyn Fn(&str, usize) -> Option<f64>, notices: &mut Vec<String>) -> Result<Layout, String> {
    let header = |word: usize| bytes.word(2 * (word - 1)).map_or(0, usize::from);
    // Counts and places are words; floats of damaged files claim anything.
    let word = |name: &str, index: usize| number(name, index).filter(|n| (0.0..65536.0).contains(n)).map(|n| n as usize);
    let count = |name: &str| word(name, 0);
    let points = count("POINT:USED").unwrap_or(header(2));
    if points == 0 {
        return Err("holds no points (POINT:USED is 0): it is no marker recording".into());
    }
    let start = BLOCK * count("POINT:DATA_START").filter(|b| *b > 1).unwrap_or(header(9)).saturating_sub(1);
    let scale = number("POINT:SCALE", 0).filter(|s| *s != 0.0).or(bytes.float(12).map(f64::from)).unwrap_or(0.0);
    if start == 0 || scale == 0.0 || !scale.is_finite() {
        return Err("names no place of the data or no scale of the points; the header is damaged".into());
    }
    let samples = header(3);
    let frame_bytes = if scale > 0.0 { 8 * points + 2 * samples } else { 16 * points + 4 * samples };
    let field = |name: &str| Some(word(name, 0)? + 65536 * word(name, 1)?);
    let trial = field("TRIAL:ACTUAL_START_FIELD").zip(field("TRIAL:ACTUAL_END_FIELD"));
    let of_header = (header(5) + 1).saturating_sub(header(4));
    let declared = trial
        .and_then(|(a, b)| (b + 1).checked_sub(a))
        .or(count("POINT:LONG_FRAMES"))
        .or(count("POINT:FRAMES").filter(|_| header(5) == 65535 || of_header == 0))
        .unwrap_or(of_header);
    let held = bytes.bytes.len().saturating_sub(start) / frame_bytes;
    if declared == 0 || held == 0 {
        return Err(format!("holds no frame of its {points} points ({declared} declared, {held} found)"));
    }
    if held < declared {
        notices.push(format!("{declared} frames are declared but the file ends after {held}"));
    }
    Ok(Layout { start, frame_bytes, points, frames: declared.min(held), scale: (scale > 0.0).then_some(scale) })
}

fn point(bytes: &Bytes, layout: &Layout, frame: usize, point: usize) -> Option<Vector3<f64>> {
    let width = if layout.scale.is_some() { 8 } else { 16 };
    let at = layout.start + frame * layout.frame_bytes + point * width;
    let (x, residual) = match layout.scale {
        Some(scale) => {
            let value = |k: usize| Some(f64::from(bytes.word(at + 2 * k)? as i16));
            (Vector3::new(value(0)?, value(1)?, value(2)?) * scale, value(3)?)
        }
        None => {
            let value = |k: usize| bytes.float(at + 4 * k).map(f64::from);
            (Vector3::new(value(0)?, value(1)?, value(2)?), value(3)?)
        }
    };
    (residual >= 0.0 && x.iter().all(|v| v.is_finite()) && x != Vector3::zeros()).then_some(x)
}

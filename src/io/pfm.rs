//! Portable float map (`Pf`), the Middlebury form of disparities: one channel, rows from the bottom up, a negative scale for
//! little-endian floats, infinity where unknown.

use super::write_atomic;
use crate::rig::rectify::Plane;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum PfmError {
    #[error("cannot write {0}: {1}")]
    Write(PathBuf, std::io::Error),
    #[error("cannot read {0}: {1}")]
    Read(PathBuf, std::io::Error),
    #[error("{0} is not a one-channel PFM file: {1}")]
    Format(PathBuf, &'static str),
}

/// Writes a plane; NaN becomes infinity.
pub fn write_pfm(path: &Path, plane: &Plane) -> Result<(), PfmError> {
    let mut bytes = format!("Pf\n{} {}\n-1.0\n", plane.width(), plane.height()).into_bytes();
    for row in plane.as_raw().chunks_exact(plane.width().max(1) as usize).rev() {
        bytes.extend(row.iter().flat_map(|v| if v.is_nan() { f32::INFINITY } else { *v }.to_le_bytes()));
    }
    write_atomic(path, &bytes).map_err(|e| PfmError::Write(path.to_owned(), e))
}

/// Reads a plane of either byte order; infinity becomes NaN.
pub fn read_pfm(path: &Path) -> Result<Plane, PfmError> {
    let bytes = std::fs::read(path).map_err(|e| PfmError::Read(path.to_owned(), e))?;
    parse(&bytes).map_err(|what| PfmError::Format(path.to_owned(), what))
}

fn parse(bytes: &[u8]) -> Result<Plane, &'static str> {
    let mut at = 0;
    let mut word = || {
        let from = at + bytes.get(at..)?.iter().position(|b| !b.is_ascii_whitespace())?;
        at = from + bytes.get(from..)?.iter().position(u8::is_ascii_whitespace)?;
        std::str::from_utf8(bytes.get(from..at)?).ok()
    };
    if word() != Some("Pf") {
        return Err("it does not start with Pf");
    }
    let mut number = || word()?.parse::<f64>().ok();
    let (Some(width), Some(height), Some(scale)) = (number(), number(), number()) else {
        return Err("width, height or scale is missing");
    };
    if !(1.0..=65535.0).contains(&width) || !(1.0..=65535.0).contains(&height) || scale == 0.0 {
        return Err("width, height or scale is out of range");
    }
    let (width, height) = (width as usize, height as usize);
    let data = bytes.get(at + 1..).filter(|d| d.len() == 4 * width * height).ok_or("the number of pixels is not width x height")?;
    let value = |b: &[u8]| {
        let b = [b[0], b[1], b[2], b[3]];
        let v = if scale < 0.0 { f32::from_le_bytes(b) } else { f32::from_be_bytes(b) };
        if v.is_finite() { v } else { f32::NAN }
    };
    let values = data.chunks_exact(4 * width).rev().flat_map(|row| row.chunks_exact(4).map(value)).collect();
    Plane::from_raw(width as u32, height as u32, values).ok_or("the number of pixels is not width x height")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comes_back_and_opencv_reads_it() {
        use opencv::{imgcodecs, prelude::*};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("d.pfm");
        let plane = Plane::from_fn(7, 5, |x, y| image::Luma([if x == 3 { f32::NAN } else { x as f32 + 0.25 * y as f32 }]));
        write_pfm(&path, &plane).unwrap();
        let same = |a: f32, b: f32| a == b || (!a.is_finite() && !b.is_finite());
        assert!(read_pfm(&path).unwrap().iter().zip(plane.iter()).all(|(a, b)| same(*a, *b)));
        let theirs = imgcodecs::imread(path.to_str().unwrap(), imgcodecs::IMREAD_UNCHANGED).unwrap();
        assert!(theirs.data_typed::<f32>().unwrap().iter().zip(plane.iter()).all(|(a, b)| same(*a, *b)));
    }

    #[test]
    fn damage_is_an_error() {
        for bytes in [&b"PF\n2 2\n-1\n"[..], b"Pf\n2 x\n-1\n", b"Pf\n2 2\n-1\n123", b"Pf\n99999999 2\n-1\n", b"Pf", b""] {
            assert!(parse(bytes).is_err());
        }
        assert!(parse(b"Pf\n1 1\n1.0\n\x3f\x80\0\0").unwrap().get_pixel(0, 0).0[0] == 1.0);
    }
}

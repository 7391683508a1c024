//! Point clouds as binary little-endian PLY: x y z (float), red green blue (uchar), confidence (float) and the upper triangle
//! of the covariance cxx cxy cxz cyy cyz czz (float, m²). Opens in MeshLab, CloudCompare and Open3D.

use super::write_atomic;
use crate::clouds::{Cloud, CloudPoint};
use nalgebra::{Matrix3, Vector3};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{DefaultElement, Property};
use std::path::{Path, PathBuf};

const COVARIANCE: [&str; 6] = ["cxx", "cxy", "cxz", "cyy", "cyz", "czz"];

#[derive(Debug, thiserror::Error)]
pub enum PlyError {
    #[error("cannot write {0}: {1}")]
    Write(PathBuf, std::io::Error),
    #[error("cannot read {0}: {1}")]
    Read(PathBuf, std::io::Error),
    #[error("{0} is not a whole PLY file: {1}")]
    Format(PathBuf, String),
    #[error("{0} has no property {1} at vertex {2}; write the cloud again with muybridge clouds")]
    Missing(PathBuf, &'static str, usize),
    #[error("{0}: property {1} of vertex {2} is not a finite number")]
    NotFinite(PathBuf, &'static str, usize),
}

/// Writes a cloud in the rig's world, metres.
pub fn write_ply(path: &Path, cloud: &Cloud) -> Result<(), PlyError> {
    let floats = |names: &[&str]| names.iter().map(|n| format!("property float {n}\n")).collect::<String>();
    let header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment muybridge cloud, metres\nelement vertex {}\n{}{}{}end_header\n",
        cloud.points.len(),
        floats(&["x", "y", "z"]),
        "property uchar red\nproperty uchar green\nproperty uchar blue\n",
        floats(&["confidence"]) + &floats(&COVARIANCE),
    );
    let mut bytes = header.into_bytes();
    for point in &cloud.points {
        bytes.extend(point.position.iter().flat_map(|v| (*v as f32).to_le_bytes()));
        bytes.extend(point.colour);
        bytes.extend((point.confidence as f32).to_le_bytes());
        let c = &point.covariance;
        bytes.extend([c.m11, c.m12, c.m13, c.m22, c.m23, c.m33].iter().flat_map(|v| (*v as f32).to_le_bytes()));
    }
    write_atomic(path, &bytes).map_err(|e| PlyError::Write(path.to_owned(), e))
}

/// Reads a cloud written by [`write_ply`], in any of PLY's encodings.
pub fn read_ply(path: &Path) -> Result<Cloud, PlyError> {
    let bytes = std::fs::read(path).map_err(|e| PlyError::Read(path.to_owned(), e))?;
    check_length(&bytes).map_err(|what| PlyError::Format(path.to_owned(), what))?;
    let ply = Parser::<DefaultElement>::new().read_ply(&mut &bytes[..]).map_err(|e| PlyError::Format(path.to_owned(), e.to_string()))?;
    let vertices = ply.payload.get("vertex").map_or(&[][..], Vec::as_slice);
    let points = vertices.iter().enumerate().map(|(i, vertex)| point(path, i, vertex)).collect::<Result<_, _>>()?;
    Ok(Cloud { points })
}

/// A header that promises more vertices than bytes follow, or a list that does, must not make the parser reserve memory for them.
fn check_length(bytes: &[u8]) -> Result<(), String> {
    const END: &[u8] = b"end_header";
    let end = bytes.windows(END.len()).position(|w| w == END).ok_or("its header has no end_header")?;
    let header = std::str::from_utf8(&bytes[..end]).map_err(|_| "its header is not text")?;
    if header.lines().any(|l| l.split_whitespace().take(2).eq(["property", "list"])) {
        return Err("it holds lists (faces), a cloud has none; save the vertices alone".into());
    }
    let promised: u64 =
        header.lines().filter_map(|l| l.strip_prefix("element")?.split_whitespace().nth(1)?.parse::<u64>().ok()).max().unwrap_or(0);
    let rest = (bytes.len() - end) as u64;
    if promised > rest { Err(format!("its header promises {promised} vertices, only {rest} bytes follow")) } else { Ok(()) }
}

fn point(path: &Path, index: usize, vertex: &DefaultElement) -> Result<CloudPoint, PlyError> {
    let number = |name: &'static str| {
        let value = match vertex.get(name) {
            Some(Property::Float(v)) => f64::from(*v),
            Some(Property::Double(v)) => *v,
            Some(Property::UChar(v)) => f64::from(*v),
            _ => return Err(PlyError::Missing(path.to_owned(), name, index)),
        };
        if value.is_finite() { Ok(value) } else { Err(PlyError::NotFinite(path.to_owned(), name, index)) }
    };
    let [xx, xy, xz, yy, yz, zz] = COVARIANCE.map(number);
    let (xy, xz, yz) = (xy?, xz?, yz?);
    Ok(CloudPoint {
        position: Vector3::new(number("x")?, number("y")?, number("z")?),
        colour: [number("red")? as u8, number("green")? as u8, number("blue")? as u8],
        confidence: number("confidence")?,
        covariance: Matrix3::new(xx?, xy, xz, xy, yy?, yz, xz, yz, zz?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> Cloud {
        let point = |i: i32| CloudPoint {
            position: Vector3::new(0.5 * f64::from(i), -1.25, 3.0),
            colour: [i as u8, 128, 255],
            confidence: 0.75,
            covariance: Matrix3::new(4.0, 1.0, 0.5, 1.0, 3.0, -0.25, 0.5, -0.25, 2.0) * 2f64.powi(-12),
        };
        Cloud { points: (0..5).map(point).collect() }
    }

    #[test]
    fn comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.ply");
        for cloud in [cloud(), Cloud::default()] {
            write_ply(&path, &cloud).unwrap();
            assert_eq!(read_ply(&path).unwrap(), cloud);
        }
    }

    #[test]
    fn damage_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        write_ply(&path, &cloud()).unwrap();
        let good = std::fs::read(&path).unwrap();
        let end = good.windows(10).position(|w| w == b"end_header").unwrap();
        let header = std::str::from_utf8(&good[..end]).unwrap();
        let swap = |a: &str, b: &str| [header.replace(a, b).as_bytes(), &good[header.len()..]].concat();
        let broken = [
            good[..good.len() - 3].to_vec(),
            good[..40].to_vec(),
            Vec::new(),
            b"plY\n".to_vec(),
            swap("vertex 5", "vertex 4000000000"),
            swap("vertex 5", "vertex 6"),
            swap("float cxx", "float dxx"),
            swap("float x", "florb x"),
        ];
        for bytes in broken {
            std::fs::write(&path, &bytes).unwrap();
            assert!(read_ply(&path).is_err(), "{:?}", String::from_utf8_lossy(&bytes));
        }
        let mut nan = good.clone();
        nan.splice(header.len() + 11..header.len() + 15, f32::NAN.to_le_bytes());
        std::fs::write(&path, &nan).unwrap();
        assert!(matches!(read_ply(&path), Err(PlyError::NotFinite(_, "x", 0))));
    }
}

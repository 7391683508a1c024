//! What model and space files have in common: `.npz` archives of `f64` arrays with a JSON header, hashed, checked.

use std::io::{BufReader, Cursor, Read, Seek};

use nalgebra::{Quaternion, UnitQuaternion};
use npyz::WriterBuilder;
use npyz::npz::{NpzArchive, NpzWriter};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::body::{BALL_JOINTS, Joint};

pub const SKELETON: &str = "muybridge-hanim-78";

/// What is wrong with an archive; the callers add the path and the remedy.
pub enum Fault {
    Foreign(String),
    Version(u32),
    Skeleton(String),
    Damaged(String),
}

/// An array of the file: name, shape, values in C order.
pub struct Array {
    pub name: &'static str,
    pub shape: Vec<u64>,
    pub values: Vec<f64>,
}

pub fn joint_names() -> Vec<String> {
    Joint::ALL[1..].iter().map(|j| j.name().to_string()).collect()
}

/// BLAKE3 of the header, whose own hash is to be empty, and all arrays.
pub fn hash(header: &impl Serialize, arrays: &[Array]) -> String {
    let mut hasher = blake3::Hasher::new();
    // A struct of strings and numbers has no way to fail.
    hasher.update(&serde_json::to_vec(header).unwrap_or_default());
    for array in arrays {
        hasher.update(array.name.as_bytes());
        for n in &array.shape {
            hasher.update(&n.to_le_bytes());
        }
        for v in &array.values {
            hasher.update(&v.to_le_bytes());
        }
    }
    hasher.finalize().to_hex().to_string()
}

/// Stored without compression and without times, so that the same content gives the same bytes.
pub fn archive(header: &impl Serialize, arrays: Vec<Array>) -> std::io::Result<Vec<u8>> {
    let options = || {
        zip::write::FileOptions::default().compression_method(zip::CompressionMethod::Stored).last_modified_time(zip::DateTime::default())
    };
    let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
    let json = serde_json::to_vec_pretty(header)?;
    let mut writer = npz.array::<u8>("header", options())?.default_dtype().shape(&[json.len() as u64]).begin_nd()?;
    writer.extend(json)?;
    writer.finish()?;
    for array in arrays {
        let mut writer = npz.array::<f64>(array.name, options())?.default_dtype().shape(&array.shape).begin_nd()?;
        writer.extend(array.values)?;
        writer.finish()?;
    }
    let cursor = npz.zip_writer().finish().map_err(std::io::Error::other)?;
    Ok(cursor.into_inner())
}

pub struct Reader<R: Read + Seek>(NpzArchive<BufReader<R>>);

impl<R: Read + Seek> Reader<R> {
    pub fn new(file: R) -> Result<Reader<R>, Fault> {
        NpzArchive::new(BufReader::new(file)).map(Reader).map_err(|e| Fault::Foreign(format!("not an .npz archive: {e}")))
    }

    /// The header of this format, version and skeleton.
    pub fn header<H: DeserializeOwned>(&mut self, format: &str, version: u32) -> Result<H, Fault> {
        let bytes = match self.0.by_name("header") {
            Ok(Some(array)) => array.into_vec::<u8>().map_err(|e| e.to_string()),
            Ok(None) => Err("it holds no array `header`".to_string()),
            Err(e) => Err(e.to_string()),
        };
        let bytes = bytes.map_err(Fault::Foreign)?;
        let value: serde_json::Value = serde_json::from_slice(&bytes).map_err(|_| Fault::Foreign("its header is no JSON".into()))?;
        if value["format"] != format {
            return Err(Fault::Foreign("its header names another format".into()));
        }
        let found = value["version"].as_u64().unwrap_or(0) as u32;
        if found != version {
            return Err(Fault::Version(found));
        }
        let found = value["skeleton"].as_str().unwrap_or("unnamed").to_string();
        if found != SKELETON {
            return Err(Fault::Skeleton(found));
        }
        if value["joints"] != serde_json::json!(joint_names()) {
            return Err(Fault::Skeleton(format!("{} joints of other names or order", value["joints"].as_array().map_or(0, Vec::len))));
        }
        serde_json::from_value(value).map_err(|e| Fault::Damaged(format!("its header: {e}")))
    }

    /// An array of finite numbers with `columns` values per row (0 for a plain vector) and its number of rows.
    pub fn array(&mut self, name: &'static str, columns: usize) -> Result<(usize, Vec<f64>), Fault> {
        let read = match self.0.by_name(name) {
            Ok(Some(array)) => {
                let shape = array.shape().to_vec();
                let fits = if columns == 0 { shape.len() == 1 } else { shape.len() == 2 && shape[1] == columns as u64 };
                if fits {
                    array.into_vec::<f64>().map(|v| (shape[0] as usize, v)).map_err(|e| e.to_string())
                } else {
                    Err(format!("shape {shape:?}"))
                }
            }
            Ok(None) => Err("missing".to_string()),
            Err(e) => Err(e.to_string()),
        };
        let (rows, values) = read.map_err(|e| Fault::Damaged(format!("array `{name}`: {e}")))?;
        if values.len() != rows * columns.max(1) || values.iter().any(|v| !v.is_finite()) {
            return Err(Fault::Damaged(format!("array `{name}` is cut short or not finite")));
        }
        Ok((rows, values))
    }
}

/// The 26 quaternions of an array of rows w x y z.
pub fn rotations(values: &[f64]) -> Result<[UnitQuaternion<f64>; BALL_JOINTS], Fault> {
    if values.len() != 4 * BALL_JOINTS {
        return Err(Fault::Damaged("its mean rotations are not one per joint".into()));
    }
    Ok(std::array::from_fn(|j| {
        let q = &values[4 * j..4 * j + 4];
        UnitQuaternion::new_unchecked(Quaternion::new(q[0], q[1], q[2], q[3]))
    }))
}

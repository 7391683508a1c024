//! What model and space files have in common: `.npz` archives of `f64` arrays with a JSON header, hashed, checked.

use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use nalgebra::{Quaternion, UnitQuaternion};
use npyz::npz::file_name_from_array_name;
use npyz::{AutoSerialize, NpyFile, WriteOptions, WriterBuilder};
use serde::Serialize;
use serde::de::DeserializeOwned;
use zip::result::ZipError;
use zip::write::FileOptions;
use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter};

use super::write_atomic;
use crate::body::{BALL_JOINTS, Joint};

/// Bytes that one of the archive may unpack to, besides the first million: numpy's compressed zeros take a thousandth, nobody's
/// motions less than a tenth.
const UNPACKED: u64 = 100;
/// Of an array's description, Python's words for shape and type; numpy's are 128 bytes long.
const LONGEST_DESCRIPTION: usize = 1024;

pub const SKELETON: &str = "muybridge-hanim-78";

/// A kind of archive: its format and version, and the words that errors need.
#[derive(Debug)]
pub struct Kind {
    pub format: &'static str,
    pub version: u32,
    /// "model", and "model file of muybridge" or the like.
    pub short: &'static str,
    pub whole: &'static str,
    /// What makes one, and of what.
    pub command: &'static str,
    pub sources: &'static str,
}

/// What is wrong with an archive.
#[derive(Debug)]
pub enum Fault {
    Foreign(String),
    Version(u32),
    Skeleton(String),
    Damaged(String),
}

#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
    #[error("{path} {}", fault.words(kind))]
    Content { path: PathBuf, kind: &'static Kind, fault: Fault },
}

impl Fault {
    /// What is wrong and what to do, after the file's name.
    fn words(&self, kind: &Kind) -> String {
        let Kind { version, short, whole, command, sources, .. } = kind;
        match self {
            Fault::Foreign(why) => format!("is no {whole} ({why}); `{command}` makes one"),
            Fault::Version(found) => format!("is a {short} of version {found}, this program reads {version}; build it again"),
            Fault::Skeleton(found) => {
                format!("is a {short} of another skeleton ({found}), {SKELETON} is needed; build it again from the {sources}")
            }
            Fault::Damaged(why) => format!("is damaged: {why}; build or copy it again"),
        }
    }
}

/// Opens and decodes a file of a kind.
pub fn read<T>(path: &Path, kind: &'static Kind, decode: impl FnOnce(File) -> Result<T, Fault>) -> Result<T, ArchiveError> {
    let file = File::open(path).map_err(|cause| ArchiveError::Read { path: path.into(), cause })?;
    decode(file).map_err(|fault| ArchiveError::Content { path: path.into(), kind, fault })
}

/// Writes a file, whole or not at all.
pub fn write(path: &Path, bytes: std::io::Result<Vec<u8>>) -> Result<(), ArchiveError> {
    bytes.and_then(|bytes| write_atomic(path, &bytes)).map_err(|cause| ArchiveError::Write { path: path.into(), cause })
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
        // Many chunks together are hashed side by side.
        for values in array.values.chunks(8192) {
            hasher.update(&values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
        }
    }
    hasher.finalize().to_hex().to_string()
}

/// Stored without compression and without times, so that the same content gives the same bytes.
pub fn archive(header: &impl Serialize, arrays: Vec<Array>) -> std::io::Result<Vec<u8>> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let json = serde_json::to_vec_pretty(header)?;
    put(&mut zip, "header", &[json.len() as u64], json)?;
    for array in arrays {
        put(&mut zip, array.name, &array.shape, array.values)?;
    }
    Ok(zip.finish().map_err(std::io::Error::other)?.into_inner())
}

fn put<T: AutoSerialize>(zip: &mut ZipWriter<Cursor<Vec<u8>>>, name: &str, shape: &[u64], values: Vec<T>) -> std::io::Result<()> {
    let options = FileOptions::default().compression_method(CompressionMethod::Stored).last_modified_time(DateTime::default());
    zip.start_file(file_name_from_array_name(name), options)?;
    let mut writer = WriteOptions::new().default_dtype().shape(shape).writer(zip).begin_nd()?;
    writer.extend(values)?;
    writer.finish()
}

pub struct Reader<R: Read + Seek> {
    archive: ZipArchive<BufReader<R>>,
    /// Bytes that an entry may unpack to.
    limit: u64,
}

impl<R: Read + Seek> Reader<R> {
    pub fn new(mut file: R) -> Result<Reader<R>, Fault> {
        let foreign = |why: String| Fault::Foreign(format!("not an .npz archive: {why}"));
        let length = file.seek(SeekFrom::End(0)).and_then(|length| file.rewind().map(|()| length)).map_err(|e| foreign(e.to_string()))?;
        let archive = ZipArchive::new(BufReader::new(file)).map_err(|e| foreign(e.to_string()))?;
        Ok(Reader { archive, limit: 1_000_000 + UNPACKED * length })
    }

    /// The bytes of an array's file; `None` where there is none.
    fn entry(&mut self, name: &str) -> Result<Option<Vec<u8>>, String> {
        let entry = match self.archive.by_name(&format!("{name}.npy")) {
            Ok(entry) => entry,
            Err(ZipError::FileNotFound) => return Ok(None),
            Err(error) => return Err(error.to_string()),
        };
        let mut bytes = Vec::new();
        entry.take(self.limit + 1).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        if bytes.len() as u64 > self.limit {
            return Err(format!("it unpacks to more than {UNPACKED} times the archive's size"));
        }
        Ok(Some(bytes))
    }

    /// The header of this kind and skeleton.
    pub fn header<H: DeserializeOwned>(&mut self, kind: &Kind) -> Result<H, Fault> {
        let entry = self.entry("header").and_then(|entry| entry.ok_or("it holds no array `header`".into()));
        let bytes = entry.and_then(|entry| numbers::<u8>(&entry)).map_err(Fault::Foreign)?.1;
        let value: serde_json::Value = serde_json::from_slice(&bytes).map_err(|_| Fault::Foreign("its header is no JSON".into()))?;
        if value["format"] != kind.format {
            return Err(Fault::Foreign("its header names another format".into()));
        }
        let found = value["version"].as_u64().unwrap_or(0) as u32;
        if found != kind.version {
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
        let found = self.entry(name).and_then(|entry| entry.ok_or("missing".into())).and_then(|entry| numbers::<f64>(&entry));
        let read = found.and_then(|(shape, values)| match shape[..] {
            [rows] if columns == 0 => Ok((rows, values)),
            [rows, found] if columns > 0 && found == columns => Ok((rows, values)),
            _ => Err(format!("shape {shape:?}")),
        });
        let (rows, values) = read.map_err(|e| Fault::Damaged(format!("array `{name}`: {e}")))?;
        if values.len() != rows * columns.max(1) || values.iter().any(|v| !v.is_finite()) {
            return Err(Fault::Damaged(format!("array `{name}` is cut short or not finite")));
        }
        Ok((rows, values))
    }
}

/// Shape and values of a `.npy` file, in C order. What its description promises is compared with its length first.
fn numbers<T: npyz::Deserialize>(bytes: &[u8]) -> Result<(Vec<usize>, Vec<T>), String> {
    const CUT: &str = "it is cut short";
    let start = match bytes.get(6).ok_or(CUT)? {
        1 => 10,
        _ => 12,
    };
    let length = bytes.get(8..start).ok_or(CUT)?.iter().rev().fold(0, |sum, b| 256 * sum + usize::from(*b));
    let description = bytes.get(start..start + length.min(LONGEST_DESCRIPTION + 1)).ok_or(CUT)?;
    if length > LONGEST_DESCRIPTION || description.iter().filter(|b| b"([{".contains(b)).count() > 8 {
        return Err("its description is not numpy's".into());
    }
    let promised = shape_of(description).ok_or("its description names no shape that fits its length")?;
    if promised.iter().try_fold(1usize, |n, k| n.checked_mul(*k)).is_none_or(|n| n > bytes.len()) {
        return Err(CUT.into());
    }
    let file = NpyFile::new(bytes).map_err(|e| e.to_string())?;
    let shape = file.shape().iter().map(|n| *n as usize).collect();
    Ok((shape, file.into_vec().map_err(|e| e.to_string())?))
}

/// The numbers behind `shape` in an array's description.
fn shape_of(description: &[u8]) -> Option<Vec<usize>> {
    let text = std::str::from_utf8(description).ok()?;
    let (_, after) = text.split_once("shape")?;
    let (_, inside) = after.split_once('(')?;
    let words = inside.split(')').next()?.split(',').map(|word| word.trim().trim_end_matches('L'));
    words.filter(|word| !word.is_empty()).map(|word| word.parse().ok()).collect()
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

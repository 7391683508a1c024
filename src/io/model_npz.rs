//! Model files: `.npz` that numpy opens, with a JSON header.
//!
//! | array | shape | content |
//! |---|---|---|
//! | `header` | (bytes,) uint8 | UTF-8 JSON: format, version, skeleton, joints, activity, subjects and sources of the members, units, hash |
//! | `mean_rotations` | (26, 4) | quaternion w x y z per ball joint; vectors are relative to it |
//! | `mean` | (7800,) | Θ0, index (sample·26 + joint)·3 + axis, radians |
//! | `basis` | (m, 7800) | Θ_i as rows |
//! | `eigenvalues` | (M−1,) | λ of all components |
//! | `root_mean`, `root_basis` | (600,), (m, 600) | root channels and their loadings on α, index sample·6 + channel |
//! | `vectors`, `roots` | (M, 7800), (M, 600) | every member's Ψ and root channels |
//! | `parameters`, `hip_heights_m`, `durations_s` | (M,) | m/s or m; m; s |
//!
//! The archive is stored without compression and without times, so a model has one file only, byte for byte. The header's
//! BLAKE3 hash covers all arrays and the rest of the header. Checked against numpy's own reading in development.

use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek};
use std::path::{Path, PathBuf};

use nalgebra::{DMatrix, DVector, Quaternion, UnitQuaternion};
use npyz::WriterBuilder;
use npyz::npz::{NpzArchive, NpzWriter};
use serde::{Deserialize, Serialize};

use super::write_atomic;
use crate::body::{BALL_JOINTS, DOF, Joint};
use crate::motion_model::{Activity, Member, Model, ROOT_CHANNELS, SAMPLES};

const FORMAT: &str = "muybridge-model";
const VERSION: u32 = 1;
const SKELETON: &str = "muybridge-hanim-78";
const VECTOR: usize = SAMPLES * DOF;
const ROOT: usize = SAMPLES * ROOT_CHANNELS;

#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    #[error("cannot read {path}: {cause}")]
    Read { path: PathBuf, cause: std::io::Error },
    #[error("cannot write {path}: {cause}")]
    Write { path: PathBuf, cause: std::io::Error },
    #[error("{path} is no model file of muybridge ({why}); `muybridge model build` makes one")]
    Foreign { path: PathBuf, why: String },
    #[error("{path} is a model of version {found}, this program reads {VERSION}; build it again")]
    Version { path: PathBuf, found: u32 },
    #[error("{path} is a model of another skeleton ({found}), {SKELETON} is needed; build it again from the recordings")]
    Skeleton { path: PathBuf, found: String },
    #[error("{path} is damaged: {why}; build or copy it again")]
    Damaged { path: PathBuf, why: String },
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    skeleton: String,
    joints: Vec<String>,
    samples: usize,
    root_channels: Vec<String>,
    activity: Activity,
    synthetic: bool,
    parameter_unit: String,
    units: String,
    subjects: Vec<String>,
    sources: Vec<String>,
    blake3: String,
}

impl Header {
    fn of(model: &Model) -> Header {
        Header {
            format: FORMAT.into(),
            version: VERSION,
            skeleton: SKELETON.into(),
            joints: joint_names(),
            samples: SAMPLES,
            root_channels: ["rotation_x", "rotation_y", "rotation_z", "sway", "height", "progress"].map(String::from).into(),
            activity: model.activity,
            synthetic: model.synthetic,
            parameter_unit: if model.activity.is_cyclic() { "m/s" } else { "m" }.into(),
            units: "radians; root lengths divided by the hip height; body frame x left, y up, z forward".into(),
            subjects: model.members.iter().map(|m| m.subject.clone()).collect(),
            sources: model.members.iter().map(|m| m.source.clone()).collect(),
            blake3: String::new(),
        }
    }
}

fn joint_names() -> Vec<String> {
    Joint::ALL[1..].iter().map(|j| j.name().to_string()).collect()
}

/// An array of the file: name, shape, values in C order.
struct Array {
    name: &'static str,
    shape: Vec<u64>,
    values: Vec<f64>,
}

fn arrays(model: &Model) -> Vec<Array> {
    let components = model.basis.ncols() as u64;
    let members = model.members.len() as u64;
    let array = |name, shape: &[u64], values: Vec<f64>| Array { name, shape: shape.to_vec(), values };
    let per_member = |f: fn(&Member) -> &[f64]| model.members.iter().flat_map(|m| f(m).iter().copied()).collect::<Vec<f64>>();
    let quaternions = model.mean_rotations.iter().flat_map(|q| [q.w, q.i, q.j, q.k]).collect();
    vec![
        array("mean_rotations", &[BALL_JOINTS as u64, 4], quaternions),
        array("mean", &[VECTOR as u64], model.mean.as_slice().to_vec()),
        array("basis", &[components, VECTOR as u64], model.basis.as_slice().to_vec()),
        array("eigenvalues", &[model.eigenvalues.len() as u64], model.eigenvalues.clone()),
        array("root_mean", &[ROOT as u64], model.root_mean.as_slice().to_vec()),
        array("root_basis", &[components, ROOT as u64], model.root_basis.as_slice().to_vec()),
        array("vectors", &[members, VECTOR as u64], per_member(|m| m.vector.as_slice())),
        array("roots", &[members, ROOT as u64], per_member(|m| m.root.as_slice())),
        array("parameters", &[members], per_member(|m| std::slice::from_ref(&m.parameter))),
        array("hip_heights_m", &[members], per_member(|m| std::slice::from_ref(&m.hip_height_m))),
        array("durations_s", &[members], per_member(|m| std::slice::from_ref(&m.duration_s))),
    ]
}

fn hash(header: &Header, arrays: &[Array]) -> String {
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

/// Hash of a model's content, the one in its file.
pub fn model_hash(model: &Model) -> String {
    hash(&Header::of(model), &arrays(model))
}

/// Writes a model; the same model gives the same bytes.
pub fn write_model(path: &Path, model: &Model) -> Result<(), ModelFileError> {
    let failed = |cause| ModelFileError::Write { path: path.to_path_buf(), cause };
    let bytes = encode(model).map_err(failed)?;
    write_atomic(path, &bytes).map_err(failed)
}

fn encode(model: &Model) -> std::io::Result<Vec<u8>> {
    let arrays = arrays(model);
    let mut header = Header::of(model);
    header.blake3 = hash(&header, &arrays);
    archive(&header, arrays)
}

fn archive(header: &Header, arrays: Vec<Array>) -> std::io::Result<Vec<u8>> {
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

/// Reads a model and checks kind, version, skeleton, shapes and hash.
pub fn read_model(path: &Path) -> Result<Model, ModelFileError> {
    let file = File::open(path).map_err(|cause| ModelFileError::Read { path: path.to_path_buf(), cause })?;
    let npz = NpzArchive::new(BufReader::new(file))
        .map_err(|e| ModelFileError::Foreign { path: path.to_path_buf(), why: format!("not an .npz archive: {e}") })?;
    Reader { path, npz }.model()
}

struct Reader<'a, R: Read + Seek> {
    path: &'a Path,
    npz: NpzArchive<R>,
}

impl<R: Read + Seek> Reader<'_, R> {
    fn foreign(&self, why: impl ToString) -> ModelFileError {
        ModelFileError::Foreign { path: self.path.to_path_buf(), why: why.to_string() }
    }

    fn damaged(&self, why: impl ToString) -> ModelFileError {
        ModelFileError::Damaged { path: self.path.to_path_buf(), why: why.to_string() }
    }

    fn header(&mut self) -> Result<Header, ModelFileError> {
        let bytes = match self.npz.by_name("header") {
            Ok(Some(array)) => array.into_vec::<u8>().map_err(|e| e.to_string()),
            Ok(None) => Err("it holds no array `header`".to_string()),
            Err(e) => Err(e.to_string()),
        };
        let bytes = bytes.map_err(|e| self.foreign(e))?;
        let value: serde_json::Value = serde_json::from_slice(&bytes).map_err(|_| self.foreign("its header is no JSON"))?;
        if value["format"] != FORMAT {
            return Err(self.foreign("its header names another format"));
        }
        let path = self.path.to_path_buf();
        let found = value["version"].as_u64().unwrap_or(0) as u32;
        if found != VERSION {
            return Err(ModelFileError::Version { path, found });
        }
        let found = value["skeleton"].as_str().unwrap_or("unnamed").to_string();
        if found != SKELETON {
            return Err(ModelFileError::Skeleton { path, found });
        }
        let header: Header = serde_json::from_value(value).map_err(|e| self.damaged(format!("its header: {e}")))?;
        if header.joints != joint_names() || header.samples != SAMPLES {
            return Err(ModelFileError::Skeleton { path, found: format!("{} joints, {} samples", header.joints.len(), header.samples) });
        }
        Ok(header)
    }

    /// An array of finite numbers with `columns` values per row (0 for a plain vector) and its number of rows.
    fn array(&mut self, name: &'static str, columns: usize) -> Result<(usize, Vec<f64>), ModelFileError> {
        let read = match self.npz.by_name(name) {
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
        let (rows, values) = read.map_err(|e| self.damaged(format!("array `{name}`: {e}")))?;
        if values.len() != rows * columns.max(1) || values.iter().any(|v| !v.is_finite()) {
            return Err(self.damaged(format!("array `{name}` is cut short or not finite")));
        }
        Ok((rows, values))
    }

    fn model(mut self) -> Result<Model, ModelFileError> {
        let header = self.header()?;
        let (_, quaternions) = self.array("mean_rotations", 4)?;
        let (_, mean) = self.array("mean", 0)?;
        let (components, basis) = self.array("basis", VECTOR)?;
        let (_, eigenvalues) = self.array("eigenvalues", 0)?;
        let (_, root_mean) = self.array("root_mean", 0)?;
        let (root_components, root_basis) = self.array("root_basis", ROOT)?;
        let (members, vectors) = self.array("vectors", VECTOR)?;
        let (root_members, roots) = self.array("roots", ROOT)?;
        let [(_, parameters), (_, hips), (_, durations)] =
            [self.array("parameters", 0)?, self.array("hip_heights_m", 0)?, self.array("durations_s", 0)?];
        let counts = [root_members, parameters.len(), hips.len(), durations.len(), header.subjects.len(), header.sources.len()];
        let sizes = quaternions.len() == 4 * BALL_JOINTS && mean.len() == VECTOR && root_mean.len() == ROOT;
        if !sizes
            || counts.iter().any(|&n| n != members)
            || root_components != components
            || components == 0
            || eigenvalues.len() < components
        {
            return Err(self.damaged("its arrays do not fit each other"));
        }
        let model = Model {
            activity: header.activity,
            synthetic: header.synthetic,
            mean_rotations: std::array::from_fn(|j| {
                let q = &quaternions[4 * j..4 * j + 4];
                UnitQuaternion::new_unchecked(Quaternion::new(q[0], q[1], q[2], q[3]))
            }),
            mean: DVector::from_vec(mean),
            basis: DMatrix::from_vec(VECTOR, components, basis),
            eigenvalues,
            root_mean: DVector::from_vec(root_mean),
            root_basis: DMatrix::from_vec(ROOT, components, root_basis),
            members: (0..members)
                .map(|i| Member {
                    subject: header.subjects[i].clone(),
                    source: header.sources[i].clone(),
                    parameter: parameters[i],
                    hip_height_m: hips[i],
                    duration_s: durations[i],
                    vector: DVector::from_column_slice(&vectors[i * VECTOR..(i + 1) * VECTOR]),
                    root: DVector::from_column_slice(&roots[i * ROOT..(i + 1) * ROOT]),
                })
                .collect(),
        };
        if model_hash(&model) != header.blake3 {
            return Err(self.damaged("its content does not match its hash"));
        }
        Ok(model)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::synthetic;

    fn model() -> Model {
        let cycles: Vec<_> = (1..3).flat_map(|s| [0.9, 1.4].map(|v| synthetic::subject(Activity::Walking, s).cycle(v, 0))).collect();
        Model::build(Activity::Walking, true, &cycles).unwrap()
    }

    #[test]
    fn comes_back_bit_for_bit_and_has_one_file_only() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("m.npz");
        let model = model();
        write_model(&path, &model).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let read = read_model(&path).unwrap();
        assert_eq!((read.activity, read.synthetic), (Activity::Walking, true));
        assert_eq!((&read.mean, &read.basis, &read.root_basis), (&model.mean, &model.basis, &model.root_basis));
        assert_eq!((&read.eigenvalues, read.mean_rotations), (&model.eigenvalues, model.mean_rotations));
        assert_eq!(read.members[3].vector, model.members[3].vector);
        assert_eq!(read.members[3].source, model.members[3].source);
        write_model(&path, &read).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), bytes);
        assert_eq!(model_hash(&read), model_hash(&model));
    }

    /// The model's archive with one array or the header changed.
    fn altered(change: impl Fn(&mut Header, &mut Vec<Array>)) -> Vec<u8> {
        let model = model();
        let (mut header, mut arrays) = (Header::of(&model), arrays(&model));
        header.blake3 = hash(&header, &arrays);
        change(&mut header, &mut arrays);
        archive(&header, arrays).unwrap()
    }

    #[test]
    fn damaged_and_foreign_files_are_named_as_such() {
        let dir = tempfile::tempdir().unwrap();
        let whole = encode(&model()).unwrap();
        let mut flipped = whole.clone();
        flipped[whole.len() / 2] ^= 1;
        let cases: [(&str, Vec<u8>); 9] = [
            ("not an .npz archive", whole[..whole.len() / 2].to_vec()),
            ("not an .npz archive", b"hello".to_vec()),
            ("is damaged", flipped),
            ("another skeleton (smpl)", altered(|h, _| h.skeleton = "smpl".into())),
            ("version 7", altered(|h, _| h.version = 7)),
            ("another skeleton", altered(|h, _| drop(h.joints.pop()))),
            ("array `roots`: missing", altered(|_, a| a.retain(|a| a.name != "roots"))),
            ("array `mean_rotations`: shape", altered(|_, a| a[0].shape = vec![104])),
            ("does not match its hash", altered(|_, a| a[1].values[5] += 1e-9)),
        ];
        for (part, bytes) in cases {
            let path = dir.path().join("x.npz");
            std::fs::write(&path, bytes).unwrap();
            let message = read_model(&path).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("x.npz") && !message.contains('\n'), "{part}: {message}");
        }
    }
}

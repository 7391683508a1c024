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
use std::path::Path;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::npz::{self, ArchiveError, Array, Fault};
use crate::body::{BALL_JOINTS, DOF};
use crate::motion_model::{Activity, Member, Model, ROOT_CHANNELS, SAMPLES};

const VECTOR: usize = SAMPLES * DOF;
const ROOT: usize = SAMPLES * ROOT_CHANNELS;

const KIND: npz::Kind = npz::Kind {
    format: "muybridge-model",
    version: 1,
    short: "model",
    whole: "model file of muybridge",
    command: "muybridge model build",
    sources: "recordings",
};

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
            format: KIND.format.into(),
            version: KIND.version,
            skeleton: npz::SKELETON.into(),
            joints: npz::joint_names(),
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

/// Hash of a model's content, the one in its file.
pub fn model_hash(model: &Model) -> String {
    npz::hash(&Header::of(model), &arrays(model))
}

/// Writes a model; the same model gives the same bytes.
pub fn write_model(path: &Path, model: &Model) -> Result<(), ArchiveError> {
    npz::write(path, encode(model))
}

fn encode(model: &Model) -> std::io::Result<Vec<u8>> {
    let arrays = arrays(model);
    let mut header = Header::of(model);
    header.blake3 = npz::hash(&header, &arrays);
    npz::archive(&header, arrays)
}

/// Reads a model and checks kind, version, skeleton, shapes and hash.
pub fn read_model(path: &Path) -> Result<Model, ArchiveError> {
    npz::read(path, &KIND, model_of)
}

fn model_of(file: File) -> Result<Model, Fault> {
    let mut npz = npz::Reader::new(file)?;
    let header: Header = npz.header(&KIND)?;
    if header.samples != SAMPLES {
        return Err(Fault::Skeleton(format!("{} samples in place of {SAMPLES}", header.samples)));
    }
    let mean_rotations = npz::rotations(&npz.array("mean_rotations", 4)?.1)?;
    let (_, mean) = npz.array("mean", 0)?;
    let (components, basis) = npz.array("basis", VECTOR)?;
    let (_, eigenvalues) = npz.array("eigenvalues", 0)?;
    let (_, root_mean) = npz.array("root_mean", 0)?;
    let (root_components, root_basis) = npz.array("root_basis", ROOT)?;
    let (members, vectors) = npz.array("vectors", VECTOR)?;
    let (root_members, roots) = npz.array("roots", ROOT)?;
    let [(_, parameters), (_, hips), (_, durations)] =
        [npz.array("parameters", 0)?, npz.array("hip_heights_m", 0)?, npz.array("durations_s", 0)?];
    let counts = [root_members, parameters.len(), hips.len(), durations.len(), header.subjects.len(), header.sources.len()];
    let sizes = mean.len() == VECTOR && root_mean.len() == ROOT;
    if !sizes || counts.iter().any(|&n| n != members) || root_components != components || components == 0 || eigenvalues.len() < components
    {
        return Err(Fault::Damaged("its arrays do not fit each other".into()));
    }
    let model = Model {
        activity: header.activity,
        synthetic: header.synthetic,
        mean_rotations,
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
        return Err(Fault::Damaged("its content does not match its hash".into()));
    }
    Ok(model)
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
        header.blake3 = npz::hash(&header, &arrays);
        change(&mut header, &mut arrays);
        npz::archive(&header, arrays).unwrap()
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

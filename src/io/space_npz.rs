//! Spaces of motions: `.npz` that numpy opens, with a JSON header.
//!
//! | array | shape | content |
//! |---|---|---|
//! | `header` | (bytes,) uint8 | UTF-8 JSON: format, version, skeleton, joints, knots, timing, members, attributes, units, hash |
//! | `mean_rotations` | (26, 4) | quaternion w x y z per ball joint; shapes are relative to it |
//! | `shapes` | (M, knots·84 + 1) | S of every member: index knot·84 + curve, last the stride over the hip height |
//! | `timings` | (M, intervals) or (M, 84·intervals) | T in seconds: knots 1, 2, … for all curves, or curve after curve |
//! | `shape_mean`, `shape_basis`, `shape_eigenvalues` | | S̄, eigenmotions as rows, their variances; the same with `timing_` |
//! | `hip_heights_m` | (M,) | |
//! | `labels`, `labelled` | (M, attributes) | labels, 0 where there is none; 1 where there is one |
//!
//! A space has one file only, byte for byte; the header's hash covers everything.

use std::path::Path;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::npz::{self, ArchiveError, Array, Fault};
use crate::body::BALL_JOINTS;
use crate::math::pca::Pca;
use crate::motion_model::Activity;
use crate::style::space::{Attribute, Layout, Member, Space, Vectors};

const KIND: npz::Kind = npz::Kind {
    format: "muybridge-space",
    version: 1,
    short: "space",
    whole: "space of motions",
    command: "muybridge blend build",
    sources: "motions",
};

#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    skeleton: String,
    joints: Vec<String>,
    /// What the members were cut as; null for whole clips.
    activity: Option<Activity>,
    cyclic: bool,
    intervals: usize,
    timing_per_curve: bool,
    reference: usize,
    members: Vec<String>,
    sources: Vec<String>,
    attributes: Vec<String>,
    units: String,
    blake3: String,
}

impl Header {
    fn of(space: &Space) -> Header {
        Header {
            format: KIND.format.into(),
            version: KIND.version,
            skeleton: npz::SKELETON.into(),
            joints: npz::joint_names(),
            activity: space.activity,
            cyclic: space.layout.cyclic,
            intervals: space.layout.intervals,
            timing_per_curve: space.layout.per_curve,
            reference: space.reference,
            members: space.members.iter().map(|m| m.name.clone()).collect(),
            sources: space.members.iter().map(|m| m.source.clone()).collect(),
            attributes: space.attributes.iter().map(|a| a.name.clone()).collect(),
            units: "curves: 78 joint coordinates, root rotation x y z (radians), sway, height over the hip height less 1, way gone \
                    (hip heights); timing in seconds; body frame x left, y up, z forward"
                .into(),
            blake3: String::new(),
        }
    }
}

fn arrays(space: &Space) -> Vec<Array> {
    let members = space.members.len() as u64;
    let rows = |f: fn(&Member) -> &[f64]| space.members.iter().flat_map(|m| f(m).iter().copied()).collect::<Vec<f64>>();
    let array = |name, shape: &[u64], values: Vec<f64>| Array { name, shape: shape.to_vec(), values };
    let [shape_len, timing_len] = [space.layout.shape_len() as u64, space.layout.timing_len() as u64];
    let attributes = space.attributes.len() as u64;
    let per_label = |f: fn(Option<f64>) -> f64| {
        (0..space.members.len()).flat_map(|m| space.attributes.iter().map(move |a| f(a.labels[m]))).collect::<Vec<f64>>()
    };
    let mut all = vec![
        array("mean_rotations", &[BALL_JOINTS as u64, 4], space.mean_rotations.iter().flat_map(|q| [q.w, q.i, q.j, q.k]).collect()),
        array("shapes", &[members, shape_len], rows(|m| m.vectors.shape.as_slice())),
        array("timings", &[members, timing_len], rows(|m| m.vectors.timing.as_slice())),
        array("hip_heights_m", &[members], rows(|m| std::slice::from_ref(&m.hip_height_m))),
        array("labels", &[members, attributes], per_label(|l| l.unwrap_or(0.0))),
        array("labelled", &[members, attributes], per_label(|l| f64::from(u8::from(l.is_some())))),
    ];
    let names = [["shape_mean", "shape_basis", "shape_eigenvalues"], ["timing_mean", "timing_basis", "timing_eigenvalues"]];
    for (pca, [mean, basis, eigenvalues]) in [&space.shape, &space.timing].into_iter().zip(names) {
        let (length, components) = (pca.basis.nrows() as u64, pca.basis.ncols() as u64);
        all.push(array(mean, &[length], pca.mean.as_slice().to_vec()));
        all.push(array(basis, &[components, length], pca.basis.as_slice().to_vec()));
        all.push(array(eigenvalues, &[pca.eigenvalues.len() as u64], pca.eigenvalues.clone()));
    }
    all
}

/// Writes a space; the same space gives the same bytes.
pub fn write_space(path: &Path, space: &Space) -> Result<(), ArchiveError> {
    let arrays = arrays(space);
    let mut header = Header::of(space);
    header.blake3 = npz::hash(&header, &arrays);
    npz::write(path, npz::archive(&header, arrays))
}

/// Reads a space and checks kind, version, skeleton, shapes and hash.
pub fn read_space(path: &Path) -> Result<Space, ArchiveError> {
    npz::read(path, &KIND, space_of)
}

fn space_of(file: std::fs::File) -> Result<Space, Fault> {
    let mut npz = npz::Reader::new(file)?;
    let header: Header = npz.header(&KIND)?;
    let layout = Layout { intervals: header.intervals, cyclic: header.cyclic, per_curve: header.timing_per_curve };
    if !(2..1_000_000).contains(&layout.intervals) {
        return Err(Fault::Damaged(format!("its header: {} intervals", layout.intervals)));
    }
    let mean_rotations = npz::rotations(&npz.array("mean_rotations", 4)?.1)?;
    let (count, shapes) = npz.array("shapes", layout.shape_len())?;
    let (timed, timings) = npz.array("timings", layout.timing_len())?;
    let (_, hips) = npz.array("hip_heights_m", 0)?;
    let names = header.attributes.len();
    let [(rows, labels), (mask_rows, labelled)] = [npz.array("labels", names)?, npz.array("labelled", names)?];
    let shape = pca(&mut npz, ["shape_mean", "shape_basis", "shape_eigenvalues"], layout.shape_len())?;
    let timing = pca(&mut npz, ["timing_mean", "timing_basis", "timing_eigenvalues"], layout.timing_len())?;
    let counts = [timed, hips.len(), rows, mask_rows, header.members.len(), header.sources.len()];
    if counts.iter().any(|&n| n != count) || count < 2 || header.reference >= count || names == 0 {
        return Err(Fault::Damaged("its arrays do not fit each other".into()));
    }
    let row = |all: &[f64], i: usize, length: usize| DVector::from_column_slice(&all[i * length..(i + 1) * length]);
    let member = |(i, (name, source)): (usize, (&String, &String))| Member {
        name: name.clone(),
        source: source.clone(),
        hip_height_m: hips[i],
        vectors: Vectors { shape: row(&shapes, i, layout.shape_len()), timing: row(&timings, i, layout.timing_len()) },
    };
    let label = |k: usize| (labelled[k] == 1.0).then_some(labels[k]);
    let attribute =
        |(a, name): (usize, &String)| Attribute { name: name.clone(), labels: (0..count).map(|m| label(m * names + a)).collect() };
    let space = Space {
        layout,
        activity: header.activity,
        mean_rotations,
        reference: header.reference,
        members: header.members.iter().zip(&header.sources).enumerate().map(member).collect(),
        attributes: header.attributes.iter().enumerate().map(attribute).collect(),
        shape,
        timing,
    };
    if npz::hash(&Header::of(&space), &arrays(&space)) != header.blake3 {
        return Err(Fault::Damaged("its content does not match its hash".into()));
    }
    Ok(space)
}

fn pca(npz: &mut npz::Reader<std::fs::File>, [mean, basis, eigenvalues]: [&'static str; 3], length: usize) -> Result<Pca, Fault> {
    let (found, mean) = npz.array(mean, 0)?;
    let (components, basis) = npz.array(basis, length)?;
    let (_, eigenvalues) = npz.array(eigenvalues, 0)?;
    if found != length || eigenvalues.len() < components {
        return Err(Fault::Damaged("its principal components do not fit its vectors".into()));
    }
    Ok(Pca { mean: DVector::from_vec(mean), basis: DMatrix::from_vec(length, components, basis), eigenvalues })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::synthetic;
    use crate::style::space::{Example, Options};

    fn space() -> Space {
        let example = |seed: u64| Example::of_cycle(&format!("w{seed}"), &synthetic::subject(Activity::Walking, seed).cycle(1.2, 0));
        let options = Options { activity: Some(Activity::Walking), intervals: Some(40), ..Options::default() };
        let mut space = Space::build(&[1, 2, 3].map(example), &options).unwrap();
        space.set_attribute(Attribute { name: "mood".into(), labels: vec![Some(0.0), None, Some(2.5)] });
        space
    }

    #[test]
    fn comes_back_bit_for_bit() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("s.npz");
        let space = space();
        write_space(&path, &space).unwrap();
        let read = read_space(&path).unwrap();
        assert_eq!((read.layout, read.activity, read.reference), (space.layout, space.activity, space.reference));
        assert_eq!((&read.attributes, read.mean_rotations), (&space.attributes, space.mean_rotations));
        assert!(read.members.iter().zip(&space.members).all(|(a, b)| a.vectors == b.vectors && a.name == b.name));
        assert_eq!((&read.shape.basis, &read.timing.eigenvalues), (&space.shape.basis, &space.timing.eigenvalues));
        let bytes = std::fs::read(&path).unwrap();
        write_space(&path, &read).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), bytes);
    }

    #[test]
    fn damaged_and_foreign_files_are_named_as_such() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.npz");
        let space = space();
        let altered = |change: &dyn Fn(&mut Header, &mut Vec<Array>)| {
            let (mut header, mut arrays) = (Header::of(&space), arrays(&space));
            header.blake3 = npz::hash(&header, &arrays);
            change(&mut header, &mut arrays);
            npz::archive(&header, arrays).unwrap()
        };
        let cases: [(&str, Vec<u8>); 7] = [
            ("no space of motions (not an .npz archive", b"hello".to_vec()),
            ("its header names another format", altered(&|h, _| h.format = "muybridge-model".into())),
            ("version 3", altered(&|h, _| h.version = 3)),
            ("another skeleton", altered(&|h, _| h.joints.swap(0, 1))),
            ("0 intervals", altered(&|h, _| h.intervals = 0)),
            ("array `shapes`: shape", altered(&|h, _| h.intervals = 41)),
            ("does not match its hash", altered(&|_, a| a[1].values[7] += 1e-9)),
        ];
        for (part, bytes) in cases {
            std::fs::write(&path, bytes).unwrap();
            let message = read_space(&path).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("x.npz") && !message.contains('\n'), "{part}: {message}");
        }
    }
}

//! Kalibr's camera chain, `camchain.yaml`: pinhole cameras with `radtan` (k1, k2, p1, p2 of Brown-Conrady) or `equidistant`
//! (OpenCV's fisheye) distortion.
//!
//! `T_cn_cnm1` takes points of the previous camera to this one, metres; the world is cam0's. Keys for other sensors
//! (`T_cam_imu`, `rostopic`) are ignored. Checked against real chains and by compositions of its transforms.

use super::rig_files::{Found, ReadRig, RigFileError, rotation_from_rows};
use crate::rig::{Camera, Lens, Rig, Up};
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::collections::BTreeMap;
use std::path::Path;
use yaml_serde::Value;

#[derive(serde::Deserialize)]
struct Entry {
    camera_model: String,
    intrinsics: Vec<f64>,
    distortion_model: String,
    #[serde(default)]
    distortion_coeffs: Vec<f64>,
    resolution: Vec<u32>,
    #[serde(rename = "T_cn_cnm1")]
    this_from_previous: Option<Vec<Vec<f64>>>,
}

/// Whether a text starts a mapping `camN:`, as chains do.
pub(super) fn is_camera_chain(text: &str) -> bool {
    text.lines().any(|line| line.strip_suffix(':').is_some_and(is_camera_name))
}

fn is_camera_name(name: &str) -> bool {
    name.strip_prefix("cam").is_some_and(|digits| !digits.is_empty() && digits.chars().all(|c| c.is_ascii_digit()))
}

pub(super) fn find(text: &str, path: &Path) -> Result<Found, RigFileError> {
    let yaml = |error: yaml_serde::Error| RigFileError::Yaml { path: path.into(), message: error.to_string().replace('\n', ", ") };
    let entries: BTreeMap<String, Value> = yaml_serde::from_str(text).map_err(yaml)?;
    let mut named: Vec<(String, Value)> = entries.into_iter().filter(|(name, _)| is_camera_name(name)).collect();
    named.sort_by(|a, b| natord::compare(&a.0, &b.0));
    let mut cameras: Vec<Camera> = Vec::new();
    for (name, value) in named {
        let entry: Entry = yaml_serde::from_value(value).map_err(|error| RigFileError::Yaml {
            path: path.into(),
            message: format!("{name}: {}", error.to_string().replace('\n', ", ")),
        })?;
        let camera = Chained { path, name, entry }.camera(cameras.last())?;
        cameras.push(camera);
    }
    let rig = Rig { cameras, up: Up::default() };
    Ok(Found { read: ReadRig { rig, form: "Kalibr camera chain", notices: Vec::new() }, camera_world: true })
}

struct Chained<'a> {
    path: &'a Path,
    name: String,
    entry: Entry,
}

impl Chained<'_> {
    fn camera(self, previous: Option<&Camera>) -> Result<Camera, RigFileError> {
        let lens = self.lens()?;
        let [fx, fy, cx, cy] = self.entry.intrinsics[..] else {
            return Err(self.wrong("intrinsics", "four numbers, fx, fy, cx, cy in px"));
        };
        let size_px = self
            .entry
            .resolution
            .as_slice()
            .try_into()
            .map_err(|_| self.wrong("resolution", "two whole numbers, width and height in px"))?;
        let (camera_from_world, translation) = self.pose(previous)?;
        let matrix = Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0);
        Ok(Camera { name: self.name, size_px, matrix, lens, camera_from_world, translation })
    }

    fn lens(&self) -> Result<Lens, RigFileError> {
        let terms = &self.entry.distortion_coeffs;
        let four = || self.wrong("distortion_coeffs", "four numbers");
        match (self.entry.camera_model.as_str(), self.entry.distortion_model.as_str()) {
            ("pinhole", "radtan") if terms.len() == 4 => Lens::brown_conrady(terms).ok_or_else(four),
            ("pinhole", "equidistant") => Lens::fisheye(terms).ok_or_else(four),
            ("pinhole", "radtan") => Err(four()),
            ("pinhole", "none") => Ok(Lens::IDEAL),
            (camera, distortion) => {
                let (path, model) = (self.path.to_path_buf(), format!("the model {camera}-{distortion}"));
                Err(RigFileError::Model { path, camera: self.name.clone(), model })
            }
        }
    }

    fn pose(&self, previous: Option<&Camera>) -> Result<(Rotation3<f64>, Vector3<f64>), RigFileError> {
        let expected = "the 4x4 matrix that takes points of the previous camera to this one, in metres";
        let key = || format!("{}: T_cn_cnm1", self.name);
        let (previous, rows) = match (previous, &self.entry.this_from_previous) {
            (None, _) => return Ok((Rotation3::identity(), Vector3::zeros())),
            (Some(_), None) => return Err(RigFileError::Missing { path: self.path.into(), key: key(), expected }),
            (Some(previous), Some(rows)) => (previous, rows),
        };
        let wrong = || RigFileError::Wrong { path: self.path.into(), key: key(), expected };
        if rows.len() != 4 || rows.iter().any(|row| row.len() != 4) || rows[3] != [0.0, 0.0, 0.0, 1.0] {
            return Err(wrong());
        }
        let turn: Vec<f64> = rows[..3].iter().flat_map(|row| &row[..3]).copied().collect();
        let this_from_previous = rotation_from_rows(&turn).ok_or_else(wrong)?;
        let shift = Vector3::new(rows[0][3], rows[1][3], rows[2][3]);
        Ok((this_from_previous * previous.camera_from_world, this_from_previous * previous.translation + shift))
    }

    fn wrong(&self, key: &str, expected: &'static str) -> RigFileError {
        RigFileError::Wrong { path: self.path.into(), key: format!("{}: {key}", self.name), expected }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three cameras; the second is a quarter turn about y from the first, the third straight on from the second.
    const CHAIN: &str = "\
cam0:
  camera_model: pinhole
  intrinsics: [400, 401.5, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [-0.1, 0.01, 0.001, 0]
  resolution: [640, 480]
  T_cam_imu: [[1, 0]]
cam1:
  T_cn_cnm1:
  - [0.0, 0.0, -1.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [1.0, 0.0, 0.0, 0.2]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  intrinsics: [400.0, 401.5, 320.0, 240.0]
  distortion_model: equidistant
  distortion_coeffs: [-0.1, 0.01, 0.001, 0.0]
  resolution: [640, 480]
cam10:
  T_cn_cnm1: [[1, 0, 0, -0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [400.0, 401.5, 320.0, 240.0]
  distortion_model: none
  resolution: [640, 480]
";

    fn refusal(from: &str, to: &str) -> String {
        assert!(CHAIN.contains(from));
        let changed = CHAIN.replacen(from, to, 1);
        assert!(is_camera_chain(&changed));
        find(&changed, Path::new("camchain.yaml")).err().unwrap().to_string()
    }

    #[test]
    fn transforms_are_chained() {
        let found = find(CHAIN, Path::new("camchain.yaml")).unwrap();
        let cameras = &found.read.rig.cameras;
        assert_eq!(cameras.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["cam0", "cam1", "cam10"]);
        assert_eq!(cameras[0].lens, Lens::brown_conrady(&[-0.1, 0.01, 0.001, 0.0]).unwrap());
        assert_eq!(cameras[1].lens, Lens::Fisheye([-0.1, 0.01, 0.001, 0.0]));
        assert_eq!((cameras[2].lens, cameras[0].matrix[(0, 0)], cameras[0].size_px), (Lens::IDEAL, 400.0, [640, 480]));
        // x in cam1 = (0.1 - z, y, 0.2 + x), x in cam10 = that - (0.3, 0, 0).
        let x = Vector3::new(0.5, -0.7, 4.0);
        assert!((cameras[1].camera_point(&x) - Vector3::new(-3.9, -0.7, 0.7)).norm() < 1e-12);
        assert!((cameras[2].camera_point(&x) - Vector3::new(-4.2, -0.7, 0.7)).norm() < 1e-12);
    }

    #[test]
    fn refusals_name_the_camera_and_the_key() {
        let cases = [
            (
                "camera_model: pinhole",
                "camera_model: omni",
                "cam0 is calibrated with the model omni-radtan; calibrate it with Kalibr's pinhole-",
            ),
            ("distortion_model: radtan", "distortion_model: fov", "cam0 is calibrated with the model pinhole-fov"),
            ("camera_model: pinhole", "camera_model: ds", "the model ds-radtan"),
            ("intrinsics: [400, 401.5, 320, 240]", "intrinsics: [400, 401.5]", "`cam0: intrinsics` must be four numbers"),
            ("intrinsics: [400, 401.5, 320, 240]", "intrinsics: 400", "is not YAML: cam0: "),
            ("  resolution: [640, 480]\n", "", "cam0: missing field `resolution`"),
            ("resolution: [640, 480]", "resolution: [640]", "`cam0: resolution` must be two whole numbers"),
            ("distortion_coeffs: [-0.1, 0.01, 0.001, 0]", "distortion_coeffs: [-0.1]", "`cam0: distortion_coeffs` must be four numbers"),
            ("distortion_coeffs: [-0.1, 0.01, 0.001, 0.0]", "distortion_coeffs: []", "`cam1: distortion_coeffs` must be four numbers"),
            ("  - [0.0, 1.0, 0.0, 0.0]\n", "", "`cam1: T_cn_cnm1` must be the 4x4 matrix"),
            ("[0.0, 1.0, 0.0, 0.0]", "[0.0, -1.0, 0.0, 0.0]", "`cam1: T_cn_cnm1` must be the 4x4 matrix"),
            ("[0.0, 1.0, 0.0, 0.0]", "[0.0, .nan, 0.0, 0.0]", "`cam1: T_cn_cnm1` must be the 4x4 matrix"),
            ("  T_cn_cnm1: [[1, 0, 0, -0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n", "", "has no `cam10: T_cn_cnm1`"),
            ("cam1:\n  T_cn_cnm1:", "cam1:\n T_cn_cnm1: [", "is not YAML: "),
        ];
        for (from, to, expected) in cases {
            let message = refusal(from, to);
            assert!(message.contains(expected) && message.starts_with("camchain.yaml: ") && !message.contains('\n'), "{message}");
        }
    }
}

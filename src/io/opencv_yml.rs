//! Rig files of OpenCV's `FileStorage` (YAML, XML or JSON).
//!
//! Many cameras, EasyMocap's keys: `K_NAME` 3x3 px, `dist_NAME`, `R_NAME` Rodrigues or `Rot_NAME` 3x3, `T_NAME` metres,
//! x_in_camera = R x_in_world + t, over one or two files in any order; `W_NAME`, `H_NAME` px where the file has them. Our own
//! files are of this form, with `fisheye_NAME` and `up` besides. Cameras are those that have both `K_` and `T_`; the list
//! `names` is not needed.
//! Two cameras, OpenCV's stereo keys: M1, D1, M2, D2, R, T and their usual other names; the world is the first camera's.
//! R1, R2, P1, P2, Q are of rectified pictures and ignored.
//! Four distortion terms are Brown-Conrady's unless the user or the file says fisheye.
//! Checked against real files and against OpenCV's own reading of what is written.

use super::rig_files::{Found, ReadRig, RigFileError, RigReading, picture_size, rotation_from_rows};
use super::write_atomic;
use crate::math::rotation;
use crate::rig::{Camera, Lens, Rig, Up};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use opencv::core::{self, FileNode, FileStorage, Mat};
use opencv::prelude::*;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Names that OpenCV's users give the keys of a pair; `#` is the camera.
const MATRICES: [&str; 6] = ["M#", "K#", "cameraMatrix#", "camera_matrix_#", "M_#", "K_#"];
const DISTORTIONS: [&str; 8] =
    ["D#", "dist#", "distCoeffs#", "dist_coeffs_#", "distortion_#", "distortion_coefficients_#", "D_#", "dist_#"];
const SIDES: [[&str; 2]; 4] = [["1", "2"], ["L", "R"], ["_left", "_right"], ["left", "right"]];

/// How far a Rodrigues vector and a matrix of one camera may differ: the digits they are printed with, degrees.
const ROTATION_TOLERANCE_DEG: f64 = 0.05;

const MATRIX: &str = "a 3x3 camera matrix in px";
const DISTORTION: &str =
    "4, 5 or 8 distortion terms (k1, k2, p1, p2, k3, k4, k5, k6; thin prism and tilt terms must be zero), or 4 fisheye terms";
const ROTATION: &str = "a Rodrigues vector in radians or a 3x3 rotation matrix";
const TRANSLATION: &str = "three numbers in metres";
const SIZE: &str = "the width and height of the pictures in px";

/// Whether a text has the header of a storage.
pub(super) fn is_storage(text: &str) -> bool {
    let text = text.trim_start();
    text.starts_with("%YAML") || text.starts_with("<?xml") || text.starts_with("<opencv_storage") || text.starts_with('{')
}

pub(super) fn find(files: &[PathBuf], texts: &[String], reading: &RigReading) -> Result<Found, RigFileError> {
    let storages = files.iter().zip(texts).map(|(path, text)| Storage::open(path, text)).collect::<Result<_, _>>()?;
    let source = Source { storages, reading };
    if !source.suffixes("K_").is_empty() && !source.suffixes("T_").is_empty() || source.suffixes("K_").len() > 2 {
        return source.named();
    }
    for matrix in MATRICES {
        for sides in SIDES {
            if sides.iter().all(|side| source.node(&matrix.replace('#', side)).is_some()) {
                return source.stereo(matrix, sides);
            }
        }
    }
    let path = files[0].clone();
    let one = ["camera_matrix", "cameraMatrix", "K", "M"].iter().any(|key| source.node(key).is_some());
    Err(if one { RigFileError::OneCamera { path } } else { RigFileError::Unknown { path } })
}

/// Writes a rig with the keys of EasyMocap; [`super::read_rig_files`] and OpenCV's own reader give the same figures back.
pub fn write_opencv_rig(path: &Path, rig: &Rig) -> Result<(), RigFileError> {
    let plain = |name: &str| !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    if let Some(camera) = rig.cameras.iter().find(|c| !plain(&c.name)) {
        return Err(RigFileError::Name { path: path.into(), name: camera.name.clone() });
    }
    write_atomic(path, rig_text(rig).as_bytes()).map_err(|error| RigFileError::Write { path: path.into(), error })
}

fn rig_text(rig: &Rig) -> String {
    let up = if rig.up == Up::Y { "y" } else { "z" };
    let mut text = format!("%YAML:1.0\n---\nup: \"{up}\"\nnames:\n");
    // Writing into a String cannot fail.
    for camera in &rig.cameras {
        let _ = writeln!(text, "  - \"{}\"", camera.name);
    }
    for c in &rig.cameras {
        let turn = c.camera_from_world.matrix();
        let vector = rotation::log(&UnitQuaternion::from_rotation_matrix(&c.camera_from_world));
        let terms = c.lens.terms();
        let _ = writeln!(text, "W_{}: {}\nH_{}: {}", c.name, c.size_px[0], c.name, c.size_px[1]);
        let _ = writeln!(text, "fisheye_{}: {}", c.name, i32::from(c.lens.is_fisheye()));
        text += &matrix_text(&format!("K_{}", c.name), 3, c.matrix.transpose().as_slice());
        text += &matrix_text(&format!("dist_{}", c.name), 1, terms);
        text += &matrix_text(&format!("R_{}", c.name), 3, vector.as_slice());
        text += &matrix_text(&format!("Rot_{}", c.name), 3, turn.transpose().as_slice());
        text += &matrix_text(&format!("T_{}", c.name), 3, c.translation.as_slice());
    }
    text
}

fn matrix_text(key: &str, rows: usize, numbers: &[f64]) -> String {
    let data: Vec<_> = numbers.iter().map(|x| format!("{x:?}")).collect();
    let columns = numbers.len() / rows;
    format!("{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {} ]\n", data.join(", "))
}

struct Storage {
    path: PathBuf,
    storage: FileStorage,
    keys: Vec<String>,
}

impl Storage {
    fn open(path: &Path, text: &str) -> Result<Storage, RigFileError> {
        let failed = |error: opencv::Error| RigFileError::Storage { path: path.into(), message: reason(&error) };
        if text.contains('\0') {
            return Err(RigFileError::Storage { path: path.into(), message: "it holds zero bytes".into() });
        }
        let storage = FileStorage::new(text, core::FileStorage_READ | core::FileStorage_MEMORY, "").map_err(failed)?;
        let keys = storage.root_def().and_then(|root| if root.is_map()? { root.keys() } else { Ok(Default::default()) });
        Ok(Storage { path: path.into(), keys: keys.map_err(failed)?.into_iter().collect(), storage })
    }
}

/// OpenCV's message without its own place in the source.
fn reason(error: &opencv::Error) -> String {
    let message = error.message.replace('\n', " ");
    let told = message.split("error: ").last().unwrap_or_default();
    let told = told.split(" in function ").next().unwrap_or_default();
    told.trim().trim_end_matches('.').to_string()
}

struct Source<'a> {
    storages: Vec<Storage>,
    reading: &'a RigReading,
}

impl Source<'_> {
    fn node(&self, key: &str) -> Option<(&Storage, FileNode)> {
        let storage = self.storages.iter().find(|s| s.keys.iter().any(|k| k == key))?;
        Some((storage, storage.storage.get_node(key).ok()?))
    }

    /// The file that a missing key should have been in.
    fn path(&self) -> PathBuf {
        self.storages.last().map(|s| s.path.clone()).unwrap_or_default()
    }

    /// What follows `prefix` in the keys, naturally sorted.
    fn suffixes(&self, prefix: &str) -> Vec<&str> {
        let mut found: Vec<&str> = self.storages.iter().flat_map(|s| &s.keys).filter_map(|key| key.strip_prefix(prefix)).collect();
        found.sort_by(|a, b| natord::compare(a, b));
        found.dedup();
        found
    }

    /// The numbers of a matrix, a list or a number, row by row; `None` where there is no such key.
    fn numbers(&self, key: &str, expected: &'static str) -> Result<Option<Vec<f64>>, RigFileError> {
        let Some((storage, node)) = self.node(key) else { return Ok(None) };
        let wrong = || RigFileError::Wrong { path: storage.path.clone(), key: key.into(), expected };
        numbers(&node).ok().filter(|n| !n.is_empty()).map(Some).ok_or_else(wrong)
    }

    fn needed(&self, key: &str, expected: &'static str) -> Result<Vec<f64>, RigFileError> {
        self.numbers(key, expected)?.ok_or_else(|| RigFileError::Missing { path: self.path(), key: key.into(), expected })
    }

    fn wrong(&self, key: &str, expected: &'static str) -> RigFileError {
        let path = self.node(key).map_or_else(|| self.path(), |(storage, _)| storage.path.clone());
        RigFileError::Wrong { path, key: key.into(), expected }
    }

    fn named(&self) -> Result<Found, RigFileError> {
        let (intrinsics, poses) = (self.suffixes("K_"), self.suffixes("T_"));
        let names: Vec<&str> = intrinsics.iter().copied().filter(|name| poses.contains(name)).collect();
        if names.is_empty() {
            let list = |names: &[&str]| if names.is_empty() { "none".into() } else { names.join(", ") };
            let (intrinsics, poses) = (list(&intrinsics), list(&poses));
            return Err(RigFileError::NoCommonCamera { path: self.storages[0].path.clone(), intrinsics, poses });
        }
        let mut notices = Vec::new();
        for (of, others, lack) in [(&intrinsics, &poses, "intrinsics but no pose"), (&poses, &intrinsics, "a pose but no intrinsics")] {
            let alone: Vec<&str> = of.iter().copied().filter(|name| !others.contains(name)).collect();
            if !alone.is_empty() {
                notices.push(format!("{} have {lack} and are left out", alone.join(", ")));
            }
        }
        let cameras = names.iter().map(|name| self.named_camera(name)).collect::<Result<_, _>>()?;
        let rig = Rig { cameras, up: self.up()? };
        Ok(Found { read: ReadRig { rig, form: "EasyMocap or OpenCV, named cameras", notices }, camera_world: false })
    }

    fn named_camera(&self, name: &str) -> Result<Camera, RigFileError> {
        let key = |prefix: &str| format!("{prefix}_{name}");
        let fisheye = match self.numbers(&key("fisheye"), "0 or 1")?.as_deref() {
            None => self.reading.fisheye,
            Some([flag]) => *flag != 0.0,
            Some(_) => return Err(self.wrong(&key("fisheye"), "0 or 1")),
        };
        let lens = self.lens(&key("dist"), fisheye)?;
        let size_px = match (self.numbers(&key("W"), SIZE)?, self.numbers(&key("H"), SIZE)?) {
            (Some(width), Some(height)) => pixels(&[width, height].concat()).ok_or_else(|| self.wrong(&key("W"), SIZE))?,
            _ => picture_size(&self.storages[0].path, name, self.reading)?,
        };
        let camera_from_world = self.named_rotation(name)?;
        self.camera(name, size_px, &key("K"), lens, camera_from_world, &key("T"))
    }

    /// `R_` and `Rot_` must agree where both are given.
    fn named_rotation(&self, name: &str) -> Result<Rotation3<f64>, RigFileError> {
        let [vector, matrix] = [format!("R_{name}"), format!("Rot_{name}")];
        if self.node(&vector).is_none() && self.node(&matrix).is_some() {
            return self.rotation(&matrix);
        }
        let camera_from_world = self.rotation(&vector)?;
        if let Some((storage, _)) = self.node(&matrix) {
            let angle_deg = self.rotation(&matrix)?.angle_to(&camera_from_world).to_degrees();
            if angle_deg > ROTATION_TOLERANCE_DEG {
                return Err(RigFileError::Contradiction { path: storage.path.clone(), camera: name.into(), angle_deg });
            }
        }
        Ok(camera_from_world)
    }

    fn stereo(&self, matrix: &str, sides: [&str; 2]) -> Result<Found, RigFileError> {
        let size_px = self.stereo_size()?;
        let second_from_first = self.rotation("R")?;
        let mut cameras = Vec::new();
        for (k, side) in sides.iter().enumerate() {
            let of_side = |name: &str| name.replace('#', side);
            let distortion = DISTORTIONS.iter().map(|d| of_side(d)).find(|key| self.node(key).is_some()).unwrap_or_else(|| of_side("D#"));
            let lens = self.lens(&distortion, self.reading.fisheye)?;
            let turn = if k == 0 { Rotation3::identity() } else { second_from_first };
            let name = format!("cam_{k:02}");
            let size_px = size_px.map_or_else(|| picture_size(&self.storages[0].path, &name, self.reading), Ok)?;
            let mut camera = self.camera(&name, size_px, &of_side(matrix), lens, turn, "T")?;
            if k == 0 {
                camera.translation = Vector3::zeros();
            }
            cameras.push(camera);
        }
        let rig = Rig { cameras, up: Up::default() };
        let mut notices = Vec::new();
        if !self.reading.fisheye && rig.cameras.iter().any(|c| c.lens != Lens::IDEAL && c.lens.terms()[4..].iter().all(|t| *t == 0.0)) {
            notices.push("distortion terms are read as k1, k2, p1, p2; if they are a fisheye lens's, add --fisheye".into());
        }
        Ok(Found { read: ReadRig { rig, form: "OpenCV stereo pair", notices }, camera_world: true })
    }

    fn stereo_size(&self) -> Result<Option<[u32; 2]>, RigFileError> {
        if let (Some(width), Some(height)) = (self.numbers("image_width", SIZE)?, self.numbers("image_height", SIZE)?) {
            return pixels(&[width, height].concat()).map(Some).ok_or_else(|| self.wrong("image_width", SIZE));
        }
        let key = ["imageSize", "image_size", "img_size", "size"].into_iter().find(|key| self.node(key).is_some());
        let Some(key) = key else { return Ok(None) };
        pixels(&self.needed(key, SIZE)?).map(Some).ok_or_else(|| self.wrong(key, SIZE))
    }

    fn camera(
        &self,
        name: &str,
        size_px: [u32; 2],
        matrix: &str,
        lens: Lens,
        camera_from_world: Rotation3<f64>,
        translation: &str,
    ) -> Result<Camera, RigFileError> {
        let rows = self.needed(matrix, MATRIX)?;
        if rows.len() != 9 {
            return Err(self.wrong(matrix, MATRIX));
        }
        let [x, y, z] = self.needed(translation, TRANSLATION)?[..] else { return Err(self.wrong(translation, TRANSLATION)) };
        let translation = Vector3::new(x, y, z);
        Ok(Camera { name: name.into(), size_px, matrix: Matrix3::from_row_slice(&rows), lens, camera_from_world, translation })
    }

    fn lens(&self, key: &str, fisheye: bool) -> Result<Lens, RigFileError> {
        let terms = self.needed(key, DISTORTION)?;
        let lens = if fisheye { Lens::fisheye(&terms) } else { Lens::brown_conrady(&terms) };
        lens.ok_or_else(|| self.wrong(key, DISTORTION))
    }

    fn rotation(&self, key: &str) -> Result<Rotation3<f64>, RigFileError> {
        let numbers = self.needed(key, ROTATION)?;
        let turn = match numbers[..] {
            [x, y, z] => Some(rotation::exp(&Vector3::new(x, y, z)).to_rotation_matrix()),
            _ => rotation_from_rows(&numbers),
        };
        turn.ok_or_else(|| self.wrong(key, ROTATION))
    }

    fn up(&self) -> Result<Up, RigFileError> {
        let Some((_, node)) = self.node("up") else { return Ok(Up::default()) };
        match node.string().unwrap_or_default().as_str() {
            "y" => Ok(Up::Y),
            "z" => Ok(Up::Z),
            _ => Err(self.wrong("up", "\"y\" or \"z\"")),
        }
    }
}

fn numbers(node: &FileNode) -> opencv::Result<Vec<f64>> {
    if node.is_int()? || node.is_real()? {
        return Ok(vec![node.real()?]);
    }
    if node.is_seq()? {
        let items = (0..node.size()? as i32).map(|i| node.at(i)?.real());
        return items.collect();
    }
    let mut whole = Mat::default();
    node.mat()?.convert_to_def(&mut whole, core::CV_64F)?;
    if whole.empty() {
        return Ok(Vec::new());
    }
    Ok(whole.reshape(1, 1)?.try_clone()?.data_typed::<f64>()?.to_vec())
}

fn pixels(numbers: &[f64]) -> Option<[u32; 2]> {
    let whole = numbers.len() == 2 && numbers.iter().all(|x| x.fract() == 0.0 && (1.0..1e6).contains(x));
    whole.then(|| [numbers[0] as u32, numbers[1] as u32])
}

#[cfg(test)]
mod tests {
    use super::super::rig_files::read_rig_files;
    use super::*;

    fn camera(name: &str, lens: Lens, turn: Vector3<f64>, translation: Vector3<f64>) -> Camera {
        let matrix = Matrix3::new(1651.0 / 3.0, 0.25, 321.7, 0.0, 550.6, 1e-7 + 238.4, 0.0, 0.0, 1.0);
        Camera { name: name.into(), size_px: [640, 480], matrix, lens, camera_from_world: Rotation3::new(turn), translation }
    }

    fn rig() -> Rig {
        let cameras = vec![
            camera(
                "7",
                Lens::brown_conrady(&[-0.1, 1.0 / 3e9, 0.0, 2.0]).unwrap(),
                Vector3::new(1.6, 0.1, -0.2),
                Vector3::new(0.1, 1.0, 0.0),
            ),
            camera(
                "11",
                Lens::BrownConrady([0.6, 0.1, 0.0, 0.0, 0.2, 0.9, 0.3, 1e-5]),
                Vector3::new(1.5, 0.0, 0.0),
                Vector3::new(-0.3, 1.0, 0.0),
            ),
            camera("cam-b", Lens::Fisheye([0.1, -1.0 / 3e9, 0.0, 2.0]), Vector3::new(1.7, 0.0, 1e-9), Vector3::new(0.1, 1.3, 1e-12)),
        ];
        Rig { cameras, up: Up::Y }
    }

    fn read_text(text: &str, reading: &RigReading) -> Result<ReadRig, RigFileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.yml");
        std::fs::write(&path, text).unwrap();
        read_rig_files(&[path], reading)
    }

    #[test]
    fn round_trip_keeps_every_figure_and_opencv_reads_the_same() {
        let (rig, folder) = (rig(), tempfile::tempdir().unwrap());
        let path = folder.path().join("out/rig.yml");
        write_opencv_rig(&path, &rig).unwrap();
        let read = read_rig_files(std::slice::from_ref(&path), &RigReading::default()).unwrap();
        assert_eq!((read.rig.up, read.notices.len(), read.rig.cameras.len()), (Up::Y, 0, 3));
        for (camera, expected) in read.rig.cameras.iter().zip(&rig.cameras) {
            assert!((camera.camera_from_world.matrix() - expected.camera_from_world.matrix()).norm() < 1e-14);
            assert_eq!(&Camera { camera_from_world: expected.camera_from_world, ..camera.clone() }, expected);
        }
        // From the file, as any OpenCV program does.
        let storage = FileStorage::new_def(path.to_str().unwrap(), core::FileStorage_READ).unwrap();
        let matrix = storage.get_node("K_11").unwrap().mat().unwrap();
        assert_eq!((matrix.rows(), matrix.cols(), *matrix.at_2d::<f64>(0, 0).unwrap()), (3, 3, 1651.0 / 3.0));
        assert_eq!(*matrix.at_2d::<f64>(1, 2).unwrap(), 238.4 + 1e-7);
        let (mut matrix, vector) = (Mat::default(), storage.get_node("R_7").unwrap().mat().unwrap());
        opencv::calib3d::rodrigues_def(&vector, &mut matrix).unwrap();
        let written = storage.get_node("Rot_7").unwrap().mat().unwrap();
        assert!(core::norm2_def(&matrix, &written).unwrap() < 1e-14);
        assert_eq!(storage.get_node("W_7").unwrap().to_i32().unwrap(), 640);
        assert_eq!(storage.get_node("names").unwrap().at(2).unwrap().string().unwrap(), "cam-b");

        let mut named = rig;
        named.cameras[0].name = "gauche 1".into();
        assert!(write_opencv_rig(&path, &named).unwrap_err().to_string().contains("\"gauche 1\" cannot be a key"));
    }

    /// What OpenCV itself writes for a pair, in its three syntaxes.
    fn stereo_text(keys: [&str; 4], extension: &str, size: bool) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stereo").with_extension(extension);
        let mut storage = FileStorage::new_def(path.to_str().unwrap(), core::FileStorage_WRITE).unwrap();
        let matrix = |f: f64| Mat::from_slice_2d(&[[f, 0.0, 320.0], [0.0, f, 240.0], [0.0, 0.0, 1.0]]).unwrap();
        let row = |numbers: &[f64]| -> Mat { Mat::from_slice(numbers).unwrap().try_clone().unwrap() };
        let mut turn = Mat::default();
        opencv::calib3d::rodrigues_def(&row(&[0.01, -0.02, 0.03]), &mut turn).unwrap();
        let mats = [
            (keys[0], matrix(530.0)),
            (keys[1], row(&[-0.2, 0.1, 0.001, 0.002, -0.03])),
            (keys[2], matrix(540.0)),
            (keys[3], row(&[-0.21, 0.11, 0.0011, 0.0021])),
            ("R", turn),
            ("T", row(&[-0.12, 0.001, 0.002])),
            ("P1", row(&[0.0])),
        ];
        for (key, mat) in &mats {
            core::write_mat(&mut storage, key, mat).unwrap();
        }
        if size {
            core::write_mat(&mut storage, "imageSize", &Mat::from_slice(&[640i32, 480]).unwrap().try_clone().unwrap()).unwrap();
        }
        storage.release().unwrap();
        std::fs::read_to_string(&path).unwrap()
    }

    #[test]
    fn opencvs_own_stereo_files_are_read_in_every_syntax_and_habit() {
        let reading = RigReading { size_px: Some([640, 480]), ..RigReading::default() };
        let expected = read_text(&stereo_text(["M1", "D1", "M2", "D2"], "yml", false), &reading).unwrap();
        let rig = &expected.rig;
        assert_eq!((rig.cameras[0].matrix[(0, 0)], rig.cameras[1].matrix[(1, 1)], rig.up), (530.0, 540.0, Up::Z));
        assert_eq!(rig.cameras[0].lens.terms(), [-0.2, 0.1, 0.001, 0.002, -0.03]);
        // The second camera's place in the first one's frame is -R^T t, in the upright world (x, z, -y).
        let turn = rotation::exp(&Vector3::new(0.01, -0.02, 0.03)).to_rotation_matrix();
        let place = -(turn.inverse() * Vector3::new(-0.12, 0.001, 0.002));
        assert!((rig.cameras[1].centre() - Vector3::new(place.x, place.z, -place.y)).norm() < 1e-12);
        assert!((rig.baselines_m()[0].2 - place.norm()).abs() < 1e-12);
        assert!(expected.notices[0].contains("--fisheye"), "{:?}", expected.notices);
        for (keys, extension) in [
            (["M1", "D1", "M2", "D2"], "xml"),
            (["M1", "D1", "M2", "D2"], "json"),
            (["cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"], "yml"),
            (["K_left", "D_left", "K_right", "D_right"], "yml"),
            (["K1", "D1", "K2", "D2"], "yml"),
        ] {
            assert_eq!(read_text(&stereo_text(keys, extension, true), &RigReading::default()).unwrap(), expected, "{keys:?} {extension}");
        }
        let no_size = read_text(&stereo_text(["M1", "D1", "M2", "D2"], "yml", false), &RigReading::default()).unwrap_err();
        assert!(no_size.to_string().contains("pictures of cam_00 are; add --size"), "{no_size}");
    }

    #[test]
    fn four_terms_are_a_fisheye_lens_where_the_user_says_so() {
        let text = rig_text(&Rig { cameras: rig().cameras[2..].to_vec(), up: Up::Z }).replace("fisheye_cam-b: 1\n", "");
        let lens = |fisheye| read_text(&text, &RigReading { fisheye, ..RigReading::default() }).unwrap().rig.cameras[0].lens;
        assert_eq!((lens(true), lens(false).is_fisheye()), (rig().cameras[2].lens, false));
    }

    #[test]
    fn refusals_name_the_file_and_the_key() {
        let text = rig_text(&rig());
        let k_7 = "K_7: !!opencv-matrix\n   rows: 3\n   cols: 3\n";
        let cases = [
            (k_7, "K_7: !!opencv-matrix\n   rows: 3\n   cols: 4\n", "`K_7` must be a 3x3 camera matrix"),
            (k_7, "K_7: !!opencv-matrix\n   rows: 2\n   cols: 3\n", "`K_7` must be a 3x3 camera matrix"),
            (k_7, "K_7: [1, 2]\nx: !!opencv-matrix\n   rows: 3\n   cols: 3\n", "`K_7` must be a 3x3 camera matrix"),
            (k_7, "K_7: there\nx: !!opencv-matrix\n   rows: 3\n   cols: 3\n", "`K_7` must be a 3x3 camera matrix"),
            ("dist_11:", "list_11:", "has no `dist_11`"),
            ("R_11:", "RR_11:", ""),
            ("W_7: 640", "W_7: 640.5", "`W_7` must be the width and height"),
            ("W_7: 640", "w_7: 640", "pictures of 7 are; add --size"),
            ("up: \"y\"", "up: \"x\"", "`up` must be \"y\" or \"z\""),
            ("up: \"y\"", "up: 3", "`up` must be \"y\" or \"z\""),
            ("fisheye_11: 0", "fisheye_11: [0, 1]", "`fisheye_11` must be 0 or 1"),
            ("fisheye_11: 0", "fisheye_11: 1", "`dist_11` must be 4, 5 or 8"),
            ("data: [ -0.1,", "data: [ .nan,", "7: the distortion holds a number that is not finite"),
            ("%YAML:1.0", "%YAML 4", "rig.yml: is not what OpenCV writes: "),
        ];
        for (from, to, expected) in cases {
            assert!(text.contains(from), "{from}");
            let outcome = read_text(&text.replacen(from, to, 1), &RigReading::default());
            if expected.is_empty() {
                assert!(outcome.is_ok(), "a matrix alone is enough");
                continue;
            }
            let message = outcome.unwrap_err().to_string();
            assert!(message.contains(expected) && message.contains("rig.yml: ") && !message.contains('\n'), "{message}");
        }
        let turned = text.replacen(
            "R_7: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 1.6",
            "R_7: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 1.7",
            1,
        );
        let message = read_text(&turned, &RigReading::default()).unwrap_err().to_string();
        assert!(message.contains("R_7 and Rot_7 are 5."), "{message}");
        let apart = text.replace("T_", "T_x");
        assert!(
            read_text(&apart, &RigReading::default()).unwrap_err().to_string().contains("no camera has both intrinsics (7, 11, cam-b)")
        );
        let no_poses = read_text(&text.replace("T_", "S_"), &RigReading::default()).unwrap_err().to_string();
        assert!(no_poses.contains("and a pose (none)"), "{no_poses}");
    }

    #[test]
    fn files_cut_anywhere_are_errors_or_whole() {
        let text = rig_text(&rig());
        for end in (0..text.len() - 1).step_by(97) {
            match read_text(&text[..end], &RigReading::default()) {
                Ok(read) => assert!(read.rig.cameras.len() < 3, "{end}"),
                Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
            }
        }
    }
}

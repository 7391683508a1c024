//! Rig files in the form of aniposelib and Pose2Sim, `Calib.toml`.
//!
//! Every table but `[metadata]` is a camera, named by its table and sorted naturally: `size` [width, height] px, `matrix`
//! 3x3 px, `distortions` of 4 (k1, k2, p1, p2), 5 (and k3) or 8 (and k4, k5, k6) terms, or the 4 of a fisheye lens with
//! `fisheye = true`, `rotation` a Rodrigues vector, `translation` metres, with x_in_camera = R x_in_world + t.
//! `[metadata] up = "y"` or `"z"` (the default). Other keys are ignored.
//! caliscope's habits are read too: tables `[cameras.N]` for camera `cam_N`, `rotation` as a matrix, `ignore = true`, and
//! tables without any of a camera's keys.
//! Checked against real files of both tools and by a round trip.

use super::rig_files::{self, rotation_from_rows};
use super::write_atomic;
use crate::math::rotation;
use crate::rig::{Camera, Lens, Rig, RigError, Up};
use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

const BROWN_CONRADY_TERMS: &str = "4, 5 or 8 numbers, k1, k2, p1, p2 (and k3 (and k4, k5, k6)); thin prism and tilt terms must be zero";
const FISHEYE_TERMS: &str = "4 numbers, k1, k2, k3, k4, for a fisheye camera";

/// What can be wrong with a rig file; every message names it.
#[derive(Debug, thiserror::Error)]
pub enum CalibError {
    #[error("{}: cannot be read: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error("{}: cannot be written: {error}", path.display())]
    Write { path: PathBuf, error: std::io::Error },
    #[error(
        "{}: is a rig file of another tool; convert it first: muybridge rig convert {} -o Calib.toml",
        path.display(),
        path.file_name().unwrap_or_default().display()
    )]
    Foreign { path: PathBuf },
    #[error("{}: there is no such file, but {}; convert that first: muybridge rig convert {} -o Calib.toml", path.display(), found.display(), found.display())]
    ForeignBeside { path: PathBuf, found: PathBuf },
    #[error("{}: is not TOML: {message}", path.display())]
    Syntax { path: PathBuf, message: String },
    #[error("{}: has no camera table; write one [cam_NN] per camera", path.display())]
    NoCameras { path: PathBuf },
    #[error("{}: [{table}] has no `{key}`; it must be {expected}", path.display())]
    MissingKey { path: PathBuf, table: String, key: &'static str, expected: &'static str },
    #[error("{}: [{table}] `{key}` must be {expected}", path.display())]
    WrongValue { path: PathBuf, table: String, key: &'static str, expected: &'static str },
    #[error("{}: {error}", path.display())]
    Rig { path: PathBuf, error: RigError },
}

/// Reads a rig and refuses it where [`Rig::validate`] does.
pub fn read_rig(path: &Path) -> Result<Rig, CalibError> {
    let text = std::fs::read_to_string(path).map_err(|error| unreadable(path, error))?;
    parse_rig(&text, path)
}

/// The same from text; `path` is what messages call it.
pub fn parse_rig(text: &str, path: &Path) -> Result<Rig, CalibError> {
    let rig = parse_unchecked(text, path)?;
    rig.validate().map_err(|error| CalibError::Rig { path: path.into(), error })?;
    Ok(rig)
}

/// The same without [`Rig::validate`].
pub(super) fn parse_unchecked(text: &str, path: &Path) -> Result<Rig, CalibError> {
    if rig_files::is_foreign(text) {
        return Err(CalibError::Foreign { path: path.into() });
    }
    let tables: Table = text.parse().map_err(|e| syntax_error(path, text, &e))?;
    let up = read_up(path, &tables)?;
    let mut named = camera_tables(&tables);
    named.sort_by(|a, b| natord::compare(&a.0, &b.0));
    if named.is_empty() {
        return Err(CalibError::NoCameras { path: path.into() });
    }
    let cameras = named.into_iter().map(|(name, table)| CameraTable { path, name: &name, table }.camera()).collect::<Result<_, _>>()?;
    Ok(Rig { cameras, up })
}

/// The cameras' tables with their names.
fn camera_tables(tables: &Table) -> Vec<(String, &Table)> {
    const KEYS: [&str; 5] = ["size", "matrix", "distortions", "rotation", "translation"];
    let is_camera = |table: &Table| KEYS.iter().any(|key| table.contains_key(*key)) && table.get("ignore") != Some(&Value::Boolean(true));
    let nested = tables.get("cameras").and_then(Value::as_table).into_iter().flatten();
    let nested = nested.filter_map(|(name, value)| Some((format!("cam_{name}"), value.as_table()?)));
    let plain = tables.iter().filter(|(name, _)| *name != "metadata").filter_map(|(name, value)| Some((name.clone(), value.as_table()?)));
    plain.chain(nested).filter(|(_, table)| is_camera(table)).collect()
}

/// Where another tool's rig file lies in the place, the way from it to this one.
fn unreadable(path: &Path, error: std::io::Error) -> CalibError {
    let beside = path.parent().and_then(rig_files::foreign_file).filter(|_| error.kind() == std::io::ErrorKind::NotFound);
    match beside {
        Some(found) => CalibError::ForeignBeside { path: path.into(), found },
        None => CalibError::Read { path: path.into(), error },
    }
}

/// Writes a rig; [`read_rig`] gives the same figures back.
pub fn write_rig(path: &Path, rig: &Rig) -> Result<(), CalibError> {
    write_atomic(path, rig_text(rig).as_bytes()).map_err(|error| CalibError::Write { path: path.into(), error })
}

fn rig_text(rig: &Rig) -> String {
    let mut text = String::new();
    for c in &rig.cameras {
        let name = Value::String(c.name.clone());
        let rows: Vec<_> = (0..3).map(|r| list(c.matrix.row(r).iter())).collect();
        let rotation = rotation::log(&UnitQuaternion::from_rotation_matrix(&c.camera_from_world));
        // Writing into a String cannot fail.
        let _ = writeln!(text, "[{}]\nname = {name}\nsize = [ {}, {} ]", key_text(&c.name), c.size_px[0], c.size_px[1]);
        let _ = writeln!(text, "matrix = [ {} ]\ndistortions = {}", rows.join(", "), list(c.lens.terms().iter()));
        let _ = writeln!(
            text,
            "rotation = {}\ntranslation = {}\nfisheye = {}\n",
            list(rotation.iter()),
            list(c.translation.iter()),
            c.lens.is_fisheye()
        );
    }
    let up = if rig.up == Up::Y { "y" } else { "z" };
    text + &format!("[metadata]\nup = \"{up}\"\n")
}

/// A TOML key, quoted where it must be.
fn key_text(name: &str) -> String {
    let bare = !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    if bare { name.into() } else { Value::String(name.into()).to_string() }
}

/// A TOML list of the shortest decimals that read back as the same floats.
fn list<'a>(numbers: impl Iterator<Item = &'a f64>) -> String {
    format!("[ {} ]", numbers.map(|x| format!("{x:?}")).collect::<Vec<_>>().join(", "))
}

fn syntax_error(path: &Path, text: &str, error: &toml::de::Error) -> CalibError {
    CalibError::Syntax { path: path.into(), message: toml_message(text, error) }
}

/// The parser's message in one line, with the line number.
pub(super) fn toml_message(text: &str, error: &toml::de::Error) -> String {
    let message = error.message().replace('\n', ", ");
    match error.span().and_then(|span| text.get(..span.start)) {
        Some(before) => format!("line {}: {message}", before.matches('\n').count() + 1),
        None => message,
    }
}

fn read_up(path: &Path, tables: &Table) -> Result<Up, CalibError> {
    let wrong = || CalibError::WrongValue { path: path.into(), table: "metadata".into(), key: "up", expected: "\"y\" or \"z\"" };
    match tables.get("metadata").and_then(|m| m.get("up")) {
        None => Ok(Up::default()),
        Some(value) => value.clone().try_into().map_err(|_| wrong()),
    }
}

struct CameraTable<'a> {
    path: &'a Path,
    name: &'a str,
    table: &'a Table,
}

impl CameraTable<'_> {
    fn camera(&self) -> Result<Camera, CalibError> {
        let fisheye = self.fisheye()?;
        let size = "two whole numbers, the width and height of the pictures in px";
        let size_px = self.read("size", size, |v| {
            let numbers = floats(v).filter(|n| n.len() == 2 && n.iter().all(|x| x.fract() == 0.0 && (1.0..1e6).contains(x)))?;
            Some([numbers[0] as u32, numbers[1] as u32])
        })?;
        let matrix = self.read("matrix", "three rows of three numbers, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px", |v| {
            let rows: Vec<_> = v.as_array()?.iter().map(floats).collect::<Option<_>>()?;
            (rows.len() == 3 && rows.iter().all(|r| r.len() == 3)).then(|| Matrix3::from_row_iterator(rows.into_iter().flatten()))
        })?;
        let expected = if fisheye { FISHEYE_TERMS } else { BROWN_CONRADY_TERMS };
        let lens = self.read("distortions", expected, |v| {
            let terms = floats(v)?;
            if fisheye { Lens::fisheye(&terms) } else { Lens::brown_conrady(&terms) }
        })?;
        let three = |v: &Value| floats(v).filter(|n| n.len() == 3).map(Vector3::from_vec);
        let camera_from_world =
            self.read("rotation", "three numbers, a Rodrigues vector in radians (or a 3x3 matrix)", |v| match three(v) {
                Some(vector) => Some(rotation::exp(&vector).to_rotation_matrix()),
                None => rotation_from_rows(&v.as_array()?.iter().map(floats).collect::<Option<Vec<_>>>()?.concat()),
            })?;
        let translation = self.read("translation", "three numbers in metres", three)?;
        Ok(Camera { name: self.name.into(), size_px, matrix, lens, camera_from_world, translation })
    }

    fn fisheye(&self) -> Result<bool, CalibError> {
        let (path, table) = (self.path.to_path_buf(), self.name.to_string());
        let wrong = CalibError::WrongValue { path, table, key: "fisheye", expected: "true or false" };
        self.table.get("fisheye").map_or(Ok(false), |v| v.as_bool().ok_or(wrong))
    }

    fn read<T>(&self, key: &'static str, expected: &'static str, parse: impl Fn(&Value) -> Option<T>) -> Result<T, CalibError> {
        let (path, table) = (self.path.to_path_buf(), self.name.to_string());
        match self.table.get(key) {
            None => Err(CalibError::MissingKey { path, table, key, expected }),
            Some(value) => parse(value).ok_or(CalibError::WrongValue { path, table, key, expected }),
        }
    }
}

fn floats(value: &Value) -> Option<Vec<f64>> {
    value.as_array()?.iter().map(|x| x.as_float().or_else(|| x.as_integer().map(|i| i as f64))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO_CAMERAS: &str = r#"
[cam_10]
size = [ 640.0, 480.0 ]
matrix = [ [ 550, 0.0, 320.0 ], [ 0.0, 551.0, 240.0 ], [ 0.0, 0.0, 1.0 ] ]
distortions = [ -0.08, 0.01, 0.001, 0.0 ]
rotation = [ 1.6, 0.0, 0.0 ]
translation = [ 0.0, 1.0, 0.0 ]

[cam_2]
name = "left"
size = [ 640, 480 ]
matrix = [ [ 550.0, 0.0, 320.0 ], [ 0.0, 551.0, 240.0 ], [ 0.0, 0.0, 1.0 ] ]
distortions = [ -0.08, 0.01, 0.001, 0.0, 0.2 ]
rotation = [ 1.6, 0.0, 0.0 ]
translation = [ -0.3, 1.0, 0.0 ]
fisheye = false

[metadata]
adjusted = false
up = "y"
"#;

    fn read_text(text: &str) -> Result<Rig, CalibError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("Calib.toml");
        std::fs::write(&path, text).unwrap();
        read_rig(&path)
    }

    fn refusal(from: &str, to: &str) -> String {
        assert!(TWO_CAMERAS.contains(from));
        read_text(&TWO_CAMERAS.replace(from, to)).unwrap_err().to_string()
    }

    #[test]
    fn cameras_come_in_natural_order_with_four_or_five_distortion_terms() {
        let rig = read_text(TWO_CAMERAS).unwrap();
        let names: Vec<_> = rig.cameras.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["cam_2", "cam_10"]);
        assert_eq!(rig.cameras[0].lens.terms(), [-0.08, 0.01, 0.001, 0.0, 0.2]);
        assert_eq!(rig.cameras[1].lens.terms(), [-0.08, 0.01, 0.001, 0.0, 0.0]);
        assert_eq!((rig.cameras[0].size_px, rig.up), ([640, 480], Up::Y));
        assert_eq!(rig.cameras[1].matrix, Matrix3::new(550.0, 0.0, 320.0, 0.0, 551.0, 240.0, 0.0, 0.0, 1.0));
        assert!((rig.baselines_m()[0].2 - 0.3).abs() < 1e-12);
    }

    #[test]
    fn round_trip_keeps_every_figure() {
        let mut rig = read_text(TWO_CAMERAS).unwrap();
        rig.cameras[0].name = "gauche 1".into();
        // Half a turn is where rotation vectors are hardest.
        rig.cameras[0].camera_from_world =
            rotation::exp(&(Vector3::new(0.6, -0.48, 0.64) * (std::f64::consts::PI - 1e-6))).to_rotation_matrix();
        rig.cameras[1].lens = Lens::Fisheye([0.1, -1.0 / 3.0e9, 0.0, 2.0]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out/Calib.toml");
        write_rig(&path, &rig).unwrap();
        let back = read_rig(&path).unwrap();
        let order = [1, 0];
        for (camera, from) in back.cameras.iter().zip(order) {
            let expected = &rig.cameras[from];
            assert!((camera.camera_from_world.matrix() - expected.camera_from_world.matrix()).norm() < 1e-9);
            assert_eq!(&Camera { camera_from_world: expected.camera_from_world, ..camera.clone() }, expected);
        }
        assert_eq!(back.up, rig.up);
    }

    #[test]
    fn refusals_name_the_table_and_the_key() {
        let cases = [
            ("size = [ 640, 480 ]", "", "[cam_2] has no `size`"),
            ("size = [ 640, 480 ]", "size = [ 640.5, 480 ]", "[cam_2] `size` must be two whole numbers"),
            ("rotation = [ 1.6, 0.0, 0.0 ]", "rotation = [ 1.6, 0.0 ]", "[cam_2] `rotation` must be three numbers"),
            ("0.001, 0.0, 0.2 ]", "0.001 ]", "[cam_2] `distortions` must be 4, 5 or 8 numbers"),
            ("fisheye = false", "fisheye = true", "[cam_2] `distortions` must be 4 numbers"),
            ("fisheye = false", "fisheye = 1", "[cam_2] `fisheye` must be true or false"),
            ("[ 0.0, 551.0, 240.0 ], ", "", "`matrix` must be three rows"),
            ("up = \"y\"", "up = \"x\"", "[metadata] `up` must be \"y\" or \"z\""),
            ("name = \"left\"", "name = left", "is not TOML: line 10: "),
            ("translation = [ -0.3,", "translation = [ -300.0,", "looks like millimetres; divide"),
        ];
        for (from, to, expected) in cases {
            let message = refusal(from, to);
            assert!(message.contains(expected) && message.contains("Calib.toml: ") && !message.contains('\n'), "{message}");
        }
        assert!(read_text("[metadata]\nup = \"z\"\n").unwrap_err().to_string().contains("has no camera table"));
    }

    #[test]
    fn real_files_are_read() {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
        if !data.exists() {
            println!("skipped: no {}", data.display());
            return;
        }
        let wide = read_rig(&data.join("multicam/pose2sim-blender-examples/Pose2Sim_cameras.toml")).unwrap();
        assert_eq!((wide.cameras.len(), wide.cameras[0].size_px), (4, [1088, 1920]));
        assert!(wide.baselines_m().iter().all(|b| (2.8..6.8).contains(&b.2)));
        assert!(matches!(wide.validate_stereo(), Err(RigError::ViewsApart { .. })));
        let lab = read_rig(&data.join("footage/p02_run_lab/Calib.toml")).unwrap();
        let expected_m = [0.3006, 0.3128, 0.3346];
        assert!(lab.baselines_m().iter().zip(expected_m).all(|(b, expected)| (b.2 - expected).abs() < 1e-4));
        assert_eq!(lab.validate_stereo(), Ok(()));
    }

    #[test]
    fn our_own_rigs_see_a_whole_person() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("calib");
        let files: Vec<_> =
            folder.read_dir().unwrap().map(|e| e.unwrap().path()).filter(|p| p.extension().is_some_and(|e| e == "toml")).collect();
        assert!(files.len() >= 3);
        for path in files {
            let name = path.file_stem().unwrap().to_str().unwrap();
            let (arm_m, height_m, depths_m) = match name {
                "phantom_lab" => (0.30, 1.0, [3.0, 4.5]),
                "lab" => (0.30, 1.1, [3.0, 5.0]),
                "digiclops" => (0.10, 1.0, [4.0, 6.0]),
                other => panic!("{other}.toml has no figures in this test"),
            };
            let rig = read_rig(&path).unwrap();
            assert!(rig.baselines_m()[..2].iter().all(|b| (b.2 - arm_m).abs() < 0.006), "{name}");
            assert_eq!((rig.cameras.len(), rig.validate_stereo(), rig.up), (3, Ok(()), Up::Z));
            assert!((rig.cameras[0].centre() - Vector3::new(0.0, 0.0, height_m)).norm() < 1e-5, "{name}");
            for (camera, depth_m) in rig.cameras.iter().flat_map(|c| depths_m.map(|d| (c, d))) {
                for z in [0.0, 1.9] {
                    let pixel = camera.project(&Vector3::new(0.0, depth_m, z)).unwrap();
                    assert!((0.0..639.0).contains(&pixel.x) && (0.0..479.0).contains(&pixel.y), "{name} {}: {pixel}", camera.name);
                }
            }
        }
    }

    #[test]
    fn files_of_other_tools_name_the_command_that_converts_them() {
        let foreign = read_text("%YAML:1.0\n---\nK_1: 3\n").unwrap_err().to_string();
        assert!(foreign.contains("another tool; convert it first: muybridge rig convert Calib.toml"), "{foreign}");
        assert!(matches!(read_text("cam0:\n  camera_model: pinhole\n"), Err(CalibError::Foreign { .. })));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("Calib.toml");
        assert!(matches!(read_rig(&path), Err(CalibError::Read { .. })));
        std::fs::write(folder.path().join("intri.yml"), "").unwrap();
        let beside = read_rig(&path).unwrap_err().to_string();
        assert!(beside.contains("intri.yml; convert that first: muybridge rig convert "), "{beside}");
    }
}

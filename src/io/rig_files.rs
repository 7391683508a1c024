//! Rig files of other tools, told by their content: Calib.toml (aniposelib, Pose2Sim, caliscope), EasyMocap's pair
//! intri.yml and extri.yml, OpenCV's stereo files, Kalibr's camera chain.
//!
//! What a file does not say is asked for ([`RigReading`]) or found beside it (the size of the pictures), never guessed.
//! Kalibr's and OpenCV's stereo files put the world into the first camera, whose y axis points down; their rigs are turned
//! upright ([`Rig::upright_at_first_camera`]).

use super::calib_toml::{self, CalibError};
use super::images;
use super::kalibr;
use super::opencv_yml;
use super::video::{self, Video};
use crate::rig::{Rig, RigError, Up, is_file_name};
use nalgebra::{Matrix3, Rotation3};
use std::path::{Path, PathBuf};

/// What can be wrong with a rig file; every message names it.
#[derive(Debug, thiserror::Error)]
pub enum RigFileError {
    #[error("{}: cannot be read: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error("{}: cannot be written: {error}", path.display())]
    Write { path: PathBuf, error: std::io::Error },
    #[error(transparent)]
    Calib(#[from] CalibError),
    #[error("{}: holds no rig; give Calib.toml, intri.yml and extri.yml, intrinsics.yml and extrinsics.yml, or camchain.yaml", path.display())]
    NoRigInFolder { path: PathBuf },
    #[error(
        "{}: is no rig file of a known form (Calib.toml, caliscope's camera_array.toml, EasyMocap's intri.yml and extri.yml, OpenCV's stereo files, Kalibr's camchain.yaml)",
        path.display()
    )]
    Unknown { path: PathBuf },
    #[error("{} and {}: do not belong together; two files are for EasyMocap's and OpenCV's intrinsics and extrinsics only", first.display(), second.display())]
    NotAPair { first: PathBuf, second: PathBuf },
    #[error("{}: is not what OpenCV writes: {message}", path.display())]
    Storage { path: PathBuf, message: String },
    #[error("{}: is nested deeper than any rig; write it again with the tool that calibrated the cameras", path.display())]
    Nested { path: PathBuf },
    #[error("{}: is not YAML: {message}", path.display())]
    Yaml { path: PathBuf, message: String },
    #[error("{}: has no `{key}`; it must be {expected}", path.display())]
    Missing { path: PathBuf, key: String, expected: &'static str },
    #[error("{}: `{key}` must be {expected}", path.display())]
    Wrong { path: PathBuf, key: String, expected: &'static str },
    #[error("{}: holds one camera without its place among the others; calibrate the cameras together (muybridge calibrate)", path.display())]
    OneCamera { path: PathBuf },
    #[error("{}: no camera has both intrinsics ({intrinsics}) and a pose ({poses}); give the two files of one calibration", path.display())]
    NoCommonCamera { path: PathBuf, intrinsics: String, poses: String },
    #[error("{}: R_{camera} and Rot_{camera} are {angle_deg:.2} degrees apart; one of them is of another calibration", path.display())]
    Contradiction { path: PathBuf, camera: String, angle_deg: f64 },
    #[error("{}: {camera} is calibrated with {model}; calibrate it with Kalibr's pinhole-radtan or pinhole-equidistant", path.display())]
    Model { path: PathBuf, camera: String, model: String },
    #[error("{}: does not say how large the pictures of {camera} are; add --size WIDTHxHEIGHT in px, or put its pictures or video beside the file", path.display())]
    NoSize { path: PathBuf, camera: String },
    #[error("{}: its world is not a camera's, so that --height means nothing; leave it out, or add --level", path.display())]
    Height { path: PathBuf },
    #[error("{}: the camera name {name:?} cannot be a key of OpenCV's; use letters, digits, _ and -", path.display())]
    Name { path: PathBuf, name: String },
    #[error("{}: {error}", path.display())]
    Rig { path: PathBuf, error: RigError },
}

/// What the user knows beyond the file.
#[derive(Clone, Debug, PartialEq)]
pub struct RigReading {
    /// Size of the pictures of cameras whose file does not say it.
    pub size_px: Option<[u32; 2]>,
    /// Metres per unit of the file's translations.
    pub scale: f64,
    /// The axis of the world that points up, instead of the file's.
    pub up: Option<Up>,
    /// Four distortion terms in a file that does not name their model are a fisheye lens's.
    pub fisheye: bool,
    /// Turns the world upright at the first camera, as is always done with files whose world is a camera's.
    pub level: bool,
    /// Height of the first camera above the floor of an upright world, metres.
    pub height_m: Option<f64>,
}

impl Default for RigReading {
    fn default() -> Self {
        RigReading { size_px: None, scale: 1.0, up: None, fisheye: false, level: false, height_m: None }
    }
}

/// A rig with what the user should know about its file.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadRig {
    pub rig: Rig,
    /// Such as `Kalibr camera chain`.
    pub form: &'static str,
    pub notices: Vec<String>,
}

/// What a reader of one form found: not scaled, not validated.
pub(super) struct Found {
    pub read: ReadRig,
    /// Whether the form always puts the world into the first camera.
    pub camera_world: bool,
}

/// Reads a rig of any known form from one file, from intrinsics and extrinsics in any order, or from the folder of either.
pub fn read_rig_files(paths: &[PathBuf], reading: &RigReading) -> Result<ReadRig, RigFileError> {
    let files = rig_files(paths)?;
    // At least one, by `rig_files`.
    let path = files[0].clone();
    let Found { mut read, camera_world } = find(&files, reading)?;
    read.rig.cameras.iter_mut().for_each(|c| c.translation *= reading.scale);
    read.rig.up = reading.up.unwrap_or(read.rig.up);
    read.rig.validate().map_err(|error| RigFileError::Rig { path: path.clone(), error })?;
    if camera_world || reading.level {
        read.rig = read.rig.upright_at_first_camera(read.rig.up, reading.height_m.unwrap_or(0.0));
        read.notices.push(level_notice(&read.rig, reading.height_m));
    } else if reading.height_m.is_some() {
        return Err(RigFileError::Height { path });
    } else if world_is_first_cameras(&read.rig) {
        let camera = &read.rig.cameras[0].name;
        read.notices.push(format!("the world is that of {camera}, whose y axis points down in its pictures; --level turns it upright"));
    }
    Ok(read)
}

fn level_notice(rig: &Rig, height_m: Option<f64>) -> String {
    let camera = &rig.cameras[0].name;
    let zero = height_m.map_or_else(
        || format!("its zero is {camera} itself because the floor is not known (add --height METRES)"),
        |h| format!("its zero is on the floor {h} m below {camera}"),
    );
    format!("the world stands upright as {camera} does, {zero}")
}

fn world_is_first_cameras(rig: &Rig) -> bool {
    rig.cameras.first().is_some_and(|c| (c.camera_from_world.matrix() - Matrix3::identity()).norm() < 1e-9 && c.translation.norm() < 1e-9)
}

/// The files behind the given paths, their folders and the missing halves of pairs looked up.
fn rig_files(paths: &[PathBuf]) -> Result<Vec<PathBuf>, RigFileError> {
    let [path] = paths else { return Ok(paths.to_vec()) };
    if !path.is_dir() {
        return Ok(std::iter::once(path.clone()).chain(other_half(path)).collect());
    }
    let file = Some(path.join("Calib.toml")).filter(|file| file.is_file()).or_else(|| foreign_file(path));
    rig_files(&[file.ok_or_else(|| RigFileError::NoRigInFolder { path: path.clone() })?])
}

/// Another tool's rig file in a folder, by its usual name.
pub(super) fn foreign_file(folder: &Path) -> Option<PathBuf> {
    let usual = ["intri.yml", "intrinsics.yml", "camera_array.toml"].map(|name| folder.join(name));
    usual.into_iter().find(|file| file.is_file()).or_else(|| camera_chain(folder))
}

/// The extrinsics beside intrinsics, or the other way round: names that differ by `intri` and `extri`.
fn other_half(path: &Path) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let other = if name.contains("intri") { name.replace("intri", "extri") } else { name.replace("extri", "intri") };
    let other = path.with_file_name(&other);
    (other != path && other.is_file()).then_some(other)
}

fn camera_chain(folder: &Path) -> Option<PathBuf> {
    let mut names: Vec<PathBuf> = folder.read_dir().ok()?.filter_map(|entry| Some(entry.ok()?.path())).collect();
    names.sort();
    names.into_iter().find(|path| path.file_name().is_some_and(|name| name.to_string_lossy().contains("camchain")))
}

fn find(files: &[PathBuf], reading: &RigReading) -> Result<Found, RigFileError> {
    let read = |path: &PathBuf| std::fs::read_to_string(path).map_err(|error| RigFileError::Read { path: path.clone(), error });
    let texts = files.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    if let Some(deep) = texts.iter().position(|text| is_deep(text)) {
        return Err(RigFileError::Nested { path: files[deep].clone() });
    }
    if texts.iter().all(|text| opencv_yml::is_storage(text)) {
        return opencv_yml::find(files, &texts, reading);
    }
    if let [first, second, ..] = files {
        return Err(RigFileError::NotAPair { first: first.clone(), second: second.clone() });
    }
    let (path, text) = (&files[0], &texts[0]);
    if kalibr::is_camera_chain(text) {
        return kalibr::find(text, path);
    }
    // What is neither a table nor an assignment anywhere is no TOML with a slip in it.
    if !text.lines().any(|line| line.trim_start().starts_with('[') || line.contains('=')) {
        return Err(RigFileError::Unknown { path: path.clone() });
    }
    let rig = calib_toml::parse_unchecked(text, path)?;
    Ok(Found { read: ReadRig { rig, form: "Calib.toml", notices: Vec::new() }, camera_world: false })
}

/// Levels of lists, tags or blanks that no rig has. OpenCV's parser, which calls itself for every level, runs out of stack, and
/// YAML's takes a minute for a hundred thousand.
const DEEPEST: usize = 100;

fn is_deep(text: &str) -> bool {
    let tags = text.trim_start().starts_with('<');
    let (mut depth, mut before) = (0usize, ' ');
    for c in text.chars() {
        match (before, c) {
            (_, '[' | '{') => depth += 1,
            (_, ']' | '}') => depth = depth.saturating_sub(1),
            ('<', '/') | ('/', '>') if tags => depth = depth.saturating_sub(1),
            ('<', _) if tags && c.is_alphabetic() => depth += 1,
            _ => {}
        }
        if depth > DEEPEST {
            return true;
        }
        before = c;
    }
    text.lines().any(|line| line.len() - line.trim_start().len() > DEEPEST && !line.trim().is_empty())
}

/// Whether a text that is not a rig in TOML looks like another tool's rig file.
pub(super) fn is_foreign(text: &str) -> bool {
    opencv_yml::is_storage(text) || kalibr::is_camera_chain(text)
}

/// Size of a camera's pictures: what the user says, else that of its pictures or video beside the rig file.
pub(super) fn picture_size(path: &Path, camera: &str, reading: &RigReading) -> Result<[u32; 2], RigFileError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let places = [folder.to_path_buf(), folder.join("images"), folder.join("videos")];
    let beside = || places.iter().find_map(|place| size_in(place, camera));
    reading.size_px.or_else(beside).ok_or_else(|| RigFileError::NoSize { path: path.into(), camera: camera.into() })
}

/// From `camera/` with pictures, `camera.png`, `camera.mp4` and the like.
fn size_in(place: &Path, camera: &str) -> Option<[u32; 2]> {
    let listed = |folder: &Path| {
        let mut paths: Vec<PathBuf> = folder.read_dir().into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path())).collect();
        paths.sort();
        paths
    };
    let named = listed(place).into_iter().filter(|path| path.file_stem().is_some_and(|stem| stem == camera) && path.is_file());
    let own = is_file_name(camera).then(|| place.join(camera));
    own.iter().flat_map(|folder| listed(folder)).chain(named).find_map(|path| file_size(&path))
}

fn file_size(path: &Path) -> Option<[u32; 2]> {
    if images::is_image_name(path) {
        return image::image_dimensions(path).ok().map(|(w, h)| [w, h]);
    }
    if !video::is_video_name(path) {
        return None;
    }
    let frame = Video::open(path).ok()?.read_grey().ok()??;
    Some([frame.width(), frame.height()])
}

/// The rotation nearest to a matrix in rows; `None` where it is no rotation to the digits that files are printed with.
pub(super) fn rotation_from_rows(rows: &[f64]) -> Option<Rotation3<f64>> {
    let matrix = (rows.len() == 9 && rows.iter().all(|x| x.is_finite())).then(|| Matrix3::from_row_slice(rows))?;
    let near = (matrix * matrix.transpose() - Matrix3::identity()).norm() < 1e-2 && matrix.determinant() > 0.0;
    let svd = matrix.svd(true, true);
    near.then(|| Some(Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?)))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::Lens;
    use nalgebra::Vector3;

    fn shared(file: &str) -> Option<PathBuf> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(file);
        if !path.exists() {
            println!("skipped: no {}", path.display());
        }
        path.exists().then_some(path)
    }

    fn read(paths: &[PathBuf], reading: RigReading) -> Result<ReadRig, RigFileError> {
        read_rig_files(paths, &reading)
    }

    #[test]
    fn easymocaps_real_pair_is_read_with_its_traps() {
        let Some(folder) = shared("rigs/easymocap") else { return };
        let without_size = read(std::slice::from_ref(&folder), RigReading::default()).unwrap_err().to_string();
        assert!(without_size.contains("does not say how large the pictures of 7 are; add --size"), "{without_size}");
        let reading = RigReading { size_px: Some([1920, 1080]), ..RigReading::default() };
        let pair = read(&[folder.join("extri.yml"), folder.join("intri.yml")], reading.clone()).unwrap();
        assert_eq!(pair, ReadRig { form: pair.form, ..read(&[folder.join("intri.yml")], reading.clone()).unwrap() });
        assert_eq!(pair, read(&[folder], reading).unwrap());
        let names: Vec<_> = pair.rig.cameras.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["7", "9", "11", "12", "13", "15"]);
        assert!(pair.notices.iter().any(|n| n.contains("1, 10 have intrinsics but no pose")), "{:?}", pair.notices);
        let eleven = &pair.rig.cameras[2];
        assert_eq!((eleven.matrix[(0, 0)], eleven.matrix[(1, 2)], eleven.size_px), (1605.067049, 533.332415, [1920, 1080]));
        assert_eq!(eleven.lens, Lens::brown_conrady(&[-0.003509, -0.546545, -0.002931, 0.006635, 0.0]).unwrap());
        assert_eq!(eleven.translation, Vector3::new(0.327633, 1.096058, 3.260243));
        assert!((eleven.camera_from_world.matrix()[(1, 2)] + 0.926116).abs() < 2e-6);
    }

    #[test]
    fn kalibrs_real_chains_stand_upright() {
        let Some(folder) = shared("rigs") else { return };
        let radtan = read(&[folder.join("kalibr-camchain.yaml")], RigReading { height_m: Some(1.1), ..RigReading::default() }).unwrap();
        let rig = &radtan.rig;
        assert_eq!((rig.cameras.len(), rig.cameras[1].name.as_str(), rig.cameras[1].size_px), (2, "cam1", [640, 480]));
        assert_eq!(rig.cameras[0].matrix[(1, 1)], 386.1281511732971);
        let first = rig.cameras[0].centre();
        assert!((first - Vector3::new(0.0, 0.0, 1.1)).norm() < 1e-12);
        // cam1 stands to the right: its centre is -R^T t of the chain, here in x right, y forward, z up.
        let place = rig.cameras[1].centre() - first;
        assert!((place - Vector3::new(0.0846060511, 0.0173506353, -0.0020279001)).norm() < 1e-9, "{place}");
        assert!((rig.baselines_m()[0].2 - 0.0863909).abs() < 1e-6);
        assert_eq!(rig.validate_stereo(), Ok(()));

        let wide = read(&[folder.join("kalibr-camchain-equidistant.yaml")], RigReading::default()).unwrap();
        assert_eq!(wide.rig.cameras[0].lens.terms()[3], 1.9185066948675424);
        assert!(wide.rig.cameras.iter().all(|c| c.lens.is_fisheye()));
        assert!((wide.rig.baselines_m()[0].2 - 0.112526).abs() < 1e-6);
        assert!(wide.notices[0].contains("add --height"), "{:?}", wide.notices);
    }

    #[test]
    fn caliscopes_real_array_is_read() {
        let Some(path) = shared("calibration/caliscope-4cam/post_optimization/camera_array.toml") else { return };
        let rig = read(std::slice::from_ref(&path), RigReading::default()).unwrap().rig;
        assert_eq!(rig.cameras.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["cam_0", "cam_1", "cam_2", "cam_3"]);
        assert_eq!((rig.cameras[2].size_px, rig.cameras[2].matrix[(1, 1)]), ([1280, 720], 654.4652152401134));
        assert!((rig.cameras[0].camera_from_world.matrix()[(1, 2)] + 0.8878722213268985).abs() < 1e-9);
        // The same cameras in the tool's other file, between tables that are no cameras.
        let config = read(&[path.with_file_name("config.toml")], RigReading::default()).unwrap().rig;
        assert_eq!(config, rig);
    }

    #[test]
    fn opencvs_real_intrinsics_lack_their_extrinsics() {
        let Some(folder) = shared("calibration/opencv-stereo-chessboard") else { return };
        let message = |name: &str| read(&[folder.join(name)], RigReading::default()).unwrap_err().to_string();
        assert!(message("intrinsics.yml").contains("has no `R`"), "{}", message("intrinsics.yml"));
        assert!(message("left_intrinsics.yml").contains("holds one camera"), "{}", message("left_intrinsics.yml"));
        assert!(message("stereo_calib.xml").contains("no rig file of a known form"), "{}", message("stereo_calib.xml"));
    }

    #[test]
    fn worlds_of_cameras_are_told_and_levelled() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("calibration.toml");
        let camera = |name: &str, x: f64| {
            format!(
                "[{name}]\nsize = [640, 480]\nmatrix = [[550.0, 0.0, 320.0], [0.0, 550.0, 240.0], [0.0, 0.0, 1.0]]\n\
                 distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.0, 0.0]\ntranslation = [{x}, 0.0, 0.0]\n"
            )
        };
        std::fs::write(&path, camera("cam_0", 0.0) + &camera("cam_1", -300.0)).unwrap();
        let paths = [path.clone()];
        let millimetres = read(&paths, RigReading::default()).unwrap_err().to_string();
        assert!(millimetres.contains("muybridge rig convert") && millimetres.contains("--scale 0.001"), "{millimetres}");
        let metres = RigReading { scale: 1e-3, ..RigReading::default() };
        let told = read(&paths, metres.clone()).unwrap();
        assert!(told.notices[0].contains("--level"), "{:?}", told.notices);
        assert!(matches!(read(&paths, RigReading { height_m: Some(1.0), ..metres.clone() }), Err(RigFileError::Height { .. })));
        for (up, expected) in [(Up::Z, Vector3::new(0.3, 0.0, 1.2)), (Up::Y, Vector3::new(0.3, 1.2, 0.0))] {
            let level = RigReading { level: true, up: Some(up), height_m: Some(1.2), ..metres.clone() };
            let rig = read(&paths, level).unwrap().rig;
            assert_eq!(rig.up, up);
            assert!((rig.cameras[1].centre() - expected).norm() < 1e-12);
            // What is above in the picture is above in the world.
            let [low, high] = [0.0, 0.5].map(|h| rig.cameras[0].centre() + rig.up.direction() * h);
            let forward = rig.cameras[0].camera_from_world.inverse() * Vector3::z() * 3.0;
            let [low, high] = [low, high].map(|x| rig.cameras[0].project(&(x + forward)).unwrap());
            assert!(low.y - high.y > 50.0 && (low.x - high.x).abs() < 1e-9);
        }
    }

    #[test]
    fn sizes_come_from_pictures_and_videos_beside() {
        let folder = tempfile::tempdir().unwrap();
        let pictures = folder.path().join("images/cam 1");
        std::fs::create_dir_all(&pictures).unwrap();
        std::fs::write(pictures.join(".note"), "no picture").unwrap();
        image::GrayImage::new(48, 32).save(pictures.join("000001.png")).unwrap();
        let path = folder.path().join("intri.yml");
        let size = |camera: &str| picture_size(&path, camera, &RigReading::default());
        assert_eq!(size("cam 1").unwrap(), [48, 32]);
        assert!(matches!(size("cam 2"), Err(RigFileError::NoSize { .. })));
        image::GrayImage::new(40, 24).save(folder.path().join("cam 2.jpg")).unwrap();
        assert_eq!(size("cam 2").unwrap(), [40, 24]);
    }

    #[test]
    fn files_that_are_no_rigs_end_in_one_sentence() {
        let folder = tempfile::tempdir().unwrap();
        let message = |text: &str| {
            let path = folder.path().join("rig.txt");
            std::fs::write(&path, text).unwrap();
            let message = read(&[path], RigReading::default()).unwrap_err().to_string();
            assert!(message.contains("rig.txt: ") && !message.contains('\n'), "{message}");
            message
        };
        assert!(message("").contains("no rig file of a known form"));
        assert!(message("Dear colleague,\nhere are the cameras.\n").contains("no rig file of a known form"));
        assert!(message("[cam_00]\nsize = [640, 480\n").contains("is not TOML: line"));
        assert!(message("%YAML:1.0\n---\nK_1: !!opencv-matrix\n   rows: 3\n").contains("rig.txt: "));
        assert!(read(&[folder.path().into()], RigReading::default()).unwrap_err().to_string().contains("holds no rig"));
        let missing = read(&[folder.path().join("none.yml")], RigReading::default()).unwrap_err().to_string();
        assert!(missing.contains("none.yml: cannot be read"));
    }
}

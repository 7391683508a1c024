//! `*_calibration.json`: how sure a calibration is, and what it left out.

use super::write_atomic;
use crate::math::rotation;
use crate::rig::calibrate::Calibration;
use nalgebra::UnitQuaternion;
use serde::Serialize;
use std::path::Path;

/// Where a calibration came from.
pub struct Source<'a> {
    /// The board in words.
    pub board: &'a str,
    /// The world frame in words.
    pub world: &'a str,
    /// Per camera: pictures looked at, and the numbers of those without a board.
    pub pictures: &'a [(usize, Vec<usize>)],
}

#[derive(Serialize)]
struct Document<'a> {
    software: &'static str,
    board: &'a str,
    world: &'a str,
    /// Root mean square distance of corners, and standard deviation of one coordinate.
    rms_px: f64,
    sigma_px: f64,
    cameras: Vec<CameraPart<'a>>,
    baselines: Vec<Baseline<'a>>,
    /// Poses relative to the first camera: x_in_camera = R exp([turn]x) x_in_first + shift, turn in radians about the solution.
    parameters: Vec<ParameterPart<'a>>,
    /// Of the parameters, in their order.
    covariance: Vec<Vec<f64>>,
    rejected: Vec<RejectedPart<'a>>,
    /// Board poses in the first camera's frame, rotation vector and metres: x_in_first = R x_on_board + translation.
    boards: Vec<BoardPart>,
}

#[derive(Serialize)]
struct CameraPart<'a> {
    name: &'a str,
    size_px: [u32; 2],
    pictures: usize,
    pictures_without_board: &'a [usize],
    views: usize,
    corners: usize,
    corners_rejected: usize,
    rms_px: f64,
    coverage: f64,
}

#[derive(Serialize)]
struct Baseline<'a> {
    first: &'a str,
    second: &'a str,
    length_m: f64,
    sigma_m: f64,
}

#[derive(Serialize)]
struct ParameterPart<'a> {
    camera: &'a str,
    name: &'static str,
    value: f64,
    sigma: f64,
}

#[derive(Serialize)]
struct RejectedPart<'a> {
    camera: &'a str,
    view: usize,
    reason: String,
}

#[derive(Serialize)]
struct BoardPart {
    view: usize,
    rotation: [f64; 3],
    translation_m: [f64; 3],
}

/// Writes what is known about a calibration besides its rig.
pub fn write(path: &Path, calibration: &Calibration, source: &Source) -> std::io::Result<()> {
    let mut text = serde_json::to_string_pretty(&document(calibration, source))?;
    text.push('\n');
    write_atomic(path, text.as_bytes())
}

fn document<'a>(calibration: &'a Calibration, source: &'a Source) -> Document<'a> {
    let cameras = &calibration.rig.cameras;
    let name = |k: usize| cameras[k].name.as_str();
    let parts = cameras.iter().zip(&calibration.quality).zip(source.pictures).map(|((camera, q), (pictures, without))| CameraPart {
        name: &camera.name,
        size_px: camera.size_px,
        pictures: *pictures,
        pictures_without_board: without,
        views: q.views,
        corners: q.corners,
        corners_rejected: q.corners_rejected,
        rms_px: q.rms_px,
        coverage: q.coverage,
    });
    let baseline = |(i, k, length_m, sigma_m)| Baseline { first: name(i), second: name(k), length_m, sigma_m };
    let boards = calibration.boards.iter().map(|(view, pose)| BoardPart {
        view: *view,
        rotation: rotation::log(&UnitQuaternion::new_normalize(pose.rotation.into_inner())).into(),
        translation_m: pose.translation.vector.into(),
    });
    Document {
        software: concat!("muybridge ", env!("CARGO_PKG_VERSION")),
        board: source.board,
        world: source.world,
        rms_px: calibration.rms_px,
        sigma_px: calibration.sigma_px,
        cameras: parts.collect(),
        baselines: calibration.baselines_m().into_iter().map(baseline).collect(),
        parameters: calibration
            .parameters
            .iter()
            .map(|p| ParameterPart { camera: name(p.camera), name: p.name, value: p.value, sigma: p.sigma })
            .collect(),
        covariance: calibration.covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
        rejected: calibration
            .rejected
            .iter()
            .map(|r| RejectedPart { camera: name(r.camera), view: r.view, reason: r.reason.to_string() })
            .collect(),
        boards: boards.collect(),
    }
}

//! What a calibration found, and how sure it is.

use super::bundle::{Bundle, INTRINSICS, Solution, camera_pose, set_pose};
use super::target::Detection;
use super::{CalibrateError, FEWEST_CORNERS, Settled, Work};
use crate::math::arrow::ArrowProblem;
use crate::math::rotation::hat;
use crate::rig::{Camera, Rig, Up};
use nalgebra::{DMatrix, Isometry3, Point2, RowDVector, UnitQuaternion, Vector2, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// Cells across a picture's width in which corners are counted.
pub const COVERAGE_COLUMNS: u32 = 16;

/// A calibrated rig.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// In camera 0's frame.
    pub rig: Rig,
    /// `rig_from_board` by view number.
    pub boards: BTreeMap<usize, Isometry3<f64>>,
    /// All corners that took part.
    pub sightings: Vec<FittedSighting>,
    pub rejected: Vec<Rejected>,
    /// Standard deviation of a corner's coordinate by (1) of the module, px.
    pub sigma_px: f64,
    /// Root mean square distance over all corners, px.
    pub rms_px: f64,
    /// One per camera.
    pub quality: Vec<CameraQuality>,
    /// The free parameters of the cameras, in the order of `covariance`.
    pub parameters: Vec<Parameter>,
    /// Covariance of `parameters`.
    pub covariance: DMatrix<f64>,
}

/// One free parameter. Poses are relative to camera 0, `x_in_camera = R exp([turn]×) x_in_camera_0 + shift`, turn in radians.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    pub camera: usize,
    pub name: &'static str,
    pub value: f64,
    pub sigma: f64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct CameraQuality {
    pub views: usize,
    pub corners: usize,
    /// Corners of the used views that were put aside.
    pub corners_rejected: usize,
    /// Root mean square distance of its corners, px.
    pub rms_px: f64,
    /// Share of the picture's cells (16 across) that hold a corner.
    pub coverage: f64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct FittedSighting {
    pub camera: usize,
    pub view: usize,
    pub corners: Vec<FittedCorner>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct FittedCorner {
    pub id: usize,
    pub pixel: Point2<f64>,
    /// Model minus picture, px.
    pub residual: Vector2<f64>,
}

/// A detection that was put aside.
#[derive(Clone, Debug, PartialEq)]
pub struct Rejected {
    pub camera: usize,
    pub view: usize,
    pub reason: Reason,
}

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Reason {
    #[error("only {0} corners, {FEWEST_CORNERS} are needed")]
    TooFewCorners(usize),
    #[error("its corners lie on a line")]
    NoPose,
    #[error(
        "its corners are {median_px:.2} px off where the other cameras and views put them, above {limit_px:.2} px (wrong labels, blur, cameras out of step)"
    )]
    Disagrees { median_px: f64, limit_px: f64 },
}

/// Covariance of the shared unknowns and the standard deviation of a coordinate; `None` if singular.
pub fn covariance(bundle: &Bundle, solution: &Solution) -> Option<(DMatrix<f64>, f64)> {
    let normal = bundle.linearise(solution);
    let residuals = 2 * bundle.views.iter().flatten().map(|s| s.corners.len()).sum::<usize>();
    let unknowns = normal.local.size() + normal.shared.nrows();
    let variance = 2.0 * normal.cost / residuals.checked_sub(unknowns).filter(|n| *n > 0)? as f64;
    Some((normal.shared_covariance()? * variance, variance.sqrt()))
}

pub(super) fn collect(work: &Work, settled: Settled, detections: &[Detection]) -> Result<Calibration, CalibrateError> {
    let Settled { bundle, solution, views, mut rejected } = settled;
    let singular = || CalibrateError::Singular { camera: solution.cameras[0].name.clone() };
    let (covariance, sigma_px) = covariance(&bundle, &solution).ok_or_else(singular)?;
    let few = detections.iter().filter(|d| d.corners.len() < FEWEST_CORNERS);
    rejected.extend(few.map(|d| Rejected { camera: d.camera, view: d.view, reason: Reason::TooFewCorners(d.corners.len()) }));
    rejected.sort_by_key(|r| (r.view, r.camera));
    let sightings = fitted(&bundle, &solution, &views);
    let quality = (0..solution.cameras.len()).map(|k| quality(&solution.cameras[k], k, &sightings, work.detections)).collect();
    let squares: Vec<f64> = sightings.iter().flat_map(|s| &s.corners).map(|c| c.residual.norm_squared()).collect();
    let rms_px = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    let parameters = parameters(&bundle, &solution.cameras, &covariance);
    let boards = views.into_iter().zip(solution.boards).collect();
    let rig = Rig { cameras: solution.cameras, up: Up::Z };
    Ok(Calibration { rig, boards, sightings, rejected, sigma_px, rms_px, quality, parameters, covariance })
}

fn fitted(bundle: &Bundle, solution: &Solution, views: &[usize]) -> Vec<FittedSighting> {
    let mut sightings = Vec::new();
    for (index, view) in views.iter().enumerate() {
        for sighting in &bundle.views[index] {
            let residuals = bundle.residuals(solution, index, sighting);
            let corner = |((id, pixel), residual): (&(usize, Point2<f64>), Option<Vector2<f64>>)| {
                Some(FittedCorner { id: *id, pixel: *pixel, residual: residual? })
            };
            let corners = sighting.corners.iter().zip(residuals).filter_map(corner).collect();
            sightings.push(FittedSighting { camera: sighting.camera, view: *view, corners });
        }
    }
    sightings
}

fn quality(camera: &Camera, index: usize, sightings: &[FittedSighting], detections: &[&Detection]) -> CameraQuality {
    let own: Vec<&FittedSighting> = sightings.iter().filter(|s| s.camera == index).collect();
    let corners: Vec<&FittedCorner> = own.iter().flat_map(|s| &s.corners).collect();
    let used: BTreeSet<usize> = own.iter().map(|s| s.view).collect();
    let offered: usize = detections.iter().filter(|d| d.camera == index && used.contains(&d.view)).map(|d| d.corners.len()).sum();
    let [columns, rows] = coverage_cells(camera.size_px);
    let side_px = f64::from(camera.size_px[0]) / f64::from(columns);
    let cells: BTreeSet<[i64; 2]> = corners.iter().map(|c| [c.pixel.x, c.pixel.y].map(|v| ((v + 0.5) / side_px).floor() as i64)).collect();
    let square_sum: f64 = corners.iter().map(|c| c.residual.norm_squared()).sum();
    CameraQuality {
        views: own.len(),
        corners: corners.len(),
        corners_rejected: offered - corners.len(),
        rms_px: (square_sum / corners.len().max(1) as f64).sqrt(),
        coverage: cells.len() as f64 / f64::from(columns * rows),
    }
}

/// Square cells across and down a picture.
pub fn coverage_cells(size_px: [u32; 2]) -> [u32; 2] {
    [COVERAGE_COLUMNS, (COVERAGE_COLUMNS * size_px[1]).div_ceil(size_px[0])]
}

const POSE_NAMES: [&str; 6] = ["turn_x", "turn_y", "turn_z", "shift_x_m", "shift_y_m", "shift_z_m"];

fn parameters(bundle: &Bundle, cameras: &[Camera], covariance: &DMatrix<f64>) -> Vec<Parameter> {
    let layout = &bundle.layout;
    let mut parameters = Vec::new();
    for (k, camera) in cameras.iter().enumerate() {
        for unknown in 0..layout.count {
            let columns: Vec<usize> = (0..INTRINSICS).filter(|c| layout.unknown[*c] == Some(unknown)).collect();
            let (name, value) = intrinsic(camera, columns[0], columns.len() > 1);
            parameters.push(Parameter { camera: k, name, value, sigma: 0.0 });
        }
        // The turn is about the solution itself.
        let pose = [0.0, 0.0, 0.0, camera.translation.x, camera.translation.y, camera.translation.z];
        let own = POSE_NAMES.iter().zip(pose).map(|(name, value)| Parameter { camera: k, name, value, sigma: 0.0 });
        parameters.extend(own.filter(|_| k > 0));
    }
    parameters.iter_mut().enumerate().for_each(|(i, p)| p.sigma = covariance[(i, i)].sqrt());
    parameters
}

fn intrinsic(camera: &Camera, column: usize, shared: bool) -> (&'static str, f64) {
    let m = &camera.matrix;
    let terms: [&str; 8] =
        if camera.lens.is_fisheye() { ["k1", "k2", "k3", "k4", "", "", "", ""] } else { ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"] };
    match column {
        0 if shared => ("f_px", m[(0, 0)]),
        0 => ("fx_px", m[(0, 0)]),
        1 => ("fy_px", m[(1, 1)]),
        2 => ("cx_px", m[(0, 2)]),
        3 => ("cy_px", m[(1, 2)]),
        _ => (terms[column - 4], camera.lens.terms().get(column - 4).copied().unwrap_or(0.0)),
    }
}

impl Calibration {
    /// The rig with the board of a view as the world: x along its rows, z up, out of the board on the cameras' side; `None` for
    /// a view that took no part.
    pub fn on_board(&self, view: usize) -> Option<Rig> {
        let rig_from_board = self.boards.get(&view)?;
        let heights = self.rig.cameras.iter().map(|c| rig_from_board.inverse_transform_point(&c.centre().into()).z);
        let below = heights.sum::<f64>() < 0.0;
        let half_turn =
            if below { UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI) } else { UnitQuaternion::identity() };
        let rig_from_world = rig_from_board * Isometry3::from_parts(Vector3::zeros().into(), half_turn);
        let mut rig = self.rig.clone();
        for camera in &mut rig.cameras {
            let pose = camera_pose(camera) * rig_from_world;
            set_pose(camera, &pose);
        }
        Some(rig)
    }

    /// Baselines with their standard deviations: (camera, later camera, metres, metres).
    pub fn baselines_m(&self) -> Vec<(usize, usize, f64, f64)> {
        let sigma = |i: usize, k: usize, baseline_m: f64| {
            let along = (self.rig.cameras[k].centre() - self.rig.cameras[i].centre()) / baseline_m;
            let gradient = self.centre_gradient(k, &along) - self.centre_gradient(i, &along);
            (&gradient * &self.covariance * gradient.transpose())[(0, 0)].max(0.0).sqrt()
        };
        self.rig.baselines_m().into_iter().map(|(i, k, baseline_m)| (i, k, baseline_m, sigma(i, k, baseline_m))).collect()
    }

    /// Derivative of a centre's coordinate along a direction by all parameters.
    fn centre_gradient(&self, camera: usize, along: &Vector3<f64>) -> RowDVector<f64> {
        let mut gradient = RowDVector::zeros(self.parameters.len());
        let Some(first) = self.parameters.iter().position(|p| p.camera == camera && p.name == POSE_NAMES[0]) else { return gradient };
        let c = &self.rig.cameras[camera];
        let (by_turn, by_shift) = (hat(&c.centre()), -c.camera_from_world.inverse().matrix());
        gradient.columns_mut(first, 3).copy_from(&(along.transpose() * by_turn));
        gradient.columns_mut(first + 3, 3).copy_from(&(along.transpose() * by_shift));
        gradient
    }
}

//! A rig from views of a flat board.
//!
//! Corners of a board that some or all cameras see at one time, over many views, give the cameras' intrinsics, lenses and
//! poses and the boards' poses in one least-squares problem ([`bundle`]). It starts from a search and a vote ([`start`]),
//! and is repeated while corners and whole detections that do not fit are put aside; what fits again comes back. The last
//! adjustment is plain least squares over what is left, so its normal equations give the covariance:
//!   Cov = σ² S⁻¹,  σ² = Σ r² / (residuals − unknowns),  S the arrow's Schur complement.                (1)
//! Fails when: cameras share no view; boards are parallel, so that focal lengths and board distances cannot be told apart
//! (told from (1), not from the poses); all of a camera's detections are wrong.
//! Checked against cv::calibrateCamera and cv::stereoCalibrate, and (1) against the spread over noise.

pub mod bundle;
pub mod homography;
mod result;
mod start;
pub mod target;
#[cfg(test)]
mod tests;

pub use result::{Calibration, CameraQuality, FittedCorner, FittedSighting, Parameter, Reason, Rejected};
pub use target::{Detection, Target, Turn};

use super::{Camera, Lens, RigError};
use crate::math::arrow::{LmOptions, minimise};
use crate::math::order::quantile;
use bundle::{Bundle, Layout, Sighting, Solution};
use nalgebra::{Isometry3, Matrix3, Point2};
use std::collections::{BTreeMap, BTreeSet};

/// Fewer corners say too little about the lens for the trouble that a wrong one makes.
pub const FEWEST_CORNERS: usize = 6;
/// A camera needs this many views; fewer cannot be told from wrong ones.
pub const FEWEST_VIEWS: usize = 3;
/// Huber's loss, and the limits of corners and of a detection's median corner, in standard deviations of a coordinate. One
/// corner in 270 000 lies beyond five; the median of a board's corners never lies beyond four.
const HUBER_SIGMAS: f64 = 3.0;
const CORNER_SIGMAS: f64 = 5.0;
const DETECTION_SIGMAS: f64 = 4.0;
/// Detectors are never better than this, so exact (drawn) corners are not judged by rounding, px.
const LEAST_SIGMA_PX: f64 = 0.01;
/// Errors below this are no mistakes, whatever the scale: far boards are less sharp than near ones, px.
const HARMLESS_PX: f64 = 0.3;
/// Wrong labels are at least a square off; the limit of the first round, in squares.
const FIRST_LIMIT_SQUARES: f64 = 0.4;
const ROUNDS: usize = 8;
/// Focal lengths and centres more uncertain than this share of the focal length are not observed.
const UNOBSERVED: f64 = 0.05;
const MINIMISE: LmOptions = LmOptions { max_iterations: 200, relative_cost: 1e-12 };
const ROUGHLY: LmOptions = LmOptions { max_iterations: 60, relative_cost: 1e-7 };

/// Lens model to calibrate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensKind {
    /// k1, k2, p1, p2 (and k3).
    #[default]
    Brown,
    /// k1, k2 (and k3, k4).
    Fisheye,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CalibrateOptions {
    pub lens: LensKind,
    /// Free k3 (fisheye: k3 and k4) too. Off: on ordinary lenses it fits noise at the picture's edge.
    pub k3: bool,
    /// f_x = f_y.
    pub fix_aspect: bool,
}

impl CalibrateOptions {
    fn lens_terms(&self) -> &'static [usize] {
        match (self.lens, self.k3) {
            (LensKind::Brown, false) => &[0, 1, 2, 3],
            (LensKind::Brown, true) => &[0, 1, 2, 3, 4],
            (LensKind::Fisheye, false) => &[0, 1],
            (LensKind::Fisheye, true) => &[0, 1, 2, 3],
        }
    }
}

/// A camera before its calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Uncalibrated {
    pub name: String,
    pub size_px: [u32; 2],
    /// Camera matrix and lens where they are known; they are kept as they are.
    pub known: Option<(Matrix3<f64>, Lens)>,
}

/// Why there is no rig; messages name the camera and the remedy.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    #[error("no camera is given")]
    NoCameras,
    #[error(
        "{camera}: only {views} views with a whole enough board, {FEWEST_VIEWS} are needed and 10 to 20 are good; film the board there too"
    )]
    TooFewViews { camera: String, views: usize },
    #[error(
        "{apart}: see no board at the same time as {rest}, or not enough to tell how the board is turned; film more views in which neighbouring cameras see the board together"
    )]
    Unlinked { apart: String, rest: String },
    #[error(
        "{camera}: the views do not determine its {what} ({value_px:.0} px, uncertain by {sigma_px:.0} px); hold the board at different angles, tilted by 20 to 45 degrees, not always parallel to itself"
    )]
    Unobserved { camera: String, what: &'static str, value_px: f64, sigma_px: f64 },
    #[error(
        "{camera}: the views do not determine its focal length at all; hold the board at different angles, tilted by 20 to 45 degrees, not always parallel to itself"
    )]
    Singular { camera: String },
    #[error("the calibration makes no sense ({0}); are the board's size and square and the lens model right")]
    Impossible(#[from] RigError),
}

/// Calibrates cameras from detections of `target`; intrinsics are kept where all cameras' are known, else all are found. The
/// rig's frame is camera 0's.
pub fn calibrate(
    cameras: &[Uncalibrated],
    target: &Target,
    detections: &[Detection],
    options: &CalibrateOptions,
) -> Result<Calibration, CalibrateError> {
    if cameras.is_empty() {
        return Err(CalibrateError::NoCameras);
    }
    let usable: Vec<&Detection> = detections.iter().filter(|d| d.corners.len() >= FEWEST_CORNERS).collect();
    let known = cameras.iter().all(|c| c.known.is_some());
    let layout = if known { Layout::new(None, false) } else { Layout::new(Some(options.lens_terms()), options.fix_aspect) };
    let mut placed = Vec::new();
    for (k, camera) in cameras.iter().enumerate() {
        let own: Vec<&Detection> = usable.iter().filter(|d| d.camera == k).copied().collect();
        placed.push(alone(camera, target, &own, options.lens, &layout)?);
    }
    start::place_cameras(&mut placed, target, &usable)?;
    let work = Work { target, detections: &usable, layout };
    let settled = work.settle(placed)?;
    let calibration = result::collect(&work, settled, detections)?;
    calibration.rig.validate()?;
    Ok(calibration)
}

/// One camera from its own views: a start for the joint adjustment.
fn alone(camera: &Uncalibrated, target: &Target, own: &[&Detection], lens: LensKind, layout: &Layout) -> Result<Camera, CalibrateError> {
    if own.len() < FEWEST_VIEWS {
        return Err(CalibrateError::TooFewViews { camera: camera.name.clone(), views: own.len() });
    }
    let start = start::first_camera(camera, lens, target, own);
    if layout.count == 0 {
        return Ok(start);
    }
    // Alone it is camera 0.
    let own: Vec<Detection> = own.iter().map(|d| Detection { camera: 0, ..(*d).clone() }).collect();
    let work = Work { target, detections: &own.iter().collect::<Vec<_>>(), layout: layout.clone() };
    let mut cameras = work.settle(vec![start])?.solution.cameras;
    Ok(cameras.swap_remove(0))
}

/// The turn of the board with which a detection fits best, and the median distance of its corners then, px.
fn best_turn(camera: &Camera, board: &Isometry3<f64>, target: &Target, detection: &Detection) -> (usize, f64) {
    let misfit = |turn: &Turn| {
        let errors = detection.corners.iter().map(|(id, seen)| {
            let pixel = bundle::pixel(camera, board, &target.point(turn.relabelled[*id]));
            pixel.map_or(f64::INFINITY, |p| (p - seen).norm())
        });
        quantile(errors.collect(), 0.5).unwrap_or(f64::INFINITY)
    };
    let errors = target.turns.iter().map(misfit).enumerate();
    errors.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, f64::INFINITY))
}

/// What is adjusted, again and again.
struct Work<'a> {
    target: &'a Target,
    detections: &'a [&'a Detection],
    layout: Layout,
}

/// The outcome of the rounds.
struct Settled<'a> {
    bundle: Bundle<'a>,
    solution: Solution,
    /// View numbers of the solution's boards.
    views: Vec<usize>,
    /// Camera and view of the detections that were put aside, and why.
    rejected: Vec<Rejected>,
}

/// `rig_from_board` by view number.
type Boards = BTreeMap<usize, Isometry3<f64>>;

/// Sightings with the index of their detection, by view.
type Chosen = BTreeMap<usize, Vec<(usize, Sighting)>>;

impl<'a> Work<'a> {
    /// Adjusts, puts aside what does not fit, and again until nothing changes; then without a robust loss.
    fn settle(&self, mut cameras: Vec<Camera>) -> Result<Settled<'a>, CalibrateError> {
        let mut boards = Boards::new();
        let mut sigma_px = None;
        let mut chosen = Chosen::new();
        for _ in 0..ROUNDS {
            // Views in which nothing fitted may have had a bad pose.
            let lost = |d: &&&Detection| !chosen.contains_key(&d.view);
            boards.extend(self.propose_boards(&cameras, self.detections.iter().filter(lost).copied()));
            let next = self.choose(&cameras, &boards, sigma_px);
            self.refuse_few(&cameras, &next)?;
            if next == chosen {
                break;
            }
            chosen = next;
            // Twice, as the first scale is the start's.
            for _ in 0..2 {
                let scale = self.sigma_px(&cameras, &boards, &chosen);
                let (bundle, solution) = self.problem(&cameras, &boards, &chosen, HUBER_SIGMAS * scale);
                let (solution, _) = minimise(&bundle, solution, &ROUGHLY);
                boards.extend(chosen.keys().copied().zip(solution.boards));
                cameras = solution.cameras;
            }
            sigma_px = Some(self.sigma_px(&cameras, &boards, &chosen));
        }
        let (bundle, solution) = self.problem(&cameras, &boards, &chosen, f64::INFINITY);
        let (solution, _) = minimise(&bundle, solution, &MINIMISE);
        self.refuse_unobserved(&bundle, &solution)?;
        boards.extend(chosen.keys().copied().zip(solution.boards.iter().copied()));
        let rejected = self.rejected(&solution.cameras, &boards, &chosen, sigma_px.unwrap_or(LEAST_SIGMA_PX));
        Ok(Settled { bundle, solution, views: chosen.into_keys().collect(), rejected })
    }

    /// Of the board poses that a view's cameras propose, each by its homography, the one that all of them like best.
    fn propose_boards(&self, cameras: &[Camera], detections: impl Iterator<Item = &'a Detection>) -> Boards {
        let mut by_view: BTreeMap<usize, Vec<&Detection>> = BTreeMap::new();
        detections.for_each(|d| by_view.entry(d.view).or_default().push(d));
        let best = |(view, seen): (usize, Vec<&Detection>)| {
            let misfit = |board: &Isometry3<f64>| -> f64 {
                let squares = |d: &&Detection| best_turn(&cameras[d.camera], board, self.target, d).1 / limit_px(d, None);
                seen.iter().map(|d| squares(d).min(1.0)).sum()
            };
            let in_rig = |d: &Detection| {
                let camera = &cameras[d.camera];
                Some(bundle::camera_pose(camera).inverse() * start::pose(camera, self.target, d)?)
            };
            let judged = seen.iter().filter_map(|d| in_rig(d)).map(|board| (misfit(&board), board));
            let (_, board) = judged.min_by(|a, b| a.0.total_cmp(&b.0))?;
            Some((view, board))
        };
        by_view.into_iter().filter_map(best).collect()
    }

    /// The detections and corners that fit, with the labels that fit best. Without a scale whole detections are judged by
    /// their squares.
    fn choose(&self, cameras: &[Camera], boards: &Boards, sigma_px: Option<f64>) -> Chosen {
        let mut chosen = Chosen::new();
        for (index, d) in self.detections.iter().enumerate() {
            let Some(board) = boards.get(&d.view) else { continue };
            let (turn, misfit_px) = best_turn(&cameras[d.camera], board, self.target, d);
            if misfit_px > limit_px(d, sigma_px) {
                continue;
            }
            let label = |(id, seen): &(usize, Point2<f64>)| (self.target.turns[turn].relabelled[*id], *seen);
            let fits = |(id, seen): &(usize, Point2<f64>)| {
                let pixel = bundle::pixel(&cameras[d.camera], board, &self.target.point(*id));
                pixel.is_some_and(|p| sigma_px.is_none_or(|sigma| (p - seen).norm() <= (CORNER_SIGMAS * sigma).max(HARMLESS_PX)))
            };
            let corners: Vec<_> = d.corners.iter().map(label).filter(fits).collect();
            if corners.len() >= FEWEST_CORNERS {
                chosen.entry(d.view).or_default().push((index, Sighting { camera: d.camera, corners }));
            }
        }
        chosen
    }

    fn problem(&self, cameras: &[Camera], boards: &Boards, chosen: &Chosen, huber_px: f64) -> (Bundle<'a>, Solution) {
        let views = chosen.values().map(|seen| seen.iter().map(|(_, s)| s.clone()).collect()).collect();
        let boards = chosen.keys().map(|view| boards[view]).collect();
        (Bundle { target: self.target, views, layout: self.layout.clone(), huber_px }, Solution { cameras: cameras.to_vec(), boards })
    }

    /// Standard deviation of a corner's coordinate by the median error of the chosen: √(2 ln 2) σ.
    fn sigma_px(&self, cameras: &[Camera], boards: &Boards, chosen: &Chosen) -> f64 {
        let (bundle, solution) = self.problem(cameras, boards, chosen, f64::INFINITY);
        let sightings = bundle.views.iter().enumerate().flat_map(|(v, seen)| seen.iter().map(move |s| (v, s)));
        let errors = sightings.flat_map(|(v, s)| bundle.residuals(&solution, v, s)).flatten().map(|r| r.norm()).collect();
        (quantile(errors, 0.5).unwrap_or(0.0) / (2.0 * std::f64::consts::LN_2).sqrt()).max(LEAST_SIGMA_PX)
    }

    fn refuse_few(&self, cameras: &[Camera], chosen: &Chosen) -> Result<(), CalibrateError> {
        for (k, camera) in cameras.iter().enumerate() {
            let views = chosen.values().flatten().filter(|(_, s)| s.camera == k).count();
            if views < FEWEST_VIEWS {
                return Err(CalibrateError::TooFewViews { camera: camera.name.clone(), views });
            }
        }
        Ok(())
    }

    /// Refuses intrinsics that the normal equations leave open.
    fn refuse_unobserved(&self, bundle: &Bundle, solution: &Solution) -> Result<(), CalibrateError> {
        let cameras = &solution.cameras;
        let Some((covariance, _)) = result::covariance(bundle, solution) else {
            return Err(CalibrateError::Singular { camera: cameras.iter().map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ") });
        };
        for (k, camera) in cameras.iter().enumerate() {
            let focal_px = camera.matrix[(0, 0)];
            let entries = [("focal length", (0, 0)), ("focal length", (1, 1)), ("principal point", (0, 2)), ("principal point", (1, 2))];
            for (column, (what, place)) in entries.into_iter().enumerate() {
                let Some(unknown) = self.layout.unknown[column] else { continue };
                let variance = covariance[(self.layout.offset(k) + unknown, self.layout.offset(k) + unknown)];
                let (value_px, sigma_px) = (camera.matrix[place], variance.sqrt());
                if !(focal_px.is_finite() && sigma_px < UNOBSERVED * focal_px.abs()) {
                    return Err(CalibrateError::Unobserved { camera: camera.name.clone(), what, value_px, sigma_px });
                }
            }
        }
        Ok(())
    }

    fn rejected(&self, cameras: &[Camera], boards: &Boards, chosen: &Chosen, sigma_px: f64) -> Vec<Rejected> {
        let kept: BTreeSet<usize> = chosen.values().flatten().map(|(index, _)| *index).collect();
        let outside = self.detections.iter().enumerate().filter(|(index, _)| !kept.contains(index));
        let reason = |d: &Detection| match boards.get(&d.view) {
            None => Reason::NoPose,
            Some(board) => {
                let median_px = best_turn(&cameras[d.camera], board, self.target, d).1;
                Reason::Disagrees { median_px, limit_px: limit_px(d, Some(sigma_px)) }
            }
        };
        outside.map(|(_, d)| Rejected { camera: d.camera, view: d.view, reason: reason(d) }).collect()
    }
}

/// Median distance of its corners up to which a detection may be right.
fn limit_px(detection: &Detection, sigma_px: Option<f64>) -> f64 {
    sigma_px.map_or(FIRST_LIMIT_SQUARES * detection.spacing_px(), |sigma| (DETECTION_SIGMAS * sigma).max(HARMLESS_PX))
}

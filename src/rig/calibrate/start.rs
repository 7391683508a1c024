//! Where the adjustment begins: focal lengths from a search, the cameras' relations from a vote.
//!
//! Per camera the focal length of a fixed geometric series, with the picture's centre and an ideal lens, whose board poses
//! (homographies of the undistorted corners) draw the corners best; this serves pinhole and fisheye alike and cannot fail
//! as Zhang's closed form can, whose equations it satisfies where they have an answer.
//! Two cameras that see one board propose T = C₂ G C₁⁻¹ from each common view, C = `camera_from_board`, for every turn G that
//! the board's picture may hide. The true T is proposed by all views, wrong ones by one: the proposal with most agreement
//! wins. A maximal spanning tree of votes then places all cameras (Prim).                                (1)
//! Fails when: cameras share no view; or a symmetric board did not move, so that two proposals get the same votes.

use super::bundle::{camera_pose, set_pose};
use super::homography::board_pose;
use super::target::{Detection, Target};
use super::{CalibrateError, LensKind, Uncalibrated};
use crate::rig::{Camera, Lens};
use nalgebra::{Isometry3, Matrix3, Rotation3, Vector3};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Focal lengths tried, in picture widths: 12 degrees of view to beyond 180 (fisheye).
const SHORTEST_FOCAL_WIDTHS: f64 = 0.25;
const LONGEST_FOCAL_WIDTHS: f64 = 5.0;
const FOCAL_STEPS: usize = 36;
/// Detections that take part in the search; more change nothing.
const SEARCHED_DETECTIONS: usize = 40;
/// Two proposals agree within this angle plus this share of the board's distance; poses of small boards before the lens is
/// known are worse than 5 %, half a turn or a square's shift are far more than this.
const AGREEMENT: f64 = 0.12;
/// Proposals per pair of cameras; the vote is quadratic in them.
const MOST_PROPOSALS: usize = 300;

/// A camera with known intrinsics, or with the focal length that suits its detections best; in the origin of the rig.
pub fn first_camera(camera: &Uncalibrated, lens: LensKind, target: &Target, detections: &[&Detection]) -> Camera {
    let longer_px = f64::from(camera.size_px[0].max(camera.size_px[1]));
    let start = ideal_camera(camera, longer_px, lens);
    if let Some((matrix, lens)) = camera.known {
        return Camera { matrix, lens, ..start };
    }
    let step = detections.len().div_ceil(SEARCHED_DETECTIONS).max(1);
    let chosen: Vec<_> = detections.iter().step_by(step).copied().collect();
    let ratio = LONGEST_FOCAL_WIDTHS / SHORTEST_FOCAL_WIDTHS;
    let candidate = |k: usize| {
        let widths = SHORTEST_FOCAL_WIDTHS * ratio.powf(k as f64 / (FOCAL_STEPS - 1) as f64);
        let camera = ideal_camera(camera, widths * longer_px, lens);
        let misfit = |d: &&Detection| pose(&camera, target, d).map_or(1e6, |pose| misfit_px(&camera, target, d, &pose).min(1e6));
        let total: f64 = chosen.iter().map(misfit).sum();
        (total, camera)
    };
    let candidates: Vec<(f64, Camera)> = (0..FOCAL_STEPS).into_par_iter().map(candidate).collect();
    candidates.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).map_or(start, |(_, best)| best)
}

fn ideal_camera(camera: &Uncalibrated, focal_px: f64, lens: LensKind) -> Camera {
    let [cx, cy] = camera.size_px.map(|s| 0.5 * f64::from(s) - 0.5);
    Camera {
        name: camera.name.clone(),
        size_px: camera.size_px,
        matrix: Matrix3::new(focal_px, 0.0, cx, 0.0, focal_px, cy, 0.0, 0.0, 1.0),
        lens: if lens == LensKind::Fisheye { Lens::Fisheye([0.0; 4]) } else { Lens::IDEAL },
        camera_from_world: Rotation3::identity(),
        translation: Vector3::zeros(),
    }
}

/// `camera_from_board` of a detection by its homography; `None` where corners have no ray or lie on a line.
pub fn pose(camera: &Camera, target: &Target, detection: &Detection) -> Option<Isometry3<f64>> {
    let ideal = detection.corners.iter().map(|(_, pixel)| camera.normalise(pixel)).collect::<Option<Vec<_>>>()?;
    let on_board: Vec<_> = detection.corners.iter().map(|(id, _)| target.points[*id]).collect();
    board_pose(&on_board, &ideal)
}

/// Root mean square distance of a detection's corners from where a camera in the origin sees the board, px.
fn misfit_px(camera: &Camera, target: &Target, detection: &Detection, camera_from_board: &Isometry3<f64>) -> f64 {
    let square = |(id, seen): &(usize, nalgebra::Point2<f64>)| {
        let x = camera_from_board.rotation * target.point(*id) + camera_from_board.translation.vector;
        camera.project(&x).map_or(f64::INFINITY, |p| (p - seen).norm_squared())
    };
    (detection.corners.iter().map(square).sum::<f64>() / detection.corners.len() as f64).sqrt()
}

/// `camera_from_board` by (camera, view).
type Poses = BTreeMap<(usize, usize), Isometry3<f64>>;

/// The relation of two cameras by vote.
struct Link {
    second_from_first: Isometry3<f64>,
    votes: usize,
}

/// Places the cameras in camera 0's frame by (1).
pub fn place_cameras(cameras: &mut [Camera], target: &Target, detections: &[&Detection]) -> Result<(), CalibrateError> {
    let posed = |d: &&Detection| Some(((d.camera, d.view), pose(&cameras[d.camera], target, d)?));
    let poses: Poses = detections.iter().filter_map(posed).collect();
    let count = cameras.len();
    let pairs: Vec<(usize, usize)> = (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))).collect();
    let links: BTreeMap<(usize, usize), Link> =
        pairs.into_par_iter().filter_map(|(a, b)| Some(((a, b), link(target, &poses, a, b)?))).collect::<Vec<_>>().into_iter().collect();
    let mut placed = vec![0];
    set_pose(&mut cameras[0], &Isometry3::identity());
    while placed.len() < count {
        let candidates = links.iter().filter(|((a, b), _)| placed.contains(a) != placed.contains(b));
        // The first of the strongest, whatever the order of threads.
        let Some((&(a, b), strongest)) = candidates.max_by(|x, y| x.1.votes.cmp(&y.1.votes).then(y.0.cmp(x.0))) else {
            return Err(unlinked(cameras, &placed));
        };
        let (from, to, relation) =
            if placed.contains(&a) { (a, b, strongest.second_from_first) } else { (b, a, strongest.second_from_first.inverse()) };
        let pose = relation * camera_pose(&cameras[from]);
        set_pose(&mut cameras[to], &pose);
        placed.push(to);
    }
    Ok(())
}

fn unlinked(cameras: &[Camera], placed: &[usize]) -> CalibrateError {
    let names = |inside: bool| {
        let chosen = (0..cameras.len()).filter(|k| placed.contains(k) == inside);
        chosen.map(|k| cameras[k].name.as_str()).collect::<Vec<_>>().join(", ")
    };
    CalibrateError::Unlinked { apart: names(false), rest: names(true) }
}

fn link(target: &Target, poses: &Poses, first: usize, second: usize) -> Option<Link> {
    let common: Vec<(Isometry3<f64>, Isometry3<f64>)> =
        poses.range((first, 0)..=(first, usize::MAX)).filter_map(|((_, view), a)| Some((*a, *poses.get(&(second, *view))?))).collect();
    let turns = target.turns.len();
    let step = (common.len() * turns).div_ceil(MOST_PROPOSALS).max(1);
    let proposals: Vec<Vec<Isometry3<f64>>> = common
        .iter()
        .step_by(step)
        .map(|(a, b)| target.turns.iter().map(|t| b * t.turned_from_board.inverse() * a.inverse()).collect())
        .collect();
    let distances_m: Vec<f64> = common.iter().step_by(step).map(|(a, _)| a.translation.vector.norm()).collect();
    let support = |t: &Isometry3<f64>| -> (usize, f64) {
        let nearest = |(view, d): (&Vec<Isometry3<f64>>, &f64)| view.iter().map(|p| apart(p, t, *d)).fold(f64::INFINITY, f64::min);
        let near: Vec<f64> = proposals.iter().zip(&distances_m).map(nearest).filter(|d| *d < AGREEMENT).collect();
        (near.len(), near.iter().sum())
    };
    let voted: Vec<(Isometry3<f64>, (usize, f64))> = proposals.iter().flatten().map(|t| (*t, support(t))).collect();
    let best = voted.iter().min_by(|x, y| y.1.0.cmp(&x.1.0).then(x.1.1.total_cmp(&y.1.1)))?;
    // A board that hides its turn must move between views: no other relation may have the same votes.
    let distance_m = distances_m.iter().sum::<f64>() / distances_m.len() as f64;
    let rival = voted.iter().filter(|v| apart(&v.0, &best.0, distance_m) > 2.0 * AGREEMENT).map(|v| v.1.0).max().unwrap_or(0);
    (turns == 1 || rival < best.1.0).then_some(Link { second_from_first: best.0, votes: best.1.0 })
}

/// Angle between two relations plus the distance between them in units of `distance_m`.
fn apart(a: &Isometry3<f64>, b: &Isometry3<f64>, distance_m: f64) -> f64 {
    a.rotation.angle_to(&b.rotation) + (a.translation.vector - b.translation.vector).norm() / distance_m
}

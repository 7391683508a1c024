//! Why pictures do not fit their calibration: a camera turned, pictures exchanged, mirrored or rotated, or another rig.
//!
//! SIFT features (Lowe 2004) are matched between the cameras without the calibration's help, pictures also mirrored. With b
//! the baseline's direction and r_a, r_b the rays of a match, a pair fits where
//!   |b · (r_a × r_b)| / |b × r_a| < τ  and  b · (r_a − r_b) > −τ,   τ = 2 px / f,                             (1)
//! the point lies in one epipolar plane and before the cameras. The first explanation under which nearly as many matches
//! of every pair fit as can be expected is given: the rig as it is; pictures of cameras exchanged; pictures mirrored or
//! rotated; one camera turned by a vector ω, the minimum of Σ ρ of (1)'s first distance, by Gauss-Newton under Geman and
//! McClure's ρ from wide to narrow.
//!
//! Fails on stages without texture and on those that repeat. A camera that was shifted is named like a turned one where a
//! turn explains it. Checked on a rendered stage with each of these faults.

use crate::math::rotation;
use crate::rig::{Camera, Rig};
use image::{GrayImage, imageops};
use nalgebra::{Matrix3, Point2, Vector3};
use opencv::core::{DMatch, KeyPoint, Mat, NORM_L2, Vector, no_array};
use opencv::features2d::{BFMatcher, SIFT};
use opencv::prelude::*;

/// Features per picture; more take longer and tell no more.
const FEATURES: i32 = 700;
/// A match is unique when the second best is this much worse (Lowe).
const UNIQUE: f32 = 0.75;
/// τ of (1); SIFT's places err by some tenths.
const FITS_PX: f64 = 2.0;
/// Fewer matches of a pair tell nothing.
const FEWEST_MATCHES: usize = 25;
/// An explanation holds where this share of every pair's matches fits; by chance 1 or 2 % do.
const EXPLAINED: f64 = 0.6;
/// Turns are sought from this distance down.
const WIDEST_PX: f64 = 80.0;
/// A pull to no turn, (matches' error in px / turns to expect in radians)², for directions that no pair sees well.
const PULL: f64 = 100.0;
/// Places of features scatter by less than this about right lines; width of ρ.
const SCATTER_PX: f64 = 1.0;
/// A turn must leave less than this of Σ ρ.
const BETTER: f64 = 0.7;
/// Cameras whose turns leave Σ ρ within this factor of the least cannot be told apart.
const ALIKE: f64 = 1.15;

/// What was done to the pictures of a camera against those that the calibration saw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    Mirrored,
    /// Upside down and mirrored.
    Flipped,
    /// Rotated by quarter turns, clockwise as seen.
    Rotated(u8),
}

/// Why the pictures do not fit the calibration.
#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    /// Two cameras' pictures are exchanged.
    Exchanged { first: usize, second: usize },
    /// The pictures under camera k's name are camera `seen_by[k]`'s.
    Permuted { seen_by: Vec<usize> },
    /// The pictures of one camera, or of all, are changed.
    Changed { camera: Option<usize>, change: Change },
    /// One of `cameras` is turned against the calibration by `angle_deg`; the first fits best.
    Turned { cameras: Vec<usize>, angle_deg: f64 },
    /// No single camera explains it.
    Whole,
    /// Too few features in common between two cameras.
    NothingInCommon { first: usize, second: usize, matches: usize },
}

#[derive(Debug, thiserror::Error)]
#[error("features cannot be sought: {0}")]
pub struct MisfitError(#[from] opencv::Error);

/// Matches of two cameras: pixels of the first and of the second.
type Pairs = Vec<(Point2<f64>, Point2<f64>)>;

/// Features of one picture.
struct Features {
    points: Vec<Point2<f64>>,
    descriptors: Mat,
}

/// Why simultaneous pictures, best of the empty stage, do not fit the rig; `None` where the features see no fault.
pub fn diagnose(rig: &Rig, images: &[GrayImage]) -> Result<Option<Fault>, MisfitError> {
    let plain = images.iter().map(features).collect::<Result<Vec<_>, _>>()?;
    let pairs: Vec<(usize, usize)> = rig.baselines_m().iter().map(|b| (b.0, b.1)).collect();
    let matched = pairs.iter().map(|&(i, k)| common(&plain[i], &plain[k])).collect::<Result<Vec<Pairs>, _>>()?;
    let fits = |rig: &Rig| explains(rig, &pairs, &matched);
    if fits(rig) {
        return Ok(turned(rig, &pairs, &matched));
    }
    if let Some(seen_by) = permutations(rig.cameras.len()).into_iter().skip(1).find(|order| fits(&permuted(rig, order))) {
        return Ok(Some(exchange(seen_by)));
    }
    if let Some(fault) = changed(rig, images, &plain, &pairs, &matched)? {
        return Ok(Some(fault));
    }
    if let Some((at, few)) = matched.iter().enumerate().min_by_key(|(_, m)| m.len()).filter(|(_, m)| m.len() < FEWEST_MATCHES) {
        let (first, second) = pairs[at];
        return Ok(Some(Fault::NothingInCommon { first, second, matches: few.len() }));
    }
    Ok(Some(turned(rig, &pairs, &matched).unwrap_or(Fault::Whole)))
}

fn features(image: &GrayImage) -> Result<Features, opencv::Error> {
    let mat = Mat::new_rows_cols_with_data(image.height() as i32, image.width() as i32, image.as_raw())?;
    let (mut keypoints, mut descriptors) = (Vector::<KeyPoint>::new(), Mat::default());
    SIFT::create(FEATURES, 3, 0.02, 10.0, 1.6)?.detect_and_compute_def(&mat, &no_array(), &mut keypoints, &mut descriptors)?;
    let points = keypoints.iter().map(|k| Point2::new(f64::from(k.pt().x), f64::from(k.pt().y))).collect();
    Ok(Features { points, descriptors })
}

/// Unique matches that hold in both directions.
fn common(a: &Features, b: &Features) -> Result<Pairs, opencv::Error> {
    let (forth, back) = (nearest(a, b)?, nearest(b, a)?);
    let both = forth.iter().enumerate().filter_map(|(i, k)| (*k).filter(|&k| back[k] == Some(i)).map(|k| (a.points[i], b.points[k])));
    Ok(both.collect())
}

/// The feature of `b` like each of `a`.
fn nearest(a: &Features, b: &Features) -> Result<Vec<Option<usize>>, opencv::Error> {
    let mut nearest = vec![None; a.points.len()];
    if a.points.len() < 2 || b.points.len() < 2 {
        return Ok(nearest);
    }
    let mut found = Vector::<Vector<DMatch>>::new();
    BFMatcher::new(NORM_L2, false)?.knn_train_match_def(&a.descriptors, &b.descriptors, &mut found, 2)?;
    for candidates in &found {
        if let (Ok(best), Ok(second)) = (candidates.get(0), candidates.get(1))
            && best.distance < UNIQUE * second.distance
        {
            nearest[best.query_idx as usize] = Some(best.train_idx as usize);
        }
    }
    Ok(nearest)
}

/// Whether (1) holds for enough matches of every pair.
fn explains(rig: &Rig, pairs: &[(usize, usize)], matched: &[Pairs]) -> bool {
    pairs.iter().zip(matched).all(|(&(i, k), found)| {
        let fitting = fitting(&rig.cameras[i], &rig.cameras[k], found);
        found.len() >= FEWEST_MATCHES && fitting as f64 > EXPLAINED * found.len() as f64
    })
}

/// How many matches fulfil (1).
fn fitting(a: &Camera, b: &Camera, found: &Pairs) -> usize {
    let Some(baseline) = (b.centre() - a.centre()).try_normalize(1e-12) else { return 0 };
    let limit = FITS_PX / a.matrix[(0, 0)];
    let fits = |(pixel_a, pixel_b): &&(Point2<f64>, Point2<f64>)| {
        let (Some(ray_a), Some(ray_b)) = (a.ray(pixel_a), b.ray(pixel_b)) else { return false };
        plane_distance(&baseline, &ray_a, &ray_b).abs() < limit && baseline.dot(&(ray_a - ray_b)) > -limit
    };
    found.iter().filter(fits).count()
}

/// The first distance of (1), signed, radians.
fn plane_distance(baseline: &Vector3<f64>, ray_a: &Vector3<f64>, ray_b: &Vector3<f64>) -> f64 {
    let normal = baseline.cross(ray_a);
    normal.dot(ray_b) / normal.norm().max(1e-9)
}

/// All orders of `count` cameras, the natural one first; only exchanges of two where there are many.
fn permutations(count: usize) -> Vec<Vec<usize>> {
    let natural: Vec<usize> = (0..count).collect();
    if count > 4 {
        let exchanges = (0..count).flat_map(|i| (i + 1..count).map(move |k| (i, k)));
        let exchanged = exchanges.map(|(i, k)| {
            let mut order = natural.clone();
            order.swap(i, k);
            order
        });
        return std::iter::once(natural.clone()).chain(exchanged).collect();
    }
    let mut all = vec![vec![]];
    for _ in 0..count {
        let longer = |order: Vec<usize>| {
            natural.iter().filter(|k| !order.contains(k)).map(|&k| [order.clone(), vec![k]].concat()).collect::<Vec<_>>()
        };
        all = all.into_iter().flat_map(longer).collect();
    }
    // Exchanges of two before longer cycles.
    all.sort_by_key(|order| order.iter().enumerate().filter(|(k, seen)| k != *seen).count());
    all
}

/// The rig whose camera k is `seen_by[k]` of this one.
fn permuted(rig: &Rig, seen_by: &[usize]) -> Rig {
    Rig { cameras: seen_by.iter().map(|&k| rig.cameras[k].clone()).collect(), up: rig.up }
}

fn exchange(seen_by: Vec<usize>) -> Fault {
    let moved: Vec<usize> = (0..seen_by.len()).filter(|&k| seen_by[k] != k).collect();
    match moved[..] {
        [first, second] => Fault::Exchanged { first, second },
        _ => Fault::Permuted { seen_by },
    }
}

/// A camera (or all) whose pictures were mirrored or rotated after they were taken.
fn changed(
    rig: &Rig,
    images: &[GrayImage],
    plain: &[Features],
    pairs: &[(usize, usize)],
    matched: &[Pairs],
) -> Result<Option<Fault>, MisfitError> {
    let all = |change: Change| {
        let undone = pairs.iter().zip(matched).map(|(&(i, k), found)| undo_pairs(found, [Some(&images[i]), Some(&images[k])], change));
        explains(rig, pairs, &undone.collect::<Vec<_>>())
    };
    for change in changes(&images[0]) {
        if all(change) {
            return Ok(Some(Fault::Changed { camera: None, change }));
        }
    }
    for camera in 0..images.len() {
        let mirrored = mirrored_matches(camera, images, plain, pairs, matched)?;
        for change in changes(&images[camera]) {
            let matched = if matches!(change, Change::Rotated(_)) { matched } else { &mirrored };
            let of = |c: usize| (c == camera).then(|| &images[c]);
            let undone = pairs.iter().zip(matched).map(|(&(i, k), found)| undo_pairs(found, [of(i), of(k)], change));
            if explains(rig, pairs, &undone.collect::<Vec<_>>()) {
                return Ok(Some(Fault::Changed { camera: Some(camera), change }));
            }
        }
    }
    Ok(None)
}

/// The matches with the features of one camera's picture sought in its mirror image, at their places in the picture.
fn mirrored_matches(
    camera: usize,
    images: &[GrayImage],
    plain: &[Features],
    pairs: &[(usize, usize)],
    matched: &[Pairs],
) -> Result<Vec<Pairs>, MisfitError> {
    let mut own = features(&imageops::flip_horizontal(&images[camera]))?;
    let right = f64::from(images[camera].width()) - 1.0;
    own.points.iter_mut().for_each(|p| p.x = right - p.x);
    let mut mirrored = Vec::new();
    for (&(i, k), found) in pairs.iter().zip(matched) {
        mirrored.push(match (i == camera, k == camera) {
            (true, _) => common(&own, &plain[k])?,
            (_, true) => common(&plain[i], &own)?,
            _ => found.clone(),
        });
    }
    Ok(mirrored)
}

/// The changes that keep a picture's size.
fn changes(image: &GrayImage) -> Vec<Change> {
    let square = image.width() == image.height();
    let quarters = if square { vec![Change::Rotated(1), Change::Rotated(3)] } else { vec![] };
    [vec![Change::Mirrored, Change::Rotated(2), Change::Flipped], quarters].concat()
}

/// Pixels as they were before `change`, of those cameras whose pictures are given.
fn undo_pairs(found: &Pairs, images: [Option<&GrayImage>; 2], change: Change) -> Pairs {
    let undo = |p: &Point2<f64>, image: Option<&GrayImage>| image.map_or(*p, |i| undo(p, change, i));
    found.iter().map(|(a, b)| (undo(a, images[0]), undo(b, images[1]))).collect()
}

fn undo(p: &Point2<f64>, change: Change, image: &GrayImage) -> Point2<f64> {
    let (right, bottom) = (f64::from(image.width()) - 1.0, f64::from(image.height()) - 1.0);
    match change {
        Change::Mirrored => Point2::new(right - p.x, p.y),
        Change::Flipped => Point2::new(p.x, bottom - p.y),
        Change::Rotated(1) => Point2::new(p.y, right - p.x),
        Change::Rotated(3) => Point2::new(bottom - p.y, p.x),
        Change::Rotated(_) => Point2::new(right - p.x, bottom - p.y),
    }
}

/// The camera whose turn explains the misfit of all pairs.
fn turned(rig: &Rig, pairs: &[(usize, usize)], matched: &[Pairs]) -> Option<Fault> {
    let try_camera = |camera: usize| {
        let turn = best_turn(rig, camera, pairs, matched);
        let mut turned = rig.clone();
        turned.cameras[camera] = with_turn(&rig.cameras[camera], &turn);
        explains(&turned, pairs, matched).then(|| (camera, turn.norm().to_degrees(), misfit(&turned, pairs, matched)))
    };
    let mut tried: Vec<_> = (0..rig.cameras.len()).filter_map(try_camera).collect();
    tried.sort_by(|a, b| a.2.total_cmp(&b.2));
    let (_, angle_deg, least) = *tried.first().filter(|t| t.2 < BETTER * misfit(rig, pairs, matched))?;
    Some(Fault::Turned { cameras: tried.iter().filter(|t| t.2 < ALIKE * least).map(|t| t.0).collect(), angle_deg })
}

/// Σ ρ of all matches.
fn misfit(rig: &Rig, pairs: &[(usize, usize)], matched: &[Pairs]) -> f64 {
    let of_pair = |(&(i, k), found): (&(usize, usize), &Pairs)| {
        let (a, b) = (&rig.cameras[i], &rig.cameras[k]);
        let Some(baseline) = (b.centre() - a.centre()).try_normalize(1e-12) else { return 0.0 };
        let one = |(pixel_a, pixel_b): &(Point2<f64>, Point2<f64>)| {
            let (Some(ray_a), Some(ray_b)) = (a.ray(pixel_a), b.ray(pixel_b)) else { return 1.0 };
            let square = (a.matrix[(0, 0)] * plane_distance(&baseline, &ray_a, &ray_b) / SCATTER_PX).powi(2);
            square / (1.0 + square)
        };
        found.iter().map(one).sum::<f64>()
    };
    pairs.iter().zip(matched).map(of_pair).sum()
}

/// A camera turned about its centre by the vector `turn` of its own frame.
fn with_turn(camera: &Camera, turn: &Vector3<f64>) -> Camera {
    let turn = rotation::exp(turn).to_rotation_matrix();
    Camera { camera_from_world: turn * camera.camera_from_world, translation: turn * camera.translation, ..camera.clone() }
}

/// The turn that minimises the robust distances of all matches of a camera.
fn best_turn(rig: &Rig, camera: usize, pairs: &[(usize, usize)], matched: &[Pairs]) -> Vector3<f64> {
    let rays = turnable(rig, camera, pairs, matched);
    let focal_px = rig.cameras[camera].matrix[(0, 0)];
    let mut turn = Vector3::zeros();
    let mut width_px = WIDEST_PX;
    for _ in 0..40 {
        let world_from_camera = with_turn(&rig.cameras[camera], &turn).camera_from_world.inverse();
        let distance = |t: &Turnable, moved: &Vector3<f64>| {
            let own = world_from_camera * moved;
            focal_px * plane_distance(&t.baseline, &t.other, &own)
        };
        let (mut normal, mut right) = (Matrix3::identity() * PULL, -turn * PULL);
        for t in &rays {
            let r = distance(t, &t.own);
            // exp(ω)⁻¹ x ≈ x − ω × x turns the ray in the camera.
            let slope = Vector3::from_fn(|k, _| distance(t, &(-Vector3::ith(k, 1.0).cross(&t.own))));
            let weight = (1.0 + (r / width_px).powi(2)).powi(-2);
            normal += slope * slope.transpose() * weight;
            right -= slope * (weight * r);
        }
        let Some(step) = normal.cholesky().map(|c| c.solve(&right)) else { break };
        turn = rotation::log(&(rotation::exp(&step) * rotation::exp(&turn)));
        width_px = (0.8 * width_px).max(SCATTER_PX);
    }
    turn
}

/// A match of the camera to be turned.
struct Turnable {
    baseline: Vector3<f64>,
    /// The other camera's ray, in the world.
    other: Vector3<f64>,
    /// The camera's own ray in its own frame.
    own: Vector3<f64>,
}

fn turnable(rig: &Rig, camera: usize, pairs: &[(usize, usize)], matched: &[Pairs]) -> Vec<Turnable> {
    let own_camera = &rig.cameras[camera];
    let of_pair = |(&(i, k), found): (&(usize, usize), &Pairs)| -> Vec<Turnable> {
        let other = if i == camera { k } else { i };
        let Some(baseline) = (own_camera.centre() - rig.cameras[other].centre()).try_normalize(1e-12) else { return Vec::new() };
        if i != camera && k != camera {
            return Vec::new();
        }
        let one = |(a, b): &(Point2<f64>, Point2<f64>)| {
            let (own, seen) = if i == camera { (a, b) } else { (b, a) };
            let own = own_camera.camera_from_world * own_camera.ray(own)?;
            Some(Turnable { baseline, other: rig.cameras[other].ray(seen)?, own })
        };
        found.iter().filter_map(one).collect()
    };
    pairs.iter().zip(matched).flat_map(of_pair).collect()
}

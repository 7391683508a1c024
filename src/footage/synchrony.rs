//! When each camera took its pictures, against the others, in frames and parts of frames.
//!
//! Camera c takes its frame n at the time n + δ_c. Coarse: what stands before the stage, counted by epipolar plane,
//!   s(n, θ) = foreground pixels of frame n whose rays lie in the plane at angle θ about the baseline,            (1)
//! is much the same in both cameras of a pair whatever the depth, so the k with the smallest Σ_n |s_a(n) − s_b(n + k)|²
//! is −(δ_b − δ_a), a parabola giving parts. Fine: corners of the person matched between the cameras move on between
//! the two times; one that crosses its epipolar curve in camera b at v px per frame lies off it by
//!   r = (δ_b − δ_a) v + c,                                                                                      (2)
//! c the pair's own misfit, small. A robust line per pair, then least squares over the pairs for all δ; their zero is the
//! camera in the middle. σ holds the scatter between instants and what all corners share (`SHARED_PX`).
//!
//! Tried alone: parabolas of (1) err by 0.02 to 0.19 frames on rendered walks (shadows, hidden limbs), (2) by 0.00 to 0.02;
//! (2) is blind beyond two frames and on clothes without texture, (1) is not. Fails when nobody crosses the epipolar
//! curves (σ says so) and for offsets that change during the film.
//! Checked on rendered footage with cameras shifted by whole frames and by parts, with σ against the true errors.

use super::epipolar::PairMatches;
use super::reduce::{full_px, reduction};
use crate::math::order::quantile;
use crate::rig::{Camera, Rig};
use image::GrayImage;
use nalgebra::{DMatrix, DVector, Matrix2, Point2, Vector2, Vector3};
use opencv::core::{Mat, Point2f, Size, TermCriteria, Vector};

/// Shifts beyond this many frames are not tried.
const LARGEST_SHIFT: usize = 150;
/// Frames that both cameras must have after a shift; fewer agree by chance.
const FEWEST_COMMON: usize = 6;
/// Another shift than none must fit this many times better, or a periodic walk would be shifted by a step.
const CLEARLY_BETTER: f64 = 2.0;
/// σ of (1)'s parabola is this times the root of the ratio of misfit and curvature.
const SIGNATURE_ERROR: f64 = 0.15;
/// Fewer corners make no line.
const FEWEST_CORNERS: usize = 12;
/// Error of a pair's calibration, the prior of c.
const CALIBRATION_PX: f64 = 0.1;
/// What the matches of one limb err together, by perspective and light.
const SHARED_PX: f64 = 0.03;
/// No match is better than this.
const FINEST_PX: f64 = 0.05;
/// Corners tracked forth and back must move alike: this plus a share of the speed.
const ACCELERATION_PX: f64 = 1.0;
const ACCELERATION_SHARE: f64 = 0.3;
/// Half the side of the tracker's window, its pyramid, and the margin around the corners that it may need.
const TRACK_RADIUS_PX: i32 = 7;
const TRACK_LEVELS: i32 = 3;
const TRACK_MARGIN_PX: f64 = 64.0;
/// An offset less certain than this is not known.
const KNOWN_FRAMES: f64 = 0.5;

/// A time in frames with its standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Offset {
    pub frames: f64,
    pub sigma: f64,
}

/// The time of the second camera of a pair after the first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairOffset {
    pub first: usize,
    pub second: usize,
    pub offset: Offset,
}

#[derive(Debug, thiserror::Error)]
#[error("corners cannot be tracked: {0}")]
pub struct SynchronyError(#[from] opencv::Error);

/// The epipolar planes of a pair as bins of about one pixel.
struct EpipolarPlanes {
    first: usize,
    second: usize,
    /// Place among the bins of every pixel of the reduced picture of the first and of the second camera.
    places: [Vec<f32>; 2],
    count: usize,
}

/// The signatures (1) of one frame: per pair, of its two cameras.
pub type Signature = Vec<[Vec<f32>; 2]>;

/// Signatures of a film.
pub struct Signatures {
    planes: Vec<EpipolarPlanes>,
    /// By frame number, ascending.
    frames: Vec<(usize, Signature)>,
}

impl Signatures {
    pub fn new(rig: &Rig) -> Signatures {
        let rays: Vec<_> = rig.cameras.iter().map(reduced_rays).collect();
        let planes = |(first, second, _): (usize, usize, f64)| EpipolarPlanes::new(rig, first, second, [&rays[first], &rays[second]]);
        Signatures { planes: rig.baselines_m().into_iter().map(planes).collect(), frames: Vec::new() }
    }

    /// Of one frame's masks, one per camera, of the reduced size.
    pub fn signature(&self, masks: &[GrayImage]) -> Signature {
        let foreground = |mask: &GrayImage| -> Vec<usize> { mask.iter().enumerate().filter(|(_, m)| **m > 0).map(|(k, _)| k).collect() };
        let pixels: Vec<_> = masks.iter().map(foreground).collect();
        self.planes.iter().map(|p| [p.count(0, &pixels[p.first]), p.count(1, &pixels[p.second])]).collect()
    }

    /// Frames come in ascending order of their numbers.
    pub fn push(&mut self, number: usize, signature: Signature) {
        self.frames.push((number, signature));
    }

    /// The offsets of all pairs that the signatures tell.
    pub fn offsets(&self) -> Vec<PairOffset> {
        let tell =
            |(pair, p): (usize, &EpipolarPlanes)| Some(PairOffset { first: p.first, second: p.second, offset: self.pair_offset(pair)? });
        self.planes.iter().enumerate().filter_map(tell).collect()
    }

    fn pair_offset(&self, pair: usize) -> Option<Offset> {
        let span = self.frames.last()?.0 - self.frames.first()?.0;
        let reach = (span / 2).min(LARGEST_SHIFT) as i64;
        let costs: Vec<f64> = (-reach..=reach).map(|k| self.cost(pair, k).unwrap_or(f64::INFINITY)).collect();
        let none = reach as usize;
        let best = (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b]))?;
        let best = if costs[none] > CLEARLY_BETTER * costs[best] { best } else { none };
        let (before, at, after) = (*costs.get(best.checked_sub(1)?)?, costs[best], *costs.get(best + 1)?);
        let bend = before - 2.0 * at + after;
        if !bend.is_finite() || bend <= 1e-9 {
            return None;
        }
        let part = (0.5 * (before - after) / bend).clamp(-1.0, 1.0);
        Some(Offset { frames: reach as f64 - best as f64 - part, sigma: SIGNATURE_ERROR * (2.0 * at / bend).sqrt() })
    }

    /// Mean square difference of a pair's signatures when the second camera's are taken `shift` frames later.
    fn cost(&self, pair: usize, shift: i64) -> Option<f64> {
        let (mut sum, mut common, mut later) = (0.0, 0, 0);
        for (number, signature) in &self.frames {
            let Some(wanted) = number.checked_add_signed(shift as isize) else { continue };
            while self.frames.get(later).is_some_and(|f| f.0 < wanted) {
                later += 1;
            }
            let Some((_, other)) = self.frames.get(later).filter(|f| f.0 == wanted) else { continue };
            sum += signature[pair][0].iter().zip(&other[pair][1]).map(|(a, b)| f64::from((a - b) * (a - b))).sum::<f64>();
            common += 1;
        }
        (common >= FEWEST_COMMON).then(|| sum / common as f64)
    }
}

impl EpipolarPlanes {
    fn new(rig: &Rig, first: usize, second: usize, rays: [&[Option<Vector3<f64>>]; 2]) -> EpipolarPlanes {
        let [a, b] = [&rig.cameras[first], &rig.cameras[second]];
        let along = (b.centre() - a.centre()).try_normalize(1e-12).unwrap_or(Vector3::x());
        let forward = [a, b].iter().map(|c| c.camera_from_world.inverse() * Vector3::z()).sum::<Vector3<f64>>();
        let middle = (forward - along * forward.dot(&along)).try_normalize(1e-9).unwrap_or(along.yzx());
        let aside = along.cross(&middle);
        let step = f64::from(reduction(a.size_px)) / a.matrix[(0, 0)];
        let angles = rays.map(|rays| rays.iter().map(|r| r.map(|r| r.dot(&aside).atan2(r.dot(&middle)) / step)).collect::<Vec<_>>());
        let seen = || angles.iter().flatten().flatten().copied();
        let (low, high) = (seen().fold(f64::INFINITY, f64::min), seen().fold(f64::NEG_INFINITY, f64::max));
        let places = angles.map(|angles| angles.iter().map(|a| a.map_or(0.0, |a| (a - low) as f32)).collect());
        EpipolarPlanes { first, second, places, count: (high - low).max(0.0) as usize + 2 }
    }

    /// Pixels per bin, each shared between the two bins beside it.
    fn count(&self, side: usize, pixels: &[usize]) -> Vec<f32> {
        let mut counts = vec![0.0; self.count];
        for place in pixels.iter().filter_map(|&k| self.places[side].get(k)) {
            let (bin, part) = (*place as usize, place.fract());
            counts[bin] += 1.0 - part;
            counts[bin + 1] += part;
        }
        counts
    }
}

/// Directions in the world of the pixels of a camera's reduced picture.
fn reduced_rays(camera: &Camera) -> Vec<Option<Vector3<f64>>> {
    let factor = reduction(camera.size_px);
    let [width, height] = camera.size_px.map(|s| s / factor);
    (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| camera.ray(&full_px(x, y, factor))).collect()
}

/// The pictures of all cameras around one instant.
pub struct Instant {
    /// One per camera: the frame before, the frame itself, the frame after.
    pub images: Vec<[GrayImage; 3]>,
}

/// A corner of the person in the second camera of a pair.
#[derive(Clone, Copy, Debug)]
struct Crossing {
    instant: usize,
    /// v of (2), px per frame.
    speed_px: f64,
    /// r of (2).
    distance_px: f64,
}

/// The offset of a pair from its matches on the person, one list per instant; `None` where they are too few.
pub fn pair_offset(pair: &PairMatches, instants: &[Instant]) -> Result<Option<PairOffset>, SynchronyError> {
    let mut crossings = Vec::new();
    for (instant, (found, at)) in pair.sets.iter().zip(instants).enumerate() {
        let Some([before, now, after]) = at.images.get(pair.second) else { continue };
        let points: Vec<_> = found.iter().map(|m| m.second_px).collect();
        for (m, velocity) in found.iter().zip(velocities([before, now, after], &points)?) {
            crossings.extend(velocity.map(|v| Crossing { instant, speed_px: v.dot(&m.normal), distance_px: m.distance_px }));
        }
    }
    Ok(line(&crossings).map(|offset| PairOffset { first: pair.first, second: pair.second, offset }))
}

/// Velocities of points, px per frame, from the frames before and after; `None` where the two disagree or tracking fails.
fn velocities([before, now, after]: [&GrayImage; 3], points: &[Point2<f64>]) -> Result<Vec<Option<Vector2<f64>>>, SynchronyError> {
    let (forth, back) = (track(now, after, points)?, track(now, before, points)?);
    let mean = |(forth, back): (Option<Vector2<f64>>, Option<Vector2<f64>>)| {
        let (forth, back) = (forth?, -back?);
        let mean = (forth + back) / 2.0;
        ((forth - back).norm() < ACCELERATION_PX + ACCELERATION_SHARE * mean.norm()).then_some(mean)
    };
    Ok(forth.into_iter().zip(back).map(mean).collect())
}

/// Displacements of points from one picture to another by Lucas and Kanade's tracker.
fn track(from: &GrayImage, to: &GrayImage, points: &[Point2<f64>]) -> Result<Vec<Option<Vector2<f64>>>, SynchronyError> {
    if points.is_empty() {
        return Ok(Vec::new());
    }
    // Only the surroundings of the points: the pyramid of the whole picture costs more than the tracking.
    let low = points.iter().fold(Point2::new(f64::INFINITY, f64::INFINITY), |l, p| l.inf(p)).map(|v| (v - TRACK_MARGIN_PX).max(0.0) as u32);
    let high = points.iter().fold(Point2::origin(), |h: Point2<f64>, p| h.sup(p)).map(|v| (v + TRACK_MARGIN_PX) as u32);
    let (width, height) = (high.x.min(from.width()).saturating_sub(low.x), high.y.min(from.height()).saturating_sub(low.y));
    let [from, to] = [from, to].map(|i| image::imageops::crop_imm(i, low.x, low.y, width, height).to_image());
    let from = Mat::new_rows_cols_with_data(height as i32, width as i32, from.as_raw())?;
    let to = Mat::new_rows_cols_with_data(height as i32, width as i32, to.as_raw())?;
    let start: Vector<Point2f> =
        points.iter().map(|p| Point2f::new((p.x - f64::from(low.x)) as f32, (p.y - f64::from(low.y)) as f32)).collect();
    let (mut end, mut status, mut error) = (Vector::<Point2f>::new(), Vector::<u8>::new(), Vector::<f32>::new());
    let window = Size::new(2 * TRACK_RADIUS_PX + 1, 2 * TRACK_RADIUS_PX + 1);
    let stop = TermCriteria::new(opencv::core::TermCriteria_COUNT + opencv::core::TermCriteria_EPS, 30, 0.01)?;
    opencv::video::calc_optical_flow_pyr_lk(&from, &to, &start, &mut end, &mut status, &mut error, window, TRACK_LEVELS, stop, 0, 1e-4)?;
    let moved = |((a, b), found): ((Point2f, Point2f), u8)| (found > 0).then(|| Vector2::new(f64::from(b.x - a.x), f64::from(b.y - a.y)));
    Ok(start.iter().zip(end.iter()).zip(status.iter()).map(moved).collect())
}

/// The robust line (2): Geman and McClure's weights, c held by its prior.
fn line(crossings: &[Crossing]) -> Option<Offset> {
    if crossings.len() < FEWEST_CORNERS {
        return None;
    }
    let (mut at, mut weights) = (Vector2::<f64>::zeros(), vec![1.0; crossings.len()]);
    let mut inverse = Matrix2::<f64>::zeros();
    for _ in 0..30 {
        let error = |c: &Crossing| c.distance_px - at[0] * c.speed_px - at[1];
        let scale = (1.4826 * quantile(crossings.iter().map(|c| error(c).abs()).collect(), 0.5)?).max(FINEST_PX);
        weights = crossings.iter().map(|c| (1.0_f64 + (error(c) / (2.0 * scale)).powi(2)).powi(-2) / (scale * scale)).collect();
        let (mut normal, mut right) = (Matrix2::from_diagonal(&Vector2::new(0.0, CALIBRATION_PX.powi(-2))), Vector2::zeros());
        for (c, w) in crossings.iter().zip(&weights) {
            let row = Vector2::new(c.speed_px, 1.0);
            normal += row * row.transpose() * *w;
            right += row * (w * c.distance_px);
        }
        inverse = normal.try_inverse()?;
        at = inverse * right;
    }
    let squares: f64 = crossings.iter().zip(&weights).map(|(c, w)| w * c.speed_px * c.speed_px).sum();
    let shared = SHARED_PX / (squares / weights.iter().sum::<f64>()).sqrt();
    let variance = (inverse * scatter(crossings, &weights, &at) * inverse)[(0, 0)] + shared * shared;
    variance.is_finite().then(|| Offset { frames: at[0], sigma: variance.sqrt() })
}

/// The gradient's covariance from its scatter between instants, whose corners err together, and the prior's.
fn scatter(crossings: &[Crossing], weights: &[f64], at: &Vector2<f64>) -> Matrix2<f64> {
    let last = crossings.iter().map(|c| c.instant).max().unwrap_or(0);
    let mut gradients = vec![Vector2::zeros(); last + 1];
    for (c, w) in crossings.iter().zip(weights) {
        gradients[c.instant] += Vector2::new(c.speed_px, 1.0) * (w * (c.distance_px - at[0] * c.speed_px - at[1]));
    }
    let prior = Matrix2::from_diagonal(&Vector2::new(0.0, CALIBRATION_PX.powi(-2)));
    gradients.iter().map(|g| g * g.transpose()).sum::<Matrix2<f64>>() + prior
}

/// The offsets of all cameras from those of pairs: least squares, inflated where the pairs disagree, counted from the
/// camera in the middle. `None` for cameras of which the pairs tell nothing.
pub fn camera_offsets(cameras: usize, pairs: &[PairOffset]) -> Vec<Option<Offset>> {
    // A loose prior keeps unconnected cameras solvable.
    let mut normal = DMatrix::from_diagonal_element(cameras, cameras, 1e-6);
    let mut right = DVector::zeros(cameras);
    for p in pairs {
        let weight = p.offset.sigma.max(1e-6).powi(-2);
        for (camera, sign) in [(p.first, -1.0), (p.second, 1.0)] {
            right[camera] += sign * weight * p.offset.frames;
            normal[(camera, p.first)] -= sign * weight;
            normal[(camera, p.second)] += sign * weight;
        }
    }
    let Some(covariance) = normal.try_inverse() else { return vec![None; cameras] };
    let at = &covariance * right;
    let misfit: f64 = pairs.iter().map(|p| ((at[p.second] - at[p.first] - p.offset.frames) / p.offset.sigma.max(1e-6)).powi(2)).sum();
    let free = (pairs.len() + 1).saturating_sub(cameras).max(1) as f64;
    let inflation = (misfit / free).max(1.0);
    let aside = |m: usize| (0..cameras).map(|k| (at[k] - at[m]).abs()).sum::<f64>();
    let Some(middle) = (0..cameras).min_by(|&a, &b| aside(a).total_cmp(&aside(b))) else { return Vec::new() };
    let one = |k: usize| {
        let variance = covariance[(k, k)] + covariance[(middle, middle)] - 2.0 * covariance[(k, middle)];
        let sigma = (inflation * variance.max(0.0)).sqrt();
        let heard = pairs.iter().any(|p| p.first == k || p.second == k);
        (heard && sigma < KNOWN_FRAMES).then(|| Offset { frames: at[k] - at[middle], sigma })
    };
    (0..cameras).map(one).collect()
}

/// The better known of two sets of pair offsets, pair by pair.
pub fn better(coarse: &[PairOffset], fine: &[PairOffset]) -> Vec<PairOffset> {
    let of = |pairs: &[PairOffset], p: &PairOffset| pairs.iter().find(|q| (q.first, q.second) == (p.first, p.second)).copied();
    let chosen = |p: &PairOffset| of(fine, p).filter(|f| f.offset.sigma < p.offset.sigma).unwrap_or(*p);
    let only_fine = fine.iter().filter(|f| of(coarse, f).is_none()).copied();
    coarse.iter().map(chosen).chain(only_fine).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::Up;
    use nalgebra::{Matrix3, Rotation3};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn pair(first: usize, second: usize, frames: f64, sigma: f64) -> PairOffset {
        PairOffset { first, second, offset: Offset { frames, sigma } }
    }

    #[test]
    fn offsets_of_pairs_become_those_of_cameras() {
        let found = camera_offsets(4, &[pair(0, 1, 2.0, 0.1), pair(1, 2, -2.1, 0.1), pair(0, 2, -0.1, 1e9)]);
        let expected = [0.0, 2.0, -0.1];
        for (found, expected) in found.iter().zip(expected) {
            assert!((found.unwrap().frames - expected).abs() < 1e-3, "{found:?}");
        }
        assert!(found[3].is_none());
        // Variances add along the chain from camera 0, the one in the middle.
        assert!((found[2].unwrap().sigma - 0.02f64.sqrt()).abs() < 1e-3 && found[0].unwrap().sigma < 1e-6);
        let torn = camera_offsets(3, &[pair(0, 1, 0.0, 0.01), pair(1, 2, 0.0, 0.01), pair(0, 2, 0.3, 0.01)]);
        assert!(torn.iter().any(|o| o.is_some_and(|o| o.sigma > 0.1)), "{torn:?}");
    }

    #[test]
    fn the_line_bears_outliers_and_knows_its_error() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut normal = || (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>();
        let mut standardised = Vec::new();
        for _ in 0..60 {
            let crossings: Vec<Crossing> = (0..160)
                .map(|k| {
                    let (speed_px, wild) = (3.0 * normal(), if k % 9 == 0 { 6.0 * normal() } else { 0.0 });
                    Crossing { instant: k / 20, speed_px, distance_px: 0.37 * speed_px + 0.05 + 0.4 * normal() + wild }
                })
                .collect();
            let found = line(&crossings).unwrap();
            assert!((found.frames - 0.37).abs() < 0.08, "{found:?}");
            standardised.push((found.frames - 0.37) / found.sigma);
        }
        let rms = (standardised.iter().map(|z| z * z).sum::<f64>() / 60.0).sqrt();
        assert!((0.7..1.4).contains(&rms), "{rms}");
        assert!(line(&[]).is_none());
    }

    /// Two cameras side by side that look along z.
    fn rig() -> Rig {
        let camera = |x: f64| Camera {
            name: format!("{x}"),
            size_px: [160, 120],
            matrix: Matrix3::new(150.0, 0.0, 80.0, 0.0, 150.0, 60.0, 0.0, 0.0, 1.0),
            lens: crate::rig::Lens::IDEAL,
            camera_from_world: Rotation3::identity(),
            translation: Vector3::new(-x, 0.0, 0.0),
        };
        Rig { cameras: vec![camera(0.0), camera(0.3)], up: Up::Y }
    }

    #[test]
    fn signatures_tell_whole_frames() {
        let mut signatures = Signatures::new(&rig());
        // A bar that jumps; the second camera sees it 15 px to the left and took the same moment 3 frames before.
        let mask = |frame: i64, left: u32| {
            let top = (30.0 + 14.0 * (0.7 * frame as f64).sin() + 0.8 * frame as f64) as u32;
            GrayImage::from_fn(160, 120, |x, y| {
                image::Luma([if (left..left + 12).contains(&x) && (top..top + 40).contains(&y) { 255 } else { 0 }])
            })
        };
        for frame in 0..30 {
            let signature = signatures.signature(&[mask(frame, 70), mask(frame + 3, 55)]);
            signatures.push(frame as usize, signature);
        }
        let found = signatures.offsets();
        assert!((found[0].offset.frames - 3.0).abs() < 0.1 && found[0].offset.sigma < 0.1, "{found:?}");
        assert!(Signatures::new(&rig()).offsets().is_empty());
    }

    #[test]
    fn corners_are_tracked() {
        let wave = |x: f64, y: f64| (120.0 + 50.0 * (0.5 * x + 0.1 * y).sin() + 50.0 * (0.45 * y - 0.15 * x).cos()) as u8;
        let picture = |t: f64| GrayImage::from_fn(160, 120, |x, y| image::Luma([wave(f64::from(x) - 3.3 * t, f64::from(y) + 1.7 * t)]));
        let points = [Point2::new(80.0, 60.0), Point2::new(50.0, 70.0)];
        for v in velocities([&picture(-1.0), &picture(0.0), &picture(1.0)], &points).unwrap() {
            assert!((v.unwrap() - Vector2::new(3.3, -1.7)).norm() < 0.05, "{v:?}");
        }
        let still = velocities([&picture(0.0), &picture(0.0), &picture(1.0)], &points).unwrap();
        assert!(still.iter().all(Option::is_none), "{still:?}");
    }
}

//! Exact rectification of two or three cameras with one disparity for all pairs.
//!
//! All views are drawn on one plane orientation (e1, e2, n) with the same 2x2 matrix A, focal length f and offset p0:
//!   p_k = f A ((X − c_k)·e1, (X − c_k)·e2) / ((X − c_k)·n) + p0.                                     (1)
//! When every baseline b_k = c_k − c_0 is perpendicular to n, the depth Z = (X − c_k)·n is the same in all views and
//!   p_k = p_0 + d s_k,   s_k = −A b_k / B,   d = f B / Z.                                           (2)
//! A triangle of cameras spans its own plane, and A with s_1 = (±1, 0), s_2 = (0, ±1) makes it an ideal L: one disparity
//! in both pairs. B = sqrt|b_1 × b_2| gives |det A| = 1, so that images keep their resolution; the signs, the roles
//! and the corner are those that keep A nearest to the identity.
//!
//! Three cameras near a line have no useful L: then A is a rotation, the longer baseline becomes an image axis and the
//! third view has its own (not integer) step, which (2) allows. Fails when a third camera near the line leaves the plane
//! by more than [`PLANE_TOLERANCE_M`], or the cameras look in directions more than 60 degrees apart.
//!
//! Checked against the raw cameras' own projection and cv::stereoRectify.

mod warp;

use super::{Camera, Lens, Rig};
use image::{GrayImage, ImageBuffer, Luma};
use nalgebra::{Matrix2, Matrix3, Point2, Rotation3, Vector2, Vector3};
use rayon::prelude::*;
use warp::{back_map, bicubic_row, bilinear, warp_map};

/// A picture of real numbers; NaN where nothing is known.
pub type Plane = ImageBuffer<Luma<f32>, Vec<f32>>;

/// How far a third camera near the line of the others may lie off their plane, metres. At 1.5 m this shifts a point in the
/// corner of a 640-pixel image by 0.4 px.
pub const PLANE_TOLERANCE_M: f64 = 0.002;

/// Beyond this ratio of the singular values of A an L is too sheared to correlate square windows in it.
const MAX_SHEAR: f64 = 3.0;

/// Half the field of a rectified picture. A plane stretches what lies further out (4 times here, without bound towards 90
/// degrees), so that windows of a fisheye camera's rim would match nothing; ordinary lenses do not reach this far.
const WIDEST_FIELD_DEG: f64 = 60.0;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RectifyError {
    #[error("cannot rectify {0} cameras together; choose two or three different cameras of the rig")]
    Count(usize),
    #[error("cameras {0} and {1} are {2:.4} m apart; stereo needs a baseline of at least 1 mm")]
    Baseline(String, String, f64),
    #[error("the views of cameras {0} and {1} differ by {2:.0} degrees in direction; correlation stereo needs less than 60")]
    Directions(String, String, f64),
    #[error("camera {0} lies {1:.1} mm off the plane of the other two views; match it with one of them alone")]
    OffPlane(String, f64),
    #[error("the baselines of cameras {0} run along their viewing direction; stereo needs cameras side by side")]
    AlongAxis(String),
}

/// The picture that a camera of the same matrix takes without distortion; black where this one does not look.
pub fn without_lens(camera: &Camera, image: &GrayImage) -> GrayImage {
    let ideal = Camera { lens: Lens::IDEAL, ..camera.clone() };
    GrayImage::from_fn(image.width(), image.height(), |x, y| {
        let normalised = ideal.normalise(&Point2::new(x.into(), y.into()));
        let at = normalised.map(|n| camera.distorted_pixel(&n));
        Luma([at.map_or(0.0, |p| bilinear(image, p.x as f32, p.y as f32)).round() as u8])
    })
}

/// One camera of a rectified group.
#[derive(Clone, Debug)]
pub struct RectifiedView {
    /// Number of the camera in the rig.
    pub index: usize,
    pub camera: Camera,
    /// Where disparity 1 px moves a pixel of the reference view: `p_k = p_0 + d * step`, pixels per pixel.
    pub step: Vector2<f64>,
    /// Raw pixel of every rectified pixel, row by row; NaN where the camera sees nothing.
    pub map: Vec<[f32; 2]>,
    /// Rectified pixel of every raw pixel, row by row; NaN where the distortion has no inverse.
    pub back_map: Vec<[f32; 2]>,
}

/// Two or three views on one image plane; `views[0]` is the reference.
#[derive(Clone, Debug)]
pub struct Rectification {
    pub size_px: [u32; 2],
    pub focal_px: f64,
    /// B of (2): `depth = focal_px * baseline_m / disparity`.
    pub baseline_m: f64,
    pub views: Vec<RectifiedView>,
    /// Rows e1, e2, n.
    plane_from_world: Rotation3<f64>,
    /// A of (1).
    pixel_from_plane: Matrix2<f64>,
    plane_from_pixel: Matrix2<f64>,
    origin_px: Vector2<f64>,
}

/// What fixes a rectified image plane.
struct Layout {
    order: Vec<usize>,
    plane_from_world: Rotation3<f64>,
    pixel_from_plane: Matrix2<f64>,
    baseline_m: f64,
    /// Distance of A from the identity; smaller is better.
    distortion: f64,
}

/// Pixels that are unwarped together if any of them may show the mask.
const UNWARPED: usize = 16;

impl Rectification {
    /// Ideal pixel of a world point in a view, equation (1); `None` behind the camera.
    pub fn project(&self, view: usize, x_in_world: &Vector3<f64>) -> Option<Vector2<f64>> {
        self.pixel_of_direction(&(x_in_world - self.views[view].camera.centre()))
    }

    /// Raw pixel of a rectified pixel; `None` behind the camera.
    pub fn raw_pixel(&self, view: usize, pixel: &Vector2<f64>) -> Option<Point2<f64>> {
        let in_plane = self.plane_from_pixel * (pixel - self.origin_px) / self.focal_px;
        let camera = &self.views[view].camera;
        let ray = camera.camera_from_world * (self.plane_from_world.inverse() * Vector3::new(in_plane.x, in_plane.y, 1.0));
        (ray.z > 1e-3).then(|| camera.distorted_pixel(&Vector2::new(ray.x / ray.z, ray.y / ray.z)))
    }

    /// Rectified pixel of a raw pixel; `None` where the distortion has no inverse.
    pub fn rectified_pixel(&self, view: usize, raw: &Point2<f64>) -> Option<Vector2<f64>> {
        self.pixel_of_direction(&self.views[view].camera.ray(raw)?)
    }

    /// World point of pixel `(u, v)` of the reference view with disparity `d > 0` px.
    pub fn world_from_pixel(&self, u: f64, v: f64, d: f64) -> Vector3<f64> {
        let depth = self.depth(d);
        let in_plane = self.plane_from_pixel * (Vector2::new(u, v) - self.origin_px) * (depth / self.focal_px);
        self.views[0].camera.centre() + self.plane_from_world.inverse() * Vector3::new(in_plane.x, in_plane.y, depth)
    }

    /// Derivative of [`Self::world_from_pixel`] by `(u, v, d)`, metres per pixel.
    pub fn world_jacobian(&self, u: f64, v: f64, d: f64) -> Matrix3<f64> {
        let by_pixel = self.plane_from_pixel * (self.depth(d) / self.focal_px);
        let by_disparity = (self.views[0].camera.centre() - self.world_from_pixel(u, v, d)) / d;
        let world_from_plane = self.plane_from_world.inverse();
        let column = |k: usize| world_from_plane * Vector3::new(by_pixel[(0, k)], by_pixel[(1, k)], 0.0);
        Matrix3::from_columns(&[column(0), column(1), by_disparity])
    }

    /// Depth perpendicular to the baselines, metres.
    pub fn depth(&self, disparity_px: f64) -> f64 {
        self.focal_px * self.baseline_m / disparity_px
    }

    /// Disparity at a depth, pixels.
    pub fn disparity(&self, depth_m: f64) -> f64 {
        self.focal_px * self.baseline_m / depth_m
    }

    /// A raw picture of a view's camera on the rectified grid, Catmull-Rom; NaN where the camera sees nothing.
    pub fn warp(&self, view: usize, raw: &GrayImage) -> Plane {
        let width = self.size_px[0].max(1) as usize;
        let mut plane = Plane::new(self.size_px[0], self.size_px[1]);
        let rows = plane.par_chunks_exact_mut(width).zip(self.views[view].map.par_chunks_exact(width));
        rows.for_each(|(out, map)| bicubic_row(raw, map, out));
        plane
    }

    /// A rectified 0/255 mask, whose first pixel lies at `corner` of the canvas, on the grid of a view's raw picture; 0 outside.
    pub fn unwarp(&self, view: usize, mask: &GrayImage, corner: [usize; 2]) -> GrayImage {
        let [width, height] = self.views[view].camera.size_px;
        let [left, top] = corner.map(|c| c as f32);
        let [right, bottom] = [left + mask.width() as f32, top + mask.height() as f32];
        let mut raw = GrayImage::new(width, height);
        let rows = raw.par_chunks_exact_mut(width.max(1) as usize).zip(self.views[view].back_map.par_chunks_exact(width.max(1) as usize));
        rows.for_each(|(out, map)| {
            for (out, map) in out.chunks_mut(UNWARPED).zip(map.chunks(UNWARPED)) {
                if map.iter().fold(false, |any, [x, y]| any | ((*x >= left) & (*y >= top) & (*x <= right) & (*y <= bottom))) {
                    for (out, [x, y]) in out.iter_mut().zip(map) {
                        *out = if bilinear(mask, x - left, y - top) >= 127.5 { 255 } else { 0 };
                    }
                }
            }
        });
        raw
    }

    fn pixel_of_direction(&self, direction: &Vector3<f64>) -> Option<Vector2<f64>> {
        let p = self.plane_from_world * direction;
        (p.z > 1e-3 * direction.norm()).then(|| self.pixel_from_plane * Vector2::new(p.x, p.y) * (self.focal_px / p.z) + self.origin_px)
    }
}

/// Rectifies two or three cameras of a rig, given by number. The reference is the best corner of three, the first of two.
pub fn rectify(rig: &Rig, cameras: &[usize]) -> Result<Rectification, RectifyError> {
    let distinct = (1..cameras.len()).all(|k| !cameras[..k].contains(&cameras[k]));
    if !(2..=3).contains(&cameras.len()) || !distinct || cameras.iter().any(|&k| k >= rig.cameras.len()) {
        return Err(RectifyError::Count(cameras.len()));
    }
    check_pairs(rig, cameras)?;
    let layout = if cameras.len() == 3 { best_l(rig, cameras) } else { None };
    let layout = match layout {
        Some(layout) => layout,
        None => in_line(rig, cameras)?,
    };
    Ok(draw(rig, layout))
}

/// Rectified groups that together use every camera which has a partner: triples sharing cameras where they must, pairs where
/// no triple exists. Fails only when no two cameras fit together.
pub fn groups(rig: &Rig) -> Result<Vec<Rectification>, RectifyError> {
    let mut found: Vec<Rectification> = Vec::new();
    let mut first_error = None;
    for camera in 0..rig.cameras.len() {
        if found.iter().any(|group| group.views.iter().any(|view| view.index == camera)) {
            continue;
        }
        match group_around(rig, camera, &found) {
            Ok(group) => found.push(group),
            Err(error) => first_error = first_error.or(Some(error)),
        }
    }
    if found.is_empty() { Err(first_error.unwrap_or(RectifyError::Count(rig.cameras.len()))) } else { Ok(found) }
}

/// The first group of `camera` with its neighbours that can be rectified; unused cameras first, near ones before far ones.
fn group_around(rig: &Rig, camera: usize, found: &[Rectification]) -> Result<Rectification, RectifyError> {
    let used = |k: usize| found.iter().any(|group| group.views.iter().any(|view| view.index == k));
    let distance = |k: usize| (rig.cameras[k].centre() - rig.cameras[camera].centre()).norm();
    let mut others: Vec<usize> = (0..rig.cameras.len()).filter(|&k| k != camera).collect();
    others.sort_by(|&a, &b| used(a).cmp(&used(b)).then(distance(a).total_cmp(&distance(b))));
    let mut last = RectifyError::Count(rig.cameras.len());
    let triples = (0..others.len()).flat_map(|i| (i + 1..others.len()).map(move |j| (i, j)));
    let wanted = triples.map(|(i, j)| vec![camera, others[i], others[j]]).chain(others.iter().map(|&k| vec![camera, k]));
    for cameras in wanted {
        match rectify(rig, &cameras) {
            Ok(group) => return Ok(group),
            Err(error) => last = error,
        }
    }
    Err(last)
}

fn optical_axis(camera: &Camera) -> Vector3<f64> {
    camera.camera_from_world.inverse() * Vector3::z()
}

fn mean_axis(rig: &Rig, cameras: &[usize]) -> Vector3<f64> {
    cameras.iter().map(|&k| optical_axis(&rig.cameras[k])).sum::<Vector3<f64>>().normalize()
}

fn check_pairs(rig: &Rig, cameras: &[usize]) -> Result<(), RectifyError> {
    for (i, &a) in cameras.iter().enumerate() {
        for &b in &cameras[..i] {
            let (a, b) = (&rig.cameras[a], &rig.cameras[b]);
            let baseline = (a.centre() - b.centre()).norm();
            if baseline < 1e-3 {
                return Err(RectifyError::Baseline(b.name.clone(), a.name.clone(), baseline));
            }
            let angle = optical_axis(a).angle(&optical_axis(b)).to_degrees();
            if angle > 60.0 {
                return Err(RectifyError::Directions(b.name.clone(), a.name.clone(), angle));
            }
        }
    }
    Ok(())
}

/// Rows e1, e2, n with e1 as near as possible to the camera's x axis.
fn plane_axes(camera: &Camera, n: &Vector3<f64>) -> Rotation3<f64> {
    let x = camera.camera_from_world.inverse() * Vector3::x();
    let e1 = (x - n * x.dot(n)).normalize();
    Rotation3::from_matrix_unchecked(Matrix3::from_rows(&[e1.transpose(), n.cross(&e1).transpose(), n.transpose()]))
}

/// The least distorted L over corners and roles; an earlier camera stays the corner unless another is clearly better.
fn best_l(rig: &Rig, cameras: &[usize]) -> Option<Layout> {
    let mut best: Option<Layout> = None;
    for (corner, a, b) in [(0, 1, 2), (1, 0, 2), (2, 0, 1)] {
        for (h, v) in [(a, b), (b, a)] {
            let layout = l_layout(rig, [cameras[corner], cameras[h], cameras[v]]);
            best = match (best, layout) {
                (Some(old), Some(new)) if new.distortion < old.distortion - 0.05 => Some(new),
                (None, new) => new,
                (old, _) => old,
            };
        }
    }
    best
}

/// Corner, horizontal and vertical camera drawn as an ideal L, if that neither mirrors nor shears too much.
fn l_layout(rig: &Rig, order: [usize; 3]) -> Option<Layout> {
    let [corner, h, v] = order.map(|k| rig.cameras[k].centre());
    let (b_h, b_v) = (h - corner, v - corner);
    let normal = b_h.cross(&b_v);
    let forward = mean_axis(rig, &order);
    let n = normal.try_normalize(1e-9)? * normal.dot(&forward).signum();
    if n.angle(&forward) > 40f64.to_radians() {
        return None;
    }
    let plane_from_world = plane_axes(&rig.cameras[order[0]], &n);
    let (b_h, b_v) = (plane_from_world * b_h, plane_from_world * b_v);
    let baselines = Matrix2::new(b_h.x, b_v.x, b_h.y, b_v.y);
    let baseline_m = baselines.determinant().abs().sqrt();
    // (2) with steps (±1, 0) and (0, ±1), the signs that make A's diagonal positive.
    let a = -baselines.try_inverse()? * baseline_m;
    let a = Matrix2::from_diagonal(&Vector2::new(a[(0, 0)].signum(), a[(1, 1)].signum())) * a;
    let stretch = a.singular_values();
    let usable = a.determinant() > 0.0 && stretch.max() / stretch.min() < MAX_SHEAR;
    usable.then(|| Layout {
        order: order.to_vec(),
        plane_from_world,
        pixel_from_plane: a,
        baseline_m,
        distortion: (a - Matrix2::identity()).norm(),
    })
}

/// Two cameras, or three near a line: the longest baseline from the reference becomes an image axis, A is a rotation.
fn in_line(rig: &Rig, cameras: &[usize]) -> Result<Layout, RectifyError> {
    let centre = |k: usize| rig.cameras[k].centre();
    let spread = |k: usize| cameras.iter().map(|&j| (centre(j) - centre(k)).norm()).sum::<f64>();
    let mut order = cameras.to_vec();
    if order.len() == 3 {
        // The middle camera sees most of what the others see.
        let middle = (0..3).min_by(|&a, &b| spread(cameras[a]).total_cmp(&spread(cameras[b]))).unwrap_or(0);
        order.swap(0, middle);
        let length = |k: usize| (centre(k) - centre(order[0])).norm();
        if length(order[2]) > length(order[1]) {
            order.swap(1, 2);
        }
    }
    let names = || cameras.iter().map(|&k| rig.cameras[k].name.as_str()).collect::<Vec<_>>().join(", ");
    let baseline = centre(order[1]) - centre(order[0]);
    let (along, forward) = (baseline.normalize(), mean_axis(rig, &order));
    if along.dot(&forward).abs() > 40f64.to_radians().cos() {
        return Err(RectifyError::AlongAxis(names()));
    }
    let n = (forward - along * along.dot(&forward)).normalize();
    if let Some(&third) = order.get(2) {
        let off_plane = (centre(third) - centre(order[0])).dot(&n).abs();
        if off_plane > PLANE_TOLERANCE_M {
            return Err(RectifyError::OffPlane(rig.cameras[third].name.clone(), 1e3 * off_plane));
        }
    }
    let plane_from_world = plane_axes(&rig.cameras[order[0]], &n);
    let b = plane_from_world * along;
    // Turn so that the baseline lies along x or y, whichever is nearer.
    let a = if b.x.abs() >= b.y.abs() {
        Matrix2::new(b.x, b.y, -b.y, b.x) * b.x.signum()
    } else {
        Matrix2::new(b.y, -b.x, b.x, b.y) * b.y.signum()
    };
    Ok(Layout { order, plane_from_world, pixel_from_plane: a, baseline_m: baseline.norm(), distortion: (a - Matrix2::identity()).norm() })
}

/// Chooses focal length and canvas, and draws the warp maps.
fn draw(rig: &Rig, layout: Layout) -> Rectification {
    let cameras: Vec<&Camera> = layout.order.iter().map(|&k| &rig.cameras[k]).collect();
    let focal = |c: &&Camera| (c.matrix[(0, 0)] * c.matrix[(1, 1)]).abs().sqrt();
    let step = |c: &Camera| {
        let b = layout.plane_from_world * (c.centre() - cameras[0].centre());
        -(layout.pixel_from_plane * Vector2::new(b.x, b.y)) / layout.baseline_m
    };
    let views = layout.order.iter().zip(&cameras).map(|(&index, &c)| RectifiedView {
        index,
        camera: c.clone(),
        step: step(c),
        map: Vec::new(),
        back_map: Vec::new(),
    });
    let mut rectification = Rectification {
        size_px: [0, 0],
        focal_px: cameras.iter().map(focal).sum::<f64>() / cameras.len() as f64,
        baseline_m: layout.baseline_m,
        views: views.collect(),
        plane_from_world: layout.plane_from_world,
        pixel_from_plane: layout.pixel_from_plane,
        plane_from_pixel: layout.pixel_from_plane.try_inverse().unwrap_or_else(Matrix2::identity),
        origin_px: Vector2::zeros(),
    };
    choose_canvas(&mut rectification);
    for view in 0..rectification.views.len() {
        rectification.views[view].back_map = back_map(&rectification, view);
        rectification.views[view].map = warp_map(&rectification, view);
    }
    rectification
}

/// One canvas for all views: the box around everything they see, at most twice the reference's own box.
fn choose_canvas(rectification: &mut Rectification) {
    let boxes: Vec<_> = (0..rectification.views.len()).map(|view| seen_box(rectification, view)).collect();
    let (low, high) = boxes[0];
    let margin = (high - low) / 2.0;
    let low = boxes.iter().fold(low, |a, b| a.inf(&b.0)).sup(&(low - margin)).map(f64::floor);
    let high = boxes.iter().fold(high, |a, b| a.sup(&b.1)).inf(&(high + margin)).map(f64::ceil);
    rectification.origin_px = -low;
    rectification.size_px = [(high.x - low.x) as u32 + 1, (high.y - low.y) as u32 + 1];
}

/// Rectified box around what a view sees, within [`WIDEST_FIELD_DEG`].
fn seen_box(rectification: &Rectification, view: usize) -> (Vector2<f64>, Vector2<f64>) {
    let [w, h] = rectification.views[view].camera.size_px.map(|s| f64::from(s) - 1.0);
    let share = |k: i32| f64::from(k) / 32.0;
    // Not the border alone: a wide lens may see nothing there.
    let grid = (0..=32).flat_map(|i| (0..=32).map(move |k| Point2::new(share(i) * w, share(k) * h)));
    let reach = Vector2::repeat(rectification.focal_px * WIDEST_FIELD_DEG.to_radians().tan());
    let mut low = Vector2::repeat(f64::INFINITY);
    let mut high = Vector2::repeat(f64::NEG_INFINITY);
    for p in grid.filter_map(|raw| rectification.rectified_pixel(view, &raw)) {
        low = low.inf(&p.sup(&-reach));
        high = high.sup(&p.inf(&reach));
    }
    // Nothing within the lens model's reach: fall back to the image's own size around the axis.
    if low.x.is_finite() { (low, high) } else { (Vector2::new(-w / 2.0, -h / 2.0), Vector2::new(w / 2.0, h / 2.0)) }
}

#[cfg(test)]
pub(crate) mod tests;

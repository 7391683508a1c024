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

use super::{Camera, Rig};
use image::{GrayImage, ImageBuffer, Luma};
use nalgebra::{Matrix2, Matrix3, Point2, Rotation3, Vector2, Vector3};
use rayon::prelude::*;

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
        let values = self.views[view].map.par_iter().map(|&[x, y]| bicubic(raw, x, y)).collect();
        ImageBuffer::from_raw(self.size_px[0], self.size_px[1], values).expect("one map entry per pixel")
    }

    /// A rectified 0/255 mask on the grid of a view's raw picture; 0 outside the canvas.
    pub fn unwarp(&self, view: usize, mask: &GrayImage) -> GrayImage {
        let [width, height] = self.views[view].camera.size_px;
        let values = self.views[view].back_map.par_iter().map(|&[x, y]| if bilinear(mask, x, y) >= 127.5 { 255 } else { 0 }).collect();
        ImageBuffer::from_raw(width, height, values).expect("one map entry per pixel")
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

fn warp_map(rectification: &Rectification, view: usize) -> Vec<[f32; 2]> {
    let [width, height] = rectification.size_px;
    let [w, h] = rectification.views[view].camera.size_px.map(|s| f64::from(s) - 1.0);
    let pixels = (0..height).into_par_iter().flat_map_iter(|v| (0..width).map(move |u| Vector2::new(f64::from(u), f64::from(v))));
    let back_map = &rectification.views[view].back_map;
    let raw = |p: Vector2<f64>| {
        let raw = rectification.raw_pixel(view, &p)?;
        if !(raw.x >= -0.5 && raw.y >= -0.5 && raw.x < w + 0.5 && raw.y < h + 0.5) {
            return None;
        }
        // Far outside the image the distortion may fold back into it; there the way back leads elsewhere.
        let [x, y] = *back_map.get(raw.y.round() as usize * (w as usize + 1) + raw.x.round() as usize)?;
        ((p - Vector2::new(x.into(), y.into())).norm() < 3.0).then_some([raw.x as f32, raw.y as f32])
    };
    pixels.map(|p| raw(p).unwrap_or([f32::NAN; 2])).collect()
}

fn back_map(rectification: &Rectification, view: usize) -> Vec<[f32; 2]> {
    let [width, height] = rectification.views[view].camera.size_px;
    let pixels = (0..height).into_par_iter().flat_map_iter(|v| (0..width).map(move |u| Point2::new(f64::from(u), f64::from(v))));
    pixels.map(|raw| rectification.rectified_pixel(view, &raw).map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32])).collect()
}

/// Catmull-Rom interpolation with replicated borders; NaN at NaN.
fn bicubic(image: &GrayImage, x: f32, y: f32) -> f32 {
    if x.is_nan() {
        return f32::NAN;
    }
    let (x0, y0) = (x.floor(), y.floor());
    let (wx, wy) = (catmull_rom(x - x0), catmull_rom(y - y0));
    let (width, height) = (image.width() as i32, image.height() as i32);
    let data = image.as_raw();
    let mut sum = 0.0;
    for (j, wy) in wy.iter().enumerate() {
        let row = (y0 as i32 + j as i32 - 1).clamp(0, height - 1) * width;
        for (i, wx) in wx.iter().enumerate() {
            let column = (x0 as i32 + i as i32 - 1).clamp(0, width - 1);
            sum += wy * wx * f32::from(data[(row + column) as usize]);
        }
    }
    sum
}

fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

/// Bilinear interpolation; 0 outside and at NaN.
fn bilinear(image: &GrayImage, x: f32, y: f32) -> f32 {
    let (width, height) = (image.width() as f32, image.height() as f32);
    if !(x >= 0.0 && y >= 0.0 && x <= width - 1.0 && y <= height - 1.0) {
        return 0.0;
    }
    let (x0, y0) = (x as u32, y as u32);
    let (tx, ty) = (x - x0 as f32, y - y0 as f32);
    let at = |i: u32, j: u32| f32::from(image.get_pixel((x0 + i).min(image.width() - 1), (y0 + j).min(image.height() - 1)).0[0]);
    (1.0 - ty) * ((1.0 - tx) * at(0, 0) + tx * at(1, 0)) + ty * ((1.0 - tx) * at(0, 1) + tx * at(1, 1))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    /// Three cameras at about 1.5 m height that look along +y, somewhere near an L or near a line.
    pub(crate) fn random_rig(random: &mut ChaCha8Rng, in_line: bool) -> Rig {
        let mut around = |size: f64| (random.random::<f64>() - 0.5) * 2.0 * size;
        let looking = Matrix3::from_rows(&[Vector3::x().transpose(), -Vector3::z().transpose(), Vector3::y().transpose()]);
        let mut places = vec![Vector3::new(around(0.1), around(0.1), 1.5)];
        let first = places[0];
        let side = if around(1.0) > 0.0 { 0.2 } else { -0.2 };
        places.push(first + Vector3::new(side + around(0.05), around(0.03), around(0.05)));
        if in_line {
            let b = places[1] - first;
            places.push(first + b * (1.6 + around(0.4)) + Vector3::new(0.0, 0.0, around(0.01)));
        } else {
            places.push(first + Vector3::new(around(0.08), around(0.03), side.signum() * (0.2 + around(0.05))));
        }
        let camera = |(k, centre): (usize, Vector3<f64>), around: &mut dyn FnMut(f64) -> f64| {
            let turn = Rotation3::new(Vector3::new(around(0.08), around(0.08), around(0.08)));
            let camera_from_world = turn * Rotation3::from_matrix_unchecked(looking);
            Camera {
                name: format!("cam_{k:02}"),
                size_px: [640, 480],
                matrix: Matrix3::new(
                    550.0 + around(30.0),
                    0.0,
                    320.0 + around(10.0),
                    0.0,
                    550.0 + around(30.0),
                    240.0 + around(10.0),
                    0.0,
                    0.0,
                    1.0,
                ),
                lens: crate::rig::Lens::BrownConrady([around(0.1), around(0.02), around(1e-3), around(1e-3), 0.0, 0.0, 0.0, 0.0]),
                camera_from_world,
                translation: -(camera_from_world * centre),
            }
        };
        let cameras = places.into_iter().enumerate().map(|place| camera(place, &mut around)).collect();
        Rig { cameras, up: super::super::Up::Z }
    }

    fn random_point(random: &mut ChaCha8Rng) -> Vector3<f64> {
        let mut around = |size: f64| (random.random::<f64>() - 0.5) * 2.0 * size;
        Vector3::new(around(0.8), 3.5 + around(1.5), 1.5 + around(0.8))
    }

    /// The relation (2) through the raw cameras: raw projection, back through the view's lens model, equal disparities.
    fn check(rectification: &Rectification, rig: &Rig, random: &mut ChaCha8Rng) {
        for _ in 0..50 {
            let x = random_point(random);
            let pixels: Vec<Vector2<f64>> = rectification
                .views
                .iter()
                .enumerate()
                .map(|(k, view)| rectification.rectified_pixel(k, &rig.cameras[view.index].project(&x).unwrap()).unwrap())
                .collect();
            let step = rectification.views[1].step;
            let d = (pixels[1] - pixels[0]).dot(&step) / step.norm_squared();
            assert!(d > 1.0);
            for (pixel, view) in pixels.iter().zip(&rectification.views) {
                assert!((pixel - (pixels[0] + view.step * d)).norm() < 1e-9, "{pixel} {} {d}", view.step);
            }
            assert!((rectification.world_from_pixel(pixels[0].x, pixels[0].y, d) - x).norm() < 1e-9);
        }
    }

    #[test]
    fn random_triangles_become_an_ideal_l() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..6 {
            let rig = random_rig(&mut random, false);
            let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
            let steps: Vec<_> = rectification.views.iter().map(|v| v.step.map(f64::abs)).collect();
            assert!((steps[1] - Vector2::x()).norm() < 1e-12 && (steps[2] - Vector2::y()).norm() < 1e-12, "{steps:?}");
            assert!((rectification.pixel_from_plane.determinant() - 1.0).abs() < 1e-12);
            check(&rectification, &rig, &mut random);
        }
    }

    #[test]
    fn fisheye_cameras_become_an_ideal_l_too() {
        let mut random = ChaCha8Rng::seed_from_u64(8);
        let mut rig = random_rig(&mut random, false);
        for camera in &mut rig.cameras {
            // 180 degrees across the width: the rim has no place on a plane.
            camera.matrix[(0, 0)] *= 0.37;
            camera.matrix[(1, 1)] *= 0.37;
            camera.lens = crate::rig::Lens::Fisheye([-0.02, 0.004, -0.003, 0.0005]);
        }
        let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
        check(&rectification, &rig, &mut random);
        let [width, height] = rectification.size_px;
        let widest = (2.0 * 1.7321 * rectification.focal_px) as u32 + 3;
        assert!((640..=widest).contains(&width) && (480..=widest).contains(&height), "{width} x {height}");
        for view in 0..3 {
            let camera = &rectification.views[view].camera;
            let value = |x: f64, y: f64| 128.0 + 60.0 * (x / 17.0).sin() + 50.0 * (y / 23.0).cos();
            let raw = GrayImage::from_fn(640, 480, |x, y| Luma([value(f64::from(x), f64::from(y)).round() as u8]));
            let warped = rectification.warp(view, &raw);
            let mut known = 0;
            for (u, v, p) in warped.enumerate_pixels().filter(|(_, _, p)| !p.0[0].is_nan()) {
                let at = Vector2::new(f64::from(u), f64::from(v));
                // Through the ray and the world point, not through the map.
                let x = rectification.world_from_pixel(at.x, at.y, rectification.disparity(3.0));
                let from_reference = rectification.views[view].step * rectification.disparity(3.0);
                let pixel = rectification.project(view, &x).unwrap() - from_reference;
                assert!((pixel - at).norm() < 1e-9);
                let raw_at = camera.project(&(x + camera.centre() - rectification.views[0].camera.centre())).unwrap();
                if raw_at.x > 2.0 && raw_at.y > 2.0 && raw_at.x < 637.0 && raw_at.y < 477.0 {
                    assert!((f64::from(p.0[0]) - value(raw_at.x, raw_at.y)).abs() < 1.2);
                    known += 1;
                }
            }
            assert!(known > 200_000, "view {view} shows {known} pixels");
        }
    }

    #[test]
    fn cameras_near_a_line_keep_their_own_steps() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for _ in 0..6 {
            let mut rig = random_rig(&mut random, true);
            // Onto the plane that the rectification takes: the group is exact there.
            let rectification = match rectify(&rig, &[0, 1, 2]) {
                Err(RectifyError::OffPlane(..)) => continue,
                other => other.unwrap(),
            };
            let n = rectification.plane_from_world.inverse() * Vector3::z();
            let reference = rig.cameras[rectification.views[0].index].centre();
            for camera in &mut rig.cameras {
                let off = n * (camera.centre() - reference).dot(&n);
                assert!(off.norm() <= PLANE_TOLERANCE_M);
                camera.translation += camera.camera_from_world * off;
            }
            let exact = rectify(&rig, &[0, 1, 2]).unwrap();
            assert!((exact.views[1].step.norm() - 1.0).abs() < 1e-12);
            assert!(exact.views[2].step.norm() < 1.0 + 1e-12);
            check(&exact, &rig, &mut random);
        }
    }

    #[test]
    fn pairs_work_and_jacobians_meet_central_differences() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        for _ in 0..6 {
            let rig = random_rig(&mut random, false);
            for cameras in [&[0, 1][..], &[2, 0], &[1, 2, 0]] {
                let r = rectify(&rig, cameras).unwrap();
                check(&r, &rig, &mut random);
                let at = Vector3::new(300.0, 250.0, r.disparity(2.5));
                let jacobian = r.world_jacobian(at.x, at.y, at.z);
                for k in 0..3 {
                    let (a, b) = (at + Vector3::ith(k, 1e-3), at - Vector3::ith(k, 1e-3));
                    let numeric = (r.world_from_pixel(a.x, a.y, a.z) - r.world_from_pixel(b.x, b.y, b.z)) / 2e-3;
                    assert!((numeric - jacobian.column(k)).norm() < 1e-6 * numeric.norm());
                }
            }
        }
    }

    #[test]
    fn a_pair_has_the_epipolar_geometry_and_depth_of_opencv() {
        use opencv::{calib3d, core, prelude::*};
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mat = |m: &[f64], rows: i32| core::Mat::new_rows_cols_with_data(rows, m.len() as i32 / rows, m).unwrap().try_clone().unwrap();
        for _ in 0..10 {
            let rig = random_rig(&mut random, false);
            let [a, b] = [&rig.cameras[0], &rig.cameras[1]];
            let r = b.camera_from_world * a.camera_from_world.inverse();
            let t = b.translation - r * a.translation;
            let rows = |m: &Matrix3<f64>| mat(m.transpose().as_slice(), 3);
            let (mut r1, mut r2, mut p1, mut p2, mut q): (core::Mat, core::Mat, core::Mat, core::Mat, core::Mat) = Default::default();
            calib3d::stereo_rectify(
                &rows(&a.matrix),
                &mat(a.lens.terms(), 1),
                &rows(&b.matrix),
                &mat(b.lens.terms(), 1),
                core::Size::new(640, 480),
                &rows(r.matrix()),
                &mat(t.as_slice(), 3),
                &mut r1,
                &mut r2,
                &mut p1,
                &mut p2,
                &mut q,
                calib3d::CALIB_ZERO_DISPARITY,
                -1.0,
                core::Size::default(),
                None,
                None,
            )
            .unwrap();
            let pixel = |camera: &Camera, r: &core::Mat, p: &core::Mat, x: &Vector3<f64>| {
                let raw = camera.project(x).unwrap();
                let source = core::Mat::from_slice(&[core::Point2d::new(raw.x, raw.y)]).unwrap().try_clone().unwrap();
                let mut out = core::Mat::default();
                let criteria = core::TermCriteria::new(3, 100, 1e-14).unwrap();
                calib3d::undistort_points_iter(&source, &mut out, &rows(&camera.matrix), &mat(camera.lens.terms(), 1), r, p, criteria)
                    .unwrap();
                let p = *out.at::<core::Point2d>(0).unwrap();
                Vector2::new(p.x, p.y)
            };
            let ours = rectify(&rig, &[0, 1]).unwrap();
            let p2 = |i, j| *p2.at_2d::<f64>(i, j).unwrap();
            // OpenCV splits the rotation between the views, so axes and depths are those of its own plane: compare in the world.
            let x = random_point(&mut random);
            let (u, v) = (
                pixel(a, &r1, &p1, &x),
                pixel(
                    b,
                    &r2,
                    &core::Mat::from_slice_2d(&[
                        [p2(0, 0), p2(0, 1), p2(0, 2), p2(0, 3)],
                        [p2(1, 0), p2(1, 1), p2(1, 2), p2(1, 3)],
                        [0.0, 0.0, 1.0, 0.0],
                    ])
                    .unwrap(),
                    &x,
                ),
            );
            assert!((u.y - v.y).abs() < 1e-6, "OpenCV's rows differ: {u} {v}");
            let theirs = p2(0, 3).abs() / (u.x - v.x).abs();
            let rectified = Matrix3::from_fn(|i, j| *r1.at_2d::<f64>(i as i32, j as i32).unwrap());
            assert!((theirs - (rectified * a.camera_point(&x)).z).abs() < 1e-6);
            let pixels = [0, 1].map(|k| ours.rectified_pixel(k, &rig.cameras[ours.views[k].index].project(&x).unwrap()).unwrap());
            assert!((pixels[0].y - pixels[1].y).abs() < 1e-9);
            let point = ours.world_from_pixel(pixels[0].x, pixels[0].y, (pixels[1].x - pixels[0].x).abs());
            assert!(((rectified * a.camera_point(&point)).z - theirs).abs() < 1e-6);
            // The same baseline direction in the world: both planes contain the epipolar lines.
            let along = rectified.transpose() * Vector3::x();
            let e1 = a.camera_from_world * (ours.plane_from_world.inverse() * (ours.plane_from_pixel * Vector2::x()).push(0.0));
            assert!(along.cross(&e1).norm() < 1e-6);
        }
    }

    #[test]
    fn warped_pictures_show_points_where_they_belong() {
        let mut random = ChaCha8Rng::seed_from_u64(6);
        let rig = random_rig(&mut random, false);
        let rectification = rectify(&rig, &[0, 1, 2]).unwrap();
        for view in 0..3 {
            // A smooth picture of the direction: bicubic reading must agree with the formula.
            let value = |x: f64, y: f64| 128.0 + 60.0 * (x / 17.0).sin() + 50.0 * (y / 23.0).cos();
            let raw = GrayImage::from_fn(640, 480, |x, y| Luma([value(f64::from(x), f64::from(y)).round() as u8]));
            let warped = rectification.warp(view, &raw);
            let mut known = 0;
            for (u, v, p) in warped.enumerate_pixels().filter(|(_, _, p)| !p.0[0].is_nan()) {
                let at = rectification.raw_pixel(view, &Vector2::new(f64::from(u), f64::from(v))).unwrap();
                if at.x > 2.0 && at.y > 2.0 && at.x < 637.0 && at.y < 477.0 {
                    assert!((f64::from(p.0[0]) - value(at.x, at.y)).abs() < 1.2);
                    known += 1;
                }
            }
            assert!(known > 200_000, "view {view} shows {known} pixels");
            let white = GrayImage::from_pixel(rectification.size_px[0], rectification.size_px[1], Luma([255]));
            let back = rectification.unwarp(view, &white);
            assert!(back.iter().filter(|&&v| v == 255).count() > 300_000);
        }
    }

    #[test]
    fn impossible_groups_are_refused_and_groups_cover_every_camera() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let mut rig = random_rig(&mut random, false);
        assert!(matches!(rectify(&rig, &[0]), Err(RectifyError::Count(1))));
        assert!(matches!(rectify(&rig, &[0, 0]), Err(RectifyError::Count(2))));
        assert!(matches!(rectify(&rig, &[0, 9]), Err(RectifyError::Count(2))));
        let mut twin = rig.cameras[0].clone();
        twin.name = "twin".into();
        rig.cameras.push(twin);
        assert!(matches!(rectify(&rig, &[0, 3]), Err(RectifyError::Baseline(..))));
        // Move the fourth beside the first: four cameras make two groups that cover all.
        rig.cameras[3].translation += Vector3::new(0.0, 0.25, 0.0);
        let found = groups(&rig).unwrap();
        assert_eq!(found.len(), 2);
        let covered: std::collections::BTreeSet<usize> = found.iter().flat_map(|g| g.views.iter().map(|v| v.index)).collect();
        assert_eq!(covered.len(), 4);
        let turned = Rotation3::new(Vector3::new(0.0, 2.0, 0.0)) * rig.cameras[1].camera_from_world;
        rig.cameras[1].camera_from_world = turned;
        assert!(matches!(rectify(&rig, &[0, 1]), Err(RectifyError::Directions(..))));
    }
}

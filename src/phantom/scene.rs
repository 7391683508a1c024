//! Images, depth maps and masks of the phantom.
//!
//! Rays go through the camera's distortion, 2×2 per pixel. The room is cast once per camera, the body where it can be;
//! grey = 255 · albedo · (ambient + diffuse · max(0, n·l) · (1 − shadow)); then Gaussian sensor noise
//! from a ChaCha stream per frame and camera, and rounding. Not modelled: lens blur, motion blur, shadows on the body
//! itself. Checked against the closed forms of a ball and of the floor.

use image::{GrayImage, ImageBuffer, Luma};
use nalgebra::{Point2, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use super::figure::{Eye, Figure, Shadow};
use super::stage::{AMBIENT, Stage};
use crate::body::surface::Surface;
use crate::body::{NODES, Placement, Pose, Shape, place};
use crate::rig::Camera;

/// Depth along the optical axis in metres at pixel centres; infinite where there is nothing.
pub type DepthMap = ImageBuffer<Luma<f32>, Vec<f32>>;

/// Stream of the empty-stage pictures' noise.
const EMPTY_STAGE: u64 = 0xffff_ffff;

/// A room and a body.
#[derive(Clone, Debug)]
pub struct Scene {
    pub stage: Stage,
    pub surface: Surface,
    pub offsets: [Vector3<f64>; NODES],
    /// Standard deviation of the sensor noise in grey levels.
    pub noise_grey: f64,
    pub seed: u64,
}

/// A camera's picture of the room, without noise, made once and reused for every frame.
pub struct View {
    pub camera: Camera,
    /// Place of the camera in its rig; picks the noise.
    pub index: usize,
    room: Vec<RoomPixel>,
}

#[derive(Clone)]
struct RoomPixel {
    grey: f32,
    /// Share of `grey` that comes from the light and not from all around.
    direct: f32,
    /// `None` where the distortion has no inverse.
    seen: Option<Seen>,
}

#[derive(Clone)]
struct Seen {
    /// Point of the room at the pixel's centre.
    point: Vector3<f64>,
    /// Directions in the world of the rays through the pixel.
    rays: [Vector3<f32>; 4],
}

impl Scene {
    /// A body of this shape, noise of 2 grey levels.
    pub fn new(stage: Stage, shape: &Shape) -> Scene {
        Scene { stage, surface: Surface::new(shape), offsets: shape.offsets(), noise_grey: 2.0, seed: 1 }
    }

    fn figure(&self, pose: &Pose) -> Figure {
        Figure::new(&self.surface, &self.offsets, &place(&self.offsets, pose))
    }
}

impl View {
    /// Casts the room; rows in parallel.
    pub fn new(stage: &Stage, camera: &Camera, index: usize) -> View {
        let [width, height] = camera.size_px;
        let row = |y: u32| (0..width).map(move |x| room_pixel(stage, camera, x, y));
        View { camera: camera.clone(), index, room: (0..height).into_par_iter().flat_map_iter(row).collect() }
    }
}

fn room_pixel(stage: &Stage, camera: &Camera, x: u32, y: u32) -> RoomPixel {
    let origin = camera.centre();
    let see = |direction: &Vector3<f64>| {
        let (t, normal) = stage.hit(&origin, direction);
        (origin + direction * t, normal)
    };
    let centre = camera.ray(&Point2::new(x as f64, y as f64));
    // The four centres of the pixel's quarters.
    let rays =
        [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)].map(|(dx, dy)| camera.ray(&Point2::new(x as f64 + dx, y as f64 + dy)));
    let (Some(centre), [Some(a), Some(b), Some(c), Some(d)]) = (centre, rays) else {
        return RoomPixel { grey: 0.0, direct: 0.0, seen: None };
    };
    let (point, normal) = see(&centre);
    let light = AMBIENT + stage.direct(&normal);
    let reflected = |(x, normal): (Vector3<f64>, Vector3<f64>)| stage.albedo(&x, &normal) * (AMBIENT + stage.direct(&normal));
    let mean = [a, b, c, d].iter().map(|ray| reflected(see(ray))).sum::<f64>() / 4.0;
    let seen = Some(Seen { point, rays: [a, b, c, d].map(|ray| ray.cast()) });
    RoomPixel { grey: (255.0 * mean) as f32, direct: ((light - AMBIENT) / light) as f32, seen }
}

/// What `view` records of the body in `pose` (rig's world) at number `frame`.
pub fn render(scene: &Scene, view: &View, pose: &Pose, frame: usize) -> GrayImage {
    let figure = scene.figure(pose);
    let mut grey = shadowed_room(&scene.stage, view, &figure);
    let mut eye = figure.seen_from(&view.camera.centre());
    let width = view.camera.size_px[0];
    for (x, y) in pixels(&figure, &view.camera) {
        let at = (y * width + x) as usize;
        if let Some(seen) = &view.room[at].seen {
            grey[at] = body_pixel(&scene.stage, &mut eye, &seen.rays, grey[at]);
        }
    }
    expose(scene, view, &grey, frame as u64)
}

/// What `view` records of the empty room.
pub fn render_stage(scene: &Scene, view: &View) -> GrayImage {
    let grey: Vec<f32> = view.room.iter().map(|p| p.grey).collect();
    expose(scene, view, &grey, EMPTY_STAGE)
}

/// True depth of body and room.
pub fn depth(scene: &Scene, view: &View, pose: &Pose) -> DepthMap {
    let [width, height] = view.camera.size_px;
    let axial = |x: &Vector3<f64>| view.camera.camera_point(x).z as f32;
    let room = view.room.iter().map(|p| p.seen.as_ref().map_or(f32::INFINITY, |s| axial(&s.point))).collect();
    let mut map = DepthMap::from_raw(width, height, room).unwrap_or_default();
    let figure = scene.figure(pose);
    let mut eye = figure.seen_from(&view.camera.centre());
    for (x, y) in pixels(&figure, &view.camera) {
        if let Some((direction, t)) = hit(&view.camera, &mut eye, x, y) {
            map.put_pixel(x, y, Luma([axial(&(view.camera.centre() + direction * t))]));
        }
    }
    map
}

/// True mask of the body at pixel centres, 0 or 255.
pub fn mask(scene: &Scene, view: &View, pose: &Pose) -> GrayImage {
    silhouette(&scene.surface, &scene.offsets, &place(&scene.offsets, pose), &view.camera)
}

/// Mask of any posed surface before any camera, 0 or 255.
pub fn silhouette(surface: &Surface, offsets: &[Vector3<f64>; NODES], placement: &Placement, camera: &Camera) -> GrayImage {
    let figure = Figure::new(surface, offsets, placement);
    let mut mask = GrayImage::new(camera.size_px[0], camera.size_px[1]);
    let mut eye = figure.seen_from(&camera.centre());
    for (x, y) in pixels(&figure, camera) {
        if hit(camera, &mut eye, x, y).is_some() {
            mask.put_pixel(x, y, Luma([255]));
        }
    }
    mask
}

fn hit(camera: &Camera, eye: &mut Eye, x: u32, y: u32) -> Option<(Vector3<f64>, f64)> {
    let direction = camera.ray(&Point2::new(x as f64, y as f64))?;
    Some((direction, eye.first_hit(&direction)?))
}

/// Pixels that the figure can cover: the union of boxes around its primitives.
fn pixels(figure: &Figure, camera: &Camera) -> Vec<(u32, u32)> {
    let [width, height] = camera.size_px;
    let mut covered = vec![false; (width * height) as usize];
    for (centre, radius) in figure.bounds() {
        if let Some([columns, rows]) = pixel_box(camera, &centre, radius) {
            for y in rows {
                covered[(y * width + columns.start) as usize..(y * width + columns.end) as usize].fill(true);
            }
        }
    }
    (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).filter(|(x, y)| covered[(y * width + x) as usize]).collect()
}

/// Columns and rows that hold the picture of a sphere; `None` behind the camera.
pub(super) fn pixel_box(camera: &Camera, centre: &Vector3<f64>, radius: f64) -> Option<[std::ops::Range<u32>; 2]> {
    let [width, height] = camera.size_px;
    let c = camera.camera_point(centre);
    if c.z < -radius {
        return None;
    }
    if c.z < 2.0 * radius {
        return Some([0..width, 0..height]); // too near for a box of corners to bound it
    }
    let (mut low, mut high) = (Point2::new(f64::INFINITY, f64::INFINITY), Point2::new(f64::NEG_INFINITY, f64::NEG_INFINITY));
    for corner in 0..8 {
        let side = |bit: usize| if corner >> bit & 1 == 1 { radius } else { -radius };
        let p = c + Vector3::new(side(0), side(1), side(2));
        let pixel = camera.distorted_pixel(&(p.xy() / p.z));
        (low, high) = (low.inf(&pixel), high.sup(&pixel));
    }
    let range = |low: f64, high: f64, size: u32| {
        let clip = |v: f64| v.clamp(0.0, size as f64) as u32;
        clip(low - 1.0)..clip(high + 2.0)
    };
    Some([range(low.x, high.x, width), range(low.y, high.y, height)])
}

/// The room's grey values under the figure's shadow.
fn shadowed_room(stage: &Stage, view: &View, figure: &Figure) -> Vec<f32> {
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    for (centre, radius) in figure.bounds() {
        low = low.inf(&(centre - Vector3::repeat(radius)));
        high = high.sup(&(centre + Vector3::repeat(radius)));
    }
    let (middle, radius) = ((low + high) / 2.0, (high - low).norm() / 2.0);
    let mut scratch = Shadow::default();
    let mut shade = |p: &RoomPixel| {
        let Some(point) = p.seen.as_ref().filter(|_| p.direct > 0.0).map(|s| s.point) else { return p.grey };
        let to = middle - point;
        let aside = to - stage.to_light * to.dot(&stage.to_light);
        if aside.norm_squared() > radius * radius {
            return p.grey;
        }
        p.grey * (1.0 - p.direct * figure.shadow(&point, &stage.to_light, &mut scratch) as f32)
    };
    view.room.iter().map(&mut shade).collect()
}

fn body_pixel(stage: &Stage, eye: &mut Eye, rays: &[Vector3<f32>; 4], room: f32) -> f32 {
    let see = |ray: &Vector3<f32>| match eye.look(&ray.cast()) {
        Some(skin) => (255.0 * skin.albedo * (AMBIENT + stage.direct(&skin.normal))) as f32,
        None => room,
    };
    rays.iter().map(see).sum::<f32>() / 4.0
}

/// Adds sensor noise and rounds.
fn expose(scene: &Scene, view: &View, grey: &[f32], frame: u64) -> GrayImage {
    let mut rng = ChaCha8Rng::seed_from_u64(scene.seed);
    rng.set_stream(frame << 16 | view.index as u64);
    let mut bytes = Vec::with_capacity(grey.len() + 1);
    for pair in grey.chunks(2) {
        let noise = gaussian_pair(&mut rng);
        bytes.extend(pair.iter().zip(noise).map(|(g, n)| (*g as f64 + scene.noise_grey * n).round().clamp(0.0, 255.0) as u8));
    }
    let [width, height] = view.camera.size_px;
    GrayImage::from_raw(width, height, bytes).unwrap_or_default()
}

/// Two independent standard normal numbers (Box and Muller).
pub(super) fn gaussian_pair(rng: &mut ChaCha8Rng) -> [f64; 2] {
    let unit = |n: u32| (n as f64 + 0.5) / 4_294_967_296.0;
    let radius = (-2.0 * unit(rng.next_u32()).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * unit(rng.next_u32())).sin_cos();
    [radius * cos, radius * sin]
}

#[cfg(test)]
pub(crate) mod tests {
    use nalgebra::{Matrix3, Rotation3};

    use super::*;
    use crate::body::{Joint, Shape};
    use crate::math::rotation::exp;
    use crate::phantom::figure::Skin;
    use crate::rig::{Rig, Up};

    /// Three distorted cameras 1 m above the floor that look along y, an L of 0.3 m.
    pub(crate) fn lab_rig(size_px: [u32; 2]) -> Rig {
        let cameras = [(0.0, 1.0, 0.0), (0.3, 1.0, 0.01), (0.0, 1.3, -0.015)].map(|(x, z, turn): (f64, f64, f64)| {
            let focal = 0.86 * size_px[0] as f64;
            // Rows: x right, y down = −z, z forward = y of the world.
            let level = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0));
            let camera_from_world = Rotation3::from_euler_angles(0.03 + turn, turn, 0.2 * turn) * level;
            Camera {
                name: format!("{x} {z}"),
                size_px,
                matrix: Matrix3::new(focal, 0.0, 0.5 * size_px[0] as f64 - 0.5, 0.0, focal, 0.5 * size_px[1] as f64 - 0.5, 0.0, 0.0, 1.0),
                lens: crate::rig::Lens::BrownConrady([-0.08, 0.01, 2e-4, -3e-4, 0.0, 0.0, 0.0, 0.0]),
                camera_from_world,
                translation: -(camera_from_world * Vector3::new(x, 0.0, z)),
            }
        });
        Rig { cameras: cameras.to_vec(), up: Up::Z }
    }

    /// A striding pose 3 m before the rig, turned by `heading` about up.
    pub(crate) fn stride(shape: &Shape, heading: f64) -> Pose {
        let mut pose = Pose::rest(Vector3::new(0.1, 3.0, shape.offsets()[0].y));
        pose.world_from_root = exp(&Vector3::new(0.0, 0.0, heading)) * exp(&Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0));
        for (joint, angle) in [
            (Joint::LHip, -0.5),
            (Joint::LKnee, 0.2),
            (Joint::RHip, 0.3),
            (Joint::RKnee, 0.4),
            (Joint::LShoulder, 0.5),
            (Joint::RShoulder, -0.5),
            (Joint::RElbow, -0.4),
        ] {
            pose.joints[joint as usize - 1] = exp(&Vector3::new(angle, 0.0, 0.0));
        }
        pose
    }

    fn scene(rig: &Rig) -> Scene {
        Scene::new(Stage::around(rig, &[Vector3::new(-1.0, 3.0, 0.9), Vector3::new(1.0, 3.0, 0.9)]), &Shape::template(1.72))
    }

    #[test]
    fn ball_and_floor_have_the_depth_of_their_closed_forms() {
        let rig = lab_rig([160, 120]);
        let mut scene = scene(&rig);
        scene.surface = Surface::ball(Joint::Root, 0.35);
        let pose = stride(&Shape::template(1.72), 1.0);
        let camera = &rig.cameras[1];
        let map = depth(&scene, &View::new(&scene.stage, camera, 1), &pose);
        let on_stage = |x: &Vector3<f64>| x.y < scene.stage.max.y && x.x > scene.stage.min.x && x.x < scene.stage.max.x;
        let (origin, mut on_ball, mut on_floor) = (camera.centre(), 0, 0);
        for (x, y, value) in map.enumerate_pixels() {
            let ray = camera.ray(&Point2::new(x as f64, y as f64)).unwrap();
            let to = pose.root - origin;
            let discriminant = to.dot(&ray).powi(2) - to.norm_squared() + 0.35 * 0.35;
            let floor = -origin.z / ray.z;
            let t = if discriminant > 0.0 {
                on_ball += 1;
                to.dot(&ray) - discriminant.sqrt()
            } else if ray.z < 0.0 && on_stage(&(origin + ray * floor)) {
                on_floor += 1;
                floor
            } else {
                continue;
            };
            let expected = camera.camera_point(&(origin + ray * t)).z;
            // At the rim a ray meets the ball at a grazing angle, where 1e-5 of the field is more along the ray.
            let tolerance = if discriminant > 0.0 && discriminant < 1e-3 { 2e-3 } else { 5e-5 };
            assert!((value[0] as f64 - expected).abs() < tolerance, "{x} {y}: {} vs {expected}", value[0]);
        }
        assert!(on_ball > 300 && on_floor > 2000, "{on_ball} {on_floor}");
    }

    #[test]
    fn joints_project_into_the_mask_and_pixels_off_it_show_the_room() {
        let rig = lab_rig([320, 240]);
        let scene = scene(&rig);
        let pose = stride(&Shape::template(1.72), 0.4);
        for (index, camera) in rig.cameras.iter().enumerate() {
            let view = View::new(&scene.stage, camera, index);
            let mask = mask(&scene, &view, &pose);
            for position in place(&scene.offsets, &pose).positions {
                let pixel = camera.project(&position).unwrap();
                assert_eq!(mask.get_pixel(pixel.x.round() as u32, pixel.y.round() as u32)[0], 255);
            }
            let covered = mask.pixels().filter(|p| p[0] > 0).count();
            assert!((2000..8000).contains(&covered), "{covered}");
            let (with, without) = (depth(&scene, &view, &pose), depth(&scene, &view, &far_away(&pose)));
            for ((m, a), b) in mask.pixels().zip(with.pixels()).zip(without.pixels()) {
                assert_eq!(m[0] > 0, a[0] < b[0]);
            }
        }
    }

    fn far_away(pose: &Pose) -> Pose {
        Pose { root: Vector3::new(0.0, -1e3, 1.0), ..pose.clone() }
    }

    #[test]
    fn pictures_differ_from_the_clean_one_by_noise_of_two_grey_levels_that_never_repeats() {
        let rig = lab_rig([160, 120]);
        let mut scene = scene(&rig);
        let pose = stride(&Shape::template(1.72), 0.4);
        let views: Vec<View> = rig.cameras.iter().enumerate().map(|(i, c)| View::new(&scene.stage, c, i)).collect();
        let noisy = [render(&scene, &views[0], &pose, 0), render(&scene, &views[0], &pose, 1)];
        assert_eq!(noisy[0], render(&scene, &views[0], &pose, 0));
        let same_camera_elsewhere = View { camera: views[0].camera.clone(), index: 1, room: views[0].room.clone() };
        let other = render(&scene, &same_camera_elsewhere, &pose, 0);
        scene.noise_grey = 0.0;
        let clean = render(&scene, &views[0], &pose, 0);
        let residual = |image: &GrayImage| -> Vec<f64> { image.iter().zip(clean.iter()).map(|(a, b)| *a as f64 - *b as f64).collect() };
        let deviation = |r: &[f64]| (r.iter().map(|v| v * v).sum::<f64>() / r.len() as f64).sqrt();
        let [a, b, c] = [residual(&noisy[0]), residual(&noisy[1]), residual(&other)];
        // Rounding of either image adds 1/12 each; the difference of two rounded images carries both.
        let expected = (4.0f64 + 2.0 / 12.0).sqrt();
        for r in [&a, &b, &c] {
            assert!((deviation(r) - expected).abs() < 0.06 && (r.iter().sum::<f64>() / r.len() as f64).abs() < 0.08, "{}", deviation(r));
        }
        for (r, s) in [(&a, &b), (&a, &c)] {
            let correlation = r.iter().zip(s).map(|(x, y)| x * y).sum::<f64>() / (r.len() as f64 * 4.0);
            assert!(correlation.abs() < 0.05, "{correlation}");
        }
    }

    #[test]
    fn pictures_are_the_same_with_one_and_four_threads() {
        let rig = lab_rig([160, 120]);
        let scene = scene(&rig);
        let pose = stride(&Shape::template(1.72), 0.4);
        let shoot = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let view = View::new(&scene.stage, &rig.cameras[0], 0);
                (0..4).into_par_iter().map(|frame| render(&scene, &view, &pose, frame)).collect::<Vec<_>>()
            })
        };
        assert_eq!(shoot(1), shoot(4));
    }

    #[test]
    fn two_cameras_see_the_same_texture_at_the_same_point() {
        let rig = lab_rig([320, 240]);
        let scene = scene(&rig);
        let pose = stride(&Shape::template(1.72), 0.4);
        let figure = scene.figure(&pose);
        let centres = [rig.cameras[0].centre(), rig.cameras[1].centre()];
        let mut eyes = centres.map(|c| figure.seen_from(&c));
        let (mut seen_by_both, mut range) = (0, (1.0f64, 0.0f64));
        for (x, y) in (0..320).step_by(3).flat_map(|x| (0..240).step_by(3).map(move |y| (x, y))) {
            let ray = rig.cameras[0].ray(&Point2::new(x as f64, y as f64)).unwrap();
            let Some(skin) = eyes[0].look(&ray) else { continue };
            let other: Option<Skin> = eyes[1].look(&(skin.position - centres[1]).normalize());
            let Some(again) = other.filter(|o| (o.position - skin.position).norm() < 2e-4 && o.normal.dot(&ray) < -0.3) else { continue };
            assert!((again.albedo - skin.albedo).abs() < 0.01, "{} {}", again.albedo, skin.albedo);
            seen_by_both += 1;
            range = (range.0.min(skin.albedo), range.1.max(skin.albedo));
        }
        assert!(seen_by_both > 250 && range.1 - range.0 > 0.4, "{seen_by_both} {range:?}");
    }

    #[test]
    fn the_shadow_darkens_the_floor_beside_the_feet_and_nothing_else() {
        let rig = lab_rig([160, 120]);
        let mut scene = scene(&rig);
        scene.noise_grey = 0.0;
        let pose = stride(&Shape::template(1.72), 0.4);
        let view = View::new(&scene.stage, &rig.cameras[0], 0);
        let (with, without) = (render(&scene, &view, &pose, 0), render_stage(&scene, &view));
        let body = mask(&scene, &view, &pose);
        // The light comes from the left and from behind the cameras: the shadow falls to the right and away.
        let feet = place(&scene.offsets, &pose).position(Joint::RAnkle);
        let away = scene.stage.to_light - Vector3::z() * scene.stage.to_light.z;
        let in_shadow = rig.cameras[0].project(&(feet.component_mul(&Vector3::new(1.0, 1.0, 0.0)) - away * 0.3)).unwrap();
        let at = (in_shadow.x.round() as u32, in_shadow.y.round() as u32);
        let (dark, bright) = (with.get_pixel(at.0, at.1)[0] as f64, without.get_pixel(at.0, at.1)[0] as f64);
        assert!(body.get_pixel(at.0, at.1)[0] == 0 && dark < 0.8 * bright, "{dark} {bright} at {at:?}");
        let left_half = (0..60).flat_map(|x| (0..120).map(move |y| (x, y)));
        assert!(left_half.filter(|(x, y)| body.get_pixel(*x, *y)[0] == 0).all(|(x, y)| with.get_pixel(x, y) == without.get_pixel(x, y)));
    }
}

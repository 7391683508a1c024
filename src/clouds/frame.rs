//! One frame: the pictures in, the person's point cloud and silhouettes out.

use super::cloud::Cloud;
use super::correlate::Region;
use super::stage::{Change, Shade, Stage, StageOptions, changed_box, compare, person_mask, whole};
use super::stereo::{StereoOptions, StereoView, ViewDisparity, match_views};
use super::subpixel::{self, Other, Refined};
use super::{edges, tidy, triangulate};
use crate::rig::Rig;
use crate::rig::rectify::{Plane, Rectification, RectifiedView, RectifyError, groups};
use image::{GrayImage, Luma};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Room around what changed, px: the reach of the correlation windows and of the outline's blur.
const MARGIN_PX: usize = 12;

/// Pictures that vary less show nothing but noise, grey levels (standard deviation).
const LEAST_CONTRAST: f64 = 4.0;

/// How clouds are made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CloudOptions {
    /// Nothing nearer is looked for, metres from the cameras.
    pub nearest_m: f64,
    /// Nothing farther is kept, metres.
    pub farthest_m: f64,
    /// Keep one point per cube of this side, metres; all points without it.
    pub voxel_m: Option<f64>,
    pub stereo: StereoOptions,
    pub stage: StageOptions,
}

impl Default for CloudOptions {
    fn default() -> Self {
        Self { nearest_m: 1.2, farthest_m: 12.0, voxel_m: None, stereo: StereoOptions::default(), stage: StageOptions::default() }
    }
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum CloudError {
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    #[error("the rig has camera number {camera} but only {given} pictures were given; give one per camera")]
    Images { camera: usize, given: usize },
    #[error("a picture of {camera} is {found:?} pixels, the calibration says {expected:?}; use pictures of the calibrated size")]
    Size { camera: String, found: [u32; 2], expected: [u32; 2] },
    #[error(
        "the picture of {camera} shows nothing, its grey values vary by {contrast:.1} only; uncover the lens, or leave this camera out of the rig"
    )]
    Blank { camera: String, contrast: f64 },
    #[error("depths from {0} m to {1} m cannot be searched; the nearest must be positive and below the farthest")]
    Depths(f64, f64),
    #[error("the stage was made for {0} views, the rig group has {1}; make it again with this rectification")]
    Stage(usize, usize),
}

/// What one frame gives.
#[derive(Clone, Debug)]
pub struct FrameCloud {
    /// The person's points in the rig's world; empty when nobody is in view.
    pub cloud: Cloud,
    /// The person in each rig camera's raw picture, 0/255; `None` for cameras outside the group, and for all without a stage.
    pub masks: Vec<Option<GrayImage>>,
    /// The person's disparities in the reference view, px; NaN elsewhere.
    pub disparity: Plane,
    /// All validated disparities of the searched part of the reference view, px, the person's or not; NaN elsewhere.
    pub matched: Plane,
    /// Pixels of the reference view that changed against the stage, 0/255; all without a stage.
    pub changed: GrayImage,
}

impl FrameCloud {
    /// Nothing, seen by so many cameras.
    pub fn unseen(cameras: usize) -> FrameCloud {
        let (cloud, masks) = (Cloud { points: Vec::new() }, vec![None; cameras]);
        FrameCloud { cloud, masks, disparity: Plane::new(0, 0), matched: Plane::new(0, 0), changed: GrayImage::new(0, 0) }
    }
}

/// A rig made ready for footage: its rectified groups, and the empty stage as each of them sees it.
#[derive(Clone, Debug)]
pub struct CloudRig {
    pub groups: Vec<(Rectification, Option<Stage>)>,
}

impl CloudRig {
    /// Height of the floor along `up`, metres: the lowest strong level among the points of the empty stage. `None` without
    /// a stage, or where no level gathers [`FLOOR_SHARE`] of its points.
    pub fn floor_m(&self, up: &Vector3<f64>) -> Option<f64> {
        let (rectification, stage) = self.groups.first()?;
        let matched = &stage.as_ref()?.views.first()?.matched;
        let height = |u: u32, v: u32| {
            let d = f64::from(matched.get_pixel(u, v).0[0]);
            (d > 0.0).then(|| {
                let (u, v) = (u.into(), v.into());
                let per_px = rectification.world_jacobian(u, v, d).column(2).dot(up);
                (rectification.world_from_pixel(u, v, d).dot(up), 1.0 / (per_px * per_px).max(1e-9))
            })
        };
        let of_row = |v: u32| (0..matched.width().div_ceil(2)).filter_map(move |half| height(2 * half, 2 * v));
        lowest_level((0..matched.height().div_ceil(2)).into_par_iter().flat_map_iter(of_row).collect())
    }

    /// `stage_images` has one picture of the empty stage per camera of the rig.
    pub fn new(rig: &Rig, stage_images: Option<&[GrayImage]>, options: &CloudOptions) -> Result<Self, CloudError> {
        let with_stage = |group: Rectification| {
            let stage = stage_images.map(|images| Stage::new(&group, images, options)).transpose()?;
            Ok((group, stage))
        };
        Ok(Self { groups: groups(rig)?.into_iter().map(with_stage).collect::<Result<_, CloudError>>()? })
    }

    /// The clouds of all groups together; masks and disparities are those of the first group that has them.
    pub fn frame(&self, images: &[GrayImage], options: &CloudOptions) -> Result<FrameCloud, CloudError> {
        let one = |(group, stage): &(Rectification, Option<Stage>)| frame_cloud(group, images, stage.as_ref(), options);
        let mut frames = self.groups.iter().map(one).collect::<Result<Vec<_>, _>>()?.into_iter();
        let mut all = frames.next().ok_or(RectifyError::Count(images.len()))?;
        for frame in frames {
            all.cloud.points.extend(frame.cloud.points);
            for (mine, other) in all.masks.iter_mut().zip(frame.masks) {
                *mine = mine.take().or(other);
            }
        }
        Ok(all)
    }
}

/// Half the thickness of a level, metres.
const LEVEL_M: f64 = 0.02;
/// Part of all points that a level must gather; furniture and walls spread over heights.
const FLOOR_SHARE: f64 = 0.02;

/// Level of the lowest slab of ±[`LEVEL_M`] that holds [`FLOOR_SHARE`] of the heights and more than the slab just above:
/// the median there by the second numbers, the heights' precisions, so that the near floor decides.
fn lowest_level(mut heights: Vec<(f64, f64)>) -> Option<f64> {
    heights.par_sort_by(|a, b| a.0.total_cmp(&b.0));
    let within = |centre: f64| {
        let from = heights.partition_point(|h| h.0 < centre - LEVEL_M);
        let to = heights.partition_point(|h| h.0 <= centre + LEVEL_M);
        &heights[from..to]
    };
    let enough = FLOOR_SHARE * heights.len() as f64;
    let mut centre = heights.first()?.0;
    while centre < heights.last()?.0 {
        if within(centre).len() as f64 >= enough && within(centre + LEVEL_M / 2.0).len() <= within(centre).len() {
            let level = within(centre);
            let half = 0.5 * level.iter().map(|h| h.1).sum::<f64>();
            let mut sum = 0.0;
            let middle = level.iter().find(|h| {
                sum += h.1;
                sum >= half
            });
            return middle.map(|h| h.0);
        }
        centre += LEVEL_M / 4.0;
    }
    None
}

impl Stage {
    /// The empty stage from one picture per camera of the rig.
    pub fn new(rectification: &Rectification, images: &[GrayImage], options: &CloudOptions) -> Result<Self, CloudError> {
        let images = pick(rectification, images)?;
        Ok(Self::measure(rectification, &images, range(rectification, options)?[1], &options.stereo))
    }
}

/// The person's cloud and silhouettes in one frame. `images` has one picture per camera of the rig. Without a stage every
/// match between the nearest and farthest depth is kept and there are no masks.
pub fn frame_cloud(
    rectification: &Rectification,
    images: &[GrayImage],
    stage: Option<&Stage>,
    options: &CloudOptions,
) -> Result<FrameCloud, CloudError> {
    let pictures = pick(rectification, images)?;
    let range = range(rectification, options)?;
    let planes: Vec<Plane> = pictures.iter().enumerate().map(|(k, picture)| rectification.warp(k, picture)).collect();
    match stage {
        None => everything(rectification, images.len(), planes, range, options),
        Some(stage) if stage.views.len() == planes.len() => Ok(person(rectification, images.len(), planes, stage, range, options)),
        Some(stage) => Err(CloudError::Stage(stage.views.len(), planes.len())),
    }
}

fn everything(
    rectification: &Rectification,
    cameras: usize,
    planes: Vec<Plane>,
    range: [usize; 2],
    options: &CloudOptions,
) -> Result<FrameCloud, CloudError> {
    let regions = vec![whole(rectification); planes.len()];
    let found = search(rectification, planes, &regions, range, options);
    let refined = refine(&found, regions[0], None);
    let cloud = points(rectification, &found[0].0, &refined, regions[0], options);
    let [width, height] = rectification.size_px;
    let changed = GrayImage::from_pixel(width, height, Luma([255]));
    let disparity = refined.disparity;
    Ok(FrameCloud { cloud, masks: vec![None; cameras], matched: disparity.clone(), disparity, changed })
}

fn person(
    rectification: &Rectification,
    cameras: usize,
    planes: Vec<Plane>,
    stage: &Stage,
    range: [usize; 2],
    options: &CloudOptions,
) -> FrameCloud {
    let mut changes: Vec<Change> = planes.iter().zip(&stage.views).map(|(now, stage)| compare(now, stage, &options.stage)).collect();
    let regions: Option<Vec<Region>> = changes.iter().map(|c| changed_box(&c.changed, &options.stage, MARGIN_PX)).collect();
    let Some(regions) = regions else { return nobody(rectification, cameras) };
    let shade = |k: usize| Shade::new(&planes[k], &stage.views[k], &changes[k], regions[k], &options.stage);
    let shades: Vec<Shade> = (0..planes.len()).map(shade).collect();
    let found = search(rectification, planes, &regions, range, options);
    let outline = |k: usize| person_mask(rectification, k, (&changes, &shades), &stage.views[k], &found[k].1, &options.stage);
    let persons: Vec<GrayImage> = (0..found.len()).map(outline).collect();
    let refined = refine(&found, regions[0], Some(&persons[0]));
    let mut masks = vec![None; cameras];
    for (k, view) in rectification.views.iter().enumerate() {
        masks[view.index] = Some(rectification.unwarp(k, &persons[k], regions[k].corner()));
    }
    let cloud = points(rectification, &found[0].0, &refined, regions[0], options);
    let [width, height] = rectification.size_px;
    let mut disparity = Plane::from_pixel(width, height, Luma([f32::NAN]));
    let mut matched = found[0].1.disparity.clone();
    let (all, known): (&mut [f32], &mut [f32]) = (&mut matched, &mut disparity);
    for (k, i) in regions[0].rows(width as usize).flatten().enumerate().filter(|(k, _)| persons[0].as_raw()[*k] != 0) {
        known[i] = refined.disparity.as_raw()[k];
        all[i] = known[i];
    }
    let changed = changes.swap_remove(0).changed;
    FrameCloud { cloud, masks, disparity, matched, changed }
}

fn pick<'a>(rectification: &Rectification, images: &'a [GrayImage]) -> Result<Vec<&'a GrayImage>, CloudError> {
    let picture = |view: &RectifiedView| {
        let image = images.get(view.index).ok_or(CloudError::Images { camera: view.index, given: images.len() })?;
        let (found, expected) = ([image.width(), image.height()], view.camera.size_px);
        let (camera, contrast) = (view.camera.name.clone(), contrast(image));
        match (found == expected, contrast >= LEAST_CONTRAST) {
            (false, _) => Err(CloudError::Size { camera, found, expected }),
            (true, false) => Err(CloudError::Blank { camera, contrast }),
            (true, true) => Ok(image),
        }
    };
    rectification.views.iter().map(picture).collect()
}

/// Standard deviation of the grey values.
fn contrast(image: &GrayImage) -> f64 {
    let (sum, squares) = image.iter().fold((0u64, 0u64), |(sum, squares), &v| (sum + u64::from(v), squares + u64::from(v) * u64::from(v)));
    let n = image.len().max(1) as f64;
    (squares as f64 / n - (sum as f64 / n).powi(2)).max(0.0).sqrt()
}

/// Whole disparities between the farthest and the nearest depth.
fn range(rectification: &Rectification, options: &CloudOptions) -> Result<[usize; 2], CloudError> {
    let (near, far) = (options.nearest_m, options.farthest_m);
    if !(near > 0.0 && near < far && far.is_finite()) {
        return Err(CloudError::Depths(near, far));
    }
    let widest = f64::from(rectification.size_px[0].max(rectification.size_px[1]));
    Ok([rectification.disparity(far).floor(), rectification.disparity(near).ceil()].map(|d| d.min(widest) as usize))
}

fn search(
    rectification: &Rectification,
    planes: Vec<Plane>,
    regions: &[Region],
    range: [usize; 2],
    options: &CloudOptions,
) -> Vec<(StereoView, ViewDisparity)> {
    let prepared: Vec<StereoView> =
        planes.into_iter().zip(&rectification.views).map(|(p, v)| StereoView { plane: p, step: v.step }).collect();
    let found = match_views(&prepared, regions, range, &options.stereo);
    prepared.into_iter().zip(found).collect()
}

fn nobody(rectification: &Rectification, cameras: usize) -> FrameCloud {
    let mut masks = vec![None; cameras];
    for view in &rectification.views {
        let [width, height] = view.camera.size_px;
        masks[view.index] = Some(GrayImage::new(width, height));
    }
    let [width, height] = rectification.size_px;
    let nothing = Plane::from_pixel(width, height, Luma([f32::NAN]));
    FrameCloud { cloud: Cloud::default(), masks, disparity: nothing.clone(), matched: nothing, changed: GrayImage::new(width, height) }
}

/// The reference view's disparities in a region, inside the mask, refined on the grey values of all views.
fn refine(found: &[(StereoView, ViewDisparity)], region: Region, mask: Option<&GrayImage>) -> Refined {
    let (reference, matched) = &found[0];
    let width = reference.plane.width() as usize;
    let part = |plane: &Plane| {
        let values = region.cut(plane, width);
        Plane::from_raw(region.width() as u32, region.height() as u32, values).expect("one value per pixel")
    };
    let (mut disparity, grey) = (part(&matched.disparity), part(&reference.plane));
    for (d, m) in disparity.iter_mut().zip(mask.into_iter().flat_map(|mask| mask.iter())) {
        *d = if *m == 0 { f32::NAN } else { *d };
    }
    let confirmed = region.cut(&matched.confirmed, width);
    confirmed_by_all(found, region, &mut disparity, &confirmed);
    let others: Vec<Other> =
        found[1..].iter().map(|(view, _)| Other::new(&view.plane, view.step - reference.step, region.corner())).collect();
    let disparity = edges::behind(&grey, &others, &disparity);
    subpixel::refine(&grey, &others, &disparity, &confirmed)
}

/// Disparities of two views' own matches that differ by more are of different surfaces, px.
const AGREEMENT_PX: f32 = 1.0;

/// Keeps the disparities of the reference that every view confirms which has the place in its picture. A view that finds
/// something else there mostly contradicts a fattened edge; the places that it cannot see for an occluder are under 1 %.
///
/// Three views can afford more: each of the others must have matched that place itself, and alike. This costs a twentieth of the
/// body and removes 11 to 45 % of the errors above 1 px; two views, which see less, would lose as much again.
fn confirmed_by_all(found: &[(StereoView, ViewDisparity)], region: Region, disparity: &mut Plane, confirmed: &[u8]) {
    let [left, top] = region.corner().map(|c| c as f64);
    for (k, (view, own)) in found[1..].iter().enumerate() {
        let step = view.step - found[0].0.step;
        let stands = |u: u32, v: u32, d: f32, confirmed: u8| {
            let at = [left + f64::from(u) + step.x * f64::from(d), top + f64::from(v) + step.y * f64::from(d)];
            let [x, y] = at.map(f64::round);
            let inside = x >= 0.0 && y >= 0.0 && x < f64::from(view.plane.width()) && y < f64::from(view.plane.height());
            if !inside || view.plane.get_pixel(x as u32, y as u32).0[0].is_nan() {
                return true;
            }
            let alike = (own.disparity.get_pixel(x as u32, y as u32).0[0] - d).abs() <= AGREEMENT_PX;
            confirmed >> k & 1 != 0 && (alike || found.len() == 2)
        };
        for ((u, v, d), confirmed) in disparity.enumerate_pixels_mut().zip(confirmed) {
            if !d.0[0].is_nan() && !stands(u, v, d.0[0], *confirmed) {
                d.0[0] = f32::NAN;
            }
        }
    }
}

fn points(rectification: &Rectification, reference: &StereoView, refined: &Refined, region: Region, options: &CloudOptions) -> Cloud {
    let cloud = triangulate::triangulate(rectification, refined, region.corner(), &reference.plane);
    let cloud = tidy::remove_outliers(cloud, neighbours(&refined.disparity));
    match options.voxel_m {
        Some(side) => tidy::thin(cloud, side),
        None => cloud,
    }
}

/// For a point of a triangulated picture those of the pixels around it, where all have one.
fn neighbours(disparity: &Plane) -> impl Fn(usize) -> Option<[usize; tidy::NEIGHBOURS]> {
    /// The nearest twelve, x and y.
    const AROUND: [[isize; 2]; tidy::NEIGHBOURS] =
        [[0, -2], [-1, -1], [0, -1], [1, -1], [-2, 0], [-1, 0], [1, 0], [2, 0], [-1, 1], [0, 1], [1, 1], [0, 2]];
    let width = disparity.width() as usize;
    let pixels: Vec<usize> = triangulate::known(disparity).map(|(u, v, _)| v as usize * width + u as usize).collect();
    let mut points = vec![None; disparity.as_raw().len()];
    pixels.iter().enumerate().for_each(|(point, pixel)| points[*pixel] = Some(point));
    move |point| {
        let mut found = [0; tidy::NEIGHBOURS];
        for (found, [x, y]) in found.iter_mut().zip(AROUND) {
            // At the border a row's end meets the next one's beginning: far points, which prove nothing.
            *found = (*points.get(pixels[point].checked_add_signed(x + y * width as isize)?)?)?;
        }
        Some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lowest_level_is_the_floor_under_a_table_and_between_walls() {
        let noise = |i: usize| 0.008 * ((i * 7919 % 101) as f64 / 50.0 - 1.0);
        let wall = (0..3000).map(|i| (-0.3 + i as f64 * 1e-3, 1.0));
        let near = (0..300).map(|i| (0.12 + 0.1 * noise(i), 100.0));
        let far = (0..500).map(|i| (0.11 + noise(i), 1.0));
        let table = (0..900).map(|i| (0.7 + noise(i), 1.0));
        let level = lowest_level(wall.clone().chain(near).chain(far).chain(table).collect()).unwrap();
        assert!((level - 0.12).abs() < 0.002, "{level}");
        assert_eq!(lowest_level(wall.collect()), None);
        assert_eq!(lowest_level(Vec::new()), None);
    }
    use std::path::{Path, PathBuf};

    fn footage(name: &str) -> Option<PathBuf> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/footage").join(name);
        if !folder.exists() {
            println!("skipped: {} is not there", folder.display());
        }
        folder.exists().then_some(folder)
    }

    fn grey(path: PathBuf) -> GrayImage {
        image::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).into_luma8()
    }

    fn pictures(folder: &Path, frame: usize) -> Vec<GrayImage> {
        (0..3).map(|k| grey(folder.join(format!("cam_0{k}/{frame:06}.jpg")))).collect()
    }

    /// A rig of the session with its empty stage; OpenCV parses nothing here, the numbers come from the session's own file.
    fn ready(folder: &Path, options: &CloudOptions) -> (Rig, CloudRig) {
        let text = std::fs::read_to_string(folder.join("Calib.toml")).unwrap();
        let table: toml::Table = text.parse().unwrap();
        let numbers = |v: &toml::Value| -> Vec<f64> { v.as_array().unwrap().iter().map(|x| x.as_float().unwrap()).collect() };
        let camera = |k: usize| {
            let t = table[&format!("cam_0{k}")].as_table().unwrap();
            let rows: Vec<f64> = t["matrix"].as_array().unwrap().iter().flat_map(numbers).collect();
            let d = numbers(&t["distortions"]);
            crate::rig::Camera {
                name: format!("cam_0{k}"),
                size_px: [640, 480],
                matrix: nalgebra::Matrix3::from_row_slice(&rows),
                lens: crate::rig::Lens::brown_conrady(&d).unwrap(),
                camera_from_world: nalgebra::Rotation3::new(nalgebra::Vector3::from_column_slice(&numbers(&t["rotation"]))),
                translation: nalgebra::Vector3::from_column_slice(&numbers(&t["translation"])),
            }
        };
        let rig = Rig { cameras: (0..3).map(camera).collect(), up: crate::rig::Up::Z };
        let stage: Vec<GrayImage> = (0..3).map(|k| grey(folder.join(format!("cam_0{k}_background.png")))).collect();
        let ready = CloudRig::new(&rig, Some(&stage), options).unwrap();
        (rig, ready)
    }

    fn median(mut values: Vec<f64>) -> f64 {
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// Median depth error on the body (m), share of points off the body, share of body pixels near a point, intersection over union.
    fn score(rig: &Rig, frame: &FrameCloud, folder: &Path, number: usize) -> [f64; 4] {
        let truth = grey(folder.join(format!("truth/mask_cam_00/{number:06}.png")));
        let depth = image::open(folder.join(format!("truth/depth_cam_00/{number:06}.png"))).unwrap().into_luma16();
        let (wide, tight) = (crate::footage::regions::box_vote(&truth, 2, 0.0), crate::footage::regions::box_vote(&truth, 2, 0.999));
        let mut covered = GrayImage::new(640, 480);
        let (mut errors, mut off) = (Vec::new(), 0.0);
        for point in &frame.cloud.points {
            let pixel = rig.cameras[0].project(&point.position).unwrap();
            let (x, y) = (pixel.x.round() as u32, pixel.y.round() as u32);
            off += f64::from(u8::from(wide.get_pixel(x, y).0[0] == 0));
            covered.put_pixel(x, y, Luma([255]));
            if tight.get_pixel(x, y).0[0] != 0 {
                let z = f64::from(depth.get_pixel(x, y).0[0]) * 1e-4;
                errors.push((rig.cameras[0].camera_point(&point.position).z - z).abs());
            }
        }
        let covered = crate::footage::regions::box_vote(&covered, 1, 0.0);
        let count = |f: &dyn Fn(bool, bool, bool) -> bool| {
            let mask = frame.masks[0].as_ref().unwrap();
            let all = truth.iter().zip(mask.iter()).zip(covered.iter());
            all.filter(|((t, m), c)| f(**t != 0, **m != 0, **c != 0)).count() as f64
        };
        let overlap = count(&|t, m, _| t && m) / count(&|t, m, _| t || m);
        let density = count(&|t, _, c| t && c) / count(&|t, _, _| t);
        [median(errors), off / frame.cloud.points.len() as f64, density, overlap]
    }

    #[test]
    fn clouds_and_masks_meet_the_rendered_truth() {
        // Depth limits are OpenCV SGBM's medians on the same sessions.
        for (name, depth_m, overlap) in [
            ("p02_run_lab", 0.0120, 0.85),
            ("p12_walk_lab", 0.0088, 0.88),
            ("p35_walk_lab_slow", 0.0108, 0.85),
            ("p39_walk_digiclops", 0.0255, 0.9),
        ] {
            let Some(folder) = footage(name) else { return };
            let options = CloudOptions::default();
            let (rig, ready) = ready(&folder, &options);
            let frame = ready.frame(&pictures(&folder, 20), &options).unwrap();
            let [error, off, density, iou] = score(&rig, &frame, &folder, 20);
            println!("{name}: {:.1} mm, {:.2} % off the body, density {density:.3}, IoU {iou:.3}", 1e3 * error, 100.0 * off);
            assert!(error < depth_m && off < 0.03 && density > 0.85 && iou > overlap, "{name}: {error} {off} {density} {iou}");
        }
    }

    #[test]
    fn two_cameras_are_enough() {
        let Some(folder) = footage("p12_walk_lab") else { return };
        let options = CloudOptions::default();
        let (mut rig, _) = ready(&folder, &options);
        rig.cameras.truncate(2);
        let stage: Vec<GrayImage> = (0..2).map(|k| grey(folder.join(format!("cam_0{k}_background.png")))).collect();
        let pair = CloudRig::new(&rig, Some(&stage), &options).unwrap();
        let frame = pair.frame(&pictures(&folder, 20)[..2], &options).unwrap();
        let [error, off, density, iou] = score(&rig, &frame, &folder, 20);
        println!("two cameras: {:.1} mm, {:.2} % off the body, density {density:.3}, IoU {iou:.3}", 1e3 * error, 100.0 * off);
        assert!(error < 0.01 && off < 0.05 && density > 0.8 && iou > 0.8, "{error} {off} {density} {iou}");
    }

    #[test]
    fn an_empty_stage_gives_an_empty_cloud() {
        let Some(folder) = footage("p39_walk_digiclops") else { return };
        let options = CloudOptions::default();
        let (_, ready) = ready(&folder, &options);
        let stage: Vec<GrayImage> = (0..3).map(|k| grey(folder.join(format!("cam_0{k}_background.png")))).collect();
        let frame = ready.frame(&stage, &options).unwrap();
        assert!(frame.cloud.points.is_empty());
        assert!(frame.masks.iter().all(|m| m.as_ref().unwrap().iter().all(|&v| v == 0)));
        assert!(ready.frame(&stage[..2], &options).is_err());
        let small: Vec<GrayImage> = (0..3).map(|_| GrayImage::new(320, 240)).collect();
        assert!(matches!(ready.frame(&small, &options), Err(CloudError::Size { .. })));
    }

    #[test]
    fn threads_change_nothing() {
        let Some(folder) = footage("p12_walk_lab") else { return };
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let options = CloudOptions { voxel_m: Some(0.02), ..CloudOptions::default() };
                let (_, ready) = ready(&folder, &options);
                ready.frame(&pictures(&folder, 10), &options).unwrap()
            })
        };
        let (one, four) = (run(1), run(4));
        assert!(one.cloud.points.len() > 500);
        assert_eq!(one.cloud, four.cloud);
        assert_eq!(one.masks, four.masks);
    }
}

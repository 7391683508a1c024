//! One frame: three pictures in, the person's point cloud and silhouettes out.

use super::cloud::Cloud;
use super::correlate::Region;
use super::stage::{Change, Stage, StageOptions, changed_box, compare, person_mask, whole};
use super::stereo::{PreparedView, StereoOptions, ViewDisparity, match_views};
use super::{tidy, triangulate};
use crate::rig::rectify::{Plane, Rectification};
use image::{GrayImage, ImageBuffer, Luma};

/// How clouds are made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CloudOptions {
    /// Nothing nearer is looked for, metres from the cameras.
    pub nearest_m: f64,
    /// Nothing farther is kept, metres.
    pub farthest_m: f64,
    /// Keep one point per cube of this side, metres.
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
    #[error("the rig has camera number {camera} but only {given} pictures were given; give one per camera")]
    Images { camera: usize, given: usize },
    #[error("a picture of {camera} is {found:?} pixels, the calibration says {expected:?}; use pictures of the calibrated size")]
    Size { camera: String, found: [u32; 2], expected: [u32; 2] },
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
    /// The person in each rig camera's raw picture, 0/255; `None` for cameras outside the group or without a stage.
    pub masks: Vec<Option<GrayImage>>,
    /// The person's disparities in the reference view, px; NaN elsewhere.
    pub disparity: Plane,
}

impl Stage {
    /// The empty stage from one picture per camera of the rig.
    pub fn from_images(rectification: &Rectification, images: &[GrayImage], options: &CloudOptions) -> Result<Self, CloudError> {
        let images = pick(rectification, images)?;
        Ok(Self::new(rectification, &images, range(rectification, options)?[1], &options.stereo))
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
    let cameras = images.len();
    let images = pick(rectification, images)?;
    let range = range(rectification, options)?;
    let planes: Vec<Plane> = (0..images.len()).map(|k| rectification.warp(k, images[k])).collect();
    let Some(stage) = stage else {
        let found = search(rectification, planes, &vec![whole(rectification); images.len()], range, options);
        return Ok(FrameCloud {
            cloud: points(rectification, &found[0], &found[0].1.disparity, options),
            masks: vec![None; cameras],
            disparity: found[0].1.disparity.clone(),
        });
    };
    if stage.views.len() != planes.len() {
        return Err(CloudError::Stage(stage.views.len(), planes.len()));
    }
    let changes: Vec<Change> = planes.iter().zip(&stage.views).map(|(now, stage)| compare(now, &stage.plane, &options.stage)).collect();
    let regions: Option<Vec<Region>> = changes.iter().map(|c| changed_box(&c.changed, &options.stage, 12)).collect();
    let Some(regions) = regions else { return Ok(nobody(rectification, cameras)) };
    let found = search(rectification, planes, &regions, range, options);
    let persons: Vec<GrayImage> =
        (0..found.len()).map(|k| person_mask(rectification, k, &changes, &stage.views[k], &found[k].1, &options.stage)).collect();
    let disparity = inside(&found[0].1.disparity, &persons[0]);
    let mut masks = vec![None; cameras];
    for (k, view) in rectification.views.iter().enumerate() {
        masks[view.index] = Some(rectification.unwarp(k, &persons[k]));
    }
    Ok(FrameCloud { cloud: points(rectification, &found[0], &disparity, options), masks, disparity })
}

fn pick<'a>(rectification: &Rectification, images: &'a [GrayImage]) -> Result<Vec<&'a GrayImage>, CloudError> {
    let picture = |view: &crate::rig::rectify::RectifiedView| {
        let image = images.get(view.index).ok_or(CloudError::Images { camera: view.index, given: images.len() })?;
        let (found, expected) = ([image.width(), image.height()], view.camera.size_px);
        if found == expected { Ok(image) } else { Err(CloudError::Size { camera: view.camera.name.clone(), found, expected }) }
    };
    rectification.views.iter().map(picture).collect()
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
) -> Vec<(PreparedView, ViewDisparity)> {
    let prepared: Vec<PreparedView> = planes.into_iter().zip(&rectification.views).map(|(p, v)| PreparedView::new(p, v.step)).collect();
    let found = match_views(&prepared, regions, range, &options.stereo, &[]);
    prepared.into_iter().zip(found).collect()
}

fn inside(disparity: &Plane, mask: &GrayImage) -> Plane {
    let values = disparity.iter().zip(mask.iter()).map(|(&d, &m)| if m == 0 { f32::NAN } else { d }).collect();
    ImageBuffer::from_raw(disparity.width(), disparity.height(), values).expect("same size")
}

fn nobody(rectification: &Rectification, cameras: usize) -> FrameCloud {
    let mut masks = vec![None; cameras];
    for view in &rectification.views {
        let [width, height] = view.camera.size_px;
        masks[view.index] = Some(GrayImage::new(width, height));
    }
    let [width, height] = rectification.size_px;
    FrameCloud { cloud: Cloud::default(), masks, disparity: Plane::from_pixel(width, height, Luma([f32::NAN])) }
}

fn points(rectification: &Rectification, reference: &(PreparedView, ViewDisparity), disparity: &Plane, options: &CloudOptions) -> Cloud {
    let (prepared, found) = reference;
    let region = found.matches.region;
    let views = rectification.views.len() as f32 - 1.0;
    let confidence = Plane::from_fn(disparity.width(), disparity.height(), |x, y| {
        let i = (y * disparity.width() + x) as usize;
        let (x, y) = (x as usize, y as usize);
        if !(region.x[0]..region.x[1]).contains(&x) || !(region.y[0]..region.y[1]).contains(&y) {
            return Luma([0.0]);
        }
        let j = (y - region.y[0]) * region.width() + x - region.x[0];
        let distinct = 1.0 - f32::from(found.matches.cost[j][1]) / f32::from(found.matches.rival[j].max(1));
        Luma([distinct.clamp(0.0, 1.0) * found.confirmed[i].count_ones() as f32 / views])
    });
    let sigma = Plane::from_pixel(disparity.width(), disparity.height(), Luma([0.2]));
    let cloud = tidy::remove_outliers(triangulate::triangulate(rectification, disparity, &sigma, &confidence, &prepared.plane));
    match options.voxel_m {
        Some(side) => tidy::thin(cloud, side),
        None => cloud,
    }
}

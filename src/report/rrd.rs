//! A tracked session as a recording of rerun, to be scrubbed through in its viewer.
//!
//! | entity | what | when |
//! |---|---|---|
//! | `world` | axes: right-handed, up as in the rig file | always |
//! | `world/cameras/NAME` | pose and pinhole; the lens's distortion is left out | always |
//! | `world/cameras/NAME/picture` | the picture as filmed, JPEG | per frame |
//! | `world/cloud` | points with their colours | per frame |
//! | `world/body`, `world/skeleton` | ellipsoids of the surface, bones by side | per frame |
//! | `curves/phase`, `curves/root/x` (`y`, `z`), `curves/points` | cycles, metres, number of points | per frame |
//!
//! Timelines: `frame`, the frames' numbers, and `time`, seconds since the first; rerun adds when it was told (`log_time`,
//! `log_tick`), so that the same session gives the same content, but not the same bytes. Checked by rerun's own reader in Python,
//! `benches/rrd.py`.

use std::path::{Path, PathBuf};

use image::GrayImage;
use nalgebra::{UnitQuaternion, Vector3};
use rerun::{
    Color, Ellipsoids3D, EncodedImage, FillMode, LineStrips3D, Mat3x3, Pinhole, Points3D, Quaternion, RecordingStream,
    RecordingStreamBuilder, RecordingStreamError, Scalars, Transform3D, ViewCoordinates,
};

use super::ReportError;
use super::canvas::{Colour, LEFT, RIGHT};
use super::page::jpeg;
use crate::body::{Joint, Placement, PosedSurface, Surface, place};
use crate::fit::{Fit, Observation};
use crate::rig::{Camera, Rig, Up};

const MIDDLE: Colour = [110, 110, 110];
const BONE_RADIUS_M: f32 = 0.012;
const POINT_RADIUS_M: f32 = 0.004;

#[derive(Debug, thiserror::Error)]
pub enum RrdError {
    #[error("cannot write {}: {error}", path.display())]
    Record { path: PathBuf, error: Box<RecordingStreamError> },
    #[error(transparent)]
    Picture(#[from] ReportError),
}

/// A recording that is being written.
pub struct Recording {
    stream: RecordingStream,
    path: PathBuf,
    surface: Surface,
    offsets: [Vector3<f64>; crate::body::NODES],
}

impl Recording {
    /// Begins a recording of a session with its cameras.
    pub fn begin(path: &Path, session: &str, rig: &Rig, fit: &Fit) -> Result<Recording, RrdError> {
        let failed = |error| RrdError::Record { path: path.into(), error: Box::new(error) };
        let stream = RecordingStreamBuilder::new("muybridge").recording_name(session).save(path).map_err(failed)?;
        let shape = fit.shape();
        let recording = Recording { stream, path: path.into(), surface: Surface::new(shape), offsets: shape.offsets() };
        let axes = if rig.up == Up::Y { ViewCoordinates::RIGHT_HAND_Y_UP() } else { ViewCoordinates::RIGHT_HAND_Z_UP() };
        recording.stream.log_static("world", &axes).map_err(failed)?;
        rig.cameras.iter().try_for_each(|camera| recording.camera(camera)).map_err(failed)?;
        Ok(recording)
    }

    fn camera(&self, camera: &Camera) -> Result<(), RecordingStreamError> {
        let entity = camera_entity(camera);
        let world_from_camera = camera.camera_from_world.inverse();
        let columns = Mat3x3(std::array::from_fn(|i| world_from_camera.matrix()[i] as f32));
        self.stream.log_static(entity.clone(), &Transform3D::from_translation_mat3x3(single(&camera.centre()), columns))?;
        let pixels = Mat3x3(std::array::from_fn(|i| camera.matrix[i] as f32));
        let pinhole = Pinhole::new(pixels).with_resolution(camera.size_px.map(|s| s as f32));
        self.stream.log_static(entity, &pinhole)
    }

    /// One frame: pictures of all cameras in the rig's order, what was seen, and what was fitted to it.
    pub fn frame(&self, rig: &Rig, pictures: &[GrayImage], seen: &Observation, fit: &Fit, index: usize) -> Result<(), RrdError> {
        self.stream.set_time_sequence("frame", seen.number as i64);
        self.stream.set_duration_secs("time", seen.time_s);
        for (camera, picture) in rig.cameras.iter().zip(pictures) {
            let bytes = jpeg(&image::DynamicImage::from(picture.clone()).into_rgb8())?;
            let picture = EncodedImage::from_file_contents(bytes).with_media_type("image/jpeg");
            self.log(&format!("{}/picture", camera_entity(camera)), &picture)?;
        }
        let points = &seen.cloud.points;
        let colours = points.iter().map(|p| Color::from_rgb(p.colour[0], p.colour[1], p.colour[2]));
        let cloud = Points3D::new(points.iter().map(|p| single(&p.position))).with_colors(colours).with_radii([POINT_RADIUS_M]);
        self.log("world/cloud", &cloud)?;
        let placement = place(&self.offsets, &fit.poses[index]);
        self.log("world/body", &self.body(&placement))?;
        self.log("world/skeleton", &skeleton(&placement))?;
        let carrier = &fit.state.carriers[index];
        let root = placement.positions[0];
        let curves =
            [("phase", carrier.phase), ("root/x", root.x), ("root/y", root.y), ("root/z", root.z), ("points", points.len() as f64)];
        curves.iter().try_for_each(|(name, value)| self.log(&format!("curves/{name}"), &Scalars::single(*value)))
    }

    /// The surface's primitives, as large as half a unit of their field, which is about the skin of a limb.
    fn body(&self, placement: &Placement) -> Ellipsoids3D {
        let posed = PosedSurface::new(&self.surface, placement);
        let turn = |p: &crate::body::surface::PosedPrimitive| {
            let q = UnitQuaternion::from_matrix(&p.world_from_node);
            Quaternion::from_xyzw([q.i, q.j, q.k, q.w].map(|v| v as f32))
        };
        let primitives = &posed.primitives;
        let half_sizes = primitives.iter().map(|p| single(&(p.semi_axes * crate::body::surface::SKIN.sqrt())));
        Ellipsoids3D::from_centers_and_half_sizes(primitives.iter().map(|p| single(&p.centre)), half_sizes)
            .with_quaternions(primitives.iter().map(turn))
            .with_colors(primitives.iter().map(|p| colour(p.node)))
            .with_fill_mode(FillMode::Solid)
    }

    fn log(&self, entity: &str, what: &impl rerun::AsComponents) -> Result<(), RrdError> {
        self.stream.log(entity, what).map_err(|error| RrdError::Record { path: self.path.clone(), error: Box::new(error) })
    }

    /// Waits until all is on the disk.
    pub fn finish(self) -> Result<(), String> {
        let flushed = self.stream.flush_blocking().map_err(|error| format!("cannot write {}: {error}", self.path.display()));
        self.stream.disconnect();
        flushed
    }
}

fn camera_entity(camera: &Camera) -> String {
    format!("world/cameras/{}", rerun::EntityPathPart::new(camera.name.as_str()).escaped_string())
}

fn skeleton(placement: &Placement) -> LineStrips3D {
    let bones: Vec<[Joint; 2]> = Joint::ALL.into_iter().filter_map(|joint| Some([joint.parent()?, joint])).collect();
    let strip = |bone: &[Joint; 2]| bone.map(|joint| single(&placement.positions[joint as usize]));
    LineStrips3D::new(bones.iter().map(strip)).with_colors(bones.iter().map(|bone| colour(bone[1]))).with_radii([BONE_RADIUS_M])
}

fn colour(joint: Joint) -> Color {
    let [r, g, b] = match joint.name().as_bytes() {
        [b'l', b'_', ..] => LEFT,
        [b'r', b'_', ..] => RIGHT,
        _ => MIDDLE,
    };
    Color::from_rgb(r, g, b)
}

fn single(x: &Vector3<f64>) -> [f32; 3] {
    [x.x, x.y, x.z].map(|v| v as f32)
}

//! A tracked session as a recording for the viewer of rerun.io: cameras, pictures, clouds, body, skeleton and curves on the
//! timelines `frame` and `time`.
//!
//! Pictures are drawn without their lens' distortion, which the viewer's pinholes do not have. Rows are numbered in order and
//! not by the clock, so that the same track gives the same bytes.
//! Checked against rerun's own reader, tests/recording.rs.

use image::codecs::jpeg::JpegEncoder;
use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use re_chunk::{Chunk, ChunkError, ChunkId, EntityPath, RowId, TimePoint, Timeline};
use re_log_encoding::{EncodeError, Encoder};
use re_log_types::external::re_tuid::Tuid;
use re_log_types::{EntityPathPart, LogMsg, SetStoreInfo, StoreId, StoreInfo, StoreSource};
use re_types::AsComponents;
use re_types::archetypes::{
    Ellipsoids3D, EncodedImage, LineStrips3D, Pinhole, Points3D, RecordingInfo, Scalars, Transform3D, ViewCoordinates,
};
use re_types::components::FillMode;
use re_types::datatypes::{Mat3x3, Quaternion};

use super::canvas::{Colour, LEFT, RIGHT};
use super::view3d::ellipsoids;
use crate::body::{Joint, Placement, place};
use crate::fit::weighing::Fitness;
use crate::fit::{Fit, Observation};
use crate::footage::FrameSet;
use crate::rig::rectify::without_lens;
use crate::rig::{Camera, Rig, Up};

const MIDDLE: Colour = [150, 150, 150];
const POINT_M: f32 = 0.004;
const BONE_M: f32 = 0.012;
/// How far before a camera the viewer shows its picture.
const PICTURE_M: f32 = 0.4;
const JPEG_QUALITY: u8 = 90;

#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    #[error("cannot record: {0}")]
    Chunk(#[from] ChunkError),
    #[error("cannot record: {0}")]
    Encode(#[from] EncodeError),
    #[error("cannot encode a picture: {0}")]
    Picture(#[from] image::ImageError),
}

/// A recording that is being made.
pub struct Recording {
    encoder: Encoder<Vec<u8>>,
    store: StoreId,
    last: Tuid,
}

impl Recording {
    /// All of a track but its pictures.
    pub fn of_track(session: &str, rig: &Rig, fit: &Fit, observations: &[Observation]) -> Result<Recording, RecordingError> {
        let what = blake3::hash(format!("{session} {:?} {:?}", fit.state.weights, fit.poses).as_bytes()).to_hex();
        let store = StoreId::recording("muybridge", &what[..32]);
        let mut recording = Recording { encoder: Encoder::local()?, store: store.clone(), last: Tuid::from_nanos_and_inc(0, 1) };
        let info = StoreInfo::new(store, StoreSource::Other(concat!("muybridge ", env!("CARGO_PKG_VERSION")).into()));
        let row_id = recording.next();
        recording.encoder.append(&LogMsg::SetStoreInfo(SetStoreInfo { row_id, info }))?;
        // What the viewer lists it by.
        recording.always(EntityPath::properties(), &RecordingInfo::new().with_name(session))?;
        let axes = match rig.up {
            Up::Y => ViewCoordinates::RIGHT_HAND_Y_UP(),
            Up::Z => ViewCoordinates::RIGHT_HAND_Z_UP(),
        };
        recording.always(path(&["world"]), &axes)?;
        for camera in &rig.cameras {
            let (pose, pinhole) = (world_from_camera(camera), pinhole(camera));
            recording.always(path(&["world", "cameras", &camera.name]), &pose)?;
            recording.always(path(&["world", "cameras", &camera.name]), &pinhole)?;
        }
        let offsets = fit.shape().offsets();
        let placements: Vec<Placement> = fit.poses.iter().map(|pose| place(&offsets, pose)).collect();
        let times: Vec<TimePoint> = observations.iter().map(|o| instant(o.number, o.time_s)).collect();
        let at = |t: usize| times[t].clone();
        recording.log(&["world", "cloud"], observations.iter().enumerate().map(|(t, o)| (at(t), cloud(o))))?;
        recording.log(&["world", "body"], placements.iter().enumerate().map(|(t, p)| (at(t), body(fit, p))))?;
        recording.log(&["world", "skeleton"], placements.iter().enumerate().map(|(t, p)| (at(t), skeleton(p))))?;
        for (name, values) in curves(fit, observations) {
            recording.log(&["curves", name], values.into_iter().enumerate().map(|(t, v)| (at(t), Scalars::new([v]))))?;
        }
        Ok(recording)
    }

    /// The pictures of one frame.
    pub fn pictures(&mut self, rig: &Rig, frame: &FrameSet) -> Result<(), RecordingError> {
        for (camera, image) in rig.cameras.iter().zip(&frame.images) {
            let mut bytes = Vec::new();
            JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).encode_image(&without_lens(camera, image))?;
            let picture = EncodedImage::new(bytes).with_media_type("image/jpeg");
            self.log(&["world", "cameras", &camera.name, "picture"], [(instant(frame.number, frame.time_s), picture)])?;
        }
        Ok(())
    }

    /// The file.
    pub fn bytes(mut self) -> Result<Vec<u8>, RecordingError> {
        self.encoder.finish()?;
        Ok(self.encoder.into_inner()?)
    }

    fn next(&mut self) -> Tuid {
        self.last = self.last.next();
        self.last
    }

    fn always(&mut self, entity: EntityPath, what: &dyn AsComponents) -> Result<(), RecordingError> {
        let (chunk, row) = (ChunkId::from_tuid(self.next()), RowId::from_tuid(self.next()));
        self.append(Chunk::builder_with_id(chunk, entity).with_archetype(row, TimePoint::default(), what).build()?)
    }

    fn log<A: AsComponents>(&mut self, entity: &[&str], rows: impl IntoIterator<Item = (TimePoint, A)>) -> Result<(), RecordingError> {
        let mut chunk = Chunk::builder_with_id(ChunkId::from_tuid(self.next()), path(entity));
        for (time, what) in rows {
            chunk = chunk.with_archetype(RowId::from_tuid(self.next()), time, &what);
        }
        self.append(chunk.build()?)
    }

    fn append(&mut self, chunk: Chunk) -> Result<(), RecordingError> {
        self.encoder.append(&LogMsg::ArrowMsg(self.store.clone(), chunk.to_arrow_msg()?))?;
        Ok(())
    }
}

/// Names of cameras may hold anything.
fn path(entity: &[&str]) -> EntityPath {
    entity.iter().map(|part| EntityPathPart::new(*part)).collect()
}

fn instant(frame: usize, time_s: f64) -> TimePoint {
    let nanoseconds = (1e9 * time_s).round() as i64;
    TimePoint::default().with(Timeline::new_sequence("frame"), frame as i64).with(Timeline::new_duration("time"), nanoseconds)
}

fn single(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

fn quaternion(q: &UnitQuaternion<f64>) -> Quaternion {
    Quaternion::from_xyzw([q.i as f32, q.j as f32, q.k as f32, q.w as f32])
}

fn columns(m: &Matrix3<f64>) -> Mat3x3 {
    Mat3x3::from([0, 1, 2].map(|k| single(&m.column(k).into_owned())))
}

fn world_from_camera(camera: &Camera) -> Transform3D {
    let turn = UnitQuaternion::from_rotation_matrix(&camera.camera_from_world.inverse());
    Transform3D::from_translation(single(&camera.centre())).with_quaternion(quaternion(&turn))
}

fn pinhole(camera: &Camera) -> Pinhole {
    // The viewer's pixels begin at their corner, ours lie at their centre.
    let mut matrix = camera.matrix;
    matrix[(0, 2)] += 0.5;
    matrix[(1, 2)] += 0.5;
    Pinhole::new(columns(&matrix))
        .with_resolution(camera.size_px.map(|s| s as f32))
        .with_camera_xyz(re_types::components::ViewCoordinates::RDF)
        .with_image_plane_distance(PICTURE_M)
}

fn cloud(observation: &Observation) -> Points3D {
    let points = &observation.cloud.points;
    Points3D::new(points.iter().map(|p| single(&p.position))).with_colors(points.iter().map(|p| p.colour)).with_radii([POINT_M])
}

fn body(fit: &Fit, placement: &Placement) -> Ellipsoids3D {
    let all = ellipsoids(fit.shape());
    let turn = |node: Joint| &placement.world_from_node[node as usize];
    Ellipsoids3D::from_half_sizes(all.iter().map(|e| single(&e.half_axes)))
        .with_centers(all.iter().map(|e| single(&(placement.position(e.node) + turn(e.node) * e.centre))))
        .with_quaternions(all.iter().map(|e| quaternion(turn(e.node))))
        .with_colors(all.iter().map(|e| side(e.node)))
        .with_fill_mode(FillMode::Solid)
}

fn skeleton(placement: &Placement) -> LineStrips3D {
    let bones: Vec<(Joint, Joint)> = Joint::ALL.into_iter().filter_map(|joint| Some((joint.parent()?, joint))).collect();
    LineStrips3D::new(bones.iter().map(|(parent, joint)| [parent, joint].map(|j| single(&placement.position(*j)))))
        .with_colors(bones.iter().map(|(_, joint)| side(*joint)))
        .with_radii([BONE_M])
}

fn side(joint: Joint) -> Colour {
    match joint.name().as_bytes() {
        [b'l', b'_', ..] => LEFT,
        [b'r', b'_', ..] => RIGHT,
        _ => MIDDLE,
    }
}

/// One value per frame: phase in cycles, root in metres, horizontal speed in m/s, rms distance of the points from the skin in mm.
fn curves(fit: &Fit, observations: &[Observation]) -> Vec<(&'static str, Vec<f64>)> {
    let root = |axis: usize| fit.poses.iter().map(|pose| pose.root[axis]).collect();
    let rms = |f: &Fitness| 1e3 * (f.inlier_square / f.inliers.max(1) as f64).sqrt();
    vec![
        ("phase", fit.state.carriers.iter().map(|c| c.phase).collect()),
        ("root_x_m", root(0)),
        ("root_y_m", root(1)),
        ("root_z_m", root(2)),
        ("speed_m_s", speeds(fit, observations)),
        ("rms_mm", fit.frames.iter().map(rms).collect()),
    ]
}

/// Of the carrier, between the neighbours of each frame.
fn speeds(fit: &Fit, observations: &[Observation]) -> Vec<f64> {
    let carriers = &fit.state.carriers;
    let last = carriers.len() - 1;
    let speed = |t: usize| {
        let [a, b] = [t.saturating_sub(1), (t + 1).min(last)];
        let way = carriers[b].position - carriers[a].position;
        (way - fit.up * way.dot(&fit.up)).norm() / (observations[b].time_s - observations[a].time_s)
    };
    (0..carriers.len()).map(speed).collect()
}

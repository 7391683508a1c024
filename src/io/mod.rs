//! One file per format. Degrees, millimetres and axes are converted here and nowhere else.

pub mod asf_amc;
pub mod atomic;
pub mod manifest;
pub mod model_npz;
pub mod style_json;
pub mod bvh;
pub mod mapping;
pub mod mocap;
pub mod mot;
pub mod sidecar;

pub use atomic::write_atomic;
pub use mocap::{MocapError, ReadClip, is_motion_file, read_clip};

//! One file per format. Degrees, millimetres and axes are converted here and nowhere else.

pub mod animal_clip;
pub mod animal_json;
pub mod asf_amc;
pub mod atomic;
pub mod bvh;
pub mod calib_toml;
pub mod calib_views;
pub mod calibration_json;
pub mod creature_bvh;
pub mod fit_json;
pub mod gait_csv;
pub mod glb;
pub mod images;
pub mod joints_csv;
mod kalibr;
pub mod manifest;
pub mod mapping;
pub mod mocap;
pub mod model_npz;
pub mod mot;
pub mod opencv_yml;
pub mod pfm;
pub mod ply;
pub mod rig_files;
pub mod session;
pub mod sidecar;
pub mod style_json;
pub mod video;

pub use atomic::write_atomic;
pub use mocap::{MocapError, ReadClip, is_motion_file, read_clip};
pub use opencv_yml::write_opencv_rig;
pub use rig_files::{ReadRig, RigFileError, RigReading, read_rig_files};

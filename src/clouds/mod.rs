//! Point clouds by three-view correlation stereo.

mod candidates;
pub mod cloud;
pub mod correlate;
pub mod edges;
pub mod frame;
mod lanes;
pub mod prefilter;
pub mod smooth;
pub mod stage;
pub mod stereo;
pub mod subpixel;
pub mod tidy;
pub mod triangulate;
pub mod validate;
mod windows;

pub use cloud::{Cloud, CloudPoint};
pub use frame::{CloudError, CloudOptions, CloudRig, FrameCloud, frame_cloud};
pub use stage::Stage;

//! Point clouds by three-view correlation stereo.

pub mod cloud;
pub mod correlate;
pub mod prefilter;
pub mod stereo;
pub mod subpixel;
pub mod validate;

pub use cloud::{Cloud, CloudPoint};

//! Point clouds by three-view correlation stereo.

pub mod cloud;

pub use cloud::{Cloud, CloudPoint};

//! One file per format. Degrees, millimetres and axes are converted here and nowhere else.

pub mod atomic;
pub mod manifest;
pub mod model_npz;
pub mod style_json;

pub use atomic::write_atomic;

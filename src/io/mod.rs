//! One file per format. Degrees, millimetres and axes are converted here and nowhere else.

pub mod atomic;
pub mod joints_csv;

pub mod calib_toml;

pub mod images;

pub mod session;

pub mod video;

pub use atomic::write_atomic;

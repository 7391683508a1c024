//! One file per format. Degrees, millimetres and axes are converted here and nowhere else.

pub mod atomic;
pub mod joints_csv;

pub use atomic::write_atomic;

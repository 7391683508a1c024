//! Marker recordings to clips: marker sets, upright metres, and inverse kinematics of all frames at once.

pub mod ik;
mod problem;
pub mod set;
mod start;

pub use ik::{IkError, Solved, solve};
pub use set::{MarkerSet, SetError, choose};

use nalgebra::Vector3;

/// A recording as its file holds it, in the file's axes and units.
#[derive(Clone, Debug, PartialEq)]
pub struct Markers {
    pub names: Vec<String>,
    pub fps: f64,
    /// `None` where the file names no unit of length.
    pub metres_per_unit: Option<f64>,
    /// Per frame one position per name; `None` where the marker was not seen.
    pub frames: Vec<Vec<Option<Vector3<f64>>>>,
}

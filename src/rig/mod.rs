//! Cameras and rigs of N cameras, three-view rectification.

pub mod camera;
pub mod rectify;

pub use camera::Camera;

use nalgebra::Vector3;

/// Which axis of the world points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Up {
    Y,
    #[default]
    Z,
}

impl Up {
    /// The up direction as a unit vector of the world.
    pub fn direction(self) -> Vector3<f64> {
        match self {
            Up::Y => Vector3::y(),
            Up::Z => Vector3::z(),
        }
    }
}

/// Synchronized, calibrated cameras in one world.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    pub cameras: Vec<Camera>,
    pub up: Up,
}

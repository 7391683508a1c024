//! A frame's point cloud.

use nalgebra::{Matrix3, Vector3};

/// One triangulated point.
#[derive(Clone, Debug, PartialEq)]
pub struct CloudPoint {
    /// Position in the rig's world, metres.
    pub position: Vector3<f64>,
    /// Grey value or colour of the reference view.
    pub colour: [u8; 3],
    /// 0 (barely accepted) to 1 (unambiguous match).
    pub confidence: f64,
    /// Covariance of the position in the world from disparity and pixel noise, m².
    pub covariance: Matrix3<f64>,
}

/// The points of one frame.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Cloud {
    pub points: Vec<CloudPoint>,
}

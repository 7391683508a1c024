//! Numerics that know no camera and no body.

pub mod arrow;
pub mod banded;
pub mod curves;
pub mod distance_field;
pub mod euler;
pub mod exponential;
pub mod order;
pub mod pca;
pub mod rbf;
pub mod rotation;
pub mod spectrum;
pub mod spline;

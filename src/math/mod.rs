//! Numerics that know no camera and no body.

pub mod curves;
pub mod rotation;

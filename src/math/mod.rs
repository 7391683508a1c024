//! Numerics that know no camera and no body.

pub mod rotation;

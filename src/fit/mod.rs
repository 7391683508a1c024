//! Fitting the body to all clouds at once.

pub mod curve;
pub mod problem;
pub mod state;

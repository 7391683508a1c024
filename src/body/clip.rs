//! A recorded or generated motion: poses at a constant rate in a y-up world, with the size of the mover.

use nalgebra::Vector3;

use super::pose::Pose;
use super::skeleton::NODES;

/// Poses at `fps` in a y-up world in metres.
#[derive(Clone, Debug)]
pub struct Clip {
    pub fps: f64,
    pub poses: Vec<Pose>,
    /// Offsets of the mover's nodes from their parents at rest, metres (see [`Shape::offsets`](super::Shape::offsets)).
    pub offsets: [Vector3<f64>; NODES],
    /// Height of the hip joints above the floor when standing, metres.
    pub hip_height_m: f64,
}

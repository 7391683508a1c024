//! The phantom's room: floor, walls and ceiling of an axis-aligned box, each with its own solid texture, and one light.

use nalgebra::Vector3;

use super::noise::{Octave, octaves};
use crate::rig::{Rig, Up};

/// Light that reaches every surface, and light from [`Stage::to_light`] that is shared out by the cosine law.
pub const AMBIENT: f64 = 0.55;
pub const DIFFUSE: f64 = 0.6;

/// Octaves of the room's textures. The finest is two to four pixels at 3 to 6 m through 550 px of focal length: finer
/// ones alias, and without the coarse ones the picture is one even grey from afar.
const FLOOR: [Octave; 4] = [(0.045, 0.12), (0.11, 0.12), (0.3, 0.10), (1.1, 0.08)];
const WALL: [Octave; 4] = [(0.055, 0.16), (0.12, 0.16), (0.35, 0.12), (1.3, 0.12)];

/// A box-shaped room in the rig's world; the floor is at height 0.
#[derive(Clone, Debug)]
pub struct Stage {
    pub up: Up,
    /// Corners, metres.
    pub min: Vector3<f64>,
    pub max: Vector3<f64>,
    /// Unit direction to the light, which is far away.
    pub to_light: Vector3<f64>,
}

impl Stage {
    /// A room that holds the cameras and `path`, with 1.8 m to spare at the sides and 3 m of height or more; the light
    /// stands behind the cameras, high and to the left.
    pub fn around(rig: &Rig, path: &[Vector3<f64>]) -> Stage {
        let up = rig.up.direction();
        let centres: Vec<_> = rig.cameras.iter().map(|c| c.centre()).collect();
        let (mut min, mut max) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        for x in centres.iter().chain(path) {
            min = min.inf(x);
            max = max.sup(x);
        }
        let height = max.dot(&up).max(1.8) + 1.2;
        let flat = Vector3::repeat(1.0) - up;
        min = (min - Vector3::repeat(1.8)).component_mul(&flat);
        max = (max + Vector3::repeat(1.8)).component_mul(&flat) + up * height;
        let forward: Vector3<f64> = rig.cameras.iter().map(|c| c.camera_from_world.inverse() * Vector3::z()).sum();
        let forward = (forward - up * forward.dot(&up)).try_normalize(1e-9).unwrap_or_else(|| up.yzx());
        let left = up.cross(&forward);
        Stage { up: rig.up, min, max, to_light: (up * 0.85 - forward * 0.45 + left * 0.4).normalize() }
    }

    /// Where a ray from inside leaves the room: the distance along `direction` (unit) and the wall's inward normal.
    pub fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> (f64, Vector3<f64>) {
        let mut nearest = (f64::INFINITY, Vector3::zeros());
        for axis in 0..3 {
            let (wall, inward) = if direction[axis] > 0.0 { (self.max[axis], -1.0) } else { (self.min[axis], 1.0) };
            let t = (wall - origin[axis]) / direction[axis];
            if t < nearest.0 {
                nearest = (t, Vector3::ith(axis, inward));
            }
        }
        nearest
    }

    /// Share of the light that a point of the room reflects, 0 to 1.
    pub fn albedo(&self, x: &Vector3<f64>, normal: &Vector3<f64>) -> f64 {
        let on_floor = normal.dot(&self.up.direction()) > 0.5;
        let (mean, layers, seed) = if on_floor { (0.46, &FLOOR, 11) } else { (0.50, &WALL, 23) };
        // Off the lattice planes, where gradient noise is flatter.
        (mean + octaves(&(x + Vector3::repeat(0.0173)), layers, seed)).clamp(0.05, 0.95)
    }

    /// Light that falls directly on a surface without shadow.
    pub fn direct(&self, normal: &Vector3<f64>) -> f64 {
        DIFFUSE * normal.dot(&self.to_light).max(0.0)
    }
}

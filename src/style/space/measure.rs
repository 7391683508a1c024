//! Attributes that are measured, not labelled: the paper's two.
//!
//! Both are taken from a body of template proportions that plays the motion, over one cycle or the whole of it.

use super::{Attribute, Blend, Space};
use crate::body::{Joint, Pose, Shape, place};
use crate::math::rotation::exp;

/// Mean height of the right wrist above the floor over the hip height.
pub const HAND_HEIGHT: &str = "hand-height";
/// Mean of ½ v² of all joints against the root, J/kg for a body of 1.75 m.
pub const ENERGY: &str = "energy";

const STATURE_M: f64 = 1.75;
/// Instants at which a motion is measured.
const INSTANTS: usize = 100;

/// [`HAND_HEIGHT`] and [`ENERGY`] of a motion.
pub fn measure(blend: &Blend) -> [f64; 2] {
    let shape = Shape::template(STATURE_M);
    let (offsets, hip_height_m) = (shape.offsets(), shape.hip_height_m());
    let step_s = blend.duration_s() / INSTANTS as f64;
    let at = |phase: f64| {
        let (joints, root) = blend.posture(phase);
        let height = (1.0 + root.position.y) * hip_height_m;
        let pose = Pose { root: nalgebra::Vector3::new(0.0, height, 0.0), world_from_root: exp(&root.rotation), joints };
        place(&offsets, &pose).positions
    };
    let frames: Vec<_> = (0..=INSTANTS).map(|k| at(k as f64 / INSTANTS as f64)).collect();
    let height = frames[1..].iter().map(|f| f[Joint::RWrist as usize].y).sum::<f64>() / INSTANTS as f64;
    let mut squares = 0.0;
    for pair in frames.windows(2) {
        let moved = |k: usize| (pair[1][k] - pair[1][0]) - (pair[0][k] - pair[0][0]);
        squares += (1..pair[0].len()).map(|k| moved(k).norm_squared()).sum::<f64>() / (pair[0].len() - 1) as f64;
    }
    [height / hip_height_m, 0.5 * squares / (INSTANTS as f64 * step_s * step_s)]
}

/// Both attributes of all members.
pub fn attributes(space: &Space) -> Vec<Attribute> {
    let measured: Vec<[f64; 2]> = space.members.iter().map(|m| measure(&space.play(&m.vectors))).collect();
    [HAND_HEIGHT, ENERGY]
        .into_iter()
        .enumerate()
        .map(|(k, name)| Attribute { name: name.into(), labels: measured.iter().map(|m| Some(m[k])).collect() })
        .collect()
}

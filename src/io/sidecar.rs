//! The JSON beside a written motion file, which says what the format cannot: units, axes, rest pose, the rig's world.

use std::path::Path;

use nalgebra::Rotation3;
use serde::{Deserialize, Serialize};

use crate::body::Clip;
use crate::math::euler::Order;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sidecar {
    pub software: String,
    pub length_unit: String,
    pub angle_unit: String,
    pub axes: String,
    pub rest_pose: String,
    pub rotation_order: String,
    pub fps: f64,
    pub hip_height_m: f64,
    /// Rows of the rotation that carries the rig's world into the file's; `None` where no rig was involved.
    pub file_from_rig_world: Option<[[f64; 3]; 3]>,
}

impl Sidecar {
    pub fn of_bvh(clip: &Clip, file_from_rig_world: Option<&Rotation3<f64>>, order: Order) -> Sidecar {
        Sidecar {
            software: concat!("muybridge ", env!("CARGO_PKG_VERSION")).into(),
            length_unit: "m".into(),
            angle_unit: "deg".into(),
            axes: "right-handed, y up; at rest the person looks along +z, left is +x; floor at y = 0".into(),
            rest_pose: "standing, arms hanging, palms in, feet forward; all joint axes parallel to the world's".into(),
            rotation_order: order_text(order),
            fps: clip.fps,
            hip_height_m: clip.hip_height_m,
            file_from_rig_world: file_from_rig_world.map(rows),
        }
    }

    pub fn to_json(&self) -> String {
        // Plain fields and finite numbers always serialise.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }

    /// The side-car of a motion file, if there is one that this software wrote.
    pub fn beside(path: &Path) -> Option<Sidecar> {
        serde_json::from_str(&std::fs::read_to_string(path.with_extension("json")).ok()?).ok()
    }
}

fn order_text(order: Order) -> String {
    let turns = order.axes().map(|axis| ["Rx", "Ry", "Rz"][axis]).join(" ");
    format!("{}: parent_from_joint = {turns} on column vectors", order.name())
}

pub(super) fn rows(r: &Rotation3<f64>) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| r[(i, j)]))
}

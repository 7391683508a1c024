//! One gait cycle or one jump, resampled to N = 100 samples: the unit of the database (style paper §3).

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::body::BALL_JOINTS;
use crate::math::rotation::{exp, log};

/// Samples per cycle, N of the paper, at phases 0, 1/N, …
pub const SAMPLES: usize = 100;
/// Root channels per sample: see [`RootSample`].
pub const ROOT_CHANNELS: usize = 6;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activity {
    Walking,
    Running,
    Jumping,
}

impl Activity {
    pub const ALL: [Activity; 3] = [Activity::Walking, Activity::Running, Activity::Jumping];

    /// Walking and running repeat; a jump has a start and an end.
    pub fn is_cyclic(self) -> bool {
        self != Activity::Jumping
    }
}

impl std::fmt::Display for Activity {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.pad(match self {
            Activity::Walking => "walking",
            Activity::Running => "running",
            Activity::Jumping => "jumping",
        })
    }
}

/// The root against its carrier, a frame that moves with the heading and the mean speed of the cycle at the standing
/// hip height: x left, y up, z forward.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RootSample {
    /// Rotation vector of carrier_from_root, radians.
    pub rotation: Vector3<f64>,
    /// Position of the root in the carrier divided by the hip height H: sway (left), height of the root above the floor
    /// minus 1 (up), progress within the cycle against uniform motion (forward). For a jump the carrier stands still at
    /// the start, and forward is the whole progress.
    pub position: Vector3<f64>,
}

/// One cycle of one subject.
#[derive(Clone, Debug)]
pub struct Cycle {
    pub subject: String,
    /// File and place it came from, for the reader of the model file.
    pub source: String,
    pub activity: Activity,
    /// Speed in m/s, for jumps the length in m.
    pub parameter: f64,
    pub hip_height_m: f64,
    pub duration_s: f64,
    /// [`SAMPLES`] postures; index of a ball joint: `joint as usize - 1`.
    pub joints: Vec<[UnitQuaternion<f64>; BALL_JOINTS]>,
    /// [`SAMPLES`] root samples.
    pub root: Vec<RootSample>,
}

impl Cycle {
    /// Joint rotations (index `joint as usize - 1`) and root at `phase`, by slerp between the neighbouring samples; a gait's
    /// phase wraps, a jump's is held at its ends.
    pub fn posture(&self, phase: f64) -> ([UnitQuaternion<f64>; BALL_JOINTS], RootSample) {
        let (before, after, part) = neighbours(self.activity, phase);
        let turn = |a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>| a * exp(&(log(&(a.inverse() * b)) * part));
        let (joints, root) = ((&self.joints[before], &self.joints[after]), (&self.root[before], &self.root[after]));
        let rotation = log(&turn(&exp(&root.0.rotation), &exp(&root.1.rotation)));
        let position = root.0.position.lerp(&root.1.position, part);
        (std::array::from_fn(|j| turn(&joints.0[j], &joints.1[j])), RootSample { rotation, position })
    }
}

/// Samples before and after a phase, and how far it is between them.
pub(super) fn neighbours(activity: Activity, phase: f64) -> (usize, usize, f64) {
    if activity.is_cyclic() {
        let at = phase.rem_euclid(1.0) * SAMPLES as f64;
        let before = at as usize % SAMPLES;
        (before, (before + 1) % SAMPLES, at - at.floor())
    } else {
        let at = phase.clamp(0.0, 1.0) * (SAMPLES - 1) as f64;
        let before = (at as usize).min(SAMPLES - 2);
        (before, before + 1, at - before as f64)
    }
}

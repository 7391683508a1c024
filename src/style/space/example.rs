//! One motion as curves: what the space is built from, and what a person gives it to change.

use nalgebra::{DMatrix, DVector, UnitQuaternion, Vector2, Vector3};

use super::interpolate::at;
use crate::body::{BALL_JOINTS, Clip, DOF, Joint, Pose, Shape, place};
use crate::math::rotation::{exp, log};
use crate::motion_model::{Cycle, RootSample};

/// Curves of one posture: 78 joint coordinates, then the root's rotation vector and its sway, height and progress.
pub const CURVES: usize = DOF + 6;
/// The curve that holds the forward progress.
pub const PROGRESS: usize = CURVES - 1;

/// A posture without its place in the world: joint rotations (index `joint as usize - 1`) and the root in its carrier.
pub type Posture = ([UnitQuaternion<f64>; BALL_JOINTS], RootSample);

/// Postures at equal steps of time. A cycle's samples leave out the end, which is its start again one stride ahead; an open
/// motion's samples include both ends.
#[derive(Clone, Debug)]
pub struct Example {
    /// The file's name, with a number where one file holds several motions.
    pub name: String,
    /// File and place it came from.
    pub source: String,
    pub cyclic: bool,
    pub duration_s: f64,
    /// Way of one cycle over the hip height; 0 for an open motion, whose progress is a curve.
    pub stride: f64,
    pub hip_height_m: f64,
    pub postures: Vec<Posture>,
}

impl Example {
    /// A gait cycle, or a jump.
    pub fn of_cycle(name: &str, cycle: &Cycle) -> Example {
        let cyclic = cycle.activity.is_cyclic();
        Example {
            name: name.into(),
            source: cycle.source.clone(),
            cyclic,
            duration_s: cycle.duration_s,
            stride: if cyclic { cycle.parameter * cycle.duration_s / cycle.hip_height_m } else { 0.0 },
            hip_height_m: cycle.hip_height_m,
            postures: cycle.joints.iter().copied().zip(cycle.root.iter().copied()).collect(),
        }
    }

    /// A whole clip, every frame of it. Its carrier stands where the root starts, facing as the root does at first.
    pub fn of_clip(name: &str, clip: &Clip) -> Option<Example> {
        let first = clip.poses.first()?;
        let facing = first.world_from_root * Vector3::z();
        let carrier_from_world = exp(&Vector3::new(0.0, -facing.x.atan2(facing.z), 0.0));
        let origin = Vector3::new(first.root.x, clip.hip_height_m, first.root.z);
        let root = |pose: &Pose| RootSample {
            rotation: log(&(carrier_from_world * pose.world_from_root)),
            position: carrier_from_world * (pose.root - origin) / clip.hip_height_m,
        };
        Some(Example {
            name: name.into(),
            source: name.into(),
            cyclic: false,
            duration_s: (clip.poses.len() - 1) as f64 / clip.fps,
            stride: 0.0,
            hip_height_m: clip.hip_height_m,
            postures: clip.poses.iter().map(|pose| (pose.joints, root(pose))).collect(),
        })
    }

    /// [`CURVES`] rows, one column per sample; joints are rotation vectors about `mean_rotations`, and a cycle's progress is
    /// the way gone, no longer the deviation from uniform motion.
    pub fn curves(&self, mean_rotations: &[UnitQuaternion<f64>; BALL_JOINTS]) -> Curves {
        let count = self.postures.len();
        let mut values = DMatrix::zeros(CURVES, count);
        for (k, (mut column, (joints, root))) in values.column_iter_mut().zip(&self.postures).enumerate() {
            for (j, (mean, joint)) in mean_rotations.iter().zip(joints).enumerate() {
                column.fixed_rows_mut::<3>(3 * j).copy_from(&log(&(mean.inverse() * joint)));
            }
            column.fixed_rows_mut::<3>(DOF).copy_from(&root.rotation);
            column.fixed_rows_mut::<3>(DOF + 3).copy_from(&root.position);
            column[PROGRESS] += self.stride * k as f64 / count as f64;
        }
        for curve in 0..CURVES - 3 {
            if curve % 3 == 0 {
                unwrap(&mut values, curve);
            }
        }
        let feet: Vec<_> = self.postures.iter().map(feet).collect();
        let feet = DMatrix::from_fn(2, count, |side, k| feet[k][side]);
        Curves { values, feet, cyclic: self.cyclic, stride: self.stride }
    }
}

/// How far the left and the right ankle are ahead of the root, over the stature of a template body.
fn feet((joints, root): &Posture) -> Vector2<f64> {
    let pose = Pose { root: Vector3::zeros(), world_from_root: exp(&root.rotation), joints: *joints };
    let placed = place(&Shape::template(1.0).offsets(), &pose);
    Vector2::new(placed.position(Joint::LAnkle).z, placed.position(Joint::RAnkle).z)
}

/// Rotation vectors jump where an angle passes π; each is replaced by the equal one nearest to its predecessor.
fn unwrap(values: &mut DMatrix<f64>, first: usize) {
    for k in 1..values.ncols() {
        let before: Vector3<f64> = values.fixed_view::<3, 1>(first, k - 1).into();
        let here: Vector3<f64> = values.fixed_view::<3, 1>(first, k).into();
        let angle = here.norm();
        if angle < 1e-6 {
            continue;
        }
        let turns = ((before.dot(&here) / angle - angle) / std::f64::consts::TAU).round();
        values.fixed_view_mut::<3, 1>(first, k).copy_from(&(here * (1.0 + turns * std::f64::consts::TAU / angle)));
    }
}

/// Curves over the time of a motion, sampled at equal steps.
#[derive(Clone, Debug)]
pub struct Curves {
    /// Curves × samples.
    pub values: DMatrix<f64>,
    /// How far left and right ankle are ahead of the root × samples: evidence for the warp, not part of a shape.
    pub feet: DMatrix<f64>,
    pub cyclic: bool,
    /// What the last curve gains in one cycle.
    pub stride: f64,
}

impl Curves {
    /// Times of the knots as parts of the duration, 0 to 1; a cycle's last knot is its first one again.
    pub fn times(&self) -> Vec<f64> {
        let intervals = if self.cyclic { self.values.ncols() } else { self.values.ncols() - 1 };
        (0..=intervals).map(|k| k as f64 / intervals as f64).collect()
    }

    /// The feet at part `time` of the duration.
    pub fn feet_at(&self, times: &[f64], time: f64) -> DVector<f64> {
        let (samples, weights, _) = at(times, self.cyclic, time);
        samples.into_iter().zip(weights).fold(DVector::zeros(2), |sum, (sample, weight)| sum + self.feet.column(sample) * weight)
    }

    /// All curves at part `time` of the duration, where `times` are [`Curves::times`].
    pub fn at(&self, times: &[f64], time: f64) -> DVector<f64> {
        let (samples, weights, wraps) = at(times, self.cyclic, time);
        let mut sum = DVector::zeros(self.values.nrows());
        for ((sample, weight), wrap) in samples.into_iter().zip(weights).zip(wraps) {
            sum.axpy(weight, &self.values.column(sample), 1.0);
            if let Some(progress) = sum.get_mut(PROGRESS) {
                *progress += weight * wrap * self.stride;
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::{Activity, synthetic};

    #[test]
    fn angles_beyond_pi_go_on_without_a_jump() {
        let angles: Vec<f64> = (0..40).map(|k| 0.2 * k as f64).collect();
        let axis = Vector3::new(0.6, 0.0, 0.8);
        let mut values = DMatrix::zeros(3, 40);
        for (k, angle) in angles.iter().enumerate() {
            values.column_mut(k).copy_from(&log(&exp(&(axis * *angle))));
        }
        assert!(values[(0, 39)].abs() < 0.6 * 3.2, "the log wraps");
        unwrap(&mut values, 0);
        assert!(angles.iter().enumerate().all(|(k, angle)| (values.column(k) - axis * *angle).norm() < 1e-9));
    }

    #[test]
    fn progress_of_a_cycle_is_its_way() {
        let cycle = synthetic::subject(Activity::Walking, 1).cycle(1.2, 0);
        let example = Example::of_cycle("a", &cycle);
        assert!((example.stride * cycle.hip_height_m - 1.2 * cycle.duration_s).abs() < 1e-12);
        let curves = example.curves(&[UnitQuaternion::identity(); BALL_JOINTS]);
        let times = curves.times();
        let z = |t: f64| curves.at(&times, t)[PROGRESS];
        assert!((z(0.4) - cycle.root[40].position.z - 0.4 * example.stride).abs() < 1e-12);
        // The end of the cycle is its start a stride ahead, and interpolation runs through it.
        assert!((z(1.0) - z(0.0) - example.stride).abs() < 1e-12);
        let (before, after) = (z(0.995), z(0.005) + example.stride);
        assert!((0.5 * (before + after) - z(1.0)).abs() < 1e-3);
    }
}

//! Blends of an artist's key poses.
//!
//! Of every bone the rotations q_i are written about their mean, q_i = q̄ exp(v_i), and blended as q̄ exp(Σ w_i v_i);
//! positions as x̄ + Σ w_i (x_i − x̄). Equation (14) of the animal paper on rotation vectors; about the mean, so that no
//! representation's poles matter and weights that do not sum to 1 shrink towards the mean pose, not towards zero.
//! Exact at the keys. Checked against them and against half a turn between two.

use nalgebra::{UnitQuaternion, Vector3};

use super::creature::{Local, Posture};
use crate::math::rotation::{exp, log, mean};

/// Key poses as offsets from their mean.
#[derive(Clone, Debug)]
pub struct PoseSpace {
    mean: Posture,
    /// Per key and bone: rotation vector and translation against the mean.
    offsets: Vec<Vec<(Vector3<f64>, Vector3<f64>)>>,
}

impl PoseSpace {
    /// All poses of one skeleton; `None` without poses.
    pub fn new(poses: &[Posture]) -> Option<PoseSpace> {
        let first = poses.first()?;
        let centre = |bone: usize| {
            let rotations: Vec<UnitQuaternion<f64>> = poses.iter().filter_map(|p| Some(p.get(bone)?.rotation)).collect();
            let translation = poses.iter().filter_map(|p| Some(p.get(bone)?.translation)).sum::<Vector3<f64>>() / poses.len() as f64;
            Local { translation, rotation: mean(&rotations).unwrap_or_default(), scale: first[bone].scale }
        };
        let mean: Posture = (0..first.len()).map(centre).collect();
        let offset =
            |(local, mean): (&Local, &Local)| (log(&(mean.rotation.inverse() * local.rotation)), local.translation - mean.translation);
        let offsets = poses.iter().map(|p| p.iter().zip(&mean).map(offset).collect()).collect();
        Some(PoseSpace { mean, offsets })
    }

    /// The pose of one weight per key.
    pub fn blend(&self, weights: &[f64]) -> Posture {
        let bone = |(k, mean): (usize, &Local)| {
            let (turn, step) = self
                .offsets
                .iter()
                .zip(weights)
                .fold((Vector3::zeros(), Vector3::zeros()), |(turn, step), (key, w)| (turn + key[k].0 * *w, step + key[k].1 * *w));
            Local { translation: mean.translation + step, rotation: mean.rotation * exp(&turn), scale: mean.scale }
        };
        self.mean.iter().enumerate().map(bone).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_come_back_and_the_middle_of_two_is_half_the_turn() {
        let pose = |x: f64, turn: Vector3<f64>| vec![Local { rotation: exp(&turn), ..Local::at(Vector3::new(x, 1.0, 0.0)) }];
        let poses = [pose(0.0, Vector3::new(0.0, 0.4, 0.0)), pose(2.0, Vector3::new(0.0, 2.0, 0.0))];
        let space = PoseSpace::new(&poses).unwrap();
        for (i, pose) in poses.iter().enumerate() {
            let found = space.blend(&[f64::from(u8::from(i == 0)), f64::from(u8::from(i == 1))]);
            assert!((found[0].translation - pose[0].translation).norm() < 1e-12 && found[0].rotation.angle_to(&pose[0].rotation) < 1e-9);
        }
        let middle = space.blend(&[0.5, 0.5]);
        assert!((log(&middle[0].rotation).y - 1.2).abs() < 1e-9 && (middle[0].translation.x - 1.0).abs() < 1e-12);
        // Beyond the hull the turn goes on.
        assert!((log(&space.blend(&[-0.5, 1.5])[0].rotation).y - 2.8).abs() < 1e-9);
        assert!(PoseSpace::new(&[]).is_none());
    }
}

//! What of a tracked motion the weights of a model do not hold, in as few numbers as a file needs.
//!
//! In the coordinates of the motion vector (joints) and of the root channels, over the phase μ:
//!   r(μ) = a_0 + Σ_k a_k cos 2πkμ + b_k sin 2πkμ.                                                                 (1)
//! Of the root's position only the height is held, as a constant: the rest follows from the weights.
//! Checked against the sum written out, and in `fit::own_motion` against motions that depart in a known way.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use super::cycle::{ROOT_CHANNELS, SAMPLES};
use super::model::Detail;
use crate::body::{DOF, Joint};

/// Series (1) of some joints and of the root's rotation.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Departure {
    /// By joint, `humanoid_root` for the root's rotation against the heading: a_0, a_1, b_1, a_2, b_2, … in radians.
    pub turns: BTreeMap<String, Vec<[f64; 3]>>,
    /// Height of the root in hip heights.
    pub root_height: f64,
}

/// Values of the functions of (1) at a phase: 1, cos, sin, cos 2·, sin 2·, …
pub fn harmonics(phase: f64, count: usize) -> impl Iterator<Item = f64> {
    let turn = move |k: usize| TAU * phase * k.div_ceil(2) as f64;
    (0..count).map(move |k| match k {
        0 => 1.0,
        k if k % 2 == 1 => turn(k).cos(),
        k => turn(k).sin(),
    })
}

impl Departure {
    /// Why it can be none of a person's, if so.
    pub fn fault(&self) -> Option<String> {
        let known = |name: &String| Joint::ALL.iter().any(|j| j.name() == name);
        if let Some(name) = self.turns.keys().find(|name| !known(name)) {
            return Some(format!("departure of a joint `{name}`, which this body has not"));
        }
        let whole = |s: &Vec<[f64; 3]>| s.len() % 2 == 1 && s.len() < SAMPLES && s.iter().flatten().all(|v| v.is_finite());
        let fits = self.turns.values().all(whole) && self.root_height.is_finite();
        (!fits).then(|| "departure must hold an odd number of finite coefficients per joint".to_string())
    }

    /// Sample by sample.
    pub fn detail(&self) -> Detail {
        let (mut vector, mut root) = (DVector::zeros(SAMPLES * DOF), DVector::zeros(SAMPLES * ROOT_CHANNELS));
        for joint in Joint::ALL {
            let Some(series) = self.turns.get(joint.name()) else { continue };
            let (rows, width, first) = match joint as usize {
                0 => (&mut root, ROOT_CHANNELS, 0),
                k => (&mut vector, DOF, 3 * (k - 1)),
            };
            for sample in 0..SAMPLES {
                for (a, f) in series.iter().zip(harmonics(sample as f64 / SAMPLES as f64, series.len())) {
                    (0..3).for_each(|axis| rows[sample * width + first + axis] += a[axis] * f);
                }
            }
        }
        (0..SAMPLES).for_each(|sample| root[sample * ROOT_CHANNELS + 4] += self.root_height);
        Detail { vector, root }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_the_series_written_out() {
        let series = vec![[0.1, 0.0, -0.2], [0.02, 0.03, 0.0], [0.0, -0.01, 0.05], [0.0, 0.0, 0.004], [0.007, 0.0, 0.0]];
        let turns = [("l_knee".to_string(), series.clone()), ("humanoid_root".to_string(), vec![[0.3, -0.1, 0.2]])];
        let departure = Departure { turns: turns.into(), root_height: 0.01 };
        assert_eq!(departure.fault(), None);
        let detail = departure.detail();
        let knee = 3 * (Joint::LKnee as usize - 1);
        for (sample, axis) in [(0, 0), (13, 1), (50, 2), (99, 0)] {
            let u = TAU * sample as f64 / 100.0;
            let a = |k: usize| series[k][axis];
            let wanted = a(0) + a(1) * u.cos() + a(2) * u.sin() + a(3) * (2.0 * u).cos() + a(4) * (2.0 * u).sin();
            assert!((detail.vector[sample * DOF + knee + axis] - wanted).abs() < 1e-12);
            assert_eq!(detail.root[sample * ROOT_CHANNELS + axis], [0.3, -0.1, 0.2][axis]);
            assert_eq!(detail.root[sample * ROOT_CHANNELS + 4], 0.01);
        }
        assert_eq!(detail.vector.iter().filter(|v| **v != 0.0).count(), 300);
        let elsewhere = Departure { turns: [("tail".to_string(), vec![[0.0; 3]])].into(), root_height: 0.0 };
        assert!(elsewhere.fault().unwrap().contains("`tail`"));
        let even = Departure { turns: [("l_knee".to_string(), vec![[0.0; 3]; 2])].into(), root_height: 0.0 };
        assert!(even.fault().is_some());
    }
}

//! Angles about three axes in any order, R = R_i(a) R_j(b) R_k(c).
//!
//! With e = 1 where i, j, k are cyclic and −1 elsewhere: sin b = e R_ik, a = atan2(−e R_jk, R_kk), c = atan2(−e R_ij, R_ii).
//! At sin b = ±1 only a ± e c is determined. Checked by multiplying back, in all six orders and in gimbal lock.

use std::str::FromStr;

use nalgebra::{UnitQuaternion, Vector3};

/// Three different axes (0 x, 1 y, 2 z) in the order in which their rotations are multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Order([usize; 3]);

impl Order {
    pub const ZXY: Order = Order([2, 0, 1]);

    pub fn axes(self) -> [usize; 3] {
        self.0
    }

    /// Capital letters, as `ZXY`.
    pub fn name(self) -> String {
        self.0.map(|axis| ["X", "Y", "Z"][axis]).concat()
    }
}

impl FromStr for Order {
    type Err = String;

    fn from_str(text: &str) -> Result<Order, String> {
        let axes: Vec<usize> = text.chars().filter_map(|c| "xyz".find(c.to_ascii_lowercase())).collect();
        match axes[..] {
            [i, j, k] if text.len() == 3 && i != j && j != k && i != k => Ok(Order([i, j, k])),
            _ => Err("must be an order of the three axes, such as zxy or xyz".into()),
        }
    }
}

/// The angles a, b, c in radians; of the two solutions and their turns the one nearest to `previous`, so that curves stay smooth.
pub fn near(rotation: &UnitQuaternion<f64>, order: Order, previous: &[f64; 3]) -> [f64; 3] {
    use std::f64::consts::{PI, TAU};
    let r = rotation.to_rotation_matrix();
    let [i, j, k] = order.0;
    let e = if j == (i + 1) % 3 { 1.0 } else { -1.0 };
    let sine = (e * r[(i, k)]).clamp(-1.0, 1.0);
    let main = if sine.abs() < 1.0 - 1e-12 {
        [(-e * r[(j, k)]).atan2(r[(k, k)]), sine.asin(), (-e * r[(i, j)]).atan2(r[(i, i)])]
    } else {
        [(e * r[(k, j)]).atan2(r[(j, j)]) - e * sine.signum() * previous[2], sine.asin(), previous[2]]
    };
    let other = [main[0] + PI, PI - main[1], main[2] + PI];
    let turned = |angles: [f64; 3]| -> [f64; 3] { std::array::from_fn(|n| angles[n] - TAU * ((angles[n] - previous[n]) / TAU).round()) };
    let distance = |a: &[f64; 3]| a.iter().zip(previous).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let (main, other) = (turned(main), turned(other));
    if distance(&main) <= distance(&other) { main } else { other }
}

/// R_i(a) R_j(b) R_k(c).
pub fn rotation(order: Order, angles: &[f64; 3]) -> UnitQuaternion<f64> {
    let turn = |n: usize| UnitQuaternion::from_axis_angle(&Vector3::ith_axis(order.0[n]), angles[n]);
    turn(0) * turn(1) * turn(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_multiply_back_in_every_order() {
        for name in ["xyz", "XZY", "yxz", "yzx", "zxy", "zyx"] {
            let order: Order = name.parse().unwrap();
            assert_eq!(order.name(), name.to_uppercase());
            for n in 0..200 {
                let t = n as f64;
                let wanted = [3.0 * (1.3 * t).sin(), 1.5 * (0.7 * t).cos(), 9.0 * (0.4 * t).sin()];
                let turned = rotation(order, &wanted);
                let found = near(&turned, order, &wanted);
                assert!((0..3).all(|k| (found[k] - wanted[k]).abs() < 1e-9), "{name}: {wanted:?} {found:?}");
                assert!(rotation(order, &near(&turned, order, &[0.0; 3])).angle_to(&turned) < 1e-7);
            }
        }
        for wrong in ["xyx", "xy", "xyzz", "abc", ""] {
            assert!(wrong.parse::<Order>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn gimbal_lock_keeps_the_rotation() {
        for name in ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"] {
            let order: Order = name.parse().unwrap();
            for sign in [1.0, -1.0] {
                let lock = rotation(order, &[0.7, sign * std::f64::consts::FRAC_PI_2, 0.0]);
                let angles = near(&lock, order, &[0.1, 0.2, 0.3]);
                assert!(rotation(order, &angles).angle_to(&lock) < 1e-7, "{name} {angles:?}");
                assert_eq!(angles[2], 0.3);
            }
        }
    }
}

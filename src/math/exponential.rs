//! e^x for x ≤ 0 without a branch, so that the compiler does several at once.
//!
//! x = n ln 2 + r with |r| ≤ ½ ln 2 gives 2^n Σ_{k≤12} r^k/k!. Arguments below −700 count as −700.
//! Checked against the library's.

use std::f64::consts::LOG2_E;

/// 1.5 · 2⁵²: a number added to it is rounded to a whole one, which the lowest bits then hold.
const WHOLE: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts, the first short enough for exact multiples.
const LN_2: [f64; 2] = [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10];
/// 1/k! from k = 12 down to 0.
const TERMS: [f64; 13] = [
    1.0 / 479_001_600.0,
    1.0 / 39_916_800.0,
    1.0 / 3_628_800.0,
    1.0 / 362_880.0,
    1.0 / 40_320.0,
    1.0 / 5_040.0,
    1.0 / 720.0,
    1.0 / 120.0,
    1.0 / 24.0,
    1.0 / 6.0,
    0.5,
    1.0,
    1.0,
];

/// e^x for x ≤ 0, to a relative 5e-16.
#[inline(always)]
pub fn exp_of_negative(x: f64) -> f64 {
    let x = if x < -700.0 { -700.0 } else { x };
    let shifted = x * LOG2_E + WHOLE;
    let n = shifted - WHOLE;
    let r = (x - n * LN_2[0]) - n * LN_2[1];
    let sum = TERMS[1..].iter().fold(TERMS[0], |sum, term| sum * r + term);
    sum * f64::from_bits((shifted.to_bits() << 52).wrapping_add(1f64.to_bits()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn meets_the_library() {
        for i in 0..200_000 {
            let x = -0.0035 * f64::from(i);
            let (found, expected) = (exp_of_negative(x), x.exp());
            assert!((found - expected).abs() <= 5e-16 * expected, "{x}: {found} {expected}");
        }
        assert_eq!(exp_of_negative(0.0), 1.0);
        assert!(exp_of_negative(-1e9) < 1e-300 && exp_of_negative(f64::NEG_INFINITY) < 1e-300);
        assert!(exp_of_negative(f64::NAN).is_nan());
    }
}

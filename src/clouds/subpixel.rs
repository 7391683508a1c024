//! Disparity between whole hypotheses.
//!
//! Sums of absolute differences form a V about their minimum, so the equiangular fit
//!   δ = (c₋ − c₊) / (2 (max(c₋, c₊) − c))                                                           (1)
//! suits them (a parabola would pull towards whole disparities). The path sums of [`super::correlate`] raise both
//! neighbours by up to P1 per path, which pulls too; as much of it as the lower neighbour shows is taken off both.

use super::correlate::STEP_PENALTIES;

/// P1 of the three paths together.
const RAISED: f32 = 3.0 * STEP_PENALTIES[0] as f32;

/// Part of the lower neighbour's rise that is taken for the penalty at most: on weak texture paths have not reached P1, and
/// taking off all would turn noise into offsets. Of 0.5, 0.75 and 0.9 the first had the least error on rendered people.
const LARGEST_PART: f32 = 0.5;

/// Offset δ of equation (1) from the costs just below, at and just above a minimum; `None` at the end of the search range.
pub fn equiangular([below, at, above]: [u8; 3]) -> Option<f32> {
    if below == u8::MAX || above == u8::MAX {
        return None;
    }
    let (below, above) = (f32::from(below) - f32::from(at), f32::from(above) - f32::from(at));
    let raised = RAISED.min(LARGEST_PART * below.min(above));
    let slope = below.max(above) - raised;
    Some(if slope > 0.0 { (below - above) / (2.0 * slope) } else { 0.0 })
}

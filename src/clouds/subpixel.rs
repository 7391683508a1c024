//! Disparity between whole pixels.
//!
//! Sums of absolute differences form a V about their minimum, so the equiangular fit
//!   δ = (c₋ − c₊) / (2 (max(c₋, c₊) − c))                                                           (1)
//! is the right one (a parabola would pull towards whole disparities).

/// Offset δ of equation (1) from the costs just below, at and just above a minimum; `None` at the end of the search range.
pub fn equiangular([below, at, above]: [u8; 3]) -> Option<f32> {
    if below == u8::MAX || above == u8::MAX {
        return None;
    }
    let slope = f32::from(below.max(above)) - f32::from(at);
    Some(if slope > 0.0 { (f32::from(below) - f32::from(above)) / (2.0 * slope) } else { 0.0 })
}

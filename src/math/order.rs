//! Order statistics.

/// The value below which a share `q` of `values` lies (0.5: the median, the upper of two); `None` for none.
pub fn quantile(mut values: Vec<f64>, q: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let at = ((q * values.len() as f64) as usize).min(last);
    Some(*values.select_nth_unstable_by(at, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_lie_below() {
        let values: Vec<f64> = (0..100).map(|i| f64::from(i * 37 % 100)).collect();
        for q in [0.0, 0.1, 0.5, 0.95] {
            let found = quantile(values.clone(), q).unwrap();
            assert_eq!(values.iter().filter(|v| **v < found).count(), (100.0 * q) as usize);
        }
        assert_eq!((quantile(values, 1.0), quantile(vec![], 0.5)), (Some(99.0), None));
    }
}

//! Quantiles.

/// The value below which `share` (0 to 1) of the values lie, interpolated between neighbours; `sorted` ascends. None of none.
pub fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let at = share * sorted.len().checked_sub(1)? as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    Some(below + at.fract() * (above - below))
}

/// The [`quantile`] of values in any order.
pub fn quantile_of(mut values: Vec<f64>, share: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    quantile(&values, share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_interpolated_by_rank() {
        let values: Vec<f64> = (0..=100).rev().map(f64::from).collect();
        let at = |share| quantile_of(values.clone(), share).unwrap();
        for (share, expected) in [(0.0, 0.0), (0.5, 50.0), (0.955, 95.5), (1.0, 100.0)] {
            assert!((at(share) - expected).abs() < 1e-9, "{share}");
        }
        assert_eq!(quantile(&[3.0], 0.95), Some(3.0));
        assert_eq!(quantile(&[], 0.5), None);
    }
}

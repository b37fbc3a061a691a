//! Ranges that settings draw numbers from.

use rand::{Rng, RngExt as _};

use crate::SimError;

/// Refuses a setting that is no range from low to high within these bounds.
pub(crate) fn check_range(
    name: &str,
    [low, high]: [f64; 2],
    least: f64,
    most: f64,
) -> Result<(), SimError> {
    // Comparisons with NaN are false.
    if least <= low && low <= high && high <= most {
        return Ok(());
    }
    Err(SimError::Setting {
        name: name.to_owned(),
        expected: format!("a range from low to high within {least:e} and {most:e}"),
        found: format!("{low} to {high}"),
    })
}

/// A number from `range`, or `nominal` where there is none; draws one from `rng` either way.
pub(crate) fn within(range: Option<[f64; 2]>, nominal: f64, rng: &mut impl Rng) -> f64 {
    let share: f64 = rng.random();
    range.map_or(nominal, |[low, high]| low + share * (high - low))
}

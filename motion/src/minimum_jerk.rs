//! The course of a smooth movement.

/// Largest slope of [`minimum_jerk`], at its middle: peak speed over mean speed.
pub const MINIMUM_JERK_PEAK: f64 = 1.875;

/// The minimum-jerk course from 0 to 1, at rest at both ends: 10 τ³ − 15 τ⁴ + 6 τ⁵ (Flash and Hogan: The coordination of arm
/// movements, J. Neurosci. 1985). `progress` is the share of the movement's time that has passed; beyond 0 and 1 it rests.
#[must_use]
pub fn minimum_jerk(progress: f64) -> f64 {
    let s = progress.clamp(0.0, 1.0);
    s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_starts_and_ends_at_rest() {
        assert_eq!(
            [-1.0, 0.0, 0.5, 1.0, 2.0].map(minimum_jerk),
            [0.0, 0.0, 0.5, 1.0, 1.0]
        );
        let slope = |t: f64| (minimum_jerk(t + 1e-4) - minimum_jerk(t - 1e-4)) / 2e-4;
        assert!(slope(0.0).abs() < 1e-6 && slope(1.0).abs() < 1e-6);
        assert!((slope(0.5) - MINIMUM_JERK_PEAK).abs() < 1e-6);
    }
}

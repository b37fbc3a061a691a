//! Angles between directions and between rotations, radians, exact where they are small.

use nalgebra::{Matrix3, Vector3};

/// Angle between two unit vectors; exact near 0 and π.
pub(super) fn angle_between(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    2.0 * (a - b).norm().atan2((a + b).norm())
}

/// Angle between two rotations: `‖R − R̂‖² = 8 sin²(θ/2)` is exact near 0, where a trace's arc cosine is not.
pub(super) fn turn_between(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    2.0 * ((a - b).norm() / 8f64.sqrt()).min(1.0).asin()
}

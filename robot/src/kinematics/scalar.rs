//! The two number types of the kinematics.

use std::ops::{Add, Mul, Neg, Sub};

/// What the kinematics needs of a number.
pub trait Scalar:
    Copy
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Neg<Output = Self>
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// Rounds to this type.
    fn from_f64(value: f64) -> Self;
    /// Sine and cosine of an angle.
    fn sin_cos(self) -> (Self, Self);
}

impl Scalar for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    fn from_f64(value: f64) -> Self {
        value as f32
    }

    fn sin_cos(self) -> (Self, Self) {
        Self::sin_cos(self)
    }
}

impl Scalar for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    fn from_f64(value: f64) -> Self {
        value
    }

    fn sin_cos(self) -> (Self, Self) {
        Self::sin_cos(self)
    }
}

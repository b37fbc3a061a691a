//! The two number types of the kinematics.

use std::ops::{Add, Mul, Neg, Sub};

use super::Kinematics;
use super::tree::Tree;

/// `f32` or `f64`. Sealed: nothing else implements it.
pub trait Real: Scalar {}

impl Real for f32 {}
impl Real for f64 {}

/// What the kinematics needs of a number; out of reach from outside, which seals [`Real`].
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
    /// The tree with its constants in this type.
    fn tree(kinematics: &Kinematics) -> &Tree<Self>;
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

    fn tree(kinematics: &Kinematics) -> &Tree<Self> {
        &kinematics.single
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

    fn tree(kinematics: &Kinematics) -> &Tree<Self> {
        &kinematics.double
    }
}

//! A few poses side by side, so that the compiler turns one operation on all of them into vector instructions.

use std::array;
use std::ops::{Add, AddAssign, Mul, Neg, Sub};

use super::scalar::Scalar;

/// Poses that are worked on at once.
pub(super) const LANES: usize = 8;

/// One number of each of [`LANES`] poses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lane<T>(pub(super) [T; LANES]);

/// A vector of each pose.
pub(super) type Vec3<T> = [Lane<T>; 3];

impl<T: Scalar> Lane<T> {
    pub(super) const ZERO: Self = Self([T::ZERO; LANES]);
    pub(super) const ONE: Self = Self([T::ONE; LANES]);

    /// Sine and cosine.
    pub(super) fn sin_cos(self) -> (Self, Self) {
        let mut sine = Self::ZERO;
        let mut cosine = Self::ZERO;
        for i in 0..LANES {
            (sine.0[i], cosine.0[i]) = self.0[i].sin_cos();
        }
        (sine, cosine)
    }
}

impl<T: Scalar> Add for Lane<T> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(array::from_fn(|i| self.0[i] + other.0[i]))
    }
}

impl<T: Scalar> AddAssign for Lane<T> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl<T: Scalar> Sub for Lane<T> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(array::from_fn(|i| self.0[i] - other.0[i]))
    }
}

impl<T: Scalar> Mul for Lane<T> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(array::from_fn(|i| self.0[i] * other.0[i]))
    }
}

/// By a number that is the same in all poses.
impl<T: Scalar> Mul<T> for Lane<T> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, factor: T) -> Self {
        Self(array::from_fn(|i| self.0[i] * factor))
    }
}

impl<T: Scalar> Neg for Lane<T> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        Self(array::from_fn(|i| -self.0[i]))
    }
}

/// a + b.
#[inline(always)]
pub(super) fn sum<T: Scalar>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// a − b.
#[inline(always)]
pub(super) fn difference<T: Scalar>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// a × b.
#[inline(always)]
pub(super) fn cross<T: Scalar>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// a · b.
#[inline(always)]
pub(super) fn dot<T: Scalar>(a: Vec3<T>, b: Vec3<T>) -> Lane<T> {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

//! What the kernel needs of a processor, for the kinds of processors that it knows.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::_MM_HINT_T0;

use pulp::cast;
#[cfg(target_arch = "x86_64")]
use pulp::{
    f32x8, f32x16,
    x86::{V3, V4},
};

/// Arithmetic on vectors of `LANES` floats.
pub(super) trait Machine<const LANES: usize>: Copy {
    /// The vectors.
    type Vector: Copy;

    fn splat(self, value: f32) -> Self::Vector;

    fn load(self, values: &[f32; LANES]) -> Self::Vector;

    fn store(self, vector: Self::Vector) -> [f32; LANES];

    /// `a · b + sum`.
    fn multiply_add(self, a: Self::Vector, b: Self::Vector, sum: Self::Vector) -> Self::Vector;

    /// Converts the bits of finite f16s, exactly.
    fn widen(self, bits: &[u16; LANES]) -> Self::Vector;

    /// Asks for the cache line at `address`, which need not exist, before it is needed.
    fn prefetch<T>(self, address: *const T);
}

/// x86-64 with AVX-512.
#[cfg(target_arch = "x86_64")]
impl Machine<16> for V4 {
    type Vector = f32x16;

    #[inline(always)]
    fn splat(self, value: f32) -> f32x16 {
        self.splat_f32x16(value)
    }

    #[inline(always)]
    fn load(self, values: &[f32; 16]) -> f32x16 {
        cast(*values)
    }

    #[inline(always)]
    fn store(self, vector: f32x16) -> [f32; 16] {
        cast(vector)
    }

    #[inline(always)]
    fn multiply_add(self, a: f32x16, b: f32x16, sum: f32x16) -> f32x16 {
        self.mul_add_f32x16(a, b, sum)
    }

    #[inline(always)]
    fn widen(self, bits: &[u16; 16]) -> f32x16 {
        cast(self.avx512f._mm512_cvtph_ps(cast(*bits)))
    }

    #[inline(always)]
    fn prefetch<T>(self, address: *const T) {
        prefetch(*self, address);
    }
}

/// x86-64 with AVX2 and fused multiply-add.
#[cfg(target_arch = "x86_64")]
impl Machine<8> for V3 {
    type Vector = f32x8;

    #[inline(always)]
    fn splat(self, value: f32) -> f32x8 {
        self.splat_f32x8(value)
    }

    #[inline(always)]
    fn load(self, values: &[f32; 8]) -> f32x8 {
        cast(*values)
    }

    #[inline(always)]
    fn store(self, vector: f32x8) -> [f32; 8] {
        cast(vector)
    }

    #[inline(always)]
    fn multiply_add(self, a: f32x8, b: f32x8, sum: f32x8) -> f32x8 {
        self.mul_add_f32x8(a, b, sum)
    }

    #[inline(always)]
    fn widen(self, bits: &[u16; 8]) -> f32x8 {
        let V3 { avx, avx2, .. } = self;
        let bits = avx2._mm256_cvtepu16_epi32(cast(*bits));
        let magnitude = avx2._mm256_and_si256(bits, avx._mm256_set1_epi32(0x7fff));
        let magnitude = cast(avx2._mm256_slli_epi32::<13>(magnitude));
        let magnitude = cast(avx._mm256_mul_ps(magnitude, avx._mm256_set1_ps(BIAS)));
        let sign = avx2._mm256_and_si256(bits, avx._mm256_set1_epi32(0x8000));
        let sign = avx2._mm256_slli_epi32::<16>(sign);
        cast(avx2._mm256_or_si256(magnitude, sign))
    }

    #[inline(always)]
    fn prefetch<T>(self, address: *const T) {
        prefetch(self, address);
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn prefetch<T>(machine: V3, address: *const T) {
    machine.sse._mm_prefetch::<_MM_HINT_T0>(address.cast());
}

/// Any processor: the compiler makes vector code of arrays where it can.
#[derive(Clone, Copy)]
pub(super) struct Portable;

impl Machine<4> for Portable {
    type Vector = [f32; 4];

    #[inline(always)]
    fn splat(self, value: f32) -> [f32; 4] {
        [value; 4]
    }

    #[inline(always)]
    fn load(self, values: &[f32; 4]) -> [f32; 4] {
        *values
    }

    #[inline(always)]
    fn store(self, vector: [f32; 4]) -> [f32; 4] {
        vector
    }

    /// Not fused: without an instruction for it, a fused one takes a hundred times as long.
    #[inline(always)]
    fn multiply_add(self, a: [f32; 4], b: [f32; 4], sum: [f32; 4]) -> [f32; 4] {
        let mut answer = sum;
        for ((answer, a), b) in answer.iter_mut().zip(a).zip(b) {
            *answer += a * b;
        }
        answer
    }

    #[inline(always)]
    fn widen(self, bits: &[u16; 4]) -> [f32; 4] {
        let mut answer = [0.0; 4];
        for (answer, &bits) in answer.iter_mut().zip(bits) {
            *answer = widen(bits);
        }
        answer
    }

    #[inline(always)]
    fn prefetch<T>(self, _address: *const T) {}
}

/// 2¹¹²: the exponents' biases are 127 and 15.
const BIAS: f32 = f32::from_bits((127 + 112) << 23);

/// The finite f16 of these bits as f32, exactly, in operations that vectors have: its exponent is put right by a multiplication, which
/// normalises what is subnormal.
#[inline(always)]
fn widen(bits: u16) -> f32 {
    let bits = u32::from(bits);
    let magnitude = f32::from_bits((bits & 0x7fff) << 13) * BIAS;
    f32::from_bits(magnitude.to_bits() | (bits & 0x8000) << 16)
}

#[cfg(test)]
mod tests {
    use super::*;
    use half::f16;

    #[test]
    fn every_finite_half_is_widened_exactly() {
        for bits in 0..=u16::MAX {
            let half = f16::from_bits(bits);
            if half.is_finite() {
                assert_eq!(widen(bits).to_bits(), half.to_f32().to_bits(), "{half}");
            }
        }
    }
}

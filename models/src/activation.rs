//! ELU as one op, in vector code: candle's own takes eight passes over memory on the way back.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Shape, Tensor, bail};
use pulp::Arch;

/// `x` where it is positive, `eˣ − 1` elsewhere.
///
/// # Errors
/// When `x` is not f32.
pub fn elu(x: &Tensor) -> candle_core::Result<Tensor> {
    x.contiguous()?.apply_op1(Elu)
}

/// Replaces numbers by their ELU.
pub fn elu_in_place(numbers: &mut [f32]) {
    Arch::new().dispatch(|| apply_elu(numbers));
}

/// Turns the gradients of ELU's answers into those of its arguments.
pub fn elu_slope_in_place(gradients: &mut [f32], answers: &[f32]) {
    Arch::new().dispatch(|| {
        for (gradient, answer) in gradients.iter_mut().zip(answers) {
            *gradient *= answer.min(0.0) + 1.0;
        }
    });
}

struct Elu;

impl CustomOp1 for Elu {
    fn name(&self) -> &'static str {
        "elu"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let x = values(x, layout)?;
        let mut out = x.to_vec();
        elu_in_place(&mut out);
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    fn bwd(&self, _x: &Tensor, y: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let grad = grad.contiguous()?;
        Ok(Some(y.contiguous()?.apply_op2_no_bwd(&grad, &Slope)?))
    }
}

/// The gradient of [`Elu`]'s argument from its answer and that answer's gradient.
struct Slope;

impl CustomOp2 for Slope {
    fn name(&self) -> &'static str {
        "elu slope"
    }

    fn cpu_fwd(
        &self,
        y: &CpuStorage,
        y_layout: &Layout,
        grad: &CpuStorage,
        grad_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (y, grad) = (values(y, y_layout)?, values(grad, grad_layout)?);
        let mut out = grad.to_vec();
        elu_slope_in_place(&mut out, y);
        Ok((CpuStorage::F32(out), y_layout.shape().clone()))
    }
}

fn values<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(values), Some((start, end))) => Ok(&values[start..end]),
        _ => bail!("elu takes contiguous f32 tensors, got the layout {layout:?}"),
    }
}

/// Replaces numbers by their ELU, in the vectors of whatever processor the caller is compiled for.
#[inline(always)]
pub(crate) fn apply_elu(numbers: &mut [f32]) {
    for x in numbers {
        let negative = exp_non_positive(x.min(0.0)) - 1.0;
        *x = if *x > 0.0 { *x } else { negative };
    }
}

/// `eˣ` for x ≤ 0 (e⁻⁸⁷ below −87), within 2 units in the last place, without branches: the compiler makes vector code of it.
#[inline(always)]
fn exp_non_positive(x: f32) -> f32 {
    /// ln 2 in two parts, so that `x − n ln 2` is exact.
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    /// Adding it rounds to an integer, which is then in the low bits.
    const ROUND: f32 = 12_582_912.0;
    /// Cephes' polynomial for (eʳ − 1 − r) / r² on |r| ≤ ½ ln 2, highest power first.
    const POLYNOMIAL: [f32; 6] = [
        1.987_569_1e-4,
        1.398_199_9e-3,
        8.333_452e-3,
        4.166_579_6e-2,
        1.666_666_5e-1,
        0.5,
    ];
    let x = x.max(-87.0);
    let n = (x * std::f32::consts::LOG2_E + ROUND) - ROUND;
    let r = (x - n * LN_2[0]) - n * LN_2[1];
    let polynomial = POLYNOMIAL.iter().fold(0.0, |sum, c| sum * r + c);
    let fraction = polynomial * r * r + r + 1.0;
    // 2ⁿ by its exponent bits; n is between −126 and 0.
    let power = ((n + ROUND).to_bits() << 23).wrapping_add(127 << 23);
    fraction * f32::from_bits(power)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn inputs() -> Vec<f32> {
        (-900..=300).map(|i| i as f32 * 0.1).collect()
    }

    #[test]
    fn the_exponential_is_right_to_the_last_places() {
        for x in inputs().into_iter().filter(|x| *x <= 0.0) {
            let expected = f64::from(x).exp();
            let error = (f64::from(exp_non_positive(x)) - expected).abs();
            assert!(error <= 2.5e-7 * expected + 2e-38, "{x}: {error}");
        }
    }

    #[test]
    fn answers_and_gradients_equal_candles() {
        let x = Var::new(inputs(), &Device::Cpu).unwrap();
        let run = |y: Tensor| {
            let grads = y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            let grad = grads.get(&x).unwrap().to_vec1::<f32>().unwrap();
            [y.to_vec1::<f32>().unwrap(), grad].concat()
        };
        let (ours, theirs) = (run(elu(&x).unwrap()), run(x.elu(1.0).unwrap()));
        for (a, b) in ours.iter().zip(theirs) {
            assert!((a - b).abs() < 1e-5 * b.abs().max(1.0), "{a} {b}");
        }
    }

    #[test]
    fn other_types_are_refused() {
        let x = Tensor::zeros(3, candle_core::DType::F64, &Device::Cpu).unwrap();
        assert!(elu(&x).is_err());
    }
}

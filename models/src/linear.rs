//! Linear layers: one op, forward and backward, over `faer`'s matrix multiply.
//!
//! Everything that trains or serves runs its matrix products through this module, so that a faster kernel serves both.
//! Answers equal candle's own `matmul` up to the order of summation: within `1e-5 · √k` for operands of unit size.

use std::cell::Cell;

use candle_core::{CpuStorage, CustomOp2, CustomOp3, DType, Layout, Shape, Tensor, bail};
use candle_nn::VarBuilder;
use faer::{Accum, MatMut, MatRef, Par, linalg::matmul::matmul};

thread_local! {
    static THREADS: Cell<usize> = const { Cell::new(1) };
}

/// Sets how many threads the matrix products that this thread starts may use; 1 by default.
///
/// Serving keeps one thread a model; a trainer that owns the machine raises it.
pub fn set_threads(threads: usize) {
    THREADS.set(threads.max(1));
}

/// How many threads the calling thread's products may use.
pub(crate) fn threads() -> usize {
    THREADS.get()
}

fn parallelism(work: usize) -> Par {
    /// Below this many multiply-adds, waking a second thread costs more than it saves.
    const PARALLEL_WORK: usize = 1 << 20;
    match threads() {
        1 => Par::Seq,
        threads if work >= PARALLEL_WORK => Par::rayon(threads),
        _ => Par::Seq,
    }
}

/// A row-major matrix, possibly to be read transposed.
#[derive(Clone, Copy)]
struct Operand<'a, T> {
    data: &'a [T],
    rows: usize,
    cols: usize,
    transposed: bool,
}

impl<'a, T> Operand<'a, T> {
    fn view(self) -> MatRef<'a, T> {
        let view = MatRef::from_row_major_slice(self.data, self.rows, self.cols);
        if self.transposed {
            view.transpose()
        } else {
            view
        }
    }
}

/// `out (+)= a · b`, all row-major.
fn product<T: faer::traits::ComplexField>(
    out: &mut [T],
    accumulate: Accum,
    a: Operand<'_, T>,
    b: Operand<'_, T>,
) {
    let (a, b) = (a.view(), b.view());
    let parallelism = parallelism(a.nrows() * a.ncols() * b.ncols());
    let out = MatMut::from_row_major_slice_mut(out, a.nrows(), b.ncols());
    matmul(out, accumulate, a, b, T::one_impl(), parallelism);
}

/// `out = a · bᵀ` for row-major `a` (m × k) and `b` (n × k), on the calling thread's [`set_threads`] budget.
pub fn product_with_transpose(out: &mut [f32], a: &[f32], b: &[f32], k: usize) {
    let a = Operand {
        data: a,
        rows: a.len() / k,
        cols: k,
        transposed: false,
    };
    let b = Operand {
        data: b,
        rows: b.len() / k,
        cols: k,
        transposed: true,
    };
    product(out, Accum::Replace, a, b);
}

/// `out = aᵀ · b` for row-major `a` (n × m) and `b` (n × k), on the calling thread's [`set_threads`] budget.
pub fn product_of_transpose(out: &mut [f32], a: &[f32], m: usize, b: &[f32]) {
    let rows = a.len() / m;
    let a = Operand {
        data: a,
        rows,
        cols: m,
        transposed: true,
    };
    let b = Operand {
        data: b,
        rows,
        cols: b.len() / rows.max(1),
        transposed: false,
    };
    product(out, Accum::Replace, a, b);
}

/// `out = a · b` for row-major `a` (n × m) and `b` (m × k), on the calling thread's [`set_threads`] budget.
pub fn product_plain(out: &mut [f32], a: &[f32], m: usize, b: &[f32]) {
    let a = Operand {
        data: a,
        rows: a.len() / m,
        cols: m,
        transposed: false,
    };
    let b = Operand {
        data: b,
        rows: m,
        cols: b.len() / m,
        transposed: false,
    };
    product(out, Accum::Replace, a, b);
}

fn contiguous<'a, T>(data: &'a [T], layout: &Layout) -> candle_core::Result<&'a [T]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&data[start..end]),
        None => bail!("a linear op takes contiguous tensors, got the layout {layout:?}"),
    }
}

/// `y = x · wᵀ + b`.
struct LinearOp;

impl LinearOp {
    fn forward<T: faer::traits::ComplexField + Copy>(
        x: Operand<'_, T>,
        w: Operand<'_, T>,
        bias: &[T],
    ) -> Vec<T> {
        let mut out = Vec::with_capacity(x.rows * bias.len());
        for _ in 0..x.rows {
            out.extend_from_slice(bias);
        }
        product(&mut out, Accum::Add, x, w);
        out
    }
}

impl CustomOp3 for LinearOp {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        w: &CpuStorage,
        w_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (m, k) = x_layout.shape().dims2()?;
        let (n, w_k) = w_layout.shape().dims2()?;
        if k != w_k || bias_layout.shape().dims1()? != n {
            bail!(
                "linear: input {:?}, weight {:?} and bias {:?} do not fit",
                x_layout.shape(),
                w_layout.shape(),
                bias_layout.shape()
            );
        }
        macro_rules! run {
            ($variant:ident, $x:expr, $w:expr, $bias:expr) => {{
                let x = Operand {
                    data: contiguous($x, x_layout)?,
                    rows: m,
                    cols: k,
                    transposed: false,
                };
                let w = Operand {
                    data: contiguous($w, w_layout)?,
                    rows: n,
                    cols: k,
                    transposed: true,
                };
                CpuStorage::$variant(Self::forward(x, w, contiguous($bias, bias_layout)?))
            }};
        }
        let out = match (x, w, bias) {
            (CpuStorage::F32(x), CpuStorage::F32(w), CpuStorage::F32(b)) => run!(F32, x, w, b),
            (CpuStorage::F64(x), CpuStorage::F64(w), CpuStorage::F64(b)) => run!(F64, x, w, b),
            _ => bail!("linear: input, weight and bias must all be f32 or all be f64"),
        };
        Ok((out, Shape::from((m, n))))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _bias: &Tensor,
        _out: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let grad = grad.contiguous()?;
        let grad_x = if x.track_op() {
            Some(grad.apply_op2_no_bwd(&w.contiguous()?, &Product { transpose_a: false })?)
        } else {
            None
        };
        let (grad_w, grad_bias) = if w.track_op() {
            let grad_w = grad.apply_op2_no_bwd(&x.contiguous()?, &Product { transpose_a: true })?;
            let ones = Tensor::ones((grad.dim(0)?, 1), grad.dtype(), grad.device())?;
            let grad_bias = grad.apply_op2_no_bwd(&ones, &Product { transpose_a: true })?;
            (Some(grad_w), Some(grad_bias.flatten_all()?))
        } else {
            (None, None)
        };
        Ok((grad_x, grad_w, grad_bias))
    }
}

/// `a · b` or `aᵀ · b`: what the backward pass of [`LinearOp`] is made of.
struct Product {
    transpose_a: bool,
}

impl CustomOp2 for Product {
    fn name(&self) -> &'static str {
        "product"
    }

    fn cpu_fwd(
        &self,
        a: &CpuStorage,
        a_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (rows, cols) = a_layout.shape().dims2()?;
        let (k, n) = b_layout.shape().dims2()?;
        let (m, a_k) = if self.transpose_a {
            (cols, rows)
        } else {
            (rows, cols)
        };
        if a_k != k {
            bail!(
                "product: {:?} and {:?} do not fit",
                a_layout.shape(),
                b_layout.shape()
            );
        }
        macro_rules! run {
            ($variant:ident, $a:expr, $b:expr, $zero:expr) => {{
                let a = Operand {
                    data: contiguous($a, a_layout)?,
                    rows,
                    cols,
                    transposed: self.transpose_a,
                };
                let b = Operand {
                    data: contiguous($b, b_layout)?,
                    rows: k,
                    cols: n,
                    transposed: false,
                };
                let mut out = vec![$zero; m * n];
                product(&mut out, Accum::Replace, a, b);
                CpuStorage::$variant(out)
            }};
        }
        let out = match (a, b) {
            (CpuStorage::F32(a), CpuStorage::F32(b)) => run!(F32, a, b, 0f32),
            (CpuStorage::F64(a), CpuStorage::F64(b)) => run!(F64, a, b, 0f64),
            _ => bail!("product: both operands must be f32 or both f64"),
        };
        Ok((out, Shape::from((m, n))))
    }
}

/// A fully connected layer, `y = x · wᵀ + b`, with `weight` (out × in) and `bias` (out).
#[derive(Clone, Debug)]
pub struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    /// Takes `weight` and `bias` from `vars`, created uniformly within `±1/√inputs` where they do not exist.
    ///
    /// # Errors
    /// When `vars` holds tensors of those names with other shapes.
    pub fn new(inputs: usize, outputs: usize, vars: &VarBuilder<'_>) -> candle_core::Result<Self> {
        let bound = 1.0 / (inputs as f64).sqrt();
        let init = candle_nn::Init::Uniform {
            lo: -bound,
            up: bound,
        };
        Ok(Self {
            weight: vars.get_with_hints((outputs, inputs), "weight", init)?,
            bias: vars.get_with_hints(outputs, "bias", init)?,
        })
    }

    /// Applies the layer along the last dimension of `x`.
    ///
    /// # Errors
    /// When the last dimension is not the layer's input width, or `x` is not f32/f64 like the weights.
    pub fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        let mut dims = x.dims().to_vec();
        let Some(last) = dims.last_mut() else {
            bail!("linear: the input is a scalar")
        };
        let inputs = std::mem::replace(last, self.bias.dim(0)?);
        let rows = x.elem_count() / inputs.max(1);
        let flat = x.reshape((rows, inputs))?.contiguous()?;
        flat.apply_op3(&self.weight, &self.bias, LinearOp)?
            .reshape(dims)
    }

    /// The weights, outputs × inputs, and the bias.
    pub fn tensors(&self) -> (&Tensor, &Tensor) {
        (&self.weight, &self.bias)
    }

    /// The data type of the weights.
    pub fn dtype(&self) -> DType {
        self.weight.dtype()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn random(shape: (usize, usize), dtype: DType) -> Tensor {
        Tensor::randn(0f64, 1., shape, &Device::Cpu)
            .unwrap()
            .to_dtype(dtype)
            .unwrap()
    }

    #[test]
    fn equals_candles_matmul() {
        for (m, k, n) in [(1, 7, 3), (8, 64, 2048), (33, 855, 130), (0, 4, 5)] {
            let (x, w) = (random((m, k), DType::F32), random((n, k), DType::F32));
            let bias = random((1, n), DType::F32).flatten_all().unwrap();
            let ours = x.apply_op3_no_bwd(&w, &bias, &LinearOp).unwrap();
            assert_eq!(ours.dims(), &[m, n]);
            if m == 0 {
                continue;
            }
            let theirs = x
                .matmul(&w.t().unwrap())
                .unwrap()
                .broadcast_add(&bias)
                .unwrap();
            let error = (ours - theirs)
                .unwrap()
                .abs()
                .unwrap()
                .max_all()
                .unwrap()
                .to_scalar::<f32>()
                .unwrap();
            assert!(error <= 1e-5 * (k as f32).sqrt(), "{m}×{k}×{n}: {error}");
        }
    }

    #[test]
    fn gradients_equal_candles() {
        let x = Var::from_tensor(&random((6, 5), DType::F64)).unwrap();
        let w = Var::from_tensor(&random((4, 5), DType::F64)).unwrap();
        let b = Var::from_tensor(&random((1, 4), DType::F64).flatten_all().unwrap()).unwrap();
        let loss = |y: Tensor| y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
        let ours = loss(x.apply_op3(&w, &b, LinearOp).unwrap());
        let theirs = loss(
            x.matmul(&w.t().unwrap())
                .unwrap()
                .broadcast_add(&b)
                .unwrap(),
        );
        for var in [&x, &w, &b] {
            let (a, b) = (ours.get(var).unwrap(), theirs.get(var).unwrap());
            let error = (a - b)
                .unwrap()
                .abs()
                .unwrap()
                .max_all()
                .unwrap()
                .to_scalar::<f64>()
                .unwrap();
            assert!(error < 1e-12, "{error}");
        }
    }

    #[test]
    fn bits_do_not_depend_on_the_thread_count() {
        let (x, w) = (
            random((512, 300), DType::F32),
            random((700, 300), DType::F32),
        );
        let bias = Tensor::zeros(700, DType::F32, &Device::Cpu).unwrap();
        let run = |threads| {
            set_threads(threads);
            let y = x.apply_op3_no_bwd(&w, &bias, &LinearOp).unwrap();
            set_threads(1);
            y.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        assert_eq!(run(1), run(2));
    }

    #[test]
    fn misfits_are_errors() {
        let (x, w) = (random((2, 3), DType::F32), random((4, 5), DType::F32));
        let bias = Tensor::zeros(4, DType::F32, &Device::Cpu).unwrap();
        assert!(x.apply_op3_no_bwd(&w, &bias, &LinearOp).is_err());
    }
}

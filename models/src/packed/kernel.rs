//! Packed weights times activations: tiles of a panel's 32 outputs by a few rows, whose sums stay in registers.

use pulp::{Arch, NullaryFnOnce};

use super::{
    block::{Block, WIDTH},
    machine::{Machine, Portable},
};
use crate::activation;

/// Inputs between the one whose weights are in use and the one whose are asked for: a processor's own prefetching falls
/// behind at batches of 4 and more.
const PREFETCH: usize = 192;

/// Bytes of a cache line.
const LINE: usize = 64;

/// A layer's weights, as `pack` leaves them.
#[derive(Clone, Debug)]
pub(super) enum Weights {
    F32(Vec<Block<f32>>),
    /// The bits of f16s.
    F16(Vec<Block<u16>>),
}

/// A packed layer.
#[derive(Clone, Debug)]
pub(super) struct Panels {
    inputs: usize,
    outputs: usize,
    weights: Weights,
    bias: Vec<Block<f32>>,
    elu: bool,
}

impl Panels {
    pub(super) fn new(
        inputs: usize,
        outputs: usize,
        weights: Weights,
        bias: Vec<Block<f32>>,
        elu: bool,
    ) -> Self {
        Self {
            inputs,
            outputs,
            weights,
            bias,
            elu,
        }
    }

    pub(super) fn inputs(&self) -> usize {
        self.inputs
    }

    pub(super) fn outputs(&self) -> usize {
        self.outputs
    }

    pub(super) fn panels(&self) -> usize {
        self.bias.len()
    }

    /// The answers of panels from `first` on for `rows` rows of `input`, as many panels as `output` has room for.
    pub(super) fn multiply(
        &self,
        first: usize,
        input: &[Block<f32>],
        rows: usize,
        output: &mut [Block<f32>],
    ) {
        self.multiply_on(Arch::new(), first, input, rows, output);
    }

    /// [`multiply`](Self::multiply) as processors of a kind do it.
    pub(super) fn multiply_on(
        &self,
        arch: Arch,
        first: usize,
        input: &[Block<f32>],
        rows: usize,
        output: &mut [Block<f32>],
    ) {
        macro_rules! run {
            ($weights:expr) => {{
                let product = Product {
                    inputs: self.inputs,
                    weights: &$weights[first * self.inputs..],
                    bias: &self.bias[first..],
                    elu: self.elu,
                    input,
                    rows,
                    output,
                };
                match arch {
                    #[cfg(target_arch = "x86_64")]
                    Arch::V4(machine) => machine.vectorize(On { machine, product }),
                    #[cfg(target_arch = "x86_64")]
                    Arch::V3(machine) => machine.vectorize(On { machine, product }),
                    _ => On {
                        machine: Portable,
                        product,
                    }
                    .call(),
                }
            }};
        }
        match &self.weights {
            Weights::F32(weights) => run!(weights),
            Weights::F16(weights) => run!(weights),
        }
    }
}

/// A stored weight.
trait Weight: Copy {
    fn load<M: Machine<LANES>, const LANES: usize>(machine: M, stored: &[Self; LANES])
    -> M::Vector;
}

impl Weight for f32 {
    #[inline(always)]
    fn load<M: Machine<LANES>, const LANES: usize>(machine: M, stored: &[f32; LANES]) -> M::Vector {
        machine.load(stored)
    }
}

/// The bits of an f16.
impl Weight for u16 {
    #[inline(always)]
    fn load<M: Machine<LANES>, const LANES: usize>(machine: M, stored: &[u16; LANES]) -> M::Vector {
        machine.widen(stored)
    }
}

/// Some panels times all rows.
struct Product<'a, W> {
    inputs: usize,
    weights: &'a [Block<W>],
    bias: &'a [Block<f32>],
    elu: bool,
    input: &'a [Block<f32>],
    rows: usize,
    output: &'a mut [Block<f32>],
}

struct On<'a, M, W> {
    machine: M,
    product: Product<'a, W>,
}

/// Runs `On` on a kind of processor: its lanes, the vectors of a tile side by side, and the numbers of rows that a tile
/// may have, each constant so that the sums stay in registers.
macro_rules! kernel {
    ($machine:ty, lanes $lanes:literal, vectors $vectors:literal, rows $($rows:literal)* to $most:literal) => {
        impl<W: Weight> NullaryFnOnce for On<'_, $machine, W> {
            type Output = ();

            #[inline(always)]
            fn call(self) {
                let On { machine, product } = self;
                let Product { inputs, rows, .. } = product;
                let panels = product.weights.chunks_exact(inputs).zip(product.bias);
                for ((panel, bias), output) in panels.zip(product.output.chunks_exact_mut(rows)) {
                    let tiles = rows.div_ceil($most);
                    let mut from = 0;
                    for tile in 0..tiles {
                        let size = (rows - from).div_ceil(tiles - tile);
                        let tile = Tile {
                            panel,
                            bias,
                            input: &product.input[from..],
                            rows,
                            output: &mut output[from..],
                        };
                        match size {
                            $($rows => tile.run::<_, $lanes, $vectors, $rows>(machine),)*
                            _ => tile.run::<_, $lanes, $vectors, $most>(machine),
                        }
                        from += size;
                    }
                    if product.elu {
                        activation::apply_elu(output.as_flattened_mut());
                    }
                }
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
kernel!(pulp::x86::V4, lanes 16, vectors 2, rows 1 2 3 4 5 6 7 8 9 10 11 12 13 to 14);
#[cfg(target_arch = "x86_64")]
kernel!(pulp::x86::V3, lanes 8, vectors 2, rows 1 2 3 4 5 to 6);
kernel!(Portable, lanes 4, vectors 4, rows 1 2 to 3);

/// One panel times a few rows.
struct Tile<'a, W> {
    panel: &'a [Block<W>],
    bias: &'a Block<f32>,
    /// The first block of the tile's first row; the same row's next block comes `rows` later.
    input: &'a [Block<f32>],
    rows: usize,
    output: &'a mut [Block<f32>],
}

impl<W: Weight> Tile<'_, W> {
    /// `ROWS` rows by the panel, `VECTORS` vectors of outputs at a time.
    #[inline(always)]
    fn run<M: Machine<L>, const L: usize, const VECTORS: usize, const ROWS: usize>(
        self,
        machine: M,
    ) {
        let Some(output) = self.output.first_chunk_mut::<ROWS>() else {
            return;
        };
        for part in 0..WIDTH / (L * VECTORS) {
            let Some(bias) = vectors::<f32, L, VECTORS>(self.bias, part) else {
                return;
            };
            let mut sums = [[machine.splat(0.0); VECTORS]; ROWS];
            for sums in &mut sums {
                for (sum, bias) in sums.iter_mut().zip(bias) {
                    *sum = machine.load(bias);
                }
            }
            let blocks = self.input.chunks(self.rows);
            for (stored, input) in self.panel.chunks(WIDTH).zip(blocks) {
                let Some(input) = input.first_chunk::<ROWS>() else {
                    return;
                };
                for (k, stored) in (0..WIDTH).zip(stored) {
                    for line in 0..size_of::<Block<W>>() / LINE {
                        let ahead = (&raw const *stored).wrapping_add(PREFETCH);
                        machine.prefetch(ahead.wrapping_byte_add(line * LINE));
                    }
                    let Some(stored) = vectors::<W, L, VECTORS>(stored, part) else {
                        return;
                    };
                    let mut weights = [machine.splat(0.0); VECTORS];
                    for (weights, stored) in weights.iter_mut().zip(stored) {
                        *weights = W::load(machine, stored);
                    }
                    for (sums, row) in sums.iter_mut().zip(input) {
                        let number = machine.splat(row[k]);
                        for (sum, weights) in sums.iter_mut().zip(weights) {
                            *sum = machine.multiply_add(weights, number, *sum);
                        }
                    }
                }
            }
            for (output, sums) in output.iter_mut().zip(sums) {
                let (vectors, _) = output.as_chunks_mut::<L>();
                let vectors = vectors[part * VECTORS..].iter_mut();
                for (vector, sum) in vectors.zip(sums) {
                    *vector = machine.store(sum);
                }
            }
        }
    }
}

/// The `part`th `VECTORS` vectors of a block.
#[inline(always)]
fn vectors<T, const L: usize, const VECTORS: usize>(
    block: &Block<T>,
    part: usize,
) -> Option<&[[T; L]; VECTORS]> {
    let (vectors, _) = block.as_chunks::<L>();
    vectors.get(part * VECTORS..)?.first_chunk()
}

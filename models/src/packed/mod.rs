//! Inference of MLPs whose weights are packed once, at load: for batches of 1 to 64 rows on a CPU.
//!
//! [`Mlp`](crate::mlp::Mlp) is what training differentiates; its matrix products rearrange the weights at every call, which
//! costs most where there are few rows. Here the weights of 32 outputs lie together in a panel, in the order in which they
//! are read; bias and ELU are applied before a tile of answers leaves the registers.
//!
//! Every answer is one sum over its inputs, in their order, from the bias on. So a row's answer is the same, bit for bit,
//! whatever rows stand beside it and however many threads share the work; and processors with a fused multiply-add agree
//! with each other.

mod block;
mod kernel;
mod machine;
#[cfg(test)]
mod tests;

use std::cell::Cell;

use candle_core::bail;
use half::f16;

use crate::linear;
use block::{Block, WIDTH};
use kernel::{Panels, Weights};

/// How weights are stored. Sums are f32 either way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 4 bytes a weight.
    F32,
    /// 2 bytes a weight, rounded to nearest: half as much to read, which is what batch 1 waits for.
    F16,
}

impl Precision {
    /// The smallest that holds all `weights` exactly: f16 for those of a checkpoint that was saved as f16.
    pub fn lossless<'a>(weights: impl IntoIterator<Item = &'a f32>) -> Self {
        let mut weights = weights.into_iter();
        match weights.all(|&weight| f16::from_f32(weight).to_f32() == weight) {
            true => Self::F16,
            false => Self::F32,
        }
    }
}

/// Fully connected layers with ELU between them, packed.
#[derive(Clone, Debug)]
pub struct PackedMlp {
    layers: Vec<Panels>,
}

impl PackedMlp {
    /// Packs layers, each a weight (outputs × inputs, row-major) and a bias (outputs).
    ///
    /// # Errors
    /// When there is no layer, a layer does not take what the one before it gives, or a weight is beyond what `precision`
    /// can hold.
    pub fn new(layers: &[(&[f32], &[f32])], precision: Precision) -> candle_core::Result<Self> {
        let mut packed: Vec<Panels> = Vec::with_capacity(layers.len());
        for (i, &(weight, bias)) in layers.iter().enumerate() {
            let inputs = weight.len() / bias.len().max(1);
            if inputs == 0 || weight.len() != inputs * bias.len() {
                bail!(
                    "packed layer {i}: {} weights do not fit {} outputs",
                    weight.len(),
                    bias.len()
                );
            }
            if let Some(before) = packed.last()
                && before.outputs() != inputs
            {
                bail!(
                    "packed layer {i} takes {inputs} numbers, the layer before gives {}",
                    before.outputs()
                );
            }
            let weights = match precision {
                Precision::F32 => Weights::F32(pack(weight, inputs, |weight| weight)),
                Precision::F16 => {
                    let limit = f16::MAX.to_f32();
                    if let Some(weight) = weight.iter().find(|weight| weight.abs() > limit) {
                        bail!("packed layer {i}: the weight {weight} is beyond ±{limit}");
                    }
                    Weights::F16(pack(weight, inputs, |weight| {
                        f16::from_f32(weight).to_bits()
                    }))
                }
            };
            let bias = pack(bias, 1, |bias| bias);
            let outputs = weight.len() / inputs;
            let last = i + 1 == layers.len();
            packed.push(Panels::new(inputs, outputs, weights, bias, !last));
        }
        if packed.is_empty() {
            bail!("a packed MLP needs a layer");
        }
        Ok(Self { layers: packed })
    }

    /// Numbers that a row has.
    pub fn inputs(&self) -> usize {
        self.layers.first().map_or(0, Panels::inputs)
    }

    /// Numbers that a row's answer has.
    pub fn outputs(&self) -> usize {
        self.layers.last().map_or(0, Panels::outputs)
    }

    /// Applies the layers to `rows` (N × [`inputs`](Self::inputs)); `out` becomes N × [`outputs`](Self::outputs).
    ///
    /// Runs on the calling thread's [`linear::set_threads`] budget. Once `scratch` and `out` have grown to the batch, one
    /// thread allocates nothing.
    ///
    /// # Errors
    /// When `rows` is not whole rows.
    pub fn forward(
        &self,
        rows: &[f32],
        out: &mut Vec<f32>,
        scratch: &mut Scratch,
    ) -> candle_core::Result<()> {
        let (inputs, outputs) = (self.inputs(), self.outputs());
        if !rows.len().is_multiple_of(inputs) {
            bail!(
                "packed MLP: {} numbers are not rows of {inputs}",
                rows.len()
            );
        }
        let count = rows.len() / inputs;
        out.clear();
        out.resize(count * outputs, 0.0);
        if count > 0 {
            scratch.read(rows, inputs);
            let threads = linear::threads();
            let mut layers = self.layers.iter();
            if layers.any(|layer| is_shared(layer, layer.panels(), count, threads)) {
                // One way into the pool for all layers.
                rayon::scope(|_| self.apply(count, scratch, threads));
            } else {
                self.apply(count, scratch, 1);
            }
            scratch.write(out, outputs);
        }
        Ok(())
    }

    /// Takes the activations in `scratch` through all layers.
    fn apply(&self, rows: usize, scratch: &mut Scratch, threads: usize) {
        for layer in &self.layers {
            scratch.next.clear();
            scratch.next.resize(layer.panels() * rows, [0.0; WIDTH]);
            share(layer, 0, &scratch.now, rows, &mut scratch.next, threads);
            std::mem::swap(&mut scratch.now, &mut scratch.next);
        }
    }
}

/// Computes the answers of the panels from `first` on that `output` has room for, split between `threads`.
fn share(
    layer: &Panels,
    first: usize,
    input: &[Block<f32>],
    rows: usize,
    output: &mut [Block<f32>],
    threads: usize,
) {
    let panels = output.len() / rows;
    if !is_shared(layer, panels, rows, threads) {
        return layer.multiply(first, input, rows, output);
    }
    let half = threads / 2;
    let split = panels * half / threads;
    let (left, right) = output.split_at_mut(split * rows);
    rayon::join(
        || share(layer, first, input, rows, left, half),
        || share(layer, first + split, input, rows, right, threads - half),
    );
}

/// Whether `panels` panels are worth more than one thread.
fn is_shared(layer: &Panels, panels: usize, rows: usize, threads: usize) -> bool {
    /// Below this many multiply-adds a thread, waking it costs more than it saves.
    const PARALLEL_WORK: usize = 1 << 18;
    let work = panels * WIDTH * layer.inputs() * rows;
    threads > 1 && panels > 1 && work >= threads * PARALLEL_WORK
}

/// Panels of a row-major matrix (outputs × `inputs`): panel p holds input 0 of the outputs 32p…32p + 31, then input 1, …;
/// zeros stand for outputs that are not there.
fn pack<T: Copy + Default>(
    matrix: &[f32],
    inputs: usize,
    convert: impl Fn(f32) -> T,
) -> Vec<Block<T>> {
    let panels = (matrix.len() / inputs).div_ceil(WIDTH);
    let mut packed = vec![[T::default(); WIDTH]; panels * inputs];
    let outputs = matrix.chunks_exact(inputs);
    for (output, weights) in outputs.enumerate() {
        let panel = &mut packed[output / WIDTH * inputs..];
        for (block, &weight) in panel.iter_mut().zip(weights) {
            block[output % WIDTH] = convert(weight);
        }
    }
    packed
}

thread_local! {
    static SCRATCH: Cell<Scratch> = const { Cell::new(Scratch::new()) };
}

/// Activations between layers, kept so that a later batch of the same size allocates nothing.
///
/// Blocks of 32 numbers of a row; block b of all rows stands before block b + 1 of the first.
#[derive(Debug, Default)]
pub struct Scratch {
    now: Vec<Block<f32>>,
    next: Vec<Block<f32>>,
}

impl Scratch {
    const fn new() -> Self {
        Self {
            now: Vec::new(),
            next: Vec::new(),
        }
    }

    /// Lends the calling thread's own.
    pub(crate) fn with<R>(run: impl FnOnce(&mut Self) -> R) -> R {
        let mut scratch = SCRATCH.take();
        let answer = run(&mut scratch);
        SCRATCH.set(scratch);
        answer
    }

    /// Puts row-major `rows` into blocks.
    fn read(&mut self, rows: &[f32], width: usize) {
        let count = rows.len() / width;
        self.now.clear();
        self.now.resize(width.div_ceil(WIDTH) * count, [0.0; WIDTH]);
        for (r, row) in rows.chunks_exact(width).enumerate() {
            let blocks = self.now[r..].iter_mut().step_by(count);
            for (block, numbers) in blocks.zip(row.chunks(WIDTH)) {
                block[..numbers.len()].copy_from_slice(numbers);
            }
        }
    }

    /// Puts blocks into row-major `rows`.
    fn write(&self, rows: &mut [f32], width: usize) {
        let count = rows.len() / width;
        for (r, row) in rows.chunks_exact_mut(width).enumerate() {
            let blocks = self.now[r..].iter().step_by(count);
            for (numbers, block) in row.chunks_mut(WIDTH).zip(blocks) {
                numbers.copy_from_slice(&block[..numbers.len()]);
            }
        }
    }
}

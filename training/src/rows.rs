//! Rows of numbers, on their way into tensors and gradients.

use anyhow::{Context as _, Result};
use candle_core::{Device, Tensor, backprop::GradStore};
use candle_nn::VarMap;

use crate::variables;

/// Rows of `width` numbers as a tensor.
pub(crate) fn tensor(rows: &[f32], width: usize) -> candle_core::Result<Tensor> {
    Tensor::from_slice(rows, (rows.len() / width, width), &Device::Cpu)
}

/// The rows of these numbers.
pub(crate) fn gather(values: &[f32], width: usize, rows: &[usize]) -> Vec<f32> {
    let mut gathered = Vec::with_capacity(rows.len() * width);
    for row in rows {
        gathered.extend_from_slice(&values[row * width..(row + 1) * width]);
    }
    gathered
}

/// The rows of these numbers as a tensor.
pub(crate) fn gathered(
    values: &[f32],
    width: usize,
    rows: &[usize],
) -> candle_core::Result<Tensor> {
    let values = gather(values, width, rows);
    Tensor::from_vec(values, (rows.len(), width), &Device::Cpu)
}

/// Adds the gradients of the variables of `maps`, in order.
///
/// # Errors
/// When there is no gradient, or the variables' lock is poisoned.
pub(crate) fn add_gradients(
    gradients: impl IntoIterator<Item = GradStore>,
    maps: &[&VarMap],
) -> Result<GradStore> {
    let mut gradients = gradients.into_iter();
    let mut total = gradients.next().context("a mini-batch has no rows")?;
    let maps = maps.iter().map(|map| variables::lock(map));
    let maps = maps.collect::<Result<Vec<_>>>()?;
    for gradient in gradients {
        for var in maps.iter().flat_map(|vars| vars.values()) {
            if let (Some(sum), Some(part)) = (total.remove(var), gradient.get(var)) {
                total.insert(var, (sum + part)?);
            }
        }
    }
    Ok(total)
}

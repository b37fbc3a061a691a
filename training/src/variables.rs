//! The variables of a network in training: initial values, and the way into a checkpoint and back.

use std::{collections::HashMap, sync::MutexGuard};

use anyhow::{Context as _, Result, anyhow};
use candle_core::{Device, Tensor, Var};
use candle_nn::VarMap;
use emp_models::checkpoint::Tensors;
use rand::{Rng, RngExt as _};

/// The variables by name.
///
/// # Errors
/// When a thread that held them panicked.
pub fn lock(vars: &VarMap) -> Result<MutexGuard<'_, HashMap<String, Var>>> {
    let vars = vars.data().lock();
    vars.map_err(|_| anyhow!("the variables' lock is poisoned"))
}

/// Draws initial weights and biases uniformly within `±1/√inputs`, in the order of the variables' names: candle draws them
/// from a generator that cannot be seeded on the CPU.
///
/// # Errors
/// When the variables' lock is poisoned.
pub fn initialise(vars: &VarMap, rng: &mut impl Rng) -> Result<()> {
    let vars = lock(vars)?;
    let mut names: Vec<&String> = vars.keys().collect();
    names.sort();
    for name in names {
        let var = &vars[name];
        let weight = name
            .strip_suffix("bias")
            .map(|stem| format!("{stem}weight"));
        let shape = weight
            .and_then(|weight| vars.get(&weight))
            .unwrap_or(var)
            .dims();
        let bound = 1.0 / (*shape.last().unwrap_or(&1) as f32).sqrt();
        let values: Vec<f32> = (0..var.elem_count())
            .map(|_| rng.random_range(-bound..bound))
            .collect();
        var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu)?)?;
    }
    Ok(())
}

/// The variables' values, which later steps do not change.
///
/// # Errors
/// When the variables' lock is poisoned.
pub fn values(vars: &VarMap) -> Result<Tensors> {
    let vars = lock(vars)?;
    vars.iter()
        .map(|(name, var)| Ok((name.clone(), var.as_detached_tensor().copy()?)))
        .collect()
}

/// Sets every variable to the tensor of its name.
///
/// # Errors
/// When one is missing or has another shape.
pub fn restore(vars: &VarMap, tensors: &Tensors) -> Result<()> {
    for (name, var) in lock(vars)?.iter() {
        let tensor = tensors
            .get(name)
            .with_context(|| format!("no tensor `{name}`"))?;
        var.set(tensor)
            .with_context(|| format!("tensor `{name}`"))?;
    }
    Ok(())
}

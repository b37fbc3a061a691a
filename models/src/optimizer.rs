//! Adam with a bounded gradient norm, whose state can be saved.
//!
//! `candle-nn`'s optimisers keep their moments to themselves, so a run that is cut off could not resume exactly.

use std::collections::BTreeMap;

use candle_core::{Tensor, Var, backprop::GradStore, bail};
use candle_nn::VarMap;

use crate::checkpoint::Tensors;

/// Adam's settings.
#[derive(Clone, Debug, PartialEq)]
pub struct AdamConfig {
    /// Decay of the mean of gradients.
    pub beta1: f64,
    /// Decay of the mean of squared gradients.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Gradients are scaled down to this norm, taken over all variables.
    pub max_gradient_norm: f64,
}

impl Default for AdamConfig {
    fn default() -> Self {
        Self {
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-8,
            max_gradient_norm: 10.0,
        }
    }
}

struct Slot {
    var: Var,
    mean: Vec<f32>,
    square: Vec<f32>,
}

/// Adam over the variables of a [`VarMap`], in the order of their names.
pub struct Adam {
    config: AdamConfig,
    slots: BTreeMap<String, Slot>,
    steps: u64,
}

impl Adam {
    /// Starts with zero moments.
    ///
    /// # Errors
    /// When the map's lock is poisoned.
    pub fn new(vars: &VarMap, config: AdamConfig) -> candle_core::Result<Self> {
        let Ok(vars) = vars.data().lock() else {
            bail!("the variables' lock is poisoned")
        };
        let slots = vars
            .iter()
            .map(|(name, var)| {
                let zeros = vec![0.0; var.elem_count()];
                (
                    name.clone(),
                    Slot {
                        var: var.clone(),
                        mean: zeros.clone(),
                        square: zeros,
                    },
                )
            })
            .collect();
        Ok(Self {
            config,
            slots,
            steps: 0,
        })
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Takes one step of size `learning_rate` and returns the gradient's norm before it was bounded.
    ///
    /// # Errors
    /// When a gradient is not f32, or not a number: the variables are then left as they were.
    pub fn step(&mut self, grads: &GradStore, learning_rate: f64) -> candle_core::Result<f64> {
        let mut found = Vec::with_capacity(self.slots.len());
        for slot in self.slots.values() {
            let grad = grads.get(&slot.var);
            found.push(
                grad.map(|g| g.flatten_all()?.to_vec1::<f32>())
                    .transpose()?,
            );
        }
        self.apply(&found, learning_rate)
    }

    /// As [`step`](Self::step), with gradients by the names of their variables.
    ///
    /// # Errors
    /// When a gradient is not a number: the variables are then left as they were.
    pub fn step_by_name(
        &mut self,
        mut gradients: BTreeMap<String, Vec<f32>>,
        learning_rate: f64,
    ) -> candle_core::Result<f64> {
        let names = self.slots.keys();
        let found: Vec<Option<Vec<f32>>> = names.map(|name| gradients.remove(name)).collect();
        self.apply(&found, learning_rate)
    }

    /// Takes a step with one gradient a slot, where there is one.
    fn apply(
        &mut self,
        found: &[Option<Vec<f32>>],
        learning_rate: f64,
    ) -> candle_core::Result<f64> {
        let squares = found
            .iter()
            .flatten()
            .flatten()
            .map(|g| f64::from(*g).powi(2));
        let norm = squares.sum::<f64>().sqrt();
        if !norm.is_finite() {
            bail!("the gradient is not a number");
        }
        let scale = (self.config.max_gradient_norm / norm.max(1e-12)).min(1.0) as f32;
        self.steps += 1;
        for (slot, grad) in self.slots.values_mut().zip(found) {
            if let Some(grad) = grad {
                slot.update(grad, scale, learning_rate, &self.config, self.steps)?;
            }
        }
        Ok(norm)
    }

    /// The moments as tensors, for a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn state(&self) -> candle_core::Result<Tensors> {
        let mut state = Tensors::new();
        for (name, slot) in &self.slots {
            let device = slot.var.device();
            state.insert(
                format!("adam.mean.{name}"),
                Tensor::new(slot.mean.as_slice(), device)?,
            );
            state.insert(
                format!("adam.square.{name}"),
                Tensor::new(slot.square.as_slice(), device)?,
            );
        }
        Ok(state)
    }

    /// Continues from a saved [`Self::state`] after `steps` steps.
    ///
    /// # Errors
    /// When a moment is missing or has another size.
    pub fn restore(&mut self, state: &Tensors, steps: u64) -> candle_core::Result<()> {
        for (name, slot) in &mut self.slots {
            for (kind, moment) in [("mean", &mut slot.mean), ("square", &mut slot.square)] {
                let key = format!("adam.{kind}.{name}");
                let Some(saved) = state.get(&key) else {
                    bail!("the checkpoint has no {key}")
                };
                let saved = saved.flatten_all()?.to_vec1::<f32>()?;
                if saved.len() != moment.len() {
                    bail!(
                        "{key} has {} values, expected {}",
                        saved.len(),
                        moment.len()
                    );
                }
                *moment = saved;
            }
        }
        self.steps = steps;
        Ok(())
    }

    /// Forgets the moments of the given rows of a variable, after these rows were replaced.
    pub fn forget_rows(&mut self, name: &str, rows: &[u32]) {
        let Some(slot) = self.slots.get_mut(name) else {
            return;
        };
        let width = slot.mean.len() / slot.var.dims().first().copied().unwrap_or(1).max(1);
        for row in rows {
            let range = *row as usize * width..(*row as usize + 1) * width;
            slot.mean[range.clone()].fill(0.0);
            slot.square[range].fill(0.0);
        }
    }
}

impl Slot {
    fn update(
        &mut self,
        grad: &[f32],
        scale: f32,
        learning_rate: f64,
        config: &AdamConfig,
        steps: u64,
    ) -> candle_core::Result<()> {
        let steps = i32::try_from(steps).unwrap_or(i32::MAX);
        let (beta1, beta2) = (config.beta1 as f32, config.beta2 as f32);
        let step = (learning_rate / (1.0 - config.beta1.powi(steps))) as f32;
        let correction = (1.0 / (1.0 - config.beta2.powi(steps)).sqrt()) as f32;
        let epsilon = config.epsilon as f32;
        let mut values = self.var.flatten_all()?.to_vec1::<f32>()?;
        let moments = self.mean.iter_mut().zip(&mut self.square);
        for ((value, grad), (mean, square)) in values.iter_mut().zip(grad).zip(moments) {
            let grad = grad * scale;
            *mean = beta1 * *mean + (1.0 - beta1) * grad;
            *square = beta2 * *square + (1.0 - beta2) * grad * grad;
            *value -= step * *mean / (square.sqrt() * correction + epsilon);
        }
        self.var.set(&Tensor::from_vec(
            values,
            self.var.shape(),
            self.var.device(),
        )?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    fn variable() -> VarMap {
        let vars = VarMap::new();
        let var = Var::from_slice(&[3f32, -2.0, 0.5, 1.0], (2, 2), &Device::Cpu).unwrap();
        vars.data().lock().unwrap().insert("x".into(), var);
        vars
    }

    fn descend(vars: &VarMap, adam: &mut Adam, steps: usize) -> Vec<f32> {
        let var = vars.data().lock().unwrap()["x"].clone();
        for _ in 0..steps {
            let grads = var.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            adam.step(&grads, 0.1).unwrap();
        }
        var.flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn the_first_step_is_the_learning_rate() {
        let vars = variable();
        let mut adam = Adam::new(&vars, AdamConfig::default()).unwrap();
        for (x, expected) in descend(&vars, &mut adam, 1)
            .iter()
            .zip([2.9, -1.9, 0.4, 0.9])
        {
            assert!((x - expected).abs() < 1e-5, "{x} {expected}");
        }
    }

    #[test]
    fn a_restored_optimiser_continues_bit_for_bit() {
        let (a, b) = (variable(), variable());
        let mut whole = Adam::new(&a, AdamConfig::default()).unwrap();
        let expected = descend(&a, &mut whole, 7);
        let mut first = Adam::new(&b, AdamConfig::default()).unwrap();
        descend(&b, &mut first, 4);
        let mut second = Adam::new(&b, AdamConfig::default()).unwrap();
        second
            .restore(&first.state().unwrap(), first.steps())
            .unwrap();
        assert_eq!(descend(&b, &mut second, 3), expected);
    }

    #[test]
    fn a_gradient_that_is_not_a_number_changes_nothing() {
        let vars = variable();
        let var = vars.data().lock().unwrap()["x"].clone();
        let mut adam = Adam::new(&vars, AdamConfig::default()).unwrap();
        let grads = (var.sum_all().unwrap() * f64::NAN)
            .unwrap()
            .backward()
            .unwrap();
        assert!(adam.step(&grads, 0.1).is_err());
        assert_eq!(
            var.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
            [3.0, -2.0, 0.5, 1.0]
        );
    }
}

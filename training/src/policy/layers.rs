//! The layers of actor and critic, differentiated by hand.
//!
//! The same numbers as [`Mlp`](emp_models::mlp::Mlp) gives, without a graph: every product writes into a buffer that stays,
//! and nothing is copied on the way. It is what the learner spends its time on.

use std::collections::HashMap;

use anyhow::{Context as _, Result};
use candle_core::Var;
use emp_models::{activation, linear};

/// Fully connected layers with ELU between them.
#[derive(Clone, Debug)]
pub struct Layers(Vec<Layer>);

#[derive(Clone, Debug)]
struct Layer {
    /// Outputs × inputs, row-major.
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Layer {
    fn inputs(&self) -> usize {
        self.weight.len() / self.bias.len()
    }
}

/// What the layers answered to some rows, the rows themselves first.
pub struct Activations(Vec<Vec<f32>>);

impl Activations {
    /// The last layer's answers.
    pub fn answers(&self) -> &[f32] {
        self.0.last().map_or(&[], Vec::as_slice)
    }
}

impl Layers {
    /// The layers' weights as they are now, from variables named as [`Mlp::new`](emp_models::mlp::Mlp::new) names them.
    ///
    /// # Errors
    /// When there is no such layer.
    pub fn read(vars: &HashMap<String, Var>, prefix: &str, depth: usize) -> Result<Self> {
        let layer = |index: usize| {
            let numbers = |part: &str| -> Result<Vec<f32>> {
                let name = format!("{prefix}.{index}.{part}");
                let var = vars.get(&name);
                let var = var.with_context(|| format!("no variable `{name}`"))?;
                Ok(var.flatten_all()?.to_vec1()?)
            };
            Ok(Layer {
                weight: numbers("weight")?,
                bias: numbers("bias")?,
            })
        };
        Ok(Self((0..depth).map(layer).collect::<Result<_>>()?))
    }

    /// Answers rows.
    pub fn forward(&self, rows: Vec<f32>) -> Activations {
        let mut activations = vec![rows];
        for (index, layer) in self.0.iter().enumerate() {
            let input = &activations[index];
            let (inputs, outputs) = (layer.inputs(), layer.bias.len());
            let mut output = vec![0.0; input.len() / inputs * outputs];
            linear::product_with_transpose(&mut output, input, &layer.weight, inputs);
            for row in output.chunks_exact_mut(outputs) {
                for (answer, bias) in row.iter_mut().zip(&layer.bias) {
                    *answer += bias;
                }
            }
            if index + 1 < self.0.len() {
                activation::elu_in_place(&mut output);
            }
            activations.push(output);
        }
        Activations(activations)
    }

    /// The gradient of each layer's weight and bias, from that of the last layer's answers.
    pub fn backward(&self, activations: &Activations, mut answers: Vec<f32>) -> Vec<[Vec<f32>; 2]> {
        let mut gradients = Vec::with_capacity(self.0.len());
        for (index, layer) in self.0.iter().enumerate().rev() {
            let input = &activations.0[index];
            let outputs = layer.bias.len();
            let mut weight = vec![0.0; layer.weight.len()];
            linear::product_of_transpose(&mut weight, &answers, outputs, input);
            let mut bias = vec![0.0; outputs];
            for row in answers.chunks_exact(outputs) {
                for (sum, gradient) in bias.iter_mut().zip(row) {
                    *sum += gradient;
                }
            }
            gradients.push([weight, bias]);
            if index > 0 {
                let mut before = vec![0.0; input.len()];
                linear::product_plain(&mut before, &answers, outputs, &layer.weight);
                activation::elu_slope_in_place(&mut before, input);
                answers = before;
            }
        }
        gradients.reverse();
        gradients
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{DType, Device, Tensor};
    use candle_nn::{VarBuilder, VarMap};
    use emp_models::mlp::Mlp;

    #[test]
    fn answers_and_gradients_are_those_of_the_graph() {
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let mlp = Mlp::new(7, &[20, 9], 3, &builder.pp("net")).unwrap();
        let numbers: Vec<f32> = (0..11 * 7).map(|i| (i as f32 * 0.73).sin()).collect();
        let weights: Vec<f32> = (0..11 * 3).map(|i| (i as f32 * 1.3).cos()).collect();

        let rows = Tensor::from_slice(&numbers, (11, 7), &Device::Cpu).unwrap();
        let expected = mlp.forward(&rows).unwrap();
        let upstream = Tensor::from_slice(&weights, (11, 3), &Device::Cpu).unwrap();
        let loss = (&expected * upstream).unwrap().sum_all().unwrap();
        let store = loss.backward().unwrap();

        let vars = vars.data().lock().unwrap();
        let layers = Layers::read(&vars, "net", 3).unwrap();
        let activations = layers.forward(numbers);
        let expected: Vec<f32> = expected.flatten_all().unwrap().to_vec1().unwrap();
        for (a, b) in activations.answers().iter().zip(expected) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
        let gradients = layers.backward(&activations, weights);
        for (index, parts) in gradients.iter().enumerate() {
            for (part, gradient) in ["weight", "bias"].into_iter().zip(parts) {
                let var = &vars[&format!("net.{index}.{part}")];
                let expected = store.get(var).unwrap().flatten_all().unwrap();
                let expected = expected.to_vec1::<f32>().unwrap();
                assert_eq!(gradient.len(), expected.len());
                for (a, b) in gradient.iter().zip(expected) {
                    assert!((a - b).abs() < 1e-4, "{index} {part}: {a} {b}");
                }
            }
        }
    }
}

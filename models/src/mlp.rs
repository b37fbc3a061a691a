//! What policy, EMP and world model are made of: fully connected layers behind a normalisation of their inputs, and the
//! tensors that a checkpoint keeps of them.

use candle_core::{DType, Device, Tensor};
use candle_nn::VarBuilder;

use crate::{
    activation,
    checkpoint::Tensors,
    linear::Linear,
    packed::{PackedMlp, Precision},
};

/// Normalised features are clipped to this many standard deviations.
const CLIP: f32 = 8.0;

/// Names of the normaliser's tensors in a checkpoint.
const NORMALIZER: [&str; 2] = ["normalizer.mean", "normalizer.scale"];

/// The tensors of a shipped checkpoint: those of a network as f16, each named `prefix.name`, those of its normaliser as f32.
///
/// # Errors
/// When a tensor cannot be converted.
pub fn shipped_tensors(
    prefix: &str,
    normalizer: &Normalizer,
    network: &Tensors,
) -> candle_core::Result<Tensors> {
    let mut tensors: Tensors = normalizer.tensors()?.into_iter().collect();
    for (name, tensor) in network {
        tensors.insert(format!("{prefix}.{name}"), tensor.to_dtype(DType::F16)?);
    }
    Ok(tensors)
}

/// Brings features to zero mean and unit size.
#[derive(Clone, Debug, PartialEq)]
pub struct Normalizer {
    /// Mean of each feature.
    pub mean: Vec<f32>,
    /// What each deviation is multiplied by.
    pub scale: Vec<f32>,
}

impl Normalizer {
    /// Leaves features as they are, but for the clipping.
    pub fn identity(features: usize) -> Self {
        Self {
            mean: vec![0.0; features],
            scale: vec![1.0; features],
        }
    }

    /// Normalises rows of features in place and clips them to ±8.
    pub fn apply(&self, features: &mut [f32]) {
        for row in features.chunks_exact_mut(self.mean.len()) {
            for ((value, mean), scale) in row.iter_mut().zip(&self.mean).zip(&self.scale) {
                *value = ((*value - mean) * scale).clamp(-CLIP, CLIP);
            }
        }
    }

    /// As [`apply`](Self::apply), differentiable.
    ///
    /// # Errors
    /// When `features` has another width.
    pub fn forward(&self, features: &Tensor) -> candle_core::Result<Tensor> {
        let row = |values: &[f32]| Tensor::new(values, features.device());
        features
            .broadcast_sub(&row(&self.mean)?)?
            .broadcast_mul(&row(&self.scale)?)?
            .clamp(-CLIP, CLIP)
    }

    /// The tensors of a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn tensors(&self) -> candle_core::Result<[(String, Tensor); 2]> {
        let tensor = |name: &str, values: &[f32]| {
            Ok::<_, candle_core::Error>((name.to_owned(), Tensor::new(values, &Device::Cpu)?))
        };
        Ok([
            tensor(NORMALIZER[0], &self.mean)?,
            tensor(NORMALIZER[1], &self.scale)?,
        ])
    }

    /// The normaliser of `features` numbers in a checkpoint's tensors.
    ///
    /// # Errors
    /// Says which tensor is missing or wrong.
    pub fn from_tensors(tensors: &Tensors, features: usize) -> Result<Self, String> {
        let read = |name: &str| {
            let tensor = tensors.get(name).ok_or(format!("no tensor `{name}`"))?;
            let values = tensor
                .to_vec1::<f32>()
                .map_err(|e| format!("tensor `{name}`: {e}"))?;
            if values.len() != features || values.iter().any(|value| !value.is_finite()) {
                return Err(format!(
                    "tensor `{name}`: expected {features} finite numbers, got {}",
                    values.len()
                ));
            }
            Ok(values)
        };
        Ok(Self {
            mean: read(NORMALIZER[0])?,
            scale: read(NORMALIZER[1])?,
        })
    }
}

/// Fully connected layers with ELU between them.
#[derive(Clone, Debug)]
pub struct Mlp {
    layers: Vec<Linear>,
}

impl Mlp {
    /// Layers `inputs → hidden… → outputs`, their tensors named `0.weight`, `0.bias`, `1.weight`, … in `vars`.
    ///
    /// # Errors
    /// When `vars` holds tensors of those names with other shapes.
    pub fn new(
        inputs: usize,
        hidden: &[usize],
        outputs: usize,
        vars: &VarBuilder<'_>,
    ) -> candle_core::Result<Self> {
        let widths: Vec<usize> = [&[inputs], hidden, &[outputs]].concat();
        let layers = widths
            .windows(2)
            .enumerate()
            .map(|(i, pair)| Linear::new(pair[0], pair[1], &vars.pp(i)));
        Ok(Self {
            layers: layers.collect::<Result<_, _>>()?,
        })
    }

    /// The layers' tensors, named as [`Mlp::new`] names them.
    pub fn tensors(&self) -> Tensors {
        let layers = self.layers.iter().enumerate();
        layers
            .flat_map(|(i, layer)| {
                let (weight, bias) = layer.tensors();
                [
                    (format!("{i}.weight"), weight.clone()),
                    (format!("{i}.bias"), bias.clone()),
                ]
            })
            .collect()
    }

    /// These layers for inference, as f16 where that loses nothing.
    ///
    /// # Errors
    /// When the tensors are not f32.
    pub fn pack(&self) -> candle_core::Result<PackedMlp> {
        let numbers = |tensor: &Tensor| tensor.flatten_all()?.to_vec1::<f32>();
        let mut layers = Vec::with_capacity(self.layers.len());
        for (weight, bias) in self.layers.iter().map(Linear::tensors) {
            layers.push((numbers(weight)?, numbers(bias)?));
        }
        let layers: Vec<(&[f32], &[f32])> = layers
            .iter()
            .map(|(weight, bias)| (weight.as_slice(), bias.as_slice()))
            .collect();
        let weights = layers.iter().flat_map(|(weight, _)| *weight);
        PackedMlp::new(&layers, Precision::lossless(weights))
    }

    /// Applies the layers to rows of inputs.
    ///
    /// # Errors
    /// When `x` has another width or type.
    pub fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        let mut x = x.clone();
        for (i, layer) in self.layers.iter().enumerate() {
            x = layer.forward(&x)?;
            if i + 1 < self.layers.len() {
                x = activation::elu(&x)?;
            }
        }
        Ok(x)
    }
}

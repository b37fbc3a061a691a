//! The actor and the critic.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result};
use candle_core::{DType, Device, Tensor, Var};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{Mirror, checkpoint::Tensors, mlp::Mlp, policy::PolicyMirror};
use nalgebra::DMatrix;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::layers::{Activations, Layers};
use super::settings::PpoSettings;
use crate::variables;

/// Prefix of the actor's tensors.
const ACTOR: &str = "actor";

/// Prefix of the critic's tensors.
const CRITIC: &str = "critic";

/// Name of the exploration's log standard deviations.
const LOG_STD: &str = "log_std";

/// The actor's last layer starts this small: every action starts near zero, the default pose.
const ACTOR_GAIN: f64 = 0.01;

/// Sizes of what actor and critic read and answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Widths {
    /// Features that the actor reads.
    pub features: usize,
    /// Numbers that only the critic reads.
    pub privileged: usize,
    /// Actions.
    pub actions: usize,
}

/// What makes actor and critic symmetric.
#[derive(Clone, Debug)]
pub struct Symmetry {
    /// The mirror of features and actions.
    pub policy: PolicyMirror,
    /// The mirror of what the critic reads.
    pub privileged: Mirror,
}

/// A Gaussian policy with a state-independent deviation, and the value of a state. Inputs are normalised.
///
/// With a [`Symmetry`], the mean action is ½ (f(s) + M f(M s)) and the value ½ (v(s) + v(M s)): rows are then followed by
/// their mirror images. The deviations of mirrored joints are the same.
pub struct ActorCritic {
    vars: VarMap,
    /// Layers of actor and critic.
    depths: [usize; 2],
    log_std: Var,
    symmetry: Option<Symmetry>,
}

impl ActorCritic {
    /// Draws initial weights: hidden layers uniformly within `±1/√inputs`, last layers orthogonal, their biases zero.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(
        widths: Widths,
        settings: &PpoSettings,
        symmetry: Option<Symmetry>,
        seed: u64,
    ) -> Result<Self> {
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let (actor, critic) = (&settings.actor_hidden, &settings.critic_hidden);
        Mlp::new(widths.features, actor, widths.actions, &builder.pp(ACTOR))?;
        Mlp::new(widths.privileged, critic, 1, &builder.pp(CRITIC))?;
        let network = Self {
            depths: [actor.len() + 1, critic.len() + 1],
            log_std: Var::new(
                vec![settings.initial_std.ln() as f32; widths.actions],
                &Device::Cpu,
            )?,
            vars,
            symmetry,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        variables::initialise(&network.vars, &mut rng)?;
        for (prefix, depth, gain) in [
            (ACTOR, actor.len(), ACTOR_GAIN),
            (CRITIC, critic.len(), 1.0),
        ] {
            let last = format!("{prefix}.{depth}");
            network.make_orthogonal(&last, gain, &mut rng)?;
        }
        variables::lock(&network.vars)?.insert(LOG_STD.to_owned(), network.log_std.clone());
        Ok(network)
    }

    fn make_orthogonal(&self, layer: &str, gain: f64, rng: &mut ChaCha8Rng) -> Result<()> {
        let vars = variables::lock(&self.vars)?;
        let find = |part: &str| {
            let name = format!("{layer}.{part}");
            vars.get(&name)
                .with_context(|| format!("no variable `{name}`"))
        };
        let (weight, bias) = (find("weight")?, find("bias")?);
        let (rows, columns) = weight.dims2()?;
        let weights = orthogonal(rows, columns, gain, rng);
        weight.set(&Tensor::from_vec(weights, (rows, columns), &Device::Cpu)?)?;
        bias.set(&bias.zeros_like()?)?;
        Ok(())
    }

    /// What makes it symmetric, if it is.
    pub fn symmetry(&self) -> Option<&Symmetry> {
        self.symmetry.as_ref()
    }

    /// The weights as they are now.
    ///
    /// # Errors
    /// When the variables' lock is poisoned.
    pub fn weights(&self) -> Result<Weights<'_>> {
        let vars = variables::lock(&self.vars)?;
        Ok(Weights {
            actor: Layers::read(&vars, ACTOR, self.depths[0])?,
            critic: Layers::read(&vars, CRITIC, self.depths[1])?,
            log_std: self.log_std.to_vec1()?,
            symmetry: self.symmetry.as_ref(),
        })
    }

    /// Keeps each deviation at `min_std` or above, and alike on both sides.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn bound_std(&self, min_std: f64) -> candle_core::Result<()> {
        let mut log_std = self.log_std.to_vec1::<f32>()?;
        if let Some(symmetry) = &self.symmetry {
            let image = symmetry.policy.actions.clone().unsigned().rows(&log_std);
            for (own, image) in log_std.iter_mut().zip(image) {
                *own = 0.5 * (*own + image);
            }
        }
        for log in &mut log_std {
            *log = log.max(min_std.ln() as f32);
        }
        let width = log_std.len();
        self.log_std
            .set(&Tensor::from_vec(log_std, width, &Device::Cpu)?)
    }

    /// All variables.
    pub fn vars(&self) -> &VarMap {
        &self.vars
    }

    /// The actor's tensors, named as [`Mlp::new`] names them.
    ///
    /// # Errors
    /// When the variables' lock is poisoned.
    pub fn actor_tensors(&self) -> Result<Tensors> {
        let vars = variables::lock(&self.vars)?;
        let actor = vars.iter().filter_map(|(name, var)| {
            let name = name.strip_prefix(ACTOR)?.strip_prefix('.')?;
            Some((name.to_owned(), var))
        });
        actor
            .map(|(name, var)| Ok((name, var.as_detached_tensor().copy()?)))
            .collect()
    }
}

/// The weights of an actor and a critic at some time.
pub struct Weights<'a> {
    actor: Layers,
    critic: Layers,
    /// Logarithms of the deviations.
    pub log_std: Vec<f32>,
    symmetry: Option<&'a Symmetry>,
}

/// What one of the two networks answered.
pub struct Answers {
    /// Mean actions (N × actions), or values (N).
    pub numbers: Vec<f32>,
    activations: Activations,
}

impl Weights<'_> {
    /// Mean actions for normalised features (N × features; with a symmetry 2N, the second half their images).
    pub fn means(&self, features: Vec<f32>) -> Answers {
        let activations = self.actor.forward(features);
        let numbers = match self.symmetry {
            Some(symmetry) => symmetry.policy.fold(activations.answers()),
            None => activations.answers().to_vec(),
        };
        Answers {
            numbers,
            activations,
        }
    }

    /// Values for normalised privileged observations (N × privileged; with a symmetry 2N, the second half their images).
    pub fn values(&self, privileged: Vec<f32>) -> Answers {
        let activations = self.critic.forward(privileged);
        let answers = activations.answers();
        let numbers = match self.symmetry {
            Some(_) => {
                let (seen, mirrored) = answers.split_at(answers.len() / 2);
                let pairs = seen.iter().zip(mirrored);
                pairs.map(|(a, b)| 0.5 * (a + b)).collect()
            }
            None => answers.to_vec(),
        };
        Answers {
            numbers,
            activations,
        }
    }

    /// Gradients of all variables, in a fixed order, from those of mean actions, values and deviations.
    pub fn gradient(
        &self,
        (means, by_means): (&Answers, Vec<f32>),
        (values, by_values): (&Answers, Vec<f32>),
        by_log_std: Vec<f32>,
    ) -> Gradient {
        let (by_means, by_values) = match self.symmetry {
            Some(symmetry) => {
                let half: Vec<f32> = by_values.iter().map(|g| 0.5 * g).collect();
                (symmetry.policy.unfold(&by_means), half.repeat(2))
            }
            None => (by_means, by_values),
        };
        let actor = self.actor.backward(&means.activations, by_means);
        let critic = self.critic.backward(&values.activations, by_values);
        let mut parts = BTreeMap::new();
        for (prefix, layers) in [(ACTOR, actor), (CRITIC, critic)] {
            for (index, [weight, bias]) in layers.into_iter().enumerate() {
                parts.insert(format!("{prefix}.{index}.weight"), weight);
                parts.insert(format!("{prefix}.{index}.bias"), bias);
            }
        }
        parts.insert(LOG_STD.to_owned(), by_log_std);
        Gradient(parts)
    }
}

/// A gradient by the names of the variables.
pub struct Gradient(pub BTreeMap<String, Vec<f32>>);

impl Gradient {
    /// Adds another one.
    pub fn add(&mut self, other: &Self) {
        for (sum, part) in self.0.values_mut().zip(other.0.values()) {
            for (sum, part) in sum.iter_mut().zip(part) {
                *sum += part;
            }
        }
    }

    /// Divides it.
    pub fn divide(&mut self, by: f32) {
        for number in self.0.values_mut().flatten() {
            *number /= by;
        }
    }
}

/// A random matrix (row-major) whose rows, or columns if there are fewer, are orthogonal and of length `gain`.
fn orthogonal(rows: usize, columns: usize, gain: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let (long, short) = (rows.max(columns), rows.min(columns));
    let q = DMatrix::from_fn(long, short, |_, _| rng.random_range(-1.0..1.0))
        .qr()
        .q()
        * gain;
    // nalgebra's storage goes column by column: that of the transpose goes row by row.
    let by_rows = if rows == long { q.transpose() } else { q };
    by_rows.iter().map(|&value: &f64| value as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn last_layers_are_orthogonal() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (rows, columns) in [(12, 64), (1, 64), (5, 5), (7, 3)] {
            let weights = orthogonal(rows, columns, 0.5, &mut rng);
            let matrix = DMatrix::from_row_slice(rows, columns, &weights);
            let product = if rows <= columns {
                &matrix * matrix.transpose()
            } else {
                matrix.transpose() * &matrix
            };
            let short = rows.min(columns);
            let error = (product - DMatrix::identity(short, short) * 0.25)
                .abs()
                .max();
            assert!(error < 1e-6, "{rows} × {columns}: {error}");
        }
    }
}

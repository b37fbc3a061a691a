//! The actor and the critic.

use anyhow::{Context as _, Result};
use candle_core::{DType, Device, Tensor, Var};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{checkpoint::Tensors, mlp::Mlp};
use nalgebra::DMatrix;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

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

/// A Gaussian policy with a state-independent deviation, and the value of a state. Inputs are normalised.
pub struct ActorCritic {
    vars: VarMap,
    actor: Mlp,
    critic: Mlp,
    log_std: Var,
}

impl ActorCritic {
    /// Draws initial weights: hidden layers uniformly within `±1/√inputs`, last layers orthogonal, their biases zero.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(widths: Widths, settings: &PpoSettings, seed: u64) -> Result<Self> {
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let (actor, critic) = (&settings.actor_hidden, &settings.critic_hidden);
        let network = Self {
            actor: Mlp::new(widths.features, actor, widths.actions, &builder.pp(ACTOR))?,
            critic: Mlp::new(widths.privileged, critic, 1, &builder.pp(CRITIC))?,
            log_std: Var::new(
                vec![settings.initial_std.ln() as f32; widths.actions],
                &Device::Cpu,
            )?,
            vars,
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

    /// Mean actions (N × actions) for normalised features (N × features).
    ///
    /// # Errors
    /// When the features have another width.
    pub fn means(&self, features: &Tensor) -> candle_core::Result<Tensor> {
        self.actor.forward(features)
    }

    /// Values (N) for normalised privileged observations (N × privileged).
    ///
    /// # Errors
    /// When the observations have another width.
    pub fn values(&self, privileged: &Tensor) -> candle_core::Result<Tensor> {
        self.critic.forward(privileged)?.flatten_all()
    }

    /// Logarithms of the deviations.
    pub fn log_std(&self) -> &Tensor {
        self.log_std.as_tensor()
    }

    /// Keeps each deviation at `min_std` or above.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn bound_std(&self, min_std: f64) -> candle_core::Result<()> {
        self.log_std
            .set(&self.log_std.detach().maximum(min_std.ln())?)
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

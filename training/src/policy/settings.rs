//! Settings of a policy's training. Two runs with the same settings, data and binary make the same bits.

use emp_sim::environment::EnvironmentConfig;
use serde::{Deserialize, Serialize};

use super::curriculum::CurriculumSettings;

/// Everything that shapes a run but the robot and its data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Seed of weights, episodes and mini-batches.
    pub seed: u64,
    /// Environments stepped side by side.
    pub environments: usize,
    /// Control periods collected between two updates.
    pub horizon: usize,
    /// Rollouts with random actions from which normalisation starts, before anything is learnt.
    pub warm_up: usize,
    /// Environment steps between two deterministic evaluations.
    pub evaluate_every: u64,
    /// Procedural clips of such an evaluation.
    pub evaluation_clips: usize,
    /// Procedural clips in the goal library.
    pub procedural_clips: usize,
    /// The learner.
    pub ppo: PpoSettings,
    /// How difficulty rises.
    pub curriculum: CurriculumSettings,
    /// Rewards, randomisation, termination.
    pub environment: EnvironmentConfig,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            seed: 1,
            environments: 256,
            horizon: 32,
            warm_up: 3,
            evaluate_every: 500_000,
            evaluation_clips: 128,
            procedural_clips: 1000,
            ppo: PpoSettings::default(),
            curriculum: CurriculumSettings::default(),
            environment: EnvironmentConfig::default(),
        }
    }
}

/// Proximal policy optimisation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PpoSettings {
    /// Widths of the actor's hidden layers.
    pub actor_hidden: Vec<usize>,
    /// Widths of the critic's hidden layers.
    pub critic_hidden: Vec<usize>,
    /// Passes over a rollout.
    pub epochs: usize,
    /// Mini-batches a pass.
    pub mini_batches: usize,
    /// Parts of a mini-batch whose gradients are computed in parallel and added in order. Fixed, whatever the number of
    /// threads: the sum's last bits depend on it.
    pub shards: usize,
    /// Discount γ.
    pub discount: f64,
    /// Decay λ of the generalised advantage estimate.
    pub trace_decay: f64,
    /// The probability ratio is clipped to 1 ± this.
    pub clip: f64,
    /// Weight of the squared value error.
    pub value_weight: f64,
    /// Weight of the entropy bonus.
    pub entropy_weight: f64,
    /// Bound of the gradient's norm, over actor and critic together.
    pub max_gradient_norm: f64,
    /// Bounds of the step size; it starts at the upper one.
    pub learning_rate: [f64; 2],
    /// The step size follows this Kullback–Leibler divergence between the policy before the update and now.
    pub target_divergence: f64,
    /// Standard deviation of exploration at the start, policy units.
    pub initial_std: f64,
    /// Floor of the standard deviation.
    pub min_std: f64,
    /// How left–right symmetry is used.
    pub symmetry: Symmetry,
}

impl Default for PpoSettings {
    fn default() -> Self {
        Self {
            actor_hidden: vec![256, 128, 64],
            critic_hidden: vec![256, 128, 64],
            epochs: 5,
            mini_batches: 4,
            shards: 4,
            discount: 0.99,
            trace_decay: 0.95,
            clip: 0.2,
            value_weight: 1.0,
            entropy_weight: 0.0,
            max_gradient_norm: 1.0,
            learning_rate: [5e-5, 1e-3],
            target_divergence: 0.01,
            initial_std: 0.3,
            min_std: 0.05,
            symmetry: Symmetry::None,
        }
    }
}

/// How a learner uses that the robot is its own mirror image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Symmetry {
    /// Not at all.
    None,
    /// Every other pass over a rollout sees it in the mirror.
    Augmentation,
    /// A loss on the difference between an action and the mirrored action of the mirrored observation.
    Loss,
}

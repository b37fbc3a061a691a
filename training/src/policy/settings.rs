//! Settings of a policy's training. Two runs with the same settings, data and binary make the same bits.

use anyhow::{Result, ensure};
use emp_robot::Robot;
use emp_sim::{Physics, environment::EnvironmentConfig};
use serde::{Deserialize, Serialize};

use super::{curriculum::CurriculumSettings, sampler::SamplerSettings};
use crate::change;

/// Settings to start from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Preset {
    /// Rewards and randomisation as the paper prints them.
    Paper,
    /// For a robot that may step: a price for falls, harder pushes, heavier hands, sensors with noise and drift.
    Robust,
}

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
    /// Procedural clips of such an evaluation, beside the recorded ones.
    pub evaluation_clips: usize,
    /// Procedural clips in the goal library.
    pub procedural_clips: usize,
    /// The learner.
    pub ppo: PpoSettings,
    /// How difficulty rises.
    pub curriculum: CurriculumSettings,
    /// How often each clip is drawn.
    pub sampler: SamplerSettings,
    /// Rewards, randomisation, termination.
    pub environment: EnvironmentConfig,
}

impl Settings {
    /// The settings of a preset for `robot`.
    pub fn preset(preset: Preset, robot: &Robot) -> Self {
        Self {
            seed: 1,
            environments: 384,
            horizon: 32,
            warm_up: 3,
            evaluate_every: 2_000_000,
            evaluation_clips: 48,
            procedural_clips: 1000,
            ppo: PpoSettings::default(),
            curriculum: CurriculumSettings::default(),
            sampler: SamplerSettings::default(),
            environment: EnvironmentConfig {
                physics: Physics::Fast,
                ..match preset {
                    Preset::Paper => EnvironmentConfig::default(),
                    Preset::Robust => EnvironmentConfig::robust(robot),
                }
            },
        }
    }

    /// Changes one setting: `key` is its path with dots, as in `ppo.discount`; `value` is JSON, or a bare word.
    ///
    /// # Errors
    /// When there is no such setting, or it cannot have that value.
    pub fn set(&mut self, key: &str, value: &str) -> Result<()> {
        *self = change::setting(self, key, value)?;
        Ok(())
    }

    /// Refuses settings with which nothing can be learnt.
    ///
    /// # Errors
    /// Names the setting.
    pub fn check(&self) -> Result<()> {
        let counts = [
            ("environments", self.environments),
            ("horizon", self.horizon),
            ("evaluation_clips", self.evaluation_clips),
            ("ppo.epochs", self.ppo.epochs),
            ("ppo.mini_batches", self.ppo.mini_batches),
            ("ppo.shards", self.ppo.shards),
        ];
        for (name, count) in counts {
            ensure!(count > 0, "setting `{name}` is 0, expected at least 1");
        }
        ensure!(
            self.evaluate_every > 0,
            "setting `evaluate_every` is 0, expected at least 1"
        );
        Ok(())
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
}

impl Default for PpoSettings {
    fn default() -> Self {
        Self {
            actor_hidden: vec![256, 128, 64],
            critic_hidden: vec![256, 128, 64],
            epochs: 4,
            mini_batches: 4,
            shards: 4,
            discount: 0.995,
            trace_decay: 0.95,
            clip: 0.2,
            value_weight: 1.0,
            entropy_weight: 0.0,
            max_gradient_norm: 1.0,
            learning_rate: [1e-5, 1e-3],
            target_divergence: 0.01,
            initial_std: 0.3,
            min_std: 0.05,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_can_be_trained_and_changed_by_path_and_mistakes_are_named() {
        let robot = Robot::load("../robots/emp27".as_ref()).unwrap();
        let paper = Settings::preset(Preset::Paper, &robot);
        let mut settings = Settings::preset(Preset::Robust, &robot);
        for settings in [&paper, &settings] {
            settings.check().unwrap();
            settings.environment.check(&robot).unwrap();
        }
        assert_eq!(
            paper.environment.rewards,
            EnvironmentConfig::default().rewards
        );
        assert_eq!(
            paper.environment.randomization,
            EnvironmentConfig::default().randomization
        );
        assert!(settings.environment.randomization.sensors.is_some());
        settings.set("ppo.discount", "0.9").unwrap();
        settings
            .set("environment.randomization.sensors", "null")
            .unwrap();
        settings.set("environment.physics", "exact").unwrap();
        assert_eq!(settings.ppo.discount, 0.9);
        assert_eq!(settings.environment.randomization.sensors, None);
        assert_eq!(settings.environment.physics, Physics::Exact);
        for (key, value) in [("ppo.symmetry", "none"), ("horizon", "-1")] {
            let error = settings.set(key, value).unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
        settings.set("horizon", "0").unwrap();
        assert!(
            settings
                .check()
                .unwrap_err()
                .to_string()
                .contains("horizon")
        );
    }
}

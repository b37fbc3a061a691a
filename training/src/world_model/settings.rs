//! Settings of a world model's training. Two runs with the same settings, data and binary make the same bits.

use anyhow::{Result, ensure};
use emp_sim::tracking::TrackingSettings;
use serde::{Deserialize, Serialize};

/// Everything that shapes a run but the robot and its data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorldModelSettings {
    /// Seed of weights, episodes and batches.
    pub seed: u64,
    /// Steps of the optimiser.
    pub steps: u64,
    /// Environments stepped side by side.
    pub environments: usize,
    /// Control periods collected in a round.
    pub frames: usize,
    /// Rounds collected before anything is learnt; scaling follows from them.
    pub warm_up: usize,
    /// Steps of the optimiser in a round.
    pub updates: usize,
    /// Control periods that are kept to draw batches from.
    pub capacity: usize,
    /// Sequences in a batch.
    pub rows: usize,
    /// Share of a batch that is drawn from tilted robots.
    pub tilted: f64,
    /// |roll| + |pitch| beyond which a robot is tilted, rad.
    pub tilt: f64,
    /// Control periods that the loss predicts from the model's own predictions; 1 is the paper's.
    pub wm_loss_steps: usize,
    /// Share of the steps in which the loss predicts one control period only, before it predicts all of them.
    pub one_step: f64,
    /// Step size at the start; it falls along a cosine.
    pub learning_rate: f64,
    /// Largest standard deviation of the slow noise on goals, rad: without it goals and robot always agree, and what a
    /// changed goal does could not be told.
    pub goal_noise: f64,
    /// The learner.
    pub learner: LearnerSettings,
    /// The motion and the conditions of the episodes.
    pub episodes: TrackingSettings,
    /// Share of the clips that come from the retargeting network alone, with its jitter.
    pub live: f64,
    /// Procedural motions in the training set.
    pub procedural_clips: usize,
}

/// The network and its steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnerSettings {
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Parts of a batch whose gradients are computed in parallel and added in order. Fixed, whatever the number of
    /// threads: the sum's last bits depend on it.
    pub shards: usize,
    /// Bound of the gradient's norm.
    pub max_gradient_norm: f64,
}

impl Default for LearnerSettings {
    fn default() -> Self {
        Self {
            hidden: vec![1024, 512],
            shards: 4,
            max_gradient_norm: 1.0,
        }
    }
}

impl Default for WorldModelSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            steps: 5000,
            environments: 128,
            frames: 50,
            warm_up: 4,
            updates: 25,
            capacity: 100_000,
            rows: 256,
            tilted: 0.3,
            tilt: 0.15,
            wm_loss_steps: 10,
            one_step: 0.7,
            learning_rate: 1e-3,
            goal_noise: 0.15,
            learner: LearnerSettings::default(),
            episodes: TrackingSettings::default(),
            live: 0.25,
            procedural_clips: 600,
        }
    }
}

impl WorldModelSettings {
    /// Refuses settings with which nothing can be learnt.
    ///
    /// # Errors
    /// Names the setting.
    pub fn check(&self) -> Result<()> {
        for (name, count) in [
            ("environments", self.environments),
            ("warm_up", self.warm_up),
            ("updates", self.updates),
            ("rows", self.rows),
            ("wm_loss_steps", self.wm_loss_steps),
            ("shards", self.learner.shards),
        ] {
            ensure!(count > 0, "setting `{name}` is 0, expected at least 1");
        }
        ensure!(
            self.frames >= self.wm_loss_steps,
            "setting `frames` is {}, expected at least `wm_loss_steps`, {}",
            self.frames,
            self.wm_loss_steps
        );
        ensure!(
            self.capacity >= self.environments * self.frames,
            "setting `capacity` is {}, expected at least `environments` × `frames`, {}",
            self.capacity,
            self.environments * self.frames
        );
        for (name, share) in [
            ("tilted", self.tilted),
            ("one_step", self.one_step),
            ("live", self.live),
        ] {
            ensure!(
                (0.0..=1.0).contains(&share),
                "setting `{name}` is {share}, expected a share from 0 to 1"
            );
        }
        ensure!(
            self.goal_noise >= 0.0 && self.learning_rate > 0.0,
            "settings `goal_noise` and `learning_rate` must not be negative, nor `learning_rate` 0"
        );
        Ok(())
    }

    /// Control periods that the loss of step `step` predicts.
    pub fn loss_steps(&self, step: u64) -> usize {
        if (step as f64) < self.one_step * self.steps as f64 {
            1
        } else {
            self.wm_loss_steps
        }
    }

    /// Step size of step `step`.
    pub fn learning_rate(&self, step: u64) -> f64 {
        /// Share of the first step size that is left at the end.
        const LEAST: f64 = 0.02;
        let progress = step as f64 / self.steps.max(1) as f64;
        let falling = (1.0 + (std::f64::consts::PI * progress).cos()) / 2.0;
        self.learning_rate * (LEAST + (1.0 - LEAST) * falling)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mistakes_are_named() {
        WorldModelSettings::default().check().unwrap();
        let error = |settings: WorldModelSettings| settings.check().unwrap_err().to_string();
        let settings = WorldModelSettings {
            wm_loss_steps: 0,
            ..WorldModelSettings::default()
        };
        assert!(error(settings).contains("`wm_loss_steps` is 0"));
        let settings = WorldModelSettings {
            frames: 5,
            ..WorldModelSettings::default()
        };
        assert!(error(settings).contains("at least `wm_loss_steps`, 10"));
        let settings = WorldModelSettings {
            tilted: f64::NAN,
            ..WorldModelSettings::default()
        };
        assert!(error(settings).contains("`tilted`"));
    }

    #[test]
    fn one_period_comes_first_and_the_step_size_falls() {
        let settings = WorldModelSettings {
            steps: 100,
            ..WorldModelSettings::default()
        };
        assert_eq!(
            [0, 69, 70, 99].map(|s| settings.loss_steps(s)),
            [1, 1, 10, 10]
        );
        let rates = [0, 50, 100].map(|step| settings.learning_rate(step) / settings.learning_rate);
        for (rate, expected) in rates.iter().zip([1.0, 0.51, 0.02]) {
            assert!((rate - expected).abs() < 1e-9, "{rate} {expected}");
        }
    }
}

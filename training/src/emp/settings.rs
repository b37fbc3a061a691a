//! Settings of an EMP's training. Two runs with the same settings, data and binary make the same bits.

use anyhow::{Context as _, Result, bail};
use emp_models::{
    emp::{DangerGate, EmpConfig, Output},
    observation::{HISTORY, HistoryMap, ObservationLayout},
};
use emp_robot::Robot;
use emp_sim::tracking::TrackingSettings;
use serde::{Deserialize, Serialize};

use super::losses::{CenOn, CenRef, LossSettings, LossWeights, SmoothOn};
use crate::world_model::settings::LearnerSettings;

/// A set of settings with a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// The printed form: the paper's sizes, an absolute answer, losses on one imagined step.
    Paper,
    /// The best that we found: a small network, a correction, and a price on falls that is learnt from real rollouts.
    Default,
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
    pub frames: usize,
    /// Control periods with unchanged goals, before anything is learnt: normalisation and the policy's operating point follow
    /// from them.
    pub warm_up: usize,
    /// The networks.
    pub network: NetworkSettings,
    /// The six losses.
    pub losses: LossSettings,
    /// Imagined control periods over which the losses are taken; 1 is the paper's. 0: nothing is imagined, and the losses see
    /// ĝ and the measured robot alone.
    pub horizon: usize,
    /// Control periods of the world model's loss beyond which it is not followed; 1 is the paper's.
    pub wm_loss_steps: usize,
    /// How the world model learns, where anything is imagined.
    pub world_model: WorldModelSettings,
    /// What should have been asked for before a fall.
    pub hindsight: HindsightSettings,
    /// What contacts and falls cost, learnt from real rollouts.
    pub risk: RiskSettings,
    /// Steps of the optimiser.
    pub optimizer: OptimizerSettings,
    /// The motion and the conditions of the episodes.
    pub episodes: TrackingSettings,
    /// Share of the clips that come from the network alone, with its jitter, as a live stream without refinement would.
    pub live: f64,
    /// Environment steps between two evaluations.
    pub evaluate_every: u64,
    /// Procedural clips of such an evaluation.
    pub evaluation_clips: usize,
    /// Procedural motions in the training set.
    pub procedural_clips: usize,
}

/// Shape of an EMP: see [`EmpConfig`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkSettings {
    /// The state encoder sees differences of frames instead of whole stacks.
    pub differences: bool,
    /// What the decoder's answer means.
    pub output: Output,
    /// Widths of the state encoder's hidden layers.
    pub state_hidden: Vec<usize>,
    /// Widths of the target encoder's hidden layers.
    pub target_hidden: Vec<usize>,
    /// Width of z₁ and of z₂.
    pub encoding: usize,
    /// Widths of the fusion network's hidden layers.
    pub fusion_hidden: Vec<usize>,
    /// Width of the latent z.
    pub latent: usize,
    /// Widths of the decoder's hidden layers.
    pub decoder_hidden: Vec<usize>,
    /// When "EMP when danger" filters.
    pub gate: DangerGate,
}

impl NetworkSettings {
    /// The shape for `robot`.
    pub fn config(&self, robot: &Robot) -> EmpConfig {
        EmpConfig {
            observation: ObservationLayout::new(robot, HISTORY),
            history_map: if self.differences {
                HistoryMap::differences()
            } else {
                HistoryMap::identity(HISTORY)
            },
            output: self.output,
            state_hidden: self.state_hidden.clone(),
            target_hidden: self.target_hidden.clone(),
            encoding: self.encoding,
            fusion_hidden: self.fusion_hidden.clone(),
            latent: self.latent,
            decoder_hidden: self.decoder_hidden.clone(),
            gate: self.gate,
        }
    }
}

/// How the world model learns beside the EMP.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorldModelSettings {
    /// Mini-batches after each rollout.
    pub updates: usize,
    /// Rows of a mini-batch.
    pub rows: usize,
    /// Step size.
    pub learning_rate: f64,
    /// Its network.
    pub learner: LearnerSettings,
}

/// The lesson of falls. Once the robot has fallen, it is known of every moment of the last second or two that its goal should have
/// been nearer the default pose. Where such moments look like others that end well, the EMP answers between the two.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HindsightSettings {
    /// Weight of ‖ĝ − (g₀ + amplitude · (g − g₀))‖² in the moments before a fall, g₀ the default pose. 0: no such loss.
    pub weight: f64,
    /// Control periods before a fall that count.
    pub frames: usize,
    /// Share of the distance from the default pose that should have been asked for.
    pub amplitude: f64,
    /// Words in the names of the goal joints of which that is said: those that fell the robot.
    pub joints: Vec<String>,
}

/// The price of falls and of what leads to them. One imagined period cannot see a fall that builds up over a second, and the
/// simulator has no gradient; so the gradient of the expected cost of what really follows is estimated from rollouts with
/// explored goals, by proximal policy optimisation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RiskSettings {
    /// Weight of the expected cost beside the six losses. 0: no exploration, no risk term.
    pub weight: f64,
    /// Cost of a fall.
    pub fall: f64,
    /// Cost of one period of `L_ori`, of the measured base.
    pub orientation: f64,
    /// Cost of one period of `L_cen`, where it is positive: of the measured centre of mass away from the policy's operating
    /// point.
    pub centroid: f64,
    /// Cost of one period with 100 N between the robot's own links.
    pub contact: f64,
    /// Discount γ.
    pub discount: f64,
    /// Decay λ of the generalised advantage estimate.
    pub trace_decay: f64,
    /// The probability ratio is clipped to 1 ± this.
    pub clip: f64,
    /// Standard deviation of what is new in exploration in a control period, rad.
    pub std: f64,
    /// Share of the exploration of one control period that stays in the next; 0: white noise. A fall builds up over a
    /// second: what lasts shows its effect, what is gone after 20 ms does not.
    pub persistence: f64,
    /// The step size follows this divergence between the EMP before the update and now.
    pub target_divergence: f64,
    /// Widths of the critic's hidden layers.
    pub critic_hidden: Vec<usize>,
    /// Step size of the critic.
    pub critic_learning_rate: f64,
}

/// Steps of the optimiser after each rollout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimizerSettings {
    /// Mini-batches after each rollout.
    pub updates: usize,
    /// Rows of a mini-batch; all rows of a rollout are used before one is used again.
    pub rows: usize,
    /// Parts of a mini-batch whose gradients are computed in parallel and added in order. Fixed, whatever the number of
    /// threads: the sum's last bits depend on it.
    pub shards: usize,
    /// Bounds of the step size; it starts at the upper one, and stays there without risk.
    pub learning_rate: [f64; 2],
    /// Bound of the gradient's norm.
    pub max_gradient_norm: f64,
    /// What is served is a running mean of the weights: after each rollout it keeps this share of itself. 0: the last weights.
    pub averaging: f64,
}

impl Settings {
    /// The settings of a preset.
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Paper => Self::paper(),
            Preset::Default => Self::best(),
        }
    }

    fn paper() -> Self {
        Self {
            seed: 1,
            environments: 128,
            frames: 32,
            warm_up: 64,
            network: NetworkSettings {
                differences: false,
                output: Output::Absolute,
                state_hidden: vec![1024, 1024],
                target_hidden: vec![1024, 1024],
                encoding: 64,
                fusion_hidden: vec![2048, 2048],
                latent: 32,
                decoder_hidden: vec![2048, 2048],
                gate: DangerGate::PAPER,
            },
            losses: LossSettings::default(),
            horizon: 1,
            wm_loss_steps: 1,
            world_model: WorldModelSettings {
                updates: 8,
                rows: 256,
                learning_rate: 5e-4,
                learner: LearnerSettings::default(),
            },
            hindsight: HindsightSettings {
                weight: 0.0,
                frames: 100,
                amplitude: 0.4,
                joints: ["waist", "shoulder_pitch", "shoulder_roll"]
                    .map(str::to_owned)
                    .to_vec(),
            },
            risk: RiskSettings {
                weight: 0.0,
                fall: 1.0,
                orientation: 0.05,
                centroid: 0.0,
                contact: 0.01,
                discount: 0.99,
                trace_decay: 0.95,
                clip: 0.2,
                std: 0.03,
                persistence: 0.95,
                target_divergence: 0.01,
                critic_hidden: vec![256, 128, 64],
                critic_learning_rate: 1e-3,
            },
            optimizer: OptimizerSettings {
                updates: 8,
                rows: 256,
                shards: 4,
                learning_rate: [1e-4, 1e-4],
                max_gradient_norm: 10.0,
                averaging: 0.0,
            },
            episodes: TrackingSettings::default(),
            live: 0.25,
            evaluate_every: 500_000,
            evaluation_clips: 128,
            procedural_clips: 1000,
        }
    }

    fn best() -> Self {
        let paper = Self::paper();
        Self {
            environments: 256,
            frames: 200,
            network: NetworkSettings {
                differences: true,
                output: Output::Residual,
                state_hidden: vec![256, 128],
                target_hidden: vec![128, 128],
                encoding: 64,
                fusion_hidden: vec![256, 128],
                latent: 32,
                decoder_hidden: vec![128, 128],
                gate: DangerGate::PAPER,
            },
            losses: LossSettings {
                weights: LossWeights {
                    orientation: 0.0,
                    collision: 0.0,
                    centroid: 0.0,
                    regularization: 0.01,
                    ..LossWeights::default()
                },
                smooth_on: SmoothOn::Correction,
                cen_on: CenOn::QuasiStatic,
                cen_ref: CenRef::Measured,
            },
            horizon: 0,
            hindsight: HindsightSettings {
                weight: 150.0,
                ..paper.hindsight.clone()
            },
            risk: RiskSettings {
                weight: 1000.0,
                fall: 0.0,
                orientation: 0.0,
                contact: 0.012,
                target_divergence: 0.03,
                ..paper.risk.clone()
            },
            optimizer: OptimizerSettings {
                updates: 60,
                rows: 2048,
                shards: 4,
                learning_rate: [3e-4, 1e-3],
                max_gradient_norm: 10.0,
                averaging: 0.9,
            },
            episodes: TrackingSettings {
                amplitude: [0.5, 2.0],
                pushed: 0.1,
                randomized: 0.1,
                ..paper.episodes
            },
            ..paper
        }
    }

    /// Changes one setting: `key` is its path with dots, as in `risk.weight`; `value` is JSON, or a bare word.
    ///
    /// # Errors
    /// When there is no such setting, or it cannot have that value.
    pub fn set(&mut self, key: &str, value: &str) -> Result<()> {
        let mut settings = serde_json::to_value(&*self)?;
        let place = key
            .split('.')
            .try_fold(&mut settings, |place, name| place.get_mut(name));
        let Some(place) = place else {
            bail!("no setting `{key}`; --print-settings shows all");
        };
        *place = serde_json::from_str(value)
            .unwrap_or_else(|_| serde_json::Value::String(value.to_owned()));
        *self = serde_json::from_value(settings)
            .with_context(|| format!("setting `{key}` cannot be {value}"))?;
        Ok(())
    }

    /// Refuses settings with which nothing can be learnt.
    ///
    /// # Errors
    /// Names the setting.
    pub fn check(&self) -> Result<()> {
        let counts = [
            ("environments", self.environments),
            ("frames", self.frames),
            ("warm_up", self.warm_up),
            ("wm_loss_steps", self.wm_loss_steps),
            ("world_model.updates", self.world_model.updates),
            ("world_model.rows", self.world_model.rows),
            (
                "world_model.learner.shards",
                self.world_model.learner.shards,
            ),
            ("optimizer.updates", self.optimizer.updates),
            ("optimizer.rows", self.optimizer.rows),
            ("optimizer.shards", self.optimizer.shards),
            ("evaluation_clips", self.evaluation_clips),
        ];
        if let Some((name, _)) = counts.iter().find(|(_, count)| *count == 0) {
            bail!("setting `{name}` is 0, expected at least 1");
        }
        for (name, steps) in [
            ("horizon", self.horizon),
            ("wm_loss_steps", self.wm_loss_steps),
        ] {
            if steps > self.frames {
                let frames = self.frames;
                bail!("setting `{name}` is {steps}, expected at most `frames`, {frames}");
            }
        }
        let averaging = self.optimizer.averaging;
        if !(0.0..1.0).contains(&averaging) {
            bail!(
                "setting `optimizer.averaging` is {averaging}, expected 0 or more and less than 1"
            );
        }
        let hindsight = &self.hindsight;
        if hindsight.weight > 0.0 && !(1..self.frames).contains(&hindsight.frames) {
            bail!(
                "setting `hindsight.frames` is {}, expected 1 or more and less than `frames`, {}",
                hindsight.frames,
                self.frames
            );
        }
        if !(0.0..=1.0).contains(&self.live) {
            bail!(
                "setting `live` is {}, expected a share from 0 to 1",
                self.live
            );
        }
        if self.risk.weight < 0.0 || self.risk.std <= 0.0 {
            bail!("settings `risk.weight` and `risk.std` must not be negative, nor `risk.std` 0");
        }
        if !(0.0..1.0).contains(&self.risk.persistence) {
            let persistence = self.risk.persistence;
            bail!(
                "setting `risk.persistence` is {persistence}, expected 0 or more and less than 1"
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_changed_by_their_path_and_mistakes_are_named() {
        let mut settings = Settings::preset(Preset::Paper);
        settings.set("risk.weight", "20").unwrap();
        settings.set("losses.smooth_on", "correction").unwrap();
        settings.set("network.gate", r#"{"tilt": 0.3}"#).unwrap();
        settings.set("network.state_hidden", "[32]").unwrap();
        assert_eq!(settings.risk.weight, 20.0);
        assert_eq!(settings.losses.smooth_on, SmoothOn::Correction);
        assert_eq!(settings.network.gate, DangerGate::Tilt(0.3));
        assert_eq!(settings.network.state_hidden, [32]);
        for (key, value) in [
            ("risk.wait", "1"),
            ("horizon", "-1"),
            ("losses.cen_on", "moon"),
        ] {
            let before = settings.clone();
            let error = settings.set(key, value).unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
            assert_eq!(settings, before);
        }
        settings.set("optimizer.rows", "0").unwrap();
        let error = settings.check().unwrap_err().to_string();
        assert!(error.contains("optimizer.rows"), "{error}");
    }

    #[test]
    fn the_presets_can_be_trained_and_the_papers_is_the_papers() {
        let robot = Robot::load("../robots/emp27".as_ref()).unwrap();
        for preset in [Preset::Paper, Preset::Default] {
            Settings::preset(preset).check().unwrap();
        }
        let paper = Settings::preset(Preset::Paper);
        assert_eq!(paper.network.config(&robot), EmpConfig::paper(&robot));
        assert_eq!(paper.losses, LossSettings::default());
        assert_eq!(
            (paper.horizon, paper.wm_loss_steps, paper.risk.weight),
            (1, 1, 0.0)
        );
    }
}

//! Settings of an EMP's training. Two runs with the same settings, data and binary make the same bits.

use anyhow::{Result, bail};
use emp_models::{
    emp::{DangerGate, EmpConfig, Output},
    observation::{HISTORY, HistoryMap, ObservationLayout},
};
use emp_robot::Robot;
use emp_sim::tracking::TrackingSettings;
use serde::{Deserialize, Serialize};

use super::losses::{CenOn, CenRef, Distance, LossSettings, LossWeights, SmoothOn};
use crate::change;

/// A set of settings with a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// The printed form: the paper's sizes, an absolute answer, losses on one imagined step.
    Paper,
    /// The best that we found: a small network, a correction, and what hindsight says of falls and contacts.
    Default,
}

/// Everything that shapes a run but the robot and its data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmpSettings {
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
    /// Imagined control periods over which the losses are taken; 1 is the paper's, and a world model is needed. 0: nothing is
    /// imagined, and the losses see ĝ and the measured robot alone.
    pub horizon: usize,
    /// What should have been asked for before a fall.
    pub hindsight: HindsightSettings,
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

/// The lesson of falls and contacts: see [`Hindsight`](super::hindsight::Hindsight).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HindsightSettings {
    /// Weight of the distance to what should have been executed against a fall. With it the reconstruction loss counts only where
    /// the goal is known to have been right. 0: no hindsight.
    pub weight: f64,
    /// The same against a contact. 0: nothing is learnt from contacts.
    pub contact_weight: f64,
    /// Control periods from one fork point to the next.
    pub window: usize,
    /// Control periods within which a fall belongs to a fork point.
    pub horizon: usize,
    /// Fork points run again after a rollout, at most, times the goals that are tried in each.
    pub replays: usize,
    /// Mean change of a goal angle in a window that has to prove that it is needed, rad.
    pub change: f64,
    /// Mean force between the robot's own links in a window that is too much, N.
    pub contact: f64,
    /// Rows that had to be changed against a fall which are remembered.
    pub memory: usize,
    /// Of them, rows beside each mini-batch.
    pub rows: usize,
    /// What is tried before a fall.
    pub against_falls: Vec<Remedy>,
    /// What is tried where links press on one another.
    pub against_contacts: Vec<Remedy>,
}

/// Tamer goals.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Remedy {
    /// Words in the names of the goal joints that it is for; the others stay as the EMP has them.
    pub joints: Vec<String>,
    /// Share of the distance from the default pose that is left.
    pub amplitude: f64,
    /// Highest speed of a goal angle, rad/s.
    pub speed: f64,
}

impl Remedy {
    fn new(joints: &[&str], amplitude: f64, speed: f64) -> Self {
        Self {
            joints: joints.iter().map(|word| (*word).to_owned()).collect(),
            amplitude,
            speed,
        }
    }

    /// The remedy as a filter's specification, for goals that nothing else changes.
    pub fn filter(&self) -> String {
        let Self {
            joints,
            amplitude,
            speed,
        } = self;
        let joints = joints.join("+");
        let limit = format!("velocity-limit:limit={speed},joints={joints}");
        if *amplitude == 1.0 {
            return limit;
        }
        format!("amplitude-cut:factor={amplitude},joints={joints}>{limit}")
    }

    /// What falls of the shipped policy call for: waist, shoulder pitch and roll fell it (docs/emp.md).
    fn against_falls() -> Vec<Self> {
        let joints = ["waist", "shoulder_pitch", "shoulder_roll"];
        [(1.0, 1.5), (0.8, 3.0), (0.6, 3.0), (0.4, 3.0)]
            .map(|(amplitude, speed)| Self::new(&joints, amplitude, speed))
            .to_vec()
    }

    /// Arms that rub along the body.
    fn against_contacts() -> Vec<Self> {
        let joints: [(&[&str], f64); 6] = [
            (&["shoulder_roll"], 0.75),
            (&["shoulder_roll"], 0.5),
            (&["shoulder_roll"], 0.0),
            (&["elbow"], 0.75),
            (&["elbow"], 0.5),
            (&["shoulder", "elbow"], 0.5),
        ];
        joints
            .map(|(joints, amplitude)| Self::new(joints, amplitude, 3.0))
            .to_vec()
    }
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
    /// Step size.
    pub learning_rate: f64,
    /// Bound of the gradient's norm.
    pub max_gradient_norm: f64,
    /// What is served is a running mean of the weights: after each rollout it keeps this share of itself. 0: the last weights.
    pub averaging: f64,
}

impl EmpSettings {
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
            hindsight: HindsightSettings {
                weight: 0.0,
                contact_weight: 0.0,
                window: 50,
                horizon: 150,
                replays: 640,
                change: 0.01,
                contact: 2.0,
                memory: 60_000,
                rows: 512,
                against_falls: Remedy::against_falls(),
                against_contacts: Remedy::against_contacts(),
            },
            optimizer: OptimizerSettings {
                updates: 8,
                rows: 256,
                shards: 4,
                learning_rate: 1e-4,
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
            environments: 128,
            frames: 400,
            network: NetworkSettings {
                differences: true,
                output: Output::Residual,
                state_hidden: vec![256, 128],
                target_hidden: vec![128, 128],
                encoding: 64,
                fusion_hidden: vec![256, 128],
                latent: 32,
                decoder_hidden: vec![128, 128],
                // What 1 % of the frames of nominal training motion exceed.
                gate: DangerGate::Regloss(0.0055),
            },
            losses: LossSettings {
                distance: Distance::Length,
                weights: LossWeights {
                    reconstruction: 4.0,
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
                weight: 300.0,
                ..paper.hindsight.clone()
            },
            optimizer: OptimizerSettings {
                updates: 60,
                rows: 2048,
                shards: 4,
                learning_rate: 1e-3,
                max_gradient_norm: 10.0,
                averaging: 0.9,
            },
            episodes: TrackingSettings {
                episode_frames: 400,
                amplitude: [0.6, 2.2],
                pushed: 0.1,
                randomized: 0.1,
                ..paper.episodes
            },
            ..paper
        }
    }

    /// Control periods between two fork points of a rollout; 0: there are none.
    pub fn fork_interval(&self) -> usize {
        if self.hindsight.weight > 0.0 {
            self.hindsight.window
        } else {
            0
        }
    }

    /// Changes one setting: `key` is its path with dots, as in `hindsight.weight`; `value` is JSON, or a bare word.
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
            ("frames", self.frames),
            ("warm_up", self.warm_up),
            ("optimizer.updates", self.optimizer.updates),
            ("optimizer.rows", self.optimizer.rows),
            ("optimizer.shards", self.optimizer.shards),
            ("evaluation_clips", self.evaluation_clips),
        ];
        if let Some((name, _)) = counts.iter().find(|(_, count)| *count == 0) {
            bail!("setting `{name}` is 0, expected at least 1");
        }
        let (horizon, frames) = (self.horizon, self.frames);
        if horizon > frames {
            bail!("setting `horizon` is {horizon}, expected at most `frames`, {frames}");
        }
        let averaging = self.optimizer.averaging;
        if !(0.0..1.0).contains(&averaging) {
            bail!(
                "setting `optimizer.averaging` is {averaging}, expected 0 or more and less than 1"
            );
        }
        self.check_hindsight()?;
        if !(0.0..=1.0).contains(&self.live) {
            bail!(
                "setting `live` is {}, expected a share from 0 to 1",
                self.live
            );
        }
        Ok(())
    }

    fn check_hindsight(&self) -> Result<()> {
        let (hindsight, frames) = (&self.hindsight, self.frames);
        if hindsight.weight == 0.0 {
            return Ok(());
        }
        let HindsightSettings {
            window, horizon, ..
        } = hindsight;
        let mut remedies = hindsight
            .against_falls
            .iter()
            .chain(&hindsight.against_contacts);
        if let Some(remedy) = remedies.find(|remedy| {
            !(remedy.speed > 0.0 && remedy.speed.is_finite() && remedy.amplitude.is_finite())
        }) {
            bail!(
                "a remedy of `hindsight` is {remedy:?}, expected a speed above 0 and a finite amplitude"
            );
        }
        for (name, count) in [("memory", hindsight.memory), ("rows", hindsight.rows)] {
            if count == 0 {
                bail!("setting `hindsight.{name}` is 0, expected at least 1");
            }
        }
        if !(1..=frames).contains(horizon) {
            bail!(
                "setting `hindsight.horizon` is {horizon}, expected 1 or more and at most `frames`, {frames}"
            );
        }
        if !(1..=*horizon).contains(window) {
            bail!(
                "setting `hindsight.window` is {window}, expected 1 or more and at most `hindsight.horizon`, {horizon}"
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
        let mut settings = EmpSettings::preset(Preset::Paper);
        settings.set("hindsight.weight", "20").unwrap();
        settings.set("losses.smooth_on", "correction").unwrap();
        settings.set("network.gate", r#"{"tilt": 0.3}"#).unwrap();
        settings.set("network.state_hidden", "[32]").unwrap();
        assert_eq!(settings.hindsight.weight, 20.0);
        assert_eq!(settings.losses.smooth_on, SmoothOn::Correction);
        assert_eq!(settings.network.gate, DangerGate::Tilt(0.3));
        assert_eq!(settings.network.state_hidden, [32]);
        for (key, value) in [
            ("hindsight.wait", "1"),
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
            EmpSettings::preset(preset).check().unwrap();
        }
        let paper = EmpSettings::preset(Preset::Paper);
        assert_eq!(paper.network.config(&robot), EmpConfig::paper(&robot));
        assert_eq!(paper.losses, LossSettings::default());
        assert_eq!((paper.horizon, paper.hindsight.weight), (1, 0.0));
    }
}

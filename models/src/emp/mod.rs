//! The Executable Motion Prior (paper, section V): changes a goal only as far as balance, self-collision and smoothness
//! need, given the robot's state.
//!
//! ```text
//! S_t ──history map, normalise──▶ state encoder ──▶ z₁ ┐
//!                                                       ├─▶ fusion ──▶ z ──▶ decoder ──▶ ĝ_t
//! g_t ───────────────────────────▶ target encoder ─▶ z₂ ┘
//! ```

mod filter;
mod network;
mod packed;
#[cfg(test)]
mod tests;

use std::{path::Path, sync::Arc};

use candle_core::{DType, Device};
use candle_nn::VarBuilder;
use emp_robot::Robot;
use serde::{Deserialize, Serialize};

pub use filter::EmpFilter;
pub use network::EmpNetwork;
pub use packed::PackedNetwork;

use crate::{
    CheckpointMetadata, ModelError,
    checkpoint::{self, Tensors},
    mlp::{Normalizer, shipped_tensors},
    observation::{HISTORY, HistoryMap, ObservationLayout},
};

/// The kind that an EMP's checkpoint names.
pub const KIND: &str = "emp";

/// Prefix of the network's tensors in a checkpoint.
pub const NETWORK_PREFIX: &str = "emp";

/// What the decoder's answer means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Output {
    /// It is the executable goal, as in the paper.
    Absolute,
    /// It is added to the goal.
    Residual,
}

/// What counts as danger: beyond it, "EMP when danger" filters (paper, section VI).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DangerGate {
    /// The mean of z² over the latent's dimensions, above this.
    Regloss(f32),
    /// The angle between the base's vertical axis and the world's, rad, above this.
    Tilt(f32),
}

impl DangerGate {
    /// The paper's gate.
    pub const PAPER: Self = Self::Regloss(0.04);
}

/// What an EMP's checkpoint says of its shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmpConfig {
    /// Where each part of the observation stands.
    pub observation: ObservationLayout,
    /// The constant first layer of the state encoder.
    pub history_map: HistoryMap,
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

impl EmpConfig {
    /// The paper's shape for `robot`: whole stacks in, 1024 units a layer in the encoders, 2048 in fusion and decoder. The
    /// widths of z₁, z₂ and z are not in the paper.
    pub fn paper(robot: &Robot) -> Self {
        Self {
            observation: ObservationLayout::new(robot, HISTORY),
            history_map: HistoryMap::identity(HISTORY),
            output: Output::Absolute,
            state_hidden: vec![1024, 1024],
            target_hidden: vec![1024, 1024],
            encoding: 64,
            fusion_hidden: vec![2048, 2048],
            latent: 32,
            decoder_hidden: vec![2048, 2048],
            gate: DangerGate::PAPER,
        }
    }

    /// Numbers that the state encoder reads.
    pub fn features(&self) -> usize {
        self.history_map.features(&self.observation)
    }

    /// Refuses a shape that does not fit `robot`.
    fn check(&self, robot: &Robot) -> Result<(), String> {
        let expected = ObservationLayout::new(robot, self.observation.history());
        if self.observation != expected {
            return Err(format!(
                "the observation is {:?}, expected {expected:?}",
                self.observation
            ));
        }
        let (DangerGate::Regloss(gate) | DangerGate::Tilt(gate)) = self.gate;
        if !gate.is_finite() || gate < 0.0 {
            return Err(format!("the gate is {gate}, expected a number from 0"));
        }
        self.history_map.check(&self.observation)
    }
}

/// The EMP's answer to one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct EmpAnswer {
    /// The executable goal ĝ: angles of the goal joints inside their ranges, rad.
    pub goal: Vec<f32>,
    /// Mean of z² over the latent's dimensions.
    pub regloss: f32,
}

/// An EMP with its robot.
#[derive(Debug)]
pub struct Emp {
    robot: Arc<Robot>,
    config: EmpConfig,
    normalizer: Normalizer,
    network: PackedNetwork,
    metadata: CheckpointMetadata,
}

impl Emp {
    /// Loads weights that were trained for `robot`.
    ///
    /// # Errors
    /// When the file is damaged, or was trained for another robot or another observation.
    pub fn load(weights: &Path, robot: Arc<Robot>) -> Result<Self, ModelError> {
        let (metadata, tensors) = checkpoint::load(weights)?;
        metadata.check(weights, &emp_metadata(&robot))?;
        let damaged = |reason: String| ModelError::Checkpoint {
            path: weights.to_owned(),
            reason,
        };
        let config: EmpConfig = serde_json::from_value(metadata.config.clone())
            .map_err(|e| damaged(format!("metadata field config: {e}")))?;
        Self::from_tensors(config, robot, tensors, metadata).map_err(damaged)
    }

    /// Puts an EMP together from a checkpoint's tensors.
    ///
    /// # Errors
    /// Says which part does not fit the robot or the shape.
    pub fn from_tensors(
        config: EmpConfig,
        robot: Arc<Robot>,
        tensors: Tensors,
        metadata: CheckpointMetadata,
    ) -> Result<Self, String> {
        config.check(&robot)?;
        let normalizer = Normalizer::from_tensors(&tensors, config.features())?;
        let vars =
            VarBuilder::from_tensors(tensors.into_iter().collect(), DType::F32, &Device::Cpu);
        let vars = vars.pp(NETWORK_PREFIX);
        let network = EmpNetwork::new(config.clone(), normalizer.clone(), &vars)
            .and_then(|network| network.pack())
            .map_err(|e| format!("the network's tensors: {e}"))?;
        Ok(Self {
            robot,
            config,
            normalizer,
            network,
            metadata,
        })
    }

    /// Writes the tensors of an EMP: `network` (named as [`EmpNetwork::new`] names them) as f16, the normaliser as f32.
    ///
    /// `training` and `git_revision` go into the metadata.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(
        path: &Path,
        robot: &Robot,
        config: &EmpConfig,
        normalizer: &Normalizer,
        network: &Tensors,
        training: serde_json::Value,
        git_revision: String,
    ) -> Result<CheckpointMetadata, ModelError> {
        let mut metadata = emp_metadata(robot);
        metadata.history_length = config.observation.history();
        metadata.config = serde_json::to_value(config).map_err(candle_core::Error::wrap)?;
        metadata.training = training;
        metadata.git_revision = git_revision;
        let tensors = shipped_tensors(NETWORK_PREFIX, normalizer, network)?;
        checkpoint::save(path, metadata, &tensors)
    }

    /// The robot that the goals are for.
    pub fn robot(&self) -> &Arc<Robot> {
        &self.robot
    }

    /// What the EMP reads, and how.
    pub fn config(&self) -> &EmpConfig {
        &self.config
    }

    /// What the weights say of themselves.
    pub fn metadata(&self) -> &CheckpointMetadata {
        &self.metadata
    }

    /// Executable goals for stacks `S_t` (N × [`ObservationLayout::width`]), the goal that was asked for in each newest frame.
    ///
    /// A row's answer does not depend on the other rows.
    ///
    /// # Errors
    /// When `stacks` is not whole rows.
    pub fn answer(&self, stacks: &[f32]) -> Result<Vec<EmpAnswer>, ModelError> {
        let layout = &self.config.observation;
        let width = layout.width();
        if !stacks.len().is_multiple_of(width) {
            let reason = format!("{} numbers are not stacks of {width}", stacks.len());
            return Err(candle_core::Error::Msg(reason).into());
        }
        let goals: Vec<f32> = stacks
            .chunks_exact(width)
            .flat_map(|stack| &stack[layout.newest_goal()])
            .copied()
            .collect();
        let mut features = Vec::new();
        self.config.history_map.apply(layout, stacks, &mut features);
        self.normalizer.apply(&mut features);
        let (mut executable, latents) = self.network.forward(&features, &goals)?;
        if self.config.output == Output::Residual {
            for (angle, goal) in executable.iter_mut().zip(&goals) {
                *angle += goal;
            }
        }
        let executable = executable.chunks_exact(layout.goal().len());
        let latents = latents.chunks_exact(self.config.latent);
        let answers = executable.zip(latents);
        Ok(answers
            .map(|(goal, latent)| EmpAnswer {
                goal: self.inside_ranges(goal.to_vec()),
                regloss: latent.iter().map(|z| z * z).sum::<f32>() / latent.len() as f32,
            })
            .collect())
    }

    fn inside_ranges(&self, mut goal: Vec<f32>) -> Vec<f32> {
        for (angle, joint) in goal.iter_mut().zip(self.robot.goal_joints()) {
            *angle = angle.clamp(joint.range[0] as f32, joint.range[1] as f32);
        }
        goal
    }
}

/// What an EMP's metadata must say to fit `robot`: it reads all joints.
fn emp_metadata(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(KIND, robot, robot.joints())
}

//! The Executable Motion Prior (paper, section V): changes a goal only as far as balance, self-collision and smoothness
//! need, given the robot's state.
//!
//! ```text
//! S_t ──history map, normalise──▶ state encoder ──▶ z₁ ┐
//!                                                       ├─▶ fusion ──▶ z ──▶ decoder ──▶ ĝ_t
//! g_t ───────────────────────────▶ target encoder ─▶ z₂ ┘
//! ```

mod config;
mod network;
mod packed;
#[cfg(test)]
mod tests;

use std::{path::Path, sync::Arc};

use candle_core::{DType, Device};
use candle_nn::VarBuilder;
use emp_robot::Robot;

pub use config::{DangerGate, EmpConfig, Output};
pub use network::EmpNetwork;
pub use packed::PackedNetwork;

use crate::{
    CheckpointMetadata, ModelError,
    checkpoint::{self, Tensors},
    mlp::{Normalizer, shipped_tensors},
};

/// The kind that an EMP's checkpoint names.
pub const KIND: &str = "emp";

/// Prefix of the network's tensors in a checkpoint.
pub const NETWORK_PREFIX: &str = "emp";

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

    /// Executable goals for stacks `S_t` (N × [`ObservationLayout::width`](crate::observation::ObservationLayout::width)), the goal that was asked for in each newest frame.
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
        let joints = layout.goal().len();
        for goal in executable.chunks_exact_mut(joints) {
            self.robot.clamp_goal(goal);
        }
        let executable = executable.chunks_exact(joints);
        let latents = latents.chunks_exact(self.config.latent);
        let answers = executable.zip(latents);
        Ok(answers
            .map(|(goal, latent)| EmpAnswer {
                goal: goal.to_vec(),
                regloss: latent.iter().map(|z| z * z).sum::<f32>() / latent.len() as f32,
            })
            .collect())
    }
}

/// What an EMP's metadata must say to fit `robot`: it reads all joints.
fn emp_metadata(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(KIND, robot, robot.joints())
}

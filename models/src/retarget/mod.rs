//! Human key nodes to joint angles: the network, the refinement of its answer, temporal smoothing.

mod clips;
pub mod features;
pub mod network;
pub mod objective;
pub mod smoothing;

use std::{path::Path, sync::Arc};

use candle_core::{DType, Device};
use candle_nn::VarBuilder;
use emp_motion::KeyNodeFrame;
use emp_robot::Robot;

pub use self::{
    clips::{GoalRows, predict_clip, retarget_clips},
    features::{BONES, Target, features},
    network::{NetworkConfig, RetargetNetwork},
    objective::{Effort, Solver},
    smoothing::Smoother,
};
use crate::{CheckpointMetadata, ModelError, checkpoint};

/// The kind that a retargeter's checkpoint names.
pub const KIND: &str = "retargeter";

/// A joint this close to a limit stands at it, radians.
pub const AT_LIMIT: f64 = 0.01;

/// One human frame to be retargeted.
#[derive(Clone, Debug)]
pub struct RetargetInput {
    /// The pose; it has passed [`KeyNodeFrame::validate`].
    pub frame: KeyNodeFrame,
    /// Whether to refine the network's answer by Gauss–Newton steps.
    pub refine: bool,
    /// The stream's previous refined answer (goal order, radians), from which the refinement starts where that is nearer
    /// to the frame than the network's answer; so a pose that has several answers keeps to one of them.
    pub previous: Option<Vec<f32>>,
}

/// The robot's answer to one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct RetargetOutput {
    /// Joint angles in goal order, radians, inside the joints' limits.
    pub angles: Vec<f32>,
    /// Mean angle between the human's and the robot's arm bones, radians.
    pub direction_error: f32,
    /// Names by index the goal joints that stand within [`AT_LIMIT`] of a limit.
    pub at_limit: Vec<usize>,
}

/// A trained network with its robot.
pub struct Retargeter {
    network: RetargetNetwork,
    robot: Arc<Robot>,
    metadata: CheckpointMetadata,
}

impl Retargeter {
    /// Loads weights that were trained for `robot`.
    ///
    /// # Errors
    /// When the file is damaged, or was trained for another robot, other limits, or another network.
    pub fn load(weights: &Path, robot: Arc<Robot>) -> Result<Self, ModelError> {
        let (metadata, tensors) = checkpoint::load(weights)?;
        metadata.check(weights, &CheckpointMetadata::for_goal_joints(KIND, &robot))?;
        let damaged = |reason: String| ModelError::Checkpoint {
            path: weights.to_owned(),
            reason,
        };
        let config: NetworkConfig = serde_json::from_value(metadata.config.clone())
            .map_err(|e| damaged(format!("metadata field config: {e}")))?;
        let vars =
            VarBuilder::from_tensors(tensors.into_iter().collect(), DType::F32, &Device::Cpu);
        let network = RetargetNetwork::new(&config, &robot, &vars)
            .map_err(|e| damaged(format!("the network's tensors: {e}")))?;
        Ok(Self {
            network,
            robot,
            metadata,
        })
    }

    /// Wraps a network in training.
    pub fn from_network(
        network: RetargetNetwork,
        robot: Arc<Robot>,
        metadata: CheckpointMetadata,
    ) -> Self {
        Self {
            network,
            robot,
            metadata,
        }
    }

    /// The robot that the answers are for.
    pub fn robot(&self) -> &Arc<Robot> {
        &self.robot
    }

    /// What the weights say of themselves.
    pub fn metadata(&self) -> &CheckpointMetadata {
        &self.metadata
    }

    /// Number of codes in the codebook.
    pub fn codes(&self) -> usize {
        self.network.codes()
    }

    /// Retargets a batch: the network's answers, each refined where its input asks for it.
    ///
    /// # Errors
    /// When a frame is not a pose, or a previous answer has another number of joints.
    pub fn retarget(&self, inputs: &[RetargetInput]) -> Result<Vec<RetargetOutput>, ModelError> {
        let joints = self.robot.goal_joints().len();
        for (index, input) in inputs.iter().enumerate() {
            input.frame.validate().map_err(|e| ModelError::Frame {
                index,
                reason: e.to_string(),
            })?;
            if let Some(previous) = input
                .previous
                .as_ref()
                .filter(|previous| previous.len() != joints)
            {
                let reason = format!(
                    "the previous answer has {} joints, expected {joints}",
                    previous.len()
                );
                return Err(ModelError::Frame { index, reason });
            }
        }
        let targets: Vec<Target> = inputs
            .iter()
            .map(|input| Target::new(&input.frame))
            .collect();
        let (angles, _) = self.predict(&targets)?;
        let mut solver = Solver::new(&self.robot);
        let answers = inputs.iter().zip(&targets).zip(angles.chunks(joints));
        Ok(answers
            .map(|((input, target), angles)| {
                let mut angles: Vec<f64> = angles.iter().map(|angle| f64::from(*angle)).collect();
                if input.refine {
                    refine(&mut solver, target, &mut angles, input.previous.as_deref());
                }
                self.output(&mut solver, target, &angles)
            })
            .collect())
    }

    /// The network's answers to a batch (batch × joints, radians) and the codes that it went through (batch × joints).
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn predict(&self, targets: &[Target]) -> Result<(Vec<f32>, Vec<u32>), ModelError> {
        if targets.is_empty() {
            return Ok((Vec::new(), Vec::new()));
        }
        Ok(self.network.predict(&features(targets)?)?)
    }

    fn output(&self, solver: &mut Solver<'_>, target: &Target, angles: &[f64]) -> RetargetOutput {
        let errors = solver.bone_errors(target, angles);
        let joints = self.robot.goal_joints().iter().enumerate();
        RetargetOutput {
            angles: angles.iter().map(|angle| *angle as f32).collect(),
            direction_error: (errors.iter().sum::<f64>() / errors.len() as f64) as f32,
            at_limit: joints
                .filter(|(i, joint)| {
                    angles[*i] <= joint.range[0] + AT_LIMIT
                        || angles[*i] >= joint.range[1] - AT_LIMIT
                })
                .map(|(i, _)| i)
                .collect(),
        }
    }
}

/// Lowers the objective from the network's answer, or from the stream's previous one where that starts lower.
fn refine(
    solver: &mut Solver<'_>,
    target: &Target,
    angles: &mut Vec<f64>,
    previous: Option<&[f32]>,
) {
    if let Some(previous) = previous {
        let previous: Vec<f64> = previous.iter().map(|angle| f64::from(*angle)).collect();
        if solver.objective(target, &previous) < solver.objective(target, angles) {
            *angles = previous;
        }
    }
    solver.minimise(target, angles, Effort::REFINE);
}

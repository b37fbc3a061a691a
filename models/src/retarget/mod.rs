//! Human key nodes to joint angles: the network, the refinement of its answer, temporal smoothing.

mod angles;
mod clips;
pub mod features;
pub mod network;
pub mod objective;
pub mod smoothing;
pub mod stream;

use std::{path::Path, sync::Arc};

use candle_core::{DType, Device};
use candle_nn::VarBuilder;
use emp_motion::KeyNodeFrame;
use emp_robot::{Joint, JointMirror, Robot};

pub use self::{
    clips::{GoalRows, predict_clip, retarget_clips},
    features::{BONES, Target, features},
    network::{NetworkConfig, RetargetNetwork},
    objective::{Effort, Search, Solver},
    smoothing::Smoother,
    stream::Memory,
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
    /// How it is answered.
    pub mode: Mode,
}

/// How a frame is answered.
#[derive(Clone, Debug)]
pub enum Mode {
    /// By the network alone; a retargeter without a network refines.
    Network,
    /// By inverse kinematics from the network's answer and other starts, as the first frame of a stream.
    Begin,
    /// By inverse kinematics from a stream's previous answer.
    Follow {
        /// What the stream remembers: [`RetargetOutput::memory`] of the answer before.
        memory: Box<Memory>,
        /// Time since that pose, seconds.
        seconds: f64,
    },
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
    /// What the stream's next frame is answered from; a network's own answer leaves none.
    pub memory: Option<Box<Memory>>,
}

/// A robot's retargeter: inverse kinematics, and the network that was trained for the robot, where one was.
pub struct Retargeter {
    network: Option<RetargetNetwork>,
    robot: Arc<Robot>,
    /// Nothing for a robot that has no mirror image.
    mirror: Option<JointMirror>,
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
        Ok(Self::from_network(network, robot, metadata))
    }

    /// Wraps a network in training.
    pub fn from_network(
        network: RetargetNetwork,
        robot: Arc<Robot>,
        metadata: CheckpointMetadata,
    ) -> Self {
        Self {
            network: Some(network),
            mirror: robot.mirror().ok(),
            robot,
            metadata,
        }
    }

    /// Inverse kinematics alone, for a robot that no network was trained for. Its version stands for the robot's joints.
    pub fn without_network(robot: Arc<Robot>) -> Self {
        let metadata = CheckpointMetadata::without_weights(KIND, &robot);
        Self {
            network: None,
            mirror: robot.mirror().ok(),
            robot,
            metadata,
        }
    }

    /// Whether there is a trained network.
    pub fn has_network(&self) -> bool {
        self.network.is_some()
    }

    /// The robot that the answers are for.
    pub fn robot(&self) -> &Arc<Robot> {
        &self.robot
    }

    /// What the weights say of themselves.
    pub fn metadata(&self) -> &CheckpointMetadata {
        &self.metadata
    }

    /// Number of codes in the network's codebook, 0 without a network.
    pub fn codes(&self) -> usize {
        self.network.as_ref().map_or(0, RetargetNetwork::codes)
    }

    /// Retargets a batch.
    ///
    /// # Errors
    /// When a frame is not a pose, or a memory is another robot's.
    pub fn retarget(&self, inputs: &[RetargetInput]) -> Result<Vec<RetargetOutput>, ModelError> {
        let joints = self.robot.goal_joints().len();
        for (index, input) in inputs.iter().enumerate() {
            self.check(input)
                .map_err(|reason| ModelError::Frame { index, reason })?;
        }
        let targets: Vec<Target> = inputs
            .iter()
            .map(|input| Target::new(&input.frame))
            .collect();
        let asked = |input: &RetargetInput| matches!(input.mode, Mode::Network);
        let alone: Vec<Target> = inputs
            .iter()
            .zip(&targets)
            .filter(|(input, _)| asked(input) && self.has_network())
            .map(|(_, target)| target.clone())
            .collect();
        let (alone, _) = self.predict(&alone)?;
        let mut alone = alone.chunks(joints);
        let mut solver = Solver::new(&self.robot);
        inputs
            .iter()
            .zip(&targets)
            .map(|(input, target)| {
                if let Some(answer) = asked(input).then(|| alone.next()).flatten() {
                    return Ok(self.output(&mut solver, target, answer, None));
                }
                let memory = match &input.mode {
                    Mode::Follow { memory, seconds } => {
                        solver.follow(target, (**memory).clone(), *seconds)
                    }
                    Mode::Begin | Mode::Network => solver.begin(target, &self.starts(target)?),
                };
                let angles = memory.angles();
                Ok(self.output(&mut solver, target, &angles, Some(Box::new(memory))))
            })
            .collect()
    }

    /// Why an input cannot be answered.
    fn check(&self, input: &RetargetInput) -> Result<(), String> {
        input.frame.validate().map_err(|e| e.to_string())?;
        let Mode::Follow { memory, seconds } = &input.mode else {
            return Ok(());
        };
        let (joints, expected) = (memory.answer().len(), self.robot.goal_joints().len());
        if joints != expected {
            return Err(format!(
                "the previous answer has {joints} joints, expected {expected}"
            ));
        }
        if !memory.answer().iter().all(|angle| angle.is_finite()) {
            return Err("the previous answer has an angle that is no number".to_owned());
        }
        if !(seconds.is_finite() && *seconds > 0.0) {
            return Err(format!(
                "{seconds} seconds since the previous answer, expected more than 0"
            ));
        }
        Ok(())
    }

    /// The network's answers to a batch (batch × joints, radians) and the codes that it went through (batch × joints); both
    /// empty without a network.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn predict(&self, targets: &[Target]) -> Result<(Vec<f32>, Vec<u32>), ModelError> {
        match &self.network {
            Some(network) if !targets.is_empty() => Ok(network.predict(&features(targets)?)?),
            _ => Ok((Vec::new(), Vec::new())),
        }
    }

    /// Where a stream's first frame is solved from: the network's answer, and what it answers in the mirror, for it is not
    /// symmetric itself.
    pub(crate) fn starts(&self, target: &Target) -> Result<Vec<Vec<f64>>, ModelError> {
        let joints = self.robot.goal_joints().len();
        let (answers, _) = self.predict(&[target.clone(), target.mirrored()])?;
        let mut starts: Vec<Vec<f32>> = answers.chunks(joints).map(<[f32]>::to_vec).collect();
        if let Some(in_mirror) = starts.pop()
            && let Some(mirror) = &self.mirror
        {
            let mut answer = vec![0.0; joints];
            mirror.goal(&in_mirror, &mut answer);
            starts.push(answer);
        }
        Ok(starts
            .iter()
            .map(|start| start.iter().map(|angle| f64::from(*angle)).collect())
            .collect())
    }

    fn output(
        &self,
        solver: &mut Solver<'_>,
        target: &Target,
        angles: &[f32],
        memory: Option<Box<Memory>>,
    ) -> RetargetOutput {
        let stands = |(angle, joint): (&f32, &Joint)| {
            let [lower, upper] = joint.range;
            let angle = f64::from(*angle);
            angle <= lower + AT_LIMIT || angle >= upper - AT_LIMIT
        };
        let exact: Vec<f64> = angles.iter().map(|angle| f64::from(*angle)).collect();
        let errors = solver.bone_errors(target, &exact);
        let joints = angles.iter().zip(self.robot.goal_joints());
        RetargetOutput {
            angles: angles.to_vec(),
            direction_error: (errors.iter().sum::<f64>() / errors.len() as f64) as f32,
            at_limit: joints
                .enumerate()
                .filter(|(_, joint)| stands(*joint))
                .map(|(i, _)| i)
                .collect(),
            memory,
        }
    }
}

//! The lower-body policy π: from the stack `S_t` to twelve leg actions (paper, section IV).
//!
//! ```text
//! S_t (15 × 57) ──constant history map──▶ features (4 × 57) ──normalise──▶ MLP, ELU ──▶ action (12)
//! ```
//!
//! The first layer is fixed: it mixes the frames of the stack, the same way for each number of a frame, into the present,
//! two differences and one deviation from the mean. Raw frames hold the same information, but learning from them took
//! many times as long.
//!
//! A symmetric policy answers π(s) = ½ (f(s) + M f(M s)), f being the network and M the mirror: what it does to the right it
//! does to the left, bit for bit. Both halves go through the network as rows of one batch. Policies that were trained
//! before that say nothing of symmetry, and answer f(s).

use std::{path::Path, sync::Arc};

use candle_core::{DType, Device, Tensor};
use candle_nn::VarBuilder;
use emp_robot::{Robot, RobotError};
use serde::{Deserialize, Serialize};

use crate::{
    CheckpointMetadata, Mirror, ModelError,
    checkpoint::{self, Tensors},
    mlp::{Mlp, Normalizer, shipped_tensors},
    observation::{HISTORY, HistoryMap, ObservationLayout},
    packed::{PackedMlp, Scratch},
};

/// The kind that a policy's checkpoint names.
pub const KIND: &str = "policy";

/// Prefix of the network's tensors in a checkpoint.
pub const NETWORK_PREFIX: &str = "policy";

/// What a policy's checkpoint says of its shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyConfig {
    /// Where each part of the observation stands.
    pub observation: ObservationLayout,
    /// The constant first layer.
    pub history_map: HistoryMap,
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Whether the policy is symmetric by construction.
    #[serde(default)]
    pub symmetric: bool,
}

impl PolicyConfig {
    /// The shape for `robot`: `s_t`, `s_t` − `s_{t−1}`, `s_{t−1}` − `s_{t−3}` and `s_t` − mean, then `hidden` layers; symmetric
    /// where the robot has a mirror image.
    pub fn new(robot: &Robot, hidden: Vec<usize>) -> Self {
        Self {
            observation: ObservationLayout::new(robot, HISTORY),
            history_map: HistoryMap::differences(),
            hidden,
            symmetric: robot.mirror().is_ok(),
        }
    }

    /// Numbers that the network reads: one frame for each row of the history map.
    pub fn features(&self) -> usize {
        self.history_map.features(&self.observation)
    }

    /// Refuses a shape that does not fit `robot`.
    fn check(&self, robot: &Robot) -> Result<(), String> {
        self.observation.check(robot)?;
        self.history_map.check(&self.observation)
    }
}

/// What makes a policy symmetric.
#[derive(Clone, Debug)]
pub struct PolicyMirror {
    /// The mirror of the network's features.
    pub features: Mirror,
    /// The mirror of actions.
    pub actions: Mirror,
}

impl PolicyMirror {
    /// The mirror for `config`'s features of `robot`: the history map mixes whole frames, so its blocks turn as frames do.
    /// None where the policy is not symmetric.
    ///
    /// # Errors
    /// When the policy is symmetric and the robot has no mirror image.
    pub fn new(robot: &Robot, config: &PolicyConfig) -> Result<Option<Self>, RobotError> {
        if !config.symmetric {
            return Ok(None);
        }
        let layout = &config.observation;
        let blocks = config.features() / layout.frame_width();
        Ok(Some(Self {
            features: Mirror::frame(robot, layout)?.repeated(blocks),
            actions: Mirror::leg_joints(&robot.mirror()?),
        }))
    }

    /// ½ (f(s) + M f(M s)) of answers f(s) (N rows) followed by the answers f(M s) to the mirrored rows.
    pub fn fold(&self, answers: &[f32]) -> Vec<f32> {
        let width = self.actions.width();
        let (seen, mirrored) = answers.split_at(answers.len() / 2);
        let rows = seen.chunks_exact(width).zip(mirrored.chunks_exact(width));
        let folded = rows.flat_map(|(seen, mirrored)| {
            let pairs = seen.iter().zip(self.actions.image(mirrored));
            pairs.map(|(a, b)| 0.5 * (a + b))
        });
        folded.collect()
    }

    /// The gradient of the answers that [`fold`](Self::fold) takes, from that of what it gives.
    pub fn unfold(&self, gradient: &[f32]) -> Vec<f32> {
        // The mirror is its own inverse, and its own transpose.
        let mut both: Vec<f32> = gradient.iter().map(|g| 0.5 * g).collect();
        let seen = both.clone();
        self.actions.extend(&mut both, &seen);
        both
    }

    /// As [`fold`](Self::fold), differentiable: 2N × actions to N × actions.
    ///
    /// # Errors
    /// When `answers` has another width or an odd number of rows.
    pub fn fold_tensor(&self, answers: &Tensor) -> candle_core::Result<Tensor> {
        let rows = answers.dim(0)? / 2;
        let seen = answers.narrow(0, 0, rows)?;
        let mirrored = self.actions.forward(&answers.narrow(0, rows, rows)?)?;
        (seen + mirrored)? * 0.5
    }
}

/// A policy with its robot.
#[derive(Debug)]
pub struct Policy {
    robot: Arc<Robot>,
    config: PolicyConfig,
    normalizer: Normalizer,
    /// Where the policy is symmetric.
    mirror: Option<PolicyMirror>,
    network: Mlp,
    /// The network as it acts; `network` itself is what gradients go through.
    packed: PackedMlp,
    metadata: CheckpointMetadata,
}

impl Policy {
    /// Loads weights that were trained for `robot`.
    ///
    /// # Errors
    /// When the file is damaged, or was trained for another robot or another observation.
    pub fn load(weights: &Path, robot: Arc<Robot>) -> Result<Self, ModelError> {
        let checkpoint = checkpoint::load(weights)?;
        Self::from_checkpoint(checkpoint, weights, robot)
    }

    /// Reads a policy from the bytes that [`encode`](Self::encode) gave, or from those of a file. Errors call them
    /// `origin`.
    ///
    /// # Errors
    /// When they are damaged, or are of another robot or another observation.
    pub fn decode(bytes: &[u8], origin: &Path, robot: Arc<Robot>) -> Result<Self, ModelError> {
        let checkpoint = checkpoint::decode(bytes, origin)?;
        Self::from_checkpoint(checkpoint, origin, robot)
    }

    /// The policy as the bytes of a checkpoint in full precision: what [`decode`](Self::decode) makes of them answers the
    /// same, bit for bit.
    ///
    /// # Errors
    /// When the tensors cannot be written.
    pub fn encode(&self) -> Result<Vec<u8>, ModelError> {
        let mut tensors: Tensors = self.normalizer.tensors()?.into_iter().collect();
        for (name, tensor) in self.network.tensors() {
            tensors.insert(format!("{NETWORK_PREFIX}.{name}"), tensor);
        }
        let metadata = CheckpointMetadata {
            history_length: self.config.observation.history(),
            config: serde_json::to_value(&self.config).map_err(candle_core::Error::wrap)?,
            ..policy_metadata(&self.robot)
        };
        Ok(checkpoint::encode(metadata, &tensors)?.1)
    }

    fn from_checkpoint(
        (metadata, tensors): (CheckpointMetadata, Tensors),
        origin: &Path,
        robot: Arc<Robot>,
    ) -> Result<Self, ModelError> {
        metadata.check(origin, &policy_metadata(&robot))?;
        let damaged = |reason: String| ModelError::Checkpoint {
            path: origin.to_owned(),
            reason,
        };
        let config: PolicyConfig = serde_json::from_value(metadata.config.clone())
            .map_err(|e| damaged(format!("metadata field config: {e}")))?;
        Self::from_tensors(config, robot, tensors, metadata).map_err(damaged)
    }

    /// Puts a policy together from a checkpoint's tensors.
    ///
    /// # Errors
    /// Says which part does not fit the robot or the shape.
    pub fn from_tensors(
        config: PolicyConfig,
        robot: Arc<Robot>,
        tensors: Tensors,
        metadata: CheckpointMetadata,
    ) -> Result<Self, String> {
        config.check(&robot)?;
        let normalizer = Normalizer::from_tensors(&tensors, config.features())?;
        let vars =
            VarBuilder::from_tensors(tensors.into_iter().collect(), DType::F32, &Device::Cpu);
        let outputs = robot.leg_joints().len();
        let vars = vars.pp(NETWORK_PREFIX);
        let network = Mlp::new(config.features(), &config.hidden, outputs, &vars)
            .map_err(|e| format!("the network's tensors: {e}"))?;
        let packed = network
            .pack()
            .map_err(|e| format!("the network's tensors: {e}"))?;
        let mirror = PolicyMirror::new(&robot, &config)
            .map_err(|e| format!("the policy is symmetric: {e}"))?;
        Ok(Self {
            robot,
            config,
            normalizer,
            mirror,
            network,
            packed,
            metadata,
        })
    }

    /// Writes the tensors of a policy: `network` (named as [`Mlp::new`] names them) as f16, the normaliser as f32.
    ///
    /// `training` and `git_revision` go into the metadata.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(
        path: &Path,
        robot: &Robot,
        config: &PolicyConfig,
        normalizer: &Normalizer,
        network: &Tensors,
        training: serde_json::Value,
        git_revision: String,
    ) -> Result<CheckpointMetadata, ModelError> {
        let mut metadata = policy_metadata(robot);
        metadata.history_length = config.observation.history();
        metadata.config = serde_json::to_value(config).map_err(candle_core::Error::wrap)?;
        metadata.training = training;
        metadata.git_revision = git_revision;
        let tensors = shipped_tensors(NETWORK_PREFIX, normalizer, network)?;
        checkpoint::save(path, metadata, &tensors)
    }

    /// The robot that the actions are for.
    pub fn robot(&self) -> &Arc<Robot> {
        &self.robot
    }

    /// What the policy reads, and how.
    pub fn config(&self) -> &PolicyConfig {
        &self.config
    }

    /// Where each part of the observation stands.
    pub fn layout(&self) -> &ObservationLayout {
        &self.config.observation
    }

    /// What the weights say of themselves.
    pub fn metadata(&self) -> &CheckpointMetadata {
        &self.metadata
    }

    /// The features (N × [`PolicyConfig::features`], not normalised) of stacks (N × [`ObservationLayout::width`]).
    pub fn features(&self, observations: &[f32]) -> Vec<f32> {
        let mut features = Vec::new();
        let config = &self.config;
        config
            .history_map
            .apply(&config.observation, observations, &mut features);
        features
    }

    /// The actions (N × leg joints, policy units) for features that are not normalised. A row's actions do not depend on the
    /// other rows.
    ///
    /// # Errors
    /// When the number of features is no multiple of [`PolicyConfig::features`].
    pub fn actions_from_features(&self, mut features: Vec<f32>) -> Result<Vec<f32>, ModelError> {
        if let Some(mirror) = &self.mirror {
            let rows = features.clone();
            mirror.features.extend(&mut features, &rows);
        }
        self.normalizer.apply(&mut features);
        let mut answers = Vec::new();
        Scratch::with(|scratch| self.packed.forward(&features, &mut answers, scratch))?;
        Ok(match &self.mirror {
            Some(mirror) => mirror.fold(&answers),
            None => answers,
        })
    }

    /// The actions (N × leg joints, policy units) for stacks (N × [`ObservationLayout::width`]).
    ///
    /// # Errors
    /// None: a last stack that is not whole is left out.
    pub fn actions(&self, observations: &[f32]) -> Result<Vec<f32>, ModelError> {
        self.actions_from_features(self.features(observations))
    }

    /// As [`actions`](Self::actions) but for rounding, differentiable: stacks N × [`ObservationLayout::width`] to actions N × leg joints.
    ///
    /// # Errors
    /// When `stacks` has another width.
    pub fn forward(&self, stacks: &Tensor) -> candle_core::Result<Tensor> {
        let config = &self.config;
        let features = config.history_map.project(&config.observation, stacks)?;
        let answers = |features: &Tensor| self.network.forward(&self.normalizer.forward(features)?);
        let Some(mirror) = &self.mirror else {
            return answers(&features);
        };
        let both = Tensor::cat(&[&features, &mirror.features.forward(&features)?], 0)?;
        mirror.fold_tensor(&answers(&both)?)
    }

    /// Leg targets (rad, inside the joints' ranges) of one action: default + scale · action.
    pub fn leg_targets(&self, action: &[f32]) -> Vec<f32> {
        leg_targets(&self.robot, action)
    }
}

/// Leg targets (rad, inside the joints' ranges) of one action in policy units: default + scale · action.
pub fn leg_targets(robot: &Robot, action: &[f32]) -> Vec<f32> {
    let scale = robot.action_scale();
    let joints = robot.leg_joints().iter().zip(action);
    joints
        .map(|(joint, &action)| {
            let target = joint.default + scale * f64::from(action);
            target.clamp(joint.range[0], joint.range[1]) as f32
        })
        .collect()
}

/// What a policy's metadata must say to fit `robot`: it reads all joints, so all their limits and gains matter.
fn policy_metadata(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(KIND, robot, robot.joints())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_nn::VarMap;

    fn robot() -> Arc<Robot> {
        Arc::new(Robot::load("../robots/emp27".as_ref()).unwrap())
    }

    fn save(path: &Path, config: &PolicyConfig, robot: &Robot) {
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let outputs = robot.leg_joints().len();
        Mlp::new(config.features(), &config.hidden, outputs, &builder).unwrap();
        let network = vars.data().lock().unwrap();
        let network: Tensors = network
            .iter()
            .map(|(name, var)| (name.clone(), var.as_detached_tensor()))
            .collect();
        let normalizer = Normalizer::identity(config.features());
        let training = serde_json::json!({});
        Policy::save(
            path,
            robot,
            config,
            &normalizer,
            &network,
            training,
            String::new(),
        )
        .unwrap();
    }

    #[test]
    fn a_saved_policy_loads_and_a_batch_equals_its_rows() {
        let (robot, folder) = (robot(), tempfile::tempdir().unwrap());
        let path = folder.path().join("policy.safetensors");
        save(&path, &PolicyConfig::new(&robot, vec![16, 8]), &robot);
        let policy = Policy::load(&path, Arc::clone(&robot)).unwrap();
        assert_eq!(policy.metadata().history_length, HISTORY);
        let width = policy.layout().width();
        let stacks: Vec<f32> = (0..5 * width).map(|i| (i as f32 * 0.37).sin()).collect();
        let batch = policy.actions(&stacks).unwrap();
        assert!(batch.iter().any(|action| action.abs() > 1e-3));
        for (stack, expected) in stacks.chunks(width).zip(batch.chunks(12)) {
            assert_eq!(policy.actions(stack).unwrap(), expected);
        }
        assert!(policy.actions(&[]).unwrap().is_empty());
        let tensor = Tensor::from_vec(stacks.clone(), (5, width), &Device::Cpu).unwrap();
        let tensor = policy.forward(&tensor).unwrap().flatten_all().unwrap();
        for (a, b) in tensor.to_vec1::<f32>().unwrap().iter().zip(&batch) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
        let sent = policy.encode().unwrap();
        let received = Policy::decode(&sent, "sent".as_ref(), robot).unwrap();
        assert_eq!(received.actions(&stacks).unwrap(), batch);
        let error = Policy::decode(&sent[..100], "sent".as_ref(), self::robot());
        assert!(error.unwrap_err().to_string().contains("sent"));
    }

    #[test]
    fn the_mirrored_observation_gets_the_mirrored_action_to_the_bit() {
        let (robot, folder) = (robot(), tempfile::tempdir().unwrap());
        let path = folder.path().join("policy.safetensors");
        let config = PolicyConfig::new(&robot, vec![32, 16]);
        assert!(config.symmetric);
        save(&path, &config, &robot);
        let policy = Policy::load(&path, Arc::clone(&robot)).unwrap();
        let frame = Mirror::frame(&robot, policy.layout()).unwrap();
        let legs = Mirror::leg_joints(&robot.mirror().unwrap());
        // Rows that are not alike, and rows of any size: what a batch has beside a row does not matter.
        let mut state = 1_u64;
        let mut number = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 33) as f32 / (1_u64 << 30) as f32 - 1.0
        };
        let stacks: Vec<f32> = (0..7 * policy.layout().width()).map(|_| number()).collect();
        let mirrored = frame.rows(&stacks);
        let (actions, images) = (
            policy.actions(&stacks).unwrap(),
            policy.actions(&mirrored).unwrap(),
        );
        assert_eq!(legs.rows(&actions), images);
        assert_ne!(actions, images);
        assert!(actions.iter().any(|action| action.abs() > 1e-3));
    }

    #[test]
    fn a_policy_that_says_nothing_of_symmetry_is_its_network() {
        let (robot, folder) = (robot(), tempfile::tempdir().unwrap());
        let path = folder.path().join("policy.safetensors");
        let config = PolicyConfig {
            symmetric: false,
            ..PolicyConfig::new(&robot, vec![8])
        };
        save(&path, &config, &robot);
        let mut written = serde_json::to_value(&config).unwrap();
        written.as_object_mut().unwrap().remove("symmetric");
        assert_eq!(
            serde_json::from_value::<PolicyConfig>(written).unwrap(),
            config
        );
        let policy = Policy::load(&path, robot).unwrap();
        let stack: Vec<f32> = (0..policy.layout().width())
            .map(|i| (i as f32).sin())
            .collect();
        let features = policy.features(&stack);
        let mut expected = Vec::new();
        Scratch::with(|scratch| policy.packed.forward(&features, &mut expected, scratch)).unwrap();
        assert_eq!(policy.actions(&stack).unwrap(), expected);
    }

    #[test]
    fn another_observation_is_refused_by_name() {
        let (robot, folder) = (robot(), tempfile::tempdir().unwrap());
        let path = folder.path().join("policy.safetensors");
        let mut config = PolicyConfig::new(&robot, vec![8]);
        config.history_map = HistoryMap::identity(HISTORY - 1);
        save(&path, &config, &robot);
        let error = Policy::load(&path, robot).unwrap_err().to_string();
        assert!(error.contains("history_map"), "{error}");
    }

    #[test]
    fn leg_targets_stay_inside_the_ranges() {
        let robot = robot();
        let rest = leg_targets(&robot, &[0.0; 12]);
        for (target, joint) in rest.iter().zip(robot.leg_joints()) {
            assert!((f64::from(*target) - joint.default).abs() < 1e-6);
        }
        for (target, joint) in leg_targets(&robot, &[1e9; 12])
            .iter()
            .zip(robot.leg_joints())
        {
            assert_eq!(*target, joint.range[1] as f32);
        }
    }
}

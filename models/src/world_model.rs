//! The world model `f_w`: the next state of the robot from the stack `S_t` and the action, differentiable (paper, section V-B).
//!
//! ```text
//! S_t (15 × 57, goal ĝ_t) ──history map──▶ 4 × 57 ┐
//!                                                  ├─normalise──▶ MLP, ELU ──× scale──▶ change of [q | roll, pitch, yaw]
//! a_t ─────────────────────────────────────────────┘
//! ```
//!
//! What is predicted is the change from the newest frame, since a robot that stands hardly changes within a control period. Goals
//! and last actions are known, not predicted: [`WorldModel::advance`] puts them into the next stack.

use std::path::Path;

use candle_core::{DType, Device, Tensor};
use candle_nn::VarBuilder;
use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use crate::{
    CheckpointMetadata, ModelError,
    checkpoint::{self, Tensors},
    mlp::{Mlp, Normalizer},
    observation::{HISTORY, HistoryMap, ObservationLayout},
};

/// The kind that a world model's checkpoint names.
pub const KIND: &str = "world-model";

/// Prefix of the network's tensors in a checkpoint.
const NETWORK_PREFIX: &str = "world_model";

/// Name of the output's scale in a checkpoint.
const OUTPUT_SCALE: &str = "output_scale";

/// What a world model's checkpoint says of its shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorldModelConfig {
    /// Where each part of the observation stands.
    pub observation: ObservationLayout,
    /// The constant first layer.
    pub history_map: HistoryMap,
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
}

impl WorldModelConfig {
    /// A shape for `robot`; the paper's `hidden` is 1024, 512. Without the past, whose differences hold velocities, a model
    /// is worse than a guess of constant velocity.
    pub fn new(robot: &Robot, hidden: Vec<usize>) -> Self {
        Self {
            observation: ObservationLayout::new(robot, HISTORY),
            history_map: HistoryMap::differences(),
            hidden,
        }
    }

    /// Numbers that the network reads: features of the stack, then the action.
    pub fn inputs(&self) -> usize {
        self.history_map.features(&self.observation) + self.observation.last_action().len()
    }

    /// Numbers that are predicted: joint positions, then roll, pitch and yaw.
    pub fn outputs(&self) -> usize {
        self.observation.joint_positions().len() + self.observation.orientation().len()
    }

    /// What the network reads, not normalised: stacks (N × [`ObservationLayout::width`]) and actions (N × leg joints) to
    /// N × [`inputs`](Self::inputs).
    ///
    /// # Errors
    /// When widths do not fit.
    pub fn project(&self, stacks: &Tensor, actions: &Tensor) -> candle_core::Result<Tensor> {
        let features = self.history_map.project(&self.observation, stacks)?;
        Tensor::cat(&[&features, actions], 1)
    }

    /// `[q | roll, pitch, yaw]` of the newest frames, N × [`outputs`](Self::outputs).
    ///
    /// # Errors
    /// When `stacks` has another width.
    pub fn newest(&self, stacks: &Tensor) -> candle_core::Result<Tensor> {
        let (layout, start) = (&self.observation, self.observation.newest().start);
        let parts = [layout.joint_positions(), layout.orientation()];
        let parts = parts.map(|part| stacks.narrow(1, start + part.start, part.len()));
        let [joints, orientation] = parts;
        Tensor::cat(&[joints?, orientation?], 1)
    }

    /// Refuses a shape that does not fit `robot`.
    fn check(&self, robot: &Robot) -> Result<(), String> {
        self.observation.check(robot)?;
        self.history_map.check(&self.observation)
    }
}

/// What brings a network's inputs and outputs to unit size.
#[derive(Clone, Debug, PartialEq)]
pub struct Scaling {
    /// Moments of the inputs.
    pub inputs: Normalizer,
    /// Size of each output: rad of change in one control period.
    pub outputs: Vec<f32>,
}

impl Scaling {
    /// Leaves inputs and outputs as they are.
    pub fn identity(config: &WorldModelConfig) -> Self {
        Self {
            inputs: Normalizer::identity(config.inputs()),
            outputs: vec![1.0; config.outputs()],
        }
    }

    /// The tensors of a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn tensors(&self) -> candle_core::Result<Tensors> {
        let mut tensors: Tensors = self.inputs.tensors()?.into_iter().collect();
        let outputs = Tensor::new(self.outputs.as_slice(), &Device::Cpu)?;
        tensors.insert(OUTPUT_SCALE.to_owned(), outputs);
        Ok(tensors)
    }

    /// The scaling in a checkpoint's tensors.
    ///
    /// # Errors
    /// Says which tensor is missing or wrong.
    pub fn from_tensors(tensors: &Tensors, config: &WorldModelConfig) -> Result<Self, String> {
        let outputs = tensors
            .get(OUTPUT_SCALE)
            .ok_or(format!("no tensor `{OUTPUT_SCALE}`"))?;
        let outputs = outputs
            .to_vec1::<f32>()
            .map_err(|e| format!("tensor `{OUTPUT_SCALE}`: {e}"))?;
        if outputs.len() != config.outputs() || outputs.iter().any(|scale| !scale.is_finite()) {
            return Err(format!(
                "tensor `{OUTPUT_SCALE}`: expected {} finite numbers, got {}",
                config.outputs(),
                outputs.len()
            ));
        }
        Ok(Self {
            inputs: Normalizer::from_tensors(tensors, config.inputs())?,
            outputs,
        })
    }
}

/// A world model.
#[derive(Clone, Debug)]
pub struct WorldModel {
    config: WorldModelConfig,
    scaling: Scaling,
    network: Mlp,
}

impl WorldModel {
    /// A model whose layers are named `0.weight`, `0.bias`, `1.weight`, … in `vars`: variables to train, or tensors.
    ///
    /// # Errors
    /// When `vars` holds tensors of those names with other shapes.
    pub fn new(
        config: WorldModelConfig,
        scaling: Scaling,
        vars: &VarBuilder<'_>,
    ) -> candle_core::Result<Self> {
        let network = Mlp::new(config.inputs(), &config.hidden, config.outputs(), vars)?;
        Ok(Self {
            config,
            scaling,
            network,
        })
    }

    /// Loads a model of `robot`.
    ///
    /// # Errors
    /// When the file is damaged, or is of another robot or another observation.
    pub fn load(path: &Path, robot: &Robot) -> Result<Self, ModelError> {
        let (metadata, tensors) = checkpoint::load(path)?;
        metadata.check(path, &metadata_of(robot))?;
        let damaged = |reason: String| ModelError::Checkpoint {
            path: path.to_owned(),
            reason,
        };
        let config: WorldModelConfig = serde_json::from_value(metadata.config)
            .map_err(|e| damaged(format!("metadata field config: {e}")))?;
        config.check(robot).map_err(damaged)?;
        let scaling = Scaling::from_tensors(&tensors, &config).map_err(damaged)?;
        let vars =
            VarBuilder::from_tensors(tensors.into_iter().collect(), DType::F32, &Device::Cpu);
        Self::new(config, scaling, &vars.pp(NETWORK_PREFIX))
            .map_err(|e| damaged(format!("the network's tensors: {e}")))
    }

    /// Writes the model in full precision. `training` and `git_revision` go into the metadata.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(
        &self,
        path: &Path,
        robot: &Robot,
        training: serde_json::Value,
        git_revision: String,
    ) -> Result<CheckpointMetadata, ModelError> {
        let mut tensors = self.scaling.tensors()?;
        for (name, tensor) in self.network.tensors() {
            tensors.insert(format!("{NETWORK_PREFIX}.{name}"), tensor);
        }
        let metadata = CheckpointMetadata {
            history_length: self.config.observation.history(),
            config: serde_json::to_value(&self.config).map_err(candle_core::Error::wrap)?,
            training,
            git_revision,
            ..metadata_of(robot)
        };
        checkpoint::save(path, metadata, &tensors)
    }

    /// What the model reads, and how.
    pub fn config(&self) -> &WorldModelConfig {
        &self.config
    }

    /// What inputs and outputs are scaled by.
    pub fn scaling(&self) -> &Scaling {
        &self.scaling
    }

    /// `[q | roll, pitch, yaw]` of `s_{t+1}` (N × [`WorldModelConfig::outputs`], rad) for stacks `S_t` with the executed goal
    /// (N × [`ObservationLayout::width`]) and actions `a_t` (N × leg joints, policy units).
    ///
    /// # Errors
    /// When widths do not fit.
    pub fn forward(&self, stacks: &Tensor, actions: &Tensor) -> candle_core::Result<Tensor> {
        let inputs = self.config.project(stacks, actions)?;
        let change = self
            .network
            .forward(&self.scaling.inputs.forward(&inputs)?)?;
        let scale = Tensor::new(self.scaling.outputs.as_slice(), stacks.device())?;
        self.config.newest(stacks)? + change.broadcast_mul(&scale)?
    }

    /// The stacks one control period later, differentiable: the oldest frame goes, and a frame of `next` (as
    /// [`forward`](Self::forward) answers it), of the actions that led there, and of the `goals` of that moment (N × goal
    /// joints, rad) comes.
    ///
    /// # Errors
    /// When widths do not fit.
    pub fn advance(
        &self,
        stacks: &Tensor,
        actions: &Tensor,
        next: &Tensor,
        goals: &Tensor,
    ) -> candle_core::Result<Tensor> {
        let layout = &self.config.observation;
        let joints = layout.joint_positions().len();
        let width = layout.frame_width();
        let kept = stacks.narrow(1, width, layout.width() - width)?;
        let positions = next.narrow(1, 0, joints)?;
        let orientation = next.narrow(1, joints, layout.orientation().len())?;
        Tensor::cat(&[&kept, &positions, actions, &orientation, goals], 1)
    }
}

/// What a world model's metadata must say to fit `robot`: it reads and predicts all joints.
fn metadata_of(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(KIND, robot, robot.joints())
}

#[cfg(test)]
mod tests {
    use candle_core::Var;
    use candle_nn::VarMap;
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::observation::{History, RobotState};

    fn robot() -> Robot {
        Robot::load("../robots/emp27".as_ref()).unwrap()
    }

    /// Numbers without a pattern, of about unit size.
    fn numbers(count: usize, seed: f32) -> Vec<f32> {
        (0..count)
            .map(|i| (12.9898 * (i as f32 + seed)).sin())
            .collect()
    }

    fn rows(count: usize, width: usize, seed: f32) -> Tensor {
        Tensor::from_vec(numbers(count * width, seed), (count, width), &Device::Cpu).unwrap()
    }

    /// A model with random weights and the variables that hold them.
    fn model(scaling: impl FnOnce(&WorldModelConfig) -> Scaling) -> (WorldModel, VarMap) {
        let config = WorldModelConfig::new(&robot(), vec![16, 8]);
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let scaling = scaling(&config);
        let model = WorldModel::new(config, scaling, &builder).unwrap();
        for (name, var) in vars.data().lock().unwrap().iter() {
            let values = numbers(var.elem_count(), name.len() as f32);
            let values: Vec<f32> = values.iter().map(|x| 0.2 * x).collect();
            var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu).unwrap())
                .unwrap();
        }
        (model, vars)
    }

    fn small_outputs(config: &WorldModelConfig) -> Scaling {
        Scaling {
            outputs: (1..=config.outputs()).map(|i| 0.01 * i as f32).collect(),
            ..Scaling::identity(config)
        }
    }

    fn values(tensor: &Tensor) -> Vec<f32> {
        tensor.flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn the_answer_is_the_newest_frame_and_a_scaled_change() {
        let (zero, vars) = model(small_outputs);
        for var in vars.data().lock().unwrap().values() {
            var.set(&var.zeros_like().unwrap()).unwrap();
        }
        let layout = zero.config.observation;
        let (stacks, actions) = (rows(3, layout.width(), 0.5), rows(3, 12, 9.0));
        let answers = zero.forward(&stacks, &actions).unwrap();
        assert_eq!(answers.dims(), [3, 30]);
        for (answer, stack) in values(&answers).chunks(30).zip(values(&stacks).chunks(855)) {
            let newest = &stack[layout.newest()];
            assert_eq!(answer[..27], newest[layout.joint_positions()]);
            assert_eq!(answer[27..], newest[layout.orientation()]);
        }
        // The last layer's biases alone: one change for all.
        for (name, var) in vars.data().lock().unwrap().iter() {
            if name == "2.bias" {
                var.set(&var.ones_like().unwrap()).unwrap();
            }
        }
        let changed = zero.forward(&stacks, &actions).unwrap();
        let changes = values(&(changed - answers).unwrap());
        for (i, change) in changes.iter().enumerate() {
            assert!((change - 0.01 * (i % 30 + 1) as f32).abs() < 1e-6);
        }
    }

    #[test]
    fn inputs_are_normalised() {
        let (plain, vars) = model(Scaling::identity);
        let inputs = plain.config.inputs();
        let scaling = Scaling {
            inputs: Normalizer {
                mean: numbers(inputs, 3.0),
                scale: vec![2.0; inputs],
            },
            ..Scaling::identity(&plain.config)
        };
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let scaled = WorldModel::new(plain.config.clone(), scaling.clone(), &builder).unwrap();
        let (stacks, actions) = (rows(2, 855, 0.1), rows(2, 12, 2.0));
        let read = values(&plain.config.project(&stacks, &actions).unwrap());
        assert_eq!(read[inputs - 12..inputs], values(&actions)[..12]);
        let mut normalised = read;
        scaling.inputs.apply(&mut normalised);
        let normalised = Tensor::from_vec(normalised, (2, inputs), &Device::Cpu).unwrap();
        let change = scaled.network.forward(&normalised).unwrap();
        let expected = (plain.config.newest(&stacks).unwrap() + change).unwrap();
        let answer = scaled.forward(&stacks, &actions).unwrap();
        for (a, b) in values(&answer).iter().zip(values(&expected)) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }

    #[test]
    fn advancing_is_what_a_history_does() {
        let (model, _) = model(Scaling::identity);
        let layout = model.config.observation;
        let mut history = History::new(layout);
        history.set_heading(0.0);
        let mut push = |t: usize| {
            let angle = 0.1 * (t as f64).sin();
            let orientation = UnitQuaternion::from_euler_angles(angle, -angle, 2.0 * angle);
            let positions = numbers(27, t as f32);
            let state = RobotState {
                joint_positions: &positions,
                orientation,
            };
            let (goal, action) = (numbers(15, 0.5 * t as f32), numbers(12, 0.7 * t as f32));
            history.push(&state, &goal);
            history.set_last_action(&action);
            let next = [positions, history.newest()[layout.orientation()].to_vec()].concat();
            (history.stack().to_vec(), next, goal, action)
        };
        let row = |values: Vec<f32>| {
            let width = values.len();
            Tensor::from_vec(values, (1, width), &Device::Cpu).unwrap()
        };
        let (stack, _, _, mut action) = push(0);
        let mut stacks = row(stack);
        for t in 1..20 {
            let (expected, next, goal, following) = push(t);
            let actions = row(std::mem::replace(&mut action, following));
            stacks = model
                .advance(&stacks, &actions, &row(next), &row(goal))
                .unwrap();
            assert_eq!(values(&stacks), expected, "{t}");
        }
    }

    #[test]
    fn gradients_are_finite_differences_through_two_imagined_periods() {
        let (model, _) = model(small_outputs);
        let weights = rows(2, 30, 0.3);
        let goals = rows(2, 15, 4.0);
        let objective = |stacks: &Tensor, actions: &Tensor| {
            let next = model.forward(stacks, actions)?;
            let stacks = model.advance(stacks, actions, &next, &goals)?;
            (model.forward(&stacks, &(actions * 0.5)?)? * &weights)?.sum_all()
        };
        let stacks = Var::from_tensor(&rows(2, 855, 0.2)).unwrap();
        let actions = Var::from_tensor(&rows(2, 12, 5.0)).unwrap();
        let grads = objective(&stacks, &actions).unwrap().backward().unwrap();
        let evaluate = |stacks: Vec<f32>, actions: Vec<f32>| {
            let stacks = Tensor::from_vec(stacks, (2, 855), &Device::Cpu).unwrap();
            let actions = Tensor::from_vec(actions, (2, 12), &Device::Cpu).unwrap();
            let value = objective(&stacks, &actions).unwrap();
            f64::from(value.to_scalar::<f32>().unwrap())
        };
        let (s, a) = (values(&stacks), values(&actions));
        let moved = |values: &[f32], i: usize, by: f32| {
            let mut values = values.to_vec();
            values[i] += by;
            values
        };
        const STEP: f32 = 0.02;
        let mut largest = 0.0_f32;
        let (by_stacks, by_actions) = (grads.get(&stacks).unwrap(), grads.get(&actions).unwrap());
        // The newest frame whole, and every 31st number of the rest.
        for i in (798..855).chain((0..798).step_by(31)).chain(855..860) {
            let [up, down] = [STEP, -STEP].map(|by| evaluate(moved(&s, i, by), a.clone()));
            let slope = ((up - down) / f64::from(2.0 * STEP)) as f32;
            let gradient = values(by_stacks)[i];
            largest = largest.max(gradient.abs());
            assert!((slope - gradient).abs() < 2e-3, "{i}: {slope} {gradient}");
        }
        for i in 0..24 {
            let [up, down] = [STEP, -STEP].map(|by| evaluate(s.clone(), moved(&a, i, by)));
            let slope = ((up - down) / f64::from(2.0 * STEP)) as f32;
            let gradient = values(by_actions)[i];
            assert!((slope - gradient).abs() < 2e-3, "{i}: {slope} {gradient}");
        }
        assert!(largest > 0.1, "{largest}");
    }

    #[test]
    fn a_saved_model_loads_and_another_kind_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let (model, _) = model(small_outputs);
        let training = serde_json::json!({ "steps": 3 });
        model
            .save(&path, &robot(), training, String::new())
            .unwrap();
        let loaded = WorldModel::load(&path, &robot()).unwrap();
        assert_eq!(loaded.config(), model.config());
        assert_eq!(loaded.scaling(), model.scaling());
        let (stacks, actions) = (rows(4, 855, 1.0), rows(4, 12, 2.0));
        assert_eq!(
            values(&loaded.forward(&stacks, &actions).unwrap()),
            values(&model.forward(&stacks, &actions).unwrap())
        );
        let policy = "weights/emp27-policy.safetensors".as_ref();
        let error = WorldModel::load(policy, &robot()).unwrap_err().to_string();
        assert!(error.contains("kind is policy"), "{error}");
    }
}

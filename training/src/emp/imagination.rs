//! Imagined control periods: EMP → goal inside `S_t` → frozen policy → frozen world model (paper, Algorithm 1; erratum E9).

use std::{path::Path, sync::Arc};

use candle_core::{Device, Tensor, bail};
use emp_models::{
    ModelError, checkpoint, emp::EmpNetwork, policy::Policy, world_model::WorldModel,
};
use emp_robot::Robot;

/// One imagined control period of a batch.
#[derive(Clone, Debug)]
pub struct ImaginedStep {
    /// The executable goal `ĝ_t` as the EMP answers it, not held inside the joints' ranges (N × goal joints, rad).
    pub goal: Tensor,
    /// The latent z of that answer (N × latent).
    pub latent: Tensor,
    /// Joint positions that the world model predicts for t + 1 (N × joints, rad).
    pub joint_positions: Tensor,
    /// Roll, pitch and yaw that it predicts for t + 1 (N × 3, rad).
    pub orientation: Tensor,
}

/// A world model that was trained before and stays as it is.
#[derive(Clone)]
pub struct FrozenWorldModel {
    /// The model.
    pub model: WorldModel,
    /// The version of its weights.
    pub version: String,
}

impl FrozenWorldModel {
    /// Loads what `emp-train world-model` wrote for `robot`.
    ///
    /// # Errors
    /// When the file is damaged or of another robot.
    pub fn load(path: &Path, robot: &Robot) -> Result<Self, ModelError> {
        let (metadata, _) = checkpoint::load(path)?;
        Ok(Self {
            model: WorldModel::load(path, robot)?,
            version: metadata.version().to_owned(),
        })
    }
}

/// A policy and a world model that stay as they are; gradients pass through them.
pub struct Imagination {
    policy: Arc<Policy>,
    world_model: WorldModel,
    /// Lower and upper limits of the goal joints (1 × goal joints, rad).
    ranges: [Tensor; 2],
}

impl Imagination {
    /// Imagines with `policy` and `world_model`. Where the world model's tensors are variables, gradients reach them too: give it
    /// with plain tensors.
    ///
    /// # Errors
    /// When the two read different observations.
    pub fn new(policy: Arc<Policy>, world_model: WorldModel) -> candle_core::Result<Self> {
        let (expected, found) = (policy.layout(), &world_model.config().observation);
        if found != expected {
            bail!("the world model reads {found:?}, expected the policy's {expected:?}");
        }
        let joints = policy.robot().goal_joints();
        let limits = |side: usize| {
            let limits = joints.iter().map(|joint| joint.range[side] as f32);
            Tensor::from_iter(limits, &Device::Cpu)?.unsqueeze(0)
        };
        Ok(Self {
            ranges: [limits(0)?, limits(1)?],
            policy,
            world_model,
        })
    }

    /// Imagines a step for the goal in the newest frames of `stacks`
    /// (N × [`ObservationLayout::width`](emp_models::observation::ObservationLayout::width)), then one for each of `goals_ahead`
    /// (N × goal joints, rad). Gradients reach `emp`.
    ///
    /// # Errors
    /// When widths do not fit.
    pub fn unroll(
        &self,
        emp: &EmpNetwork,
        stacks: &Tensor,
        goals_ahead: &[Tensor],
    ) -> candle_core::Result<Vec<ImaginedStep>> {
        let newest_goal = self.policy.layout().newest_goal();
        let mut goals = stacks.narrow(1, newest_goal.start, newest_goal.len())?;
        let mut stacks = stacks.clone();
        let mut goals_ahead = goals_ahead.iter();
        let mut steps = Vec::with_capacity(1 + goals_ahead.len());
        loop {
            let (goal, latent) = emp.forward(&stacks, &goals)?;
            let executed = self.with_goal(&stacks, &goal)?;
            let actions = self.policy.forward(&executed)?;
            let next = self.world_model.forward(&executed, &actions)?;
            steps.push(self.step(goal, latent, &next)?);
            let Some(next_goals) = goals_ahead.next() else {
                return Ok(steps);
            };
            stacks = self
                .world_model
                .advance(&executed, &actions, &next, next_goals)?;
            goals = next_goals.clone();
        }
    }

    /// `stacks` with `goal`, inside the joints' ranges, in their newest frames: what is executed.
    fn with_goal(&self, stacks: &Tensor, goal: &Tensor) -> candle_core::Result<Tensor> {
        let [lower, upper] = &self.ranges;
        let goal = goal.broadcast_maximum(lower)?.broadcast_minimum(upper)?;
        let past = stacks.narrow(1, 0, self.policy.layout().newest_goal().start)?;
        Tensor::cat(&[past, goal], 1)
    }

    fn step(
        &self,
        goal: Tensor,
        latent: Tensor,
        next: &Tensor,
    ) -> candle_core::Result<ImaginedStep> {
        let joints = self.policy.layout().joint_positions().len();
        let angles = self.policy.layout().orientation().len();
        Ok(ImaginedStep {
            goal,
            latent,
            joint_positions: next.narrow(1, 0, joints)?,
            orientation: next.narrow(1, joints, angles)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use candle_core::DType;
    use candle_nn::{VarBuilder, VarMap};
    use emp_models::{
        CheckpointMetadata,
        emp::{DangerGate, EmpConfig, Output},
        mlp::{Mlp, Normalizer},
        observation::{HISTORY, HistoryMap, ObservationLayout},
        policy::{self, PolicyConfig},
        world_model::{Scaling, WorldModelConfig},
    };
    use emp_robot::Robot;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        emp::{
            losses::{LossSettings, LossWeights},
            objective::{Objective, StateBatch},
        },
        variables,
    };

    const ROWS: usize = 3;

    fn robot() -> Arc<Robot> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27");
        Arc::new(Robot::load(&folder).unwrap())
    }

    fn layout() -> ObservationLayout {
        ObservationLayout::new(&robot(), HISTORY)
    }

    /// Random variables, the same ones every time, of what `network` makes with them.
    fn random<T>(seed: u64, network: impl Fn(&VarBuilder<'_>) -> T) -> (VarMap, T) {
        let vars = VarMap::new();
        let network = network(&VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu));
        variables::initialise(&vars, &mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
        (vars, network)
    }

    fn policy() -> Arc<Policy> {
        let robot = robot();
        let config = PolicyConfig::new(&robot, vec![16]);
        let (vars, _) = random(1, |vars| {
            let vars = vars.pp(policy::NETWORK_PREFIX);
            let actions = robot.leg_joints().len();
            Mlp::new(config.features(), &config.hidden, actions, &vars).unwrap()
        });
        let mut tensors = variables::values(&vars).unwrap();
        tensors.extend(Normalizer::identity(config.features()).tensors().unwrap());
        let metadata = CheckpointMetadata::for_joints(policy::KIND, &robot, robot.joints());
        Arc::new(Policy::from_tensors(config, robot, tensors, metadata).unwrap())
    }

    fn imagination() -> Imagination {
        let config = WorldModelConfig::new(&robot(), vec![16]);
        let scaling = Scaling {
            outputs: vec![0.1; config.outputs()],
            ..Scaling::identity(&config)
        };
        let (vars, _) = random(3, |vars| {
            WorldModel::new(config.clone(), scaling.clone(), vars).unwrap()
        });
        let tensors = variables::values(&vars).unwrap().into_iter().collect();
        let vars = VarBuilder::from_tensors(tensors, DType::F32, &Device::Cpu);
        Imagination::new(policy(), WorldModel::new(config, scaling, &vars).unwrap()).unwrap()
    }

    fn emp(output: Output) -> (VarMap, EmpNetwork) {
        let config = EmpConfig {
            output,
            history_map: HistoryMap::differences(),
            state_hidden: vec![12],
            target_hidden: vec![10],
            encoding: 6,
            fusion_hidden: vec![8],
            latent: 5,
            decoder_hidden: vec![8],
            gate: DangerGate::PAPER,
            ..EmpConfig::paper(&robot())
        };
        let normalizer = Normalizer::identity(config.features());
        random(2, |vars| {
            EmpNetwork::new(config.clone(), normalizer.clone(), vars).unwrap()
        })
    }

    fn tensor(rows: usize, values: impl Iterator<Item = f64>) -> Tensor {
        let values = values.map(|value| value as f32);
        let values = Tensor::from_iter(values, &Device::Cpu).unwrap();
        let width = values.elem_count() / rows;
        values.reshape((rows, width)).unwrap()
    }

    /// Stacks near the default pose.
    fn stacks() -> Tensor {
        let (robot, layout) = (robot(), layout());
        let mut frame = vec![0.0; layout.frame_width()];
        let default: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
        frame[layout.joint_positions()].copy_from_slice(&default);
        frame[layout.goal()].copy_from_slice(&default[..layout.goal().len()]);
        let numbers = 0..ROWS * layout.width();
        tensor(
            ROWS,
            numbers.map(|i| frame[i % frame.len()] + 0.1 * (3.7 * i as f64).sin()),
        )
    }

    fn goals(seed: f64) -> Tensor {
        let robot = robot();
        let width = robot.goal_joints().len();
        let default = |i: usize| robot.goal_joints()[i % width].default;
        tensor(
            ROWS,
            (0..ROWS * width).map(|i| default(i) + 0.1 * (5.1 * i as f64 + seed).sin()),
        )
    }

    fn numbers(tensor: &Tensor) -> Vec<f64> {
        let tensor = tensor.flatten_all().unwrap().to_dtype(DType::F64);
        tensor.unwrap().to_vec1().unwrap()
    }

    fn assert_near(found: &Tensor, expected: &Tensor) {
        assert_eq!(found.dims(), expected.dims());
        for (found, expected) in numbers(found).iter().zip(numbers(expected)) {
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
    }

    /// What policy and world model answer to stacks whose newest goals are replaced: those stacks, the actions, and the
    /// predictions.
    fn passes(imagination: &Imagination, stacks: &Tensor, goals: &Tensor) -> [Tensor; 3] {
        let mut rows = stacks.to_vec2::<f32>().unwrap();
        for (row, goal) in rows.iter_mut().zip(goals.to_vec2::<f32>().unwrap()) {
            row[layout().newest_goal()].copy_from_slice(&goal);
        }
        let actions = imagination.policy.actions(&rows.concat()).unwrap();
        let actions = tensor(ROWS, actions.into_iter().map(f64::from));
        let stacks = tensor(ROWS, rows.concat().into_iter().map(f64::from));
        let next = imagination.world_model.forward(&stacks, &actions).unwrap();
        [stacks, actions, next]
    }

    fn next(step: &ImaginedStep) -> Tensor {
        Tensor::cat(&[&step.joint_positions, &step.orientation], 1).unwrap()
    }

    fn newest_goal(stacks: &Tensor) -> Tensor {
        let part = layout().newest_goal();
        stacks.narrow(1, part.start, part.len()).unwrap()
    }

    #[test]
    fn the_executable_goal_takes_the_goals_place() {
        let (imagination, stacks) = (imagination(), stacks());
        let (_, emp) = emp(Output::Residual);
        let asked = newest_goal(&stacks);
        let (goal, latent) = emp.forward(&stacks, &asked).unwrap();
        let steps = imagination.unroll(&emp, &stacks, &[]).unwrap();
        assert_eq!(steps.len(), 1);
        assert_near(&steps[0].goal, &goal);
        assert_near(&steps[0].latent, &latent);
        let [_, _, expected] = passes(&imagination, &stacks, &goal);
        assert_near(&next(&steps[0]), &expected);
        let [_, _, unchanged] = passes(&imagination, &stacks, &asked);
        let changes = numbers(&(expected - unchanged).unwrap());
        assert!(changes.iter().any(|change| change.abs() > 1e-3));
    }

    #[test]
    fn the_next_step_sees_the_predicted_frame() {
        let (imagination, stacks, layout) = (imagination(), stacks(), layout());
        let (_, emp) = emp(Output::Residual);
        let ahead = goals(1.0);
        let steps = imagination
            .unroll(&emp, &stacks, std::slice::from_ref(&ahead))
            .unwrap();
        let [executed, actions, _] = passes(&imagination, &stacks, &steps[0].goal);
        let width = layout.frame_width();
        let kept = executed.narrow(1, width, layout.width() - width).unwrap();
        let ImaginedStep {
            joint_positions,
            orientation,
            ..
        } = &steps[0];
        let stacks = Tensor::cat(&[&kept, joint_positions, &actions, orientation, &ahead], 1);
        let alone = imagination.unroll(&emp, &stacks.unwrap(), &[]).unwrap();
        assert_eq!(steps.len(), 2);
        assert_near(&steps[1].goal, &alone[0].goal);
        assert_near(&next(&steps[1]), &next(&alone[0]));
    }

    #[test]
    fn what_is_executed_is_inside_the_ranges() {
        let (imagination, stacks) = (imagination(), stacks());
        let (vars, emp) = emp(Output::Absolute);
        let vars = variables::lock(&vars).unwrap();
        let bias = &vars["decoder.1.bias"];
        bias.set(&(bias.ones_like().unwrap() * 50.0).unwrap())
            .unwrap();
        let steps = imagination.unroll(&emp, &stacks, &[]).unwrap();
        assert!(numbers(&steps[0].goal).iter().all(|angle| *angle > 40.0));
        let robot = robot();
        let upper = robot.goal_joints().iter().map(|joint| joint.range[1]);
        let upper = tensor(1, upper).repeat((ROWS, 1)).unwrap();
        let [_, _, expected] = passes(&imagination, &stacks, &upper);
        assert_near(&next(&steps[0]), &expected);
    }

    /// The loss of an EMP's imagined steps. Its networks compute in f32; the rest is in f64.
    struct Case {
        imagination: Imagination,
        objective: Objective,
        states: StateBatch,
    }

    impl Case {
        fn new(horizon: usize) -> Self {
            let settings = LossSettings::default();
            Self {
                imagination: imagination(),
                objective: Objective::new(&robot(), layout(), settings).unwrap(),
                states: StateBatch {
                    stacks: stacks(),
                    goals_ahead: (1..horizon).map(|t| goals(t as f64)).collect(),
                    goals_before: [goals(-2.0), goals(-1.0)],
                },
            }
        }

        fn loss(&self, emp: &EmpNetwork, weights: &LossWeights) -> Tensor {
            let double = |tensor: &Tensor| tensor.to_dtype(DType::F64).unwrap();
            let (stacks, ahead) = (&self.states.stacks, &self.states.goals_ahead);
            let steps = self.imagination.unroll(emp, stacks, ahead).unwrap();
            let steps: Vec<ImaginedStep> = steps
                .iter()
                .map(|step| ImaginedStep {
                    goal: double(&step.goal),
                    latent: double(&step.latent),
                    joint_positions: double(&step.joint_positions),
                    orientation: double(&step.orientation),
                })
                .collect();
            let states = StateBatch {
                stacks: double(stacks),
                goals_ahead: ahead.iter().map(double).collect(),
                goals_before: self.states.goals_before.each_ref().map(double),
            };
            let terms = self.objective.terms(&states, &steps).unwrap();
            terms.total(weights).unwrap()
        }
    }

    /// Compares the slope of the loss along a direction in each of the EMP's tensors with a finite difference.
    fn assert_gradient(horizon: usize, weights: &LossWeights) {
        const STEP: f64 = 0.02;
        /// Relative; networks in f32 and a step of this size leave up to 0.0015.
        const TOLERANCE: f64 = 0.005;
        let case = Case::new(horizon);
        let (vars, emp) = emp(Output::Residual);
        let loss = case.loss(&emp, weights);
        let gradients = loss.backward().unwrap();
        let vars = variables::lock(&vars).unwrap();
        assert_eq!(vars.len(), emp.tensors().len());
        for (name, var) in vars.iter() {
            let gradient = numbers(gradients.get(var).unwrap());
            let norm = gradient
                .iter()
                .map(|slope| slope * slope)
                .sum::<f64>()
                .sqrt();
            let aside = (2.0 / gradient.len() as f64).sqrt();
            let direction = gradient.iter().enumerate();
            let direction: Vec<f64> = direction
                .map(|(i, slope)| slope / norm + aside * (2.3 * i as f64).sin())
                .collect();
            let slopes = gradient.iter().zip(&direction);
            let slope = slopes.map(|(slope, along)| slope * along).sum::<f64>();
            let values = var.as_detached_tensor().copy().unwrap();
            let moved = |step: f64| {
                let moved = numbers(&values).into_iter().zip(&direction);
                let moved = tensor(1, moved.map(|(value, along)| value + step * along));
                var.set(&moved.reshape(var.shape()).unwrap()).unwrap();
                case.loss(&emp, weights).to_scalar::<f64>().unwrap()
            };
            let expected = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            var.set(&values).unwrap();
            assert!(
                (slope - expected).abs() < TOLERANCE * expected.abs(),
                "horizon {horizon}, {name}: {slope} {expected}"
            );
        }
    }

    #[test]
    fn gradients_reach_every_tensor_of_the_emp() {
        for horizon in [1, 3] {
            assert_gradient(horizon, &LossWeights::default());
        }
    }

    #[test]
    fn gradients_pass_through_policy_and_world_model() {
        // The predicted tilt depends on the EMP in no other way.
        let tilt = LossWeights {
            reconstruction: 0.0,
            orientation: 1.0,
            collision: 0.0,
            centroid: 0.0,
            smoothness: 0.0,
            regularization: 0.0,
        };
        for horizon in [1, 3] {
            assert_gradient(horizon, &tilt);
        }
    }

    #[test]
    fn a_world_model_of_other_observations_is_refused() {
        let mut config = WorldModelConfig::new(&robot(), vec![4]);
        config.observation = ObservationLayout::new(&robot(), 3);
        config.history_map = HistoryMap::identity(3);
        let scaling = Scaling::identity(&config);
        let (_, model) = random(4, |vars| {
            WorldModel::new(config.clone(), scaling.clone(), vars).unwrap()
        });
        let error = Imagination::new(policy(), model).err().unwrap();
        assert!(error.to_string().contains("history: 15"), "{error}");
    }
}

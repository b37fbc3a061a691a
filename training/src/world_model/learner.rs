//! The learner of a world model: from sequences to the next weights.
//!
//! Each batch is cut into a fixed number of shards; the gradient of each is computed on one thread, and they are added in order. So
//! the weights have the same bits at any number of threads.

use anyhow::Result;
use candle_core::{DType, Device, Tensor, backprop::GradStore};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    checkpoint::Tensors,
    observation::ObservationLayout,
    optimizer::{Adam, AdamConfig},
    world_model::{Scaling, WorldModel, WorldModelConfig},
};
use emp_robot::Robot;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::{
    sequences::{Period, Sequences},
    settings::LearnerSettings,
};
use crate::{
    policy::moments::RunningMoments,
    rows::{add_gradients, tensor},
    variables,
};

/// The model starts this near to predicting no change.
const GAIN: f64 = 0.1;

/// An output that changes less than this in a control period is scaled as if it changed so much, rad.
const LEAST_CHANGE: f64 = 1e-5;

/// Learns a world model.
pub struct WorldModelLearner {
    settings: LearnerSettings,
    vars: VarMap,
    model: WorldModel,
    adam: Adam,
}

/// What one update measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStatistics {
    /// Mean squared error over rows, periods and outputs, each output in units of its scale.
    pub loss: f64,
    /// Norm of the gradient before it was bounded.
    pub gradient_norm: f64,
}

impl WorldModelLearner {
    /// A learner with random weights. Inputs and outputs are scaled by their moments in the first periods of `sample`.
    ///
    /// # Errors
    /// When the sample is not of this robot.
    pub fn new(
        robot: &Robot,
        settings: LearnerSettings,
        sample: &Sequences,
        seed: u64,
    ) -> Result<Self> {
        let config = WorldModelConfig::new(robot, settings.hidden.clone());
        let scaling = scaling(&config, sample)?;
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let model = WorldModel::new(config, scaling, &builder)?;
        variables::initialise(&vars, &mut ChaCha8Rng::seed_from_u64(seed))?;
        let last = format!("{}.", settings.hidden.len());
        for (name, var) in variables::lock(&vars)?.iter() {
            if name.starts_with(&last) {
                var.set(&(var.as_detached_tensor() * GAIN)?)?;
            }
        }
        let config = AdamConfig {
            max_gradient_norm: settings.max_gradient_norm,
            ..AdamConfig::default()
        };
        Ok(Self {
            adam: Adam::new(&vars, config)?,
            settings,
            vars,
            model,
        })
    }

    /// Learns from a batch: the model predicts its periods one after the other, each from its own prediction of the one before,
    /// with the actions and goals that were recorded.
    ///
    /// # Errors
    /// When the batch is not of this robot, or the gradient is not a number.
    pub fn update(
        &mut self,
        batch: &Sequences,
        learning_rate: f64,
        threads: &rayon::ThreadPool,
    ) -> Result<UpdateStatistics> {
        let rows = batch.len(self.layout());
        let shard_rows = rows.div_ceil(self.settings.shards).max(1);
        let starts: Vec<usize> = (0..rows).step_by(shard_rows).collect();
        let shards = threads.install(|| {
            let shards = starts
                .par_iter()
                .map(|&start| self.shard(batch, start..(start + shard_rows).min(rows)));
            shards.collect::<Result<Vec<_>>>()
        })?;
        let loss = shards.iter().map(|(loss, _)| loss).sum();
        let gradients = shards.into_iter().map(|(_, gradient)| gradient);
        let gradient = add_gradients(gradients, &[&self.vars])?;
        Ok(UpdateStatistics {
            loss,
            gradient_norm: self.adam.step(&gradient, learning_rate)?,
        })
    }

    /// The model as it is now: later updates do not change it, and no gradient reaches its weights.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn model(&self) -> Result<WorldModel> {
        let tensors = variables::values(&self.vars)?.into_iter().collect();
        let vars = VarBuilder::from_tensors(tensors, DType::F32, &Device::Cpu);
        let (config, scaling) = (self.model.config().clone(), self.model.scaling().clone());
        Ok(WorldModel::new(config, scaling, &vars)?)
    }

    /// Steps of the optimiser so far.
    pub fn steps(&self) -> u64 {
        self.adam.steps()
    }

    /// Weights, scaling and the optimiser's state, for a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn state(&self) -> Result<Tensors> {
        let mut tensors = variables::values(&self.vars)?;
        tensors.extend(self.adam.state()?);
        tensors.extend(self.model.scaling().tensors()?);
        Ok(tensors)
    }

    /// Continues from a saved [`state`](Self::state) after `steps` steps of the optimiser.
    ///
    /// # Errors
    /// When a tensor is missing or has another shape.
    pub fn restore(&mut self, tensors: &Tensors, steps: u64) -> Result<()> {
        let config = self.model.config().clone();
        let scaling = Scaling::from_tensors(tensors, &config).map_err(anyhow::Error::msg)?;
        variables::restore(&self.vars, tensors)?;
        self.adam.restore(tensors, steps)?;
        let builder = VarBuilder::from_varmap(&self.vars, DType::F32, &Device::Cpu);
        self.model = WorldModel::new(config, scaling, &builder)?;
        Ok(())
    }

    fn layout(&self) -> &ObservationLayout {
        &self.model.config().observation
    }

    /// Loss and gradient of some rows of a batch, as their share of the whole batch's.
    fn shard(&self, batch: &Sequences, rows: std::ops::Range<usize>) -> Result<(f64, GradStore)> {
        let layout = self.layout();
        let part = |values: &[f32], width: usize| {
            tensor(&values[rows.start * width..rows.end * width], width)
        };
        let outputs = self.model.config().outputs();
        let units: Vec<f32> = self
            .model
            .scaling()
            .outputs
            .iter()
            .map(|s| 1.0 / s)
            .collect();
        let units = Tensor::new(units, &Device::Cpu)?;
        let mut stacks = part(&batch.stacks, layout.width())?;
        let mut sum = Tensor::zeros((), DType::F32, &Device::Cpu)?;
        for (index, period) in batch.periods.iter().enumerate() {
            let Period {
                actions,
                next,
                goals,
            } = period;
            let actions = part(actions, layout.last_action().len())?;
            let predicted = self.model.forward(&stacks, &actions)?;
            let error = (&predicted - part(next, outputs)?)?.broadcast_mul(&units)?;
            sum = (sum + error.sqr()?.sum_all()?)?;
            if index + 1 < batch.periods.len() {
                let goals = part(goals, layout.goal().len())?;
                stacks = self.model.advance(&stacks, &actions, &predicted, &goals)?;
            }
        }
        let count = batch.len(layout) * batch.periods.len() * outputs;
        let loss = (sum / count as f64)?;
        Ok((f64::from(loss.to_scalar::<f32>()?), loss.backward()?))
    }
}

/// The moments of inputs and outputs in the first periods of `sample`.
fn scaling(config: &WorldModelConfig, sample: &Sequences) -> Result<Scaling> {
    let layout = &config.observation;
    let first = sample.periods.first();
    let first = first.ok_or_else(|| anyhow::anyhow!("expected a control period, found none"))?;
    let stacks = tensor(&sample.stacks, layout.width())?;
    let actions = tensor(&first.actions, layout.last_action().len())?;
    let mut inputs = RunningMoments::new(config.inputs());
    let rows = config.project(&stacks, &actions)?;
    inputs.update(&rows.flatten_all()?.to_vec1::<f32>()?);
    let next = tensor(&first.next, config.outputs())?;
    let squares = (next - config.newest(&stacks)?)?.sqr()?.mean(0)?;
    let outputs = squares.to_vec1::<f32>()?.into_iter();
    Ok(Scaling {
        inputs: inputs.normalizer(),
        outputs: outputs
            .map(|square| f64::from(square).sqrt().max(LEAST_CHANGE) as f32)
            .collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world_model::testing::{robot, threads};

    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count)
            .map(|i| (12.9898 * (i + 7919 * seed) as f32).sin())
            .collect()
    }

    /// Robots whose every number follows its first action.
    fn batch(rows: usize, steps: usize, seed: usize) -> Sequences {
        let layout = WorldModelConfig::new(&robot(), Vec::new()).observation;
        let stacks = numbers(rows * layout.width(), seed);
        let newest = |stack: &[f32]| {
            let newest = &stack[layout.newest()];
            [
                &newest[layout.joint_positions()],
                &newest[layout.orientation()],
            ]
            .concat()
        };
        let mut now: Vec<f32> = stacks.chunks(layout.width()).flat_map(newest).collect();
        let periods = (0..steps).map(|period| {
            let actions = numbers(rows * 12, seed + period + 1);
            for (now, action) in now.chunks_mut(30).zip(actions.chunks(12)) {
                now.iter_mut().for_each(|x| *x += 0.1 * action[0]);
            }
            Period {
                next: now.clone(),
                goals: numbers(rows * 15, seed + period + 2),
                actions,
            }
        });
        let periods = periods.collect();
        Sequences { stacks, periods }
    }

    fn learner(sample: &Sequences) -> WorldModelLearner {
        let settings = LearnerSettings {
            hidden: vec![32],
            ..LearnerSettings::default()
        };
        WorldModelLearner::new(&robot(), settings, sample, 1).unwrap()
    }

    #[test]
    fn what_follows_from_the_action_is_learnt() {
        let (sample, threads) = (batch(64, 2, 0), threads(2));
        let mut learner = learner(&sample);
        let before = learner.model().unwrap();
        let losses: Vec<f64> = (0..150)
            .map(|i| {
                let update = learner.update(&batch(64, 2, 10 * i), 3e-3, &threads);
                update.unwrap().loss
            })
            .collect();
        // Without a prediction the error of the second period is twice that of the first, whose square is 1.
        assert!((1.0..2.0).contains(&losses[0]), "{}", losses[0]);
        assert!(losses[149] < 0.25, "{}", losses[149]);
        let stacks = tensor(&sample.stacks, 855).unwrap();
        let actions = tensor(&sample.periods[0].actions, 12).unwrap();
        let answer = |model: &WorldModel| -> Vec<f32> {
            let answer = model.forward(&stacks, &actions).unwrap();
            answer.flatten_all().unwrap().to_vec1().unwrap()
        };
        let error = |model: &WorldModel| -> f32 {
            let pairs = answer(model).into_iter().zip(&sample.periods[0].next);
            pairs.map(|(a, b)| (a - b).powi(2)).sum()
        };
        let after = learner.model().unwrap();
        assert!(error(&after) < 0.2 * error(&before));
        let then = answer(&after);
        learner.update(&sample, 3e-3, &threads).unwrap();
        assert_eq!(answer(&after), then, "a model that was given away stays");
    }

    #[test]
    fn a_restored_learner_goes_on_bit_for_bit_at_any_number_of_threads() {
        let sample = batch(30, 2, 0);
        let mut original = learner(&sample);
        for i in 0..3 {
            original
                .update(&batch(30, 2, i), 1e-3, &threads(2))
                .unwrap();
        }
        let (state, steps) = (original.state().unwrap(), original.steps());
        let next = original
            .update(&batch(30, 2, 9), 1e-3, &threads(2))
            .unwrap();
        for count in [1, 3] {
            // Scaled by another sample, until it is restored.
            let mut restored = learner(&batch(20, 1, 5));
            restored.restore(&state, steps).unwrap();
            let update = restored.update(&batch(30, 2, 9), 1e-3, &threads(count));
            assert_eq!(update.unwrap(), next);
            assert_eq!(restored.steps(), 4);
        }
    }
}

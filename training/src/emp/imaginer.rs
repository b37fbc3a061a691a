//! The first half of Algorithm 1: rollouts with goals as they are asked for, from which the world model learns.

use std::sync::Arc;

use anyhow::{Context as _, Result};
use emp_models::checkpoint::Tensors;
use rand::{SeedableRng as _, seq::SliceRandom as _};
use rand_chacha::ChaCha8Rng;

use super::{
    equipment::Equipment,
    imagination::Imagination,
    learner::usable_rows,
    rollout::{Collector, Rollout},
    settings::Settings,
};
use crate::world_model::{
    learner::WorldModelLearner,
    sequences::{Sequences, Trajectories},
};

/// What its environments and its weights have in their seed beside the run's.
const SEED: u64 = 0x0077_6f72_6c64;

/// Prefix of its tensors in a checkpoint.
const PREFIX: &str = "world-model";

/// A world model that learns beside the EMP.
pub struct Imaginer {
    settings: Settings,
    collector: Collector,
    learner: WorldModelLearner,
    /// Rollouts learnt from.
    rollouts: u64,
}

impl Imaginer {
    /// A world model with random weights, scaled by a first rollout.
    ///
    /// # Errors
    /// When a setting is out of bounds, or the simulation fails.
    pub fn new(equipment: &Equipment, settings: &Settings) -> Result<Self> {
        let seed = settings.seed ^ SEED;
        let mut collector = Collector::new(equipment.environments(settings, seed)?);
        let rollout = collect(&mut collector, settings, equipment)?;
        let sample = sequences(&collector, &rollout, &usable_rows(&rollout, 1), 1);
        let learner = settings.world_model.learner.clone();
        Ok(Self {
            learner: WorldModelLearner::new(&equipment.robot, learner, &sample, seed)?,
            settings: settings.clone(),
            collector,
            rollouts: 0,
        })
    }

    /// Collects a rollout and learns from it; the mean loss.
    ///
    /// # Errors
    /// When the simulation fails, or a gradient is not a number.
    pub fn learn(&mut self, equipment: &Equipment) -> Result<f64> {
        let rollout = collect(&mut self.collector, &self.settings, equipment)?;
        let steps = self.settings.wm_loss_steps;
        let usable = usable_rows(&rollout, steps);
        let mut rng = ChaCha8Rng::seed_from_u64(self.settings.seed ^ SEED);
        rng.set_stream(self.rollouts + 1);
        let world_model = &self.settings.world_model;
        let mut order = Vec::new();
        let mut losses = 0.0;
        for _ in 0..world_model.updates {
            if order.is_empty() {
                order.clone_from(&usable);
                order.shuffle(&mut rng);
            }
            let left = order.len().saturating_sub(world_model.rows);
            let rows: Vec<usize> = order.split_off(left);
            let batch = sequences(&self.collector, &rollout, &rows, steps);
            let rate = world_model.learning_rate;
            losses += self.learner.update(&batch, rate, &equipment.threads)?.loss;
        }
        self.rollouts += 1;
        Ok(losses / world_model.updates.max(1) as f64)
    }

    /// Imagines with the world model as it is now.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn imagination(&self, equipment: &Equipment) -> Result<Imagination> {
        let policy = Arc::clone(&equipment.policy);
        Ok(Imagination::new(policy, self.learner.model()?)?)
    }

    /// Adds everything that later learning depends on to a checkpoint's tensors; its environments' snapshot and its counts.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn save(&self, tensors: &mut Tensors) -> Result<(Vec<u8>, [u64; 2])> {
        let state = self.learner.state()?.into_iter();
        tensors.extend(state.map(|(name, tensor)| (format!("{PREFIX}/{name}"), tensor)));
        Ok((
            self.collector.snapshot()?,
            [self.rollouts, self.learner.steps()],
        ))
    }

    /// Goes on from what [`save`](Self::save) gave.
    ///
    /// # Errors
    /// When a part is missing or is of another run.
    pub fn restore(
        &mut self,
        tensors: &Tensors,
        snapshot: &[u8],
        [rollouts, steps]: [u64; 2],
    ) -> Result<()> {
        let own = tensors.iter().filter_map(|(name, tensor)| {
            let name = name.strip_prefix(PREFIX)?.strip_prefix('/')?;
            Some((name.to_owned(), tensor.clone()))
        });
        self.learner
            .restore(&own.collect(), steps)
            .context("the world model")?;
        self.collector.restore(snapshot)?;
        self.rollouts = rollouts;
        Ok(())
    }
}

fn collect(
    collector: &mut Collector,
    settings: &Settings,
    equipment: &Equipment,
) -> Result<Rollout> {
    collector.collect(None, settings.frames, 0, &equipment.threads)
}

fn sequences(collector: &Collector, rollout: &Rollout, rows: &[usize], steps: usize) -> Sequences {
    let trajectories = Trajectories {
        environments: rollout.environments,
        stacks: &rollout.stacks,
        executed: &rollout.goals,
        actions: &rollout.actions,
        next: &rollout.next,
    };
    Sequences::gather(
        &trajectories,
        collector.environments().layout(),
        rows,
        steps,
    )
}

//! Where rollouts come from: this machine's simulation, or that of servers.

use std::{sync::Arc, time::Duration};

use anyhow::Result;
use emp_models::policy::Policy;
use emp_robot::Robot;
use emp_sim::{Collector, Pool, Rollout, environment::VecEnvironment, goals::GoalLibrary};

use super::Settings;

/// What a rollout is collected with.
#[derive(Clone, Debug)]
pub struct PolicySnapshot {
    /// The policy.
    pub policy: Arc<Policy>,
    /// Logarithms of the deviations of exploration, one a leg joint.
    pub log_std: Vec<f32>,
    /// Scale of the domain randomisation of episodes that start now.
    pub randomization: f64,
    /// Largest amplitude of goals of episodes that start now.
    pub difficulty: f64,
    /// How often each clip of the library is drawn from now on, relative to its class and length.
    pub clip_weights: Vec<f32>,
}

/// A rollout and how long parts of it took.
#[derive(Clone, Debug)]
pub struct Collected {
    /// The rollout.
    pub rollout: Rollout,
    /// Time that the policy took of it.
    pub inference: Duration,
}

/// Environments that a learner explores, wherever they are. The same seed and number of environments give the same rollouts
/// from every source.
pub trait RolloutSource {
    /// Runs all environments for `horizon` control periods.
    ///
    /// # Errors
    /// When the simulation fails for good; the environments are then where they were before.
    fn collect(&mut self, snapshot: &PolicySnapshot, horizon: usize) -> Result<Collected>;

    /// Everything that later rollouts depend on, but for the snapshots they are collected with.
    ///
    /// # Errors
    /// When it cannot be read.
    fn snapshot(&mut self) -> Result<Vec<u8>>;

    /// Continues from a [`snapshot`](Self::snapshot).
    ///
    /// # Errors
    /// When it is of other environments.
    fn restore(&mut self, snapshot: &[u8]) -> Result<()>;
}

/// Environments on this machine.
pub struct LocalSource {
    collector: Collector,
}

impl LocalSource {
    /// The environments of a run, on `pool`, with goals from `library`.
    ///
    /// # Errors
    /// When a setting is out of bounds or the library is not for this robot.
    pub fn new(
        robot: &Arc<Robot>,
        pool: &Arc<Pool>,
        settings: &Settings,
        library: Arc<GoalLibrary>,
    ) -> Result<Self> {
        let environments = VecEnvironment::new(
            Arc::clone(robot),
            Arc::clone(pool),
            settings.environment,
            library,
            0..settings.environments as u64,
            settings.seed,
        )?;
        Ok(Self {
            collector: Collector::new(environments, 0, settings.seed),
        })
    }
}

impl RolloutSource for LocalSource {
    fn collect(&mut self, snapshot: &PolicySnapshot, horizon: usize) -> Result<Collected> {
        self.collector
            .set_curriculum(snapshot.randomization, snapshot.difficulty as f32);
        self.collector.set_clip_weights(&snapshot.clip_weights);
        let rollout = self
            .collector
            .collect(&snapshot.policy, &snapshot.log_std, horizon)?;
        Ok(Collected {
            rollout,
            inference: self.collector.inference_time(),
        })
    }

    fn snapshot(&mut self) -> Result<Vec<u8>> {
        Ok(self.collector.snapshot()?)
    }

    fn restore(&mut self, snapshot: &[u8]) -> Result<()> {
        Ok(self.collector.restore(snapshot)?)
    }
}

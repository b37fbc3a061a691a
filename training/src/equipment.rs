//! What every training in simulation needs beside its settings.

use std::sync::Arc;

use anyhow::Result;
use emp_models::policy::Policy;
use emp_robot::Robot;
use emp_sim::{
    Pool,
    goals::GoalClip,
    tracking::{TrackingEnvironments, TrackingSettings},
};

/// What a run trains with.
#[derive(Clone)]
pub struct Equipment {
    /// The robot.
    pub robot: Arc<Robot>,
    /// The frozen policy, which moves the legs.
    pub policy: Arc<Policy>,
    /// Physics.
    pub pool: Arc<Pool>,
    /// The clips.
    pub clips: Arc<[GoalClip]>,
    /// Threads of forward and backward passes.
    pub threads: Arc<rayon::ThreadPool>,
}

impl Equipment {
    /// So many environments, whose episodes follow from `seed`.
    pub(crate) fn environments(
        &self,
        episodes: TrackingSettings,
        count: usize,
        seed: u64,
    ) -> Result<TrackingEnvironments> {
        Ok(TrackingEnvironments::new(
            Arc::clone(&self.robot),
            Arc::clone(&self.pool),
            Arc::clone(&self.policy),
            episodes,
            Arc::clone(&self.clips),
            0..count as u64,
            seed,
        )?)
    }
}

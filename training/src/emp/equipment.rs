//! What a run trains with.

use std::sync::Arc;

use anyhow::Result;
use emp_models::policy::Policy;
use emp_robot::Robot;
use emp_sim::{Pool, goals::GoalClip, tracking::TrackingEnvironments};

use super::settings::Settings;

/// What a run trains with.
#[derive(Clone)]
pub struct Equipment {
    /// The robot.
    pub robot: Arc<Robot>,
    /// The frozen policy.
    pub policy: Arc<Policy>,
    /// Physics.
    pub pool: Arc<Pool>,
    /// The clips.
    pub clips: Arc<[GoalClip]>,
    /// Threads of forward and backward passes.
    pub threads: Arc<rayon::ThreadPool>,
}

impl Equipment {
    /// Environments whose episodes follow from `seed`.
    pub(super) fn environments(
        &self,
        settings: &Settings,
        seed: u64,
    ) -> Result<TrackingEnvironments> {
        Ok(TrackingEnvironments::new(
            Arc::clone(&self.robot),
            Arc::clone(&self.pool),
            Arc::clone(&self.policy),
            settings.episodes,
            Arc::clone(&self.clips),
            0..settings.environments as u64,
            seed,
        )?)
    }
}

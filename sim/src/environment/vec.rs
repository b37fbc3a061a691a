//! Many environments, stepped together.

use std::ops::Range;
use std::sync::Arc;

use emp_models::observation::ObservationLayout;
use emp_robot::Robot;
use rayon::prelude::*;

use super::episode::{Environment, Setting, Slots};
use super::{EndReason, EnvironmentConfig, PrivilegedLayout, REWARD_TERMS};
use crate::goals::GoalLibrary;
use crate::{Pool, SimError};

/// N environments. Batches hold one row an environment.
#[derive(Debug)]
pub struct VecEnvironment {
    pool: Arc<Pool>,
    setting: Setting,
    environments: Vec<Environment>,
    batch: Batch,
}

/// What one control period came to; batches with one row an environment.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// Rewards: the sum of the terms × the control period in seconds.
    pub rewards: &'a [f32],
    /// Weighted reward terms, [`REWARD_TERMS`] a row.
    pub terms: &'a [f64],
    /// Why the episode ended, where it did. The observations then are already those of the next one.
    pub ends: &'a [Option<EndReason>],
    /// Control periods since the episode's start.
    pub lengths: &'a [u32],
    /// Index of the clip that is played, or was until a moment ago.
    pub clips: &'a [u32],
    /// Where an episode ended: the privileged observation at its end.
    pub final_privileged: &'a [f32],
}

#[derive(Debug)]
struct Batch {
    observations: Vec<f32>,
    privileged: Vec<f32>,
    final_privileged: Vec<f32>,
    rewards: Vec<f32>,
    terms: Vec<f64>,
    ends: Vec<Option<EndReason>>,
    lengths: Vec<u32>,
    clips: Vec<u32>,
}

impl VecEnvironment {
    /// The environments with the numbers `environments`. Seed and number decide all that is random in an environment, so that ranges
    /// on several machines together are what one machine would simulate.
    ///
    /// # Errors
    /// If a setting is out of bounds or the library is not for this robot.
    pub fn new(
        robot: Arc<Robot>,
        pool: Arc<Pool>,
        config: EnvironmentConfig,
        library: Arc<GoalLibrary>,
        environments: Range<u64>,
        seed: u64,
    ) -> Result<Self, SimError> {
        config.check(&robot)?;
        if library.joints() != robot.goal_joints().len() {
            return Err(SimError::Setting {
                name: "goal library".to_owned(),
                expected: format!("goals of {} joints", robot.goal_joints().len()),
                found: library.joints().to_string(),
            });
        }
        let setting = Setting::new(robot, config, library);
        let count = environments.end.saturating_sub(environments.start) as usize;
        let mut made: Vec<Option<Environment>> = (0..count).map(|_| None).collect();
        pool.for_each(made.par_iter_mut().enumerate(), |stage, (index, slot)| {
            let index = environments.start + index as u64;
            *slot = Some(Environment::new(&setting, stage, seed, index));
        });
        let mut vec = Self {
            batch: Batch::new(&setting, count),
            environments: made.into_iter().flatten().collect(),
            pool,
            setting,
        };
        vec.write_observations();
        Ok(vec)
    }

    /// Number of environments.
    pub fn len(&self) -> usize {
        self.environments.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.environments.is_empty()
    }

    /// The robot.
    pub fn robot(&self) -> &Arc<Robot> {
        &self.setting.kind.robot
    }

    /// The settings.
    pub fn config(&self) -> &EnvironmentConfig {
        &self.setting.config
    }

    /// Where each part of an observation stands.
    pub fn layout(&self) -> &ObservationLayout {
        &self.setting.kind.observation
    }

    /// Where each part of a privileged observation stands.
    pub fn privileged_layout(&self) -> &PrivilegedLayout {
        &self.setting.kind.privileged
    }

    /// The stacks `S_t`, N × [`ObservationLayout::width`].
    pub fn observations(&self) -> &[f32] {
        &self.batch.observations
    }

    /// What the critic sees, N × [`PrivilegedLayout::width`].
    pub fn privileged(&self) -> &[f32] {
        &self.batch.privileged
    }

    /// How hard episodes are that start from now on: the scale of every range of the randomisation (1 is as set, 0 is
    /// nominal) and the largest amplitude of goals (1 is the clips' own).
    pub fn set_curriculum(&mut self, randomization: f64, difficulty: f32) {
        let setting = &mut self.setting;
        let full = setting.config.randomization;
        setting.randomization = full.scaled(&setting.kind.robot, randomization);
        setting.difficulty = difficulty;
    }

    /// How often each clip of the library is drawn from now on, as a multiple of how often it would be by its class and
    /// length; clips without a weight have 1.
    pub fn set_clip_weights(&mut self, weights: &[f32]) {
        self.setting.library = Arc::new(self.setting.library.weighted(weights));
    }

    /// Runs every environment for one control period; `actions` is N × leg joints, policy units.
    ///
    /// # Panics
    /// If there is not one row of actions an environment.
    pub fn step(&mut self, actions: &[f32]) -> Step<'_> {
        let (setting, batch) = (&self.setting, &mut self.batch);
        let legs = setting.kind.observation.last_action().len();
        assert_eq!(actions.len(), legs * self.environments.len(), "actions");
        let privileged = setting.kind.privileged.width();
        let rows = (
            self.environments.par_iter_mut(),
            actions.par_chunks_exact(legs),
            batch
                .observations
                .par_chunks_exact_mut(setting.kind.observation.width()),
            batch.privileged.par_chunks_exact_mut(privileged),
            batch.final_privileged.par_chunks_exact_mut(privileged),
            batch.rewards.par_iter_mut(),
            batch.terms.par_chunks_exact_mut(REWARD_TERMS),
            batch.ends.par_iter_mut(),
            batch.lengths.par_iter_mut(),
            batch.clips.par_iter_mut(),
        );
        self.pool.for_each(rows.into_par_iter(), |stage, row| {
            let (
                environment,
                action,
                observation,
                privileged,
                final_privileged,
                reward,
                terms,
                end,
                length,
                clip,
            ) = row;
            let mut slots = Slots {
                observation,
                privileged,
                final_privileged,
                reward,
                terms,
                end,
                length,
                clip,
            };
            environment.step(setting, stage, action, &mut slots);
        });
        Step {
            rewards: &batch.rewards,
            terms: &batch.terms,
            ends: &batch.ends,
            lengths: &batch.lengths,
            clips: &batch.clips,
            final_privileged: &batch.final_privileged,
        }
    }

    /// Everything that the environments' future depends on, but for the actions, the settings and the curriculum.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        postcard::to_stdvec(&self.environments).map_err(|e| SimError::Snapshot(e.to_string()))
    }

    /// Goes on from a snapshot of environments of the same robot, number and settings, bit for bit.
    ///
    /// # Errors
    /// If it is no such snapshot; then nothing has changed.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<(), SimError> {
        let environments: Vec<Environment> =
            postcard::from_bytes(snapshot).map_err(|e| SimError::Snapshot(e.to_string()))?;
        if environments.len() != self.len() {
            return Err(SimError::Snapshot(format!(
                "expected {} environments, found {}",
                self.len(),
                environments.len()
            )));
        }
        let mut pairs = environments.iter().zip(&self.environments);
        if !pairs.all(|(restored, present)| restored.is_like(present)) {
            return Err(SimError::Snapshot(
                "it is of another robot or setting".to_owned(),
            ));
        }
        self.environments = environments;
        self.write_observations();
        Ok(())
    }

    fn write_observations(&mut self) {
        let observations = self
            .batch
            .observations
            .chunks_exact_mut(self.setting.kind.observation.width());
        let privileged = self
            .batch
            .privileged
            .chunks_exact_mut(self.setting.kind.privileged.width());
        for ((environment, observation), privileged) in
            self.environments.iter().zip(observations).zip(privileged)
        {
            environment.write(&self.setting, observation, privileged);
        }
    }
}

impl Batch {
    fn new(setting: &Setting, count: usize) -> Self {
        let privileged = vec![0.0; count * setting.kind.privileged.width()];
        Self {
            observations: vec![0.0; count * setting.kind.observation.width()],
            final_privileged: privileged.clone(),
            privileged,
            rewards: vec![0.0; count],
            terms: vec![0.0; count * REWARD_TERMS],
            ends: vec![None; count],
            lengths: vec![0; count],
            clips: vec![0; count],
        }
    }
}

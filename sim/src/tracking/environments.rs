//! Many tracking environments, stepped together.

use std::ops::Range;
use std::sync::Arc;

use emp_models::observation::ObservationLayout;
use emp_models::policy::Policy;
use emp_robot::Robot;
use rayon::prelude::*;

use super::TrackingSettings;
use super::episode::{EndedEpisode, Environment, Setting, Slots};
use crate::goals::{GoalClip, check_clips};
use crate::{End, Pool, SimError};

/// Environments that share a batch of the policy: the same ones on any number of threads, since a batch's size changes an
/// answer's last bits.
const GROUP: usize = 16;

/// N robots whose legs a frozen policy moves and whose goals the learner chooses. Batches hold one row an environment.
#[derive(Debug)]
pub struct TrackingEnvironments {
    pool: Arc<Pool>,
    policy: Arc<Policy>,
    setting: Arc<Setting>,
    environments: Vec<Environment>,
    batch: Batch,
}

/// What one control period came to; batches with one row an environment, measured before any reset.
///
/// Where the simulation diverged ([`End::Diverged`]) nothing could be measured: `next` and the measurements are those of the
/// control period before.
#[derive(Clone, Copy, Debug)]
pub struct TrackingStep<'a> {
    /// The policy's actions `a_t`, N × leg joints, policy units.
    pub actions: &'a [f32],
    /// `[q | roll, pitch, yaw]` of `s_{t+1}`, N × (joints + 3), rad; yaw relative to the heading at reset.
    pub next: &'a [f32],
    /// Horizontal way from the middle between the feet to the measured centre of mass, heading frame (x forward, y left),
    /// N × 2, metres.
    pub com: &'a [f32],
    /// Contact force of the robot with itself ([`SelfContact::force`](crate::SelfContact::force)), N, newtons.
    pub contact: &'a [f32],
    /// How the control period ended, N. Where it ended an episode, the observations are already those of the next one.
    pub ends: &'a [End],
    /// The episodes that ended, in the order of the rows.
    pub episodes: &'a [EndedEpisode],
}

/// A robot in the middle of an episode.
#[derive(Clone, Debug)]
pub struct TrackingState(Environment);

#[derive(Debug)]
struct Batch {
    observations: Vec<f32>,
    goals: Vec<f32>,
    starts: Vec<bool>,
    actions: Vec<f32>,
    next: Vec<f32>,
    com: Vec<f32>,
    contact: Vec<f32>,
    ends: Vec<End>,
    ended: Vec<Option<EndedEpisode>>,
    episodes: Vec<EndedEpisode>,
}

impl TrackingEnvironments {
    /// The environments with the numbers `numbers`. Seed and number decide all that is random in an environment. Each
    /// episode takes any of `clips`, all equally likely, and any part of a clip that is longer than the episode.
    ///
    /// # Errors
    /// If a setting is out of bounds, there is no clip, or clips or policy are not for this robot.
    pub fn new(
        robot: Arc<Robot>,
        pool: Arc<Pool>,
        policy: Arc<Policy>,
        settings: TrackingSettings,
        clips: Arc<[GoalClip]>,
        numbers: Range<u64>,
        seed: u64,
    ) -> Result<Self, SimError> {
        settings.check(&robot)?;
        check_clips(&robot, &clips)?;
        let observation = *policy.layout();
        observation
            .check(&robot)
            .map_err(|found| SimError::Setting {
                name: "policy".to_owned(),
                expected: format!("one for {}", robot.name()),
                found,
            })?;
        let setting = Arc::new(Setting::new(robot, observation, settings, clips)?);
        let count = numbers.end.saturating_sub(numbers.start) as usize;
        let mut made: Vec<Option<Environment>> = (0..count).map(|_| None).collect();
        pool.for_each(made.par_iter_mut().enumerate(), |stage, (row, slot)| {
            let index = numbers.start + row as u64;
            *slot = Some(Environment::new(&setting, stage, seed, index, row));
        });
        let mut environments = Self {
            batch: Batch::new(&setting, count),
            environments: made.into_iter().flatten().collect(),
            pool,
            policy,
            setting,
        };
        environments.observe();
        Ok(environments)
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

    /// Where each part of an observation stands.
    pub fn layout(&self) -> &ObservationLayout {
        &self.setting.kind.observation
    }

    /// The stacks `S_t`, N × [`ObservationLayout::width`]; the newest goal is the one that is asked for, those before it are the
    /// executed ones.
    pub fn observations(&self) -> &[f32] {
        &self.batch.observations
    }

    /// The goals that are asked for, N × goal joints, rad.
    pub fn goals(&self) -> &[f32] {
        &self.batch.goals
    }

    /// Whether this is the first control period of an episode, N.
    pub fn starts(&self) -> &[bool] {
        &self.batch.starts
    }

    /// Runs every environment for one control period: `executed` (N × goal joints, rad) takes the place of the goals that are
    /// asked for, in the stacks and on the robot; the policy moves the legs.
    ///
    /// # Errors
    /// If there is not one row of goals an environment, or the policy fails; then nothing has changed.
    pub fn step(&mut self, executed: &[f32]) -> Result<TrackingStep<'_>, SimError> {
        let layout = self.setting.kind.observation;
        let joints = layout.goal().len();
        if executed.len() != joints * self.len() {
            return Err(SimError::Setting {
                name: "executed goals".to_owned(),
                expected: format!("{} × {joints} angles", self.len()),
                found: executed.len().to_string(),
            });
        }
        let stacks = self.batch.observations.chunks_exact_mut(layout.width());
        for (stack, goal) in stacks.zip(executed.chunks_exact(joints)) {
            stack[layout.newest_goal()].copy_from_slice(goal);
        }
        if let Err(error) = self.act() {
            self.observe();
            return Err(error);
        }
        self.simulate(executed);
        let batch = &mut self.batch;
        batch.episodes.clear();
        batch.episodes.extend(batch.ended.iter().flatten());
        batch.set_goals(&layout);
        Ok(TrackingStep {
            actions: &batch.actions,
            next: &batch.next,
            com: &batch.com,
            contact: &batch.contact,
            ends: &batch.ends,
            episodes: &batch.episodes,
        })
    }

    /// Lets the policy answer the stacks.
    fn act(&mut self) -> Result<(), SimError> {
        let (policy, batch) = (&self.policy, &mut self.batch);
        let groups = batch
            .observations
            .par_chunks(GROUP * self.setting.kind.observation.width());
        let mut answers: Vec<_> = (0..groups.len()).map(|_| Ok(Vec::new())).collect();
        let work = answers.par_iter_mut().zip(groups);
        self.pool.for_each(work, |_, (answer, stacks)| {
            *answer = policy.actions(stacks);
        });
        batch.actions.clear();
        for answer in answers {
            batch.actions.extend(answer?);
        }
        Ok(())
    }

    /// Executes goals and actions.
    fn simulate(&mut self, executed: &[f32]) {
        let (setting, batch) = (&self.setting, &mut self.batch);
        let layout = &setting.kind.observation;
        let commands = executed
            .par_chunks_exact(layout.goal().len())
            .zip(batch.actions.par_chunks_exact(layout.last_action().len()));
        let rows = (
            self.environments.par_iter_mut(),
            commands,
            batch.observations.par_chunks_exact_mut(layout.width()),
            batch.starts.par_iter_mut(),
            batch.next.par_chunks_exact_mut(next_width(layout)),
            batch.com.par_chunks_exact_mut(2),
            batch.contact.par_iter_mut(),
            batch.ends.par_iter_mut(),
            batch.ended.par_iter_mut(),
        );
        self.pool.for_each(rows.into_par_iter(), |stage, row| {
            let (
                environment,
                (executed, action),
                observation,
                start,
                next,
                com,
                contact,
                end,
                ended,
            ) = row;
            let mut slots = Slots {
                observation,
                start,
                next,
                com,
                contact,
                end,
                ended,
            };
            environment.step(setting, stage, [executed, action], &mut slots);
        });
    }

    /// The environments as they are now, row by row.
    pub fn states(&self) -> Vec<TrackingState> {
        let environments = self.environments.iter().cloned();
        environments.map(TrackingState).collect()
    }

    /// Environments that go on from `states` of these ones, one a row: with the same executed goals what follows is the same
    /// (but for the policy's last bits, which depend on the batch).
    pub fn fork<'a>(&self, states: impl Iterator<Item = &'a TrackingState>) -> Self {
        let environments: Vec<_> = states
            .enumerate()
            .map(|(row, state)| state.0.clone().in_row(row))
            .collect();
        let mut fork = Self {
            pool: Arc::clone(&self.pool),
            policy: Arc::clone(&self.policy),
            batch: Batch::new(&self.setting, environments.len()),
            setting: Arc::clone(&self.setting),
            environments,
        };
        fork.observe();
        fork
    }

    /// Everything that the environments' future depends on, but for the executed goals, the clips, the policy and the settings.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        postcard::to_stdvec(&self.environments).map_err(|e| SimError::Snapshot(e.to_string()))
    }

    /// Goes on from a snapshot of environments of the same robot, number, clips and settings, bit for bit.
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
        let clips = self.setting.clips.len();
        let mut pairs = environments.iter().zip(&self.environments);
        if !pairs.all(|(restored, present)| restored.is_like(present, clips)) {
            return Err(SimError::Snapshot(
                "it is of another robot or other clips".to_owned(),
            ));
        }
        self.environments = environments;
        self.observe();
        Ok(())
    }

    /// Writes what the learner sees now.
    fn observe(&mut self) {
        let (setting, batch) = (&self.setting, &mut self.batch);
        let layout = &setting.kind.observation;
        let stacks = batch.observations.chunks_exact_mut(layout.width());
        let rows = stacks.zip(&mut batch.starts);
        for (environment, (observation, start)) in self.environments.iter().zip(rows) {
            environment.write(observation, start);
        }
        batch.set_goals(layout);
    }
}

impl Batch {
    fn new(setting: &Setting, count: usize) -> Self {
        let layout = &setting.kind.observation;
        let rows = |width: usize| vec![0.0; count * width];
        Self {
            observations: rows(layout.width()),
            goals: rows(layout.goal().len()),
            starts: vec![true; count],
            actions: rows(layout.last_action().len()),
            next: rows(next_width(layout)),
            com: rows(2),
            contact: rows(1),
            ends: vec![End::None; count],
            ended: vec![None; count],
            episodes: Vec::new(),
        }
    }

    /// Takes the goals that are asked for from the stacks.
    fn set_goals(&mut self, layout: &ObservationLayout) {
        let stacks = self.observations.chunks_exact(layout.width());
        let goals = self.goals.chunks_exact_mut(layout.goal().len());
        for (goal, stack) in goals.zip(stacks) {
            goal.copy_from_slice(&stack[layout.newest_goal()]);
        }
    }
}

/// Numbers of a frame that the simulation decides.
fn next_width(layout: &ObservationLayout) -> usize {
    layout.joint_positions().len() + layout.orientation().len()
}

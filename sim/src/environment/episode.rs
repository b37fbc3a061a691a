//! One training environment.

use std::sync::Arc;

use emp_models::observation::{HISTORY, ObservationLayout};
use emp_robot::Robot;
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::end_reason::EndReason;
use super::rewards::Outcome;
use super::subject::{EpisodeSetup, Kind, Subject};
use super::{EnvironmentConfig, REWARD_TERMS, Randomization};
use crate::goals::{GoalLibrary, GoalStream};
use crate::pushes::Pushes;
use crate::{BodyParameters, Reading, Stage};

/// What all environments share.
#[derive(Debug)]
pub(super) struct Setting {
    pub(super) kind: Kind,
    pub(super) config: EnvironmentConfig,
    pub(super) library: Arc<GoalLibrary>,
    /// The randomisation at its present scale.
    pub(super) randomization: Randomization,
    /// Largest amplitude of goals.
    pub(super) difficulty: f32,
}

impl Setting {
    pub(super) fn new(
        robot: Arc<Robot>,
        config: EnvironmentConfig,
        library: Arc<GoalLibrary>,
    ) -> Self {
        let observation =
            ObservationLayout::new(&robot, HISTORY).with_heading_periods(config.heading_periods);
        Self {
            kind: Kind::new(robot, observation),
            randomization: config.randomization,
            difficulty: 1.0,
            config,
            library,
        }
    }

    /// Why an episode with this reading ends, if it does.
    pub(super) fn fall(&self, reading: &Reading) -> Option<EndReason> {
        self.config.fall(reading, self.kind.standing_height)
    }
}

/// Where one environment's share of the batch goes.
#[derive(Debug)]
pub(super) struct Slots<'a> {
    pub(super) observation: &'a mut [f32],
    pub(super) privileged: &'a mut [f32],
    pub(super) final_privileged: &'a mut [f32],
    pub(super) reward: &'a mut f32,
    pub(super) terms: &'a mut [f64],
    pub(super) end: &'a mut Option<EndReason>,
    pub(super) length: &'a mut u32,
    pub(super) clip: &'a mut u32,
}

/// One robot in the middle of an episode.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Environment {
    /// Gives each episode its seed.
    seeds: ChaCha8Rng,
    /// The episode's own.
    rng: ChaCha8Rng,
    subject: Subject,
    goals: GoalStream,
    /// Control periods until the episode times out.
    left: usize,
    /// Control periods since it began.
    age: u32,
}

impl Environment {
    /// Environment number `index`, at the start of its first episode, whose clock stands anywhere so that not all time out
    /// at once.
    pub(super) fn new(setting: &Setting, stage: &mut Stage, seed: u64, index: u64) -> Self {
        let mut seeds = ChaCha8Rng::seed_from_u64(seed);
        seeds.set_stream(index);
        let mut rng = ChaCha8Rng::seed_from_u64(seeds.next_u64());
        let goals = setting.library.stream(rng.next_u64(), setting.difficulty);
        let left = rng.random_range(1..=setting.config.episode_frames);
        let mut environment = Self {
            subject: Subject::new(&setting.kind, stage),
            seeds,
            rng,
            goals,
            left,
            age: 0,
        };
        environment.reset(setting, stage);
        environment.left = left;
        environment
    }

    /// Starts a new episode.
    fn reset(&mut self, setting: &Setting, stage: &mut Stage) {
        self.rng = ChaCha8Rng::seed_from_u64(self.seeds.next_u64());
        let ranges = &setting.randomization;
        let parameters = BodyParameters {
            physics: setting.config.physics,
            ..setting.kind.draw(ranges, &mut self.rng)
        };
        self.goals = setting
            .library
            .stream(self.rng.next_u64(), setting.difficulty);
        self.next_goal(setting);
        let pushed: f64 = self.rng.random();
        let setup = EpisodeSetup {
            parameters,
            ranges,
            pushes: ranges
                .push
                .filter(|push| pushed < push.ratio)
                .map(Pushes::Random),
        };
        self.subject
            .place(&setting.kind, stage, setup, &mut self.rng);
        self.left = setting.config.episode_frames;
        self.age = 0;
        self.subject.observe();
    }

    fn next_goal(&mut self, setting: &Setting) {
        let (library, goals) = (&setting.library, &mut self.goals);
        goals.next(library, &mut self.subject.goal);
        self.subject
            .look_ahead(|ahead, goal| goals.peek(library, ahead, goal));
    }

    /// One control period with `action` (policy units). An episode that ends is followed by the next one's start.
    pub(super) fn step(
        &mut self,
        setting: &Setting,
        stage: &mut Stage,
        action: &[f32],
        slots: &mut Slots<'_>,
    ) {
        self.subject
            .execute(&setting.kind, stage, action, &mut self.rng);
        self.age += 1;
        self.left = self.left.saturating_sub(1);
        let time_out = (self.left == 0).then_some(EndReason::TimedOut);
        let end = setting.fall(self.subject.body.reading()).or(time_out);
        let fell = matches!(end, Some(EndReason::Tilted | EndReason::Sank));
        self.judge(setting, action, fell, slots);
        *slots.end = end;
        *slots.length = self.age;
        *slots.clip = self.goals.clip() as u32;
        if !matches!(end, Some(EndReason::Diverged(_))) {
            self.subject.remember(action);
            self.next_goal(setting);
            self.subject.observe();
        }
        if end.is_some() {
            self.subject
                .write_privileged(&setting.kind, slots.final_privileged);
            self.reset(setting, stage);
        }
        self.write(setting, slots.observation, slots.privileged);
    }

    /// Writes what the policy and the critic see now.
    pub(super) fn write(&self, setting: &Setting, observation: &mut [f32], privileged: &mut [f32]) {
        observation.copy_from_slice(self.subject.history.stack());
        self.subject.write_privileged(&setting.kind, privileged);
    }

    /// Whether it has the shape of `other`, as every environment of one robot and setting does.
    pub(super) fn is_like(&self, other: &Self) -> bool {
        self.subject.is_like(&other.subject)
    }

    /// Writes the reward of the control period that just ended: the weighted terms' sum times its length.
    fn judge(&self, setting: &Setting, action: &[f32], fell: bool, slots: &mut Slots<'_>) {
        let (kind, reading) = (&setting.kind, self.subject.body.reading());
        let [last, before] = &self.subject.actions;
        let mut terms = [0.0; REWARD_TERMS];
        if reading.divergence.is_none() {
            terms = setting.config.rewards.terms(&Outcome {
                reading,
                standing_height: kind.standing_height,
                leg_default: &kind.leg_default,
                action_scale: kind.robot.action_scale(),
                actions: [action, last, before],
                fell,
            });
        }
        *slots.reward = (terms.iter().sum::<f64>() / kind.robot.control_rate_hz()) as f32;
        slots.terms.copy_from_slice(&terms);
    }
}

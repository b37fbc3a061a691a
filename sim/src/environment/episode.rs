//! One training environment.

use std::fmt;
use std::sync::Arc;

use emp_models::observation::{HISTORY, History, ObservationLayout, RobotState};
use emp_robot::Robot;
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::privileged::{AHEAD, PrivilegedState};
use super::randomization::{leg_targets, within};
use super::rewards::Outcome;
use super::{EnvironmentConfig, PrivilegedLayout, REWARD_TERMS, Randomization};
use crate::goals::{GoalLibrary, GoalStream};
use crate::{Body, Divergence, Reading, Stage, Start, Targets};

/// Acceleration of gravity that turns the robot's mass into its weight, m/s².
const GRAVITY: f64 = 9.81;

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum EndReason {
    /// The base tilted too far.
    Tilted,
    /// The base came too low.
    Sank,
    /// The episode reached its full length.
    TimedOut,
    /// The simulation diverged.
    Diverged(Divergence),
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tilted => f.write_str("the base tilted too far"),
            Self::Sank => f.write_str("the base came too low"),
            Self::TimedOut => f.write_str("the episode reached its full length"),
            Self::Diverged(divergence) => write!(f, "the simulation diverged: {divergence}"),
        }
    }
}

/// What all environments share.
#[derive(Debug)]
pub(super) struct Setting {
    pub(super) robot: Arc<Robot>,
    pub(super) config: EnvironmentConfig,
    pub(super) library: Arc<GoalLibrary>,
    pub(super) observation: ObservationLayout,
    pub(super) privileged: PrivilegedLayout,
    /// The randomisation at its present scale.
    pub(super) randomization: Randomization,
    /// Largest amplitude of goals.
    pub(super) difficulty: f32,
    /// Leg angles of the default pose, rad.
    leg_default: Vec<f32>,
    /// Bodies of the model.
    bodies: usize,
    mass: f64,
    standing_height: f64,
    /// Control periods between pushes.
    push_interval: Option<usize>,
}

impl Setting {
    pub(super) fn new(
        robot: Arc<Robot>,
        config: EnvironmentConfig,
        library: Arc<GoalLibrary>,
        bodies: usize,
    ) -> Self {
        let observation = ObservationLayout::new(&robot, HISTORY);
        let rate = robot.control_rate_hz();
        let push = config.randomization.push;
        Self {
            privileged: PrivilegedLayout::new(&observation),
            observation,
            randomization: config.randomization,
            difficulty: 1.0,
            leg_default: robot
                .leg_joints()
                .iter()
                .map(|joint| joint.default as f32)
                .collect(),
            bodies,
            mass: robot.mass(),
            standing_height: robot.standing_height(),
            push_interval: push.map(|push| (push.interval * rate).round() as usize),
            robot,
            config,
            library,
        }
    }

    /// Why an episode with this reading ends, if it does.
    pub(super) fn fall(&self, reading: &Reading) -> Option<EndReason> {
        self.config.fall(reading, self.standing_height)
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
}

/// One robot in the middle of an episode.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Environment {
    /// Gives each episode its seed.
    seeds: ChaCha8Rng,
    /// The episode's own.
    rng: ChaCha8Rng,
    body: Body,
    history: History,
    goals: GoalStream,
    /// The present goal `g_t`.
    goal: Vec<f32>,
    /// Goals ahead of it.
    ahead: [Vec<f32>; 2],
    /// The last two actions, newest first, policy units.
    actions: [Vec<f32>; 2],
    /// Leg targets, rad.
    legs: Vec<f32>,
    /// Control periods until the episode times out.
    left: usize,
    /// Control periods since it began.
    age: u32,
    /// Control periods until the next push.
    until_push: usize,
    /// What the critic is told of the parameters.
    parameters: Vec<f32>,
}

impl Environment {
    /// Environment number `index`, at the start of its first episode, whose clock stands anywhere so that not all time out
    /// at once.
    pub(super) fn new(setting: &Setting, stage: &mut Stage, seed: u64, index: u64) -> Self {
        let mut seeds = ChaCha8Rng::seed_from_u64(seed);
        seeds.set_stream(index);
        let mut rng = ChaCha8Rng::seed_from_u64(seeds.next_u64());
        let goals = setting.library.stream(rng.next_u64(), setting.difficulty);
        let legs = setting.leg_default.len();
        let joints = setting.library.joints();
        let frames = setting.config.episode_frames;
        let parameters = setting.privileged.parameters().len();
        let mut environment = Self {
            left: rng.random_range(1..=frames),
            body: stage.place(&Start {
                joint_positions: &vec![0.0; joints + legs],
                lift: 0.0,
                parameters: Default::default(),
            }),
            seeds,
            rng,
            history: History::new(setting.observation),
            goals,
            goal: vec![0.0; joints],
            ahead: [vec![0.0; joints], vec![0.0; joints]],
            actions: [vec![0.0; legs], vec![0.0; legs]],
            legs: vec![0.0; legs],
            age: 0,
            until_push: 0,
            parameters: vec![0.0; parameters],
        };
        let left = environment.left;
        environment.reset(setting, stage);
        environment.left = left;
        environment
    }

    /// Starts a new episode.
    fn reset(&mut self, setting: &Setting, stage: &mut Stage) {
        self.rng = ChaCha8Rng::seed_from_u64(self.seeds.next_u64());
        let (rng, ranges, robot) = (&mut self.rng, &setting.randomization, &setting.robot);
        let parameters = ranges.draw(robot, setting.bodies, rng);
        self.goals = setting.library.stream(rng.next_u64(), setting.difficulty);
        self.goals.next(&setting.library, &mut self.goal);
        let start = self.goal.iter().chain(&setting.leg_default);
        let joints: Vec<f64> = robot
            .joints()
            .zip(start)
            .map(|(joint, &angle)| {
                let angle = f64::from(angle) + within(ranges.initial_joints, 0.0, rng);
                angle.clamp(joint.range[0], joint.range[1])
            })
            .collect();
        let hanging: f64 = rng.random();
        let hang = ranges.hang.filter(|hang| hanging < hang.ratio);
        self.until_push = rng.random_range(0..setting.push_interval.unwrap_or(1));
        self.body = stage.place(&Start {
            joint_positions: &joints,
            lift: hang.map_or(0.0, |hang| hang.height),
            parameters,
        });
        let added = stage.mass() - setting.mass;
        setting.privileged.write_parameters(
            robot,
            self.body.parameters(),
            added,
            &mut self.parameters,
        );
        for action in &mut self.actions {
            action.fill(0.0);
        }
        self.history.reset();
        self.left = setting.config.episode_frames;
        self.age = 0;
        self.observe(setting);
    }

    /// One control period with `action` (policy units). An episode that ends is followed by the next one's start.
    pub(super) fn step(
        &mut self,
        setting: &Setting,
        stage: &mut Stage,
        action: &[f32],
        slots: &mut Slots<'_>,
    ) {
        self.push(setting);
        self.set_targets(setting, action);
        let targets = Targets {
            goal: &self.goal,
            legs: &self.legs,
        };
        stage.step(&mut self.body, &targets);
        self.age += 1;
        self.left = self.left.saturating_sub(1);
        let time_out = (self.left == 0).then_some(EndReason::TimedOut);
        let end = setting.fall(self.body.reading()).or(time_out);
        self.judge(setting, action, slots);
        *slots.end = end;
        *slots.length = self.age;

        if !matches!(end, Some(EndReason::Diverged(_))) {
            self.history.set_last_action(action);
            self.actions.swap(0, 1);
            self.actions[0].copy_from_slice(action);
            self.goals.next(&setting.library, &mut self.goal);
            self.observe(setting);
        }
        if end.is_some() {
            self.write_privileged(setting, slots.final_privileged);
            self.reset(setting, stage);
        }
        self.write(setting, slots.observation, slots.privileged);
    }

    /// Writes what the policy and the critic see now.
    pub(super) fn write(&self, setting: &Setting, observation: &mut [f32], privileged: &mut [f32]) {
        observation.copy_from_slice(self.history.stack());
        self.write_privileged(setting, privileged);
    }

    /// Whether it has the shape of `other`, as every environment of one robot and setting does.
    pub(super) fn is_like(&self, other: &Self) -> bool {
        let shape = |environment: &Self| {
            (
                environment.history.stack().len(),
                environment.goal.len(),
                environment.parameters.len(),
                environment.body.reading().joint_positions.len(),
            )
        };
        shape(self) == shape(other)
    }

    fn push(&mut self, setting: &Setting) {
        let (Some(push), Some(interval)) = (setting.randomization.push, setting.push_interval)
        else {
            return;
        };
        if self.until_push > 0 {
            self.until_push -= 1;
            return;
        }
        self.until_push = interval.saturating_sub(1);
        let [linear, angular] = push.draw(&mut self.rng);
        self.body.push(linear, angular);
    }

    fn set_targets(&mut self, setting: &Setting, action: &[f32]) {
        let noise = setting.randomization.action;
        leg_targets(&setting.robot, action, noise, &mut self.rng, &mut self.legs);
    }

    /// Writes the reward of the control period that just ended: the weighted terms' sum times its length.
    fn judge(&self, setting: &Setting, action: &[f32], slots: &mut Slots<'_>) {
        let mut terms = [0.0; REWARD_TERMS];
        if self.body.reading().divergence.is_none() {
            terms = setting.config.rewards.terms(&Outcome {
                reading: self.body.reading(),
                standing_height: setting.standing_height,
                leg_default: &setting.leg_default,
                action_scale: setting.robot.action_scale(),
                actions: [action, &self.actions[0], &self.actions[1]],
            });
        }
        *slots.reward = (terms.iter().sum::<f64>() / setting.robot.control_rate_hz()) as f32;
        slots.terms.copy_from_slice(&terms);
    }

    /// Adds the present frame to the history.
    fn observe(&mut self, setting: &Setting) {
        for (ahead, goal) in AHEAD.into_iter().zip(&mut self.ahead) {
            self.goals.peek(&setting.library, ahead, goal);
        }
        let reading = self.body.reading();
        let state = RobotState {
            joint_positions: &reading.joint_positions,
            orientation: reading.orientation,
        };
        self.history.push(&state, &self.goal);
    }

    fn write_privileged(&self, setting: &Setting, out: &mut [f32]) {
        let state = PrivilegedState {
            reading: self.body.reading(),
            frame: self.history.newest(),
            action_before: &self.actions[1],
            goal: &self.goal,
            goals_ahead: [&self.ahead[0], &self.ahead[1]],
            parameters: &self.parameters,
            standing_height: setting.standing_height,
            weight: setting.mass * GRAVITY,
        };
        setting.privileged.write(&state, out);
    }
}

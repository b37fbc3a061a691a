//! The robot of an episode: its body, its past and its goals, wherever goals and actions come from and whoever judges it.

use std::sync::Arc;

use emp_models::observation::{History, ObservationLayout, RobotState};
use emp_robot::Robot;
use rand::{Rng, RngExt as _};
use serde::{Deserialize, Serialize};

use super::privileged::{AHEAD, PrivilegedState};
use super::randomization::leg_targets;
use super::{PrivilegedLayout, Randomization};
use crate::pushes::{PushClock, Pushes};
use crate::ranges::within;
use crate::sensors::Sensors;
use crate::{Body, BodyParameters, Stage, Start, Targets};

/// Acceleration of gravity that turns the robot's mass into its weight, m/s².
const GRAVITY: f64 = 9.81;

/// What all subjects of one kind share.
#[derive(Debug)]
pub(crate) struct Kind {
    pub(crate) robot: Arc<Robot>,
    pub(crate) observation: ObservationLayout,
    pub(crate) privileged: PrivilegedLayout,
    /// Leg angles of the default pose, rad.
    pub(crate) leg_default: Vec<f32>,
    pub(crate) standing_height: f64,
    /// Bodies of the model.
    bodies: usize,
    mass: f64,
}

impl Kind {
    /// Robots whose observations have this layout.
    pub(crate) fn new(robot: Arc<Robot>, observation: ObservationLayout) -> Self {
        Self {
            privileged: PrivilegedLayout::new(&observation),
            observation,
            leg_default: robot
                .leg_joints()
                .iter()
                .map(|joint| joint.default as f32)
                .collect(),
            standing_height: robot.standing_height(),
            bodies: robot.model().body_mass().len(),
            mass: robot.mass(),
            robot,
        }
    }

    /// Draws the parameters of one episode's body.
    pub(crate) fn draw(&self, ranges: &Randomization, rng: &mut impl Rng) -> BodyParameters {
        ranges.draw(&self.robot, self.bodies, rng)
    }

    /// A robot at rest, and its pushes to come: legs in their default pose, upper body at `goal` (rad), both as far off as the
    /// ranges say, feet on the floor or above it.
    pub(crate) fn begin(
        &self,
        stage: &mut Stage,
        goal: &[f32],
        setup: EpisodeSetup<'_>,
        rng: &mut impl Rng,
    ) -> (Body, PushClock) {
        let ranges = setup.ranges;
        let start = goal.iter().chain(&self.leg_default);
        let joints: Vec<f64> = self
            .robot
            .joints()
            .zip(start)
            .map(|(joint, &angle)| {
                let angle = f64::from(angle) + within(ranges.initial_joints, 0.0, rng);
                angle.clamp(joint.range[0], joint.range[1])
            })
            .collect();
        let hanging: f64 = rng.random();
        let hang = ranges.hang.filter(|hang| hanging < hang.ratio);
        let pushes = PushClock::new(setup.pushes, &self.robot, rng);
        let body = stage.place(&Start {
            joint_positions: &joints,
            lift: hang.map_or(0.0, |hang| hang.height),
            parameters: setup.parameters,
        });
        (body, pushes)
    }
}

/// What an episode begins with.
#[derive(Debug)]
pub(crate) struct EpisodeSetup<'a> {
    /// What was drawn for its body.
    pub(crate) parameters: BodyParameters,
    /// What its start and its action noise are drawn from.
    pub(crate) ranges: &'a Randomization,
    pub(crate) pushes: Option<Pushes>,
}

/// One robot in an episode.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Subject {
    pub(crate) body: Body,
    pub(crate) history: History,
    /// The present goal `g_t`.
    pub(crate) goal: Vec<f32>,
    /// The goals [`AHEAD`] of it.
    ahead: [Vec<f32>; 2],
    /// The last two actions, newest first, policy units.
    pub(crate) actions: [Vec<f32>; 2],
    /// Leg targets, rad.
    legs: Vec<f32>,
    pushes: PushClock,
    /// Factor on each action, drawn anew in every control period.
    action_noise: Option<[f64; 2]>,
    /// What it sees itself with; none: the truth.
    sensors: Option<Sensors>,
    /// What the critic is told of the parameters.
    parameters: Vec<f32>,
}

impl Subject {
    /// A robot that waits for its first episode.
    pub(crate) fn new(kind: &Kind, stage: &mut Stage) -> Self {
        let goal = vec![0.0; kind.observation.goal().len()];
        let action = vec![0.0; kind.observation.last_action().len()];
        Self {
            body: stage.place(&Start {
                joint_positions: &vec![0.0; kind.observation.joint_positions().len()],
                lift: 0.0,
                parameters: BodyParameters::default(),
            }),
            history: History::new(kind.observation),
            ahead: [goal.clone(), goal.clone()],
            goal,
            legs: action.clone(),
            actions: [action.clone(), action],
            pushes: PushClock::default(),
            action_noise: None,
            sensors: None,
            parameters: vec![0.0; kind.privileged.parameters().len()],
        }
    }

    /// Starts an episode with the upper body at the present goal, as [`Kind::begin`] says.
    pub(crate) fn place(
        &mut self,
        kind: &Kind,
        stage: &mut Stage,
        setup: EpisodeSetup<'_>,
        rng: &mut impl Rng,
    ) {
        let ranges = setup.ranges;
        self.action_noise = ranges.action;
        self.sensors = ranges.sensors.map(|noise| {
            let period = 1.0 / kind.robot.control_rate_hz();
            let joints = kind.observation.joint_positions().len();
            Sensors::new(noise, joints, period, rng.random())
        });
        (self.body, self.pushes) = kind.begin(stage, &self.goal, setup, rng);
        kind.privileged.write_parameters(
            &kind.robot,
            self.body.parameters(),
            stage.mass() - kind.mass,
            &mut self.parameters,
        );
        for action in &mut self.actions {
            action.fill(0.0);
        }
        self.history.reset();
    }

    /// One control period with the present goal for the upper body and `action` (policy units) for the legs.
    pub(crate) fn execute(
        &mut self,
        kind: &Kind,
        stage: &mut Stage,
        action: &[f32],
        rng: &mut impl Rng,
    ) {
        self.pushes.tick(&kind.robot, &mut self.body, rng);
        leg_targets(&kind.robot, action, self.action_noise, rng, &mut self.legs);
        let targets = Targets {
            goal: &self.goal,
            legs: &self.legs,
        };
        stage.step(&mut self.body, &targets);
    }

    /// Remembers the action that was executed.
    pub(crate) fn remember(&mut self, action: &[f32]) {
        self.history.set_last_action(action);
        self.actions.swap(0, 1);
        self.actions[0].copy_from_slice(action);
    }

    /// Lets `goal_at` write the goals [`AHEAD`], by how many control periods they are ahead.
    pub(crate) fn look_ahead(&mut self, mut goal_at: impl FnMut(usize, &mut [f32])) {
        for (ahead, goal) in AHEAD.into_iter().zip(&mut self.ahead) {
            goal_at(ahead, goal);
        }
    }

    /// Adds the present frame to the history.
    pub(crate) fn observe(&mut self) {
        let reading = self.body.reading();
        match &mut self.sensors {
            Some(sensors) => {
                let (joint_positions, orientation) = sensors.measure(reading);
                let state = RobotState {
                    joint_positions: &joint_positions,
                    orientation,
                };
                self.history.push(&state, &self.goal);
            }
            None => {
                let state = RobotState {
                    joint_positions: &reading.joint_positions,
                    orientation: reading.orientation,
                };
                self.history.push(&state, &self.goal);
            }
        }
    }

    /// Writes what the critic sees now.
    pub(crate) fn write_privileged(&self, kind: &Kind, out: &mut [f32]) {
        let state = PrivilegedState {
            reading: self.body.reading(),
            frame: self.history.newest(),
            action_before: &self.actions[1],
            goal: &self.goal,
            goals_ahead: [&self.ahead[0], &self.ahead[1]],
            parameters: &self.parameters,
            standing_height: kind.standing_height,
            weight: kind.mass * GRAVITY,
        };
        kind.privileged.write(&state, out);
    }

    /// Whether it has the shape of `other`, as every subject of one kind does.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        let shape = |subject: &Self| {
            (
                subject.history.stack().len(),
                subject.goal.len(),
                subject.parameters.len(),
                subject.body.reading().joint_positions.len(),
            )
        };
        shape(self) == shape(other)
    }
}

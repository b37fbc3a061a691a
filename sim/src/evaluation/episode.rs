//! One robot on one clip.

use std::sync::Arc;

use emp_models::controller::{ControllerInput, ControllerOutput, ControllerState};
use emp_models::observation::RobotState;
use emp_robot::Robot;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::observer::ExecutedFrame;
use crate::environment::{EndReason, EnvironmentConfig, Randomization, leg_targets};
use crate::goals::{GoalClip, Source};
use crate::metrics::{EpisodeSums, Frame};
use crate::pushes::{PushClock, Pushes};
use crate::ranges::within;
use crate::{Body, Stage, Start, Targets};

/// What all episodes of an evaluation share.
pub(super) struct Setting {
    pub(super) robot: Arc<Robot>,
    pub(super) seed: u64,
    pub(super) randomization: Randomization,
    pub(super) pushes: Option<Pushes>,
    /// When a robot has fallen: as in training.
    pub(super) limits: EnvironmentConfig,
    /// The default pose of the goal joints, rad.
    pub(super) default: Vec<f32>,
    /// Bodies of the model.
    pub(super) bodies: usize,
}

/// How one episode went.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Its number.
    pub episode: usize,
    /// Name of its clip.
    pub clip: String,
    /// Where the clip's motion comes from.
    pub source: Source,
    /// Control periods that were executed, the last one included: that of the fall, or the clip's last.
    pub frames: usize,
    /// Why the robot failed; none if it stood to the end.
    pub failure: Option<EndReason>,
    /// What the frames add up to; a period in which the simulation diverged cannot be measured and is left out.
    pub sums: EpisodeSums,
}

/// An episode that is being run.
pub(super) struct Episode<'a> {
    number: usize,
    clip: &'a GoalClip,
    rng: ChaCha8Rng,
    body: Body,
    state: ControllerState,
    pushes: PushClock,
    legs: Vec<f32>,
    /// Control periods that were executed.
    executed: usize,
    /// Set when it is over: whether and how it failed.
    outcome: Option<Option<EndReason>>,
    sums: EpisodeSums,
}

impl<'a> Episode<'a> {
    /// The robot at rest: legs in their default pose, feet on the floor, upper body at the clip's first goal (under full
    /// randomisation as in training: every joint a little off, now and then above the floor).
    pub(super) fn new(
        setting: &Setting,
        number: usize,
        clip: &'a GoalClip,
        state: ControllerState,
        stage: &mut Stage,
    ) -> Self {
        let robot = &setting.robot;
        let mut rng = ChaCha8Rng::seed_from_u64(setting.seed);
        rng.set_stream(number as u64);
        let ranges = &setting.randomization;
        let parameters = ranges.draw(robot, setting.bodies, &mut rng);
        let legs = robot.leg_joints().iter().map(|joint| joint.default);
        let goal = clip.frame(0).iter().map(|&angle| f64::from(angle));
        let start: Vec<f64> = goal
            .chain(legs)
            .zip(robot.joints())
            .map(|(angle, joint)| {
                let angle = angle + within(ranges.initial_joints, 0.0, &mut rng);
                angle.clamp(joint.range[0], joint.range[1])
            })
            .collect();
        let hanging: f64 = rng.random();
        let hang = ranges.hang.filter(|hang| hanging < hang.ratio);
        let pushes = PushClock::new(setting.pushes, robot, &mut rng);
        Self {
            number,
            clip,
            body: stage.place(&Start {
                joint_positions: &start,
                lift: hang.map_or(0.0, |hang| hang.height),
                parameters,
            }),
            pushes,
            rng,
            state,
            legs: vec![0.0; robot.leg_joints().len()],
            executed: 0,
            outcome: None,
            sums: EpisodeSums::default(),
        }
    }

    pub(super) fn is_over(&self) -> bool {
        self.outcome.is_some()
    }

    /// What the controller needs; of an episode that is over, what it saw last.
    pub(super) fn input(&mut self) -> (&mut ControllerState, ControllerInput<'_>) {
        let reading = self.body.reading();
        let input = ControllerInput {
            state: RobotState {
                joint_positions: &reading.joint_positions,
                orientation: reading.orientation,
            },
            goal: self.asked(),
        };
        (&mut self.state, input)
    }

    /// The goal of the control period to come; of an episode that is over, the clip's last.
    pub(super) fn asked(&self) -> &'a [f32] {
        self.clip.frame(self.executed)
    }

    /// One control period with the controller's answer.
    pub(super) fn step(&mut self, setting: &Setting, stage: &mut Stage, output: &ControllerOutput) {
        self.pushes
            .tick(&setting.robot, &mut self.body, &mut self.rng);
        match setting.randomization.action {
            Some(noise) => leg_targets(
                &setting.robot,
                &output.action,
                Some(noise),
                &mut self.rng,
                &mut self.legs,
            ),
            None => self.legs.copy_from_slice(&output.leg_targets),
        }
        let asked = self.asked();
        let goals = output.goal.len();
        let speeds_before = self.body.reading().joint_velocities[..goals].to_vec();
        let targets = Targets {
            goal: &output.goal,
            legs: &self.legs,
        };
        let reading = stage.step(&mut self.body, &targets);
        let fall = setting
            .limits
            .fall(reading, setting.robot.standing_height());
        if reading.divergence.is_none() {
            self.sums.add(&Frame {
                reading,
                goal: asked,
                executed: &output.goal,
                default: &setting.default,
                speeds_before: &speeds_before,
            });
        }
        self.executed += 1;
        if fall.is_some() || self.executed == self.clip.len() {
            self.sums.sums.suc = f64::from(u8::from(fall.is_none()));
            self.outcome = Some(fall);
        }
    }

    /// The control period that was executed last, with the controller's answer.
    pub(super) fn executed<'b>(&'b self, output: &'b ControllerOutput) -> ExecutedFrame<'b> {
        let frame = self.executed - 1;
        ExecutedFrame {
            episode: self.number,
            frame,
            asked: self.clip.frame(frame),
            output,
            reading: self.body.reading(),
        }
    }

    /// How it went, once it is over.
    pub(super) fn result(&self) -> Option<EpisodeResult> {
        Some(EpisodeResult {
            episode: self.number,
            clip: self.clip.name.clone(),
            source: self.clip.source,
            frames: self.executed,
            failure: self.outcome?,
            sums: self.sums,
        })
    }
}

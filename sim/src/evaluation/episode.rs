//! One robot on one clip.

use emp_models::controller::{ControllerInput, ControllerOutput, ControllerState};
use emp_models::observation::RobotState;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::observer::ExecutedFrame;
use crate::environment::{
    EndReason, EnvironmentConfig, EpisodeSetup, Kind, Randomization, leg_targets,
};
use crate::goals::{GoalClip, Source};
use crate::metrics::{EpisodeSums, Frame, Sample};
use crate::pushes::{PushClock, Pushes};
use crate::{Body, Stage, Targets};

/// What all episodes of an evaluation share.
pub(super) struct EvaluationContext {
    pub(super) kind: Kind,
    pub(super) seed: u64,
    pub(super) randomization: Randomization,
    pub(super) pushes: Option<Pushes>,
    /// When a robot has fallen: as in training.
    pub(super) limits: EnvironmentConfig,
    /// The default pose of the goal joints, rad.
    pub(super) default: Vec<f32>,
}

/// How one episode went.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Its number.
    pub episode: usize,
    /// Name of its clip.
    pub clip: String,
    /// The recording or procedural motion that the clip is a piece of.
    pub motion: String,
    /// Where the clip's motion comes from.
    pub source: Source,
    /// Control periods that were executed, the last one included: that of the fall, or the clip's last.
    pub frames: usize,
    /// Why the robot failed; none if it stood to the end.
    pub failure: Option<EndReason>,
    /// What the frames add up to; a period in which the simulation diverged cannot be measured and is left out.
    pub sums: EpisodeSums,
}

impl EpisodeResult {
    /// The episode as a sample of its motion.
    pub fn sample(&self) -> Sample {
        Sample {
            motion: self.motion.clone(),
            sums: self.sums,
        }
    }
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
    /// The robot at rest with its upper body at `start` (rad), as [`Kind::begin`] says.
    pub(super) fn new(
        context: &EvaluationContext,
        number: usize,
        clip: &'a GoalClip,
        start: &[f32],
        state: ControllerState,
        stage: &mut Stage,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(context.seed);
        rng.set_stream(number as u64);
        let ranges = &context.randomization;
        let setup = EpisodeSetup {
            parameters: context.kind.draw(ranges, &mut rng),
            ranges,
            pushes: context.pushes,
        };
        let (body, pushes) = context.kind.begin(stage, start, setup, &mut rng);
        Self {
            number,
            clip,
            body,
            pushes,
            rng,
            state,
            legs: vec![0.0; context.kind.leg_default.len()],
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
    pub(super) fn step(
        &mut self,
        context: &EvaluationContext,
        stage: &mut Stage,
        output: &ControllerOutput,
    ) {
        self.pushes
            .tick(&context.kind.robot, &mut self.body, &mut self.rng);
        match context.randomization.action {
            Some(noise) => leg_targets(
                &context.kind.robot,
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
        let fall = context.limits.fall(reading, context.kind.standing_height);
        if reading.divergence.is_none() {
            self.sums.add(&Frame {
                reading,
                goal: asked,
                executed: &output.goal,
                default: &context.default,
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
            motion: self.clip.motion.clone(),
            source: self.clip.source,
            frames: self.executed,
            failure: self.outcome?,
            sums: self.sums,
        })
    }
}

//! The path of one control period: newest pose → retargeter → guard → EMP, guard and policy → answer.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use emp_models::{
    controller::ControllerState,
    guard::{ExecutionGuard, GoalGuard, GoalInput, GoalPhase, GuardSettings, RampCause},
    retarget::{Memory, Mode, RetargetInput, RetargetOutput, Smoother},
};
use emp_motion::KeyNodeFrame;
use emp_proto::v1::{DroppedFrame, FrameHeader, PoseReport, TeleoperatedFrame, Timing};
use nalgebra::UnitQuaternion;

use super::{
    Joined,
    falls::FallWatch,
    messages,
    sessions::{NewestPose, Retargeting},
};
use crate::{
    batcher::Batcher,
    control::{ControlInput, EmpMode, PolicyOutput},
    deadline,
    queue::{Answer, Priority},
    session::NotComputed,
    wire,
};

/// A control period as the robot sent it.
pub(super) struct RobotFrame {
    pub(super) header: Option<FrameHeader>,
    /// The person's newest pose, where it comes with the robot's state.
    pub(super) pose: Option<KeyNodeFrame>,
    pub(super) joint_positions: Vec<f32>,
    pub(super) orientation: UnitQuaternion<f64>,
    pub(super) reset: bool,
    pub(super) emp_mode: Option<EmpMode>,
    pub(super) arrived: Instant,
    pub(super) deadline: Option<Instant>,
}

/// What a session's robot remembers from one control period to the next.
pub(super) struct Path<'a> {
    joined: &'a Joined,
    /// A robot that was silent for this long starts anew.
    patience: Duration,
    /// When the robot came.
    since: Instant,
    /// When the last control period was taken up that was answered.
    last: Option<Instant>,
    person: Person,
    guard: GoalGuard,
    emp_mode: EmpMode,
    /// The past as far as it was answered, with the guard after the EMP.
    past: ControllerState,
    falls: FallWatch,
}

impl<'a> Path<'a> {
    pub(super) fn new(joined: &'a Joined, settings: &GuardSettings) -> Self {
        let robot = &joined.policy.robot;
        let state = joined.policy.model.state();
        Self {
            joined,
            patience: settings.stale_after,
            since: Instant::now(),
            last: None,
            person: Person::default(),
            guard: GoalGuard::new(robot, settings),
            emp_mode: joined.member.emp_mode(),
            falls: FallWatch::new(&joined.policy.card.robot),
            past: state.with_guard(ExecutionGuard::new(robot, settings)),
        }
    }

    /// Computes one control period, and tells the session's listeners.
    pub(super) async fn step(
        &mut self,
        mut frame: RobotFrame,
    ) -> Result<TeleoperatedFrame, DroppedFrame> {
        let now = Instant::now();
        self.begin(&mut frame, now);
        self.falls.look(&frame.orientation);
        let pose = self.take_pose(now, frame.deadline).await;
        // What follows leaves no trace if the frame is dropped.
        let mut guard = self.guard.clone();
        let goals = self.joined.policy.robot.goal_joints().len();
        let (goal, phase) = guard.step(&GoalInput {
            goal: self.person.goal(),
            age: self.person.age(now).unwrap_or(now - self.since),
            measured: &frame.joint_positions[..goals],
        });
        let input = ControlInput {
            mode: self.emp_mode,
            state: self.past.clone(),
            joint_positions: frame.joint_positions,
            orientation: frame.orientation,
            goal: goal.to_vec(),
        };
        let asked = input.goal.clone();
        let batcher = &self.joined.policy.batcher;
        let answer = compute(batcher, input, frame.deadline)
            .await
            .map_err(|why| why.notice(frame.header))?;
        let timing = wire::timing(&answer);
        let PolicyOutput { state, .. } = &answer.output;
        self.past = state.clone();
        self.guard = guard;
        self.last = Some(now);
        let mut result = self.result(answer.output, phase);
        result.header = frame.header;
        result.pose = pose;
        result.goal = asked;
        result.timing = Some(timing);
        result.total_time = Some(wire::duration(frame.arrived.elapsed()));
        self.joined.member.tell(&result);
        Ok(result)
    }

    /// Sees what the frame changes: its pose and mode, an episode that starts, a robot that was silent.
    fn begin(&mut self, frame: &mut RobotFrame, now: Instant) {
        let Joined {
            member,
            retargeting,
            ..
        } = self.joined;
        if let Some(pose) = frame.pose.take() {
            member.set_pose(
                frame.header,
                pose,
                frame.arrived,
                frame.deadline,
                retargeting,
            );
        }
        if let Some(mode) = frame.emp_mode {
            member.set_emp_mode(mode);
        }
        let mode = member.emp_mode();
        if mode != self.emp_mode {
            self.emp_mode = mode;
            if let Some(guard) = self.past.guard_mut() {
                guard.filter_changed();
            }
        }
        let was_silent = self.last.is_some_and(|last| now - last > self.patience);
        if frame.reset {
            self.past.reset();
            self.guard.restart(RampCause::FirstFrame);
        } else if was_silent {
            self.past.reset();
            self.guard.restart(RampCause::RobotResumed);
        }
    }

    /// Retargets the newest pose, if there is a new one, and moves the smoothed goal on.
    async fn take_pose(&mut self, now: Instant, deadline: Option<Instant>) -> Option<PoseReport> {
        let newest = self.joined.member.newest_pose()?;
        if self.person.meets(&newest) {
            self.guard.operator_changed();
        }
        let (timing, dropped) = if self.person.has_seen(&newest) {
            (None, None)
        } else {
            match self.person.retarget(&newest, deadline).await {
                Ok(timing) => (Some(timing), None),
                Err(why) => (None, Some(why.notice(newest.header))),
            }
        };
        let goal = self.person.smoothed(&newest.retargeting);
        Some(PoseReport {
            header: newest.header,
            age: Some(wire::duration(
                now.saturating_duration_since(newest.arrived),
            )),
            goal,
            direction_error: self.person.direction_error,
            timing,
            dropped,
        })
    }

    fn result(&self, answer: PolicyOutput, phase: GoalPhase) -> TeleoperatedFrame {
        let PolicyOutput {
            output, assessment, ..
        } = answer;
        let robot = &self.joined.policy.robot;
        let guard = messages::guard_report(robot, phase, &output);
        let filter = wire::filter_result(robot, output.goal, output.risk, assessment);
        TeleoperatedFrame {
            guard: Some(guard),
            emp_mode: messages::emp_mode(self.emp_mode).into(),
            filter: Some(filter),
            action: output.action,
            leg_targets: output.leg_targets,
            ..TeleoperatedFrame::default()
        }
    }
}

/// The person's motion as far as it became goals.
#[derive(Default)]
struct Person {
    /// Number of the operator, from 1.
    operator: u64,
    /// The pose that was seen last.
    seen: Option<Arc<NewestPose>>,
    /// The last answer of the retargeter, rad, and when its pose arrived.
    retargeted: Option<(Vec<f32>, Instant)>,
    /// What the next refined answer starts from.
    memory: Option<Box<Memory>>,
    direction_error: f32,
    smoother: Smoother,
    /// The last answer after smoothing, rad.
    goal: Vec<f32>,
}

impl Person {
    /// Whether the pose is another operator's than the last one; what was remembered of that one is forgotten then.
    fn meets(&mut self, newest: &NewestPose) -> bool {
        let is_another = self.operator != newest.operator;
        if is_another {
            self.operator = newest.operator;
            self.smoother.reset();
        }
        is_another
    }

    fn has_seen(&self, newest: &Arc<NewestPose>) -> bool {
        self.seen
            .as_ref()
            .is_some_and(|seen| Arc::ptr_eq(seen, newest))
    }

    async fn retarget(
        &mut self,
        newest: &Arc<NewestPose>,
        deadline: Option<Instant>,
    ) -> Result<Timing, NotComputed> {
        let before = self.seen.replace(Arc::clone(newest));
        let is_same_operator = before.is_some_and(|before| before.operator == newest.operator);
        let Retargeting { model, refine, .. } = &*newest.retargeting;
        let memory = self.memory.clone().filter(|_| is_same_operator);
        let before = self.retargeted.as_ref().map(|(_, arrived)| *arrived);
        let input = RetargetInput {
            frame: newest.frame.clone(),
            mode: match (memory, before) {
                _ if !*refine => Mode::Network,
                (Some(memory), Some(before)) => Mode::Follow {
                    memory,
                    seconds: between(before, newest.arrived, model.robot.control_rate_hz()),
                },
                _ => Mode::Begin,
            },
        };
        let deadline = deadline::sooner(deadline, newest.deadline);
        let answer = compute(&model.batcher, input, deadline).await?;
        let timing = wire::timing(&answer);
        let RetargetOutput {
            angles,
            direction_error,
            memory,
            ..
        } = answer.output;
        self.memory = memory;
        self.retargeted = Some((angles, newest.arrived));
        self.direction_error = direction_error;
        Ok(timing)
    }

    /// The goal of this control period; empty before the first.
    fn smoothed(&mut self, retargeting: &Retargeting) -> Vec<f32> {
        if let Some((angles, _)) = &self.retargeted {
            self.goal.clone_from(angles);
            if retargeting.smoothing {
                self.smoother.step(&mut self.goal);
            }
        }
        self.goal.clone()
    }

    fn goal(&self) -> Option<&[f32]> {
        self.retargeted.is_some().then_some(&self.goal)
    }

    /// How long ago the pose arrived that the goal follows from.
    fn age(&self, now: Instant) -> Option<Duration> {
        let (_, arrived) = self.retargeted.as_ref()?;
        Some(now.saturating_duration_since(*arrived))
    }
}

/// Time between the arrivals of two poses, seconds: at least half a control period, for the network may deliver two at
/// once, and at most a fifth of a second.
fn between(before: Instant, after: Instant, control_rate_hz: f64) -> f64 {
    const LONGEST: f64 = 0.2;
    let seconds = after.saturating_duration_since(before).as_secs_f64();
    seconds.clamp(0.5 / control_rate_hz, LONGEST)
}

/// Brings one item to its model.
async fn compute<I: Send + 'static, O: Send + 'static>(
    batcher: &Batcher<I, O>,
    input: I,
    deadline: Option<Instant>,
) -> Result<Answer<O>, NotComputed> {
    if deadline::has_passed(deadline) {
        return Err(NotComputed::late());
    }
    let ticket = batcher.submit(Priority::Stream, input, deadline)?;
    let answer = ticket.await?;
    if deadline::has_passed(deadline) {
        return Err(NotComputed::late());
    }
    Ok(answer)
}

//! One control period of a teleoperated robot: newest goal → guard → EMP, guard and policy → answer.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use emp_models::{
    controller::ControllerState,
    guard::{
        ExecutionGuard, GoalGuard, GoalInput, GuardSettings, Period, RampCause, RobotClock, Wish,
    },
    retarget::Smoother,
};
use emp_proto::v1::{DroppedFrame, FrameHeader, GuardReport, PoseReport, TeleoperatedFrame};

use super::{
    joined::Joined,
    messages,
    sessions::{Goal, Orders},
};
use crate::{
    decode::robot_state::Measured,
    dropped::NotComputed,
    encode,
    inference::{
        controllers::{ControlInput, EmpMode, PolicyOutput},
        queue::Priority,
    },
};

/// A control period as the robot sent it.
pub(super) struct RobotFrame {
    pub(super) header: Option<FrameHeader>,
    pub(super) measured: Measured,
    /// Whether an episode starts with it.
    pub(super) resets: bool,
    pub(super) arrived: Instant,
    pub(super) deadline: Option<Instant>,
}

/// What a session's robot remembers from one control period to the next.
pub(super) struct Pipeline<'a> {
    joined: &'a Joined,
    /// Age at which poses and states are stale; a robot that was silent for as long starts anew.
    stale_after: Duration,
    /// When the robot came.
    since: Instant,
    /// When the last control period was taken up that was answered.
    last: Option<Instant>,
    clock: RobotClock,
    sensors: Sensors,
    person: Person,
    guard: GoalGuard,
    emp_mode: EmpMode,
    /// The past as far as it was answered, with the guard after the EMP.
    past: ControllerState,
}

impl<'a> Pipeline<'a> {
    pub(super) fn new(joined: &'a Joined, settings: &GuardSettings) -> Self {
        let robot = &joined.policy.robot;
        let state = joined.policy.model.state();
        Self {
            joined,
            stale_after: settings.stale_after,
            since: Instant::now(),
            last: None,
            clock: RobotClock::new(robot),
            sensors: Sensors::default(),
            person: Person::default(),
            guard: GoalGuard::new(robot, settings),
            emp_mode: joined.member.emp_mode(),
            past: state.with_guard(ExecutionGuard::new(robot, settings)),
        }
    }

    /// Computes one control period, and tells the session's listeners.
    pub(super) async fn step(
        &mut self,
        frame: RobotFrame,
    ) -> Result<TeleoperatedFrame, DroppedFrame> {
        let now = Instant::now();
        let orders = self.joined.member.orders();
        self.begin(&frame, &orders, now);
        // A simulated robot's clock alone counts.
        let simulated = self.joined.simulated;
        let arrived = frame.measured.time.filter(|_| simulated);
        let arrived = arrived.unwrap_or(frame.arrived - self.since);
        let elapsed = self.clock.tick(arrived, frame.measured.time);
        let frozen_for = self.sensors.unchanged_for(&frame.measured, frame.arrived);
        let is_frozen = !simulated && frozen_for >= self.stale_after;
        let period = Period {
            elapsed,
            speed: orders.speed,
        };
        let pose = self.person.report(&orders, now);
        // What follows leaves no trace if the frame is dropped.
        let mut guard = self.guard.clone();
        let goals = self.joined.policy.robot.goal_joints().len();
        let (goal, phase) = guard.step(&GoalInput {
            goal: self.person.goal(),
            age: self.person.age(now).unwrap_or(now - self.since),
            measured: &frame.measured.joint_positions[..goals],
            wish: if is_frozen { Wish::Hold } else { orders.wish },
            period,
        });
        let asked = goal.to_vec();
        let mut past = self.past.clone();
        if let Some(guard) = past.guard_mut() {
            guard.set_period(period);
        }
        let input = ControlInput {
            mode: self.emp_mode,
            state: past,
            joint_positions: frame.measured.joint_positions,
            orientation: frame.measured.orientation,
            goal: asked.clone(),
        };
        let batcher = &self.joined.policy.batcher;
        let computed = batcher.compute(Priority::Stream, input, frame.deadline);
        let answer = computed
            .await
            .map_err(|why| NotComputed::from(why).notice(frame.header))?;
        let timing = encode::timing(&answer);
        let PolicyOutput { state, .. } = &answer.output;
        self.past = state.clone();
        self.guard = guard;
        self.last = Some(now);
        let report = GuardReport {
            elapsed: Some(encode::duration(elapsed)),
            state_frozen: is_frozen,
            ..messages::guard_report(phase, &answer.output.output)
        };
        let mut result = self.result(answer.output, report);
        result.header = frame.header;
        result.pose = pose;
        result.goal = asked;
        result.state = orders.state.into();
        result.timing = Some(timing);
        result.total_time = Some(encode::duration(frame.arrived.elapsed()));
        self.joined.member.tell(&mut result);
        Ok(result)
    }

    /// Sees what has changed: the mode, the person, an episode that starts, a robot that was silent.
    fn begin(&mut self, frame: &RobotFrame, orders: &Orders, now: Instant) {
        if orders.emp_mode != self.emp_mode {
            self.emp_mode = orders.emp_mode;
            if let Some(guard) = self.past.guard_mut() {
                guard.filter_changed();
            }
        }
        let was_silent =
            !self.joined.simulated && self.last.is_some_and(|last| now - last > self.stale_after);
        if frame.resets {
            self.past.reset();
            self.guard.restart(RampCause::FirstFrame);
        } else if was_silent {
            self.past.reset();
            self.guard.restart(RampCause::RobotResumed);
        }
        if let Some(goal) = &orders.goal
            && self.person.takes(goal)
        {
            self.guard.operator_changed();
        }
    }

    fn result(&self, answer: PolicyOutput, guard: GuardReport) -> TeleoperatedFrame {
        let PolicyOutput {
            output, assessment, ..
        } = answer;
        let filter = encode::filter_result(output.goal, output.risk, assessment);
        TeleoperatedFrame {
            guard: Some(guard),
            emp_mode: encode::emp_mode(self.emp_mode).into(),
            filter: Some(filter),
            action: output.action,
            leg_targets: output.leg_targets,
            ..TeleoperatedFrame::default()
        }
    }
}

/// Tells sensors that stand still from a robot that does: a robot's are never the same twice, number for number.
#[derive(Default)]
struct Sensors {
    /// What they said, and when they said it first.
    last: Option<(Measured, Instant)>,
}

impl Sensors {
    /// For how long they have been saying the same.
    fn unchanged_for(&mut self, measured: &Measured, arrived: Instant) -> Duration {
        if let Some((last, first)) = &self.last
            && last.is_same_as(measured)
        {
            return arrived.saturating_duration_since(*first);
        }
        self.last = Some((measured.clone(), arrived));
        Duration::ZERO
    }
}

/// The person's motion as far as it became goals.
#[derive(Default)]
struct Person {
    newest: Option<Arc<Goal>>,
    /// The newest goal has not been reported yet.
    is_new: bool,
    smoother: Smoother,
    /// The newest goal after smoothing, rad.
    goal: Vec<f32>,
}

impl Person {
    /// Takes the newest goal; says whether it is another operator's than the last one, of whom nothing is remembered then.
    fn takes(&mut self, newest: &Arc<Goal>) -> bool {
        let before = self.newest.replace(Arc::clone(newest));
        let Some(before) = before else {
            self.is_new = true;
            return true;
        };
        self.is_new = !Arc::ptr_eq(&before, newest);
        let is_another = before.operator != newest.operator;
        if is_another {
            self.smoother.reset();
        }
        is_another
    }

    /// What is said of the newest pose in this control period; its goal moves on.
    fn report(&mut self, orders: &Orders, now: Instant) -> Option<PoseReport> {
        let dropped = orders.no_goal.clone();
        let Some(newest) = &self.newest else {
            return dropped.map(|dropped| PoseReport {
                header: dropped.header,
                dropped: Some(dropped),
                ..PoseReport::default()
            });
        };
        self.goal.clone_from(&newest.angles);
        if newest.smoothing {
            self.smoother.step(&mut self.goal);
        }
        let age = now.saturating_duration_since(newest.arrived);
        Some(PoseReport {
            header: newest.header,
            age: Some(encode::duration(age)),
            goal: self.goal.clone(),
            direction_error: newest.direction_error,
            timing: std::mem::take(&mut self.is_new).then_some(newest.timing),
            dropped,
        })
    }

    fn goal(&self) -> Option<&[f32]> {
        self.newest.is_some().then_some(&self.goal)
    }

    /// How long ago the pose arrived that the goal follows from.
    fn age(&self, now: Instant) -> Option<Duration> {
        let newest = self.newest.as_ref()?;
        Some(now.saturating_duration_since(newest.arrived))
    }
}

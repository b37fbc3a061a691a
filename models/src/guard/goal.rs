//! The guard before the goal filter.

use std::time::Duration;

use emp_robot::Robot;

use super::{GuardSettings, Limits, Period, Ramp};

/// Why the goal is being blended to the newest one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RampCause {
    /// The robot's first frame: from its measured pose.
    FirstFrame,
    /// The robot was silent for a while: from its measured pose.
    RobotResumed,
    /// A person came, or came back: from the goal that stood till then.
    OperatorReturned,
}

/// What the guard does with the goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GoalPhase {
    /// The goal is the newest one.
    Following,
    /// The goal is on its way to the newest one.
    Ramping {
        /// Why.
        cause: RampCause,
        /// Share of the time that has passed, 0 to 1.
        progress: f32,
    },
    /// There is no fresh goal; the last one stands.
    Holding,
    /// There was no fresh goal for long; the goal is on its way to the default pose.
    Returning {
        /// Share of the time that has passed, 0 to 1.
        progress: f32,
    },
    /// There is still no fresh goal; the goal is the default pose.
    Resting,
}

/// What the guard is told in a control period.
#[derive(Clone, Copy, Debug)]
pub struct GoalInput<'a> {
    /// The newest goal: angles of the goal joints, rad, inside their ranges; none before the first.
    pub goal: Option<&'a [f32]>,
    /// How old the newest goal is; without one, how long the robot has waited for it.
    pub age: Duration,
    /// The measured angles of the goal joints, rad.
    pub measured: &'a [f32],
    /// What those who are responsible for the robot want.
    pub wish: Wish,
    /// How much time has passed for the robot, and how fast it may move.
    pub period: Period,
}

/// What those who are responsible for a robot want it to do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wish {
    /// Follow the newest goal while it is fresh.
    #[default]
    Follow,
    /// Hold the goal that stands, fresh or not.
    Hold,
    /// Go to the default pose, and stay there.
    Rest,
}

/// Decides in each control period which goal is asked of the robot. One robot's; see the [module](super).
#[derive(Clone, Debug)]
pub struct GoalGuard {
    settings: GuardSettings,
    limits: Limits,
    default: Vec<f32>,
    state: State,
    /// The last goal; empty before the first control period.
    goal: Vec<f32>,
}

#[derive(Clone, Debug)]
enum State {
    /// A ramp begins with the next fresh goal.
    Due(RampCause),
    Ramping(Blend, RampCause),
    Following,
    Returning(Blend),
    Resting,
}

/// A ramp from a pose.
#[derive(Clone, Debug)]
struct Blend {
    from: Vec<f32>,
    ramp: Ramp,
}

impl Blend {
    /// Moves `goal` on toward `to`; gives the progress, or none once it is there.
    fn step(&mut self, to: &[f32], elapsed: Duration, goal: &mut [f32]) -> Option<f32> {
        self.ramp.advance(elapsed);
        if self.ramp.is_finished() {
            return None;
        }
        let (progress, weight) = (self.ramp.progress(), self.ramp.weight());
        for ((goal, from), to) in goal.iter_mut().zip(&self.from).zip(to) {
            *goal = from + weight * (to - from);
        }
        Some(progress)
    }
}

impl GoalGuard {
    /// A guard for a robot that has not sent a frame yet.
    pub fn new(robot: &Robot, settings: &GuardSettings) -> Self {
        let joints = robot.goal_joints().iter();
        Self {
            settings: *settings,
            limits: Limits::new(robot, settings),
            default: joints.map(|joint| joint.default as f32).collect(),
            state: State::Due(RampCause::FirstFrame),
            goal: Vec::new(),
        }
    }

    /// Forgets the goal: the next control period begins at the measured pose.
    pub fn restart(&mut self, cause: RampCause) {
        self.state = State::Due(cause);
        self.goal.clear();
    }

    /// The newest goal comes from another source from now on: it is blended to, from the goal that stands.
    pub fn operator_changed(&mut self) {
        if matches!(self.state, State::Ramping(..) | State::Following) {
            self.state = State::Due(RampCause::OperatorReturned);
        }
    }

    /// The goal of this control period, rad, and how it came about.
    ///
    /// No joint's goal moves faster than the joint may by what the guard itself does; a newest goal that is followed may jump, which
    /// is the [`ExecutionGuard`](super::ExecutionGuard)'s to stop.
    pub fn step(&mut self, input: &GoalInput<'_>) -> (&[f32], GoalPhase) {
        if self.goal.is_empty() {
            self.goal = self.limits.inside(input.measured);
        }
        let period = self.limits.bounded(input.period);
        let is_fresh = input.age < self.settings.stale_after;
        let phase = match (input.wish, input.goal) {
            (Wish::Rest, _) => self.go_home(period),
            (Wish::Follow, Some(newest)) if is_fresh => self.follow(newest, period),
            (Wish::Hold, _) => self.hold(period),
            _ if input.age < self.settings.return_after => self.hold(period),
            _ => self.go_home(period),
        };
        (&self.goal, phase)
    }

    fn follow(&mut self, newest: &[f32], period: Period) -> GoalPhase {
        let cause = match self.state {
            State::Due(cause) => Some(cause),
            State::Returning(_) | State::Resting => Some(RampCause::OperatorReturned),
            State::Ramping(..) | State::Following => None,
        };
        if let Some(cause) = cause {
            self.state = State::Ramping(self.blend_to(newest, period.speed), cause);
        }
        if let State::Ramping(blend, cause) = &mut self.state
            && let Some(progress) = blend.step(newest, period.elapsed, &mut self.goal)
        {
            return GoalPhase::Ramping {
                cause: *cause,
                progress,
            };
        }
        self.state = State::Following;
        self.goal.copy_from_slice(newest);
        GoalPhase::Following
    }

    fn hold(&mut self, period: Period) -> GoalPhase {
        match &mut self.state {
            // A new robot, or an operator who stays away: nothing has changed since the last control period.
            State::Due(_) => GoalPhase::Holding,
            State::Ramping(..) | State::Following => {
                self.state = State::Due(RampCause::OperatorReturned);
                GoalPhase::Holding
            }
            State::Returning(_) | State::Resting => self.go_home(period),
        }
    }

    fn go_home(&mut self, period: Period) -> GoalPhase {
        if !matches!(self.state, State::Returning(_) | State::Resting) {
            self.state = State::Returning(self.blend_to(&self.default, period.speed));
        }
        if let State::Returning(blend) = &mut self.state
            && let Some(progress) = blend.step(&self.default, period.elapsed, &mut self.goal)
        {
            return GoalPhase::Returning { progress };
        }
        self.state = State::Resting;
        self.goal.copy_from_slice(&self.default);
        GoalPhase::Resting
    }

    fn blend_to(&self, pose: &[f32], speed: f32) -> Blend {
        Blend {
            from: self.goal.clone(),
            ramp: self.limits.ramp(&self.goal, pose, speed),
        }
    }
}

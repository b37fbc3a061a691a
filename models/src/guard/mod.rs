//! Safety around a live stream of goals: what stands between a person's motion and a robot's joints when streams start, stop,
//! tear, and come back.
//!
//! Two guards, one on either side of the goal filter, so that the filter sees the goal that is about to be executed and nothing
//! comes after the last limit:
//!
//! - [`GoalGuard`] before it: ramps to the newest goal from the robot's measured pose (first frame, resume) or from the last goal
//!   (an operator who is back); holds the last goal when it is stale; returns to the default pose when it stays so.
//! - [`ExecutionGuard`] after it: fades a filter's correction in and out when the robot starts or the filter is exchanged, and
//!   bounds every joint's speed. It is a part of a [`ControllerState`](crate::controller::ControllerState), so that the
//!   history and the policy see what is executed.
//!
//! Neither has a clock: both are driven by control periods, and are told how much time has passed for the robot since the one
//! before and how old a goal is. [`RobotClock`] tells that time from a robot's frames. Ramps are minimum-jerk
//! (Flash and Hogan: The coordination of arm movements, J. Neurosci. 1985).

mod clock;
mod execution;
mod goal;
#[cfg(test)]
mod tests;

use std::time::Duration;

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

pub use clock::RobotClock;
pub use execution::{Execution, ExecutionGuard};
pub use goal::{GoalGuard, GoalInput, GoalPhase, RampCause, Wish};

/// Largest slope of [`minimum_jerk`], at its middle.
const PEAK_SLOPE: f32 = emp_motion::MINIMUM_JERK_PEAK as f32;

/// Most control periods that the guards let pass in one: a robot that was silent for longer does not catch up.
pub const LONGEST_PERIOD: u32 = 2;

/// Least share of the joints' speed limits.
const SLOWEST: f32 = 0.01;

/// Share of a joint's speed limit that a ramp may take; the rest is left to the motion that it leads to.
pub const RAMP_SPEED: f32 = 0.25;

/// How patient the guards are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GuardSettings {
    /// How long a ramp takes; longer where a joint would pass [`RAMP_SPEED`] of its speed limit.
    pub ramp: Duration,
    /// Age at which a goal is stale and the robot holds.
    pub stale_after: Duration,
    /// Age at which the robot returns to its default pose; not below `stale_after`.
    pub return_after: Duration,
}

/// How long a control period of `robot` should be.
fn control_period(robot: &Robot) -> Duration {
    Duration::from_secs_f64(1.0 / robot.control_rate_hz())
}

/// [`emp_motion::minimum_jerk`] in single precision.
fn minimum_jerk(progress: f32) -> f32 {
    emp_motion::minimum_jerk(f64::from(progress)) as f32
}

/// A blend over a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Ramp {
    /// Time that has passed; none before the first control period.
    done: Option<Duration>,
    length: Duration,
}

impl Ramp {
    /// A control period begins, `elapsed` after the one before. A ramp starts with its first.
    fn advance(&mut self, elapsed: Duration) {
        self.done = Some(self.done.map_or(Duration::ZERO, |done| done + elapsed));
    }

    /// Share of its time that has passed, 0 to 1.
    fn progress(&self) -> f32 {
        let done = self.done.unwrap_or_default().as_secs_f64();
        if self.is_finished() {
            1.0
        } else {
            (done / self.length.as_secs_f64()) as f32
        }
    }

    /// Weight of what it leads to, 0 to 1.
    fn weight(&self) -> f32 {
        minimum_jerk(self.progress())
    }

    fn is_finished(&self) -> bool {
        self.done.is_some_and(|done| done >= self.length)
    }
}

/// The time of one control period, and how much of the joints' speed it may use.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Period {
    /// Time since the control period before, for the robot. The guards take at most [`LONGEST_PERIOD`] control periods.
    pub elapsed: Duration,
    /// Share of the joints' speed limits that may be used, more than 0, at most 1. Ramps take as much longer.
    pub speed: f32,
}

/// What the guards know of the goal joints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Limits {
    /// Largest speeds, rad/s.
    speeds: Vec<f32>,
    /// Lower and upper limit, rad.
    ranges: Vec<[f32; 2]>,
    /// How long a ramp takes at least.
    ramp: Duration,
    /// A control period, as long as it should be.
    period: Duration,
}

impl Limits {
    fn new(robot: &Robot, settings: &GuardSettings) -> Self {
        let joints = robot.goal_joints();
        Self {
            speeds: joints
                .iter()
                .map(|joint| joint.velocity_limit as f32)
                .collect(),
            ranges: joints
                .iter()
                .map(|joint| joint.range.map(|limit| limit as f32))
                .collect(),
            ramp: settings.ramp,
            period: control_period(robot),
        }
    }

    /// A control period that is as long as it should be, at full speed.
    fn usual(&self) -> Period {
        Period {
            elapsed: self.period,
            speed: 1.0,
        }
    }

    /// The period with its time and speed inside their bounds.
    fn bounded(&self, period: Period) -> Period {
        Period {
            elapsed: period.elapsed.min(self.period * LONGEST_PERIOD),
            speed: if period.speed.is_finite() {
                period.speed.clamp(SLOWEST, 1.0)
            } else {
                SLOWEST
            },
        }
    }

    /// A ramp over the distance from one pose to another, rad.
    fn ramp(&self, from: &[f32], to: &[f32], speed: f32) -> Ramp {
        let joints = from.iter().zip(to).zip(&self.speeds);
        let slowest = joints
            .map(|((from, to), limit)| PEAK_SLOPE * (to - from).abs() / (RAMP_SPEED * limit))
            .fold(0.0, f32::max);
        let stretched =
            |seconds: f32| Duration::try_from_secs_f32(seconds / speed).unwrap_or(Duration::MAX);
        let length = self.ramp.div_f32(speed).max(stretched(slowest));
        // Even the shortest blend is seen to begin.
        Ramp {
            done: None,
            length: length.max(Duration::from_nanos(1)),
        }
    }

    /// The pose with every joint inside its range.
    fn inside(&self, pose: &[f32]) -> Vec<f32> {
        let joints = pose.iter().zip(&self.ranges);
        joints
            .map(|(angle, [lower, upper])| angle.clamp(*lower, *upper))
            .collect()
    }
}

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
//! Neither has a clock: both are driven by control periods, and are told how old a goal is. Ramps are minimum-jerk
//! (Flash and Hogan: The coordination of arm movements, J. Neurosci. 1985).

mod execution;
mod goal;
#[cfg(test)]
mod tests;

use std::time::Duration;

use emp_robot::{Joint, Robot};
use serde::{Deserialize, Serialize};

pub use execution::{Execution, ExecutionGuard};
pub use goal::{GoalGuard, GoalInput, GoalPhase, RampCause};

/// Largest slope of [`minimum_jerk`], at its middle.
const PEAK_SLOPE: f32 = emp_motion::MINIMUM_JERK_PEAK as f32;

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

/// [`emp_motion::minimum_jerk`] in single precision.
fn minimum_jerk(progress: f32) -> f32 {
    emp_motion::minimum_jerk(f64::from(progress)) as f32
}

/// A blend over a number of control periods.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Ramp {
    done: u32,
    periods: u32,
}

impl Ramp {
    /// Share of its time that has passed, 0 to 1.
    fn progress(&self) -> f32 {
        self.done as f32 / self.periods as f32
    }

    /// Weight of what it leads to, 0 to 1.
    fn weight(&self) -> f32 {
        minimum_jerk(self.progress())
    }

    fn is_finished(&self) -> bool {
        self.done == self.periods
    }
}

/// What the guards know of the goal joints.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Limits {
    /// Largest step in a control period, rad.
    steps: Vec<f32>,
    /// Lower and upper limit, rad.
    ranges: Vec<[f32; 2]>,
    /// Control periods that a ramp takes at least.
    ramp: u32,
}

impl Limits {
    fn new(robot: &Robot, settings: &GuardSettings) -> Self {
        let rate = robot.control_rate_hz();
        let step = |joint: &Joint| (joint.velocity_limit / rate) as f32;
        let joints = robot.goal_joints();
        Self {
            steps: joints.iter().map(step).collect(),
            ranges: joints
                .iter()
                .map(|joint| joint.range.map(|limit| limit as f32))
                .collect(),
            ramp: (settings.ramp.as_secs_f64() * rate).ceil() as u32,
        }
    }

    /// A ramp over the distance from one pose to another, rad.
    fn ramp(&self, from: &[f32], to: &[f32]) -> Ramp {
        let joints = from.iter().zip(to).zip(&self.steps);
        let slowest = joints
            .map(|((from, to), step)| PEAK_SLOPE * (to - from).abs() / (RAMP_SPEED * step))
            .fold(1.0, f32::max);
        Ramp {
            done: 0,
            periods: self.ramp.max(slowest.ceil() as u32),
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

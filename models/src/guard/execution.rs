//! The guard after the goal filter.

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use super::{GuardSettings, Limits, Period, Ramp};

/// The last stage before the joints: fades corrections and bounds speeds. One robot's; see the [module](super).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExecutionGuard {
    limits: Limits,
    /// The control period that comes next.
    period: Period,
    /// The last goal that was executed, rad; empty before the first control period.
    executed: Vec<f32>,
    /// By how much the last goal was moved from the one that was asked for, rad.
    correction: Vec<f32>,
    /// Whether a fade begins with the next control period.
    is_changed: bool,
    fade: Option<Fade>,
}

/// What is left of an older correction, while it vanishes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Fade {
    /// The older correction minus the newer one, when the fade began, rad.
    offset: Vec<f32>,
    ramp: Ramp,
}

/// What the guard did in a control period.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Execution {
    /// While one correction of the goal is exchanged for another: the share of the time that has passed, 0 to 1.
    pub fade: Option<f32>,
    /// The goal before speeds were limited, rad.
    pub wanted: Vec<f32>,
    /// Goal joints, by index, whose speed was limited.
    pub limited: Vec<usize>,
}

impl ExecutionGuard {
    /// A guard for a robot that was not told anything yet.
    pub fn new(robot: &Robot, settings: &GuardSettings) -> Self {
        let limits = Limits::new(robot, settings);
        Self {
            period: limits.usual(),
            limits,
            executed: Vec::new(),
            correction: Vec::new(),
            is_changed: false,
            fade: None,
        }
    }

    /// Says how much time passes with the next control period, and how fast the robot may move in it. Without it the last one holds;
    /// at first, a control period as long as it should be, at full speed.
    pub fn set_period(&mut self, period: Period) {
        self.period = self.limits.bounded(period);
    }

    /// Forgets what was executed: the next control period begins at the measured pose, without a correction.
    pub fn restart(&mut self) {
        self.executed.clear();
        self.fade = None;
    }

    /// From the next control period on another filter answers: its correction takes the place of the old one by a ramp.
    pub fn filter_changed(&mut self) {
        self.is_changed = true;
    }

    /// Turns the filter's answer to `asked` into the goal to execute. All are angles of the goal joints, rad.
    ///
    /// The answer is inside the joints' ranges, and no joint is further from the last goal (at first, from `measured`) than it may
    /// move in the time that has passed.
    pub fn step(&mut self, measured: &[f32], asked: &[f32], goal: &mut [f32]) -> Execution {
        if self.executed.is_empty() {
            self.executed = self.limits.inside(measured);
            self.correction = vec![0.0; asked.len()];
            self.is_changed = true;
        }
        if std::mem::take(&mut self.is_changed) {
            self.begin_fade(asked, goal);
        }
        let fade = self.fade(goal);
        goal.copy_from_slice(&self.limits.inside(goal));
        let wanted = goal.to_vec();
        let limited = self.limit_speeds(goal);
        self.executed.copy_from_slice(goal);
        for ((correction, goal), asked) in self.correction.iter_mut().zip(goal).zip(asked) {
            *correction = *goal - asked;
        }
        Execution {
            fade,
            wanted,
            limited,
        }
    }

    fn begin_fade(&mut self, asked: &[f32], goal: &[f32]) {
        let correction: Vec<f32> = goal.iter().zip(asked).map(|(g, a)| g - a).collect();
        let old = self.correction.iter().zip(&correction);
        self.fade = (self.correction != correction).then(|| Fade {
            offset: old.map(|(old, new)| old - new).collect(),
            ramp: self
                .limits
                .ramp(&self.correction, &correction, self.period.speed),
        });
    }

    /// Adds what is left of the older correction; gives the fade's progress.
    fn fade(&mut self, goal: &mut [f32]) -> Option<f32> {
        let fade = self.fade.as_mut()?;
        fade.ramp.advance(self.period.elapsed);
        if fade.ramp.is_finished() {
            self.fade = None;
            return None;
        }
        let (progress, left) = (fade.ramp.progress(), 1.0 - fade.ramp.weight());
        for (goal, offset) in goal.iter_mut().zip(&fade.offset) {
            *goal += left * offset;
        }
        Some(progress)
    }

    fn limit_speeds(&self, goal: &mut [f32]) -> Vec<usize> {
        let Period { elapsed, speed } = self.period;
        let reach = elapsed.as_secs_f32() * speed;
        let joints = goal.iter_mut().zip(&self.executed).zip(&self.limits.speeds);
        let mut limited = Vec::new();
        for (index, ((goal, last), limit)) in joints.enumerate() {
            let (wanted, step) = (*goal, limit * reach);
            // A goal that is no number stays where the joint is.
            *goal = wanted.max(last - step).min(last + step);
            if *goal != wanted {
                limited.push(index);
            }
        }
        limited
    }
}

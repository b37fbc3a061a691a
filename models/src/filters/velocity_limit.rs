//! A limit on joint speed.

use emp_robot::Robot;

use super::{
    error::FilterError,
    goal_filter::FilterItem,
    parameters::Parameters,
    rule::{Rule, remembered},
};

/// Moves each joint's goal toward the one asked for, by no more than a largest step a control period.
///
/// Parameter `limit`: rad/s; without it each joint's own limit. Memory: the last goal.
pub(super) struct VelocityLimit {
    /// Largest step of each joint, rad.
    steps: Vec<f32>,
}

impl VelocityLimit {
    pub(super) fn new(parameters: &mut Parameters<'_>, robot: &Robot) -> Result<Self, FilterError> {
        let limit = parameters.number("limit", 0.01..=1000.0, " rad/s")?;
        parameters.finish("limit or joints")?;
        let joints = robot.goal_joints().iter();
        let step = |speed: f64| (speed / robot.control_rate_hz()) as f32;
        Ok(Self {
            steps: joints
                .map(|joint| step(limit.unwrap_or(joint.velocity_limit)))
                .collect(),
        })
    }
}

impl Rule for VelocityLimit {
    fn memory(&self) -> usize {
        self.steps.len()
    }

    fn apply(&self, item: &mut FilterItem<'_>) {
        if let Some(last) = remembered(item.memory, self.steps.len()) {
            for ((goal, last), step) in item.goal.iter_mut().zip(last).zip(&self.steps) {
                if (*goal - *last).abs() > *step {
                    *goal = *last + step.copysign(*goal - *last);
                }
            }
        }
        item.memory.clear();
        item.memory.extend_from_slice(item.goal);
    }
}

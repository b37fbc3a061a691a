//! Filters that need no learning: a fixed rule for one robot's goal.

use emp_robot::Robot;

use super::goal_filter::{FilterItem, GoalFilter};
use crate::ModelError;

/// Changes one robot's goal by a fixed rule.
pub(super) trait Rule: Send + Sync {
    fn apply(&self, item: &mut FilterItem<'_>);
}

/// A rule as a filter.
pub(super) struct RuleFilter {
    specification: String,
    rule: Box<dyn Rule>,
    ranges: Vec<[f32; 2]>,
}

impl RuleFilter {
    /// `rule` for `robot`, as `specification` asks for it.
    pub(super) fn new(specification: &str, rule: Box<dyn Rule>, robot: &Robot) -> Self {
        let ranges = robot.goal_joints().iter();
        Self {
            specification: specification.trim().to_owned(),
            rule,
            ranges: ranges
                .map(|joint| joint.range.map(|limit| limit as f32))
                .collect(),
        }
    }
}

impl GoalFilter for RuleFilter {
    fn name(&self) -> &str {
        &self.specification
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        for item in batch {
            self.rule.apply(item);
            for (angle, range) in item.goal.iter_mut().zip(&self.ranges) {
                *angle = angle.clamp(range[0], range[1]);
            }
        }
        Ok(())
    }
}

/// What a rule remembers of a robot: `width` numbers, or none yet.
pub(super) fn remembered(memory: &mut [f32], width: usize) -> Option<&mut [f32]> {
    (memory.len() == width).then_some(memory)
}

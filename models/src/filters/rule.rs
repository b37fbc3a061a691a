//! Filters that need no learning: a fixed rule for one robot's goal.

use std::sync::Arc;

use emp_robot::Robot;

use super::goal_filter::{FilterItem, GoalFilter};
use crate::ModelError;

/// Changes one robot's goal by a fixed rule.
pub(super) trait Rule: Send + Sync {
    /// Numbers that it remembers of a robot.
    fn memory(&self) -> usize {
        0
    }

    fn apply(&self, item: &mut FilterItem<'_>);
}

/// A rule for some joints alone.
pub(super) struct SomeJoints {
    rule: Box<dyn Rule>,
    /// Indices of the goal joints that it leaves alone.
    others: Vec<usize>,
}

impl SomeJoints {
    /// `rule` for all goal joints but `others`.
    pub(super) fn new(rule: Box<dyn Rule>, others: Vec<usize>) -> Self {
        Self { rule, others }
    }
}

impl Rule for SomeJoints {
    fn memory(&self) -> usize {
        self.rule.memory()
    }

    fn apply(&self, item: &mut FilterItem<'_>) {
        let asked: Vec<f32> = self.others.iter().map(|&joint| item.goal[joint]).collect();
        self.rule.apply(item);
        for (&joint, asked) in self.others.iter().zip(asked) {
            item.goal[joint] = asked;
        }
    }
}

/// Rules as a filter, one after the other.
pub(super) struct RuleFilter {
    specification: String,
    rules: Vec<Box<dyn Rule>>,
    robot: Arc<Robot>,
}

impl RuleFilter {
    /// `rules` for `robot`, as `specification` asks for them.
    pub(super) fn new(specification: &str, rules: Vec<Box<dyn Rule>>, robot: &Arc<Robot>) -> Self {
        Self {
            specification: specification.trim().to_owned(),
            rules,
            robot: Arc::clone(robot),
        }
    }

    /// Applies the rules to one robot's goal; what they remember stands one after the other.
    fn apply(&self, item: &mut FilterItem<'_>) {
        let memories: usize = self.rules.iter().map(|rule| rule.memory()).sum();
        let is_known = item.memory.len() == memories;
        let mut known = std::mem::take(item.memory).into_iter();
        for rule in &self.rules {
            let mut memory = Vec::new();
            if is_known {
                memory.extend(known.by_ref().take(rule.memory()));
            }
            rule.apply(&mut FilterItem {
                observation: item.observation,
                goal: item.goal,
                memory: &mut memory,
                risk: item.risk,
            });
            item.memory.extend(memory);
        }
    }
}

impl GoalFilter for RuleFilter {
    fn name(&self) -> &str {
        &self.specification
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        for item in batch {
            self.apply(item);
            self.robot.clamp_goal(item.goal);
        }
        Ok(())
    }
}

/// What a rule remembers of a robot: `width` numbers, or none yet.
pub(super) fn remembered(memory: &mut [f32], width: usize) -> Option<&mut [f32]> {
    (memory.len() == width).then_some(memory)
}

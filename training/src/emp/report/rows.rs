//! The rows of the tables.

use emp_sim::{
    metrics::{
        Interval, Metrics, Sample, failures, failures_cut, motions, paired_difference, summary,
    },
    suite::Condition,
};
use serde::Serialize;

/// What the hard conditions together are called.
pub(super) const HARD: &str = "hard suite";

/// One controller.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Name of the controller.
    pub(super) name: String,
    /// Its family; an EMP is one of its own.
    pub(super) family: String,
    /// Whether it is learned.
    pub(super) learned: bool,
    /// All hard conditions together.
    pub(super) hard: Outcome,
    /// The same by the kind of motion.
    pub(super) groups: Vec<GroupOutcome>,
    /// Each condition by itself.
    pub(super) conditions: Vec<Outcome>,
}

/// What came of a set of episodes.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Name of the condition.
    pub(super) condition: &'static str,
    /// Number of episodes.
    pub(super) episodes: usize,
    /// Number of motions that they play: what the intervals rest on.
    pub(super) motions: usize,
    /// Number of those in which the robot fell.
    pub(super) falls: usize,
    /// Share of the policy's own falls that are gone; none where it has none.
    pub(super) falls_cut: Option<Interval>,
    /// The metrics.
    pub(super) metrics: Metrics<Interval>,
    /// Their difference from the policy's own, pair by pair.
    pub(super) difference: Metrics<Interval>,
}

/// What came of the episodes on one kind of motion.
#[derive(Clone, Debug, Serialize)]
pub struct GroupOutcome {
    /// The kind of motion.
    pub(super) name: &'static str,
    /// What came of them.
    #[serde(flatten)]
    pub(super) outcome: Outcome,
}

/// An EMP against a filter.
#[derive(Clone, Debug, Serialize)]
pub struct Duel {
    /// The EMP.
    pub(super) emp: String,
    /// The filter.
    pub(super) filter: String,
    /// The EMP's metrics minus the filter's.
    pub(super) difference: Metrics<Interval>,
}

impl Row {
    pub(super) fn under(&self, condition: Condition) -> Option<&Outcome> {
        let mut outcomes = self.conditions.iter();
        outcomes.find(|outcome| outcome.condition == condition.name())
    }
}

impl Outcome {
    pub(super) fn new(condition: &'static str, ours: &[Sample], raw: &[Sample], seed: u64) -> Self {
        Self {
            condition,
            episodes: ours.len(),
            motions: motions(ours),
            falls: failures(ours),
            falls_cut: failures_cut(ours, raw, seed),
            metrics: summary(ours, seed),
            difference: paired_difference(ours, raw, seed),
        }
    }

    /// Share of episodes in which the robot fell.
    pub(super) fn fallen(&self) -> f64 {
        self.falls as f64 / self.episodes.max(1) as f64
    }
}

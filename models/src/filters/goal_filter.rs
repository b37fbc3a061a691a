//! What a goal filter is.

use serde::{Deserialize, Serialize};

use crate::ModelError;

/// Changes goals before they are executed: the EMP, or one of the simple rules to compare it with.
pub trait GoalFilter: Send + Sync {
    /// The filter's name, as a controller is called.
    fn name(&self) -> &str;

    /// Replaces each goal by the one to execute.
    ///
    /// # Errors
    /// When a model fails; then the whole batch has no answer.
    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError>;
}

/// One robot's goal, on its way through a filter.
#[derive(Debug)]
pub struct FilterItem<'a> {
    /// The stack `S_t` with the goal that was asked for in its newest frame.
    pub observation: &'a [f32],
    /// The goal, rad: in, as asked for; out, to be executed.
    pub goal: &'a mut [f32],
    /// What the filter remembers of this robot; empty at reset, otherwise the filter's own.
    pub memory: &'a mut Vec<f32>,
    /// How dangerous the filter finds the goal, for filters that judge it; none before.
    pub risk: &'a mut Option<Risk>,
}

/// How dangerous an EMP finds a goal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Risk {
    /// Mean of z² over the latent's dimensions.
    pub regloss: f32,
    /// Whether the danger gate is passed.
    pub danger: bool,
    /// Share of the correction that is executed, 0 to 1.
    pub applied: f32,
}

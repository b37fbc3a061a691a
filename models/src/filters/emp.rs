//! The EMP as a filter of goals, always or when there is danger.

use std::sync::Arc;

use super::{
    goal_filter::{FilterItem, GoalFilter, Risk},
    names::{EMP, EMP_WHEN_DANGER},
};
use crate::{
    ModelError,
    emp::{DangerGate, Emp},
};

/// Control periods in which the correction is faded in once there is danger.
const OPENING: f32 = 5.0;
/// Control periods in which it is faded out after the danger.
const CLOSING: f32 = 25.0;

/// An EMP as a filter.
#[derive(Clone, Debug)]
pub struct EmpFilter {
    emp: Arc<Emp>,
    gate: DangerGate,
    /// Filters when there is no danger too.
    always: bool,
}

impl EmpFilter {
    /// Filters every goal; danger is judged by the checkpoint's gate.
    pub fn always(emp: Arc<Emp>) -> Self {
        Self {
            gate: emp.config().gate,
            emp,
            always: true,
        }
    }

    /// Filters while `gate` sees danger; the correction is faded in within 0.1 s and out within 0.5 s, at 50 Hz.
    pub fn when_danger(emp: Arc<Emp>, gate: DangerGate) -> Self {
        Self {
            emp,
            gate,
            always: false,
        }
    }

    /// What the filter remembers of a control period in which this share of its correction was executed.
    pub fn memory(applied: f32) -> Vec<f32> {
        vec![applied]
    }

    /// The EMP.
    pub fn emp(&self) -> &Arc<Emp> {
        &self.emp
    }

    /// How much of the correction is executed, after a control period in which it was `before`.
    fn applied(&self, before: f32, danger: bool) -> f32 {
        match (self.always, danger) {
            (true, _) => 1.0,
            (false, true) => (before + 1.0 / OPENING).min(1.0),
            (false, false) => (before - 1.0 / CLOSING).max(0.0),
        }
    }
}

impl GoalFilter for EmpFilter {
    fn name(&self) -> &str {
        if self.always { EMP } else { EMP_WHEN_DANGER }
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        let layout = self.emp.config().observation;
        let stacks = batch.iter().flat_map(|item| item.observation).copied();
        let answers = self.emp.answer(&stacks.collect::<Vec<_>>())?;
        for (item, answer) in batch.iter_mut().zip(answers) {
            let frame = &item.observation[layout.newest()];
            let danger = self.gate.is_passed(answer.regloss, frame, &layout);
            let before = item.memory.first().copied().unwrap_or(0.0);
            let applied = self.applied(before, danger);
            *item.memory = Self::memory(applied);
            for (goal, executable) in item.goal.iter_mut().zip(&answer.goal) {
                *goal += applied * (executable - *goal);
            }
            *item.risk = Some(Risk {
                regloss: answer.regloss,
                danger,
                applied,
            });
        }
        Ok(())
    }
}

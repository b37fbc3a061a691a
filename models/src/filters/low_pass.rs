//! A plain low-pass, to set beside a learned filter of the same lag.

use std::f64::consts::TAU;

use emp_robot::Robot;

use super::{
    error::FilterError,
    goal_filter::FilterItem,
    parameters::Parameters,
    rule::{Rule, remembered},
};

/// Equal first-order sections in a row, by joint: no overshoot, and slow motion comes out
/// `order · √(2^(1/order) − 1) / (2π cutoff)` seconds late.
///
/// Parameters: `cutoff` of the whole (half power), Hz; `order`, number of sections. Memory: the sections' last answers, joint
/// by joint.
pub(super) struct LowPass {
    /// Weight of a section's newest input.
    weight: f32,
    order: usize,
    joints: usize,
}

impl LowPass {
    pub(super) fn new(parameters: &mut Parameters<'_>, robot: &Robot) -> Result<Self, FilterError> {
        let rate = robot.control_rate_hz();
        let cutoff = parameters.number("cutoff", 0.01..=0.5 * rate, " Hz")?;
        let order = parameters.word("order", &["1", "2"])?;
        parameters.finish("cutoff, order or joints")?;
        let order = if order == Some("2") { 2 } else { 1 };
        let section = cutoff.unwrap_or(2.0) / (2.0_f64.powf(1.0 / order as f64) - 1.0).sqrt();
        Ok(Self {
            weight: (1.0 - (-TAU * section / rate).exp()) as f32,
            order,
            joints: robot.goal_joints().len(),
        })
    }
}

impl Rule for LowPass {
    fn memory(&self) -> usize {
        self.order * self.joints
    }

    fn apply(&self, item: &mut FilterItem<'_>) {
        let Some(memory) = remembered(item.memory, self.memory()) else {
            item.memory.clear();
            let sections = |&goal: &f32| std::iter::repeat_n(goal, self.order);
            item.memory.extend(item.goal.iter().flat_map(sections));
            return;
        };
        for (goal, sections) in item
            .goal
            .iter_mut()
            .zip(memory.chunks_exact_mut(self.order))
        {
            for answer in sections {
                *answer += self.weight * (*goal - *answer);
                *goal = *answer;
            }
        }
    }
}

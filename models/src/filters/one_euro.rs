//! The One-Euro filter (Casiez, Roussel, Vogel: 1 € filter, CHI 2012).

use std::f64::consts::TAU;

use emp_robot::Robot;

use super::{
    error::FilterError,
    goal_filter::FilterItem,
    parameters::Parameters,
    rule::{Rule, remembered},
};

/// A first-order low-pass by joint, whose cut-off rises with the joint's speed: little jitter at rest, little lag in motion.
///
/// Parameters: `cutoff` at rest, Hz; `beta`, Hz of cut-off for each rad/s; `derivative`, cut-off of the speed, Hz.
/// Memory, joint by joint: the last goal as asked for, the last answer, the smoothed speed (rad/s).
pub(super) struct OneEuro {
    cutoff: f64,
    beta: f64,
    derivative: f64,
    rate: f64,
    joints: usize,
}

impl OneEuro {
    pub(super) fn new(parameters: &mut Parameters<'_>, robot: &Robot) -> Result<Self, FilterError> {
        let cutoff = parameters.number("cutoff", 0.01..=1000.0, " Hz")?;
        let beta = parameters.number("beta", 0.0..=1000.0, " Hz per rad/s")?;
        let derivative = parameters.number("derivative", 0.01..=1000.0, " Hz")?;
        parameters.finish("cutoff, beta, derivative or joints")?;
        Ok(Self {
            cutoff: cutoff.unwrap_or(2.0),
            beta: beta.unwrap_or(0.5),
            derivative: derivative.unwrap_or(1.0),
            rate: robot.control_rate_hz(),
            joints: robot.goal_joints().len(),
        })
    }

    /// Weight of the newest value at a cut-off frequency.
    fn weight(&self, cutoff: f64) -> f64 {
        let step = TAU * cutoff / self.rate;
        step / (1.0 + step)
    }
}

impl Rule for OneEuro {
    fn memory(&self) -> usize {
        3 * self.joints
    }

    fn apply(&self, item: &mut FilterItem<'_>) {
        let Some(memory) = remembered(item.memory, self.memory()) else {
            item.memory.clear();
            let fresh = item.goal.iter().flat_map(|&goal| [goal, goal, 0.0]);
            item.memory.extend(fresh);
            return;
        };
        let speed_weight = self.weight(self.derivative) as f32;
        for (goal, memory) in item.goal.iter_mut().zip(memory.chunks_exact_mut(3)) {
            let [asked, answer, speed] = memory else {
                continue;
            };
            let newest = (*goal - *asked) * self.rate as f32;
            *speed += speed_weight * (newest - *speed);
            let cutoff = self.cutoff + self.beta * f64::from(speed.abs());
            *answer += self.weight(cutoff) as f32 * (*goal - *answer);
            *asked = *goal;
            *goal = *answer;
        }
    }
}

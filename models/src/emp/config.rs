//! The shape of an EMP, as its checkpoint gives it.

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use crate::observation::{HISTORY, HistoryMap, ObservationLayout};

/// What the decoder's answer means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Output {
    /// It is the executable goal, as in the paper.
    Absolute,
    /// It is added to the goal.
    Residual,
}

/// What counts as danger: beyond it, "EMP when danger" filters (paper, section VI).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DangerGate {
    /// The mean of z² over the latent's dimensions, above this.
    Regloss(f32),
    /// The angle between the base's vertical axis and the world's, rad, above this.
    Tilt(f32),
}

impl DangerGate {
    /// The paper's gate.
    pub const PAPER: Self = Self::Regloss(0.04);

    /// Whether there is danger: `regloss` is the EMP's, `frame` the newest of its stack.
    pub(crate) fn is_passed(self, regloss: f32, frame: &[f32], layout: &ObservationLayout) -> bool {
        match self {
            Self::Regloss(limit) => regloss > limit,
            Self::Tilt(limit) => {
                let orientation = &frame[layout.orientation()];
                let upright = orientation[0].cos() * orientation[1].cos();
                upright < limit.cos()
            }
        }
    }
}

/// What an EMP's checkpoint says of its shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmpConfig {
    /// Where each part of the observation stands.
    pub observation: ObservationLayout,
    /// The constant first layer of the state encoder.
    pub history_map: HistoryMap,
    /// What the decoder's answer means.
    pub output: Output,
    /// Widths of the state encoder's hidden layers.
    pub state_hidden: Vec<usize>,
    /// Widths of the target encoder's hidden layers.
    pub target_hidden: Vec<usize>,
    /// Width of z₁ and of z₂.
    pub encoding: usize,
    /// Widths of the fusion network's hidden layers.
    pub fusion_hidden: Vec<usize>,
    /// Width of the latent z.
    pub latent: usize,
    /// Widths of the decoder's hidden layers.
    pub decoder_hidden: Vec<usize>,
    /// When "EMP when danger" filters.
    pub gate: DangerGate,
}

impl EmpConfig {
    /// The paper's shape for `robot`: whole stacks in, 1024 units a layer in the encoders, 2048 in fusion and decoder. The
    /// widths of z₁, z₂ and z are not in the paper.
    pub fn paper(robot: &Robot) -> Self {
        Self {
            observation: ObservationLayout::new(robot, HISTORY),
            history_map: HistoryMap::identity(HISTORY),
            output: Output::Absolute,
            state_hidden: vec![1024, 1024],
            target_hidden: vec![1024, 1024],
            encoding: 64,
            fusion_hidden: vec![2048, 2048],
            latent: 32,
            decoder_hidden: vec![2048, 2048],
            gate: DangerGate::PAPER,
        }
    }

    /// Numbers that the state encoder reads.
    pub fn features(&self) -> usize {
        self.history_map.features(&self.observation)
    }

    /// Refuses a shape that does not fit `robot`.
    pub(super) fn check(&self, robot: &Robot) -> Result<(), String> {
        self.observation.check(robot)?;
        let (DangerGate::Regloss(gate) | DangerGate::Tilt(gate)) = self.gate;
        if !gate.is_finite() || gate < 0.0 {
            return Err(format!("the gate is {gate}, expected a number from 0"));
        }
        self.history_map.check(&self.observation)
    }
}

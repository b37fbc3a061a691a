//! What a world model learns from: states of robots, and the control periods that followed.

use emp_models::observation::ObservationLayout;

/// N states and the control periods that followed them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sequences {
    /// Stacks `S_t` with the executed goal in the newest frame, N × [`ObservationLayout::width`].
    pub stacks: Vec<f32>,
    /// The control periods t, t + 1, …, at least one.
    pub periods: Vec<Period>,
}

/// One control period of N robots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Period {
    /// Actions, N × leg joints, policy units.
    pub actions: Vec<f32>,
    /// `[q | roll, pitch, yaw]` at its end, N × (joints + 3), rad.
    pub next: Vec<f32>,
    /// Goals that are executed in the period after it, N × goal joints, rad. Those of the last period are not read.
    pub goals: Vec<f32>,
}

impl Sequences {
    /// Number of sequences.
    pub fn len(&self, layout: &ObservationLayout) -> usize {
        self.stacks.len() / layout.width()
    }
}

//! Physics that left what it can compute.

use std::fmt;

use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_statistic::MjWarningStat;
use serde::{Deserialize, Serialize};

/// Values beyond this count as diverged, as they do in MuJoCo.
const HUGE: f64 = 1e10;

/// Why a simulation's state is not to be trusted any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Divergence {
    /// The inertia matrix became singular.
    Inertia,
    /// There were more contacts than there is room for.
    Contacts,
    /// There were more constraints than there is room for.
    Constraints,
    /// A joint position became NaN, infinite or huge.
    Position,
    /// A joint velocity became NaN, infinite or huge.
    Velocity,
    /// A joint acceleration became NaN, infinite or huge.
    Acceleration,
    /// A control was NaN, infinite or huge.
    Control,
}

impl Divergence {
    /// In the order of MuJoCo's warnings.
    const ALL: [Self; 7] = [
        Self::Inertia,
        Self::Contacts,
        Self::Constraints,
        Self::Position,
        Self::Velocity,
        Self::Acceleration,
        Self::Control,
    ];

    /// What diverged, in a word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Inertia => "inertia",
            Self::Contacts => "contacts",
            Self::Constraints => "constraints",
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::Acceleration => "acceleration",
            Self::Control => "control",
        }
    }

    /// The divergence with this [`name`](Self::name).
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// The first thing that MuJoCo warned of more than `seen` times.
    pub(crate) fn warned(warnings: &[MjWarningStat], seen: i32) -> Option<Self> {
        let mut kinds = warnings.iter().zip(Self::ALL);
        kinds
            .find(|(warning, _)| warning.number > seen)
            .map(|(_, kind)| kind)
    }

    /// Whether a state that no further step will look at is still one.
    pub(crate) fn of_state(data: &MjData<Box<MjModel>>) -> Option<Self> {
        let is_bad = |value: &f64| value.is_nan() || value.abs() > HUGE;
        if data.qpos().iter().any(is_bad) {
            Some(Self::Position)
        } else if data.qvel().iter().any(is_bad) {
            Some(Self::Velocity)
        } else {
            None
        }
    }
}

impl fmt::Display for Divergence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Inertia => "the inertia matrix is singular",
            Self::Contacts => "there are more contacts than there is room for",
            Self::Constraints => "there are more constraints than there is room for",
            Self::Position => "a joint position is NaN, infinite or huge",
            Self::Velocity => "a joint velocity is NaN, infinite or huge",
            Self::Acceleration => "a joint acceleration is NaN, infinite or huge",
            Self::Control => "a control is NaN, infinite or huge",
        })
    }
}

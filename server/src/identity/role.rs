//! What somebody may do.

use std::fmt;

use serde::{Deserialize, Serialize};

/// What somebody may do.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Sees robots, models and what sessions do. Every other role does, too.
    Observer,
    /// Sends the poses that robots follow, and controls sessions.
    Operator,
    /// Is a robot: sends states, receives joint targets.
    Robot,
    /// Runs evaluations and rollouts.
    Evaluator,
    /// May do everything, and alone reloads models and ends sessions.
    Admin,
}

impl Role {
    /// Its name, as files and messages have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Observer => "observer",
            Self::Operator => "operator",
            Self::Robot => "robot",
            Self::Evaluator => "evaluator",
            Self::Admin => "admin",
        }
    }

    /// Whether whoever has this role may do what needs the other.
    pub(super) fn covers(self, needed: Self) -> bool {
        self == needed || self == Self::Admin || needed == Self::Observer
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

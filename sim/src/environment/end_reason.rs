//! Why episodes end.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Divergence;

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum EndReason {
    /// The base tilted too far.
    Tilted,
    /// The base came too low.
    Sank,
    /// The episode reached its full length.
    TimedOut,
    /// The simulation diverged.
    Diverged(Divergence),
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tilted => f.write_str("the base tilted too far"),
            Self::Sank => f.write_str("the base came too low"),
            Self::TimedOut => f.write_str("the episode reached its full length"),
            Self::Diverged(divergence) => write!(f, "the simulation diverged: {divergence}"),
        }
    }
}

//! Training environments: robots that try to stand while their upper bodies follow goals (paper, section IV).
//!
//! A [`VecEnvironment`] is many of them, stepped together on a [`Pool`](crate::Pool). Each goes through episodes on its own; all that is
//! random in an episode follows from one seed, drawn by the environment's number. Results therefore depend on the seed and
//! the actions alone, not on the number of threads.

mod config;
mod end_reason;
mod episode;
mod privileged;
mod randomization;
mod rewards;
mod subject;
#[cfg(test)]
mod tests;
mod vec;

pub use config::EnvironmentConfig;
pub use end_reason::EndReason;
pub use privileged::PrivilegedLayout;
pub(crate) use randomization::leg_targets;
pub use randomization::{Hang, MassRange, Randomization};
pub use rewards::{REWARD_NAMES, REWARD_TERMS, RewardWeights};
pub(crate) use subject::{EpisodeSetup, Kind, Subject};
pub use vec::{Step, VecEnvironment};

//! Environments for learning what goals to execute: a frozen policy moves the legs, the learner chooses the goals.
//!
//! [`TrackingEnvironments`] is many robots, each on one piece of a clip after the other. A learner reads the stacks `S_t` with
//! the goals that are asked for, answers with the goals to execute, and is told what became of them. All that is random in an
//! episode follows from one seed, drawn by the environment's number; results depend on the seed and the executed goals alone,
//! not on the number of threads.

mod environments;
mod episode;
mod settings;
#[cfg(test)]
mod tests;

pub use environments::{TrackingEnvironments, TrackingState, TrackingStep};
pub use episode::EndedEpisode;
pub use settings::TrackingSettings;

//! Upper-body goals over time: clips for evaluation, endless streams for training.

mod clip;
mod library;
mod live;
mod piece;
mod statistics;
mod stream;

use emp_models::ModelError;
use emp_robot::RobotError;

pub use clip::{GoalClip, Source};
pub use library::GoalLibrary;
pub(crate) use piece::{GoalJoint, Piece, check_clips};
pub use statistics::{GoalStatistics, Spread};
pub use stream::GoalStream;

/// Why goals cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum GoalError {
    /// A library needs clips.
    #[error("expected at least one clip of goals, found none")]
    NoClip,
    /// A clip has no frames.
    #[error("clip {clip:?}: expected at least one frame, found none")]
    Empty {
        /// Name of the clip.
        clip: String,
    },
    /// A frame is not a goal.
    #[error(
        "clip {clip:?}, frame {frame}: expected {expected} finite joint angles, found {found:?}"
    )]
    Frame {
        /// Name of the clip.
        clip: String,
        /// Index of the frame.
        frame: usize,
        /// Goal joints of the robot.
        expected: usize,
        /// What is there, rad.
        found: Vec<f32>,
    },
    /// A clip was made for another robot.
    #[error("clip {clip:?}: expected {expected} joints, found {found}")]
    Joints {
        /// Name of the clip.
        clip: String,
        /// Goal joints of the robot.
        expected: usize,
        /// Joints of the clip.
        found: usize,
    },
    /// Human motion could not be retargeted.
    #[error(transparent)]
    Retarget(#[from] ModelError),
    /// The robot has no mirror image.
    #[error("goals cannot be mirrored: {0}")]
    Mirror(#[from] RobotError),
}

#[cfg(test)]
mod tests;

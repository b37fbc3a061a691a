//! The crate's one error type.

use std::path::PathBuf;

/// What can go wrong when a model is loaded, saved or run.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file could not be read or written.
    #[error("{}: {reason}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        reason: std::io::Error,
    },
    /// A file is not a checkpoint of ours, or is damaged.
    #[error("{}: {reason}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// A checkpoint that is sound was made for something else.
    #[error("{}: {field} is {found}, but the robot {robot} has {expected}", path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// The metadata field that differs.
        field: &'static str,
        /// The robot that was to be driven.
        robot: String,
        /// What the checkpoint says.
        found: String,
        /// What the robot's configuration says.
        expected: String,
    },
    /// An input frame cannot be retargeted.
    #[error("frame {index}: {reason}")]
    Frame {
        /// The frame's place in the batch.
        index: usize,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// A clip cannot be retargeted.
    #[error("clip {clip:?}, frame {frame}: {reason}")]
    Clip {
        /// Name of the clip.
        clip: String,
        /// Index of the frame.
        frame: usize,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// A clip cannot be brought to the robot's rate.
    #[error(transparent)]
    Resample(#[from] emp_motion::ResampleError),
    /// The tensor library refused an operation.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

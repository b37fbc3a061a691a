//! What can be wrong with a motion.

use std::path::{Path, PathBuf};

/// Why one pose was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// A coordinate is NaN or infinite.
    #[error("position of {node} is not finite")]
    NotFinite {
        /// The node in question.
        node: &'static str,
    },
    /// A coordinate lies farther from the waist than any body reaches.
    #[error("{node} lies {distance:.1} m from the waist, more than {limit} m")]
    TooFar {
        /// The node in question.
        node: &'static str,
        /// Its distance from the waist, metres.
        distance: f32,
        /// The largest distance accepted, metres.
        limit: f32,
    },
    /// Two neighbouring nodes coincide, so the bone has no direction.
    #[error("bone {parent} to {node} has no length")]
    EmptyBone {
        /// The bone's near end.
        parent: &'static str,
        /// The bone's far end.
        node: &'static str,
    },
    /// A wrist orientation is not a rotation.
    #[error("{side} wrist orientation is not a rotation matrix")]
    NotARotation {
        /// `left` or `right`.
        side: &'static str,
    },
}

/// Why a motion cannot be brought to another rate.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ResampleError {
    /// A rate is not a positive number.
    #[error("expected a rate above 0 frames a second, found {rate}")]
    Rate {
        /// The rate found, frames a second.
        rate: f64,
    },
    /// The motion is so slow that its frames would fill the memory.
    #[error(
        "{frames} frames at the new rate; expected at most {limit}: is the motion's frame rate right?"
    )]
    TooManyFrames {
        /// Frames it would have.
        frames: usize,
        /// The most there may be.
        limit: usize,
    },
}

/// Why a motion file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum MotionError {
    /// The operating system refused.
    #[error("{}: {reason}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        reason: std::io::Error,
    },
    /// A text file is wrong at one line.
    #[error("{}:{line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, counted from 1.
        line: usize,
        /// What was expected and what was found.
        reason: String,
    },
    /// A file is wrong as a whole or in one of its arrays.
    #[error("{}: {reason}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What was expected and what was found.
        reason: String,
    },
    /// One frame of a file does not describe a body.
    #[error("{}: frame {frame}: {reason}", path.display())]
    Frame {
        /// The file.
        path: PathBuf,
        /// The frame, counted from 0.
        frame: usize,
        /// What is wrong with it.
        reason: FrameError,
    },
}

impl MotionError {
    pub(crate) fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format {
            path: path.to_owned(),
            reason: reason.into(),
        }
    }

    pub(crate) fn line(path: &Path, line: usize, reason: impl Into<String>) -> Self {
        Self::Line {
            path: path.to_owned(),
            line,
            reason: reason.into(),
        }
    }

    pub(crate) fn io(path: &Path, reason: std::io::Error) -> Self {
        Self::Io {
            path: path.to_owned(),
            reason,
        }
    }
}

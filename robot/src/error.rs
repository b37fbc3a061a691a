//! What can go wrong while a robot is loaded.

use std::fmt;
use std::path::{Path, PathBuf};

/// Why a robot could not be loaded. Every message names the file, and the key where there is one.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// A file or folder could not be read.
    #[error("{}: cannot be read: {reason}", file.display())]
    Read {
        /// The file or folder.
        file: PathBuf,
        /// What the system said.
        reason: std::io::Error,
    },
    /// `robot.toml` is not TOML, or a key is unknown, missing or of the wrong type.
    #[error("{}: {key}: {message}", file.display())]
    Parse {
        /// The `robot.toml`.
        file: PathBuf,
        /// The key, for example `joints.goal[3].kp`; `.` is the whole file.
        key: String,
        /// What the parser said, with line and column.
        message: String,
    },
    /// A value of `robot.toml` is out of range or disagrees with the MJCF model.
    #[error("{}: {key}: expected {expected}, found {found}", file.display())]
    Value {
        /// The `robot.toml`.
        file: PathBuf,
        /// The key, for example `joints.goal[3].kp`.
        key: String,
        /// What was expected.
        expected: String,
        /// What is there.
        found: String,
    },
    /// The MJCF model is not on this machine yet; a command fetches it.
    #[error("{}: model: {} is not there; run `{command}` to fetch it", file.display(), model.display())]
    NotFetched {
        /// The `robot.toml` that names the model.
        file: PathBuf,
        /// The MJCF file that is missing.
        model: PathBuf,
        /// The command that fetches it.
        command: String,
    },
    /// MuJoCo refused the MJCF model, or what `robot.toml` made of it.
    #[error("{}: MuJoCo: {message}", file.display())]
    Mujoco {
        /// The MJCF file.
        file: PathBuf,
        /// MuJoCo's message.
        message: String,
    },
}

impl RobotError {
    pub(crate) fn value(
        file: &Path,
        key: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Self {
        Self::Value {
            file: file.to_path_buf(),
            key: key.into(),
            expected: expected.into(),
            found: found.into(),
        }
    }

    pub(crate) fn mujoco(file: &Path, message: impl fmt::Display) -> Self {
        Self::Mujoco {
            file: file.to_path_buf(),
            message: message.to_string(),
        }
    }
}

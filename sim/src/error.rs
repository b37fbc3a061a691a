//! What can go wrong in a simulation.

use emp_models::ModelError;
use mujoco_rs::prelude::MjDataError;

use crate::goals::GoalError;

/// Why a simulation could not be run to its end.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// A frame has the wrong number of joint angles.
    #[error("frame {frame}: expected {expected} joint angles, found {found}")]
    Width {
        /// Index of the frame.
        frame: usize,
        /// Goal joints of the robot.
        expected: usize,
        /// Angles in the frame.
        found: usize,
    },
    /// A joint angle is NaN or infinite.
    #[error("frame {frame}: the angle of {joint} is {value}")]
    NotFinite {
        /// Index of the frame.
        frame: usize,
        /// Name of the joint.
        joint: String,
        /// The angle.
        value: f32,
    },
    /// A collision pair names a geom that the compiled model lacks.
    #[error("the model has no geom {geom:?}, which a collision pair names")]
    MissingGeom {
        /// Name of the geom.
        geom: String,
    },
    /// The compiled model lacks a body that the robot names.
    #[error("the model has no body {body:?}, which the robot names")]
    MissingBody {
        /// Name of the body.
        body: String,
    },
    /// A setting of the environment is out of bounds.
    #[error("{name}: expected {expected}, found {found}")]
    Setting {
        /// Name of the setting.
        name: String,
        /// What it may be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A snapshot is not one of these environments.
    #[error("the snapshot does not fit: {0}")]
    Snapshot(String),
    /// Goals cannot be used.
    #[error(transparent)]
    Goals(#[from] GoalError),
    /// A policy could not be run.
    #[error("the policy failed: {0}")]
    Policy(#[source] Box<ModelError>),
    /// The system gave no threads for a pool.
    #[error("cannot start threads for simulation: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// MuJoCo had no memory for the simulation.
    #[error("cannot make a simulation: {0}")]
    Data(#[from] MjDataError),
}

impl From<ModelError> for SimError {
    fn from(error: ModelError) -> Self {
        Self::Policy(Box::new(error))
    }
}

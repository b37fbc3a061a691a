//! Networks and what they need around them: the linear op, robot kinematics as a differentiable op, checkpoints, and the
//! human-to-robot retargeter.
//!
//! This crate turns human key nodes into robot joint angles. It never opens a socket, never steps physics, and never
//! reads a motion file: frames come in as values, answers go out as values.
#![forbid(unsafe_code)]

pub mod checkpoint;
pub mod error;
pub mod kinematics;
pub mod linear;
pub mod optimizer;
pub mod retarget;

pub use checkpoint::CheckpointMetadata;
pub use error::ModelError;

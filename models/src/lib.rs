//! Networks and what they need around them: the linear op, robot kinematics as a differentiable op, checkpoints, the
//! human-to-robot retargeter, the observation history, the lower-body policy, the Executable Motion Prior, and the controller that puts them in order.
//!
//! This crate turns human key nodes into robot joint angles and robot states into joint targets. It never opens a socket, never steps physics, and never
//! reads a motion file: frames come in as values, answers go out as values.
#![forbid(unsafe_code)]

pub mod activation;
pub mod assessment;
pub mod checkpoint;
pub mod controller;
pub mod emp;
pub mod error;
pub mod filters;
pub mod guard;
pub mod kinematics;
pub mod linear;
pub mod mirror;
pub mod mlp;
pub mod observation;
pub mod optimizer;
pub mod packed;
pub mod policy;
pub mod retarget;
pub mod world_model;

pub use checkpoint::CheckpointMetadata;
pub use error::ModelError;
pub use mirror::Mirror;

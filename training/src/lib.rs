//! Training and its reports: losses, trainers, checkpoints of a run, and the `emp-train` command.
//!
//! This crate makes the weights that the other crates serve. It never serves, and no crate but the end-to-end tests depends on it.
#![forbid(unsafe_code)]

pub mod change;
pub mod emp;
pub mod equipment;
pub mod log;
pub mod policy;
pub mod retargeter;
mod rows;
pub mod run;
pub mod sets;
pub mod skill_report;
pub mod variables;
pub mod world_model;

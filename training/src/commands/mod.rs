//! The commands, one file each.

mod arguments;
pub(crate) mod emp;
pub(crate) mod emp_ablation;
pub(crate) mod emp_report;
mod emp_training;
pub(crate) mod fall_report;
pub(crate) mod policy;
pub(crate) mod policy_curves;
pub(crate) mod policy_report;
pub(crate) mod retarget_report;
pub(crate) mod retargeter;
pub(crate) mod skill_report;
mod trial;
pub(crate) mod world_model;
pub(crate) mod world_model_report;

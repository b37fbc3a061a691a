//! The Executable Motion Prior: learning to change goals only as far as balance needs (paper, section V).

pub mod ablation;
pub mod data;
pub mod falls;
pub mod hindsight;
pub mod imagination;
pub mod judge;
pub mod learner;
pub mod losses;
pub mod memory;
pub mod objective;
pub mod report;
pub mod rollout;
pub mod settings;
pub mod trainer;

//! Trains the retargeting network (paper, section III) and reports on it.

pub mod data;
pub mod loss;
pub mod report;
pub mod trainer;

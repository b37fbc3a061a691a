//! The world model: one-step prediction of the robot, learnt from robots whose legs the policy moves (paper, section V-B).
//!
//! [`learner::WorldModelLearner`] learns from [`sequences::Sequences`], wherever they come from; [`trainer`] collects them and
//! trains a model by itself; [`accuracy`] says how well it predicts.

pub mod accuracy;
pub mod explorer;
pub mod learner;
pub mod replay;
pub mod sequences;
pub mod settings;
#[cfg(test)]
mod testing;
pub mod trainer;

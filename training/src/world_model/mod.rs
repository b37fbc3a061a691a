//! The world model: one-step prediction of the robot, learnt from robots whose legs the policy moves (paper, section V-B).
//!
//! [`trainer`] collects [`sequences::Sequences`], from which [`learner::WorldModelLearner`] learns; [`accuracy`] says how well a
//! model predicts. An EMP that imagines is trained with such a model ([`crate::emp::imagination`]).

pub mod accuracy;
pub mod explorer;
pub mod learner;
pub mod replay;
pub mod sequences;
pub mod settings;
#[cfg(test)]
mod testing;
pub mod trainer;

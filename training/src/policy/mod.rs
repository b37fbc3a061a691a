//! The lower-body policy: proximal policy optimisation with an asymmetric actor–critic (paper, section IV).

pub mod curriculum;
pub mod curves;
pub mod data;
mod environment;
pub mod judge;
pub mod learner;
pub mod moments;
pub mod network;
pub mod objective;
pub mod remote;
pub mod report;
pub mod returns;
pub mod settings;
pub mod source;
pub mod symmetry;
pub mod trainer;

pub use settings::Settings;
pub use trainer::{Run, Trainer, train};

//! Evaluations and rollouts for learners, as jobs on threads of their own.

mod blocks;
mod clips;
pub(crate) mod collect;
mod context;
pub(crate) mod controllers;
pub(crate) mod evaluate;
mod job;
mod jobs;
mod places;
mod scores;
mod watch;

pub(crate) use self::{context::RolloutContext, job::JobStream, watch::watch};

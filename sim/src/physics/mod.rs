//! One control period of one robot: what a step depends on, what it changes, what can be measured of it.
//!
//! A [`Stage`] is a MuJoCo model and its data; there is one a thread, so that it stays in that core's cache. A [`Body`] is all
//! that makes one simulated robot differ from another: its state and its own masses, gains and frictions, a few
//! kilobytes that are put on the stage, stepped, and taken off again. A step depends on nothing but the body and
//! its targets: not on the stage, nor on who stood on it before.

mod apply;
mod body;
mod fields;
mod pace;
mod parameters;
mod rig;
mod stage;
#[cfg(test)]
mod tests;

pub use body::{Body, FootReading, Reading, SelfContact};
pub use parameters::{BodyParameters, Physics};
pub use stage::{Stage, Start, Targets};

pub(crate) use parameters::factor;
pub(crate) use rig::Rig;

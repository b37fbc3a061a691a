//! A robot in MuJoCo: what becomes of joint targets when physics carries them out.
//!
//! [`replay`] plays goal-joint targets on a robot whose pelvis is held; [`SelfCollision`] tells whether poses touch
//! themselves, without physics. Joints, gains, timestep and collision pairs are the robot's own.
//!
//! This crate never speaks to a network, never learns, and draws nothing.
//!
//! Frames: x forward, y left, z up, origin at the pelvis. Units: metres, radians, seconds.

mod collision;
mod error;
mod replay;
#[cfg(test)]
mod testing;

pub use collision::SelfCollision;
pub use error::SimError;
pub use replay::{Replay, ReplayFrame, replay};

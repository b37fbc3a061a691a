//! A robot in MuJoCo: what becomes of joint targets when physics carries them out.
//!
//! [`replay`] plays goal-joint targets on a robot whose pelvis is held; [`SelfCollision`] tells whether poses touch
//! themselves, without physics. Joints, gains, timestep and collision pairs are the robot's own.
//!
//! This crate never speaks to a network, never learns, and draws nothing.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let robot = emp_robot::Robot::load("../robots/emp27".as_ref())?;
//! let rest: Vec<f32> = robot.goal_joints().iter().map(|joint| joint.default as f32).collect();
//! let replay = emp_sim::replay(&robot, &vec![rest; 50])?;
//! println!("after a second the left wrist is at {}", replay.frames[49].key_nodes[6]);
//! assert_eq!(replay.self_collision_share(), 0.0);
//! # Ok(())
//! # }
//! ```
//!
//! Frames: x forward, y left, z up, origin at the pelvis. Units: metres, radians, seconds.

mod collector;
mod collision;
mod divergence;
pub mod environment;
mod error;
pub mod evaluation;
pub mod goals;
pub mod ladder;
pub mod metrics;
mod physics;
mod pool;
mod replay;
#[cfg(test)]
mod testing;

pub use collector::{Collector, End, Episode, Rollout, RolloutStatistics};
pub use collision::SelfCollision;
pub use divergence::Divergence;
pub use error::SimError;
pub use physics::{Body, BodyParameters, FootReading, Reading, SelfContact, Stage, Start, Targets};
pub use pool::{Pool, Priority};
pub use replay::{Replay, ReplayFrame, replay};

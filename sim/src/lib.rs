//! A robot in MuJoCo: what becomes of joint targets when physics carries them out.
//!
//! A [`Stage`] simulates a [`Body`] for one control period at a time, a [`Pool`] many of them on all cores. [`environment`]
//! makes training episodes of that, [`metrics`] says how well a robot stood. [`SelfCollision`] tells whether poses touch
//! themselves and a [`Skeleton`] where limbs are, both without physics. Joints, gains, timestep and collision pairs are the
//! robot's own.
//!
//! This crate never speaks to a network, never learns, and draws nothing.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use emp_sim::{BodyParameters, Stage, Start, Targets};
//!
//! let robot = emp_robot::Robot::load("../robots/emp27".as_ref())?;
//! let rest: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
//! let mut stage = Stage::new(&robot)?;
//! let mut body = stage.place(&Start { joint_positions: &rest, lift: 0.0, parameters: BodyParameters::default() });
//! let rest: Vec<f32> = rest.iter().map(|&angle| angle as f32).collect();
//! let (goal, legs) = rest.split_at(robot.goal_joints().len());
//! let reading = stage.step(&mut body, &Targets { goal, legs });
//! println!("after a control period the base is {} m high", reading.position.z);
//! assert!(reading.position.z > 0.9 * robot.standing_height());
//! # Ok(())
//! # }
//! ```
//!
//! Frames: x forward, y left, z up. Units: metres, radians, seconds.

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
pub mod pushes;
pub mod quantile;
mod ranges;
mod sensors;
mod skeleton;
pub mod suite;
#[cfg(test)]
mod testing;
pub mod tracking;

pub use collector::{Collector, End, Episode, Rollout, RolloutStatistics};
pub use collision::SelfCollision;
pub use divergence::Divergence;
pub use error::SimError;
pub use physics::{
    Body, BodyParameters, FootReading, Physics, Reading, SelfContact, Stage, Start, Targets,
};
pub use pool::{Pool, Priority};
pub use sensors::SensorNoise;
pub use skeleton::{Skeleton, SkeletonPose};

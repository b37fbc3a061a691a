//! A robot: what its MJCF model and its `robot.toml` say, checked against each other, and its kinematics.
//!
//! [`Robot::load`] reads a folder of `robots/` and answers with joints, limits, gains, key nodes, contacts, a
//! compiled MuJoCo model and [`Kinematics`]: batched forward kinematics with an analytic reverse pass.
//! Joint counts, names, orders, gains and scales come from those files, never from code.
//!
//! This library never simulates, never learns, and knows nothing of human motion, networks or the wire.
//!
//! Frames: x forward, y left, z up. Units: metres, radians, seconds, kilograms, newton metres.

mod config;
mod error;
mod foot;
mod goal_tree;
mod joint;
mod key_nodes;
mod kinematics;
mod loader;
mod mirror;
mod model;
mod robot;
mod support;

pub use error::RobotError;
pub use foot::Foot;
pub use joint::{GoalNode, Joint};
pub use key_nodes::{KEY_NODE_NAMES, KEY_NODES, KeyNodeSite};
pub use kinematics::{FrameKinematics, Kinematics, OutputLayout, Real};
pub use mirror::JointMirror;
pub use robot::{AddedMasses, LinkSphere, Robot, robot_folders};
pub use support::SupportPolygon;

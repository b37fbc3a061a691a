//! One simulated robot, and what can be measured of it.

use std::sync::Arc;

use emp_models::observation::roll_pitch_yaw;
use nalgebra::{UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::fields::ModelFields;
use super::parameters::BodyParameters;
use crate::Divergence;

/// One simulated robot between two control periods. Made by [`Stage::place`](super::Stage::place).
///
/// It can be written and read back (serde): it then goes on bit for bit.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Body {
    pub(crate) parameters: BodyParameters,
    /// What the parameters make of the model; the next stage derives it where it is missing.
    #[serde(skip)]
    pub(crate) fields: Option<Arc<ModelFields>>,
    pub(crate) qpos: Vec<f64>,
    pub(crate) qvel: Vec<f64>,
    /// Accelerations that the solver starts from.
    pub(crate) warm_start: Vec<f64>,
    /// Targets of the last control period, goal joints first, rad.
    pub(crate) control: Vec<f64>,
    pub(crate) reading: Reading,
}

impl Body {
    /// What was measured at the end of its last control period, or when it was placed.
    pub fn reading(&self) -> &Reading {
        &self.reading
    }

    /// Its physical parameters.
    pub fn parameters(&self) -> &BodyParameters {
        &self.parameters
    }

    /// Pushes the base: adds `linear` (world frame, m/s) and `angular` (base frame, rad/s) to its velocity.
    pub fn push(&mut self, linear: Vector3<f64>, angular: Vector3<f64>) {
        let added = linear.iter().chain(&angular);
        for (velocity, added) in self.qvel.iter_mut().zip(added) {
            *velocity += added;
        }
    }
}

/// What was measured of a body. Vectors over joints have the goal joints first.
///
/// Positions and velocities are those of the end of the control period. What MuJoCo computes on the way to them (torques,
/// forces, centre of mass, feet) is as of the last physics step's start.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Reading {
    /// Joint angles, rad.
    pub joint_positions: Vec<f32>,
    /// Joint speeds, rad/s.
    pub joint_velocities: Vec<f32>,
    /// Mean joint accelerations over the control period, rad/s².
    pub joint_accelerations: Vec<f32>,
    /// Torques of the motors, N·m.
    pub torques: Vec<f32>,
    /// Position of the base in the world, metres.
    pub position: Vector3<f64>,
    /// Orientation of the base in the world.
    pub orientation: UnitQuaternion<f64>,
    /// Velocity of the base in the world frame, m/s.
    pub linear_velocity: Vector3<f64>,
    /// Angular velocity of the base in its own frame, rad/s.
    pub angular_velocity: Vector3<f64>,
    /// Change of the base's velocity over the control period, `v_t − v_{t−1}` of the paper, m/s. A push before it does not count.
    pub velocity_change: Vector3<f64>,
    /// Centre of mass of the whole robot in the world, metres.
    pub center_of_mass: Vector3<f64>,
    /// The feet, left and right.
    pub feet: [FootReading; 2],
    /// Contact of the robot with itself.
    pub self_contact: SelfContact,
    /// Set if the simulation diverged in this control period: then all else is as it was before it.
    pub divergence: Option<Divergence>,
}

impl Reading {
    /// Horizontal way from the middle between the soles to the centre of mass, in the base's heading frame: x forward,
    /// y left, metres.
    pub fn center_of_mass_over_feet(&self) -> Vector2<f64> {
        let [_, _, yaw] = roll_pitch_yaw(&self.orientation);
        let to_heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -yaw);
        let middle = (self.feet[0].position + self.feet[1].position) / 2.0;
        (to_heading * (self.center_of_mass - middle)).xy()
    }
}

/// What was measured of one foot.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FootReading {
    /// Centre of the sole in the world, metres.
    pub position: Vector3<f64>,
    /// Its velocity in the world frame, m/s.
    pub velocity: Vector3<f64>,
    /// Normal force from the floor, N.
    pub force: f64,
}

/// Contacts between the links that may touch each other.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SelfContact {
    /// How hard they press: the sum over touching pairs of the norm of the pair's contact force, averaged over the control
    /// period, N.
    pub force: f64,
    /// Whether a pair touched at any physics step of the control period.
    pub touched: bool,
}

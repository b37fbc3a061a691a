//! What the critic sees: the state as only a simulation knows it.

use std::ops::Range;

use emp_models::Mirror;
use emp_models::observation::{ObservationLayout, projected_gravity, roll_pitch_yaw};
use emp_robot::{Robot, RobotError};
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::BodyParameters;
use crate::physics::{Reading, factor};

/// Factors that bring each part to about unit size.
const JOINT_VELOCITY: f32 = 0.2;
const HEIGHT: f32 = 10.0;
const CENTER_OF_MASS: f32 = 10.0;
const GOAL_AHEAD: [f32; 2] = [10.0, 3.0];
const ADDED_MASS: f32 = 20.0;
const BASE_COM: f32 = 20.0;
const FACTOR: f32 = 5.0;
const DELAY: f32 = 100.0;

/// How far ahead goals are seen, control periods.
pub(super) const AHEAD: [usize; 2] = [1, 5];

/// Where each part of a privileged observation stands. Parts follow each other in the order of the fields, each brought to about unit size by
/// the factor that its comment gives.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PrivilegedLayout {
    /// The newest frame `s_t`, as in the observation.
    pub frame: Range<usize>,
    /// Velocity of the base in its heading frame (x forward, z up), m/s.
    pub linear_velocity: Range<usize>,
    /// Angular velocity of the base in its own frame, rad/s.
    pub angular_velocity: Range<usize>,
    /// Joint speeds, goal joints first, rad/s × 0.2.
    pub joint_velocities: Range<usize>,
    /// Height of the base above its standing height, m × 10.
    pub height: Range<usize>,
    /// Projected gravity.
    pub gravity: Range<usize>,
    /// Normal forces of the left and the right foot, half the robot's weights.
    pub foot_forces: Range<usize>,
    /// Horizontal way from the middle between the feet to the centre of mass, heading frame, m × 10.
    pub center_of_mass: Range<usize>,
    /// The action before the last, `a_{t−2}`, policy units; `a_{t−1}` is in the frame.
    pub action_before: Range<usize>,
    /// Change of the goal from now to 1 control period ahead, rad × 10.
    pub goal_next: Range<usize>,
    /// Change of the goal from now to 5 control periods ahead, rad × 3.
    pub goal_later: Range<usize>,
    /// Friction of the feet − 1.
    pub friction: Range<usize>,
    /// Mass added to the base, to the left and the right hand, and to the robot as a whole, robot's masses × 20.
    pub added_masses: Range<usize>,
    /// Displacement of the base's centre of mass, m × 20.
    pub base_com: Range<usize>,
    /// Delay of the motors, s × 100.
    pub motor_delay: Range<usize>,
    /// Factors on the legs' stiffness, (factor − 1) × 5.
    pub p_gain: Range<usize>,
    /// Factors on the legs' servo damping, (factor − 1) × 5.
    pub d_gain: Range<usize>,
    /// Factors on the legs' torque limits, (factor − 1) × 5.
    pub motor_torque: Range<usize>,
    /// Factors on the legs' passive damping, factor − 1.
    pub motor_damping: Range<usize>,
}

impl PrivilegedLayout {
    /// The layout for a robot with this observation.
    pub fn new(observation: &ObservationLayout) -> Self {
        let joints = observation.joint_positions().len();
        let (legs, goals) = (observation.last_action().len(), observation.goal().len());
        let mut end = 0;
        let mut next = |width: usize| {
            end += width;
            end - width..end
        };
        Self {
            frame: next(observation.frame_width()),
            linear_velocity: next(3),
            angular_velocity: next(3),
            joint_velocities: next(joints),
            height: next(1),
            gravity: next(3),
            foot_forces: next(2),
            center_of_mass: next(2),
            action_before: next(legs),
            goal_next: next(goals),
            goal_later: next(goals),
            friction: next(1),
            added_masses: next(4),
            base_com: next(3),
            motor_delay: next(1),
            p_gain: next(legs),
            d_gain: next(legs),
            motor_torque: next(legs),
            motor_damping: next(legs),
        }
    }

    /// The mirror of privileged observations of `robot`, whose observations have this layout.
    ///
    /// # Errors
    /// When the robot has no mirror image.
    pub fn mirror(
        &self,
        robot: &Robot,
        observation: &ObservationLayout,
    ) -> Result<Mirror, RobotError> {
        let joints = robot.mirror()?;
        let (all, goals, legs) = (
            Mirror::joints(&joints),
            Mirror::goal_joints(&joints),
            Mirror::leg_joints(&joints),
        );
        // Rotations turn the other way about x and z, ways about y.
        let (polar, axial) = ([1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]);
        let factors = legs.clone().unsigned();
        let mirror = Mirror::chain([
            Mirror::frame(robot, observation)?,
            Mirror::signs(&polar),
            Mirror::signs(&axial),
            all,
            Mirror::signs(&[1.0]),
            Mirror::signs(&polar),
            Mirror::sides(),
            Mirror::signs(&polar[..2]),
            legs,
            goals.clone(),
            goals,
            Mirror::signs(&[1.0]),
            Mirror::signs(&[1.0]),
            Mirror::sides(),
            Mirror::signs(&[1.0]),
            Mirror::signs(&polar),
            Mirror::signs(&[1.0]),
            factors.repeated(4),
        ]);
        debug_assert_eq!(mirror.width(), self.width());
        Ok(mirror)
    }

    /// Numbers in a privileged observation.
    pub fn width(&self) -> usize {
        self.motor_damping.end
    }

    /// The part that an episode's parameters fill.
    pub fn parameters(&self) -> Range<usize> {
        self.friction.start..self.width()
    }

    /// Writes what an episode's parameters are, `added` the mass of the whole robot beyond its nominal one, kg.
    pub(super) fn write_parameters(
        &self,
        robot: &Robot,
        parameters: &BodyParameters,
        added: f64,
        out: &mut [f32],
    ) {
        let start = self.friction.start;
        let mut part = |range: &Range<usize>, values: &mut dyn Iterator<Item = f32>| {
            let out = &mut out[range.start - start..range.end - start];
            for (out, value) in out.iter_mut().zip(values) {
                *out = value;
            }
        };
        let goals = robot.goal_joints().len();
        let [left, right] = parameters.hand_mass;
        let masses = [parameters.base_mass, left, right, added];
        part(
            &self.friction,
            &mut std::iter::once(parameters.friction as f32 - 1.0),
        );
        part(
            &self.added_masses,
            &mut masses
                .iter()
                .map(|mass| ADDED_MASS * (mass / robot.mass()) as f32),
        );
        part(
            &self.base_com,
            &mut parameters
                .base_com
                .iter()
                .map(|&offset| BASE_COM * offset as f32),
        );
        part(
            &self.motor_delay,
            &mut std::iter::once(DELAY * parameters.motor_delay as f32),
        );
        for (range, factors, scale) in [
            (&self.p_gain, &parameters.p_gain, FACTOR),
            (&self.d_gain, &parameters.d_gain, FACTOR),
            (&self.motor_torque, &parameters.motor_torque, FACTOR),
            (&self.motor_damping, &parameters.motor_damping, 1.0),
        ] {
            let values = (goals..).map(|joint| scale * (factor(factors, joint) - 1.0) as f32);
            part(range, &mut values.into_iter());
        }
    }

    /// Writes a privileged observation.
    pub(super) fn write(&self, state: &PrivilegedState<'_>, out: &mut [f32]) {
        let reading = state.reading;
        let [_, _, yaw] = roll_pitch_yaw(&reading.orientation);
        let to_heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -yaw);
        let forces = reading.feet.iter().map(|foot| foot.force);

        out[self.frame.clone()].copy_from_slice(state.frame);
        write(
            &mut out[self.linear_velocity.clone()],
            &(to_heading * reading.linear_velocity),
            1.0,
        );
        write(
            &mut out[self.angular_velocity.clone()],
            &reading.angular_velocity,
            1.0,
        );
        let velocities = out[self.joint_velocities.clone()].iter_mut();
        for (out, velocity) in velocities.zip(&reading.joint_velocities) {
            *out = JOINT_VELOCITY * velocity;
        }
        out[self.height.start] = HEIGHT * (reading.position.z - state.standing_height) as f32;
        write(
            &mut out[self.gravity.clone()],
            &projected_gravity(&reading.orientation),
            1.0,
        );
        for (out, force) in out[self.foot_forces.clone()].iter_mut().zip(forces) {
            *out = (2.0 * force / state.weight) as f32;
        }
        write(
            &mut out[self.center_of_mass.clone()],
            &reading.center_of_mass_over_feet(),
            CENTER_OF_MASS,
        );
        out[self.action_before.clone()].copy_from_slice(state.action_before);
        for ((range, ahead), scale) in [&self.goal_next, &self.goal_later]
            .into_iter()
            .zip(state.goals_ahead)
            .zip(GOAL_AHEAD)
        {
            for ((out, ahead), now) in out[range.clone()].iter_mut().zip(ahead).zip(state.goal) {
                *out = scale * (ahead - now);
            }
        }
        out[self.parameters()].copy_from_slice(state.parameters);
    }
}

fn write<'a>(out: &mut [f32], values: impl IntoIterator<Item = &'a f64>, scale: f32) {
    for (out, &value) in out.iter_mut().zip(values) {
        *out = scale * value as f32;
    }
}

/// What a privileged observation is made of.
#[derive(Debug)]
pub(super) struct PrivilegedState<'a> {
    pub(super) reading: &'a Reading,
    /// The newest frame of the observation.
    pub(super) frame: &'a [f32],
    pub(super) action_before: &'a [f32],
    pub(super) goal: &'a [f32],
    /// Goals [`AHEAD`].
    pub(super) goals_ahead: [&'a [f32]; 2],
    /// The part that [`PrivilegedLayout::write_parameters`] wrote.
    pub(super) parameters: &'a [f32],
    /// Height of the base when the robot stands, metres.
    pub(super) standing_height: f64,
    /// Weight of the nominal robot, N.
    pub(super) weight: f64,
}

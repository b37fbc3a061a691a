//! Rewards (paper, table "Rewards Expressions and Weights").

use emp_models::observation::{projected_gravity, roll_pitch_yaw};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

use crate::Reading;

/// Normal force from which a foot counts as standing, N.
const STANDING_FORCE: f64 = 5.0;

/// Declares the terms: each is a weight, a name and a place in the arrays.
macro_rules! rewards {
    ($($(#[$doc:meta])* $term:ident = $weight:expr,)*) => {
        /// Weights of the reward's terms; the default is the paper's.
        #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct RewardWeights {
            $($(#[$doc])* pub $term: f64,)*
        }

        impl Default for RewardWeights {
            fn default() -> Self {
                Self { $($term: $weight,)* }
            }
        }

        /// Number of terms.
        pub const REWARD_TERMS: usize = [$($weight,)*].len();

        /// Names of the terms, in the order in which they stand everywhere.
        pub const REWARD_NAMES: [&str; REWARD_TERMS] = [$(stringify!($term),)*];

        impl RewardWeights {
            /// The weights in the order of the names.
            fn array(&self) -> [f64; REWARD_TERMS] {
                [$(self.$term,)*]
            }

            /// The weight of the term with this name, if there is one.
            pub fn of_term(&mut self, name: &str) -> Option<&mut f64> {
                $(if name == stringify!($term) {
                    return Some(&mut self.$term);
                })*
                None
            }
        }

        /// The terms' expressions, before weighting.
        struct Expressions {
            $($term: f64,)*
        }

        impl Expressions {
            fn array(&self) -> [f64; REWARD_TERMS] {
                [$(self.$term,)*]
            }
        }
    };
}

rewards! {
    /// `exp(−10 ‖(roll, pitch)‖₁)`
    base_orientation = 3.0,
    /// `exp(−20 ‖pg_xy‖₂)`, pg the projected gravity
    projected_gravity = 3.0,
    /// `exp(−100 |h − h_ref|)`, `h_ref` the standing height
    base_height = 0.2,
    /// `exp(−10 ‖v‖₂²)`
    base_linear_velocity = 0.75,
    /// `exp(−20 ‖ω‖₂)`
    base_angular_velocity = 0.75,
    /// `exp(−3 ‖v_t − v_{t−1}‖₂)`
    base_acceleration = 0.2,
    /// `exp(−100 ‖q_leg − q_ref‖₂)`, `q_ref` the default pose
    leg_position = 1.0,
    /// `1(F_z ≥ 5 N)`, mean over the feet
    feet_contact = 0.5,
    /// `1(F_z ≥ 5 N) √‖v_foot‖₂`, sum over the feet; negative (erratum E2)
    feet_slip = -0.2,
    /// `‖a_t‖₁`, a in radians of leg target
    action_range = -0.075,
    /// `‖a_t − a_{t−1}‖₂²`
    action_rate = -1.5,
    /// `‖a_t − 2 a_{t−1} + a_{t−2}‖₂²`
    action_acceleration = -1.5,
    /// `‖τ‖₂²` of the legs
    torques = -1e-5,
    /// `‖q̇‖₂²` of the legs
    joint_velocity = -1e-4,
    /// `‖q̈‖₂²` of the legs
    joint_acceleration = -1e-7,
}

/// What a control period is judged by.
#[derive(Debug)]
pub(super) struct Outcome<'a> {
    pub(super) reading: &'a Reading,
    /// Height of the base when the robot stands, metres.
    pub(super) standing_height: f64,
    /// Leg angles of the default pose, rad.
    pub(super) leg_default: &'a [f32],
    /// Radians of one unit of action.
    pub(super) action_scale: f64,
    /// The last actions, newest first: `a_t`, `a_{t−1}`, `a_{t−2}`, policy units.
    pub(super) actions: [&'a [f32]; 3],
}

impl RewardWeights {
    /// The terms of one control period, weighted.
    pub(super) fn terms(&self, outcome: &Outcome<'_>) -> [f64; REWARD_TERMS] {
        let mut terms = outcome.expressions().array();
        for (term, weight) in terms.iter_mut().zip(self.array()) {
            *term *= weight;
        }
        terms
    }
}

impl Outcome<'_> {
    fn expressions(&self) -> Expressions {
        let reading = self.reading;
        let goals = reading.joint_positions.len() - self.leg_default.len();
        let [roll, pitch, _] = roll_pitch_yaw(&reading.orientation);
        let [gravity_x, gravity_y, _] = projected_gravity(&reading.orientation);
        let height = reading.position.z - self.standing_height;
        let legs = reading.joint_positions[goals..]
            .iter()
            .zip(self.leg_default);
        let leg_offset = legs.map(|(q, default)| f64::from(q - default).powi(2));
        let standing = reading
            .feet
            .iter()
            .filter(|foot| foot.force >= STANDING_FORCE);
        let (actions, scale) = (self.actions, self.action_scale);
        let action = |i: usize, joint: usize| scale * f64::from(actions[i][joint]);
        let joints = 0..self.leg_default.len();
        Expressions {
            base_orientation: (-10.0 * (roll.abs() + pitch.abs())).exp(),
            projected_gravity: (-20.0 * Vector2::new(gravity_x, gravity_y).norm()).exp(),
            base_height: (-100.0 * height.abs()).exp(),
            base_linear_velocity: (-10.0 * reading.linear_velocity.norm_squared()).exp(),
            base_angular_velocity: (-20.0 * reading.angular_velocity.norm()).exp(),
            base_acceleration: (-3.0 * reading.velocity_change.norm()).exp(),
            leg_position: (-100.0 * leg_offset.sum::<f64>().sqrt()).exp(),
            feet_contact: standing.clone().count() as f64 / reading.feet.len() as f64,
            feet_slip: standing.map(|foot| foot.velocity.norm().sqrt()).sum(),
            action_range: joints.clone().map(|j| action(0, j).abs()).sum(),
            action_rate: joints
                .clone()
                .map(|j| (action(0, j) - action(1, j)).powi(2))
                .sum(),
            action_acceleration: joints
                .map(|j| (action(0, j) - 2.0 * action(1, j) + action(2, j)).powi(2))
                .sum(),
            torques: square_norm(&reading.torques[goals..]),
            joint_velocity: square_norm(&reading.joint_velocities[goals..]),
            joint_acceleration: square_norm(&reading.joint_accelerations[goals..]),
        }
    }
}

fn square_norm(values: &[f32]) -> f64 {
    values.iter().map(|&value| f64::from(value).powi(2)).sum()
}

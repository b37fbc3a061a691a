//! Settings of the training environments.

use emp_models::observation::projected_gravity;
use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use super::{EndReason, Randomization, RewardWeights};
use crate::{Physics, Reading, SimError};

/// Settings of the training environments. The default is the paper's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EnvironmentConfig {
    /// What differs between episodes.
    pub randomization: Randomization,
    /// Weights of the reward's terms.
    pub rewards: RewardWeights,
    /// Control periods after which an episode times out.
    pub episode_frames: usize,
    /// An episode ends when the projected gravity is larger than this along the base's x or y axis.
    pub tilt_limit: f64,
    /// An episode ends when the base is lower than this share of its standing height.
    pub height_limit: f64,
    /// Control periods in which the heading, to which the observed yaw is relative, comes near the base's; 0: it stays as
    /// at the episode's start.
    pub heading_periods: u32,
    /// How exactly the robots are simulated.
    pub physics: Physics,
}

impl Default for EnvironmentConfig {
    fn default() -> Self {
        Self {
            randomization: Randomization::default(),
            rewards: RewardWeights::default(),
            episode_frames: 500,
            tilt_limit: 0.7,
            height_limit: 1.0 / 3.0,
            heading_periods: 0,
            physics: Physics::Exact,
        }
    }
}

/// Time constant of the robust policies' heading, control periods: ten seconds.
const HEADING_PERIODS: u32 = 500;

impl EnvironmentConfig {
    /// For a robot that may step, with sensors as they are: harder pushes, heavier hands, noise and a yaw that drifts.
    pub fn robust(robot: &Robot) -> Self {
        Self {
            randomization: Randomization::robust(robot),
            rewards: RewardWeights::robust(),
            heading_periods: HEADING_PERIODS,
            ..Self::default()
        }
    }

    /// Refuses settings with which `robot` cannot be trained.
    ///
    /// # Errors
    /// [`SimError::Setting`] names the setting.
    pub fn check(&self, robot: &Robot) -> Result<(), SimError> {
        if self.episode_frames == 0 {
            return Err(SimError::Setting {
                name: "episode_frames".to_owned(),
                expected: "at least 1".to_owned(),
                found: "0".to_owned(),
            });
        }
        for (name, limit) in [
            ("tilt_limit", self.tilt_limit),
            ("height_limit", self.height_limit),
        ] {
            if !(0.0..=1.0).contains(&limit) {
                return Err(SimError::Setting {
                    name: name.to_owned(),
                    expected: "a number from 0 to 1".to_owned(),
                    found: limit.to_string(),
                });
            }
        }
        self.randomization.check(robot)
    }

    /// Why an episode with this reading ends before its time, if it does: the robot fell, or its simulation diverged. The
    /// standing height is the robot's, metres.
    pub fn fall(&self, reading: &Reading, standing_height: f64) -> Option<EndReason> {
        if let Some(divergence) = reading.divergence {
            return Some(EndReason::Diverged(divergence));
        }
        let [x, y, _] = projected_gravity(&reading.orientation);
        if x.abs().max(y.abs()) > self.tilt_limit {
            Some(EndReason::Tilted)
        } else if reading.position.z < self.height_limit * standing_height {
            Some(EndReason::Sank)
        } else {
            None
        }
    }
}

//! Under what conditions goals are tracked.

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use crate::SimError;
use crate::environment::{MassRange, Randomization};
use crate::ranges::check_range;

/// What the episodes of [`TrackingEnvironments`](super::TrackingEnvironments) are drawn from. The default goes from the test
/// conditions to beyond what a policy stands.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackingSettings {
    /// Control periods of an episode, fewer where the clip is shorter.
    pub episode_frames: usize,
    /// Factor on the goals' distance from the default pose; goals stay inside the joints' ranges.
    pub amplitude: [f64; 2],
    /// Speed of the motion, as a multiple of its own.
    pub speed: [f64; 2],
    /// Mass added to each hand, drawn separately, kg.
    pub hand_load: [f64; 2],
    /// Share of episodes with pushes of known speed.
    pub pushed: f64,
    /// Speed that such a push adds to the base in a random horizontal direction, drawn once an episode, m/s.
    pub push_speed: [f64; 2],
    /// Time between two such pushes, seconds.
    pub push_interval: f64,
    /// Share of episodes under the paper's full randomisation, its hand masses and its pushes too; pushes of known speed
    /// take these pushes' place.
    pub randomized: f64,
    /// Whether half of the episodes are in the mirror.
    pub mirrored: bool,
}

impl Default for TrackingSettings {
    fn default() -> Self {
        Self {
            episode_frames: 200,
            amplitude: [0.8, 2.0],
            speed: [0.8, 1.5],
            hand_load: [0.0, 3.0],
            pushed: 0.3,
            push_speed: [0.1, 0.5],
            push_interval: 1.5,
            randomized: 0.3,
            mirrored: true,
        }
    }
}

impl TrackingSettings {
    /// Refuses settings out of bounds.
    ///
    /// # Errors
    /// [`SimError::Setting`] names the setting.
    pub fn check(&self, robot: &Robot) -> Result<(), SimError> {
        let period = 1.0 / robot.control_rate_hz();
        for (name, range, least, most) in [
            ("episode_frames", [self.episode_frames as f64; 2], 1.0, 1e6),
            ("amplitude", self.amplitude, 0.0, 10.0),
            ("speed", self.speed, 0.1, 10.0),
            ("hand_load", self.hand_load, 0.0, f64::MAX),
            ("pushed", [self.pushed; 2], 0.0, 1.0),
            ("push_speed", self.push_speed, 0.0, 5.0),
            ("push_interval", [self.push_interval; 2], period, 3600.0),
            ("randomized", [self.randomized; 2], 0.0, 1.0),
        ] {
            check_range(name, range, least, most)?;
        }
        Ok(())
    }

    /// What differs between episodes that are not under full randomisation.
    pub(super) fn loads(&self) -> Randomization {
        Randomization {
            hand_mass: MassRange::Kilograms(self.hand_load),
            ..Randomization::nominal()
        }
    }
}

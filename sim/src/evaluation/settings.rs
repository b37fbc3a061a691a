//! Under what conditions a controller is evaluated.

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use crate::SimError;
use crate::environment::{MassRange, Randomization};
use crate::pushes::{Kick, Pushes};

/// How much the simulated robots differ from the model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RandomizationLevel {
    /// The model as it is, but for the load in the hands.
    #[default]
    Nominal,
    /// Every row of the paper's table of domain randomisation, pushes too.
    Full,
}

/// Conditions of an evaluation; the default is the paper's test. All that is random in an episode follows from the seed and
/// the episode's number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationSettings {
    /// Seed of everything random.
    pub seed: u64,
    /// Number of episodes, which take the clips in turn; none: one a clip.
    pub episodes: Option<usize>,
    /// How much the robots differ from the model.
    pub conditions: RandomizationLevel,
    /// Mass added to each hand, drawn separately, kg. None: under nominal conditions the robot's test load, else as in
    /// training.
    pub hand_load: Option<[f64; 2]>,
    /// Pushes. None: none under nominal conditions, else as in training. A speed of 0 is no push under any.
    pub push: Option<Kick>,
    /// Speed of the motion, as a multiple of its own. Clips become shorter or longer by it.
    pub speed: f64,
    /// Factor on the goals' distance from the default pose; goals stay inside the joints' ranges.
    pub amplitude: f64,
}

impl Default for EvaluationSettings {
    fn default() -> Self {
        Self {
            seed: 0,
            episodes: None,
            conditions: RandomizationLevel::Nominal,
            hand_load: None,
            push: None,
            speed: 1.0,
            amplitude: 1.0,
        }
    }
}

impl EvaluationSettings {
    /// Refuses settings out of bounds.
    ///
    /// # Errors
    /// [`SimError::Setting`] names the setting.
    pub fn check(&self, robot: &Robot) -> Result<(), SimError> {
        let within = |name: &str, range: std::ops::RangeInclusive<f64>, value: f64| {
            if range.contains(&value) {
                return Ok(());
            }
            Err(SimError::Setting {
                name: name.to_owned(),
                expected: format!("a number from {} to {}", range.start(), range.end()),
                found: value.to_string(),
            })
        };
        within("speed", 0.1..=10.0, self.speed)?;
        within("amplitude", 0.0..=10.0, self.amplitude)?;
        if let Some(push) = self.push {
            within("push.speed", 0.0..=5.0, push.speed)?;
            let period = 1.0 / robot.control_rate_hz();
            within("push.interval", period..=3600.0, push.interval)?;
        }
        self.randomization(robot).check(robot)
    }

    /// What differs between episodes, but for the pushes.
    pub(super) fn randomization(&self, robot: &Robot) -> Randomization {
        let mut randomization = match self.conditions {
            RandomizationLevel::Nominal => Randomization {
                hand_mass: MassRange::Kilograms(robot.added_masses().test_hand),
                ..Randomization::nominal()
            },
            RandomizationLevel::Full => Randomization::default(),
        };
        if let Some(load) = self.hand_load {
            randomization.hand_mass = MassRange::Kilograms(load);
        }
        randomization
    }

    pub(super) fn pushes(&self, randomization: &Randomization) -> Option<Pushes> {
        match self.push {
            Some(kick) => (kick.speed > 0.0).then_some(Pushes::Kick(kick)),
            None => randomization.push.map(Pushes::Random),
        }
    }
}

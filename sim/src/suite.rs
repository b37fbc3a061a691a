//! Named conditions between easy and hard, to set controllers beside each other.
//!
//! [`ladder`](crate::ladder) climbs one thing at a time until nothing stands any more. A suite holds still: each of its hard
//! conditions fells a trained policy in some episodes, not in most, so that a filter has something to mend.

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use crate::evaluation::{EvaluationSettings, RandomizationLevel};
use crate::pushes::Kick;

/// Amplitudes of goals that reach farther than in training, and farther still.
const WIDE: f64 = 1.5;
const WIDEST: f64 = 1.8;
/// Amplitude of easy goals.
const EASY: f64 = 0.6;
/// Speed of fast motion.
const FAST: f64 = 1.5;
/// A heavy load, as a share of the largest in training: 3 kg in each hand of a robot of 60 kg.
const HEAVY: f64 = 1.2;
/// Speeds of a push and of a lighter one that comes on top of something else, m/s.
const PUSH: f64 = 0.4;
const LIGHT_PUSH: f64 = 0.3;
/// Time between pushes, seconds: a clip of 200 frames has two or three.
const PUSH_INTERVAL: f64 = 1.5;

/// A condition with a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Condition {
    /// The paper's test.
    Nominal,
    /// Goals at 0.6 of their distance from the default pose.
    Easy,
    /// Goals at 1.8 times their distance from the default pose.
    Wide,
    /// As wide, and 1.5 times as fast.
    WideFast,
    /// As wide, with 1.2 times training's largest load in each hand.
    WideHeavy,
    /// A push of 0.4 m/s every 1.5 s.
    Pushed,
    /// Goals at 1.5 times their distance, and a push of 0.3 m/s every 1.5 s.
    WidePushed,
    /// Goals at 1.5 times their distance under the paper's whole domain randomisation.
    Randomized,
}

impl Condition {
    /// Those in which a trained policy falls now and then.
    pub const HARD: [Self; 6] = [
        Self::Wide,
        Self::WideFast,
        Self::WideHeavy,
        Self::Pushed,
        Self::WidePushed,
        Self::Randomized,
    ];

    /// The condition as a table names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nominal => "nominal",
            Self::Easy => "easy",
            Self::Wide => "wide",
            Self::WideFast => "wide-fast",
            Self::WideHeavy => "wide-heavy",
            Self::Pushed => "pushed",
            Self::WidePushed => "wide-pushed",
            Self::Randomized => "randomized",
        }
    }

    /// The settings of an evaluation of `robot` under this condition.
    pub fn settings(self, robot: &Robot, seed: u64) -> EvaluationSettings {
        let push = |speed| {
            Some(Kick {
                speed,
                interval: PUSH_INTERVAL,
            })
        };
        let nominal = EvaluationSettings {
            seed,
            ..EvaluationSettings::default()
        };
        let wide = |amplitude| EvaluationSettings {
            amplitude,
            ..nominal
        };
        match self {
            Self::Nominal => nominal,
            Self::Easy => wide(EASY),
            Self::Wide => wide(WIDEST),
            Self::WideFast => EvaluationSettings {
                speed: FAST,
                ..wide(WIDEST)
            },
            Self::WideHeavy => EvaluationSettings {
                hand_load: Some([HEAVY * robot.added_masses().hand[1]; 2]),
                ..wide(WIDEST)
            },
            Self::Pushed => EvaluationSettings {
                push: push(PUSH),
                ..nominal
            },
            Self::WidePushed => EvaluationSettings {
                push: push(LIGHT_PUSH),
                ..wide(WIDE)
            },
            Self::Randomized => EvaluationSettings {
                conditions: RandomizationLevel::Full,
                ..wide(WIDE)
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::for_each_robot;

    #[test]
    fn every_condition_can_be_run_and_is_called_as_it_is_written() {
        for_each_robot(|robot| {
            for condition in Condition::HARD
                .into_iter()
                .chain([Condition::Nominal, Condition::Easy])
            {
                let settings = condition.settings(robot, 7);
                settings.check(robot).unwrap();
                assert_eq!(settings.seed, 7);
                let written = serde_json::to_value(condition).unwrap();
                assert_eq!(written, condition.name());
            }
        });
    }

    #[test]
    fn a_heavy_load_is_three_kilograms_for_sixty() {
        let robot = crate::testing::emp27();
        let [left, right] = Condition::WideHeavy.settings(&robot, 0).hand_load.unwrap();
        assert!((left - 3.0).abs() < 1e-9 && left == right, "{left} {right}");
    }
}

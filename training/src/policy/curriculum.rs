//! The curriculum: randomisation and the upper body's difficulty rise while episodes last.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

/// How one scale of difficulty moves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ramp {
    /// Where it starts; it never falls below.
    pub start: f64,
    /// Where it ends.
    pub end: f64,
    /// Step up while episodes are long.
    pub rise: f64,
    /// Step down while they are short.
    pub fall: f64,
}

impl Ramp {
    fn moved(&self, scale: f64, direction: f64) -> f64 {
        let step = if direction > 0.0 {
            self.rise
        } else if direction < 0.0 {
            -self.fall
        } else {
            0.0
        };
        (scale + step).clamp(self.start, self.end)
    }
}

/// Settings of the curriculum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurriculumSettings {
    /// Scale of the domain randomisation; 1 is the paper's.
    pub randomization: Ramp,
    /// Largest amplitude of the goals, which speed rises with; 1 is the motion as recorded.
    pub difficulty: Ramp,
    /// Scales rise while the mean length of episodes is above this share of the longest possible.
    pub rise_above: f64,
    /// Scales fall while it is below this share.
    pub fall_below: f64,
    /// Ended episodes over which lengths are averaged.
    pub window: usize,
    /// Updates between two looks.
    pub interval: u64,
}

impl Default for CurriculumSettings {
    fn default() -> Self {
        Self {
            randomization: Ramp {
                start: 0.1,
                end: 1.0,
                rise: 0.05,
                fall: 0.02,
            },
            difficulty: Ramp {
                start: 0.8,
                end: 2.0,
                rise: 0.02,
                fall: 0.01,
            },
            rise_above: 0.75,
            fall_below: 0.4,
            window: 200,
            interval: 5,
        }
    }
}

/// An episode that ended.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Episode {
    /// Its length as a share of the longest possible.
    pub length: f64,
    /// Whether the robot still stood.
    pub survived: bool,
}

/// Where the curriculum is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curriculum {
    settings: CurriculumSettings,
    randomization: f64,
    difficulty: f64,
    /// The last episodes, oldest first.
    recent: VecDeque<Episode>,
    updates: u64,
}

impl Curriculum {
    /// At its start.
    pub fn new(settings: CurriculumSettings) -> Self {
        Self {
            settings,
            randomization: settings.randomization.start,
            difficulty: settings.difficulty.start,
            recent: VecDeque::new(),
            updates: 0,
        }
    }

    /// Takes over how far a curriculum with other settings was.
    pub fn resume_from(&mut self, other: &Self) {
        let within = |ramp: Ramp, scale: f64| scale.clamp(ramp.start, ramp.end);
        self.randomization = within(self.settings.randomization, other.randomization);
        self.difficulty = within(self.settings.difficulty, other.difficulty);
        self.updates = other.updates;
    }

    /// Scale of the domain randomisation.
    pub fn randomization(&self) -> f64 {
        self.randomization
    }

    /// Scale of the goals' amplitude and speed.
    pub fn difficulty(&self) -> f64 {
        self.difficulty
    }

    /// Mean length of the last episodes, as a share of the longest possible; none before the first has ended.
    pub fn mean_length(&self) -> Option<f64> {
        let total: f64 = self.recent.iter().map(|episode| episode.length).sum();
        (!self.recent.is_empty()).then(|| total / self.recent.len() as f64)
    }

    /// Share of the last episodes that the robot survived; none before the first has ended.
    pub fn survival(&self) -> Option<f64> {
        let survived = self.recent.iter().filter(|e| e.survived).count();
        (!self.recent.is_empty()).then(|| survived as f64 / self.recent.len() as f64)
    }

    /// Takes in the episodes that ended in one rollout, and moves the scales when it is time.
    pub fn update(&mut self, ended: impl IntoIterator<Item = Episode>) {
        self.recent.extend(ended);
        let surplus = self.recent.len().saturating_sub(self.settings.window);
        self.recent.drain(..surplus);
        self.updates += 1;
        let enough = 2 * self.recent.len() >= self.settings.window;
        if !enough || !self.updates.is_multiple_of(self.settings.interval) {
            return;
        }
        let length = self.mean_length().unwrap_or(0.0);
        let direction = if length > self.settings.rise_above {
            1.0
        } else if length < self.settings.fall_below {
            -1.0
        } else {
            0.0
        };
        let settings = &self.settings;
        self.randomization = settings.randomization.moved(self.randomization, direction);
        self.difficulty = settings.difficulty.moved(self.difficulty, direction);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(length: f64, updates: usize, curriculum: &mut Curriculum) {
        let episode = Episode {
            length,
            survived: length == 1.0,
        };
        for _ in 0..updates {
            curriculum.update([episode; 100]);
        }
    }

    #[test]
    fn scales_rise_with_long_episodes_fall_with_short_ones_and_stay_in_range() {
        let mut curriculum = Curriculum::new(CurriculumSettings::default());
        assert_eq!(curriculum.survival(), None);
        run(1.0, 4, &mut curriculum);
        assert_eq!(curriculum.randomization(), 0.1);
        run(1.0, 1, &mut curriculum);
        assert!((curriculum.randomization() - 0.15).abs() < 1e-12);
        assert!((curriculum.difficulty() - 0.82).abs() < 1e-12);
        assert_eq!(curriculum.survival(), Some(1.0));
        run(0.6, 10, &mut curriculum);
        assert!(
            (curriculum.randomization() - 0.15).abs() < 1e-12,
            "between the bounds"
        );
        run(0.1, 5, &mut curriculum);
        assert!((curriculum.randomization() - 0.13).abs() < 1e-12);
        run(0.1, 50, &mut curriculum);
        assert_eq!(
            (curriculum.randomization(), curriculum.difficulty()),
            (0.1, 0.8)
        );
        run(1.0, 500, &mut curriculum);
        assert_eq!(
            (curriculum.randomization(), curriculum.difficulty()),
            (1.0, 2.0)
        );
        let mut other = Curriculum::new(CurriculumSettings {
            difficulty: Ramp {
                end: 1.5,
                ..CurriculumSettings::default().difficulty
            },
            ..CurriculumSettings::default()
        });
        other.resume_from(&curriculum);
        assert_eq!((other.randomization(), other.difficulty()), (1.0, 1.5));
    }

    #[test]
    fn few_episodes_move_nothing() {
        let mut curriculum = Curriculum::new(CurriculumSettings::default());
        for _ in 0..20 {
            curriculum.update([Episode {
                length: 1.0,
                survived: true,
            }]);
        }
        assert_eq!(curriculum.randomization(), 0.1);
        assert_eq!(curriculum.mean_length(), Some(1.0));
    }
}

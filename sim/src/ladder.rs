//! The difficulty ladder: how a controller does as one thing at a time gets harder than it was trained for.

use std::fmt;

use emp_models::controller::Controller;
use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use crate::evaluation::{Evaluation, EvaluationSettings, Progress, evaluate};
use crate::goals::GoalClip;
use crate::metrics::{Interval, LIST, Metric, Metrics, headings};
use crate::pushes::Kick;
use crate::{Pool, SimError};

/// Scales of amplitude and speed.
const SCALES: [f64; 6] = [0.6, 0.8, 1.0, 1.2, 1.4, 1.6];
/// Loads, as shares of the largest in training: 3 kg in each hand of a robot of 60 kg at the top.
const LOADS: [f64; 4] = [0.0, 0.4, 0.8, 1.2];
/// Speeds of pushes, m/s.
const PUSHES: [f64; 5] = [0.0, 0.2, 0.4, 0.6, 0.8];
/// Time between pushes, seconds: a clip of 200 frames has one to three.
const PUSH_INTERVAL: f64 = 1.5;

/// What gets harder.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// The goals' distance from the default pose; no unit.
    Amplitude,
    /// The speed of the motion; no unit.
    Speed,
    /// The mass in each hand, kg.
    HandLoad,
    /// The speed of pushes, m/s.
    Push,
}

impl Axis {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Amplitude, Self::Speed, Self::HandLoad, Self::Push];

    /// The axis as a table names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Amplitude => "amplitude",
            Self::Speed => "speed",
            Self::HandLoad => "hand_load",
            Self::Push => "push",
        }
    }
}

/// One step of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rung {
    /// What gets harder.
    pub axis: Axis,
    /// How hard it is, in the axis's unit.
    pub value: f64,
}

impl Rung {
    /// The ladder for `robot`: amplitude and speed from 0.6 to 1.6, hand load to 3 kg (scaled to the robot's mass), pushes
    /// to 0.8 m/s.
    pub fn all(robot: &Robot) -> Vec<Self> {
        let load = robot.added_masses().hand[1];
        let values = |axis| match axis {
            Axis::Amplitude | Axis::Speed => SCALES.to_vec(),
            Axis::HandLoad => LOADS.map(|share| share * load).to_vec(),
            Axis::Push => PUSHES.to_vec(),
        };
        let rungs = |axis| {
            values(axis)
                .into_iter()
                .map(move |value| Self { axis, value })
        };
        Axis::ALL.into_iter().flat_map(rungs).collect()
    }

    /// The conditions on this rung: those of `base`, with one thing changed.
    #[must_use]
    pub fn settings(self, base: &EvaluationSettings) -> EvaluationSettings {
        let mut settings = *base;
        match self.axis {
            Axis::Amplitude => settings.amplitude = self.value,
            Axis::Speed => settings.speed = self.value,
            Axis::HandLoad => settings.hand_load = Some([self.value; 2]),
            Axis::Push => {
                settings.push = Some(Kick {
                    speed: self.value,
                    interval: PUSH_INTERVAL,
                });
            }
        }
        settings
    }
}

/// One controller on one rung.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LadderRow {
    /// Name of the controller.
    pub controller: String,
    /// What is harder, and how hard.
    #[serde(flatten)]
    pub rung: Rung,
    /// Number of episodes.
    pub episodes: usize,
    /// Number of motions that they play: what the intervals rest on.
    pub motions: usize,
    /// The metrics.
    #[serde(flatten)]
    pub metrics: Metrics<Interval>,
}

/// What climbing came to: one row for each controller and rung. As JSON a list of objects; [`Display`](fmt::Display) writes a
/// table in Markdown.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Ladder {
    /// The rows, controller by controller in the order of the rungs.
    pub rows: Vec<LadderRow>,
}

/// Evaluates each of `controllers` on each of `rungs`, with the same clips and seeds; `base` are the conditions but for what
/// a rung changes. `row` is called with each row as it comes. If `progress` cancels, the rows that are complete are the result.
///
/// # Errors
/// As of [`evaluate`].
pub fn climb(
    pool: &Pool,
    controllers: &[Controller],
    clips: &[GoalClip],
    base: &EvaluationSettings,
    rungs: &[Rung],
    progress: &mut dyn Progress,
    mut row: impl FnMut(&LadderRow),
) -> Result<Ladder, SimError> {
    let mut ladder = Ladder::default();
    for controller in controllers {
        // Every axis passes through conditions where another one is too: those are run once.
        let mut known: Vec<Evaluation> = Vec::new();
        for rung in rungs {
            let settings = rung.settings(base);
            let found = known.iter().position(|known| known.settings == settings);
            let index = match found {
                Some(index) => index,
                None => {
                    let evaluation = evaluate(pool, controller, clips, &settings, progress)?;
                    if !evaluation.complete {
                        return Ok(ladder);
                    }
                    known.push(evaluation);
                    known.len() - 1
                }
            };
            ladder.rows.push(LadderRow {
                controller: controller.name().to_owned(),
                rung: *rung,
                episodes: known[index].all.episodes,
                motions: known[index].all.motions,
                metrics: known[index].all.metrics,
            });
            ladder.rows.last().into_iter().for_each(&mut row);
        }
    }
    Ok(ladder)
}

impl Ladder {
    /// The rows as CSV: controller, axis, value, episodes, motions, then each metric's mean, low and high end.
    pub fn csv(&self) -> String {
        let columns = LIST.map(|Metric { name, .. }| format!("{name},{name}_low,{name}_high"));
        let columns = columns.join(",");
        let mut csv = format!("controller,axis,value,episodes,motions,{columns}\n");
        for row in &self.rows {
            let numbers = row.metrics.array();
            let numbers =
                numbers.map(|metric| format!("{},{},{}", metric.mean, metric.low, metric.high));
            // A controller's parameters have commas.
            csv += &format!(
                "\"{}\",{},{},{},{},{}\n",
                row.controller,
                row.rung.axis.name(),
                row.rung.value,
                row.episodes,
                row.motions,
                numbers.join(",")
            );
        }
        csv
    }
}

impl fmt::Display for Ladder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let headings = headings();
        writeln!(
            f,
            "| controller | axis | value | clips of motions | {} |",
            headings.join(" | ")
        )?;
        writeln!(f, "|---|---|---|---|{}", "---|".repeat(headings.len()))?;
        for row in &self.rows {
            writeln!(
                f,
                "| {} | {} | {:.2} | {} of {} | {} |",
                row.controller,
                row.rung.axis.name(),
                row.rung.value,
                row.episodes,
                row.motions,
                row.metrics.cells().join(" | ")
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::Priority;
    use crate::evaluation::EpisodeResult;
    use crate::testing::{emp27, goal_library, policy};

    #[test]
    fn the_ladder_spans_what_it_says() {
        let robot = emp27();
        let rungs = Rung::all(&robot);
        let span = |axis| {
            let values = rungs.iter().filter(|rung| rung.axis == axis);
            let values: Vec<f64> = values.map(|rung| rung.value).collect();
            (values[0], values[values.len() - 1])
        };
        assert_eq!(span(Axis::Amplitude), (0.6, 1.6));
        assert_eq!(span(Axis::Speed), (0.6, 1.6));
        assert_eq!(span(Axis::HandLoad), (0.0, 3.0));
        assert_eq!(span(Axis::Push), (0.0, 0.8));
        let base = EvaluationSettings::default();
        for rung in rungs {
            rung.settings(&base).check(&robot).unwrap();
        }
    }

    /// Counts episodes, and stops after some.
    struct Counter {
        ended: usize,
        limit: usize,
    }

    impl Progress for Counter {
        fn finished(&mut self, _: &EpisodeResult) {
            self.ended += 1;
        }

        fn is_cancelled(&self) -> bool {
            self.ended >= self.limit
        }
    }

    #[test]
    fn rungs_are_run_by_controller_and_equal_ones_once() {
        let robot = emp27();
        let pool = Pool::new(&robot, 2, Priority::Normal).unwrap();
        let library = goal_library(&robot);
        let clips: Vec<_> = (0..3).map(|seed| library.sample(seed, 1.0, 20)).collect();
        let controller =
            |filter| Controller::by_name(filter, &Arc::new(policy(&robot)), None).unwrap();
        let controllers = ["decoupled", "low-pass:cutoff=3,order=2"].map(controller);
        let rung = |axis, value| Rung { axis, value };
        let rungs = [
            rung(Axis::Amplitude, 1.0),
            rung(Axis::Amplitude, 1.4),
            rung(Axis::Speed, 1.0),
            rung(Axis::Push, 0.8),
        ];
        let base = EvaluationSettings::default();
        let mut counter = Counter {
            ended: 0,
            limit: usize::MAX,
        };
        let mut told = Vec::new();
        let ladder = climb(
            &pool,
            &controllers,
            &clips,
            &base,
            &rungs,
            &mut counter,
            |row| {
                told.push(row.clone());
            },
        )
        .unwrap();
        // Amplitude 1 and speed 1 are the same conditions.
        assert_eq!((counter.ended, ladder.rows.len()), (2 * 3 * 3, 8));
        assert_eq!(told, ladder.rows);
        assert_eq!(ladder.rows[0].metrics, ladder.rows[2].metrics);
        assert_ne!(ladder.rows[0].metrics, ladder.rows[1].metrics);
        assert_ne!(ladder.rows[0].metrics, ladder.rows[4].metrics);

        let csv = ladder.csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert!(
            lines[0].starts_with("controller,axis,value,episodes,motions,suc,suc_low,suc_high,mjp")
        );
        assert!(
            lines[4].starts_with("\"decoupled\",push,0.8,3,"),
            "{}",
            lines[4]
        );
        assert!(lines[5].starts_with("\"low-pass:cutoff=3,order=2\",amplitude,1,3,"));
        assert_eq!(lines[1].split(',').count(), lines[0].split(',').count());
        assert_eq!(ladder.to_string().lines().count(), 10);
        let json = serde_json::to_value(&ladder).unwrap();
        assert_eq!(json[3]["axis"], "push");
        assert!(json[3]["suc"]["mean"].is_f64());

        let mut counter = Counter { ended: 0, limit: 6 };
        let part = climb(
            &pool,
            &controllers,
            &clips,
            &base,
            &rungs,
            &mut counter,
            |_| {},
        )
        .unwrap();
        assert_eq!(part.rows, ladder.rows[..3]);
    }
}

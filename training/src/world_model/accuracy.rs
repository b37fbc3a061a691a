//! How well a world model predicts, beside guesses that need no learning.

use std::fmt;

use anyhow::{Context as _, Result};
use candle_core::{Device, Tensor};
use emp_models::{observation::ObservationLayout, world_model::WorldModel};
use emp_sim::tracking::TrackingEnvironments;
use rayon::prelude::*;
use serde::Serialize;

use super::{
    replay::{Replay, Start},
    sequences::Sequences,
};
use crate::rows::tensor;

/// How far ahead is predicted, control periods.
const AHEAD: [usize; 2] = [1, 10];

/// The last seconds before a fall count as near it.
const NEAR: f64 = 1.5;

/// One start of so many is predicted from.
const EVERY: usize = 4;

/// Sequences that are predicted together. Fixed: the last bits of an answer may depend on the size of its batch.
const ROWS: usize = 64;

/// Ways to tell what comes.
const GUESSES: [&str; 3] = ["world model", "constant velocity", "hold position"];

/// Errors of predictions from held-out states. As JSON one object; [`Display`](fmt::Display) writes a table in Markdown.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Accuracy {
    /// Name of the robot.
    pub robot: String,
    /// Sequences that were predicted.
    pub sequences: usize,
    /// Those of them that end near a fall.
    pub near_falls: usize,
    /// Falls in the motion.
    pub falls: usize,
    /// The errors.
    pub rows: Vec<Row>,
}

/// Root mean square errors of one way to predict.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Who predicts.
    pub guess: &'static str,
    /// Whether only sequences that end near a fall count.
    pub near_falls: bool,
    /// Control periods ahead.
    pub ahead: usize,
    /// Error of roll and pitch, rad.
    pub tilt: f64,
    /// Error of the joint positions, rad.
    pub joints: f64,
}

/// Sums of squared errors.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    tilt: f64,
    joints: f64,
    count: usize,
}

/// Errors of each guess at each distance, over all sequences and over those near falls.
type Table = [[[Sums; 2]; AHEAD.len()]; GUESSES.len()];

/// Plays `frames` control periods with the goals that are asked for, and predicts from every fourth state, with the actions and
/// goals that followed.
///
/// # Errors
/// When the policy fails, or no robot stands long enough.
pub fn measure(
    model: &WorldModel,
    environments: &mut TrackingEnvironments,
    frames: usize,
    threads: &rayon::ThreadPool,
) -> Result<Accuracy> {
    let longest = AHEAD[AHEAD.len() - 1];
    let mut replay = Replay::new(*environments.layout(), usize::MAX);
    for _ in 0..frames {
        let goals = environments.goals().to_vec();
        replay.step(environments, &goals)?;
    }
    replay.cut();
    let starts = replay.starts(longest, f64::INFINITY);
    let last = starts.iter().filter(|s| s.until_fall == Some(longest));
    let falls = last.count();
    let starts: Vec<Start> = starts.into_iter().step_by(EVERY).collect();
    let near = (NEAR * environments.robot().control_rate_hz()) as usize;
    let tables = threads.install(|| {
        let batches = starts.par_chunks(ROWS).map(|starts| {
            let sequences = replay.sequences(starts, longest);
            predict(model, &sequences, |row, ahead| {
                starts[row]
                    .until_fall
                    .is_some_and(|left| left <= near + ahead)
            })
        });
        batches.collect::<candle_core::Result<Vec<_>>>()
    })?;
    let table = tables.into_iter().reduce(added);
    let table = table.context("no robot stands long enough to predict what it does")?;
    Ok(Accuracy {
        robot: environments.robot().name().to_owned(),
        sequences: table[0][AHEAD.len() - 1][0].count,
        near_falls: table[0][AHEAD.len() - 1][1].count,
        falls,
        rows: rows(&table),
    })
}

/// Predicts sequences; `is_near` says of a row and a distance whether that state is near a fall.
fn predict(
    model: &WorldModel,
    sequences: &Sequences,
    is_near: impl Fn(usize, usize) -> bool,
) -> candle_core::Result<Table> {
    let layout = &model.config().observation;
    let outputs = model.config().outputs();
    let mut stacks = tensor(&sequences.stacks, layout.width())?;
    let (now, change) = newest(model, &stacks)?;
    let mut table = Table::default();
    for (index, period) in sequences.periods.iter().enumerate() {
        let actions = tensor(&period.actions, layout.last_action().len())?;
        let predicted = model.forward(&stacks, &actions)?;
        if let Some(at) = AHEAD.iter().position(|&ahead| ahead == index + 1) {
            let moved = (&now + (&change * (index + 1) as f64)?)?;
            for (table, guess) in table.iter_mut().zip([&predicted, &moved, &now]) {
                let errors = (guess - tensor(&period.next, outputs)?)?.sqr()?;
                let errors = errors.flatten_all()?.to_vec1::<f32>()?;
                for (row, errors) in errors.chunks_exact(outputs).enumerate() {
                    let sums = Sums::of(errors, layout);
                    table[at][0].add(sums);
                    if is_near(row, index + 1) {
                        table[at][1].add(sums);
                    }
                }
            }
        }
        let goals = tensor(&period.goals, layout.goal().len())?;
        stacks = model.advance(&stacks, &actions, &predicted, &goals)?;
    }
    Ok(table)
}

/// What the newest frames of stacks say, and by how much it differs from the frames before.
fn newest(model: &WorldModel, stacks: &Tensor) -> candle_core::Result<(Tensor, Tensor)> {
    let layout = &model.config().observation;
    let (rows, width) = (stacks.dim(0)?, layout.frame_width());
    let now = model.config().newest(stacks)?;
    let oldest = Tensor::zeros((rows, width), stacks.dtype(), &Device::Cpu)?;
    let earlier = Tensor::cat(&[&oldest, &stacks.narrow(1, 0, layout.width() - width)?], 1)?;
    let change = (&now - model.config().newest(&earlier)?)?;
    Ok((now, change))
}

impl Sums {
    /// Of the squared errors of one prediction.
    fn of(errors: &[f32], layout: &ObservationLayout) -> Self {
        let (joints, orientation) = errors.split_at(layout.joint_positions().len());
        let mean = |errors: &[f32]| {
            let sum: f64 = errors.iter().map(|&error| f64::from(error)).sum();
            sum / errors.len() as f64
        };
        Self {
            tilt: mean(&orientation[..2]),
            joints: mean(joints),
            count: 1,
        }
    }

    fn add(&mut self, other: Self) {
        self.tilt += other.tilt;
        self.joints += other.joints;
        self.count += other.count;
    }
}

fn added(mut sum: Table, part: Table) -> Table {
    let sums = sum.iter_mut().flatten().flatten();
    for (sum, part) in sums.zip(part.into_iter().flatten().flatten()) {
        sum.add(part);
    }
    sum
}

fn rows(table: &Table) -> Vec<Row> {
    let mut rows = Vec::new();
    for (near, near_falls) in [false, true].into_iter().enumerate() {
        for (guess, table) in GUESSES.into_iter().zip(table) {
            for (ahead, sums) in AHEAD.into_iter().zip(table) {
                let sums = sums[near];
                let error = |sum: f64| (sum / sums.count.max(1) as f64).sqrt();
                rows.push(Row {
                    guess,
                    near_falls,
                    ahead,
                    tilt: error(sums.tilt),
                    joints: error(sums.joints),
                });
            }
        }
    }
    rows
}

impl fmt::Display for Accuracy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "World model of {}: root mean square errors in rad, {} sequences with {} falls; near falls ({} of them): the moment \
             that is predicted lies in the last {NEAR} s before one.\n",
            self.robot, self.sequences, self.falls, self.near_falls
        )?;
        write!(f, "| prediction |")?;
        for frames in ["all", "near falls"] {
            for ahead in AHEAD {
                write!(
                    f,
                    " roll, pitch, {ahead} ahead, {frames} | joints, {ahead} ahead, {frames} |"
                )?;
            }
        }
        writeln!(f, "\n|---|{}", "---|".repeat(4 * AHEAD.len()))?;
        for guess in GUESSES {
            write!(f, "| {guess} |")?;
            for row in self.rows.iter().filter(|row| row.guess == guess) {
                write!(f, " {:.4} | {:.4} |", row.tilt, row.joints)?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use candle_core::DType;
    use candle_nn::VarBuilder;
    use emp_models::world_model::{Scaling, WorldModelConfig};
    use emp_sim::tracking::TrackingSettings;

    use super::*;
    use crate::world_model::{
        sequences::Period,
        testing::{environments, robot, threads},
    };

    fn zero() -> WorldModel {
        let config = WorldModelConfig::new(&robot(), vec![4]);
        let scaling = Scaling::identity(&config);
        let vars = VarBuilder::zeros(DType::F32, &Device::Cpu);
        WorldModel::new(config, scaling, &vars).unwrap()
    }

    #[test]
    fn a_model_that_predicts_no_change_holds_the_position() {
        let settings = TrackingSettings {
            pushed: 1.0,
            push_speed: [3.0, 3.0],
            push_interval: 0.6,
            ..TrackingSettings::default()
        };
        let measured = |count: usize| {
            let mut environments = environments(4, settings);
            measure(&zero(), &mut environments, 120, &threads(count)).unwrap()
        };
        let accuracy = measured(2);
        assert_eq!(accuracy, measured(1));
        let of = |guess: &str| -> Vec<[f64; 2]> {
            let rows = accuracy.rows.iter().filter(|row| row.guess == guess);
            rows.map(|row| [row.tilt, row.joints]).collect()
        };
        assert_eq!(of("world model"), of("hold position"));
        assert_ne!(of("world model"), of("constant velocity"));
        assert!(accuracy.falls >= 3 && accuracy.near_falls >= 10);
        assert!(accuracy.near_falls < accuracy.sequences);
        let hold = of("hold position");
        assert_eq!(hold.len(), 4);
        let [one, ten, near_one, near_ten] = [0, 1, 2, 3].map(|i| hold[i][0]);
        assert!(one < ten && one < near_one && ten < near_ten);
        assert!(accuracy.to_string().contains("| hold position |"));
    }

    #[test]
    fn a_constant_velocity_is_guessed_from_two_frames() {
        let layout = zero().config().observation;
        // Frame t is t everywhere; it goes on like that.
        let sequences = Sequences {
            stacks: (0..layout.width())
                .map(|i| (i / layout.frame_width()) as f32)
                .collect(),
            periods: (15..25)
                .map(|t| Period {
                    actions: vec![t as f32; 12],
                    next: vec![t as f32; 30],
                    goals: vec![t as f32; 15],
                })
                .collect(),
        };
        let table = predict(&zero(), &sequences, |_, ahead| ahead == 10).unwrap();
        let [_, moved, held] = table;
        for (sums, ahead) in held.iter().zip([1.0, 10.0]) {
            assert_eq!(
                (sums[0].tilt, sums[0].joints),
                (ahead * ahead, ahead * ahead)
            );
        }
        assert!(
            moved
                .iter()
                .all(|sums| sums[0].tilt + sums[0].joints < 1e-9)
        );
        assert_eq!([held[0][1].count, held[1][1].count], [0, 1]);
    }
}

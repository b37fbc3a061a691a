//! How well a trained policy stands: the paper's metrics on clips that it was not trained on, and the difficulty ladder.

use std::{fmt, path::Path};

use anyhow::{Context as _, Result, anyhow, ensure};
use emp_models::controller::Controller;
use emp_motion::atomic;
use emp_sim::{
    Pool,
    evaluation::{
        Evaluation, EvaluationSettings, Failure, Progress, RandomizationLevel, Scores, evaluate,
    },
    goals::{GoalClip, GoalLibrary, Spread},
    ladder::{Axis, Ladder, Rung, climb},
    metrics::headings,
};
use plotters::{
    prelude::{
        ChartBuilder, Circle, Color as _, IntoDrawingArea as _, LineSeries, Palette as _,
        Palette99, PathElement, SVGBackend, SeriesLabelPosition, WHITE,
    },
    style::{BLACK, IntoFont as _},
};
use serde::Serialize;

use crate::sets::{Basis, ClipGroup, MotionSet};

/// Frames of a clip, as in the paper.
pub const FRAMES: usize = 200;

/// Amplitude of the second trial.
const AMPLITUDE: f64 = 1.2;

/// Episodes of the trial under full randomisation, and their frames: ten seconds.
const RANDOMIZED: (u64, usize) = (500, 500);

/// What the motion of that trial is called.
const MIXED: &str = "random pieces of all";

/// Failures of a trial that the text lists.
const LISTED: usize = 12;

/// Size of one panel of the ladder's picture, pixels.
const PANEL: (u32, u32) = (480, 360);

/// One controller under one trial's conditions, on one kind of motion.
#[derive(Debug, Serialize)]
pub struct Trial {
    /// What the conditions are.
    name: &'static str,
    /// The kind of motion.
    group: &'static str,
    /// What came of it.
    #[serde(flatten)]
    evaluation: Evaluation,
}

/// Every trial of every controller. [`Display`](fmt::Display) writes tables in Markdown.
#[derive(Debug, Serialize)]
pub struct Report {
    /// What it rests on.
    basis: Basis,
    /// Controller by controller.
    trials: Vec<Trial>,
}

/// Runs each controller on clips of `set` as they are and with a larger amplitude, and for ten seconds at a time on random
/// pieces of all of them under full randomisation with pushes.
///
/// # Errors
/// When there is no clip, or a policy fails.
pub fn report(
    pool: &Pool,
    controllers: &[Controller],
    groups: &[ClipGroup],
    set: MotionSet,
    progress: &mut dyn Progress,
) -> Result<Report> {
    let first = controllers.first().context("expected a controller")?;
    let seed = set.seed();
    let clips = groups.iter().flat_map(|group| group.clips.clone());
    let library = GoalLibrary::new(first.policy().robot(), clips.collect())?;
    let (episodes, frames) = RANDOMIZED;
    let long: Vec<GoalClip> = (0..episodes)
        .map(|episode| library.sample(seed.wrapping_add(episode), 1.0, frames))
        .collect();
    let nominal = EvaluationSettings {
        seed,
        ..EvaluationSettings::default()
    };
    let wide = EvaluationSettings {
        amplitude: AMPLITUDE,
        ..nominal
    };
    let full = EvaluationSettings {
        conditions: RandomizationLevel::Full,
        ..nominal
    };
    let groups_under = |name, settings| {
        let trial = move |group: &'_ ClipGroup| (name, group.name, group.clips.clone(), settings);
        groups.iter().map(trial)
    };
    let mut trials: Vec<_> = groups_under("nominal", nominal).collect();
    trials.extend(groups_under("amplitude × 1.2", wide));
    trials.push(("full randomisation, 10 s", MIXED, long, full));
    let mut rows = Vec::new();
    for controller in controllers {
        for (name, group, clips, settings) in &trials {
            let evaluation = evaluate(pool, controller, clips, settings, progress)?;
            ensure!(evaluation.complete, "interrupted in the trial {name:?}");
            rows.push(Trial {
                name,
                group,
                evaluation,
            });
        }
    }
    Ok(Report {
        basis: Basis::new(set, groups),
        trials: rows,
    })
}

/// Runs the controllers up the difficulty ladder.
///
/// # Errors
/// As [`report`].
pub fn ladder(
    pool: &Pool,
    controllers: &[Controller],
    clips: &[GoalClip],
    seed: u64,
    progress: &mut dyn Progress,
) -> Result<Ladder> {
    let first = controllers.first().context("expected a controller")?;
    let rungs = Rung::all(first.policy().robot());
    let base = EvaluationSettings {
        seed,
        ..EvaluationSettings::default()
    };
    let ladder = climb(pool, controllers, clips, &base, &rungs, progress, |_| {})?;
    ensure!(
        ladder.rows.len() == controllers.len() * rungs.len(),
        "interrupted on the ladder"
    );
    Ok(ladder)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let headings = headings();
        writeln!(f, "On {}.\n", self.basis)?;
        writeln!(
            f,
            "| controller | conditions | clips of motions | {} |",
            headings.join(" | ")
        )?;
        writeln!(f, "|---|---|---|{}", "---|".repeat(headings.len()))?;
        for Trial {
            name,
            group,
            evaluation,
        } in &self.trials
        {
            let Scores {
                episodes,
                motions,
                metrics,
                ..
            } = &evaluation.all;
            writeln!(
                f,
                "| {} | {name} | {group}: {episodes} of {motions} | {} |",
                evaluation.controller,
                metrics.cells().join(" | ")
            )?;
        }
        self.write_goals(f)?;
        self.write_failures(f)
    }
}

impl Report {
    /// How hard the clips are: the same for every controller.
    fn write_goals(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "\n| conditions, motion | fastest joint rad/s, mean / p95 | faster hand m/s | farthest joint from the default pose, rad |"
        )?;
        writeln!(f, "|---|---|---|---|")?;
        let first = self
            .trials
            .first()
            .map(|trial| &trial.evaluation.controller);
        for Trial {
            name,
            group,
            evaluation,
        } in &self.trials
        {
            let is_first = Some(&evaluation.controller) == first;
            if let Some(goals) = evaluation.all.goals.filter(|_| is_first) {
                let spreads = [goals.joint_speed, goals.hand_speed, goals.amplitude];
                let spreads = spreads.map(|Spread { mean, p95 }| format!("{mean:.2} / {p95:.2}"));
                writeln!(f, "| {name}, {group} | {} |", spreads.join(" | "))?;
            }
        }
        writeln!(f)
    }

    fn write_failures(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Trial {
            name,
            group,
            evaluation,
        } in &self.trials
        {
            let failures = &evaluation.failures;
            if !failures.is_empty() {
                writeln!(f, "{} {name}, {group}:", evaluation.controller)?;
            }
            for Failure {
                clip, time, reason, ..
            } in failures.iter().take(LISTED)
            {
                writeln!(f, "  {clip} at {time:.2} s: {reason}")?;
            }
            if let Some(more) = failures.len().checked_sub(LISTED + 1) {
                writeln!(f, "  and {} more, all in --json", more + 1)?;
            }
        }
        Ok(())
    }
}

/// Draws success along each axis of the ladder, one line a controller, with the intervals' ends.
///
/// # Errors
/// When the picture cannot be drawn or written.
pub fn draw_ladder(ladder: &Ladder, robot: &str, out: &Path) -> Result<()> {
    let mut controllers: Vec<&str> = Vec::new();
    for row in &ladder.rows {
        if !controllers.contains(&row.controller.as_str()) {
            controllers.push(&row.controller);
        }
    }
    let mut svg = String::new();
    {
        let size = (2 * PANEL.0, 2 * PANEL.1);
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        for (panel, axis) in area.split_evenly((2, 2)).iter().zip(Axis::ALL) {
            let rows = || ladder.rows.iter().filter(|row| row.rung.axis == axis);
            let values = || rows().map(|row| row.rung.value);
            let span = values().fold(f64::INFINITY, f64::min)..values().fold(0.0, f64::max);
            let mut chart = ChartBuilder::on(panel)
                .caption(
                    format!("{robot}: success along {}", axis.name().replace('_', " ")),
                    ("sans-serif", 18).into_font(),
                )
                .margin(12)
                .x_label_area_size(36)
                .y_label_area_size(48)
                .build_cartesian_2d(span, 0.0..1.02)
                .map_err(failed)?;
            chart
                .configure_mesh()
                .x_desc(unit(axis))
                .y_desc("SUC")
                .max_light_lines(0)
                .draw()
                .map_err(failed)?;
            for (index, name) in controllers.iter().enumerate() {
                let style = Palette99::pick(index).to_rgba().stroke_width(2);
                let of = || rows().filter(|row| row.controller == *name);
                let line = of().map(|row| (row.rung.value, row.metrics.suc.mean));
                chart
                    .draw_series(LineSeries::new(line.clone(), style))
                    .map_err(failed)?
                    .label(*name)
                    .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
                let dots = line.map(|point| Circle::new(point, 3, style.filled()));
                chart.draw_series(dots).map_err(failed)?;
                let intervals = of().map(|row| {
                    let (x, suc) = (row.rung.value, row.metrics.suc);
                    PathElement::new([(x, suc.low), (x, suc.high)], style.stroke_width(1))
                });
                chart.draw_series(intervals).map_err(failed)?;
            }
            chart
                .configure_series_labels()
                .position(SeriesLabelPosition::LowerLeft)
                .background_style(WHITE.mix(0.8))
                .border_style(BLACK.mix(0.3))
                .draw()
                .map_err(failed)?;
        }
        area.present().map_err(failed)?;
    }
    atomic::write(out, svg.as_bytes()).with_context(|| format!("writing {}", out.display()))
}

fn unit(axis: Axis) -> &'static str {
    match axis {
        Axis::Amplitude => "factor on the distance from the default pose",
        Axis::Speed => "factor on the speed of the motion",
        Axis::HandLoad => "kg in each hand",
        Axis::Push => "m/s, every 1.5 s",
    }
}

fn failed(error: impl fmt::Display) -> anyhow::Error {
    anyhow!("drawing the ladder: {error}")
}

#[cfg(test)]
mod tests {
    use emp_sim::{
        ladder::LadderRow,
        metrics::{Interval, METRICS, Metrics},
    };

    use super::*;

    #[test]
    fn the_ladder_is_drawn_with_its_axes_and_controllers() {
        let interval = |mean: f64| Interval {
            mean,
            low: 0.9 * mean,
            high: mean,
        };
        let row = |controller: &str, axis, value: f64| LadderRow {
            controller: controller.to_owned(),
            rung: Rung { axis, value },
            episodes: 10,
            motions: 10,
            metrics: Metrics::from([interval(1.0 / (1.0 + value)); METRICS]),
        };
        let rows = Axis::ALL.into_iter().flat_map(|axis| {
            let values = [0.5, 1.0, 1.5].into_iter();
            values.flat_map(move |value| {
                ["decoupled", "soft-knee"].map(|name| row(name, axis, value))
            })
        });
        let ladder = Ladder {
            rows: rows.collect(),
        };
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("ladder.svg");
        draw_ladder(&ladder, "emp27", &out).unwrap();
        let svg = std::fs::read_to_string(out).unwrap();
        for text in [
            "emp27: success along hand load",
            "soft-knee",
            "kg in each hand",
            "1.5 s",
        ] {
            assert!(svg.contains(text), "{text}");
        }
    }
}

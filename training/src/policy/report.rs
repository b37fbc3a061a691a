//! How well a trained policy stands: the paper's metrics on clips that it was not trained on, and the difficulty ladder.

use std::{fmt, path::Path};

use anyhow::{Context as _, Result, anyhow, ensure};
use emp_models::controller::Controller;
use emp_motion::atomic;
use emp_sim::{
    Pool,
    evaluation::{Conditions, Evaluation, EvaluationSettings, Failure, Progress, Scores, evaluate},
    goals::{GoalClip, GoalLibrary},
    ladder::{Axis, Ladder, Rung, climb},
};
use plotters::{
    prelude::{
        ChartBuilder, Circle, Color as _, IntoDrawingArea as _, LineSeries, Palette as _,
        Palette99, PathElement, SVGBackend, SeriesLabelPosition, WHITE,
    },
    style::{BLACK, IntoFont as _},
};
use serde::Serialize;

/// Frames of a clip, as in the paper.
pub const FRAMES: usize = 200;

/// Amplitude of the second trial.
const AMPLITUDE: f64 = 1.2;

/// Episodes of the trial under full randomisation, and their frames: ten seconds.
const RANDOMIZED: (u64, usize) = (500, 500);

/// Failures of a trial that the text lists.
const LISTED: usize = 12;

/// Size of one panel of the ladder's picture, pixels.
const PANEL: (u32, u32) = (480, 360);

/// One controller under one trial's conditions.
#[derive(Debug, Serialize)]
pub struct Trial {
    /// What the conditions are.
    name: &'static str,
    /// What came of it.
    #[serde(flatten)]
    evaluation: Evaluation,
}

/// Every trial of every controller. As JSON a list of objects; [`Display`](fmt::Display) writes a table in Markdown.
#[derive(Debug, Serialize)]
#[serde(transparent)]
pub struct Report(Vec<Trial>);

/// Runs each controller on `clips` as they are and with a larger amplitude, and for ten seconds at a time on random pieces of
/// the clips under full randomisation with pushes.
///
/// # Errors
/// When there is no clip, or a policy fails.
pub fn report(
    pool: &Pool,
    controllers: &[Controller],
    clips: &[GoalClip],
    seed: u64,
    progress: &mut dyn Progress,
) -> Result<Report> {
    let first = controllers.first().context("expected a controller")?;
    let library = GoalLibrary::new(first.policy().robot(), clips.to_vec())?;
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
        conditions: Conditions::Full,
        ..nominal
    };
    let trials = [
        ("nominal", clips, nominal),
        ("amplitude × 1.2", clips, wide),
        ("full randomisation, 10 s", &long, full),
    ];
    let mut rows = Vec::new();
    for controller in controllers {
        for (name, clips, settings) in &trials {
            let evaluation = evaluate(pool, controller, clips, settings, progress)?;
            ensure!(evaluation.complete, "interrupted in the trial {name:?}");
            rows.push(Trial { name, evaluation });
        }
    }
    Ok(Report(rows))
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
        writeln!(
            f,
            "| controller | conditions | clips | SUC (95 %) | MJP | MSC N | self-collision | MBV | MBA | MBO | MUS |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|")?;
        for Trial { name, evaluation } in &self.0 {
            let controller = &evaluation.controller;
            for (source, scores) in sources(evaluation) {
                write!(f, "| {controller} | {name} | {source} {} ", scores.episodes)?;
                write_metrics(f, scores)?;
            }
        }
        writeln!(f)?;
        for Trial { name, evaluation } in &self.0 {
            for (source, scores) in sources(evaluation) {
                if let Some(goals) = scores.goals {
                    writeln!(
                        f,
                        "{} {name}, {source}: fastest joint {:.2} rad/s (p95 {:.2}), faster hand {:.2} m/s (p95 {:.2}), \
                         farthest joint {:.2} rad from the default pose (p95 {:.2})",
                        evaluation.controller,
                        goals.joint_speed.mean,
                        goals.joint_speed.p95,
                        goals.hand_speed.mean,
                        goals.hand_speed.p95,
                        goals.amplitude.mean,
                        goals.amplitude.p95
                    )?;
                }
            }
            for Failure {
                clip, time, reason, ..
            } in evaluation.failures.iter().take(LISTED)
            {
                writeln!(f, "  {clip} at {time:.2} s: {reason}")?;
            }
            if let Some(more) = evaluation.failures.len().checked_sub(LISTED + 1) {
                writeln!(f, "  and {} more, all in --json", more + 1)?;
            }
        }
        Ok(())
    }
}

/// The scores by source, those that there are.
fn sources(evaluation: &Evaluation) -> impl Iterator<Item = (&'static str, &Scores)> {
    let sources = [
        ("recorded", &evaluation.recorded),
        ("procedural", &evaluation.procedural),
    ];
    sources
        .into_iter()
        .filter_map(|(name, scores)| Some((name, scores.as_ref()?)))
}

fn write_metrics(f: &mut fmt::Formatter<'_>, scores: &Scores) -> fmt::Result {
    let metrics = &scores.metrics;
    let suc = metrics.suc;
    writeln!(
        f,
        "| {:.3} ({:.3}–{:.3}) | {:.3} | {:.2} | {:.1} % | {:.3} | {:.3} | {:.3} | {:.3} |",
        suc.mean,
        suc.low,
        suc.high,
        metrics.mjp.mean,
        metrics.msc.mean,
        100.0 * metrics.self_collision_share.mean,
        metrics.mbv.mean,
        metrics.mba.mean,
        metrics.mbo.mean,
        metrics.mus.mean
    )
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

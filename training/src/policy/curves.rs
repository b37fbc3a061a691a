//! Learning curves: survival and reward terms against environment steps, as an SVG picture.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, ensure};
use emp_motion::atomic;
use emp_sim::environment::REWARD_NAMES;
use plotters::{
    coord::Shift,
    prelude::{
        ChartBuilder, Color as _, DrawingArea, IntoDrawingArea as _, LineSeries, Palette as _,
        Palette99, PathElement, SVGBackend, SeriesLabelPosition, WHITE,
    },
    style::{BLACK, IntoFont as _},
};

/// Size of one panel, pixels.
const PANEL: (u32, u32) = (560, 400);

/// Panels of one run.
const PANELS: u32 = 3;

/// Points of a curve: more are averaged.
const POINTS: usize = 400;

/// A line: its name, and points (environment steps in millions, value).
struct Curve {
    name: String,
    points: Vec<(f64, f64)>,
}

/// Draws the runs whose logs are `logs`, a row of panels each: survival with the evaluations beside the log, rewards, and
/// penalties.
///
/// # Errors
/// When a log cannot be read or has other columns, or the picture cannot be written.
pub fn draw(logs: &[PathBuf], out: &Path) -> Result<()> {
    let runs = logs.iter().map(|log| read(log));
    let runs = runs.collect::<Result<Vec<_>>>()?;
    let mut svg = String::new();
    {
        let size = (PANELS * PANEL.0, runs.len() as u32 * PANEL.1);
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let panels = area.split_evenly((runs.len(), PANELS as usize));
        for (row, (name, panels_of_run)) in runs.iter().enumerate() {
            for (column, (title, curves)) in panels_of_run.iter().enumerate() {
                let panel = &panels[row * PANELS as usize + column];
                draw_panel(panel, &format!("{name}: {title}"), curves)?;
            }
        }
        area.present().map_err(failed)?;
    }
    atomic::write(out, svg.as_bytes()).with_context(|| format!("writing {}", out.display()))
}

/// A run's name and its panels.
type Run = (String, [(&'static str, Vec<Curve>); PANELS as usize]);

fn read(log: &Path) -> Result<Run> {
    let columns = columns(log)?;
    let terms = |positive: bool| {
        let of_sign = |name: &&str| {
            let sum = |curve: &Curve| curve.points.iter().map(|(_, value)| value).sum::<f64>();
            let curve = columns.iter().find(|curve| curve.name == **name);
            curve.is_some_and(|curve| (sum(curve) > 0.0) == positive)
        };
        let names: Vec<&str> = REWARD_NAMES.iter().copied().filter(of_sign).collect();
        pick(&columns, &names, log)
    };
    let mut survival = pick(&columns, &["survival", "randomization", "difficulty"], log)?;
    let evaluations = log.with_file_name("evaluations.csv");
    if evaluations.exists() {
        let evaluated = self::columns(&evaluations)?;
        survival.extend(
            evaluated
                .into_iter()
                .filter(|curve| curve.name.starts_with("suc_")),
        );
    }
    let folder = log.parent().and_then(Path::file_name).unwrap_or_default();
    Ok((
        folder.to_string_lossy().into_owned(),
        [
            ("survival and curriculum", survival),
            ("rewards", terms(true)?),
            ("penalties", terms(false)?),
        ],
    ))
}

fn pick(columns: &[Curve], names: &[&str], log: &Path) -> Result<Vec<Curve>> {
    let find = |name: &&str| {
        let curve = columns.iter().find(|curve| curve.name == *name);
        let curve = curve.with_context(|| format!("{}: no column {name}", log.display()))?;
        Ok(Curve {
            name: curve.name.clone(),
            points: curve.points.clone(),
        })
    };
    names.iter().map(find).collect()
}

/// Every column of a log against its first, smoothed.
fn columns(path: &Path) -> Result<Vec<Curve>> {
    let context = || format!("reading {}", path.display());
    let mut reader = csv::Reader::from_path(path).with_context(context)?;
    let names: Vec<String> = reader
        .headers()
        .with_context(context)?
        .iter()
        .skip(1)
        .map(str::to_owned)
        .collect();
    let rows: Vec<Vec<f64>> = reader
        .deserialize()
        .collect::<Result<_, _>>()
        .with_context(context)?;
    ensure!(!rows.is_empty(), "{}: no rows", path.display());
    let group = rows.len().div_ceil(POINTS);
    let curve = |(index, name): (usize, String)| {
        let point = |rows: &[Vec<f64>]| {
            let numbers = rows.iter().map(|row| row[index + 1]);
            let numbers: Vec<f64> = numbers.filter(|x: &f64| x.is_finite()).collect();
            let mean = numbers.iter().sum::<f64>() / numbers.len() as f64;
            let steps = rows.last().map_or(0.0, |row| row[0] / 1e6);
            (!numbers.is_empty()).then_some((steps, mean))
        };
        let points = rows.chunks(group).filter_map(point).collect();
        Curve { name, points }
    };
    Ok(names.into_iter().enumerate().map(curve).collect())
}

fn draw_panel(
    panel: &DrawingArea<SVGBackend<'_>, Shift>,
    title: &str,
    curves: &[Curve],
) -> Result<()> {
    let points = || curves.iter().flat_map(|curve| &curve.points);
    let last = points().map(|(steps, _)| *steps).fold(0.0, f64::max);
    let low = points().map(|(_, value)| *value).fold(0.0, f64::min);
    let high = points().map(|(_, value)| *value).fold(0.0, f64::max);
    let margin = 0.05 * (high - low).max(1e-9);
    let mut chart = ChartBuilder::on(panel)
        .caption(title, ("sans-serif", 18).into_font())
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(0.0..last.max(1e-9), low - margin..high + margin)
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_desc("environment steps, millions")
        .max_light_lines(0)
        .draw()
        .map_err(failed)?;
    for (index, curve) in curves.iter().enumerate() {
        let color = Palette99::pick(index).to_rgba();
        let style = color.stroke_width(2);
        chart
            .draw_series(LineSeries::new(curve.points.iter().copied(), style))
            .map_err(failed)?
            .label(&curve.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::MiddleRight)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .draw()
        .map_err(failed)?;
    Ok(())
}

fn failed(error: impl std::fmt::Display) -> anyhow::Error {
    anyhow!("drawing the curves: {error}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_runs_curves_are_drawn_with_their_names() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log.csv");
        let columns = super::super::trainer::columns();
        let row = |step: usize| {
            let values = columns.iter().skip(1).enumerate();
            let values: Vec<String> = values.map(|(i, _)| format!("{}", (step + i) % 7)).collect();
            format!("{step},{}\n", values.join(","))
        };
        let rows: String = (1..1000).map(row).collect();
        std::fs::write(&log, format!("{}\n{rows}", columns.join(","))).unwrap();
        let evaluations = folder.path().join("evaluations.csv");
        std::fs::write(
            evaluations,
            "step,suc_nominal,score\n500,0.5,NaN\n900,0.9,0.7\n",
        )
        .unwrap();
        let out = folder.path().join("curves.svg");
        draw(&[log], &out).unwrap();
        let svg = std::fs::read_to_string(out).unwrap();
        for name in [
            "survival",
            "suc_nominal",
            "base_orientation",
            "action_rate",
            "penalties",
        ] {
            assert!(svg.contains(name), "{name}");
        }
    }

    #[test]
    fn a_log_without_the_columns_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log.csv");
        std::fs::write(&log, "step,loss\n1,2\n").unwrap();
        let error = draw(&[log], &folder.path().join("curves.svg")).unwrap_err();
        assert!(error.to_string().contains("survival"), "{error}");
    }
}

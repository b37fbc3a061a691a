//! The frontier between falls and what a filter takes for them, as an SVG picture.

use std::{fmt, path::Path};

use anyhow::{Context as _, Result, anyhow};
use emp_motion::atomic;
use plotters::{
    coord::Shift,
    prelude::{
        ChartBuilder, Circle, Color as _, DrawingArea, IntoDrawingArea as _, LineSeries,
        Palette as _, Palette99, PathElement, SVGBackend, SeriesLabelPosition, WHITE,
    },
    style::{BLACK, IntoFont as _},
};

use super::{EmpReport, Outcome, Row};

/// Size of one panel, pixels.
const PANEL: (u32, u32) = (520, 420);

/// What a filter takes: the title of its axis, and its value beside the policy's own.
type Price = (&'static str, fn(&Outcome, &Outcome) -> f64);

const PRICES: [Price; 3] = [
    ("relL2 = |ĝ − g| / |g − default|", |ours, _| {
        ours.metrics.relative_change.mean
    }),
    ("mean absolute change of a goal angle, rad", |ours, _| {
        ours.metrics.change.mean
    }),
    ("loss of MJP", |ours, raw| {
        raw.metrics.mjp.mean - ours.metrics.mjp.mean
    }),
];

/// Draws falls under the hard conditions against relL2, mean absolute change and loss of MJP: one line a family, from the policy
/// alone over its members in their order.
///
/// # Errors
/// When there is nothing to draw, or the picture cannot be drawn or written.
pub fn draw(report: &EmpReport, out: &Path) -> Result<()> {
    let raw = report
        .rows
        .first()
        .context("expected the policy's own row")?;
    let mut svg = String::new();
    {
        let size = (PRICES.len() as u32 * PANEL.0, PANEL.1);
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        for (panel, price) in area.split_evenly((1, PRICES.len())).iter().zip(PRICES) {
            draw_panel(panel, report, raw, price)?;
        }
        area.present().map_err(failed)?;
    }
    atomic::write(out, svg.as_bytes()).with_context(|| format!("writing {}", out.display()))
}

/// The families in the order of the rows, without the policy alone.
fn families(rows: &[Row]) -> Vec<&[Row]> {
    let others = rows.get(1..).unwrap_or_default();
    others.chunk_by(|a, b| a.family == b.family).collect()
}

fn draw_panel(
    panel: &DrawingArea<SVGBackend<'_>, Shift>,
    report: &EmpReport,
    raw: &Row,
    (title, price): Price,
) -> Result<()> {
    let place = |row: &Row| (price(&row.hard, &raw.hard), row.hard.fallen());
    let places = || report.rows.iter().map(place);
    let left = places().map(|(x, _)| x).fold(0.0, f64::min);
    let right = places().map(|(x, _)| x).fold(1e-6, f64::max);
    let top = places().map(|(_, y)| y).fold(1e-6, f64::max);
    let mut chart = ChartBuilder::on(panel)
        .caption(
            format!("{}: falls under hard conditions", report.robot),
            ("sans-serif", 18).into_font(),
        )
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(48)
        .build_cartesian_2d(left..1.05 * right, 0.0..1.1 * top)
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_desc(title)
        .y_desc("share of falls")
        .max_light_lines(0)
        .draw()
        .map_err(failed)?;
    for (index, family) in families(&report.rows).into_iter().enumerate() {
        let Some(first) = family.first() else {
            continue;
        };
        let colour = Palette99::pick(index).to_rgba();
        let (width, radius) = if first.learned { (3, 6) } else { (2, 3) };
        let style = colour.stroke_width(width);
        let line = std::iter::once(raw).chain(family).map(place);
        chart
            .draw_series(LineSeries::new(line, style))
            .map_err(failed)?
            .label(first.family.as_str())
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
        let dots = family
            .iter()
            .map(|row| Circle::new(place(row), radius, colour.filled()));
        chart.draw_series(dots).map_err(failed)?;
    }
    chart
        .draw_series([Circle::new(place(raw), 5, BLACK.filled())])
        .map_err(failed)?
        .label(raw.name.as_str())
        .legend(|(x, y)| Circle::new((x + 8, y), 4, BLACK.filled()));
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .draw()
        .map_err(failed)
}

fn failed(error: impl fmt::Display) -> anyhow::Error {
    anyhow!("drawing the frontier: {error}")
}

//! Curves over time.

use super::canvas::{Align, Canvas, Point, Rgb};
use super::view::{BACKGROUND, FAINT, GROUND, INK, PANEL};

/// Height of the line above the curves that holds title and names, pixels.
const HEAD: f32 = 44.0;
/// Between the panel's border and the curves, pixels: left, right, bottom.
const INSETS: [f32; 3] = [64.0, 20.0, 16.0];
/// Text sizes of titles and of numbers at the axes, pixels.
const TITLE: f32 = 24.0;
const NUMBER: f32 = 19.0;
/// Number of grid lines to aim at.
const LINES: f32 = 4.0;
/// Width of curves, pixels.
const CURVE: f32 = 2.4;

/// A panel with one vertical axis, on a time axis that several panels share.
pub(super) struct Chart {
    /// Corners of the panel, pixels.
    panel: [Point; 2],
    /// Seconds at the left and the right end of the curves.
    times: [f32; 2],
    /// Values at the lower and the upper end of the curves.
    values: [f32; 2],
}

impl Chart {
    /// Draws the empty panel: background, grid, numbers, title.
    pub(super) fn new(
        canvas: &mut Canvas,
        panel: [Point; 2],
        times: [f32; 2],
        values: [f32; 2],
        title: &str,
    ) -> Self {
        let chart = Self {
            panel,
            times,
            values,
        };
        let [(left, top), (right, bottom)] = panel;
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        canvas.area(&corners, 0.0, PANEL);
        canvas.text((left + 16.0, top + 31.0), TITLE, Align::Left, INK, title);
        let step = nice_step(values[1] - values[0]);
        for number in (values[0] / step).ceil() as i32..=(values[1] / step).floor() as i32 {
            let value = number as f32 * step;
            let [start, end] = times.map(|time| chart.place(time, value));
            let (width, color) = if number == 0 {
                (2.0, FAINT)
            } else {
                (1.2, GROUND)
            };
            canvas.line(&[start, end], width, color);
            let at = (start.0 - 10.0, start.1 + 0.34 * NUMBER);
            canvas.text(at, NUMBER, Align::Right, FAINT, &format!("{value}"));
        }
        chart
    }

    /// The names of curves and bands, at the right end of the title's line.
    pub(super) fn names(&self, canvas: &mut Canvas, names: &[(&str, Rgb)]) {
        let [(_, top), (right, _)] = self.panel;
        let mut x = right - INSETS[1];
        for (name, color) in names.iter().rev() {
            canvas.text((x, top + 31.0), TITLE, Align::Right, *color, name);
            x -= canvas.text_width(TITLE, name) + 28.0;
        }
    }

    /// The area between two curves.
    pub(super) fn band(&self, canvas: &mut Canvas, curves: [&[(f32, f32)]; 2], rgb: Rgb) {
        let place = |&(time, value): &(f32, f32)| self.place(time, value);
        let there = curves[0].iter().map(place);
        let back = curves[1].iter().rev().map(place);
        canvas.area(&there.chain(back).collect::<Vec<_>>(), 0.0, rgb);
    }

    /// A curve through (seconds, value); it keeps to the panel where values do not.
    pub(super) fn curve(&self, canvas: &mut Canvas, curve: &[(f32, f32)], rgb: Rgb) {
        let points: Vec<Point> = curve
            .iter()
            .map(|&(time, value)| self.place(time, value))
            .collect();
        canvas.line(&points, CURVE + 2.0, PANEL);
        canvas.line(&points, CURVE, rgb);
    }

    /// A vertical line at a time.
    pub(super) fn rule(&self, canvas: &mut Canvas, time: f32, width: f32, rgb: Rgb) {
        let [bottom, top] = self.values.map(|value| self.place(time, value));
        canvas.line(&[bottom, top], width, rgb);
    }

    /// Numbers of the time axis, below the panel; every panel above has the same.
    pub(super) fn time_axis(&self, canvas: &mut Canvas) {
        let step = nice_step((self.times[1] - self.times[0]) / 2.0);
        let bottom = self.panel[1].1;
        for number in 0..=(self.times[1] / step).floor() as i32 {
            let time = number as f32 * step;
            let x = self.place(time, 0.0).0;
            canvas.line(&[(x, bottom), (x, bottom + 7.0)], 1.5, FAINT);
            let text = format!("{time} s");
            canvas.text(
                (x, bottom + 30.0),
                NUMBER + 2.0,
                Align::Center,
                FAINT,
                &text,
            );
        }
    }

    /// A number on a disc, at a time, on the lower border of the curves.
    pub(super) fn tag(&self, canvas: &mut Canvas, time: f32, text: &str) {
        let at = self.place(time, self.values[0]);
        tag(canvas, at, text);
    }

    fn place(&self, time: f32, value: f32) -> Point {
        let [(left, top), (right, bottom)] = self.panel;
        let within =
            |[low, high]: [f32; 2], value: f32| ((value - low) / (high - low)).clamp(0.0, 1.0);
        let (left, right) = (left + INSETS[0], right - INSETS[1]);
        let (top, bottom) = (top + HEAD, bottom - INSETS[2]);
        (
            left + within(self.times, time) * (right - left),
            bottom - within(self.values, value) * (bottom - top),
        )
    }
}

/// A number on a disc.
pub(super) fn tag(canvas: &mut Canvas, at: Point, text: &str) {
    canvas.disc(at, 13.0, FAINT);
    canvas.text((at.0, at.1 + 6.5), 19.0, Align::Center, BACKGROUND, text);
}

/// One, two or five times a power of ten, such that some [`LINES`] steps make the span.
fn nice_step(span: f32) -> f32 {
    let step = (span / LINES).max(f32::MIN_POSITIVE);
    let power = 10_f32.powf(step.log10().floor());
    let digit = [1.0, 2.0, 5.0]
        .into_iter()
        .find(|digit| digit * power >= 0.999 * step);
    digit.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_lines_stand_at_round_numbers() {
        for (span, step) in [
            (8.0, 2.0),
            (17.0, 5.0),
            (40.0, 10.0),
            (0.3, 0.1),
            (1.7, 0.5),
        ] {
            assert!(
                (nice_step(span) - step).abs() < 1e-6,
                "{span}: {}",
                nice_step(span)
            );
        }
    }

    #[test]
    fn curves_keep_to_their_panel() {
        let mut canvas = Canvas::new(400, 200, BACKGROUND).unwrap();
        let panel = [(10.0, 10.0), (390.0, 190.0)];
        let chart = Chart::new(&mut canvas, panel, [0.0, 2.0], [-1.0, 3.0], "title");
        let (left, top) = chart.place(0.0, 3.0);
        assert_eq!((left, top), (10.0 + INSETS[0], 10.0 + HEAD));
        assert_eq!(chart.place(0.0, 100.0), (left, top));
        let (middle, _) = chart.place(1.0, 0.0);
        let (right, bottom) = chart.place(2.0, -1.0);
        assert_eq!((right, bottom), (390.0 - INSETS[1], 190.0 - INSETS[2]));
        assert!((middle - f32::midpoint(left, right)).abs() < 1e-3);
    }
}

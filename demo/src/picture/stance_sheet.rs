//! The stance sheet: the robot from its right side at some stills, and below how it stood over the whole run.

use anyhow::{Result, ensure};
use nalgebra::Vector3;

use super::Still;
use super::canvas::{Align, Canvas, Point, Rgb};
use super::chart::{Chart, tag};
use super::view::{BACKGROUND, Bounds, Camera, FAINT, GROUND, INK, LEFT, PANEL, RIGHT, View};
use crate::stance::Stance;

const COLUMNS: usize = 4;
const CELL_WIDTH: f32 = 400.0;
const MARGIN: f32 = 28.0;
const HEADER: f32 = 110.0;
const CAPTION: f32 = 70.0;
const GAP: f32 = 20.0;
const INSET: f32 = 16.0;
/// Free space around the figures of a cell, pixels.
const PADDING: f32 = 24.0;
/// What of a cell lies below the floor, pixels.
const CELLAR: f32 = 78.0;
/// A metre is at most this many pixels.
const LARGEST_SCALE: f32 = 330.0;
/// Height of a chart and of the time axis below the last, pixels.
const CHART: f32 = 250.0;
const AXIS: f32 = 44.0;

const CENTER_OF_MASS: Rgb = [0, 128, 94];
const ROLL: Rgb = [150, 60, 140];
const PITCH: Rgb = [180, 120, 0];
const FALL: Rgb = [200, 30, 40];
const UNDER_FEET: Rgb = [226, 231, 236];
const UNDER_LEFT: Rgb = [206, 226, 240];
const UNDER_RIGHT: Rgb = [246, 222, 206];

/// Smallest and largest ends of the charts' axes, degrees and centimetres: small sways show, and a fall does not hide them.
const TILT_AXIS: [f32; 2] = [3.0, 15.0];
const WAY_AXIS: [f32; 2] = [6.0, 30.0];

/// A sheet about how the robot stood.
pub(crate) struct StanceSheet<'a> {
    /// First line of the head.
    pub(crate) title: &'a str,
    /// Second line of the head.
    pub(crate) subtitle: &'a str,
    /// What is shown, in order.
    pub(crate) stills: &'a [Still],
    /// How the robot stood, frame by frame.
    pub(crate) stances: &'a [Stance],
    /// Frames a second.
    pub(crate) rate: f64,
    /// When the robot fell, seconds.
    pub(crate) fall: Option<f64>,
    /// When it was pushed, seconds.
    pub(crate) pushes: &'a [f64],
}

impl StanceSheet<'_> {
    /// Draws the sheet; the answer is a PNG file.
    pub(crate) fn png(&self) -> Result<Vec<u8>> {
        ensure!(!self.stills.is_empty(), "there is no still to draw");
        ensure!(!self.stances.is_empty(), "there is no frame to draw");
        let cells = Cells::new(self.stills);
        let width = 2.0 * MARGIN + COLUMNS as f32 * (CELL_WIDTH + GAP) - GAP;
        let charts_top = HEADER + cells.rows as f32 * (cells.height + GAP);
        let height = charts_top + 3.0 * (CHART + GAP) - GAP + AXIS + MARGIN / 2.0;
        let mut canvas = Canvas::new(width as u32, height as u32, BACKGROUND)?;
        self.header(&mut canvas, width);
        for (index, still) in self.stills.iter().enumerate() {
            cells.draw(&mut canvas, index, still);
        }
        self.charts(&mut canvas, charts_top, width);
        canvas.png()
    }

    fn header(&self, canvas: &mut Canvas, width: f32) {
        canvas.text((MARGIN, 50.0), 38.0, Align::Left, INK, self.title);
        canvas.text((MARGIN, 88.0), 24.0, Align::Left, FAINT, self.subtitle);
        let right = width - MARGIN;
        let name = "centre of mass";
        canvas.text((right, 46.0), 24.0, Align::Right, CENTER_OF_MASS, name);
        let symbol = right - canvas.text_width(24.0, name) - 22.0;
        center_of_mass(canvas, (symbol, 38.0), BACKGROUND);
        canvas.text((right, 80.0), 24.0, Align::Right, RIGHT, "right foot");
        let left = right - canvas.text_width(24.0, "right foot") - 24.0;
        canvas.text((left, 80.0), 24.0, Align::Right, LEFT, "left foot");
    }

    fn charts(&self, canvas: &mut Canvas, top: f32, width: f32) {
        let places = [0, 1, 2].map(|number| {
            let top = top + number as f32 * (CHART + GAP);
            [(MARGIN, top), (width - MARGIN, top + CHART)]
        });
        let charts = [
            self.tilt_chart(canvas, places[0]),
            self.forward_chart(canvas, places[1]),
            self.sideways_chart(canvas, places[2]),
        ];
        for (number, still) in self.stills.iter().enumerate() {
            charts[0].tag(canvas, still.time as f32, &format!("{}", number + 1));
        }
        charts[2].time_axis(canvas);
    }

    fn tilt_chart(&self, canvas: &mut Canvas, place: [Point; 2]) -> Chart {
        let pitch = self.curve(|stance| stance.pitch.to_degrees());
        let roll = self.curve(|stance| stance.roll.to_degrees());
        let range = axis([&pitch, &roll], TILT_AXIS);
        let chart = self.chart(canvas, place, range, "tilt of the base, degrees");
        chart.names(
            canvas,
            &[("pitch, forward", PITCH), ("roll, to the right", ROLL)],
        );
        chart.curve(canvas, &roll, ROLL);
        chart.curve(canvas, &pitch, PITCH);
        chart
    }

    fn forward_chart(&self, canvas: &mut Canvas, place: [Point; 2]) -> Chart {
        let heel = self.curve(|stance| 100.0 * stance.heel_and_toe()[0]);
        let toe = self.curve(|stance| 100.0 * stance.heel_and_toe()[1]);
        let center = self.curve(|stance| 100.0 * stance.center_of_mass.x);
        let range = axis([&heel, &toe, &center], WAY_AXIS);
        let title = "centre of mass forward of the middle between the feet, cm";
        let chart = self.chart(canvas, place, range, title);
        chart.band(canvas, [&heel, &toe], UNDER_FEET);
        self.rules(canvas, &chart);
        chart.names(
            canvas,
            &[
                ("from heels to toes", FAINT),
                ("centre of mass", CENTER_OF_MASS),
            ],
        );
        chart.curve(canvas, &center, CENTER_OF_MASS);
        chart
    }

    fn sideways_chart(&self, canvas: &mut Canvas, place: [Point; 2]) -> Chart {
        let edges = |foot: usize| {
            [
                self.curve(|stance| 100.0 * stance.feet[foot].right),
                self.curve(|stance| 100.0 * stance.feet[foot].left),
            ]
        };
        let [left, right] = [edges(0), edges(1)];
        let center = self.curve(|stance| 100.0 * stance.center_of_mass.y);
        let range = axis([&left[1], &right[0], &center], WAY_AXIS);
        let title = "centre of mass to the left of that middle, cm";
        let chart = self.chart(canvas, place, range, title);
        chart.band(canvas, [&left[0], &left[1]], UNDER_LEFT);
        chart.band(canvas, [&right[0], &right[1]], UNDER_RIGHT);
        self.rules(canvas, &chart);
        let names = [
            ("left foot", LEFT),
            ("right foot", RIGHT),
            ("centre of mass", CENTER_OF_MASS),
        ];
        chart.names(canvas, &names);
        chart.curve(canvas, &center, CENTER_OF_MASS);
        chart
    }

    fn chart(&self, canvas: &mut Canvas, place: [Point; 2], range: [f32; 2], title: &str) -> Chart {
        let end = self.stances.len() as f64 / self.rate;
        let chart = Chart::new(canvas, place, [0.0, end as f32], range, title);
        self.rules(canvas, &chart);
        chart
    }

    /// Lines at the stills, the pushes and the fall.
    fn rules(&self, canvas: &mut Canvas, chart: &Chart) {
        for still in self.stills {
            chart.rule(canvas, still.time as f32, 1.2, GROUND);
        }
        for &push in self.pushes {
            chart.rule(canvas, push as f32, 2.0, FAINT);
        }
        if let Some(fall) = self.fall {
            chart.rule(canvas, fall as f32, 4.0, FALL);
        }
    }

    fn curve(&self, value: impl Fn(&Stance) -> f64) -> Vec<(f32, f32)> {
        let time = |frame: usize| (frame + 1) as f64 / self.rate;
        let points = self.stances.iter().enumerate();
        points
            .map(|(frame, stance)| (time(frame) as f32, value(stance) as f32))
            .collect()
    }
}

/// Ends of a vertical axis that is symmetric about 0 and holds the curves, between a smallest and a largest one.
fn axis<'a>(
    curves: impl IntoIterator<Item = &'a Vec<(f32, f32)>>,
    [smallest, largest]: [f32; 2],
) -> [f32; 2] {
    let values = curves.into_iter().flatten().map(|(_, value)| value.abs());
    let end = 1.08 * values.fold(0.0, f32::max);
    let end = end.clamp(smallest, largest);
    [-end, end]
}

/// The cells of the stills: all of one size, and of one scale.
struct Cells {
    camera: Camera,
    views: Vec<View>,
    bounds: Bounds,
    scale: f32,
    height: f32,
    rows: usize,
}

impl Cells {
    fn new(stills: &[Still]) -> Self {
        let camera = Camera::right_side();
        let view = |still: &Still| {
            let robot = still.robot_figure().placed(&still.stance.base);
            View::new(&robot, &camera)
        };
        let views: Vec<View> = stills.iter().map(view).collect();
        let bounds = views
            .iter()
            .fold(Bounds::NONE, |bounds, view| bounds.union(view.bounds))
            .with((0.0, 0.0), 0.0);
        let room = CELL_WIDTH - 2.0 * PADDING;
        let scale = (room / (bounds.right - bounds.left)).min(LARGEST_SCALE);
        Self {
            camera,
            views,
            bounds,
            scale,
            height: CAPTION + PADDING + bounds.top * scale + CELLAR,
            rows: stills.len().div_ceil(COLUMNS),
        }
    }

    fn draw(&self, canvas: &mut Canvas, index: usize, still: &Still) {
        let left = MARGIN + (index % COLUMNS) as f32 * (CELL_WIDTH + GAP);
        let top = HEADER + (index / COLUMNS) as f32 * (self.height + GAP);
        let (right, bottom) = (left + CELL_WIDTH, top + self.height);
        rectangle(canvas, [(left, top), (right, bottom)], PANEL);
        caption(canvas, (left, top), index + 1, still);

        let floor = bottom - CELLAR;
        let width = (self.bounds.right - self.bounds.left) * self.scale;
        let origin = (
            left + (CELL_WIDTH - width) / 2.0 - self.bounds.left * self.scale,
            floor,
        );
        self.views[index].draw(canvas, origin, self.scale);
        rectangle(canvas, [(left, floor), (right, bottom)], UNDER_FEET);
        canvas.line(&[(left, floor), (right, floor)], 2.0, GROUND);
        self.balance(canvas, origin, &still.stance);
    }

    /// The centre of mass, and below the floor where it is against the feet.
    fn balance(&self, canvas: &mut Canvas, origin: Point, stance: &Stance) {
        let place = |point: &Vector3<f64>| {
            let (x, y) = self.camera.project(&point.cast());
            (origin.0 + x * self.scale, origin.1 - y * self.scale)
        };
        let along = |forward: f64| origin.0 + forward as f32 * self.scale;
        let floor = origin.1;
        for (foot, (row, color)) in stance.feet.iter().zip([(16.0, LEFT), (28.0, RIGHT)]) {
            let ends = [foot.heel, foot.toe].map(|end| (along(end), floor + row));
            canvas.line(&ends, 8.0, color);
        }
        let center = place(&stance.center_of_mass);
        canvas.dashes([center, (center.0, floor + 44.0)], 6.0, 2.5, CENTER_OF_MASS);
        center_of_mass(canvas, center, PANEL);

        let [heel, toe] = stance.heel_and_toe();
        let forward = stance.center_of_mass.x;
        let cm = |way: f64| format!("{:.1} cm", 100.0 * way);
        let line = floor + 65.0;
        let [behind, ahead] = [cm(forward - heel), cm(toe - forward)];
        canvas.text((center.0 - 14.0, line), 20.0, Align::Right, FAINT, &behind);
        canvas.text((center.0 + 14.0, line), 20.0, Align::Left, FAINT, &ahead);
        let tip = (center.0, floor + 44.0);
        let arrow = [
            tip,
            (tip.0 - 8.0, tip.1 + 14.0),
            (tip.0 + 8.0, tip.1 + 14.0),
        ];
        canvas.area(&arrow, 1.0, CENTER_OF_MASS);
    }
}

fn caption(canvas: &mut Canvas, (left, top): Point, number: usize, still: &Still) {
    let line = top + 36.0;
    tag(
        canvas,
        (left + INSET + 13.0, line - 9.0),
        &format!("{number}"),
    );
    let time = format!("{:.1} s", still.time);
    canvas.text((left + INSET + 38.0, line), 27.0, Align::Left, INK, &time);
    let right = left + CELL_WIDTH - INSET;
    canvas.text((right, line), 27.0, Align::Right, INK, &still.name);
    let tilt = format!("base tilted by {:.1}°", still.stance.tilt().to_degrees());
    canvas.text((left + INSET, line + 28.0), 21.0, Align::Left, FAINT, &tilt);
}

/// The sign for a centre of mass: a disc in quarters.
fn center_of_mass(canvas: &mut Canvas, (x, y): Point, background: Rgb) {
    let radius = 12.0;
    canvas.disc((x, y), radius + 2.5, background);
    canvas.disc((x, y), radius, CENTER_OF_MASS);
    canvas.disc((x, y), radius - 2.5, BACKGROUND);
    for start in [0.0_f32, 180.0] {
        let rim = (0..=9).map(|step| (start + 10.0 * step as f32).to_radians());
        let rim = rim.map(|angle| (x + radius * angle.cos(), y + radius * angle.sin()));
        let quarter: Vec<Point> = std::iter::once((x, y)).chain(rim).collect();
        canvas.area(&quarter, 0.0, CENTER_OF_MASS);
    }
}

fn rectangle(canvas: &mut Canvas, [(left, top), (right, bottom)]: [Point; 2], color: Rgb) {
    let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
    canvas.area(&corners, 0.0, color);
}

#[cfg(test)]
mod tests {
    use tiny_skia::Pixmap;

    use super::super::testing::{stance, still};
    use super::*;

    fn draw(stills: usize, forward: f64, fall: Option<f64>) -> Pixmap {
        let stills: Vec<Still> = (0..stills).map(|index| still(index as f64)).collect();
        let sway = |frame: usize| (frame as f64 / 30.0).sin();
        let stances: Vec<Stance> = (0..400)
            .map(|frame| stance(0.02 * sway(frame), forward))
            .collect();
        let sheet = StanceSheet {
            title: "title",
            subtitle: "subtitle",
            stills: &stills,
            stances: &stances,
            rate: 50.0,
            fall,
            pushes: &[],
        };
        Pixmap::decode_png(&sheet.png().unwrap()).unwrap()
    }

    /// Rows of the pixels of a colour in the lower part of the picture, where the charts are.
    fn rows(pixels: &Pixmap, rgb: Rgb) -> Vec<u32> {
        let charts = pixels.height() - (3.0 * (CHART + GAP) + AXIS) as u32;
        let of_color = |x: u32, y: u32| {
            let pixel = pixels.pixel(x, y).unwrap();
            [pixel.red(), pixel.green(), pixel.blue()] == rgb
        };
        let rows = charts..pixels.height();
        // Names stand in the right half.
        rows.flat_map(|y| (0..pixels.width() / 2).map(move |x| (x, y)))
            .filter(|&(x, y)| of_color(x, y))
            .map(|(_, y)| y)
            .collect()
    }

    #[test]
    fn a_centre_of_mass_farther_forward_is_drawn_higher() {
        let [back, front] = [-0.05, 0.05].map(|forward| {
            let rows = rows(&draw(1, forward, None), CENTER_OF_MASS);
            assert!(rows.len() > 500, "{} pixels", rows.len());
            rows.iter().sum::<u32>() / rows.len() as u32
        });
        assert!(front + 20 < back, "{front} {back}");
    }

    #[test]
    fn a_fall_is_marked_in_every_chart() {
        assert!(rows(&draw(1, 0.0, None), FALL).is_empty());
        let fallen = rows(&draw(1, 0.0, Some(2.0)), FALL);
        for chart in 0..3 {
            let bottom = draw(1, 0.0, None).height() as f32 - AXIS - MARGIN / 2.0;
            let middle = bottom - chart as f32 * (CHART + GAP) - CHART / 2.0;
            assert!(fallen.contains(&(middle as u32)), "chart {chart}");
        }
    }

    #[test]
    fn two_rows_of_stills_are_higher_than_one() {
        let [one, two] = [4, 5].map(|count| draw(count, 0.0, None));
        assert!(one.width() == two.width() && two.height() > one.height() + 300);
    }
}

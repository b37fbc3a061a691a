//! The EMP sheet: one person, two robots. Strips of what the person did and of the robot with and without the EMP; below them
//! tilt, centre of mass and goals over time.

use anyhow::{Result, ensure};
use emp_motion::KeyNodeFrame;
use nalgebra::{Isometry3, Point3, Vector3};

use super::canvas::{Align, Canvas, Point, Rgb};
use super::chart::{Chart, tag};
use super::figure::{Figure, Leg};
use super::view::{BACKGROUND, Bounds, Camera, FAINT, GROUND, INK, LEFT, PANEL, RIGHT, View};

/// Colour of the run without the EMP, of the run with it, and of a goal before the EMP.
pub(crate) const OFF: Rgb = [200, 30, 40];
pub(crate) const ON: Rgb = [0, 120, 135];
const ASKED: Rgb = [150, 160, 172];

const WIDTH: f32 = 1716.0;
const MARGIN: f32 = 28.0;
const HEADER: f32 = 152.0;
const GAP: f32 = 8.0;
/// Height of the line above a row of cells, pixels.
const ROW_TITLE: f32 = 42.0;
/// Space above, below and beside the figures of a cell, pixels.
const PADDING: f32 = 16.0;
/// Height of a cell's caption, pixels.
const CAPTION: f32 = 32.0;
/// A metre is at most this many pixels.
const LARGEST_SCALE: f32 = 175.0;
/// Heights of the charts of all runs, of those of single joints, and of the time axis below the last, pixels.
const CHART: f32 = 230.0;
const JOINT_CHART: f32 = 176.0;
const AXIS: f32 = 44.0;
/// Space between the strips and the charts, and between charts, pixels.
const CHART_GAP: f32 = 16.0;
/// Half the width and half the height of the shadow below a robot, metres.
const SHADOW: [f32; 2] = [0.34, 0.08];
/// Size of small text, pixels.
const SMALL: f32 = 21.0;

/// Least upper end of the tilt's axis and the largest one, degrees; ends of the margin's axis, cm.
const TILT_AXIS: [f32; 2] = [5.0, 50.0];
const MARGIN_AXIS: [[f32; 2]; 2] = [[-2.0, -12.0], [6.0, 16.0]];

/// Values over time: (seconds, value).
pub(crate) type Curve = Vec<(f32, f32)>;

/// A robot with and without the EMP.
pub(crate) struct EmpSheet<'a> {
    /// First line of the head.
    pub(crate) title: &'a str,
    /// The lines below it.
    pub(crate) subtitles: &'a [String],
    /// Times that the strips show, seconds.
    pub(crate) times: &'a [f64],
    /// What the person did at these times.
    pub(crate) person: &'a [KeyNodeFrame],
    /// The runs.
    pub(crate) strips: &'a [Strip],
    /// Goal joints that the EMP changed; may be none.
    pub(crate) joints: &'a [JointCurves],
    /// Length of the charts, seconds.
    pub(crate) seconds: f64,
    /// When the robots were pushed, seconds.
    pub(crate) pushes: &'a [f64],
}

/// One run.
pub(crate) struct Strip {
    /// Short name, for charts.
    pub(crate) name: &'static str,
    /// What happened, in a line.
    pub(crate) outcome: String,
    /// Its colour.
    pub(crate) color: Rgb,
    /// The robot at the sheet's times.
    pub(crate) figures: Vec<Standing>,
    /// Tilt of the base over time, degrees.
    pub(crate) tilt: Curve,
    /// How far the centre of mass was inside the feet's support polygon, cm.
    pub(crate) margin: Curve,
    /// When it fell, seconds.
    pub(crate) fall: Option<f64>,
}

/// A robot at one still.
pub(crate) struct Standing {
    /// Its key nodes in the frame of its base.
    pub(crate) pose: KeyNodeFrame,
    /// Its legs in the same frame.
    pub(crate) legs: [Leg; 2],
    /// The base over the floor, horizontally at the origin.
    pub(crate) base: Isometry3<f32>,
    /// Tilt of the base, degrees.
    pub(crate) tilt: f32,
    /// Set when it had fallen by then, and stands for its last moment: the time of the fall, seconds.
    pub(crate) fallen: Option<f64>,
}

/// What the EMP did to the goal of one joint.
pub(crate) struct JointCurves {
    /// The joint's name.
    pub(crate) name: String,
    /// The goal before the EMP, degrees.
    pub(crate) asked: Curve,
    /// The goal that was executed, degrees.
    pub(crate) executed: Curve,
}

impl EmpSheet<'_> {
    /// Draws the sheet; the answer is a PNG file.
    ///
    /// # Errors
    /// If there is nothing to draw.
    pub(crate) fn png(&self) -> Result<Vec<u8>> {
        ensure!(!self.strips.is_empty(), "there is no run to draw");
        ensure!(!self.times.is_empty(), "there is no still to draw");
        let rows = Rows::new(self);
        let charts_top = HEADER + rows.height() + CHART_GAP;
        let joints = self.joints.len() as f32;
        let charts = 2.0 * (CHART + CHART_GAP) + joints * (JOINT_CHART + CHART_GAP);
        let height = charts_top + charts - CHART_GAP + AXIS + MARGIN / 2.0;
        let mut canvas = Canvas::new(WIDTH as u32, height as u32, BACKGROUND)?;
        self.header(&mut canvas);
        rows.draw(&mut canvas, self);
        self.charts(&mut canvas, charts_top);
        canvas.png()
    }

    fn header(&self, canvas: &mut Canvas) {
        canvas.text((MARGIN, 50.0), 38.0, Align::Left, INK, self.title);
        for (line, text) in self.subtitles.iter().enumerate() {
            let at = (MARGIN, 88.0 + 32.0 * line as f32);
            canvas.text(at, 24.0, Align::Left, FAINT, text);
        }
    }

    fn charts(&self, canvas: &mut Canvas, top: f32) {
        let mut top = top;
        let mut place = |height: f32| {
            let corners = [(MARGIN, top), (WIDTH - MARGIN, top + height)];
            top += height + CHART_GAP;
            corners
        };
        let tilt = self.tilt_chart(canvas, place(CHART));
        for (number, &time) in self.times.iter().enumerate() {
            tilt.tag(canvas, time as f32, &format!("{}", number + 1));
        }
        let mut last = self.margin_chart(canvas, place(CHART));
        for joint in self.joints {
            last = self.joint_chart(canvas, place(JOINT_CHART), joint);
        }
        last.time_axis(canvas);
    }

    fn tilt_chart(&self, canvas: &mut Canvas, place: [Point; 2]) -> Chart {
        let values = self.strips.iter().flat_map(|strip| &strip.tilt);
        let largest = values.map(|(_, value)| *value).fold(0.0, f32::max);
        let end = (1.08 * largest).clamp(TILT_AXIS[0], TILT_AXIS[1]);
        let title = "tilt of the base, degrees";
        // Below 0 there is room for the stills' numbers.
        let chart = self.chart(canvas, place, [-0.14 * end, end], title);
        self.runs(canvas, &chart, |strip| strip.tilt.clone());
        chart
    }

    fn margin_chart(&self, canvas: &mut Canvas, place: [Point; 2]) -> Chart {
        let values = self.strips.iter().flat_map(|strip| &strip.margin);
        let fold = |start: f32, pick: fn(f32, f32) -> f32| {
            values
                .clone()
                .map(|(_, value)| 1.08 * value)
                .fold(start, pick)
        };
        let [[high_low, low], [low_high, high]] = MARGIN_AXIS;
        let range = [
            fold(high_low, f32::min).max(low),
            fold(low_high, f32::max).min(high),
        ];
        let title = "centre of mass inside the edge of the feet, cm (below 0: outside)";
        let chart = self.chart(canvas, place, range, title);
        // Once the robot falls, how far it is out tells no more.
        let inside = |strip: &Strip| {
            let margin = strip.margin.iter().copied();
            margin.take_while(|(_, value)| *value >= range[0]).collect()
        };
        self.runs(canvas, &chart, inside);
        chart
    }

    fn joint_chart(&self, canvas: &mut Canvas, place: [Point; 2], joint: &JointCurves) -> Chart {
        let values = joint.asked.iter().chain(&joint.executed);
        let values = values.map(|(_, value)| *value);
        let [low, high] = [
            values.clone().fold(f32::INFINITY, f32::min),
            values.fold(f32::NEG_INFINITY, f32::max),
        ];
        let room = (0.06 * (high - low)).max(1.0);
        let title = format!("goal of {}, degrees", joint.name);
        let chart = self.chart(canvas, place, [low - room, high + room], &title);
        chart.names(canvas, &[("before the EMP", ASKED), ("after it", ON)]);
        chart.curve(canvas, &joint.asked, ASKED);
        chart.curve(canvas, &joint.executed, ON);
        chart
    }

    fn runs(&self, canvas: &mut Canvas, chart: &Chart, curve: impl Fn(&Strip) -> Curve) {
        let names: Vec<_> = self
            .strips
            .iter()
            .map(|strip| (strip.name, strip.color))
            .collect();
        chart.names(canvas, &names);
        for strip in self.strips {
            chart.curve(canvas, &curve(strip), strip.color);
        }
    }

    /// An empty chart with lines at the stills, the pushes and the falls.
    fn chart(&self, canvas: &mut Canvas, place: [Point; 2], range: [f32; 2], title: &str) -> Chart {
        let chart = Chart::new(canvas, place, [0.0, self.seconds as f32], range, title);
        for &time in self.times {
            chart.rule(canvas, time as f32, 1.2, GROUND);
        }
        for &push in self.pushes {
            chart.rule(canvas, push as f32, 2.0, FAINT);
        }
        for strip in self.strips {
            if let Some(fall) = strip.fall {
                chart.rule(canvas, fall as f32, 4.0, strip.color);
            }
        }
        chart
    }
}

/// The strips: a row of cells for the person, then one for each run. All figures have one scale.
struct Rows {
    scale: f32,
    rows: Vec<Row>,
}

/// One row of cells.
struct Row {
    views: Vec<View>,
    bounds: Bounds,
}

impl Rows {
    fn new(sheet: &EmpSheet<'_>) -> Self {
        let camera = Camera::front_left();
        let person = sheet.person.iter().map(Figure::person);
        let person = person.map(|figure| View::new(&figure, &camera)).collect();
        let runs = sheet.strips.iter().map(|strip| {
            let figures = strip.figures.iter();
            figures.map(|robot| robot.view(&camera)).collect()
        });
        let rows: Vec<Row> = std::iter::once(person).chain(runs).map(Row::new).collect();
        let views = rows.iter().flat_map(|row| &row.views);
        let widest = views
            .map(|view| view.bounds.right - view.bounds.left)
            .fold(0.0, f32::max);
        let room = cell_width(sheet.times.len()) - 2.0 * PADDING;
        Self {
            scale: (room / widest).min(LARGEST_SCALE),
            rows,
        }
    }

    fn height(&self) -> f32 {
        let rows = self.rows.iter().map(|row| row.height(self.scale));
        rows.sum::<f32>() + GAP * (self.rows.len() - 1) as f32
    }

    fn draw(&self, canvas: &mut Canvas, sheet: &EmpSheet<'_>) {
        let mut top = HEADER;
        for (number, row) in self.rows.iter().enumerate() {
            let strip = number.checked_sub(1).map(|run| &sheet.strips[run]);
            match strip {
                None => {
                    row_title(canvas, top, INK, "the person");
                    sides(canvas, top);
                }
                Some(strip) => row_title(canvas, top, strip.color, &strip.outcome),
            }
            for column in 0..row.views.len() {
                let corner = (left(column, sheet.times.len()), top + ROW_TITLE);
                let caption = match strip {
                    None => Caption::Time(column + 1, sheet.times[column]),
                    Some(strip) => Caption::Robot(&strip.figures[column]),
                };
                self.cell(canvas, row, column, corner, &caption);
            }
            top += row.height(self.scale) + GAP;
        }
    }

    fn cell(
        &self,
        canvas: &mut Canvas,
        row: &Row,
        column: usize,
        (left, top): Point,
        caption: &Caption<'_>,
    ) {
        let (right, bottom) = (
            left + cell_width(row.views.len()),
            top + row.height(self.scale) - ROW_TITLE,
        );
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        canvas.area(&corners, 0.0, PANEL);
        caption.draw(canvas, [(left, top), (right, top)]);
        let view = &row.views[column];
        // Each figure stands in the middle of its cell; all of a row on one line.
        let middle = (view.bounds.left + view.bounds.right) / 2.0;
        let origin = (
            (left + right) / 2.0 - middle * self.scale,
            bottom - PADDING + row.bounds.bottom * self.scale,
        );
        if let Caption::Robot(robot) = caption {
            let (x, y) = robot.shadow(&Camera::front_left());
            let at = (origin.0 + x * self.scale, origin.1 - y * self.scale);
            let [x, y] = SHADOW.map(|half| half * self.scale);
            canvas.ellipse(at, (x, y), GROUND);
        }
        view.draw(canvas, origin, self.scale);
    }
}

impl Row {
    fn new(views: Vec<View>) -> Self {
        let bounds = views
            .iter()
            .fold(Bounds::NONE, |bounds, view| bounds.union(view.bounds));
        Self { views, bounds }
    }

    fn height(&self, scale: f32) -> f32 {
        ROW_TITLE + CAPTION + self.bounds.height() * scale + 2.0 * PADDING
    }
}

/// The line at the top of a cell.
enum Caption<'a> {
    /// Number of the still, and when it is.
    Time(usize, f64),
    Robot(&'a Standing),
}

impl Caption<'_> {
    fn draw(&self, canvas: &mut Canvas, [(left, top), (right, _)]: [Point; 2]) {
        let line = top + CAPTION - 4.0;
        match self {
            Self::Time(number, time) => {
                tag(canvas, (left + 24.0, line - 8.0), &format!("{number}"));
                let text = format!("{time:.1} s");
                canvas.text((left + 46.0, line), 25.0, Align::Left, INK, &text);
            }
            Self::Robot(Standing {
                fallen: Some(time), ..
            }) => {
                let text = format!("fell at {time:.1} s");
                canvas.text((right - 14.0, line), SMALL, Align::Right, INK, &text);
            }
            Self::Robot(Standing { tilt, .. }) => {
                let text = format!("tilted by {tilt:.0}°");
                canvas.text((right - 14.0, line), SMALL, Align::Right, FAINT, &text);
            }
        }
    }
}

impl Standing {
    /// The robot as the camera sees it, with room for its shadow.
    fn view(&self, camera: &Camera) -> View {
        let figure = Figure::robot(&self.pose, &self.legs).placed(&self.base);
        let mut view = View::new(&figure, camera);
        let (x, y) = self.shadow(camera);
        for corner in [
            (x - SHADOW[0], y - SHADOW[1]),
            (x + SHADOW[0], y + SHADOW[1]),
        ] {
            view.bounds = view.bounds.with(corner, 0.0);
        }
        view
    }

    /// The point of the floor below the middle of the feet, as the camera sees it, metres.
    fn shadow(&self, camera: &Camera) -> Point {
        let feet = self.legs.iter().filter_map(|leg| leg.last());
        let feet: Vec<Vector3<f32>> = feet
            .map(|toe| (self.base * Point3::from(*toe)).coords)
            .collect();
        let middle = feet.iter().sum::<Vector3<f32>>() / feet.len().max(1) as f32;
        camera.project(&Vector3::new(middle.x, middle.y, 0.0))
    }
}

fn row_title(canvas: &mut Canvas, top: f32, color: Rgb, text: &str) {
    canvas.text((MARGIN, top + 29.0), 27.0, Align::Left, color, text);
}

/// The colours of both sides, at the right end of a row's title.
fn sides(canvas: &mut Canvas, top: f32) {
    let mut right = WIDTH - MARGIN;
    for (text, color) in [("right arm and leg", RIGHT), ("left arm and leg", LEFT)] {
        canvas.text((right, top + 29.0), 24.0, Align::Right, color, text);
        right -= canvas.text_width(24.0, text) + 28.0;
    }
}

fn cell_width(columns: usize) -> f32 {
    let columns = columns as f32;
    (WIDTH - 2.0 * MARGIN - (columns - 1.0) * GAP) / columns
}

fn left(column: usize, columns: usize) -> f32 {
    MARGIN + column as f32 * (cell_width(columns) + GAP)
}

#[cfg(test)]
mod tests {
    use tiny_skia::Pixmap;

    use super::super::testing::still;
    use super::*;

    const TIMES: [f64; 3] = [0.5, 1.0, 1.5];

    fn strip(name: &'static str, color: Rgb, fall: Option<f64>) -> Strip {
        let figures = TIMES.map(|time| {
            let still = still(time);
            Standing {
                pose: still.robot,
                legs: still.legs,
                base: still.stance.base,
                tilt: 1.0,
                fallen: fall.filter(|fall| *fall <= time),
            }
        });
        let until = fall.unwrap_or(4.0);
        let curve = |value: f32| {
            let times = (0..200).map(|frame| frame as f32 / 50.0);
            let times = times.filter(|time| f64::from(*time) <= until);
            times.map(|time| (time, value)).collect()
        };
        Strip {
            name,
            outcome: name.to_owned(),
            color,
            figures: figures.into(),
            tilt: curve(2.0),
            margin: curve(3.0),
            fall,
        }
    }

    fn draw(strips: &[Strip], joints: usize) -> Pixmap {
        let joints: Vec<_> = (0..joints)
            .map(|number| JointCurves {
                name: format!("joint {number}"),
                asked: vec![(0.0, 10.0), (4.0, 20.0)],
                executed: vec![(0.0, 8.0), (4.0, 15.0)],
            })
            .collect();
        let sheet = EmpSheet {
            title: "title",
            subtitles: &["one".to_owned(), "two".to_owned()],
            times: &TIMES,
            person: &TIMES.map(|time| still(time).human),
            strips,
            joints: &joints,
            seconds: 4.0,
            pushes: &[],
        };
        Pixmap::decode_png(&sheet.png().unwrap()).unwrap()
    }

    fn columns(pixels: &Pixmap, rgb: Rgb, rows: std::ops::Range<u32>) -> Vec<u32> {
        let points = rows.flat_map(|y| (0..pixels.width()).map(move |x| (x, y)));
        let of_color = |&(x, y): &(u32, u32)| {
            let pixel = pixels.pixel(x, y).unwrap();
            [pixel.red(), pixel.green(), pixel.blue()] == rgb
        };
        points.filter(of_color).map(|(x, _)| x).collect()
    }

    #[test]
    fn a_run_that_falls_ends_in_the_charts_and_the_other_goes_on() {
        let strips = [strip("EMP off", OFF, Some(1.5)), strip("EMP on", ON, None)];
        let pixels = draw(&strips, 0);
        // The last chart, without its line of names.
        let bottom = pixels.height() - (AXIS + MARGIN / 2.0) as u32;
        let rows = bottom - CHART as u32 + 50..bottom;
        let farthest = |rgb| {
            columns(&pixels, rgb, rows.clone())
                .into_iter()
                .max()
                .unwrap()
        };
        assert!(farthest(ON) > 1600);
        assert!((600..800).contains(&farthest(OFF)), "{}", farthest(OFF));
    }

    #[test]
    fn the_sheet_grows_with_its_runs_and_joints() {
        let off = || strip("EMP off", OFF, None);
        let one = draw(&[off()], 0);
        let two = draw(&[off(), strip("EMP on", ON, None)], 0);
        let joints = draw(&[off(), strip("EMP on", ON, None)], 3);
        assert!(one.width() == two.width() && two.height() > one.height() + 200);
        assert!(joints.height() > two.height() + 400);
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        let sheet = EmpSheet {
            title: "",
            subtitles: &[],
            times: &[],
            person: &[],
            strips: &[],
            joints: &[],
            seconds: 1.0,
            pushes: &[],
        };
        assert!(sheet.png().is_err());
    }
}

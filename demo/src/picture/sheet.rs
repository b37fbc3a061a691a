//! Layout of the contact sheet, and the camera.

use anyhow::{Result, ensure};
use emp_motion::{KeyNodeFrame, Side};
use nalgebra::Vector3;

use super::canvas::{Align, Canvas, Point, Rgb};
use super::figure::{Figure, Leg, Part, Shape};

const BACKGROUND: Rgb = [255, 255, 255];
const PANEL: Rgb = [244, 246, 248];
const INK: Rgb = [38, 46, 56];
const FAINT: Rgb = [120, 130, 142];
const GROUND: Rgb = [205, 211, 218];
const MIDDLE: Rgb = [96, 108, 122];
const LEFT: Rgb = [0, 114, 178];
const RIGHT: Rgb = [213, 94, 0];

const COLUMNS: usize = 4;
const CELL_WIDTH: f32 = 400.0;
const MARGIN: f32 = 28.0;
const HEADER: f32 = 110.0;
const CAPTION: f32 = 70.0;
const GAP: f32 = 20.0;
/// Between a cell's border and its text, pixels.
const INSET: f32 = 16.0;
/// Width of the edge around shapes, pixels.
const EDGE: f32 = 3.0;
/// Free space around the figures of a cell, pixels.
const PADDING: f32 = 24.0;

/// One moment of the motion.
pub(crate) struct Moment {
    /// Since the motion began, seconds.
    pub(crate) time: f64,
    /// What is going on, if that has a name.
    pub(crate) name: String,
    /// Mean angle between the person's and the robot's arm bones, degrees.
    pub(crate) direction_error_deg: f32,
    /// The person.
    pub(crate) human: KeyNodeFrame,
    /// The robot's key nodes, as the physics left them, in its pelvis frame.
    pub(crate) robot: KeyNodeFrame,
    /// The robot's left and right leg.
    pub(crate) legs: [Leg; 2],
}

/// A contact sheet.
pub(crate) struct Sheet<'a> {
    /// First line of the head.
    pub(crate) title: &'a str,
    /// Second line of the head.
    pub(crate) subtitle: &'a str,
    /// What is shown, in order.
    pub(crate) moments: &'a [Moment],
}

impl Sheet<'_> {
    /// Draws the sheet; the answer is a PNG file.
    pub(crate) fn png(&self) -> Result<Vec<u8>> {
        ensure!(!self.moments.is_empty(), "there is no moment to draw");
        let camera = Camera::front_left();
        let pairs: Vec<[View; 2]> = self
            .moments
            .iter()
            .map(|moment| moment.views(&camera))
            .collect();
        let layout = Layout::new(&pairs);
        let mut canvas = Canvas::new(layout.width as u32, layout.height as u32, BACKGROUND)?;
        self.header(&mut canvas, layout.width);
        for (index, (moment, views)) in self.moments.iter().zip(&pairs).enumerate() {
            layout.draw(&mut canvas, index, moment, views);
        }
        canvas.png()
    }

    fn header(&self, canvas: &mut Canvas, width: f32) {
        canvas.text((MARGIN, 50.0), 38.0, Align::Left, INK, self.title);
        canvas.text((MARGIN, 88.0), 24.0, Align::Left, FAINT, self.subtitle);
        let right = width - MARGIN;
        canvas.text((right, 46.0), 24.0, Align::Right, LEFT, "left arm and leg");
        canvas.text(
            (right, 80.0),
            24.0,
            Align::Right,
            RIGHT,
            "right arm and leg",
        );
    }
}

impl Moment {
    fn views(&self, camera: &Camera) -> [View; 2] {
        let human = Figure::person(&self.human);
        let robot = Figure::robot(&self.robot, &self.legs);
        [human, robot].map(|figure| View::new(&figure, camera))
    }
}

/// A parallel projection.
struct Camera {
    right: Vector3<f32>,
    up: Vector3<f32>,
    /// From the figure to the camera.
    toward: Vector3<f32>,
}

impl Camera {
    /// In front of the figure, somewhat to its left and above: depth shows, and neither arm hides the other.
    fn front_left() -> Self {
        let (azimuth, elevation) = (28_f32.to_radians(), 12_f32.to_radians());
        let toward = Vector3::new(
            azimuth.cos() * elevation.cos(),
            azimuth.sin() * elevation.cos(),
            elevation.sin(),
        );
        let right = (-toward).cross(&Vector3::z()).normalize();
        Self {
            right,
            up: right.cross(&-toward),
            toward,
        }
    }

    /// Metres to the right and up, seen from the camera.
    fn project(&self, point: &Vector3<f32>) -> Point {
        (self.right.dot(point), self.up.dot(point))
    }

    /// Nearness to the camera, metres.
    fn depth(&self, point: &Vector3<f32>) -> f32 {
        self.toward.dot(point)
    }
}

/// A figure as the camera sees it: flat shapes from far to near.
struct View {
    shapes: Vec<FlatShape>,
    bounds: Bounds,
}

/// A shape in camera metres.
struct FlatShape {
    color: Rgb,
    depth: f32,
    points: Vec<Point>,
    kind: Kind,
}

/// How the points of a flat shape are joined; sizes in metres.
enum Kind {
    Rod { width: f32, joints: Vec<Point> },
    Slab { rounding: f32 },
    Ball { radius: f32 },
}

/// What a figure spans, in camera metres.
#[derive(Clone, Copy)]
struct Bounds {
    left: f32,
    right: f32,
    bottom: f32,
    top: f32,
}

impl Bounds {
    const NONE: Self = Self {
        left: f32::INFINITY,
        right: f32::NEG_INFINITY,
        bottom: f32::INFINITY,
        top: f32::NEG_INFINITY,
    };

    fn with(self, (x, y): Point, margin: f32) -> Self {
        Self {
            left: self.left.min(x - margin),
            right: self.right.max(x + margin),
            bottom: self.bottom.min(y - margin),
            top: self.top.max(y + margin),
        }
    }

    fn union(self, other: Self) -> Self {
        self.with((other.left, other.bottom), 0.0)
            .with((other.right, other.top), 0.0)
    }

    fn height(&self) -> f32 {
        self.top - self.bottom
    }

    /// Largest distance to either side of the pelvis.
    fn half_width(&self) -> f32 {
        self.right.max(-self.left)
    }
}

impl View {
    fn new(figure: &Figure, camera: &Camera) -> Self {
        let mut bounds = Bounds::NONE;
        let mut shapes = Vec::new();
        for (part, shape) in &figure.shapes {
            let points: Vec<Point> = shape
                .points()
                .iter()
                .map(|point| camera.project(point))
                .collect();
            bounds = points
                .iter()
                .fold(bounds, |bounds, &point| bounds.with(point, shape.margin()));
            let depths = shape.points().iter().map(|point| camera.depth(point));
            let depth = depths.sum::<f32>() / shape.points().len() as f32;
            let kind = match shape {
                Shape::Rod { width, joints, .. } => {
                    let joints = joints.iter().map(|joint| camera.project(joint)).collect();
                    Kind::Rod {
                        width: *width,
                        joints,
                    }
                }
                Shape::Slab { rounding, .. } => Kind::Slab {
                    rounding: *rounding,
                },
                Shape::Ball { radius, .. } => Kind::Ball { radius: *radius },
            };
            shapes.push(FlatShape {
                color: tint(*part),
                depth,
                points,
                kind,
            });
        }
        shapes.sort_by(|a, b| a.depth.total_cmp(&b.depth));
        Self { shapes, bounds }
    }

    /// Draws the figure with the pelvis at `origin`, at `scale` pixels a metre.
    fn draw(&self, canvas: &mut Canvas, origin: Point, scale: f32) {
        let place = |&(x, y): &Point| (origin.0 + x * scale, origin.1 - y * scale);
        for shape in &self.shapes {
            let points: Vec<Point> = shape.points.iter().map(place).collect();
            // An edge in the colour of the background parts a shape from what lies behind it.
            for (edge, color) in [(EDGE, PANEL), (0.0, shape.color)] {
                match &shape.kind {
                    Kind::Rod { width, .. } => {
                        canvas.line(&points, width * scale + 2.0 * edge, color);
                    }
                    Kind::Slab { rounding } => canvas.area(&points, rounding * scale + edge, color),
                    Kind::Ball { radius } => canvas.disc(points[0], radius * scale + edge, color),
                }
            }
            if let Kind::Rod { width, joints } = &shape.kind {
                for joint in joints {
                    canvas.disc(place(joint), 0.22 * width * scale, PANEL);
                }
            }
        }
    }
}

fn tint(part: Part) -> Rgb {
    match part {
        Part::Middle => MIDDLE,
        Part::Limb(Side::Left) => LEFT,
        Part::Limb(Side::Right) => RIGHT,
    }
}

/// Where the bands are, and how large a metre is: the same for all figures.
struct Layout {
    width: f32,
    height: f32,
    scale: f32,
    bands: Vec<Band>,
}

/// A row of cells, and what its figures span.
struct Band {
    top: f32,
    height: f32,
    human: Bounds,
    robot: Bounds,
}

impl Layout {
    fn new(pairs: &[[View; 2]]) -> Self {
        let half_width = pairs
            .iter()
            .flatten()
            .map(|view| view.bounds.half_width())
            .fold(0.0, f32::max);
        let scale = (CELL_WIDTH / 2.0 - PADDING) / half_width;
        let mut top = HEADER;
        let mut bands = Vec::new();
        for row in pairs.chunks(COLUMNS) {
            let band = Band::new(row, top, scale);
            top += band.height + GAP;
            bands.push(band);
        }
        let columns = pairs.len().min(COLUMNS) as f32;
        let width = 2.0 * MARGIN + columns * CELL_WIDTH + (columns - 1.0) * GAP;
        Self {
            width,
            height: top - GAP + MARGIN,
            scale,
            bands,
        }
    }

    fn draw(&self, canvas: &mut Canvas, index: usize, moment: &Moment, [human, robot]: &[View; 2]) {
        let Band {
            top,
            height,
            human: human_bounds,
            robot: robot_bounds,
        } = &self.bands[index / COLUMNS];
        let column = index % COLUMNS;
        let left = MARGIN + column as f32 * (CELL_WIDTH + GAP);
        let right = left + CELL_WIDTH;
        canvas.area(
            &[
                (left, *top),
                (right, *top),
                (right, top + height),
                (left, top + height),
            ],
            0.0,
            PANEL,
        );
        caption(canvas, (left, *top), moment);

        let middle = left + CELL_WIDTH / 2.0;
        let human_top = top + CAPTION + PADDING;
        let human_bottom = human_top + human_bounds.height() * self.scale;
        let robot_top = human_bottom + 1.5 * PADDING;
        let robot_bottom = robot_top + robot_bounds.height() * self.scale;
        if column == 0 {
            canvas.text(
                (left + INSET, human_bottom),
                22.0,
                Align::Left,
                FAINT,
                "person",
            );
            canvas.text(
                (left + INSET, robot_bottom),
                22.0,
                Align::Left,
                FAINT,
                "robot",
            );
        }
        canvas.ellipse(
            (middle, robot_bottom - 6.0),
            (CELL_WIDTH * 0.24, 12.0),
            GROUND,
        );
        human.draw(
            canvas,
            (middle, human_top + human_bounds.top * self.scale),
            self.scale,
        );
        robot.draw(
            canvas,
            (middle, robot_top + robot_bounds.top * self.scale),
            self.scale,
        );
    }
}

impl Band {
    fn new(pairs: &[[View; 2]], top: f32, scale: f32) -> Self {
        let [human, robot] = [0, 1].map(|row| {
            pairs
                .iter()
                .fold(Bounds::NONE, |bounds, pair| bounds.union(pair[row].bounds))
        });
        let height = CAPTION + (human.height() + robot.height()) * scale + 3.5 * PADDING;
        Self {
            top,
            height,
            human,
            robot,
        }
    }
}

fn caption(canvas: &mut Canvas, (left, top): Point, moment: &Moment) {
    let right = left + CELL_WIDTH - INSET;
    let line = top + 36.0;
    canvas.text(
        (left + INSET, line),
        27.0,
        Align::Left,
        INK,
        &format!("{:.1} s", moment.time),
    );
    canvas.text((right, line), 27.0, Align::Right, INK, &moment.name);
    let error = format!("arm directions {:.1}° apart", moment.direction_error_deg);
    canvas.text(
        (left + INSET, line + 28.0),
        21.0,
        Align::Left,
        FAINT,
        &error,
    );
}

#[cfg(test)]
mod tests {
    use emp_motion::skills;
    use tiny_skia::Pixmap;

    use super::*;

    fn moment(time: f64) -> Moment {
        let frame = skills::medley(1).frames[(time * 50.0) as usize].clone();
        let leg = |y: f32| {
            [
                (0.0, -0.1),
                (0.1, -0.45),
                (0.0, -0.8),
                (-0.1, -0.85),
                (0.15, -0.85),
            ]
            .map(|(x, z)| Vector3::new(x, y, z))
            .to_vec()
        };
        Moment {
            time,
            name: "reach-overhead".to_owned(),
            direction_error_deg: 1.0,
            human: frame.clone(),
            robot: frame,
            legs: [leg(0.1), leg(-0.1)],
        }
    }

    fn draw(moments: &[Moment]) -> Pixmap {
        let png = Sheet {
            title: "title",
            subtitle: "subtitle",
            moments,
        }
        .png()
        .unwrap();
        Pixmap::decode_png(&png).unwrap()
    }

    #[test]
    fn left_is_drawn_on_the_right_of_a_figure_that_faces_us() {
        let pixels = draw(&[moment(0.0)]);
        let center = |rgb: Rgb| {
            let columns =
                (0..pixels.height()).flat_map(|y| (0..pixels.width()).map(move |x| (x, y)));
            let [red, green, blue] = rgb;
            let found: Vec<u32> = columns
                .filter(|&(_, y)| y > HEADER as u32)
                .filter(|&(x, y)| {
                    let pixel = pixels.pixel(x, y).unwrap();
                    [pixel.red(), pixel.green(), pixel.blue()] == [red, green, blue]
                })
                .map(|(x, _)| x)
                .collect();
            assert!(found.len() > 1000, "{rgb:?}: {} pixels", found.len());
            found.iter().sum::<u32>() / found.len() as u32
        };
        assert!(center(LEFT) > center(RIGHT) + 20);
    }

    #[test]
    fn the_sheet_grows_with_its_moments() {
        let moments: Vec<Moment> = (0..5).map(|index| moment(f64::from(index))).collect();
        let [one, four, five] = [1, 4, 5].map(|count| draw(&moments[..count]));
        assert!(one.width() < four.width() && four.width() == five.width());
        assert!(five.height() > four.height() + 400);
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        assert!(
            Sheet {
                title: "",
                subtitle: "",
                moments: &[]
            }
            .png()
            .is_err()
        );
    }
}

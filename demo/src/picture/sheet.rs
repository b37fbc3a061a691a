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
const CAPTION: f32 = 64.0;
const GAP: f32 = 20.0;
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
        let human = Figure::new(&self.human, None);
        let robot = Figure::new(&self.robot, Some(&self.legs));
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
    Rod { width: f32 },
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
                Shape::Rod { width, .. } => Kind::Rod { width: *width },
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
            for (edge, color) in [(3.0, PANEL), (0.0, shape.color)] {
                match shape.kind {
                    Kind::Rod { width } => canvas.line(&points, width * scale + 2.0 * edge, color),
                    Kind::Slab { rounding } => canvas.area(&points, rounding * scale + edge, color),
                    Kind::Ball { radius } => {
                        let radius = radius * scale + edge;
                        canvas.ellipse(points[0], (radius, radius), color);
                    }
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

/// Where the cells are, and how large a metre is: the same for all figures.
struct Layout {
    width: f32,
    height: f32,
    scale: f32,
    cell_height: f32,
    human: Bounds,
    robot: Bounds,
}

impl Layout {
    fn new(pairs: &[[View; 2]]) -> Self {
        let [human, robot] = [0, 1].map(|row| {
            pairs
                .iter()
                .fold(Bounds::NONE, |bounds, pair| bounds.union(pair[row].bounds))
        });
        let scale = (CELL_WIDTH / 2.0 - PADDING) / human.half_width().max(robot.half_width());
        let cell_height = CAPTION + (human.height() + robot.height()) * scale + 3.0 * PADDING;
        let rows = pairs.len().div_ceil(COLUMNS) as f32;
        let columns = pairs.len().min(COLUMNS) as f32;
        Self {
            width: 2.0 * MARGIN + columns * CELL_WIDTH + (columns - 1.0) * GAP,
            height: HEADER + rows * (cell_height + GAP) - GAP + MARGIN,
            scale,
            cell_height,
            human,
            robot,
        }
    }

    fn draw(&self, canvas: &mut Canvas, index: usize, moment: &Moment, [human, robot]: &[View; 2]) {
        let left = MARGIN + (index % COLUMNS) as f32 * (CELL_WIDTH + GAP);
        let top = HEADER + (index / COLUMNS) as f32 * (self.cell_height + GAP);
        let corners = [
            (0.0, 0.0),
            (CELL_WIDTH, 0.0),
            (CELL_WIDTH, self.cell_height),
            (0.0, self.cell_height),
        ];
        canvas.area(&corners.map(|(x, y)| (left + x, top + y)), 0.0, PANEL);
        self.caption(canvas, (left, top), moment);

        let middle = left + CELL_WIDTH / 2.0;
        let human_waist = top + CAPTION + PADDING + self.human.top * self.scale;
        human.draw(canvas, (middle, human_waist), self.scale);

        let robot_top = top + CAPTION + 2.0 * PADDING + self.human.height() * self.scale;
        let robot_waist = robot_top + self.robot.top * self.scale;
        let feet = robot_top + self.robot.height() * self.scale;
        canvas.ellipse((middle, feet - 6.0), (CELL_WIDTH * 0.24, 12.0), GROUND);
        robot.draw(canvas, (middle, robot_waist), self.scale);
    }

    fn caption(&self, canvas: &mut Canvas, (left, top): Point, moment: &Moment) {
        let inset = 16.0;
        let time = format!("{:.1} s", moment.time);
        canvas.text((left + inset, top + 34.0), 26.0, Align::Left, INK, &time);
        canvas.text(
            (left + CELL_WIDTH - inset, top + 34.0),
            26.0,
            Align::Right,
            INK,
            &moment.name,
        );
        let error = format!("arm directions {:.1}° apart", moment.direction_error_deg);
        canvas.text((left + inset, top + 62.0), 20.0, Align::Left, FAINT, &error);
    }
}

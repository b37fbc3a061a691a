//! Figures as a camera sees them, and the colours of all pictures.

use emp_motion::Side;
use nalgebra::Vector3;

use super::canvas::{Canvas, Point, Rgb};
use super::figure::{Figure, Part, Shape};

pub(super) const BACKGROUND: Rgb = [255, 255, 255];
pub(super) const PANEL: Rgb = [244, 246, 248];
pub(super) const INK: Rgb = [38, 46, 56];
pub(super) const FAINT: Rgb = [120, 130, 142];
pub(super) const GROUND: Rgb = [205, 211, 218];
pub(super) const MIDDLE: Rgb = [96, 108, 122];
pub(super) const LEFT: Rgb = [0, 114, 178];
pub(super) const RIGHT: Rgb = [213, 94, 0];

/// Width of the edge around shapes, pixels.
const EDGE: f32 = 3.0;

/// A parallel projection.
pub(super) struct Camera {
    right: Vector3<f32>,
    up: Vector3<f32>,
    /// From the figure to the camera.
    toward: Vector3<f32>,
}

impl Camera {
    /// In front of the figure, somewhat to its left and above: depth shows, and neither arm hides the other.
    pub(super) fn front_left() -> Self {
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

    /// On the figure's right, level with it: forward is to the right of the picture, and heights are true.
    pub(super) fn right_side() -> Self {
        Self {
            right: Vector3::x(),
            up: Vector3::z(),
            toward: -Vector3::y(),
        }
    }

    /// Metres to the right and up, seen from the camera.
    pub(super) fn project(&self, point: &Vector3<f32>) -> Point {
        (self.right.dot(point), self.up.dot(point))
    }

    /// Nearness to the camera, metres.
    fn depth(&self, point: &Vector3<f32>) -> f32 {
        self.toward.dot(point)
    }
}

/// A figure as the camera sees it: flat shapes from far to near.
pub(super) struct View {
    shapes: Vec<FlatShape>,
    pub(super) bounds: Bounds,
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
pub(super) struct Bounds {
    pub(super) left: f32,
    pub(super) right: f32,
    pub(super) bottom: f32,
    pub(super) top: f32,
}

impl Bounds {
    pub(super) const NONE: Self = Self {
        left: f32::INFINITY,
        right: f32::NEG_INFINITY,
        bottom: f32::INFINITY,
        top: f32::NEG_INFINITY,
    };

    pub(super) fn with(self, (x, y): Point, margin: f32) -> Self {
        Self {
            left: self.left.min(x - margin),
            right: self.right.max(x + margin),
            bottom: self.bottom.min(y - margin),
            top: self.top.max(y + margin),
        }
    }

    pub(super) fn union(self, other: Self) -> Self {
        self.with((other.left, other.bottom), 0.0)
            .with((other.right, other.top), 0.0)
    }

    pub(super) fn height(&self) -> f32 {
        self.top - self.bottom
    }

    /// Largest distance to either side of the pelvis.
    pub(super) fn half_width(&self) -> f32 {
        self.right.max(-self.left)
    }
}

impl View {
    pub(super) fn new(figure: &Figure, camera: &Camera) -> Self {
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

    /// Draws the figure with its origin at `origin`, at `scale` pixels a metre.
    pub(super) fn draw(&self, canvas: &mut Canvas, origin: Point, scale: f32) {
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

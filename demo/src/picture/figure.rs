//! From key nodes to something with a body: limbs, a trunk and a head in space.

use emp_motion::{KeyNode, KeyNodeFrame, Side};
use nalgebra::Vector3;

/// Which part of a body a shape belongs to; decides its colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// Trunk and head.
    Middle,
    /// An arm or leg.
    Limb(Side),
}

/// A shape in the pelvis frame, metres.
pub(super) enum Shape {
    /// A round rod through points.
    Rod {
        points: Vec<Vector3<f32>>,
        width: f32,
    },
    /// A slab with round corners.
    Slab {
        corners: Vec<Vector3<f32>>,
        rounding: f32,
    },
    /// A ball.
    Ball { center: Vector3<f32>, radius: f32 },
}

/// A body to be drawn: its shapes, each with the part that it belongs to.
pub(super) struct Figure {
    pub(super) shapes: Vec<(Part, Shape)>,
}

/// The points of one leg from the hip to the ankle, then heel and toe, in the pelvis frame, metres.
pub(crate) type Leg = Vec<Vector3<f32>>;

impl Figure {
    /// A body from its key nodes; legs only where they are known.
    pub(super) fn new(frame: &KeyNodeFrame, legs: Option<&[Leg; 2]>) -> Self {
        let mut figure = Self { shapes: Vec::new() };
        // All widths follow the body's own size.
        let size = shoulder_width(frame);
        figure.trunk(frame, size);
        for side in Side::BOTH {
            if let Some(legs) = legs {
                let points = legs[side as usize].clone();
                figure.add(
                    Part::Limb(side),
                    Shape::Rod {
                        points,
                        width: 0.22 * size,
                    },
                );
            }
            figure.arm(frame, side, size);
        }
        figure
    }

    fn add(&mut self, part: Part, shape: Shape) {
        self.shapes.push((part, shape));
    }

    fn trunk(&mut self, frame: &KeyNodeFrame, size: f32) {
        let waist = frame.position(KeyNode::Waist);
        let [left, right] = shoulders(frame);
        let neck = (left + right) / 2.0;
        let spine = (neck - waist)
            .try_normalize(1e-6)
            .unwrap_or_else(Vector3::z);
        let hip = Vector3::y() * (0.24 * size);
        let inset = (left - right) * 0.08;
        let corners = vec![left - inset, right + inset, waist - hip, waist + hip];
        self.add(
            Part::Middle,
            Shape::Slab {
                corners,
                rounding: 0.1 * size,
            },
        );

        let head = neck + spine * (0.62 * size);
        let forward = (left - right)
            .cross(&spine)
            .try_normalize(1e-6)
            .unwrap_or_else(Vector3::x);
        let throat = vec![neck, neck + spine * (0.35 * size)];
        self.add(
            Part::Middle,
            Shape::Rod {
                points: throat,
                width: 0.2 * size,
            },
        );
        self.add(
            Part::Middle,
            Shape::Ball {
                center: head,
                radius: 0.28 * size,
            },
        );
        // A nose shows which way the body faces.
        let nose = vec![
            head + forward * (0.2 * size),
            head + forward * (0.36 * size),
        ];
        self.add(
            Part::Middle,
            Shape::Rod {
                points: nose,
                width: 0.1 * size,
            },
        );
    }

    fn arm(&mut self, frame: &KeyNodeFrame, side: Side, size: f32) {
        let part = Part::Limb(side);
        let [shoulder, elbow, wrist] = side.arm().map(|node| frame.position(node));
        self.add(
            part,
            Shape::Rod {
                points: vec![shoulder, elbow],
                width: 0.2 * size,
            },
        );
        self.add(
            part,
            Shape::Rod {
                points: vec![elbow, wrist],
                width: 0.17 * size,
            },
        );
        match frame.wrist_rotations[side as usize] {
            Some(rotation) => {
                let [fingers, thumb] = [rotation * Vector3::x(), rotation * Vector3::z()];
                let palm = wrist + fingers * (0.2 * size);
                self.add(
                    part,
                    Shape::Rod {
                        points: vec![wrist, wrist + fingers * (0.42 * size)],
                        width: 0.12 * size,
                    },
                );
                self.add(
                    part,
                    Shape::Rod {
                        points: vec![palm, palm + thumb * (0.2 * size)],
                        width: 0.08 * size,
                    },
                );
            }
            None => self.add(
                part,
                Shape::Ball {
                    center: wrist,
                    radius: 0.14 * size,
                },
            ),
        }
    }
}

impl Shape {
    /// The points that span the shape.
    pub(super) fn points(&self) -> &[Vector3<f32>] {
        match self {
            Self::Rod { points, .. } => points,
            Self::Slab { corners, .. } => corners,
            Self::Ball { center, .. } => std::slice::from_ref(center),
        }
    }

    /// How far the shape reaches beyond its points.
    pub(super) fn margin(&self) -> f32 {
        match self {
            Self::Rod { width, .. } => width / 2.0,
            Self::Slab { rounding, .. } => *rounding,
            Self::Ball { radius, .. } => *radius,
        }
    }
}

fn shoulders(frame: &KeyNodeFrame) -> [Vector3<f32>; 2] {
    [KeyNode::LeftShoulder, KeyNode::RightShoulder].map(|node| frame.position(node))
}

fn shoulder_width(frame: &KeyNodeFrame) -> f32 {
    let [left, right] = shoulders(frame);
    (left - right).norm()
}

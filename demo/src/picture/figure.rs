//! From key nodes to something with a body: limbs, a trunk and a head in space.

use emp_motion::{KeyNode, KeyNodeFrame, Side};
use nalgebra::{Isometry3, Point3, Vector3};

/// Which part of a body a shape belongs to; decides its colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// Trunk and head.
    Middle,
    /// An arm or leg.
    Limb(Side),
}

/// A shape in the figure's frame, metres.
pub(super) enum Shape {
    /// A round rod through points, and the joints that show on it.
    Rod {
        points: Vec<Vector3<f32>>,
        width: f32,
        joints: Vec<Vector3<f32>>,
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

/// The points of one leg in the pelvis frame, metres: its joints from the hip down, then heel and toes.
pub(crate) type Leg = Vec<Vector3<f32>>;

/// How many points of a leg follow its last joint.
const SOLE: usize = 2;

impl Figure {
    /// A person from the key nodes alone.
    pub(super) fn person(frame: &KeyNodeFrame) -> Self {
        Self::with_arms(frame, false)
    }

    /// A robot: with hips and legs, and with joints that show.
    pub(super) fn robot(frame: &KeyNodeFrame, legs: &[Leg; 2]) -> Self {
        let mut figure = Self::with_arms(frame, true);
        let size = shoulder_width(frame);
        if let [Some(left), Some(right)] = [legs[0].first(), legs[1].first()] {
            let waist = frame.position(KeyNode::Waist);
            figure.rod(Part::Middle, &[*left, waist, *right], 0.3 * size, &[]);
        }
        for side in Side::BOTH {
            figure.leg(&legs[side as usize], side, size);
        }
        figure
    }

    /// The figure elsewhere: every point moved by `placement`.
    pub(super) fn placed(mut self, placement: &Isometry3<f32>) -> Self {
        for (_, shape) in &mut self.shapes {
            shape.each_point(|point| *point = (placement * Point3::from(*point)).coords);
        }
        self
    }

    fn with_arms(frame: &KeyNodeFrame, joints: bool) -> Self {
        let mut figure = Self { shapes: Vec::new() };
        // All widths follow the body's own size.
        let size = shoulder_width(frame);
        figure.trunk(frame, size);
        for side in Side::BOTH {
            figure.arm(frame, side, size, joints);
        }
        figure
    }

    fn add(&mut self, part: Part, shape: Shape) {
        self.shapes.push((part, shape));
    }

    fn rod(&mut self, part: Part, points: &[Vector3<f32>], width: f32, joints: &[Vector3<f32>]) {
        self.add(
            part,
            Shape::Rod {
                points: points.to_vec(),
                width,
                joints: joints.to_vec(),
            },
        );
    }

    fn leg(&mut self, leg: &Leg, side: Side, size: f32) {
        let (part, width) = (Part::Limb(side), 0.22 * size);
        let Some(knee) = knee(leg) else { return };
        self.rod(part, &leg[..=knee], width, &[leg[0], leg[knee]]);
        self.rod(part, &leg[knee..], width, &[leg[knee]]);
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
        let throat = [neck, neck + spine * (0.35 * size)];
        self.rod(Part::Middle, &throat, 0.2 * size, &[]);
        self.add(
            Part::Middle,
            Shape::Ball {
                center: head,
                radius: 0.28 * size,
            },
        );
        // A nose shows which way the body faces.
        let nose = [
            head + forward * (0.2 * size),
            head + forward * (0.36 * size),
        ];
        self.rod(Part::Middle, &nose, 0.1 * size, &[]);
    }

    fn arm(&mut self, frame: &KeyNodeFrame, side: Side, size: f32, joints: bool) {
        let part = Part::Limb(side);
        let [shoulder, elbow, wrist] = side.arm().map(|node| frame.position(node));
        let shown = |all: &[Vector3<f32>]| if joints { all.to_vec() } else { Vec::new() };
        self.rod(
            part,
            &[shoulder, elbow],
            0.2 * size,
            &shown(&[shoulder, elbow]),
        );
        self.rod(part, &[elbow, wrist], 0.17 * size, &shown(&[elbow, wrist]));
        match frame.wrist_rotations[side as usize] {
            Some(rotation) => {
                let [fingers, thumb] = [rotation * Vector3::x(), rotation * Vector3::z()];
                let palm = wrist + fingers * (0.2 * size);
                self.rod(
                    part,
                    &[wrist, wrist + fingers * (0.42 * size)],
                    0.12 * size,
                    &shown(&[wrist]),
                );
                self.rod(part, &[palm, palm + thumb * (0.2 * size)], 0.08 * size, &[]);
            }
            None => self.add(
                part,
                Shape::Ball {
                    center: wrist,
                    radius: 0.12 * size,
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

    fn each_point(&mut self, change: impl FnMut(&mut Vector3<f32>)) {
        match self {
            Self::Rod { points, joints, .. } => points.iter_mut().chain(joints).for_each(change),
            Self::Slab { corners, .. } => corners.iter_mut().for_each(change),
            Self::Ball { center, .. } => std::iter::once(center).for_each(change),
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

/// Index of the joint in the middle of the leg: the one that is farthest from both its ends.
fn knee(leg: &Leg) -> Option<usize> {
    let joints = &leg[..leg.len().checked_sub(SOLE)?];
    let (first, last) = (joints.first()?, joints.last()?);
    let inside = |index: &usize| {
        (joints[*index] - first)
            .norm()
            .min((joints[*index] - last).norm())
    };
    (0..joints.len()).max_by(|a, b| inside(a).total_cmp(&inside(b)))
}

fn shoulders(frame: &KeyNodeFrame) -> [Vector3<f32>; 2] {
    [KeyNode::LeftShoulder, KeyNode::RightShoulder].map(|node| frame.position(node))
}

fn shoulder_width(frame: &KeyNodeFrame) -> f32 {
    let [left, right] = shoulders(frame);
    (left - right).norm()
}

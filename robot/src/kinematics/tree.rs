//! The kinematic tree, taken once from a compiled MuJoCo model.

use mujoco_rs::prelude::*;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::scalar::Scalar;

/// An axis closer than this to x, y or z counts as that axis.
const AXIS_TOLERANCE: f64 = 1e-12;

/// One moving link: what stands between a joint and the next ones, rigid bodies fused.
///
/// Nodes are described in the pose where every joint is zero: there a node's frame has the base's orientation, and
/// its origin is on the joint's axis. So the only rotation between a node and its parent is the joint's own, and a
/// joint about x, y or z costs no more than mixing two columns.
#[derive(Clone, Debug)]
pub(super) struct Node<T> {
    /// Index of the parent node, which comes earlier. The base, node 0, is its own.
    pub(super) parent: usize,
    /// Column of the joint in a joint vector; unused for the base.
    pub(super) joint: usize,
    /// Origin in the parent's frame.
    pub(super) offset: [T; 3],
    /// The joint.
    pub(super) turn: Turn<T>,
    /// Mass of the link over the robot's mass.
    pub(super) mass: T,
    /// That mass times the link's centre of mass in the node's frame.
    pub(super) moment: [T; 3],
}

/// Rotation of a node about its joint's axis.
#[derive(Clone, Copy, Debug)]
pub(super) enum Turn<T> {
    /// The base: no joint.
    None,
    /// About +x.
    X,
    /// About +y.
    Y,
    /// About +z.
    Z,
    /// About any unit axis: R = `fixed` + sin·`sine` + cos·`cosine`, matrices column by column.
    Axis {
        axis: [T; 3],
        fixed: [T; 9],
        sine: [T; 9],
        cosine: [T; 9],
    },
}

/// A point that moves with a node; `offset` in the node's frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point<T> {
    pub(super) node: usize,
    pub(super) offset: [T; 3],
}

/// A frame that turns with a node: its axes x, y, z in the node's frame, one after the other.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame<T> {
    pub(super) node: usize,
    pub(super) axes: [T; 9],
}

/// The tree and all that is computed from it.
#[derive(Clone, Debug)]
pub struct Tree<T> {
    /// Length of a joint vector.
    pub(super) dof: usize,
    pub(super) nodes: Vec<Node<T>>,
    /// Key nodes, then link centres.
    pub(super) points: Vec<Point<T>>,
    /// Left and right.
    pub(super) wrists: [Frame<T>; 2],
    /// Centres of the soles, left and right.
    pub(super) soles: [Point<T>; 2],
    /// Centres of the spheres that touch the floor, both feet's.
    pub(super) foot_contacts: Vec<Point<T>>,
}

/// What is attached to the bodies of a model, in the frames of those bodies (given by their ids).
pub(crate) struct Attached {
    pub(crate) key_nodes: Vec<(usize, Vector3<f64>)>,
    pub(crate) links: Vec<(usize, Vector3<f64>)>,
    /// Columns x, y, z.
    pub(crate) wrists: [(usize, Matrix3<f64>); 2],
    pub(crate) soles: [(usize, Vector3<f64>); 2],
    pub(crate) foot_contacts: Vec<(usize, Vector3<f64>)>,
}

/// A body in the pose where every joint is zero, in the base's frame, and the node that carries it.
#[derive(Clone, Copy)]
struct Body {
    position: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
    node: usize,
}

impl Body {
    fn point(&self, local: &[f64; 3]) -> Vector3<f64> {
        self.position + self.rotation * Vector3::from(*local)
    }
}

/// The tree while it is taken out of a model: nodes with their origins in the zero pose.
struct Builder<'a> {
    model: &'a MjModel,
    nodes: Vec<Node<f64>>,
    origins: Vec<Vector3<f64>>,
    bodies: Vec<Body>,
}

impl Tree<f64> {
    /// Takes the tree of body `base` out of `model`; `columns[joint id]` is the joint's column in a joint vector.
    ///
    /// Every joint below the base is a hinge with a column: the caller has checked that.
    pub(super) fn new(
        model: &MjModel,
        base: usize,
        columns: &[usize],
        dof: usize,
        attached: &Attached,
    ) -> Self {
        let mut builder = Builder::new(model);
        for body in base..model.body_mass().len() {
            if model.body_rootid()[body] as usize == base {
                builder.body(body, base, columns);
            }
        }
        builder.finish(dof, attached)
    }

    /// The same tree in another precision.
    pub(super) fn cast<T: Scalar>(&self) -> Tree<T> {
        Tree {
            dof: self.dof,
            nodes: self.nodes.iter().map(Node::cast).collect(),
            points: self.points.iter().map(Point::cast).collect(),
            wrists: self.wrists.map(|wrist| wrist.cast()),
            soles: self.soles.map(|sole| sole.cast()),
            foot_contacts: self.foot_contacts.iter().map(Point::cast).collect(),
        }
    }
}

impl<'a> Builder<'a> {
    fn new(model: &'a MjModel) -> Self {
        let body = Body {
            position: Vector3::zeros(),
            rotation: UnitQuaternion::identity(),
            node: 0,
        };
        Self {
            model,
            nodes: vec![Node::new(0, 0, Vector3::zeros(), Turn::None)],
            origins: vec![Vector3::zeros()],
            bodies: vec![body; model.body_mass().len()],
        }
    }

    /// Places a body, whose parent is placed, and adds a node for each of its joints.
    fn body(&mut self, id: usize, base: usize, columns: &[usize]) {
        let model = self.model;
        if id != base {
            let parent = self.bodies[model.body_parentid()[id] as usize];
            let [w, x, y, z] = model.body_quat()[id];
            self.bodies[id] = Body {
                position: parent.point(&model.body_pos()[id]),
                rotation: parent.rotation
                    * UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
                node: parent.node,
            };
            for (joint, &column) in columns.iter().enumerate() {
                if model.jnt_bodyid()[joint] as usize == id {
                    self.joint(id, joint, column);
                }
            }
        }
        let Body { node, .. } = self.bodies[id];
        let mass = model.body_mass()[id];
        let center = self.bodies[id].point(&model.body_ipos()[id]) - self.origins[node];
        self.nodes[node].mass += mass;
        for (moment, center) in self.nodes[node].moment.iter_mut().zip(center.iter()) {
            *moment += mass * center;
        }
    }

    fn joint(&mut self, body: usize, joint: usize, column: usize) {
        let parent = self.bodies[body].node;
        let anchor = self.bodies[body].point(&self.model.jnt_pos()[joint]);
        let axis = self.bodies[body].rotation * Vector3::from(self.model.jnt_axis()[joint]);
        let offset = anchor - self.origins[parent];
        self.bodies[body].node = self.nodes.len();
        self.nodes.push(Node::new(
            parent,
            column,
            offset,
            Turn::new(axis.normalize()),
        ));
        self.origins.push(anchor);
    }

    fn finish(mut self, dof: usize, attached: &Attached) -> Tree<f64> {
        let total: f64 = self.nodes.iter().map(|node| node.mass).sum();
        for node in &mut self.nodes {
            node.mass /= total;
            node.moment = node.moment.map(|moment| moment / total);
        }
        let point = |(body, local): &(usize, Vector3<f64>)| self.point(*body, local);
        let frame = |(body, axes): &(usize, Matrix3<f64>)| self.frame(*body, axes);
        Tree {
            dof,
            points: attached
                .key_nodes
                .iter()
                .chain(&attached.links)
                .map(point)
                .collect(),
            wrists: attached.wrists.each_ref().map(frame),
            soles: attached.soles.each_ref().map(point),
            foot_contacts: attached.foot_contacts.iter().map(point).collect(),
            nodes: self.nodes,
        }
    }

    fn point(&self, body: usize, local: &Vector3<f64>) -> Point<f64> {
        let body = &self.bodies[body];
        let offset = body.position + body.rotation * local - self.origins[body.node];
        Point {
            node: body.node,
            offset: offset.into(),
        }
    }

    fn frame(&self, body: usize, axes: &Matrix3<f64>) -> Frame<f64> {
        let body = &self.bodies[body];
        Frame {
            node: body.node,
            axes: columns(&(body.rotation.to_rotation_matrix() * axes)),
        }
    }
}

impl Node<f64> {
    fn new(parent: usize, joint: usize, offset: Vector3<f64>, turn: Turn<f64>) -> Self {
        Self {
            parent,
            joint,
            offset: offset.into(),
            turn,
            mass: 0.0,
            moment: [0.0; 3],
        }
    }

    fn cast<T: Scalar>(&self) -> Node<T> {
        Node {
            parent: self.parent,
            joint: self.joint,
            offset: self.offset.map(T::from_f64),
            turn: self.turn.cast(),
            mass: T::from_f64(self.mass),
            moment: self.moment.map(T::from_f64),
        }
    }
}

impl Turn<f64> {
    fn new(axis: Vector3<f64>) -> Self {
        for (unit, turn) in [
            (Vector3::x(), Self::X),
            (Vector3::y(), Self::Y),
            (Vector3::z(), Self::Z),
        ] {
            if (axis - unit).norm() < AXIS_TOLERANCE {
                return turn;
            }
        }
        let fixed = axis * axis.transpose();
        Self::Axis {
            axis: axis.into(),
            fixed: columns(&fixed),
            sine: columns(&axis.cross_matrix()),
            cosine: columns(&(Matrix3::identity() - fixed)),
        }
    }

    fn cast<T: Scalar>(&self) -> Turn<T> {
        match self {
            Self::None => Turn::None,
            Self::X => Turn::X,
            Self::Y => Turn::Y,
            Self::Z => Turn::Z,
            Self::Axis {
                axis,
                fixed,
                sine,
                cosine,
            } => Turn::Axis {
                axis: axis.map(T::from_f64),
                fixed: fixed.map(T::from_f64),
                sine: sine.map(T::from_f64),
                cosine: cosine.map(T::from_f64),
            },
        }
    }
}

impl Point<f64> {
    fn cast<T: Scalar>(&self) -> Point<T> {
        Point {
            node: self.node,
            offset: self.offset.map(T::from_f64),
        }
    }
}

impl Frame<f64> {
    fn cast<T: Scalar>(&self) -> Frame<T> {
        Frame {
            node: self.node,
            axes: self.axes.map(T::from_f64),
        }
    }
}

fn columns(matrix: &Matrix3<f64>) -> [f64; 9] {
    let mut columns = [0.0; 9];
    columns.copy_from_slice(matrix.as_slice());
    columns
}

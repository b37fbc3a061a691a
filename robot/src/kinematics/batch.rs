//! Forward and reverse pass over a few poses at once.

use super::lane::{LANES, Lane, Vec3, cross, difference, dot, sum};
use super::scalar::Scalar;
use super::tree::{Frame, Node, Point, Tree, Turn};

/// Where a node is, in the base's frame: the columns of its rotation, and its origin.
#[derive(Clone, Copy)]
pub(super) struct Pose<T> {
    columns: [Vec3<T>; 3],
    origin: Vec3<T>,
}

impl<T: Scalar> Pose<T> {
    pub(super) fn base() -> Self {
        let (zero, one) = (Lane::ZERO, Lane::ONE);
        Self {
            columns: [[one, zero, zero], [zero, one, zero], [zero, zero, one]],
            origin: [zero; 3],
        }
    }

    /// The node's rotation times a constant vector of its frame.
    #[inline(always)]
    fn rotate(&self, [x, y, z]: [T; 3]) -> Vec3<T> {
        let [a, b, c] = &self.columns;
        [
            a[0] * x + b[0] * y + c[0] * z,
            a[1] * x + b[1] * y + c[1] * z,
            a[2] * x + b[2] * y + c[2] * z,
        ]
    }

    #[inline(always)]
    pub(super) fn point(&self, offset: [T; 3]) -> Vec3<T> {
        sum(self.origin, self.rotate(offset))
    }

    /// The pose of a child node whose joint stands at `angle`.
    #[inline(always)]
    fn child(&self, node: &Node<T>, angle: Lane<T>) -> Self {
        let (sine, cosine) = angle.sin_cos();
        let [x, y, z] = self.columns;
        let columns = match &node.turn {
            Turn::None => [x, y, z],
            Turn::X => {
                let (y, z) = mix(y, z, sine, cosine);
                [x, y, z]
            }
            Turn::Y => {
                let (z, x) = mix(z, x, sine, cosine);
                [x, y, z]
            }
            Turn::Z => {
                let (x, y) = mix(x, y, sine, cosine);
                [x, y, z]
            }
            Turn::Axis {
                fixed,
                sine: by_sine,
                cosine: by_cosine,
                ..
            } => {
                let turn = |i: usize| {
                    let [a, b, c] = [3 * i, 3 * i + 1, 3 * i + 2]
                        .map(|k| sine * by_sine[k] + cosine * by_cosine[k] + Lane::ONE * fixed[k]);
                    [0, 1, 2].map(|row| x[row] * a + y[row] * b + z[row] * c)
                };
                [turn(0), turn(1), turn(2)]
            }
        };
        Self {
            columns,
            origin: self.point(node.offset),
        }
    }

    /// The joint's axis, which the joint itself does not turn.
    #[inline(always)]
    fn axis(&self, node: &Node<T>) -> Vec3<T> {
        match &node.turn {
            Turn::None => [Lane::ZERO; 3],
            Turn::X => self.columns[0],
            Turn::Y => self.columns[1],
            Turn::Z => self.columns[2],
            Turn::Axis { axis, .. } => self.rotate(*axis),
        }
    }
}

/// Turns the column pair (a, b) in its plane: a right-handed rotation about the third column.
#[inline(always)]
fn mix<T: Scalar>(a: Vec3<T>, b: Vec3<T>, sine: Lane<T>, cosine: Lane<T>) -> (Vec3<T>, Vec3<T>) {
    let row = |i: usize| (cosine * a[i] + sine * b[i], cosine * b[i] - sine * a[i]);
    let [(a0, b0), (a1, b1), (a2, b2)] = [row(0), row(1), row(2)];
    ([a0, a1, a2], [b0, b1, b2])
}

/// Reads column `column` of up to [`LANES`] rows of `width`; missing rows are zero.
#[inline(always)]
fn gather<T: Scalar>(rows: &[T], width: usize, column: usize) -> Lane<T> {
    let mut lane = Lane::ZERO;
    for (slot, value) in lane.0.iter_mut().zip(rows[column..].iter().step_by(width)) {
        *slot = *value;
    }
    lane
}

/// Writes columns `column`, … of up to [`LANES`] rows of `width`.
#[inline(always)]
fn scatter<T: Scalar, const N: usize>(
    rows: &mut [T],
    width: usize,
    column: usize,
    values: &[Lane<T>; N],
) {
    for (i, row) in rows.chunks_exact_mut(width).enumerate() {
        for (out, value) in row[column..column + N].iter_mut().zip(values) {
            *out = value.0[i];
        }
    }
}

impl<T: Scalar> Tree<T> {
    /// Width of an output row: key nodes and link centres, two wrist rotations, centre of mass, foot support.
    pub(super) fn width(&self) -> usize {
        3 * self.points.len() + 2 * 9 + 3 + 3
    }

    /// Poses of all nodes at up to [`LANES`] joint vectors.
    pub(super) fn poses(&self, q: &[T], poses: &mut [Pose<T>]) {
        poses[0] = Pose::base();
        for (i, node) in self.nodes.iter().enumerate().skip(1) {
            poses[i] = poses[node.parent].child(node, gather(q, self.dof, node.joint));
        }
    }

    /// Output rows from the poses of all nodes.
    pub(super) fn write(&self, poses: &[Pose<T>], key_nodes: usize, out: &mut [T]) {
        let width = self.width();
        let mut column = 0;
        let point = |point: &Point<T>| poses[point.node].point(point.offset);
        for key_node in &self.points[..key_nodes] {
            scatter(out, width, column, &point(key_node));
            column += 3;
        }
        for Frame {
            node,
            axes: [a, b, c, d, e, f, g, h, i],
        } in self.wrists
        {
            let pose = &poses[node];
            let [x, y, z] = [
                pose.rotate([a, b, c]),
                pose.rotate([d, e, f]),
                pose.rotate([g, h, i]),
            ];
            let row_major = [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];
            scatter(out, width, column, &row_major);
            column += 9;
        }
        for link in &self.points[key_nodes..] {
            scatter(out, width, column, &point(link));
            column += 3;
        }
        scatter(out, width, column, &self.center_of_mass(poses));
        column += 3;
        let support = sum(point(&self.soles[0]), point(&self.soles[1]));
        let half = T::from_f64(0.5);
        scatter(out, width, column, &support.map(|value| value * half));
    }

    fn center_of_mass(&self, poses: &[Pose<T>]) -> Vec3<T> {
        let mut center = [Lane::ZERO; 3];
        for (node, pose) in self.nodes.iter().zip(poses) {
            let moment = sum(
                pose.rotate(node.moment),
                pose.origin.map(|value| value * node.mass),
            );
            center = sum(center, moment);
        }
        center
    }

    /// Reverse pass: joint gradients from the gradients of output rows, at the poses of the same joint vectors.
    ///
    /// Every output pulls on its node with a force, and a torque about the node's origin. From the tips to the base
    /// a node's torque along its joint's axis is that joint's gradient; force and torque then pass to the parent.
    pub(super) fn pull(
        &self,
        poses: &[Pose<T>],
        key_nodes: usize,
        grad_out: &[T],
        wrenches: &mut [Wrench<T>],
        grad_q: &mut [T],
    ) {
        wrenches.fill(Wrench::ZERO);
        self.collect(poses, key_nodes, grad_out, wrenches);
        for (i, node) in self.nodes.iter().enumerate().skip(1).rev() {
            let Wrench { force, torque } = wrenches[i];
            let slope = dot(poses[i].axis(node), torque);
            scatter(grad_q, self.dof, node.joint, &[slope]);
            let arm = difference(poses[i].origin, poses[node.parent].origin);
            wrenches[node.parent].add(force, sum(torque, cross(arm, force)));
        }
    }

    /// Forces and torques of all outputs on their nodes.
    fn collect(
        &self,
        poses: &[Pose<T>],
        key_nodes: usize,
        grad_out: &[T],
        wrenches: &mut [Wrench<T>],
    ) {
        let width = self.width();
        let read =
            |column: usize| [column, column + 1, column + 2].map(|c| gather(grad_out, width, c));
        let mut column = 0;
        let mut pull = |point: &Point<T>, force: Vec3<T>| {
            wrenches[point.node].add(force, cross(poses[point.node].rotate(point.offset), force));
        };
        for key_node in &self.points[..key_nodes] {
            pull(key_node, read(column));
            column += 3;
        }
        let wrists = column;
        column += 18;
        for link in &self.points[key_nodes..] {
            pull(link, read(column));
            column += 3;
        }
        let half = T::from_f64(0.5);
        let support = read(column + 3).map(|value| value * half);
        for sole in &self.soles {
            pull(sole, support);
        }
        let center = read(column);
        for ((node, pose), wrench) in self.nodes.iter().zip(poses).zip(wrenches.iter_mut()) {
            let force = center.map(|value| value * node.mass);
            wrench.add(force, cross(pose.rotate(node.moment), center));
        }
        for (wrist, start) in self.wrists.iter().zip([wrists, wrists + 9]) {
            let torque = wrist_torque(wrist, &poses[wrist.node], |k| {
                gather(grad_out, width, start + k)
            });
            wrenches[wrist.node].add([Lane::ZERO; 3], torque);
        }
    }
}

/// Torque of a gradient on a row-major rotation: Σ over its columns of column × gradient.
#[inline(always)]
fn wrist_torque<T: Scalar>(
    wrist: &Frame<T>,
    pose: &Pose<T>,
    gradient: impl Fn(usize) -> Lane<T>,
) -> Vec3<T> {
    let mut torque = [Lane::ZERO; 3];
    for column in 0..3 {
        let axis = [0, 1, 2].map(|row| wrist.axes[3 * column + row]);
        let pull = [0, 1, 2].map(|row| gradient(3 * row + column));
        torque = sum(torque, cross(pose.rotate(axis), pull));
    }
    torque
}

/// Force on a node, and torque about the node's origin.
#[derive(Clone, Copy)]
pub(super) struct Wrench<T> {
    force: Vec3<T>,
    torque: Vec3<T>,
}

impl<T: Scalar> Wrench<T> {
    pub(super) const ZERO: Self = Self {
        force: [Lane::ZERO; 3],
        torque: [Lane::ZERO; 3],
    };

    #[inline(always)]
    fn add(&mut self, force: Vec3<T>, torque: Vec3<T>) {
        self.force = sum(self.force, force);
        self.torque = sum(self.torque, torque);
    }
}

/// Rows that are worked on at once.
pub(super) const fn block(width: usize) -> usize {
    LANES * width
}

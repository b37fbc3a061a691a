//! One pose at a time, with what a Jacobian is made of.

use nalgebra::{Matrix3, Vector3};

use super::tree::{Tree, Turn};
use crate::key_nodes::KEY_NODES;

/// Key nodes, wrists and joint axes of one pose: what inverse kinematics over the goal joints needs.
///
/// [`update`](Self::update) computes them at given goal joints, without allocation. The Jacobian's columns follow:
/// goal joint j turns with axis aⱼ through anchor oⱼ, so that
///
/// - ∂p/∂qⱼ = aⱼ × (p − oⱼ) for the position p of a key node that j moves ([`position_derivative`]),
/// - ∂r/∂qⱼ = aⱼ × r for a column r of a wrist's rotation that j moves ([`direction_derivative`]),
///
/// and both are zero for joints that are not in [`joints_moving`](Self::joints_moving) of that node. A joint of the
/// hand beyond the wrist's node turns the wrist without moving the node: there the first is zero, the second not. For the
/// direction d of a bone between two key nodes p₁ → p₂ of length l: ∂d/∂qⱼ = (I − d dᵀ)(∂p₂/∂qⱼ − ∂p₁/∂qⱼ) / l.
///
/// Everything is in the base's frame, metres and radians. Legs do not move key nodes.
///
/// [`position_derivative`]: Self::position_derivative
/// [`direction_derivative`]: Self::direction_derivative
#[derive(Clone, Debug)]
pub struct FrameKinematics {
    tree: Tree<f64>,
    /// Nodes that goal joints turn, parents first.
    moved: Vec<usize>,
    rotations: Vec<Matrix3<f64>>,
    origins: Vec<Vector3<f64>>,
    axes: Vec<Vector3<f64>>,
    anchors: Vec<Vector3<f64>>,
    positions: [Vector3<f64>; KEY_NODES],
    wrists: [Matrix3<f64>; 2],
    /// Joints that move a key node or turn its wrist.
    chains: [Vec<usize>; KEY_NODES],
    /// Which joints move a key node's position.
    moves: [Vec<bool>; KEY_NODES],
}

impl FrameKinematics {
    /// `tree` of a robot whose first `joints` joints are goal joints.
    pub(super) fn new(tree: &Tree<f64>, joints: usize) -> Self {
        let tree = tree.clone();
        let moved = (1..tree.nodes.len())
            .filter(|&node| tree.nodes[node].joint < joints)
            .collect();
        let chains = std::array::from_fn(|key_node| {
            let wrist = key_node
                .checked_sub(KEY_NODES - 2)
                .map(|side| tree.wrists[side].node);
            chain(&tree, wrist.unwrap_or(tree.points[key_node].node))
        });
        let moves = std::array::from_fn(|key_node| {
            let chain = chain(&tree, tree.points[key_node].node);
            (0..joints).map(|joint| chain.contains(&joint)).collect()
        });
        let nodes = tree.nodes.len();
        let mut frame = Self {
            tree,
            moved,
            rotations: vec![Matrix3::identity(); nodes],
            origins: vec![Vector3::zeros(); nodes],
            axes: vec![Vector3::zeros(); joints],
            anchors: vec![Vector3::zeros(); joints],
            positions: [Vector3::zeros(); KEY_NODES],
            wrists: [Matrix3::identity(); 2],
            chains,
            moves,
        };
        frame.update(&vec![0.0; joints]);
        frame
    }

    /// Moves to the goal joints `q`, radians in goal order.
    ///
    /// # Panics
    /// If `q` is not one angle for each goal joint.
    pub fn update(&mut self, q: &[f64]) {
        assert_eq!(q.len(), self.axes.len(), "one angle for each goal joint");
        for &i in &self.moved {
            let node = &self.tree.nodes[i];
            let parent = self.rotations[node.parent];
            self.origins[i] = self.origins[node.parent] + parent * Vector3::from(node.offset);
            let (turn, axis) = turn(&node.turn, q[node.joint]);
            self.rotations[i] = parent * turn;
            self.axes[node.joint] = parent * axis;
            self.anchors[node.joint] = self.origins[i];
        }
        for (position, point) in self.positions.iter_mut().zip(&self.tree.points) {
            *position =
                self.origins[point.node] + self.rotations[point.node] * Vector3::from(point.offset);
        }
        for (wrist, frame) in self.wrists.iter_mut().zip(&self.tree.wrists) {
            *wrist = self.rotations[frame.node] * Matrix3::from_column_slice(&frame.axes);
        }
    }

    /// Positions of the key nodes, in the order of [`crate::KEY_NODE_NAMES`].
    pub fn positions(&self) -> &[Vector3<f64>; KEY_NODES] {
        &self.positions
    }

    /// Rotations of the wrists, left and right: columns x from wrist to fingers, z toward the thumb, y = z × x.
    pub fn wrist_rotations(&self) -> &[Matrix3<f64>; 2] {
        &self.wrists
    }

    /// Unit axes of the goal joints.
    pub fn axes(&self) -> &[Vector3<f64>] {
        &self.axes
    }

    /// A point on the axis of each goal joint.
    pub fn anchors(&self) -> &[Vector3<f64>] {
        &self.anchors
    }

    /// The goal joints between the base and a key node, base first; of a wrist, those between the base and the hand.
    /// All other joints leave the node where it is, and the wrist's rotation as it is.
    pub fn joints_moving(&self, key_node: usize) -> &[usize] {
        &self.chains[key_node]
    }

    /// ∂(position of `key_node`)/∂q of a goal joint; zero where the joint does not move it.
    pub fn position_derivative(&self, key_node: usize, joint: usize) -> Vector3<f64> {
        if !self.moves[key_node][joint] {
            return Vector3::zeros();
        }
        self.axes[joint].cross(&(self.positions[key_node] - self.anchors[joint]))
    }

    /// ∂(a direction that moves with a wrist)/∂q of a goal joint in [`joints_moving`](Self::joints_moving) of it.
    pub fn direction_derivative(&self, direction: &Vector3<f64>, joint: usize) -> Vector3<f64> {
        self.axes[joint].cross(direction)
    }
}

/// Joints from the base to `node`.
fn chain(tree: &Tree<f64>, mut node: usize) -> Vec<usize> {
    let mut joints = Vec::new();
    while node != 0 {
        joints.push(tree.nodes[node].joint);
        node = tree.nodes[node].parent;
    }
    joints.reverse();
    joints
}

/// Rotation of a joint at an angle, and its axis, in the parent's frame.
fn turn(turn: &Turn<f64>, angle: f64) -> (Matrix3<f64>, Vector3<f64>) {
    let (s, c) = angle.sin_cos();
    match turn {
        Turn::None => (Matrix3::identity(), Vector3::zeros()),
        Turn::X => (
            Matrix3::new(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c),
            Vector3::x(),
        ),
        Turn::Y => (
            Matrix3::new(c, 0.0, s, 0.0, 1.0, 0.0, -s, 0.0, c),
            Vector3::y(),
        ),
        Turn::Z => (
            Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0),
            Vector3::z(),
        ),
        Turn::Axis {
            axis,
            fixed,
            sine,
            cosine,
        } => {
            let [fixed, sine, cosine] =
                [fixed, sine, cosine].map(|columns| Matrix3::from_column_slice(columns));
            (fixed + sine * s + cosine * c, Vector3::from(*axis))
        }
    }
}

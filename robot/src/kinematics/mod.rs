//! Batched forward kinematics, its reverse pass, and the state of one pose for inverse kinematics.
//!
//! A joint vector q holds the goal joints, then the leg joints, in radians. Everything is in the base's (pelvis)
//! frame with the base at identity: x forward, y left, z up, metres.

mod batch;
mod frame;
mod lane;
mod precision;
mod scalar;
mod tree;

use std::ops::Range;

use mujoco_rs::prelude::*;
use nalgebra::Vector3;

pub use frame::FrameKinematics;
pub use precision::Real;
pub(crate) use tree::Attached;

use crate::key_nodes::KEY_NODES;
use batch::{Pose, Wrench, block};
use precision::Trees;
use tree::Tree;

/// Where each output stands in a row of [`Kinematics::forward`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutputLayout {
    /// Positions of the key nodes in the order of [`crate::KEY_NODE_NAMES`]: 8 × 3.
    pub key_nodes: Range<usize>,
    /// Rotations of the wrists, left then right, row-major: 2 × 9. Columns: x from wrist to fingers, z toward the
    /// thumb, y = z × x.
    pub wrist_rotations: Range<usize>,
    /// Centres of the link spheres in the order of [`crate::Robot::link_spheres`]: L × 3.
    pub link_centers: Range<usize>,
    /// Centre of mass of the whole robot: 3.
    pub center_of_mass: Range<usize>,
    /// Centre of the support surface: midway between the centres of the two soles: 3.
    pub foot_support: Range<usize>,
}

impl OutputLayout {
    fn new(links: usize) -> Self {
        let mut end = 0;
        let mut next = |width: usize| {
            end += width;
            end - width..end
        };
        Self {
            key_nodes: next(3 * KEY_NODES),
            wrist_rotations: next(2 * 9),
            link_centers: next(3 * links),
            center_of_mass: next(3),
            foot_support: next(3),
        }
    }

    /// Numbers in one output row.
    pub fn width(&self) -> usize {
        self.foot_support.end
    }
}

/// Forward kinematics of a robot with an analytic vector–Jacobian product.
///
/// Both passes cost O(joints) a pose, work on a few poses at once and allocate one small scratch a call. They run on
/// the calling thread; a pose's result does not depend on the others in its batch.
#[derive(Clone, Debug)]
pub struct Kinematics {
    trees: Trees,
    layout: OutputLayout,
    goal_joints: usize,
}

impl Kinematics {
    /// `columns[joint id]` is the column of a joint in a joint vector of `dof`, of which the first are goal joints.
    pub(crate) fn new(
        model: &MjModel,
        base: usize,
        columns: &[usize],
        dof: usize,
        goal_joints: usize,
        attached: &Attached,
    ) -> Self {
        let double = Tree::new(model, base, columns, dof, attached);
        let layout = OutputLayout::new(attached.links.len());
        Self {
            trees: Trees {
                single: double.cast(),
                double,
            },
            layout,
            goal_joints,
        }
    }

    /// Length of a joint vector.
    pub fn dof(&self) -> usize {
        self.trees.double.dof
    }

    /// Numbers in one output row: [`OutputLayout::width`].
    pub fn output_width(&self) -> usize {
        self.layout.width()
    }

    /// Where each output stands in a row.
    pub fn layout(&self) -> &OutputLayout {
        &self.layout
    }

    /// Outputs `out` [B × [`output_width`](Self::output_width)] of joint vectors `q` [B × [`dof`](Self::dof)], both
    /// row-major.
    ///
    /// # Panics
    /// If the lengths are not those of the same number of rows.
    pub fn forward<T: Real>(&self, q: &[T], out: &mut [T]) {
        let (dof, width) = (self.dof(), self.output_width());
        self.check_rows(q.len(), out.len());
        let tree = T::tree(&self.trees);
        let mut poses = vec![Pose::base(); tree.nodes.len()];
        for (q, out) in q.chunks(block(dof)).zip(out.chunks_mut(block(width))) {
            tree.poses(q, &mut poses);
            tree.write(&poses, KEY_NODES, out);
        }
    }

    /// Vector–Jacobian product: the gradient `grad_q` [B × dof] of a scalar with respect to `q` [B × dof], from its
    /// gradient `grad_out` [B × `output_width`] with respect to the outputs at `q`. Overwrites `grad_q`.
    ///
    /// # Panics
    /// If the lengths are not those of the same number of rows.
    pub fn backward<T: Real>(&self, q: &[T], grad_out: &[T], grad_q: &mut [T]) {
        let (dof, width) = (self.dof(), self.output_width());
        self.check_rows(q.len(), grad_out.len());
        assert_eq!(q.len(), grad_q.len(), "grad_q has to be as long as q");
        let tree = T::tree(&self.trees);
        let mut poses = vec![Pose::base(); tree.nodes.len()];
        let mut wrenches = vec![Wrench::ZERO; tree.nodes.len()];
        let rows = q
            .chunks(block(dof))
            .zip(grad_out.chunks(block(width)))
            .zip(grad_q.chunks_mut(block(dof)));
        for ((q, grad_out), grad_q) in rows {
            tree.poses(q, &mut poses);
            tree.pull(&poses, KEY_NODES, grad_out, &mut wrenches, grad_q);
        }
    }

    /// Centres of the spheres with which both feet touch the floor, the left foot's first, at one joint vector `q`.
    ///
    /// # Panics
    /// If `q` is not one angle for each joint.
    pub fn foot_contacts(&self, q: &[f64]) -> Vec<Vector3<f64>> {
        assert_eq!(q.len(), self.dof(), "one angle for each joint");
        let mut poses = vec![Pose::base(); self.trees.double.nodes.len()];
        self.trees.double.poses(q, &mut poses);
        let contacts = self.trees.double.foot_contacts.iter();
        contacts
            .map(|contact| poses[contact.node].point(contact.offset))
            .map(|point| point.map(|lane| lane.0[0]).into())
            .collect()
    }

    /// Whether a goal joint moves the link sphere with this index.
    pub fn goals_move(&self, link: usize) -> bool {
        let nodes = &self.trees.double.nodes;
        let mut node = self.trees.double.points[KEY_NODES + link].node;
        while node != 0 {
            if nodes[node].joint < self.goal_joints {
                return true;
            }
            node = nodes[node].parent;
        }
        false
    }

    /// A state for following one pose at a time, as inverse kinematics does; every joint at zero.
    pub fn frame(&self) -> FrameKinematics {
        FrameKinematics::new(&self.trees.double, self.goal_joints)
    }

    fn check_rows(&self, q: usize, out: usize) {
        let (dof, width) = (self.dof(), self.output_width());
        assert!(
            q.is_multiple_of(dof),
            "q has {q} numbers, not rows of {dof}"
        );
        assert_eq!(
            out,
            q / dof * width,
            "outputs have to be one row of {width} for each row of q"
        );
    }
}

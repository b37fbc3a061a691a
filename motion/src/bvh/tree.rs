//! A joint tree: who hangs on whom, how long bones are, and where joints are in a pose.

use nalgebra::{Rotation3, Vector3};

use super::parse::{Channel, Document, Joint};
use crate::source::probed;

/// The joints of a document, with what its frames tell about them.
pub(super) struct Tree<'a> {
    pub(super) joints: &'a [Joint],
    children: Vec<Vec<usize>>,
    /// Whether inner joints' position channels add to their offsets; else they replace them.
    deltas: bool,
    /// From the parent in the parent's frame as the frames have it, file units.
    pub(super) offsets: Vec<Vector3<f64>>,
    /// Where each joint is with all rotations zero, file units.
    pub(super) rest: Vec<Vector3<f64>>,
}

impl<'a> Tree<'a> {
    pub(super) fn new(document: &'a Document) -> Self {
        let joints = document.joints.as_slice();
        let mut children = vec![Vec::new(); joints.len()];
        for (index, joint) in joints.iter().enumerate() {
            if let Some(parent) = joint.parent {
                children[parent].push(index);
            }
        }
        let deltas = positions_are_deltas(document);
        let offsets = mean_offsets(document, deltas);
        let mut rest: Vec<Vector3<f64>> = Vec::with_capacity(joints.len());
        for (joint, offset) in joints.iter().zip(&offsets) {
            let parent = joint
                .parent
                .map_or_else(Vector3::zeros, |parent| rest[parent]);
            rest.push(parent + offset);
        }
        Self {
            joints,
            children,
            deltas,
            offsets,
            rest,
        }
    }

    pub(super) fn children(&self, joint: usize) -> &[usize] {
        &self.children[joint]
    }

    /// The joints above `joint`, nearest first.
    pub(super) fn ancestors(&self, joint: usize) -> impl Iterator<Item = usize> + use<'_> {
        std::iter::successors(self.joints[joint].parent, |joint| {
            self.joints[*joint].parent
        })
    }

    pub(super) fn is_below(&self, joint: usize, ancestor: usize) -> bool {
        self.ancestors(joint).any(|j| j == ancestor)
    }

    /// The joints below `joint` in the file's order.
    pub(super) fn descendants(&self, joint: usize) -> impl Iterator<Item = usize> + use<'_> {
        (joint + 1..self.joints.len()).filter(move |other| self.is_below(*other, joint))
    }

    /// The nearest joint above both; a joint counts as above itself.
    pub(super) fn meeting(&self, a: usize, b: usize) -> Option<usize> {
        let line = |joint| std::iter::once(joint).chain(self.ancestors(joint));
        line(a).find(|joint| line(b).any(|other| other == *joint))
    }

    /// Lengths of the bones from `ancestor` down to `joint`, added up.
    pub(super) fn path(&self, ancestor: usize, joint: usize) -> f64 {
        let line = std::iter::once(joint).chain(self.ancestors(joint));
        line.take_while(|j| *j != ancestor)
            .map(|j| self.offsets[j].norm())
            .sum()
    }

    /// Position and orientation of every joint for one frame's values.
    pub(super) fn pose(&self, values: &[f64]) -> (Vec<Vector3<f64>>, Vec<Rotation3<f64>>) {
        let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
        let mut positions: Vec<Vector3<f64>> = Vec::with_capacity(self.joints.len());
        let mut rotations: Vec<Rotation3<f64>> = Vec::with_capacity(self.joints.len());
        for joint in self.joints {
            let offset = offset_in(joint, values, self.deltas);
            let mut turn = Rotation3::identity();
            for (channel, value) in joint.channels.iter().zip(&values[joint.first_value..]) {
                if let Channel::Rotation(axis) = channel {
                    turn *= Rotation3::from_axis_angle(&axes[*axis], value.to_radians());
                }
            }
            let (position, rotation) = joint.parent.map_or_else(
                || (offset, turn),
                |p| (positions[p] + rotations[p] * offset, rotations[p] * turn),
            );
            positions.push(position);
            rotations.push(rotation);
        }
        (positions, rotations)
    }
}

/// The joint's offset in one frame. A root's position channels always replace its offset.
fn offset_in(joint: &Joint, values: &[f64], deltas: bool) -> Vector3<f64> {
    let mut offset = joint.offset;
    for (channel, value) in joint.channels.iter().zip(&values[joint.first_value..]) {
        if let Channel::Position(axis) = channel {
            let base = if deltas && joint.parent.is_some() {
                joint.offset[*axis]
            } else {
                0.0
            };
            offset[*axis] = base + *value;
        }
    }
    offset
}

fn mean_offsets(document: &Document, deltas: bool) -> Vec<Vector3<f64>> {
    let mean = |joint: &Joint| {
        if !joint.moves() {
            return joint.offset;
        }
        let all = probed(document.frames).map(|i| offset_in(joint, document.frame(i), deltas));
        let (sum, count) = all.fold((Vector3::zeros(), 0.0), |(s, n), v| (s + v, n + 1.0));
        sum / count
    };
    document.joints.iter().map(mean).collect()
}

/// Whether inner joints' position channels are small beside their offsets, rather than near them. A joint that travels is
/// far from both and has no say.
fn positions_are_deltas(document: &Document) -> bool {
    let (mut as_delta, mut as_place) = (0.0, 0.0);
    let inner = document
        .joints
        .iter()
        .filter(|j| j.parent.is_some() && j.moves());
    for joint in inner {
        let length = joint.offset.norm();
        if length < 1e-9 {
            continue;
        }
        for frame in probed(document.frames) {
            let position = joint.position(document.frame(frame));
            as_delta += (position.norm() / length).min(1.0);
            as_place += ((position - joint.offset).norm() / length).min(1.0);
        }
    }
    as_delta < as_place
}

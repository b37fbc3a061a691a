//! The parts of a body as joints of a tree.

use super::tree::Tree;
use crate::Side;
use crate::names::{self, Named, Part};

/// The joints that carry the key nodes, as indices into the tree.
#[derive(Debug)]
pub(super) struct Skeleton {
    pub(super) root: usize,
    pub(super) waist: Waist,
    /// The joint where both arms' chains part; `None` where that is the waist itself.
    pub(super) torso: Option<usize>,
    pub(super) arms: [Arm; 2],
    /// Left and right hip joint.
    pub(super) hips: Option<[usize; 2]>,
    pub(super) legs: Option<[LegJoints; 2]>,
    /// Whether the tree's structure told the arms, not the names.
    pub(super) by_structure: bool,
}

/// Where the waist is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Waist {
    Joint(usize),
    /// Between the hip joints, where no joint is near.
    BetweenHips,
}

/// One arm's joints.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arm {
    pub(super) shoulder: usize,
    pub(super) elbow: usize,
    pub(super) wrist: usize,
}

/// One leg's joints.
#[derive(Clone, Copy, Debug)]
pub(super) struct LegJoints {
    pub(super) hip: usize,
    pub(super) knee: usize,
    pub(super) ankle: usize,
    pub(super) toe: Option<usize>,
}

/// A tree's joints with what their names say.
pub(super) struct NamedTree<'a> {
    pub(super) tree: &'a Tree<'a>,
    pub(super) names: Vec<Named>,
}

impl<'a> NamedTree<'a> {
    pub(super) fn new(tree: &'a Tree<'a>) -> Self {
        let names = tree.joints.iter().map(|j| names::parse(&j.name)).collect();
        Self { tree, names }
    }

    /// Whether a joint is one of these parts on one side.
    pub(super) fn is(&self, joint: usize, side: Side, parts: &[Part]) -> bool {
        let Named { side: of, part } = self.names[joint];
        of == Some(side) && part.is_some_and(|part| parts.contains(&part))
    }
}

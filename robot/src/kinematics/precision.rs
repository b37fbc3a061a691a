//! A tree in both number types, and the choice between them.

use super::scalar::Scalar;
use super::tree::Tree;

/// The same tree in double and in single precision.
#[derive(Clone, Debug)]
pub struct Trees {
    pub(super) double: Tree<f64>,
    pub(super) single: Tree<f32>,
}

/// `f32` or `f64`. Sealed: nothing else implements it.
pub trait Real: Chosen {}

impl Real for f32 {}
impl Real for f64 {}

/// Chooses a tree; out of reach from outside, which seals [`Real`].
pub trait Chosen: Scalar {
    /// The tree with its constants in this type.
    fn tree(trees: &Trees) -> &Tree<Self>;
}

impl Chosen for f32 {
    fn tree(trees: &Trees) -> &Tree<Self> {
        &trees.single
    }
}

impl Chosen for f64 {
    fn tree(trees: &Trees) -> &Tree<Self> {
        &trees.double
    }
}

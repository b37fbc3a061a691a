//! One pose as a file has it.

use nalgebra::{Rotation3, Vector3};

use crate::KEY_NODES;

/// One pose before normalisation, at any place and heading: in a file's unit and axes, or already in metres with z up.
#[derive(Clone)]
pub(crate) struct WorldFrame {
    pub(crate) positions: [Vector3<f64>; KEY_NODES],
    /// Points to the person's left; its direction in the ground plane defines the heading.
    pub(crate) left: Vector3<f64>,
    pub(crate) wrists: [Option<Rotation3<f64>>; 2],
}

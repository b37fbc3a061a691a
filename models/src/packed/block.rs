//! The unit in which weights and activations lie in memory.

/// Outputs of a panel, and inputs of a block of activations.
pub(super) const WIDTH: usize = 32;

/// As many numbers as a panel has outputs.
pub(super) type Block<T> = [T; WIDTH];

//! Imagined control periods: EMP → goal inside `S_t` → frozen policy → frozen world model (paper, Algorithm 1; erratum E9).

use candle_core::Tensor;

/// One imagined control period of a batch.
#[derive(Clone, Debug)]
pub struct ImaginedStep {
    /// The executable goal ĝ_t as the EMP answers it, not held inside the joints' ranges (N × goal joints, rad).
    pub goal: Tensor,
    /// The latent z of that answer (N × latent).
    pub latent: Tensor,
    /// Joint positions that the world model predicts for t + 1 (N × joints, rad).
    pub joint_positions: Tensor,
    /// Roll, pitch and yaw that it predicts for t + 1 (N × 3, rad).
    pub orientation: Tensor,
}

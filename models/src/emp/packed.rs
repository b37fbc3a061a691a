//! The four networks of an EMP, packed: what serving runs.

use crate::packed::{PackedMlp, Scratch};

/// The networks of an [`EmpNetwork`](super::EmpNetwork), whose numbers it gives up to rounding: within 1e-5 for answers of unit size.
///
/// A row's answer is the same, bit for bit, whatever rows stand beside it.
#[derive(Clone, Debug)]
pub struct PackedNetwork {
    pub(super) state: PackedMlp,
    pub(super) target: PackedMlp,
    pub(super) fusion: PackedMlp,
    pub(super) decoder: PackedMlp,
}

impl PackedNetwork {
    /// What the decoder answers (N × goal joints) and the latents z (N × [`EmpConfig::latent`](super::EmpConfig::latent)) for
    /// features that are mapped and normalised (N × [`EmpConfig::features`](super::EmpConfig::features)) and goals
    /// (N × goal joints).
    ///
    /// # Errors
    /// When either is not whole rows, or not as many.
    pub fn forward(
        &self,
        features: &[f32],
        goals: &[f32],
    ) -> candle_core::Result<(Vec<f32>, Vec<f32>)> {
        Scratch::with(|scratch| {
            let (mut state, mut target) = (Vec::new(), Vec::new());
            self.state.forward(features, &mut state, scratch)?;
            self.target.forward(goals, &mut target, scratch)?;
            let widths = [self.state.outputs(), self.target.outputs()];
            let pairs = state
                .chunks_exact(widths[0])
                .zip(target.chunks_exact(widths[1]));
            if pairs.len() * widths[0] != state.len() || pairs.len() * widths[1] != target.len() {
                candle_core::bail!(
                    "{} features are not for {} goals",
                    features.len(),
                    goals.len()
                );
            }
            let encodings: Vec<f32> = pairs.flat_map(|(z1, z2)| [z1, z2].concat()).collect();
            let (mut latents, mut decoded) = (Vec::new(), Vec::new());
            self.fusion.forward(&encodings, &mut latents, scratch)?;
            self.decoder.forward(&latents, &mut decoded, scratch)?;
            Ok((decoded, latents))
        })
    }
}

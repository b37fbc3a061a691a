//! The four networks of an EMP as candle tensors: what training differentiates.

use candle_core::Tensor;
use candle_nn::VarBuilder;

use super::{
    config::{EmpConfig, Output},
    packed::PackedNetwork,
};
use crate::{
    checkpoint::Tensors,
    mlp::{Mlp, Normalizer},
};

/// Names of the networks, in the order of [`EmpNetwork`]'s fields.
const NAMES: [&str; 4] = ["state", "target", "fusion", "decoder"];

/// State encoder `f_s`, target encoder `f_t`, fusion `f_ψ` and decoder (paper, section V-A), with what the state encoder's input
/// goes through first.
#[derive(Clone, Debug)]
pub struct EmpNetwork {
    config: EmpConfig,
    normalizer: Normalizer,
    state: Mlp,
    target: Mlp,
    fusion: Mlp,
    decoder: Mlp,
}

impl EmpNetwork {
    /// Networks of the shape that `config` says, their tensors named `state.0.weight`, `target.0.weight`, `fusion.…` and
    /// `decoder.…` in `vars`. `normalizer` is that of the state's features.
    ///
    /// # Errors
    /// When `vars` holds tensors of those names with other shapes.
    pub fn new(
        config: EmpConfig,
        normalizer: Normalizer,
        vars: &VarBuilder<'_>,
    ) -> candle_core::Result<Self> {
        let goals = config.observation.goal().len();
        let mlp = |name: usize, inputs, hidden: &[usize], outputs| {
            Mlp::new(inputs, hidden, outputs, &vars.pp(NAMES[name]))
        };
        Ok(Self {
            state: mlp(0, config.features(), &config.state_hidden, config.encoding)?,
            target: mlp(1, goals, &config.target_hidden, config.encoding)?,
            fusion: mlp(2, 2 * config.encoding, &config.fusion_hidden, config.latent)?,
            decoder: mlp(3, config.latent, &config.decoder_hidden, goals)?,
            normalizer,
            config,
        })
    }

    /// The shape.
    pub fn config(&self) -> &EmpConfig {
        &self.config
    }

    /// The networks' tensors, named as [`EmpNetwork::new`] names them.
    pub fn tensors(&self) -> Tensors {
        let networks = [&self.state, &self.target, &self.fusion, &self.decoder];
        let named = NAMES.into_iter().zip(networks);
        named
            .flat_map(|(name, network)| {
                let tensors = network.tensors().into_iter();
                tensors.map(move |(tensor, value)| (format!("{name}.{tensor}"), value))
            })
            .collect()
    }

    /// The networks for inference, as f16 where that loses nothing.
    ///
    /// # Errors
    /// When the tensors are not f32.
    pub fn pack(&self) -> candle_core::Result<PackedNetwork> {
        Ok(PackedNetwork {
            state: self.state.pack()?,
            target: self.target.pack()?,
            fusion: self.fusion.pack()?,
            decoder: self.decoder.pack()?,
        })
    }

    /// The executable goals ĝ (N × goal joints, rad, not held inside the joints' ranges) and the latents z
    /// (N × [`EmpConfig::latent`]) for stacks (N × [`ObservationLayout::width`](crate::observation::ObservationLayout::width), the
    /// goal that was asked for in the newest frame) and those goals (N × goal joints).
    ///
    /// # Errors
    /// When widths do not fit.
    pub fn forward(
        &self,
        stacks: &Tensor,
        goals: &Tensor,
    ) -> candle_core::Result<(Tensor, Tensor)> {
        let config = &self.config;
        let features = config.history_map.project(&config.observation, stacks)?;
        self.forward_features(&self.normalizer.forward(&features)?, goals)
    }

    /// What the state encoder reads, mapped and normalised (N × [`EmpConfig::features`]), for stacks. Not differentiable, and many
    /// times as fast as the way there through tensors.
    pub fn features(&self, stacks: &[f32]) -> Vec<f32> {
        let mut features = Vec::new();
        let config = &self.config;
        config
            .history_map
            .apply(&config.observation, stacks, &mut features);
        self.normalizer.apply(&mut features);
        features
    }

    /// As [`forward`](Self::forward), from features that are mapped and normalised (N × [`EmpConfig::features`]).
    ///
    /// # Errors
    /// When widths do not fit.
    pub fn forward_features(
        &self,
        features: &Tensor,
        goals: &Tensor,
    ) -> candle_core::Result<(Tensor, Tensor)> {
        let encodings = [self.state.forward(features)?, self.target.forward(goals)?];
        let latent = self.fusion.forward(&Tensor::cat(&encodings, 1)?)?;
        let decoded = self.decoder.forward(&latent)?;
        let executable = match self.config.output {
            Output::Absolute => decoded,
            Output::Residual => (goals + decoded)?,
        };
        Ok((executable, latent))
    }
}

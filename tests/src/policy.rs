//! A policy without training: random actions that follow from the observation. Enough to tell answers apart, and to fall.

use std::{path::Path, sync::Arc};

use anyhow::Context as _;
use candle_core::{Device, Tensor};
use emp_models::{
    checkpoint::Tensors,
    mlp::Normalizer,
    policy::{Policy, PolicyConfig},
};
use emp_robot::Robot;
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};
use tempfile::TempDir;

/// Widths of the hidden layers: those of the policies that ship.
const HIDDEN: [usize; 3] = [256, 128, 64];

/// Writes the weights of a random policy for `robot`.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, robot: &Robot, seed: u64) -> anyhow::Result<()> {
    let config = PolicyConfig::new(robot, HIDDEN.to_vec());
    let normalizer = Normalizer::identity(config.features());
    let outputs = robot.leg_joints().len();
    let widths = [&[config.features()], &HIDDEN[..], &[outputs]].concat();
    let network = random_network(&widths, &mut StdRng::seed_from_u64(seed))?;
    let training = serde_json::json!({ "seed": seed });
    Policy::save(
        path,
        robot,
        &config,
        &normalizer,
        &network,
        training,
        String::new(),
    )?;
    Ok(())
}

/// Tensors of an MLP with random weights, layer by layer; its answers are about as large as what is asked.
///
/// # Errors
/// When the tensor library fails.
pub(crate) fn random_network(widths: &[usize], rng: &mut StdRng) -> anyhow::Result<Tensors> {
    let mut network = Tensors::new();
    for (layer, pair) in widths.windows(2).enumerate() {
        let [inputs, outputs] = [pair[0], pair[1]];
        let largest = (3.0 / inputs as f32).sqrt();
        let mut random = |shape: &[usize]| {
            let values = (0..shape.iter().product()).map(|_| rng.random_range(-largest..largest));
            Tensor::from_vec(values.collect::<Vec<f32>>(), shape, &Device::Cpu)
        };
        network.insert(format!("{layer}.weight"), random(&[outputs, inputs])?);
        network.insert(format!("{layer}.bias"), random(&[outputs])?);
    }
    Ok(network)
}

/// A folder of weights for [`emp27`](crate::emp27): the shipped retargeter, and a random policy.
///
/// # Errors
/// When a file cannot be read or written.
pub fn weights() -> anyhow::Result<TempDir> {
    let folder = tempfile::tempdir()?;
    let retargeter = "emp27-retargeter.safetensors";
    std::fs::copy(
        crate::weights()?.join(retargeter),
        folder.path().join(retargeter),
    )
    .context(retargeter)?;
    write(&file(&folder), &*crate::emp27()?, 1)?;
    Ok(folder)
}

/// The policy's file in a folder of [`weights`].
pub fn file(weights: &TempDir) -> std::path::PathBuf {
    weights.path().join("emp27-policy.safetensors")
}

/// The policy in a folder of [`weights`].
///
/// # Errors
/// When it does not load.
pub fn load(weights: &TempDir) -> anyhow::Result<Arc<Policy>> {
    Ok(Arc::new(Policy::load(&file(weights), crate::emp27()?)?))
}

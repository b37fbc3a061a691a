//! An EMP without training: random answers that follow from state and goal, near enough to the goal to be executed.

use std::{path::Path, sync::Arc};

use emp_models::{
    checkpoint::Tensors,
    emp::{DangerGate, Emp, EmpConfig, Output},
    mlp::Normalizer,
    observation::HistoryMap,
};
use emp_robot::Robot;
use rand::{SeedableRng as _, rngs::StdRng};
use tempfile::TempDir;

use crate::policy;

/// A small EMP's shape, which sees danger when the base is tilted by more than `tilt`, rad.
pub fn small(robot: &Robot, tilt: f32) -> EmpConfig {
    EmpConfig {
        history_map: HistoryMap::differences(),
        output: Output::Residual,
        state_hidden: vec![32],
        target_hidden: vec![32],
        encoding: 8,
        fusion_hidden: vec![32],
        latent: 8,
        decoder_hidden: vec![32],
        gate: DangerGate::Tilt(tilt),
        ..EmpConfig::paper(robot)
    }
}

/// Writes the weights of a random EMP of this shape for `robot`.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, robot: &Robot, config: &EmpConfig, seed: u64) -> anyhow::Result<()> {
    let goals = robot.goal_joints().len();
    let encoding = config.encoding;
    let networks = [
        ("state", config.features(), &config.state_hidden, encoding),
        ("target", goals, &config.target_hidden, encoding),
        ("fusion", 2 * encoding, &config.fusion_hidden, config.latent),
        ("decoder", config.latent, &config.decoder_hidden, goals),
    ];
    let mut rng = StdRng::seed_from_u64(seed);
    let mut tensors = Tensors::new();
    for (name, inputs, hidden, outputs) in networks {
        let widths = [&[inputs], hidden.as_slice(), &[outputs]].concat();
        for (tensor, value) in policy::random_network(&widths, &mut rng)? {
            tensors.insert(format!("{name}.{tensor}"), value);
        }
    }
    let training = serde_json::json!({ "seed": seed });
    let normalizer = Normalizer::identity(config.features());
    Emp::save(
        path,
        robot,
        config,
        &normalizer,
        &tensors,
        training,
        String::new(),
    )?;
    Ok(())
}

/// A folder of weights for [`emp27`](crate::emp27): the shipped retargeter, a random policy and a random EMP of this shape.
///
/// # Errors
/// When a file cannot be read or written.
pub fn weights(config: &EmpConfig) -> anyhow::Result<TempDir> {
    let folder = policy::weights()?;
    write(&file(&folder), &*crate::emp27()?, config, 2)?;
    Ok(folder)
}

/// The EMP's file in a folder of [`weights`].
pub fn file(weights: &TempDir) -> std::path::PathBuf {
    weights.path().join("emp27-emp.safetensors")
}

/// The EMP in a folder of [`weights`].
///
/// # Errors
/// When it does not load.
pub fn load(weights: &TempDir) -> anyhow::Result<Arc<Emp>> {
    Ok(Arc::new(Emp::load(&file(weights), crate::emp27()?)?))
}

//! The training loop of the retargeting network: checkpoints, resumption, codebook upkeep.

use std::{path::Path, sync::Arc, time::Instant};

use anyhow::{Context as _, Result, bail, ensure};
use candle_core::{DType, Device, Tensor};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    CheckpointMetadata,
    checkpoint::{self, Tensors},
    optimizer::{Adam, AdamConfig},
    retarget::{self, NetworkConfig, RetargetNetwork, Target, features},
};
use emp_robot::Robot;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{
    data::Dataset,
    loss::{Loss, TargetBatch, Terms},
};
use crate::{
    log::CsvLog,
    run::{self, Interrupt, Outcome, RunFiles},
    variables,
};

/// Kind of the checkpoints in a run's folder, which hold the optimiser's state too.
const RUN_KIND: &str = "retargeter-run";

/// Steps between two looks at which codes are in use.
const CODE_WINDOW: u64 = 100;

/// Settings of a run. Two runs with the same settings, data and binary make the same bits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RetargeterSettings {
    /// Optimiser steps.
    pub steps: u64,
    /// Frames a step.
    pub batch: usize,
    /// Learning rate at its peak; it falls to a hundredth along a cosine.
    pub learning_rate: f64,
    /// Seed of weights and batches.
    pub seed: u64,
    /// Procedural clips in the mix.
    pub procedural_clips: usize,
}

/// A run: network, optimiser, and how far they are.
pub struct Trainer {
    robot: Arc<Robot>,
    settings: RetargeterSettings,
    network: RetargetNetwork,
    vars: VarMap,
    adam: Adam,
    loss: Loss,
    /// How often each code was chosen since the last look.
    usage: Vec<f32>,
}

/// What one step measured.
struct Step {
    total: f64,
    terms: [f64; 7],
    gradient_norm: f64,
    perplexity: f64,
}

impl Trainer {
    /// Starts with random weights.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(robot: Arc<Robot>, settings: RetargeterSettings) -> Result<Self> {
        let vars = VarMap::new();
        let config = NetworkConfig::default();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let network = RetargetNetwork::new(&config, &robot, &builder)?;
        variables::initialise(&vars, &mut ChaCha8Rng::seed_from_u64(settings.seed))?;
        let adam = Adam::new(&vars, AdamConfig::default())?;
        let loss = Loss::new(&robot)?;
        let usage = vec![0.0; network.codes()];
        let mut trainer = Self {
            robot,
            settings,
            network,
            vars,
            adam,
            loss,
            usage,
        };
        trainer.network.refresh_codebook()?;
        Ok(trainer)
    }

    /// Continues from a checkpoint of this run.
    ///
    /// # Errors
    /// When the checkpoint is damaged, or its run had other settings or another robot.
    pub fn resume(robot: Arc<Robot>, settings: RetargeterSettings, path: &Path) -> Result<Self> {
        let (metadata, tensors) = checkpoint::load(path)?;
        metadata.check(path, &CheckpointMetadata::for_goal_joints(RUN_KIND, &robot))?;
        let saved: Progress = serde_json::from_value(metadata.training)
            .with_context(|| format!("{}: metadata field training", path.display()))?;
        ensure!(
            saved.settings == settings,
            "{}: the run was started with {:?}, not with {settings:?}",
            path.display(),
            saved.settings
        );
        let mut trainer = Self::new(robot, settings)?;
        variables::restore(&trainer.vars, &tensors)
            .with_context(|| format!("{}", path.display()))?;
        trainer.adam.restore(&tensors, saved.step)?;
        let Some(usage) = tensors.get("usage") else {
            bail!("{}: no tensor `usage`", path.display())
        };
        trainer.usage = usage.to_vec1()?;
        trainer.network.refresh_codebook()?;
        Ok(trainer)
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.adam.steps()
    }

    /// The weights, by name.
    ///
    /// # Errors
    /// When the variables' lock is poisoned.
    pub fn weights(&self) -> Result<Tensors> {
        variables::values(&self.vars)
    }

    /// The network as it is now.
    pub fn network(&self) -> &RetargetNetwork {
        &self.network
    }

    /// Writes network, optimiser and progress.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save_run(&self, path: &Path) -> Result<()> {
        let mut tensors = self.weights()?;
        tensors.extend(self.adam.state()?);
        tensors.insert(
            "usage".to_owned(),
            Tensor::new(self.usage.as_slice(), &Device::Cpu)?,
        );
        let mut metadata = CheckpointMetadata::for_goal_joints(RUN_KIND, &self.robot);
        metadata.config = serde_json::to_value(NetworkConfig::default())?;
        metadata.training = serde_json::to_value(Progress {
            settings: self.settings.clone(),
            step: self.steps(),
        })?;
        checkpoint::save(path, metadata, &tensors)?;
        Ok(())
    }

    /// Writes the weights as f16, for serving.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn export(&self, path: &Path, data: &serde_json::Value) -> Result<CheckpointMetadata> {
        let mut metadata = CheckpointMetadata::for_goal_joints(retarget::KIND, &self.robot);
        metadata.config = serde_json::to_value(NetworkConfig::default())?;
        metadata.git_revision = run::git_revision();
        metadata.training = serde_json::json!({
            "command": run::command_line(),
            "settings": self.settings,
            "step": self.steps(),
            "recorded_motion": data,
        });
        let half = |(name, tensor): (String, Tensor)| Ok((name, tensor.to_dtype(DType::F16)?));
        let tensors = self
            .weights()?
            .into_iter()
            .map(half)
            .collect::<Result<Tensors>>()?;
        Ok(checkpoint::save(path, metadata, &tensors)?)
    }

    /// Takes one step on a batch that depends on nothing but the seed and the step's number.
    fn step(&mut self, dataset: &Dataset) -> Result<Step> {
        let step = self.steps();
        let mut rng = step_rng(self.settings.seed, step);
        let targets: Vec<Target> = (0..self.settings.batch)
            .map(|_| dataset.sample(&mut rng))
            .collect();
        let decoded = self.network.forward(&features(&targets)?)?;
        if step == 0 {
            self.replace_codes(&decoded.latent, |_| true, &mut rng)?;
        }
        let terms = self.loss.terms(&decoded, &TargetBatch::new(&targets)?)?;
        let total = terms.total()?;
        let gradient_norm = self
            .adam
            .step(&total.backward()?, self.learning_rate(step))?;
        for index in &decoded.indices {
            self.usage[*index as usize] += 1.0;
        }
        // Late in the run the codebook is left alone, for the decoder to settle on it.
        if (step + 1).is_multiple_of(CODE_WINDOW) && step < self.settings.steps * 7 / 10 {
            let usage = std::mem::replace(&mut self.usage, vec![0.0; self.network.codes()]);
            self.replace_codes(&decoded.latent, |code| usage[code] == 0.0, &mut rng)?;
        }
        self.network.refresh_codebook()?;
        Ok(Step {
            total: f64::from(total.to_scalar::<f32>()?),
            terms: terms.values()?,
            gradient_norm,
            perplexity: perplexity(&decoded.indices, self.network.codes()),
        })
    }

    /// Moves the codes that `dead` names onto random latent vectors of the batch, and forgets their moments.
    fn replace_codes(
        &mut self,
        latent: &Tensor,
        dead: impl Fn(usize) -> bool,
        rng: &mut ChaCha8Rng,
    ) -> Result<()> {
        let codes: Vec<usize> = (0..self.network.codes())
            .filter(|code| dead(*code))
            .collect();
        if codes.is_empty() {
            return Ok(());
        }
        let (rows, width) = latent.dims2()?;
        let latent = latent.flatten_all()?.to_vec1::<f32>()?;
        let vars = variables::lock(&self.vars)?;
        let codebook = vars.get("codebook").context("no variable `codebook`")?;
        let mut values = codebook.flatten_all()?.to_vec1::<f32>()?;
        for code in &codes {
            let row = rng.random_range(0..rows);
            values[code * width..(code + 1) * width]
                .copy_from_slice(&latent[row * width..(row + 1) * width]);
        }
        codebook.set(&Tensor::from_vec(values, codebook.shape(), &Device::Cpu)?)?;
        drop(vars);
        let codes: Vec<u32> = codes.into_iter().map(|code| code as u32).collect();
        self.adam.forget_rows("codebook", &codes);
        Ok(())
    }

    fn learning_rate(&self, step: u64) -> f64 {
        const WARM_UP: f64 = 200.0;
        const LAST: f64 = 0.01;
        let progress = step as f64 / self.settings.steps as f64;
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * progress).cos());
        let warm_up = ((step + 1) as f64 / WARM_UP).min(1.0);
        self.settings.learning_rate * warm_up * (LAST + (1.0 - LAST) * cosine)
    }
}

/// What a run's checkpoint says of its progress.
#[derive(Serialize, Deserialize)]
struct Progress {
    settings: RetargeterSettings,
    step: u64,
}

fn step_rng(seed: u64, step: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Stream 0 drew the initial weights.
    rng.set_stream(step + 1);
    rng
}

/// `exp(H)` of the codes' frequencies: how many codes are in use, as it were.
pub fn perplexity(indices: &[u32], codes: usize) -> f64 {
    let mut counts = vec![0u64; codes];
    for index in indices {
        counts[*index as usize] += 1;
    }
    let total = indices.len().max(1) as f64;
    let shares = counts
        .iter()
        .filter(|count| **count > 0)
        .map(|count| *count as f64 / total);
    shares.map(|p| -p * p.ln()).sum::<f64>().exp()
}

/// Runs the trainer to its end or to an interruption, saving now and then.
///
/// # Errors
/// When a file cannot be written, or the gradient stops being a number.
pub fn train(
    trainer: &mut Trainer,
    dataset: &Dataset,
    data_summary: &serde_json::Value,
    files: &RunFiles,
    interrupt: &Interrupt,
) -> Result<Outcome> {
    const LOG_EVERY: u64 = 100;
    let mut columns = vec!["step", "loss"];
    columns.extend(Terms::NAMES);
    columns.extend(["gradient_norm", "perplexity", "learning_rate"]);
    let done = trainer.steps();
    let mut log = CsvLog::open(&files.log(), &columns, (done > 0).then_some(done))?;
    let bar = run::progress(trainer.settings.steps, done);
    let mut saved = Instant::now();
    while trainer.steps() < trainer.settings.steps {
        if interrupt.requested() {
            trainer.save_run(&files.checkpoint())?;
            bar.abandon_with_message("interrupted; continue with --resume");
            return Ok(Outcome::Interrupted);
        }
        let rate = trainer.learning_rate(trainer.steps());
        let step = trainer
            .step(dataset)
            .with_context(|| format!("step {}", trainer.steps()))?;
        bar.set_position(trainer.steps());
        if trainer.steps().is_multiple_of(LOG_EVERY) || trainer.steps() == trainer.settings.steps {
            let mut row = vec![step.total];
            row.extend(step.terms);
            row.extend([step.gradient_norm, step.perplexity, rate]);
            log.row(trainer.steps(), &row)?;
            bar.set_message(format!("loss {:.2}", step.total));
        }
        if saved.elapsed() >= files.save_every {
            trainer.save_run(&files.checkpoint())?;
            saved = Instant::now();
        }
    }
    trainer.save_run(&files.checkpoint())?;
    trainer.export(&files.weights, data_summary)?;
    bar.finish();
    Ok(Outcome::Finished)
}

//! The training loop of a world model: rounds of collecting and learning, log, checkpoints.

use std::{path::Path, time::Instant};

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use emp_models::{
    CheckpointMetadata,
    checkpoint::{self, Tensors},
    world_model::WorldModel,
};
use emp_robot::Robot;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{
    explorer::Explorer,
    learner::{UpdateStatistics, WorldModelLearner},
    replay::{Replay, Start},
    sequences::Sequences,
    settings::WorldModelSettings,
};
use crate::{
    equipment::Equipment,
    log::CsvLog,
    run::{self, Interrupt, Outcome, RunFiles},
};

/// Kind of the checkpoints in a run's folder, which hold the optimiser, the environments and what they collected too.
const RUN_KIND: &str = "world-model-run";

/// Snapshots in a checkpoint.
const ENVIRONMENTS: &str = "environments";
const REPLAY: &str = "replay";

/// Sequences from which scaling follows, at most.
const SAMPLE: usize = 20_000;

/// Columns of the log after the step.
const COLUMNS: [&str; 7] = [
    "loss",
    "loss_steps",
    "gradient_norm",
    "learning_rate",
    "tilted_starts",
    "seconds_collecting",
    "seconds_learning",
];

/// A run: the learner, its environments, and how far they are.
pub struct Trainer {
    equipment: Equipment,
    settings: WorldModelSettings,
    explorer: Explorer,
    replay: Replay,
    learner: WorldModelLearner,
}

/// What a run's checkpoint says of its progress.
#[derive(Serialize, Deserialize)]
struct Saved {
    settings: WorldModelSettings,
    steps: u64,
}

/// What one round measured.
#[derive(Clone, Copy, Debug, Default)]
struct Round {
    updates: f64,
    loss: f64,
    gradient_norm: f64,
    loss_steps: usize,
    learning_rate: f64,
    tilted_starts: usize,
    collecting: f64,
    learning: f64,
}

impl Trainer {
    /// Starts with random weights, scaled by what the first rounds collect.
    ///
    /// # Errors
    /// When a setting is out of bounds.
    pub fn new(equipment: Equipment, settings: WorldModelSettings) -> Result<Self> {
        let (mut explorer, mut replay) = empty(&equipment, &settings)?;
        for _ in 0..settings.warm_up {
            explorer.collect(settings.frames, &mut replay)?;
        }
        let starts = replay.starts(1, settings.tilt);
        let step = starts.len().div_ceil(SAMPLE).max(1);
        let starts: Vec<Start> = starts.into_iter().step_by(step).collect();
        let sample = replay.sequences(&starts, 1);
        Self::with(equipment, settings, explorer, replay, &sample)
    }

    fn with(
        equipment: Equipment,
        settings: WorldModelSettings,
        explorer: Explorer,
        replay: Replay,
        sample: &Sequences,
    ) -> Result<Self> {
        let learner = settings.learner.clone();
        Ok(Self {
            learner: WorldModelLearner::new(&equipment.robot, learner, sample, settings.seed)?,
            equipment,
            settings,
            explorer,
            replay,
        })
    }

    /// Continues from a checkpoint of this run.
    ///
    /// # Errors
    /// When the checkpoint is damaged, or its run had other settings or another robot.
    pub fn resume(equipment: Equipment, settings: WorldModelSettings, path: &Path) -> Result<Self> {
        let (metadata, mut tensors) = checkpoint::load(path)?;
        metadata.check(path, &run_metadata(&equipment.robot))?;
        let saved: Saved = serde_json::from_value(metadata.training)
            .with_context(|| format!("{}: metadata field training", path.display()))?;
        ensure!(
            saved.settings == settings,
            "{}: the run was started with {:?}, not with {settings:?}",
            path.display(),
            saved.settings
        );
        Self::restored(equipment, settings, saved.steps, &mut tensors)
            .with_context(|| path.display().to_string())
    }

    fn restored(
        equipment: Equipment,
        settings: WorldModelSettings,
        steps: u64,
        tensors: &mut Tensors,
    ) -> Result<Self> {
        let mut bytes = |name: &str| {
            let tensor = tensors.remove(name);
            let tensor = tensor.with_context(|| format!("no tensor `{name}`"))?;
            Ok::<_, anyhow::Error>(tensor.to_vec1::<u8>()?)
        };
        let (mut explorer, mut replay) = empty(&equipment, &settings)?;
        explorer.restore(&bytes(ENVIRONMENTS)?)?;
        replay.restore(&bytes(REPLAY)?)?;
        let starts = replay.starts(1, settings.tilt);
        let sample = replay.sequences(&starts[..starts.len().min(1)], 1);
        let mut trainer = Self::with(equipment, settings, explorer, replay, &sample)?;
        trainer.learner.restore(tensors, steps)?;
        Ok(trainer)
    }

    /// Steps of the optimiser so far.
    pub fn steps(&self) -> u64 {
        self.learner.steps()
    }

    /// The model as it is now.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn model(&self) -> Result<WorldModel> {
        self.learner.model()
    }

    /// Writes the model.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn export(&self, path: &Path, data: &serde_json::Value) -> Result<CheckpointMetadata> {
        let training = serde_json::json!({
            "command": run::command_line(),
            "settings": self.settings,
            "steps": self.steps(),
            "policy": self.equipment.policy.metadata().version(),
            "data": data,
        });
        let robot = &self.equipment.robot;
        Ok(self
            .model()?
            .save(path, robot, training, run::git_revision())?)
    }

    /// Writes everything that the run depends on.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save_run(&self, path: &Path) -> Result<()> {
        let mut tensors = self.learner.state()?;
        for (name, bytes) in [
            (ENVIRONMENTS, self.explorer.snapshot()?),
            (REPLAY, self.replay.snapshot()?),
        ] {
            let length = bytes.len();
            let tensor = Tensor::from_vec(bytes, length, &Device::Cpu)?;
            tensors.insert(name.to_owned(), tensor);
        }
        let mut metadata = run_metadata(&self.equipment.robot);
        metadata.training = serde_json::to_value(Saved {
            settings: self.settings.clone(),
            steps: self.steps(),
        })?;
        checkpoint::save(path, metadata, &tensors)?;
        Ok(())
    }

    /// Collects, then learns.
    fn round(&mut self) -> Result<Round> {
        let start = Instant::now();
        let settings = &self.settings;
        self.explorer.collect(settings.frames, &mut self.replay)?;
        let collecting = start.elapsed().as_secs_f64();
        let loss_steps = settings.loss_steps(self.steps());
        let starts = self.replay.starts(loss_steps, settings.tilt);
        ensure!(
            !starts.is_empty(),
            "no robot stands for {loss_steps} control periods: is this its policy?"
        );
        let tilted = starts.iter().filter(|start| start.is_tilted);
        let tilted: Vec<Start> = tilted.copied().collect();
        let mut round = Round {
            loss_steps,
            tilted_starts: tilted.len(),
            collecting,
            ..Round::default()
        };
        let updates = settings.updates as u64;
        for _ in 0..updates.min(settings.steps.saturating_sub(self.steps())) {
            round.learning_rate = self.settings.learning_rate(self.steps());
            let batch = self.draw(&starts, &tilted, loss_steps);
            let step = self.steps();
            let update = self
                .learner
                .update(&batch, round.learning_rate, &self.equipment.threads)
                .with_context(|| format!("step {step}"))?;
            round.add(&update);
        }
        round.learning = start.elapsed().as_secs_f64() - collecting;
        Ok(round)
    }

    /// The batch of the next step: some of the sequences start anywhere, some where a robot is tilted.
    fn draw(&self, starts: &[Start], tilted: &[Start], steps: usize) -> Sequences {
        let settings = &self.settings;
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        // Stream 0 drew the weights.
        rng.set_stream(self.steps() + 1);
        let from_tilted = if tilted.is_empty() {
            0
        } else {
            (settings.tilted * settings.rows as f64).round() as usize
        };
        let drawn: Vec<Start> = (0..settings.rows)
            .map(|row| {
                let from = if row < from_tilted { tilted } else { starts };
                from[rng.random_range(0..from.len())]
            })
            .collect();
        self.replay.sequences(&drawn, steps)
    }
}

impl Round {
    fn add(&mut self, update: &UpdateStatistics) {
        self.updates += 1.0;
        self.loss += update.loss;
        self.gradient_norm += update.gradient_norm;
    }

    fn row(&self) -> [f64; COLUMNS.len()] {
        let updates = self.updates.max(1.0);
        [
            self.loss / updates,
            self.loss_steps as f64,
            self.gradient_norm / updates,
            self.learning_rate,
            self.tilted_starts as f64,
            self.collecting,
            self.learning,
        ]
    }
}

/// Environments and nothing collected.
fn empty(equipment: &Equipment, settings: &WorldModelSettings) -> Result<(Explorer, Replay)> {
    settings.check()?;
    let (episodes, count) = (settings.episodes, settings.environments);
    let environments = equipment.environments(episodes, count, settings.seed)?;
    let replay = Replay::new(*environments.layout(), settings.capacity);
    let explorer = Explorer::new(environments, settings.goal_noise, settings.seed);
    Ok((explorer, replay))
}

fn run_metadata(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(RUN_KIND, robot, robot.joints())
}

/// Trains to the settings' last step, or the interrupt. `data` is what the model's metadata say of the goals.
///
/// # Errors
/// When a file cannot be written, or the gradient stops being a number.
pub fn train(
    trainer: &mut Trainer,
    data: &serde_json::Value,
    files: &RunFiles,
    interrupt: &Interrupt,
) -> Result<Outcome> {
    let (done, steps) = (trainer.steps(), trainer.settings.steps);
    let columns: Vec<&str> = ["step"].into_iter().chain(COLUMNS).collect();
    let mut log = CsvLog::open(&files.log(), &columns, (done > 0).then_some(done))?;
    let bar = run::progress(steps, done);
    let mut saved = Instant::now();
    while trainer.steps() < steps {
        if interrupt.requested() {
            trainer.save_run(&files.checkpoint())?;
            bar.abandon_with_message("interrupted; continue with --resume");
            return Ok(Outcome::Interrupted);
        }
        let round = trainer.round()?;
        let row = round.row();
        log.row(trainer.steps(), &row)?;
        bar.set_position(trainer.steps());
        bar.set_message(format!("loss {:.4} over {} periods", row[0], row[1]));
        if saved.elapsed() >= files.save_every {
            trainer.save_run(&files.checkpoint())?;
            saved = Instant::now();
        }
    }
    trainer.save_run(&files.checkpoint())?;
    trainer.export(&files.weights, data)?;
    bar.finish();
    Ok(Outcome::Finished)
}

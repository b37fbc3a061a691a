//! The training loop of the EMP (paper, Algorithm 1): rollouts with the EMP's goals teach the EMP.
//!
//! The paper updates after every control period of a batch of clips; we update after every few, on mini-batches of them: one
//! update then sees many moments of many clips. The paper's world model learns in turns with the EMP; ours is trained before
//! ([`crate::world_model`]) and stays as it is.

use std::{path::Path, sync::Arc, time::Instant};

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use emp_models::{
    CheckpointMetadata, checkpoint,
    emp::{self, Emp, NETWORK_PREFIX},
    mlp::shipped_tensors,
};
use emp_motion::atomic;
use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use super::{
    hindsight::{Counts, Hindsight},
    imagination::{FrozenWorldModel, Imagination},
    judge::{Judge, Verdict},
    learner::{self, Learner, UpdateStatistics, WarmUp},
    objective::Terms,
    rollout::EmpCollector,
    settings::EmpSettings,
};
use crate::{
    equipment::Equipment,
    log::CsvLog,
    run::{self, Interrupt, Outcome, RunFiles, Session},
};

/// Kind of the checkpoints in a run's folder, which hold the optimiser and the environments too.
const RUN_KIND: &str = "emp-run";

/// The environments' snapshot in a checkpoint.
const ENVIRONMENTS: &str = "environments";

/// Columns of the log after the step and the losses.
const COLUMNS: [&str; 15] = [
    "hindsight",
    "falls",
    "contact",
    "mean_change",
    "episodes",
    "gradient_norm",
    "moments_before_falls",
    "avoidable",
    "moments_of_contacts",
    "relievable",
    "moments_of_changes",
    "needed",
    "seconds_collecting",
    "seconds_replaying",
    "seconds_learning",
];

/// A run: the learner, its environments, and how far they are.
pub struct Trainer {
    equipment: Equipment,
    settings: EmpSettings,
    /// Settings that the run had before, with the steps at which they were left.
    past: Vec<Phase>,
    collector: EmpCollector,
    learner: Learner,
    /// Policy and world model, where anything is imagined.
    imagination: Option<Imagination>,
    /// Version of the world model.
    world_model: Option<String>,
    /// Environment steps of the EMP learnt from.
    steps: u64,
    /// The best score of a judged EMP.
    best_score: Option<f64>,
    /// What the run was run by, command by command.
    sessions: Vec<Session>,
}

/// A part of a run with settings of its own.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Phase {
    until_step: u64,
    settings: EmpSettings,
    #[serde(default)]
    world_model: Option<String>,
}

/// What a run's checkpoint says of its progress.
#[derive(Serialize, Deserialize)]
struct Saved {
    settings: EmpSettings,
    #[serde(default)]
    past: Vec<Phase>,
    steps: u64,
    learner: learner::Progress,
    /// Version of the world model.
    world_model: Option<String>,
    best_score: Option<f64>,
    sessions: Vec<Session>,
}

/// A run's files and its judge.
pub struct Run<'a> {
    /// Where it writes.
    pub files: &'a RunFiles,
    /// Who judges it.
    pub judge: &'a Judge,
    /// What the weights say of the data.
    pub data: serde_json::Value,
}

impl Trainer {
    /// Starts with random weights. `world_model` is read where the settings imagine.
    ///
    /// # Errors
    /// When a setting is out of bounds, a world model is missing, or the robot falls whatever it is asked for.
    pub fn new(
        equipment: Equipment,
        world_model: Option<&FrozenWorldModel>,
        settings: EmpSettings,
    ) -> Result<Self> {
        settings.check()?;
        let world_model = match settings.horizon {
            0 => None,
            horizon => Some(world_model.with_context(|| {
                format!(
                    "setting `horizon` is {horizon}: imagining needs a world model (--world-model)"
                )
            })?),
        };
        let imagine = |world_model: &FrozenWorldModel| {
            Imagination::new(Arc::clone(&equipment.policy), world_model.model.clone())
        };
        let (episodes, count) = (settings.episodes, settings.environments);
        let environments = equipment.environments(episodes, count, settings.seed)?;
        let mut collector = EmpCollector::new(environments);
        let rollout = collector.collect(None, settings.warm_up, 0, &equipment.threads)?;
        let layout = *collector.environments().layout();
        let warm_up = WarmUp::new(rollout, &layout)?;
        Ok(Self {
            learner: Learner::new(&equipment.robot, &settings, &warm_up)?,
            imagination: world_model.map(imagine).transpose()?,
            world_model: world_model.map(|world_model| world_model.version.clone()),
            collector,
            equipment,
            settings,
            past: Vec::new(),
            steps: 0,
            best_score: None,
            sessions: vec![Session::begin(0)],
        })
    }

    /// Continues from a checkpoint of this run. Only if `may_change`, the settings may be others than before: a new phase of the
    /// run, which its weights will tell.
    ///
    /// # Errors
    /// When the checkpoint is damaged, or its run had another robot, other networks or, unasked, other settings.
    pub fn resume(
        equipment: Equipment,
        world_model: Option<&FrozenWorldModel>,
        settings: EmpSettings,
        path: &Path,
        may_change: bool,
    ) -> Result<Self> {
        let (metadata, mut tensors) = checkpoint::load(path)?;
        metadata.check(path, &run_metadata(&equipment.robot))?;
        let saved: Saved = serde_json::from_value(metadata.training)
            .with_context(|| format!("{}: metadata field training", path.display()))?;
        ensure!(
            may_change || saved.settings == settings,
            "{}: the run has {:?}, not {settings:?}; --change-settings starts a new phase of it",
            path.display(),
            saved.settings
        );
        let environments = tensors
            .remove(ENVIRONMENTS)
            .with_context(|| format!("{}: no tensor `{ENVIRONMENTS}`", path.display()))?
            .to_vec1::<u8>()?;
        let mut trainer = Self::new(equipment, world_model, settings)?;
        ensure!(
            may_change || saved.world_model == trainer.world_model,
            "{}: the run has the world model {:?}, not {:?}; --change-settings starts a new phase of it",
            path.display(),
            saved.world_model,
            trainer.world_model
        );
        trainer.past = saved.past;
        let before = (&saved.settings, &saved.world_model);
        if before != (&trainer.settings, &trainer.world_model) {
            trainer.past.push(Phase {
                until_step: saved.steps,
                settings: saved.settings,
                world_model: saved.world_model,
            });
        }
        trainer
            .collector
            .restore(&environments)
            .with_context(|| path.display().to_string())?;
        trainer
            .learner
            .restore(&tensors, saved.learner)
            .with_context(|| path.display().to_string())?;
        trainer.steps = saved.steps;
        trainer.best_score = saved.best_score;
        trainer.sessions = saved.sessions;
        trainer.sessions.push(Session::begin(saved.steps));
        Ok(trainer)
    }

    /// Environment steps learnt from so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// The EMP as it would be served now: with the precision of the file that ships.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn emp(&self) -> Result<Emp> {
        let (normalizer, average) = (self.learner.normalizer(), self.learner.average());
        let tensors = shipped_tensors(NETWORK_PREFIX, normalizer, average)?;
        let robot = &self.equipment.robot;
        let metadata = CheckpointMetadata::for_joints(emp::KIND, robot, robot.joints());
        let config = self.learner.network().config().clone();
        Emp::from_tensors(config, Arc::clone(robot), tensors, metadata).map_err(anyhow::Error::msg)
    }

    /// Writes the EMP for serving: the networks as f16.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn export(
        &self,
        path: &Path,
        data: &serde_json::Value,
        verdict: &Verdict,
    ) -> Result<CheckpointMetadata> {
        let training = serde_json::json!({
            "sessions": self.sessions,
            "settings": self.settings,
            "past": self.past,
            "steps": self.steps,
            "policy": self.equipment.policy.metadata().version(),
            "world_model": self.world_model,
            "operating_point": self.learner.reference(),
            "data": data,
            "figures": verdict,
        });
        Ok(Emp::save(
            path,
            &self.equipment.robot,
            self.learner.network().config(),
            self.learner.normalizer(),
            self.learner.average(),
            training,
            run::git_revision(),
        )?)
    }

    /// Writes everything that the run depends on.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save_run(&self, path: &Path) -> Result<()> {
        let mut tensors = self.learner.state()?;
        let environments = self.collector.snapshot()?;
        let bytes = environments.len();
        let environments = Tensor::from_vec(environments, bytes, &Device::Cpu)?;
        tensors.insert(ENVIRONMENTS.to_owned(), environments);
        let mut metadata = run_metadata(&self.equipment.robot);
        metadata.config = serde_json::to_value(self.learner.network().config())?;
        metadata.training = serde_json::to_value(Saved {
            settings: self.settings.clone(),
            past: self.past.clone(),
            steps: self.steps,
            learner: self.learner.progress(),
            world_model: self.world_model.clone(),
            best_score: self.best_score,
            sessions: self.sessions.clone(),
        })?;
        checkpoint::save(path, metadata, &tensors)?;
        Ok(())
    }

    /// Judges the EMP, and keeps its weights if it is the best so far.
    fn judge(&mut self, run: &Run<'_>) -> Result<Verdict> {
        let verdict = run.judge.judge(self.emp()?)?;
        if self.best_score.is_none_or(|best| verdict.score > best) {
            self.best_score = Some(verdict.score);
            self.export(&run.files.best(), &run.data, &verdict)?;
        }
        Ok(verdict)
    }

    /// Collects a rollout and learns from it.
    fn step(&mut self) -> Result<Step> {
        let start = Instant::now();
        let threads = &self.equipment.threads;
        let network = self.learner.network().clone();
        let frames = self.settings.frames;
        let fork_interval = self.settings.fork_interval();
        let rollout = self
            .collector
            .collect(Some(&network), frames, fork_interval, threads)?;
        let collecting = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let mut labels = None;
        if self.settings.hindsight.weight > 0.0 {
            let hindsight = Hindsight::new(&self.equipment.robot, &self.settings.hindsight);
            let seed = self.settings.seed.wrapping_add(self.steps);
            let found = hindsight.labels(&rollout, &self.collector, &network, seed, threads);
            labels = Some(found?);
        }
        let replaying = start.elapsed().as_secs_f64();
        let update = self.learner.update(
            &rollout,
            labels.as_ref(),
            self.imagination.as_ref(),
            threads,
        )?;
        let rows = rollout.rows();
        self.steps += rows as u64;
        let changes = rollout.answers.iter().zip(&rollout.goals);
        let change: f64 = changes.map(|(a, b)| f64::from((a - b).abs())).sum();
        Ok(Step {
            change: change / rollout.answers.len() as f64,
            falls: rollout.falls(),
            contact: mean(&rollout.contact),
            episodes: rollout.episodes(),
            update,
            collecting,
            replaying,
            counts: labels.map(|labels| labels.counts).unwrap_or_default(),
        })
    }
}

/// What one rollout and its update measured.
struct Step {
    falls: usize,
    /// Mean force between the robot's own links, N.
    contact: f64,
    /// Mean absolute change of a goal angle, rad.
    change: f64,
    episodes: usize,
    update: UpdateStatistics,
    collecting: f64,
    replaying: f64,
    counts: Counts,
}

impl Step {
    fn row(&self) -> Vec<f64> {
        let (update, counts) = (&self.update, &self.counts);
        let mut row = update.terms.to_vec();
        row.extend([
            update.hindsight,
            self.falls as f64,
            self.contact,
            self.change,
            self.episodes as f64,
            update.gradient_norm,
            counts.falls as f64,
            counts.avoidable as f64,
            counts.contacts as f64,
            counts.relievable as f64,
            counts.changes as f64,
            counts.needed as f64,
            self.collecting,
            self.replaying,
            update.seconds,
        ]);
        row
    }

    fn message(&self) -> String {
        format!(
            "falls {} of {} change {:.3} rad contact {:.1} N",
            self.falls, self.episodes, self.change, self.contact,
        )
    }
}

/// Trains until `steps` environment steps are learnt from, or the interrupt.
///
/// # Errors
/// When a file cannot be written, or the gradient stops being a number.
pub fn train(
    trainer: &mut Trainer,
    steps: u64,
    run: &Run<'_>,
    interrupt: &Interrupt,
) -> Result<Outcome> {
    let done = trainer.steps();
    let resumed = (done > 0).then_some(done);
    let mut columns = vec!["step"];
    columns.extend(Terms::NAMES);
    columns.extend(COLUMNS);
    let mut log = CsvLog::open(&run.files.log(), &columns, resumed)?;
    let mut verdicts = CsvLog::open(&run.files.evaluations(), &Verdict::columns(), resumed)?;
    let bar = run::progress(steps, done);
    let mut saved = Instant::now();
    while trainer.steps() < steps {
        if interrupt.requested() {
            trainer.save_run(&run.files.checkpoint())?;
            bar.abandon_with_message("interrupted; continue with --resume");
            return Ok(Outcome::Interrupted);
        }
        let before = trainer.steps();
        let step = trainer.step()?;
        log.row(trainer.steps(), &step.row())?;
        bar.set_position(trainer.steps());
        bar.set_message(step.message());
        let every = trainer.settings.evaluate_every.max(1);
        if before / every < trainer.steps() / every || trainer.steps() >= steps {
            let verdict = trainer.judge(run)?;
            verdicts.row(trainer.steps(), &verdict.row())?;
        }
        if saved.elapsed() >= run.files.save_every {
            trainer.save_run(&run.files.checkpoint())?;
            saved = Instant::now();
        }
    }
    trainer.save_run(&run.files.checkpoint())?;
    let best = run.files.best();
    if best != run.files.weights {
        let weights =
            std::fs::read(&best).with_context(|| format!("reading {}", best.display()))?;
        atomic::write(&run.files.weights, &weights)
            .with_context(|| format!("writing {}", run.files.weights.display()))?;
    }
    bar.finish();
    Ok(Outcome::Finished)
}

fn mean(values: &[f32]) -> f64 {
    let sum: f64 = values.iter().copied().map(f64::from).sum();
    sum / values.len().max(1) as f64
}

fn run_metadata(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(RUN_KIND, robot, robot.joints())
}

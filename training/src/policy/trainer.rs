//! The training loop of the policy: rollouts, updates, curriculum, log, checkpoints.

use std::{fmt, path::Path, sync::Arc, time::Instant};

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use emp_models::{
    CheckpointMetadata,
    checkpoint::{self, Tensors},
    mlp::shipped_tensors,
    policy::{self, NETWORK_PREFIX, Policy, PolicyConfig, PolicyMirror},
};
use emp_motion::atomic;
use emp_robot::Robot;
use emp_sim::{
    End, Rollout,
    environment::{EndReason, PrivilegedLayout, REWARD_NAMES},
    goals::GoalLibrary,
};
use serde::{Deserialize, Serialize};

use super::{
    curriculum::{Curriculum, Episode},
    judge::{Judge, Verdict},
    learner::{self, Learner, UpdateStatistics},
    network::{Symmetry, Widths},
    sampler::Sampler,
    settings::Settings,
    source::{PolicySnapshot, RolloutSource},
};
use crate::{
    log::CsvLog,
    run::{self, Interrupt, Outcome, RunFiles},
};

/// Kind of the checkpoints in a run's folder, which hold the critic, the optimiser and the environments too.
const RUN_KIND: &str = "policy-run";

/// The environments' snapshot in a checkpoint.
const ENVIRONMENTS: &str = "environments";

/// Columns of the log after the step, around the reward's terms.
const EPISODE_COLUMNS: [&str; 6] = [
    "survival",
    "episode_frames",
    "falls",
    "divergences",
    "randomization",
    "difficulty",
];
const LEARNER_COLUMNS: [&str; 7] = [
    "kl",
    "learning_rate",
    "std",
    "policy_loss",
    "value_loss",
    "explained_variance",
    "gradient_norm",
];
const TIME_COLUMNS: [&str; 3] = ["seconds_physics", "seconds_inference", "seconds_learning"];

/// A run: the learner, its curriculum, and how far they are.
pub struct Trainer {
    robot: Arc<Robot>,
    settings: Settings,
    config: PolicyConfig,
    learner: Learner,
    curriculum: Curriculum,
    sampler: Sampler,
    /// The goals, which the sampler's weights are for.
    library: Arc<GoalLibrary>,
    /// Environment steps learnt from.
    steps: u64,
    /// The best score of a judged policy.
    best_score: Option<f64>,
    times: Times,
}

/// Seconds that parts of the run took.
#[derive(Clone, Copy, Debug, Default)]
pub struct Times {
    /// Environment steps.
    pub steps: u64,
    /// Physics, observations and rewards.
    pub physics: f64,
    /// The policy while exploring.
    pub inference: f64,
    /// Updates.
    pub learning: f64,
}

impl Times {
    fn add(&mut self, other: Self) {
        self.steps += other.steps;
        self.physics += other.physics;
        self.inference += other.inference;
        self.learning += other.learning;
    }
}

impl fmt::Display for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let total = self.physics + self.inference + self.learning;
        let share = |seconds: f64| 100.0 * seconds / total.max(1e-9);
        write!(
            f,
            "{total:.0} s: physics {:.0} %, inference {:.0} %, learning {:.0} %; {:.0} environment steps a second",
            share(self.physics),
            share(self.inference),
            share(self.learning),
            self.steps as f64 / total.max(1e-9),
        )
    }
}

/// What a run's checkpoint says of its progress.
#[derive(Serialize, Deserialize)]
struct Saved {
    settings: Settings,
    steps: u64,
    learner: learner::Progress,
    curriculum: Curriculum,
    best_score: Option<f64>,
}

impl Trainer {
    /// Starts with random weights, on goals from `library`. The policy is symmetric where the robot is.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        robot: Arc<Robot>,
        settings: Settings,
        library: Arc<GoalLibrary>,
        threads: usize,
    ) -> Result<Self> {
        let mut config = PolicyConfig::new(&robot, settings.ppo.actor_hidden.clone());
        config.observation = config
            .observation
            .with_heading_periods(settings.environment.heading_periods);
        let layout = PrivilegedLayout::new(&config.observation);
        let widths = Widths {
            features: config.features(),
            privileged: layout.width(),
            actions: config.observation.last_action().len(),
        };
        let symmetry = match PolicyMirror::new(&robot, &config)? {
            Some(policy) => Some(Symmetry {
                policy,
                privileged: layout.mirror(&robot, &config.observation)?,
            }),
            None => None,
        };
        let (ppo, clips) = (settings.ppo.clone(), library.clips().len());
        Ok(Self {
            learner: Learner::new(widths, ppo, symmetry, settings.seed, threads)?,
            curriculum: Curriculum::new(settings.curriculum),
            sampler: Sampler::new(settings.sampler, clips),
            library,
            steps: 0,
            best_score: None,
            times: Times::default(),
            config,
            robot,
            settings,
        })
    }

    /// Continues from a checkpoint of this run, the environments of `source` too. Where the settings, or the goals, may be
    /// others than they were, the environments and the counts of falls start anew, and so does the best score.
    ///
    /// # Errors
    /// When the checkpoint is damaged, its run had another robot, or other settings or goals unasked.
    pub fn resume(
        robot: Arc<Robot>,
        settings: Settings,
        library: Arc<GoalLibrary>,
        threads: usize,
        path: &Path,
        source: &mut dyn RolloutSource,
        change_settings: bool,
    ) -> Result<Self> {
        let (metadata, mut tensors) = checkpoint::load(path)?;
        metadata.check(path, &run_metadata(&robot))?;
        let saved: Saved = serde_json::from_value(metadata.training)
            .with_context(|| format!("{}: metadata field training", path.display()))?;
        ensure!(
            change_settings || saved.settings == settings,
            "{}: the run was started with {:?}, not with {settings:?}; --change-settings lets it go on with these",
            path.display(),
            saved.settings
        );
        let mut trainer = Self::new(robot, settings, library, threads)?;
        let environments = tensors
            .remove(ENVIRONMENTS)
            .with_context(|| format!("{}: no tensor `{ENVIRONMENTS}`", path.display()))?;
        let file = || path.display().to_string();
        trainer
            .learner
            .restore(&tensors, saved.learner)
            .with_context(file)?;
        trainer.steps = saved.steps;
        if change_settings {
            trainer.curriculum.resume_from(&saved.curriculum);
        } else {
            source.restore(&environments.to_vec1::<u8>()?)?;
            trainer.sampler.restore(&tensors).with_context(file)?;
            trainer.curriculum = saved.curriculum;
            trainer.best_score = saved.best_score;
        }
        Ok(trainer)
    }

    /// Environment steps learnt from so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Seconds that parts of this process's share of the run took.
    pub fn times(&self) -> Times {
        self.times
    }

    /// The policy as it is now.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn policy(&self) -> Result<Policy> {
        let mut tensors: Tensors = self.learner.normalizer().tensors()?.into_iter().collect();
        for (name, tensor) in self.learner.actor()? {
            tensors.insert(format!("{NETWORK_PREFIX}.{name}"), tensor);
        }
        self.policy_of(tensors)
    }

    /// The policy as it would be served now: with the precision of the file that ships.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    fn shipped(&self) -> Result<Policy> {
        let (normalizer, actor) = (self.learner.normalizer(), self.learner.actor()?);
        let tensors = shipped_tensors(NETWORK_PREFIX, &normalizer, &actor)?;
        self.policy_of(tensors)
    }

    fn policy_of(&self, tensors: Tensors) -> Result<Policy> {
        let (config, robot) = (self.config.clone(), Arc::clone(&self.robot));
        let metadata = CheckpointMetadata::for_joints(policy::KIND, &robot, robot.joints());
        Policy::from_tensors(config, robot, tensors, metadata).map_err(anyhow::Error::msg)
    }

    /// Writes the policy for serving: the network as f16.
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
            "command": run::command_line(),
            "settings": self.settings,
            "steps": self.steps,
            "data": data,
            "figures": verdict,
        });
        Ok(Policy::save(
            path,
            &self.robot,
            &self.config,
            &self.learner.normalizer(),
            &self.learner.actor()?,
            training,
            run::git_revision(),
        )?)
    }

    /// Writes everything that the run depends on.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save_run(&self, path: &Path, source: &mut dyn RolloutSource) -> Result<()> {
        let mut tensors = self.learner.state()?;
        self.sampler.save(&mut tensors)?;
        let environments = source.snapshot()?;
        let bytes = environments.len();
        tensors.insert(
            ENVIRONMENTS.to_owned(),
            Tensor::from_vec(environments, bytes, &Device::Cpu)?,
        );
        let mut metadata = run_metadata(&self.robot);
        metadata.config = serde_json::to_value(&self.config)?;
        metadata.training = serde_json::to_value(Saved {
            settings: self.settings.clone(),
            steps: self.steps,
            learner: self.learner.progress(),
            curriculum: self.curriculum.clone(),
            best_score: self.best_score,
        })?;
        checkpoint::save(path, metadata, &tensors)?;
        Ok(())
    }

    /// Judges the policy, and keeps its weights if it is the best so far.
    fn judge(&mut self, run: &Run<'_>) -> Result<Verdict> {
        let verdict = run.judge.judge(self.shipped()?)?;
        if self.best_score.is_none_or(|best| verdict.score > best) {
            self.best_score = Some(verdict.score);
            self.export(&run.files.best(), &run.data, &verdict)?;
        }
        Ok(verdict)
    }

    fn snapshot(&self) -> Result<PolicySnapshot> {
        Ok(PolicySnapshot {
            policy: Arc::new(self.policy()?),
            log_std: self.learner.log_std()?,
            randomization: self.curriculum.randomization(),
            difficulty: self.curriculum.difficulty(),
            clip_weights: self.sampler.weights(),
        })
    }

    /// Lets normalisation see what random actions lead to.
    fn warm_up(&mut self, source: &mut dyn RolloutSource) -> Result<()> {
        for _ in 0..self.settings.warm_up {
            let collected = source.collect(&self.snapshot()?, self.settings.horizon)?;
            self.learner.warm_up(&collected.rollout);
        }
        Ok(())
    }

    /// Collects a rollout and learns from it.
    fn step(&mut self, source: &mut dyn RolloutSource) -> Result<Step> {
        let start = Instant::now();
        let snapshot = self.snapshot()?;
        let collected = source.collect(&snapshot, self.settings.horizon)?;
        let collecting = start.elapsed().as_secs_f64();
        let rollout = collected.rollout;
        let update = self.learner.update(&rollout)?;
        let fell = |end: EndReason| matches!(end, EndReason::Tilted | EndReason::Sank);
        let ended = rollout.statistics.episodes.iter();
        self.sampler.update(
            &self
                .library
                .weighted(&snapshot.clip_weights)
                .probabilities(),
            rollout.rewards.len(),
            ended
                .filter(|episode| fell(episode.end))
                .map(|episode| episode.clip as usize),
        );
        let longest = self.settings.environment.episode_frames as f64;
        let episodes = rollout.statistics.episodes.iter();
        self.curriculum.update(episodes.map(|episode| {
            let survived = episode.end == EndReason::TimedOut;
            // The first episodes time out early, lest all do at once.
            let length = if survived {
                1.0
            } else {
                f64::from(episode.length) / longest
            };
            Episode { length, survived }
        }));
        self.steps += rollout.rewards.len() as u64;
        let inference = collected.inference.as_secs_f64();
        let times = Times {
            steps: rollout.rewards.len() as u64,
            physics: collecting - inference,
            inference,
            learning: update.seconds,
        };
        self.times.add(times);
        Ok(Step {
            rollout,
            update,
            times,
        })
    }

    fn row(&self, step: &Step) -> Vec<f64> {
        let count = |end: End| step.rollout.ends.iter().filter(|e| **e == end).count() as f64;
        let longest = self.settings.environment.episode_frames as f64;
        let update = &step.update;
        let mut row = vec![
            self.curriculum.survival().unwrap_or(f64::NAN),
            self.curriculum
                .mean_length()
                .map_or(f64::NAN, |share| share * longest),
            count(End::Terminated),
            count(End::Diverged),
            self.curriculum.randomization(),
            self.curriculum.difficulty(),
        ];
        row.push(step.rollout.statistics.reward_terms.iter().sum());
        row.extend(&step.rollout.statistics.reward_terms);
        row.extend([
            update.divergence,
            update.learning_rate,
            update.std,
            update.policy_loss,
            update.value_loss,
            update.explained_variance,
            update.gradient_norm,
            step.times.physics,
            step.times.inference,
            step.times.learning,
        ]);
        row
    }

    fn message(&self, step: &Step) -> String {
        let terms = &step.rollout.statistics.reward_terms;
        let main = REWARD_NAMES.iter().zip(terms).take(3);
        let main: String = main
            .map(|(name, value)| format!(" {name} {value:.2}"))
            .collect();
        let longest = self.settings.environment.episode_frames as f64;
        format!(
            "survival {:.2} frames {:.0} reward {:.2}{main}",
            self.curriculum.survival().unwrap_or(f64::NAN),
            self.curriculum.mean_length().unwrap_or(f64::NAN) * longest,
            terms.iter().sum::<f64>(),
        )
    }
}

/// What one rollout and its update measured.
struct Step {
    rollout: Rollout,
    update: UpdateStatistics,
    times: Times,
}

/// The names of the log's columns.
pub(super) fn columns() -> Vec<&'static str> {
    let mut columns = vec!["step"];
    columns.extend(EPISODE_COLUMNS);
    columns.push("reward");
    columns.extend(REWARD_NAMES);
    columns.extend(LEARNER_COLUMNS);
    columns.extend(TIME_COLUMNS);
    columns
}

fn run_metadata(robot: &Robot) -> CheckpointMetadata {
    CheckpointMetadata::for_joints(RUN_KIND, robot, robot.joints())
}

/// What a run reads and writes beside the trainer's state.
pub struct Run<'a> {
    /// The environments.
    pub source: &'a mut dyn RolloutSource,
    /// Judges the policy now and then; the best one's weights are the run's result.
    pub judge: &'a Judge,
    /// What the goals were made of, for the weights' metadata.
    pub data: serde_json::Value,
    /// The run's files.
    pub files: RunFiles,
}

/// Runs the trainer until it has learnt from `steps` environment steps or is interrupted, saving now and then.
///
/// # Errors
/// When the simulation fails for good, a file cannot be written, or the gradient stops being a number.
pub fn train(
    trainer: &mut Trainer,
    steps: u64,
    run: &mut Run<'_>,
    interrupt: &Interrupt,
) -> Result<Outcome> {
    let done = trainer.steps();
    let resumed = (done > 0).then_some(done);
    let mut log = CsvLog::open(&run.files.log(), &columns(), resumed)?;
    let mut verdicts = CsvLog::open(&run.files.evaluations(), &Verdict::columns(), resumed)?;
    if done == 0 {
        trainer.warm_up(run.source)?;
    }
    let bar = run::progress(steps, done);
    let mut saved = Instant::now();
    while trainer.steps() < steps {
        if interrupt.requested() {
            trainer.save_run(&run.files.checkpoint(), run.source)?;
            bar.abandon_with_message("interrupted; continue with --resume");
            return Ok(Outcome::Interrupted);
        }
        let before = trainer.steps();
        let step = trainer.step(run.source)?;
        log.row(trainer.steps(), &trainer.row(&step))?;
        bar.set_position(trainer.steps());
        bar.set_message(trainer.message(&step));
        let every = trainer.settings.evaluate_every;
        if before / every < trainer.steps() / every || trainer.steps() >= steps {
            let verdict = trainer.judge(run)?;
            verdicts.row(trainer.steps(), &verdict.row())?;
        }
        if saved.elapsed() >= run.files.save_every {
            trainer.save_run(&run.files.checkpoint(), run.source)?;
            saved = Instant::now();
        }
    }
    trainer.save_run(&run.files.checkpoint(), run.source)?;
    let best = run.files.best();
    let weights = std::fs::read(&best).with_context(|| format!("reading {}", best.display()))?;
    atomic::write(&run.files.weights, &weights)
        .with_context(|| format!("writing {}", run.files.weights.display()))?;
    bar.finish();
    Ok(Outcome::Finished)
}

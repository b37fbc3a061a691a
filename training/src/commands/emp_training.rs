//! What `emp-train emp` and `emp-train emp-ablation` share.

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::Duration};

use anyhow::Result;
use clap::Args;
use emp_models::{policy::Policy, retarget::Retargeter};
use emp_sim::{Pool, Priority};
use emp_training::{
    change,
    emp::{
        data::{self, Motions},
        imagination::FrozenWorldModel,
        judge::Judge,
        settings::{EmpSettings, Preset},
        trainer::{self, Run, Trainer},
    },
    equipment::Equipment,
    run::{Interrupt, Outcome, RunFiles},
};

use super::arguments::{
    RobotArguments, interrupted, learner_threads, policy_weights, retargeter_weights,
};

/// What every training of an EMP takes.
#[derive(Args)]
pub(super) struct TrainingArguments {
    #[command(flatten)]
    pub(super) robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Settings to start from.
    #[arg(long, value_enum, default_value_t = Preset::Default)]
    preset: Preset,
    /// Change one setting, as in `hindsight.weight=50` or `losses.smooth_on=target`; `emp-train emp --print-settings` shows all.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    changes: Vec<String>,
    /// Seed of weights, episodes and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Environment steps to learn from; a resumed run may be given more.
    #[arg(long, default_value_t = 8_000_000)]
    steps: u64,
    /// The frozen policy [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// The world model that imagines (`emp-train world-model`), where the setting `horizon` is above 0, as in the paper's preset.
    #[arg(long, value_name = "FILE")]
    world_model: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// Continue from the checkpoint, or from those that there are.
    #[arg(long)]
    pub(super) resume: bool,
    /// Let a resumed run go on with other settings than it had.
    #[arg(long, requires = "resume")]
    change_settings: bool,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 120)]
    save_every: u64,
    /// Threads for physics and learning; the weights do not depend on it.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// What several trainings of one robot share.
pub(super) struct Setup {
    pub(super) equipment: Equipment,
    pub(super) judge: Judge,
    world_model: Option<FrozenWorldModel>,
    data: serde_json::Value,
}

impl Setup {
    pub(super) fn new(arguments: &TrainingArguments, settings: &EmpSettings) -> Result<Self> {
        let robot = arguments.robot.load()?;
        let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
        let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
        let weights = policy_weights(arguments.policy.as_ref(), &robot);
        let policy = Arc::new(Policy::load(&weights, Arc::clone(&robot))?);
        let world_model = arguments.world_model.as_ref();
        let world_model = world_model.map(|file| FrozenWorldModel::load(file, &robot));
        let world_model = world_model.transpose()?;
        let pool = Arc::new(Pool::new(&robot, arguments.threads, Priority::Normal)?);
        let motions = Motions {
            folders: &arguments.motions,
            procedural: settings.procedural_clips,
            seed: settings.seed,
            live: settings.live,
            frames: settings.episodes.episode_frames,
        };
        let (clips, data) = data::clips(&retargeter, &motions, arguments.threads)?;
        eprintln!("{} clips", clips.len());
        Ok(Self {
            judge: Judge::new(
                &retargeter,
                Arc::clone(&policy),
                settings.evaluation_clips,
                Arc::clone(&pool),
                arguments.threads,
            )?,
            equipment: Equipment {
                robot,
                policy,
                pool,
                clips: clips.into(),
                threads: Arc::new(learner_threads(arguments.threads)?),
            },
            world_model,
            data,
        })
    }

    /// Trains to the arguments' steps; from the checkpoint, if there is one. The exit code, if it was interrupted.
    pub(super) fn train(
        &self,
        arguments: &TrainingArguments,
        settings: EmpSettings,
        files: &RunFiles,
        interrupt: &Interrupt,
    ) -> Result<Option<ExitCode>> {
        let equipment = self.equipment.clone();
        let world_model = self.world_model.as_ref();
        let checkpoint = files.checkpoint();
        let mut trainer = if checkpoint.exists() {
            Trainer::resume(
                equipment,
                world_model,
                settings,
                &checkpoint,
                arguments.change_settings,
            )?
        } else {
            Trainer::new(equipment, world_model, settings)?
        };
        let run = Run {
            files,
            judge: &self.judge,
            data: self.data.clone(),
        };
        let outcome = trainer::train(&mut trainer, arguments.steps, &run, interrupt)?;
        Ok(match outcome {
            Outcome::Finished => None,
            Outcome::Interrupted => Some(interrupted(trainer.steps())),
        })
    }
}

pub(super) fn files(arguments: &TrainingArguments, folder: PathBuf) -> RunFiles {
    let mut files = RunFiles {
        folder,
        weights: PathBuf::new(),
        save_every: Duration::from_secs(arguments.save_every),
    };
    files.weights = files.best();
    files
}

/// The preset's settings with the arguments' changes.
pub(super) fn settings(arguments: &TrainingArguments) -> Result<EmpSettings> {
    let mut settings = EmpSettings::preset(arguments.preset);
    settings.seed = arguments.seed;
    for change in &arguments.changes {
        let (key, value) = change::pair(change)?;
        settings.set(key, value)?;
    }
    settings.check()?;
    Ok(settings)
}

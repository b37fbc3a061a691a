//! `emp-train world-model`.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
    sync::Arc,
};

use anyhow::Result;
use clap::Args;
use emp_models::{policy::Policy, retarget::Retargeter};
use emp_robot::Robot;
use emp_sim::{Pool, Priority};
use emp_training::{
    emp::data::{self, Motions},
    equipment::Equipment,
    run::{Interrupt, Outcome},
    world_model::{
        settings::WorldModelSettings,
        trainer::{self, Trainer},
    },
};

use super::arguments::{
    RobotArguments, RunArguments, interrupted, learner_threads, policy_weights, refuse_overwriting,
    retargeter_weights,
};

/// The command, in the names of its runs.
pub(super) const COMMAND: &str = "world-model";

/// What is trained, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// The policy that moves the legs [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// Where the model goes [default: model.safetensors in the run's folder].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Steps of the optimiser.
    #[arg(long, default_value_t = WorldModelSettings::default().steps)]
    steps: u64,
    /// Control periods that the loss predicts one after the other; 1 is the paper's.
    #[arg(long, default_value_t = WorldModelSettings::default().wm_loss_steps)]
    loss_steps: usize,
    /// Sequences in a batch.
    #[arg(long, default_value_t = WorldModelSettings::default().rows)]
    rows: usize,
    /// Environments stepped side by side.
    #[arg(long, default_value_t = WorldModelSettings::default().environments)]
    environments: usize,
    /// Procedural motions in the mix.
    #[arg(long, default_value_t = WorldModelSettings::default().procedural_clips)]
    procedural_clips: usize,
    /// Seed of weights, episodes and procedural skills.
    #[arg(long, default_value_t = WorldModelSettings::default().seed)]
    seed: u64,
    #[command(flatten)]
    run: RunArguments,
}

/// Trains a world model.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let folder = arguments.run.folder(COMMAND, &robot);
    let weights = arguments.out.clone().unwrap_or_else(|| model_file(&folder));
    let files = arguments.run.files(folder, weights);
    let checkpoint = files.checkpoint();
    refuse_overwriting(&checkpoint, arguments.run.resume)?;
    let settings = settings(arguments);
    settings.check()?;
    let (equipment, data) = equipment(arguments, robot, &settings)?;
    let mut trainer = if arguments.run.resume {
        Trainer::resume(equipment, settings, &checkpoint)?
    } else {
        Trainer::new(equipment, settings)?
    };
    let interrupt = Interrupt::listen()?;
    match trainer::train(&mut trainer, &data, &files, &interrupt)? {
        Outcome::Finished => {
            eprintln!("wrote {}", files.weights.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => Ok(interrupted(trainer.steps())),
    }
}

fn settings(arguments: &Arguments) -> WorldModelSettings {
    WorldModelSettings {
        seed: arguments.seed,
        steps: arguments.steps,
        environments: arguments.environments,
        rows: arguments.rows,
        wm_loss_steps: arguments.loss_steps,
        procedural_clips: arguments.procedural_clips,
        ..WorldModelSettings::default()
    }
}

fn equipment(
    arguments: &Arguments,
    robot: Arc<Robot>,
    settings: &WorldModelSettings,
) -> Result<(Equipment, serde_json::Value)> {
    let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
    let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
    let weights = policy_weights(arguments.policy.as_ref(), &robot);
    let motions = Motions {
        folders: &arguments.motions,
        procedural: settings.procedural_clips,
        seed: settings.seed,
        live: settings.live,
        frames: settings.episodes.episode_frames,
    };
    let (clips, data) = data::clips(&retargeter, &motions, arguments.run.threads)?;
    eprintln!("{} clips", clips.len());
    let equipment = Equipment {
        policy: Arc::new(Policy::load(&weights, Arc::clone(&robot))?),
        pool: Arc::new(Pool::new(&robot, arguments.run.threads, Priority::Normal)?),
        clips: clips.into(),
        threads: Arc::new(learner_threads(arguments.run.threads)?),
        robot,
    };
    Ok((equipment, data))
}

/// The model in a run's folder.
pub(super) fn model_file(folder: &Path) -> PathBuf {
    folder.join("model.safetensors")
}

//! `emp-train world-model-report`.

use std::{path::PathBuf, process::ExitCode, sync::Arc};

use anyhow::Result;
use clap::Args;
use emp_models::world_model::WorldModel;
use emp_sim::tracking::{TrackingEnvironments, TrackingSettings};
use emp_training::world_model::accuracy;

use super::{
    arguments::{RobotArguments, learner_threads, run_folder},
    trial::{TrialArguments, printed},
    world_model::{COMMAND, model_file},
};

/// What is measured, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    #[command(flatten)]
    trial: TrialArguments,
    /// The world model [default: runs/world-model-ROBOT/model.safetensors].
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Environments stepped side by side.
    #[arg(long, default_value_t = 256)]
    environments: u64,
    /// Control periods of each.
    #[arg(long, default_value_t = 800)]
    frames: usize,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Measures a world model and prints the result.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let (robot, trial) = (arguments.robot.load()?, &arguments.trial);
    let file = arguments.model.clone();
    let file = file.unwrap_or_else(|| model_file(&run_folder(COMMAND, &robot)));
    let model = WorldModel::load(&file, &robot)?;
    let mut environments = TrackingEnvironments::new(
        Arc::clone(&robot),
        Arc::new(trial.pool(&robot)?),
        trial.policy(&robot)?,
        TrackingSettings::default(),
        trial.clips(&robot)?.into(),
        0..arguments.environments,
        trial.set.seed(),
    )?;
    let threads = learner_threads(trial.threads)?;
    let accuracy = accuracy::measure(&model, &mut environments, arguments.frames, &threads)?;
    print!("{}", printed(&accuracy, arguments.json)?);
    Ok(ExitCode::SUCCESS)
}

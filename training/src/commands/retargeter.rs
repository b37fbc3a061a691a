//! `emp-train retargeter`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::{Result, ensure};
use clap::Args;
use emp_models::linear;
use emp_training::{
    retargeter::{
        data::{self, Dataset},
        trainer::{self, RetargeterSettings, Trainer},
    },
    run::{Interrupt, Outcome},
};

use super::arguments::{RobotArguments, RunArguments, interrupted, refuse_overwriting};

/// What is trained, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Where the weights go, f16 safetensors.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Optimiser steps.
    #[arg(long, default_value_t = 12_000)]
    steps: u64,
    /// Frames a step.
    #[arg(long, default_value_t = 512)]
    batch: usize,
    /// Learning rate at its peak.
    #[arg(long, default_value_t = 2e-3)]
    learning_rate: f64,
    /// Seed of weights, batches and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Procedural clips in the mix.
    #[arg(long, default_value_t = 600)]
    procedural_clips: usize,
    #[command(flatten)]
    run: RunArguments,
}

/// Trains a retargeter.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    ensure!(
        arguments.batch > 0 && arguments.steps > 0,
        "--batch and --steps must be at least 1"
    );
    let robot = arguments.robot.load()?;
    let folder = arguments.run.folder("retargeter", &robot);
    let files = arguments.run.files(folder, arguments.out.clone());
    let settings = RetargeterSettings {
        steps: arguments.steps,
        batch: arguments.batch,
        learning_rate: arguments.learning_rate,
        seed: arguments.seed,
        procedural_clips: arguments.procedural_clips,
    };
    let (clips, summary) = data::load_with_summary(&arguments.motions)?;
    let dataset = Dataset::new(&clips, settings.procedural_clips, settings.seed)?;
    let (recorded, procedural) = dataset.len();
    eprintln!(
        "{} clips: {recorded} recorded and {procedural} procedural frames, mirrored ones included",
        clips.len()
    );

    linear::set_threads(arguments.run.threads);
    let checkpoint = files.checkpoint();
    refuse_overwriting(&checkpoint, arguments.run.resume)?;
    let mut trainer = if arguments.run.resume {
        Trainer::resume(robot, settings, &checkpoint)?
    } else {
        Trainer::new(robot, settings)?
    };
    let interrupt = Interrupt::listen()?;
    match trainer::train(&mut trainer, &dataset, &summary, &files, &interrupt)? {
        Outcome::Finished => {
            eprintln!("wrote {}", files.weights.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => Ok(interrupted(trainer.steps())),
    }
}

//! `emp-train emp`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Result;
use clap::Args;
use emp_training::run::Interrupt;

use super::{
    arguments::refuse_overwriting,
    emp_training::{Setup, TrainingArguments, files, settings},
};

/// What is trained.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    training: TrainingArguments,
    /// Print the settings as JSON and stop.
    #[arg(long)]
    print_settings: bool,
    /// Where the best weights go at the end, f16 safetensors [default: they stay best.safetensors in the run's folder].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Folder of the run's checkpoint and logs [default: runs/emp-ROBOT].
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
}

/// Trains an EMP.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let settings = settings(&arguments.training)?;
    if arguments.print_settings {
        println!("{}", serde_json::to_string_pretty(&settings)?);
        return Ok(ExitCode::SUCCESS);
    }
    let robot = &arguments.training.robot.robot;
    let default = || PathBuf::from(format!("runs/emp-{robot}"));
    let mut files = files(
        &arguments.training,
        arguments.run.clone().unwrap_or_else(default),
    );
    if let Some(out) = &arguments.out {
        files.weights.clone_from(out);
    }
    refuse_overwriting(&files.checkpoint(), arguments.training.resume)?;
    let setup = Setup::new(&arguments.training, &settings)?;
    let interrupt = Interrupt::listen()?;
    if let Some(code) = setup.train(&arguments.training, settings, &files, &interrupt)? {
        return Ok(code);
    }
    eprintln!("wrote {}", files.weights.display());
    Ok(ExitCode::SUCCESS)
}

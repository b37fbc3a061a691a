//! `emp-train emp-ablation`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Result;
use clap::Args;
use emp_training::{emp::ablation, run::Interrupt};

use super::{
    arguments::refuse_overwriting,
    emp_training::{Setup, TrainingArguments, files, settings},
};

/// Which parts are left out, and where it goes.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    training: TrainingArguments,
    /// Folder of the four runs and of the table, ablation.md and ablation.json [default: runs/ablation-ROBOT].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Trains the rows of the paper's ablation table one after the other, and writes the table.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let full = settings(&arguments.training)?;
    let setup = Setup::new(&arguments.training, &full)?;
    let robot = &arguments.training.robot.robot;
    let default = || PathBuf::from(format!("runs/ablation-{robot}"));
    let folder = arguments.out.clone().unwrap_or_else(default);
    let interrupt = Interrupt::listen()?;
    let mut weights = Vec::new();
    for row in ablation::Row::ALL {
        let files = files(&arguments.training, folder.join(row.name()));
        refuse_overwriting(&files.checkpoint(), arguments.training.resume)?;
        eprintln!("{row}");
        if let Some(code) =
            setup.train(&arguments.training, row.settings(&full), &files, &interrupt)?
        {
            return Ok(code);
        }
        weights.push((row, files.weights));
    }
    let table = ablation::table(&setup.judge, &setup.equipment.robot, &weights)?;
    table.write(&folder)?;
    print!("{table}");
    Ok(ExitCode::SUCCESS)
}

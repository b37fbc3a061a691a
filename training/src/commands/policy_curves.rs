//! `emp-train policy-curves`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Result;
use clap::Args;
use emp_training::policy::curves;

/// What is drawn.
#[derive(Args)]
pub(crate) struct Arguments {
    /// Logs of runs: log.csv in a run's folder. Evaluations beside it are drawn too.
    #[arg(long, num_args = 1.., required = true, value_name = "CSV")]
    log: Vec<PathBuf>,
    /// Where the picture goes, SVG.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Draws learning curves.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    curves::draw(&arguments.log, &arguments.out)?;
    Ok(ExitCode::SUCCESS)
}

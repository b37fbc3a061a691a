//! `emp-train retarget-report`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::{Context as _, Result};
use clap::Args;
use emp_models::retarget::Retargeter;
use emp_motion::atomic;
use emp_training::{retargeter::report, run};

use super::arguments::{RobotArguments, retargeter_weights};

/// What is measured, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion, each folder with motion under them a set of its own; without any, a library
    /// of procedural skills that no network was trained on.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// The weights [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Print the report as one JSON object.
    #[arg(long)]
    json: bool,
    /// Also write the JSON object to a file.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Measures a retargeter and prints the result.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let weights = retargeter_weights(arguments.weights.as_ref(), &robot);
    let retargeter = Retargeter::load(&weights, robot)?;
    let sets = if arguments.motions.is_empty() {
        vec![report::held_out(&retargeter)?]
    } else {
        report::load_sets(&arguments.motions, retargeter.robot().control_rate_hz())?
    };
    let bar = run::spinner();
    let report = report::report(&retargeter, sets, |what| {
        bar.set_message(what.to_owned());
    })?;
    bar.finish_and_clear();
    let json = serde_json::to_string_pretty(&report)?;
    if let Some(out) = &arguments.out {
        atomic::write(out, json.as_bytes())
            .with_context(|| format!("writing {}", out.display()))?;
    }
    if arguments.json {
        println!("{json}");
    } else {
        print!("{report}");
    }
    Ok(ExitCode::SUCCESS)
}

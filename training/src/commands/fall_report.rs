//! `emp-train fall-report`.

use std::{path::PathBuf, process::ExitCode, sync::Arc};

use anyhow::Result;
use clap::Args;
use emp_models::emp::Emp;
use emp_sim::suite::Condition;
use emp_training::{
    emp::falls::{self, FallRun},
    sets::Basis,
};

use super::{
    arguments::RobotArguments,
    trial::{EpisodeProgress, TrialArguments, printed},
};

/// What falls, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    #[command(flatten)]
    trial: TrialArguments,
    /// Weights of an EMP, whose regloss is judged as a sign of coming falls; it changes no goal.
    #[arg(long, value_name = "FILE")]
    emp: Option<PathBuf>,
    /// Do not cut one thing at a time: that takes eleven of twelve parts of the time.
    #[arg(long)]
    no_cuts: bool,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
}

/// Finds out what fells the policy, and prints it.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let policy = arguments.trial.policy(&robot)?;
    let emp = arguments.emp.as_ref();
    let emp = emp.map(|weights| Emp::load(weights, Arc::clone(&robot)));
    let emp = emp.transpose()?.map(Arc::new);
    let groups = arguments.trial.groups(&robot)?;
    let basis = Basis::new(arguments.trial.set, &groups);
    let clips: Vec<_> = groups.into_iter().flat_map(|group| group.clips).collect();
    let pool = arguments.trial.pool(&robot)?;
    let mut progress = EpisodeProgress::listen()?;
    let run = FallRun {
        pool: &pool,
        policy: &policy,
        emp,
        clips: &clips,
        basis: &basis,
        conditions: &Condition::HARD,
        cuts: !arguments.no_cuts,
    };
    let report = falls::report(&run, &mut progress)?;
    progress.finish();
    print!("{}", printed(&report, arguments.json)?);
    Ok(ExitCode::SUCCESS)
}

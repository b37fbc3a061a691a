//! `emp-train policy-report`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::{Context as _, Result};
use clap::Args;
use emp_models::{controller::Controller, filters::DECOUPLED};
use emp_motion::atomic;
use emp_training::policy::report;

use super::{
    arguments::RobotArguments,
    trial::{EpisodeProgress, TrialArguments, printed},
};

/// What is scored, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    #[command(flatten)]
    trial: TrialArguments,
    /// What stands before the policy: `decoupled` for nothing, or a filter, with parameters as `NAME:key=value,…`.
    #[arg(long, num_args = 1.., value_name = "NAME", default_value = DECOUPLED)]
    controllers: Vec<String>,
    /// Climb the difficulty ladder instead (amplitude, speed, hand load, pushes) and write ladder.csv and ladder.svg here.
    #[arg(long, value_name = "DIR")]
    ladder: Option<PathBuf>,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
}

/// Scores a policy and prints the result.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let policy = arguments.trial.policy(&robot)?;
    let controllers = arguments
        .controllers
        .iter()
        .map(|name| Controller::by_name(name, &policy, None));
    let controllers = controllers.collect::<Result<Vec<_>, _>>()?;
    let set = arguments.trial.set;
    let groups = arguments.trial.groups(&robot)?;
    let pool = arguments.trial.pool(&robot)?;
    let mut progress = EpisodeProgress::listen()?;
    let text = match &arguments.ladder {
        Some(folder) => {
            let clips: Vec<_> = groups.into_iter().flat_map(|group| group.clips).collect();
            let seed = set.seed();
            let ladder = report::ladder(&pool, &controllers, &clips, seed, &mut progress)?;
            let csv = folder.join("ladder.csv");
            atomic::write(&csv, ladder.csv().as_bytes())
                .with_context(|| format!("writing {}", csv.display()))?;
            report::draw_ladder(&ladder, robot.name(), &folder.join("ladder.svg"))?;
            printed(&ladder, arguments.json)?
        }
        None => {
            let report = report::report(&pool, &controllers, &groups, set, &mut progress)?;
            printed(&report, arguments.json)?
        }
    };
    progress.finish();
    print!("{text}");
    Ok(ExitCode::SUCCESS)
}

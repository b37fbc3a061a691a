//! `emp-train policy-report`.

use std::{path::PathBuf, process::ExitCode, sync::Arc};

use anyhow::{Context as _, Result};
use clap::Args;
use emp_models::{
    checkpoint::write_atomically, controller::Controller, policy::Policy,
    retarget::Retargeter,
};
use emp_sim::{
    Pool, Priority,
    evaluation::{EpisodeResult, Progress},
    goals::{GoalClip, Source},
};
use emp_training::{
    policy::report,
    retargeter::data,
    run::{self, Interrupt},
};

use crate::{RobotArguments, retargeter_weights};

/// What is scored, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion; without any, procedural skills alone.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Procedural motions, cut into clips like the recorded ones.
    #[arg(long, default_value_t = 100)]
    procedural: usize,
    /// The policy [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// What stands before the policy: `decoupled` for nothing, or a filter, with parameters as `NAME:key=value,…`.
    #[arg(long, num_args = 1.., value_name = "NAME", default_value = Controller::DECOUPLED)]
    controllers: Vec<String>,
    /// Seed of loads, pushes and randomisation.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Climb the difficulty ladder instead (amplitude, speed, hand load, pushes) and write ladder.csv and ladder.svg here.
    #[arg(long, value_name = "DIR")]
    ladder: Option<PathBuf>,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
    /// Threads for physics; the figures do not depend on it.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// Scores a policy and prints the result.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
    let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
    let weights = arguments.weights.clone().unwrap_or_else(|| {
        PathBuf::from(format!(
            "models/weights/{}-policy.safetensors",
            robot.name()
        ))
    });
    let policy = Arc::new(Policy::load(&weights, Arc::clone(&robot))?);
    let controllers = arguments
        .controllers
        .iter()
        .map(|name| Controller::by_name(name, &policy, None));
    let controllers = controllers.collect::<Result<Vec<_>, _>>()?;
    let clips = clips(arguments, &retargeter)?;
    let pool = Pool::new(&robot, arguments.threads, Priority::Normal)?;
    let mut progress = EpisodeProgress::listen()?;
    let text = match &arguments.ladder {
        Some(folder) => {
            let ladder =
                report::ladder(&pool, &controllers, &clips, arguments.seed, &mut progress)?;
            let csv = folder.join("ladder.csv");
            write_atomically(&csv, ladder.csv().as_bytes())
                .with_context(|| format!("writing {}", csv.display()))?;
            report::draw_ladder(&ladder, robot.name(), &folder.join("ladder.svg"))?;
            printed(&ladder, arguments.json)?
        }
        None => {
            let report =
                report::report(&pool, &controllers, &clips, arguments.seed, &mut progress)?;
            printed(&report, arguments.json)?
        }
    };
    progress.finish();
    print!("{text}");
    Ok(ExitCode::SUCCESS)
}

/// The clips of a report: none of them was trained on, if --motions are other people's than in training.
fn clips(arguments: &Arguments, retargeter: &Retargeter) -> Result<Vec<GoalClip>> {
    /// Training draws its skills from other seeds.
    const SEED: u64 = 0x7265_706f_7274;
    let recorded = if arguments.motions.is_empty() {
        Vec::new()
    } else {
        data::load_clips(&arguments.motions)?
    };
    let skills = emp_motion::skills::library(SEED, arguments.procedural);
    let threads = arguments.threads;
    let mut clips = GoalClip::retargeted(retargeter, &recorded, Source::Recorded, threads)?;
    clips.extend(GoalClip::retargeted(
        retargeter,
        &skills,
        Source::Procedural,
        threads,
    )?);
    let windows = clips.iter().flat_map(|clip| clip.windows(report::FRAMES));
    Ok(windows.collect())
}

fn printed<T: serde::Serialize + std::fmt::Display>(value: &T, json: bool) -> Result<String> {
    Ok(if json {
        serde_json::to_string_pretty(value)? + "\n"
    } else {
        value.to_string()
    })
}

/// Counts episodes on stderr; Ctrl-C stops them.
struct EpisodeProgress {
    bar: indicatif::ProgressBar,
    interrupt: Interrupt,
}

impl EpisodeProgress {
    fn listen() -> Result<Self> {
        Ok(Self {
            bar: run::spinner(),
            interrupt: Interrupt::listen()?,
        })
    }

    fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

impl Progress for EpisodeProgress {
    fn finished(&mut self, episode: &EpisodeResult) {
        self.bar.inc(1);
        let message = format!("{} episodes; {}", self.bar.position(), episode.clip);
        self.bar.set_message(message);
    }

    fn is_cancelled(&self) -> bool {
        self.interrupt.requested()
    }
}

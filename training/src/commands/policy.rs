//! `emp-train policy`.

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::Duration};

use anyhow::{Result, ensure};
use clap::Args;
use emp_models::retarget::Retargeter;
use emp_robot::Robot;
use emp_sim::{
    Pool, Priority,
    goals::{GoalClip, GoalLibrary},
};
use emp_training::{
    change,
    policy::{
        self, Preset, Run,
        judge::Judge,
        remote::RemoteSource,
        source::{LocalSource, RolloutSource},
    },
    run::{Interrupt, Outcome, RunFiles},
};

use super::arguments::{RobotArguments, interrupted, refuse_overwriting, retargeter_weights};

/// What is trained, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// Where the weights go, f16 safetensors [default: weights.safetensors in the run's folder].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Environment steps to learn from; a resumed run may be given more.
    #[arg(long, default_value_t = 20_000_000)]
    steps: u64,
    /// Settings to start from.
    #[arg(long, value_enum, default_value_t = Preset::Robust)]
    preset: Preset,
    /// Change one setting, as in `environments=512` or `ppo.discount=0.99`; --print-settings shows all.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    changes: Vec<String>,
    /// Print the settings as JSON and stop.
    #[arg(long)]
    print_settings: bool,
    /// Folders (or files) of recorded motion of people who are not in --motions, by which weights are chosen.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    development: Vec<PathBuf>,
    /// Seed of weights, episodes and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Servers that simulate, for example `http://host:50051`; without any, this machine does. A resumed run needs as many.
    #[arg(long, num_args = 1.., value_name = "URL")]
    remote: Vec<String>,
    /// Continue the run from its checkpoint.
    #[arg(long)]
    resume: bool,
    /// Let a resumed run go on with other settings or motion than it had.
    #[arg(long, requires = "resume")]
    change_settings: bool,
    /// Folder of the run's checkpoint and log [default: runs/policy-ROBOT].
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 120)]
    save_every: u64,
    /// Threads for physics and learning; the weights do not depend on it.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// Trains a policy.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    ensure!(arguments.steps > 0, "--steps must be at least 1");
    let robot = arguments.robot.load()?;
    let settings = settings(arguments, &robot)?;
    if arguments.print_settings {
        println!("{}", serde_json::to_string_pretty(&settings)?);
        return Ok(ExitCode::SUCCESS);
    }
    let folder = arguments
        .run
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("runs/policy-{}", robot.name())));
    let weights = arguments.out.clone();
    let files = RunFiles {
        weights: weights.unwrap_or_else(|| folder.join("weights.safetensors")),
        folder,
        save_every: Duration::from_secs(arguments.save_every),
    };
    let checkpoint = files.checkpoint();
    refuse_overwriting(&checkpoint, arguments.resume)?;
    let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
    let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
    let (library, data) = goal_library(arguments, &settings, &retargeter)?;
    let library = Arc::new(library);
    let pool = Arc::new(Pool::new(&robot, arguments.threads, Priority::Normal)?);
    let judge = Judge::new(
        &retargeter,
        &arguments.development,
        settings.evaluation_clips,
        Arc::clone(&pool),
        arguments.threads,
    )?;
    let mut source: Box<dyn RolloutSource> = if arguments.remote.is_empty() {
        let library = Arc::clone(&library);
        Box::new(LocalSource::new(&robot, &pool, &settings, library)?)
    } else {
        Box::new(RemoteSource::new(
            &arguments.remote,
            &robot,
            &settings,
            &library,
        )?)
    };
    let mut trainer = if arguments.resume {
        policy::Trainer::resume(
            robot,
            settings,
            library,
            arguments.threads,
            &checkpoint,
            source.as_mut(),
            arguments.change_settings,
        )?
    } else {
        policy::Trainer::new(robot, settings, library, arguments.threads)?
    };
    let interrupt = Interrupt::listen()?;
    let mut run = Run {
        source: source.as_mut(),
        judge: &judge,
        data,
        files,
    };
    let outcome = policy::train(&mut trainer, arguments.steps, &mut run, &interrupt)?;
    eprintln!("{}", trainer.times());
    match outcome {
        Outcome::Finished => {
            eprintln!("wrote {}", run.files.weights.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => Ok(interrupted(trainer.steps())),
    }
}

/// The preset's settings with the arguments' changes.
fn settings(arguments: &Arguments, robot: &Robot) -> Result<policy::Settings> {
    let mut settings = policy::Settings::preset(arguments.preset, robot);
    settings.seed = arguments.seed;
    for change in &arguments.changes {
        let (key, value) = change::pair(change)?;
        settings.set(key, value)?;
    }
    settings.check()?;
    Ok(settings)
}

fn goal_library(
    arguments: &Arguments,
    settings: &policy::Settings,
    retargeter: &Retargeter,
) -> Result<(GoalLibrary, serde_json::Value)> {
    let (library, data) = policy::data::library(
        retargeter,
        &arguments.motions,
        settings.procedural_clips,
        settings.seed,
        arguments.threads,
    )?;
    let frames: usize = library.clips().map(GoalClip::len).sum();
    eprintln!("{} clips of goals, {frames} frames", library.clips().len());
    Ok((library, data))
}

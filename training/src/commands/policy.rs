//! `emp-train policy`.

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::Duration};

use anyhow::{Result, ensure};
use clap::Args;
use emp_models::retarget::Retargeter;
use emp_sim::{
    Pool, Priority,
    goals::{GoalClip, GoalLibrary},
};
use emp_training::{
    policy::{
        self, Run,
        judge::Judge,
        remote::RemoteSource,
        settings::{PpoSettings, Symmetry},
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
    /// Where the weights go, f16 safetensors.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Environment steps to learn from; a resumed run may be given more.
    #[arg(long, default_value_t = 20_000_000)]
    steps: u64,
    /// Seed of weights, episodes and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Environments stepped side by side.
    #[arg(long, default_value_t = 256)]
    environments: usize,
    /// Control periods collected between two updates.
    #[arg(long, default_value_t = 32)]
    horizon: usize,
    /// Procedural clips in the mix.
    #[arg(long, default_value_t = 1000)]
    procedural_clips: usize,
    /// How left–right symmetry is used.
    #[arg(long, value_enum, default_value_t = Symmetry::None)]
    symmetry: Symmetry,
    /// Servers that simulate, for example `http://host:50051`; without any, this machine does. A resumed run needs as many.
    #[arg(long, num_args = 1.., value_name = "URL")]
    remote: Vec<String>,
    /// Continue the run from its checkpoint.
    #[arg(long)]
    resume: bool,
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
    ensure!(
        arguments.environments > 0 && arguments.horizon > 0 && arguments.steps > 0,
        "--environments, --horizon and --steps must be at least 1"
    );
    let robot = arguments.robot.load()?;
    let folder = arguments
        .run
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("runs/policy-{}", robot.name())));
    let files = RunFiles {
        folder,
        weights: arguments.out.clone(),
        save_every: Duration::from_secs(arguments.save_every),
    };
    let settings = policy::Settings {
        seed: arguments.seed,
        environments: arguments.environments,
        horizon: arguments.horizon,
        procedural_clips: arguments.procedural_clips,
        ppo: PpoSettings {
            symmetry: arguments.symmetry,
            ..PpoSettings::default()
        },
        ..policy::Settings::default()
    };
    let checkpoint = files.checkpoint();
    refuse_overwriting(&checkpoint, arguments.resume)?;
    let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
    let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
    let (library, data) = goal_library(arguments, &retargeter)?;
    let pool = Arc::new(Pool::new(&robot, arguments.threads, Priority::Normal)?);
    let judge = Judge::new(
        &retargeter,
        settings.evaluation_clips,
        Arc::clone(&pool),
        arguments.threads,
    )?;
    let mut source: Box<dyn RolloutSource> = if arguments.remote.is_empty() {
        let library = Arc::new(library);
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
            arguments.threads,
            &checkpoint,
            source.as_mut(),
        )?
    } else {
        policy::Trainer::new(robot, settings, arguments.threads)?
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
            eprintln!("wrote {}", arguments.out.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => Ok(interrupted(trainer.steps())),
    }
}

fn goal_library(
    arguments: &Arguments,
    retargeter: &Retargeter,
) -> Result<(GoalLibrary, serde_json::Value)> {
    let (library, data) = policy::data::library(
        retargeter,
        &arguments.motions,
        arguments.procedural_clips,
        arguments.seed,
        arguments.threads,
    )?;
    let frames: usize = library.clips().map(GoalClip::len).sum();
    eprintln!("{} clips of goals, {frames} frames", library.clips().len());
    Ok((library, data))
}

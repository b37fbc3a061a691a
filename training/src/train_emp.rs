//! `emp-train emp`.

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::Duration};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use emp_models::{policy::Policy, retarget::Retargeter};
use emp_sim::{Pool, Priority};
use emp_training::{
    emp::{
        data::{self, Motions},
        judge::Judge,
        settings::{Preset, Settings},
        trainer::{self, Equipment, Run, Trainer},
    },
    run::{Interrupt, Outcome, RunFiles},
};

use crate::{RobotArguments, policy_weights, retargeter_weights};

/// What is trained, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Settings to start from.
    #[arg(long, value_enum, default_value_t = Preset::Default)]
    preset: Preset,
    /// Change one setting, as in `risk.weight=50` or `losses.smooth_on=target`; --print-settings shows all.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    changes: Vec<String>,
    /// Print the settings as JSON and stop.
    #[arg(long)]
    print_settings: bool,
    /// Seed of weights, episodes and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Environment steps to learn from; a resumed run may be given more.
    #[arg(long, default_value_t = 6_000_000)]
    steps: u64,
    /// The frozen policy [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// Where the weights go, f16 safetensors; written at every evaluation [default: best.safetensors in the run's folder].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Continue the run from its checkpoint.
    #[arg(long)]
    resume: bool,
    /// Folder of the run's checkpoint and logs [default: runs/emp-ROBOT].
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 120)]
    save_every: u64,
    /// Threads for physics and learning; the weights do not depend on it.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// Trains an EMP.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let settings = settings(arguments)?;
    if arguments.print_settings {
        println!("{}", serde_json::to_string_pretty(&settings)?);
        return Ok(ExitCode::SUCCESS);
    }
    let robot = arguments.robot.load()?;
    let folder = arguments
        .run
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("runs/emp-{}", robot.name())));
    let mut files = RunFiles {
        folder,
        weights: PathBuf::new(),
        save_every: Duration::from_secs(arguments.save_every),
    };
    files.weights = arguments.out.clone().unwrap_or_else(|| files.best());
    let checkpoint = files.checkpoint();
    ensure!(
        arguments.resume || !checkpoint.exists(),
        "{} exists: continue with --resume, or remove it, or name another --run",
        checkpoint.display()
    );
    let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
    let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
    let weights = policy_weights(arguments.policy.as_ref(), &robot);
    let policy = Arc::new(Policy::load(&weights, Arc::clone(&robot))?);
    let pool = Arc::new(Pool::new(&robot, arguments.threads, Priority::Normal)?);
    let judge = Judge::new(
        &retargeter,
        Arc::clone(&policy),
        settings.evaluation_clips,
        Arc::clone(&pool),
        arguments.threads,
    )?;
    let motions = Motions {
        folders: &arguments.motions,
        procedural: settings.procedural_clips,
        seed: settings.seed,
        live: settings.live,
    };
    let (clips, data) = data::clips(&retargeter, &motions, arguments.threads)?;
    eprintln!("{} clips", clips.len());
    let threads = rayon::ThreadPoolBuilder::new().num_threads(arguments.threads);
    let equipment = Equipment {
        robot,
        policy,
        pool,
        clips: clips.into(),
        threads: threads.build().context("starting the learner's threads")?,
    };
    let mut trainer = if arguments.resume {
        Trainer::resume(equipment, settings, &checkpoint)?
    } else {
        Trainer::new(equipment, settings)?
    };
    let run = Run {
        files: &files,
        judge: &judge,
        data,
    };
    let interrupt = Interrupt::listen()?;
    match trainer::train(&mut trainer, arguments.steps, &run, &interrupt)? {
        Outcome::Finished => {
            eprintln!("wrote {}", files.weights.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => {
            let steps = trainer.steps();
            eprintln!("interrupted after {steps} environment steps; continue with --resume");
            Ok(ExitCode::from(3))
        }
    }
}

/// The preset's settings with the arguments' changes.
fn settings(arguments: &Arguments) -> Result<Settings> {
    let mut settings = Settings::preset(arguments.preset);
    settings.seed = arguments.seed;
    for change in &arguments.changes {
        let (key, value) = change
            .split_once('=')
            .with_context(|| format!("--set {change}: expected KEY=VALUE"))?;
        settings.set(key, value)?;
    }
    settings.check()?;
    Ok(settings)
}

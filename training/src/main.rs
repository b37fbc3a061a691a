//! `emp-train`: trains the models and reports on them.

use std::{path::PathBuf, process::ExitCode, sync::Arc};

use anyhow::{Context as _, Result, ensure};
use clap::{Args, Parser, Subcommand};
use emp_models::{checkpoint::write_atomically, linear, retarget::Retargeter};
use emp_robot::Robot;
use emp_training::{
    retargeter::{
        data::{self, Dataset},
        report,
        trainer::{self, Outcome, RunFiles, Settings, Trainer},
    },
    run::{self, Interrupt},
};

/// Trains the models of the motion-filtering service, and reports on them.
#[derive(Parser)]
#[command(
    name = "emp-train",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 3 interrupted with its state saved."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train the human-to-robot retargeting network (paper, section III).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions. The run's checkpoint and CSV log
    /// stand in runs/retargeter-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    Retargeter(RetargeterArguments),
    /// Compare a trained retargeter with converged inverse kinematics on the same objective.
    RetargetReport(ReportArguments),
}

#[derive(Args)]
struct RobotArguments {
    /// Robot: a folder of --robots.
    #[arg(long)]
    robot: String,
    /// Folder of robot descriptions.
    #[arg(long, default_value = "robots")]
    robots: PathBuf,
}

impl RobotArguments {
    fn load(&self) -> Result<Arc<Robot>> {
        let folder = self.robots.join(&self.robot);
        Ok(Arc::new(Robot::load(&folder).with_context(|| {
            format!("loading robot {}", self.robot)
        })?))
    }
}

#[derive(Args)]
struct RetargeterArguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Where the weights go, f16 safetensors.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Optimiser steps.
    #[arg(long, default_value_t = 12_000)]
    steps: u64,
    /// Frames a step.
    #[arg(long, default_value_t = 512)]
    batch: usize,
    /// Learning rate at its peak.
    #[arg(long, default_value_t = 2e-3)]
    learning_rate: f64,
    /// Seed of weights, batches and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Procedural clips in the mix.
    #[arg(long, default_value_t = 600)]
    procedural_clips: usize,
    /// Continue the run from its checkpoint.
    #[arg(long)]
    resume: bool,
    /// Folder of the run's checkpoint and log [default: runs/retargeter-ROBOT].
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 120)]
    save_every: u64,
    /// Threads for matrix products; the weights do not depend on it.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

#[derive(Args)]
struct ReportArguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion; without any, a library of procedural skills.
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

fn main() -> Result<ExitCode> {
    // SAFETY: no other thread runs yet, so none reads the environment meanwhile.
    unsafe { single_thread_element_wise_ops() };
    match Cli::parse().command {
        Command::Retargeter(arguments) => train_retargeter(&arguments),
        Command::RetargetReport(arguments) => report_retargeter(&arguments),
    }
}

/// Keeps candle's element-wise ops on the calling thread: its own pool waits by spinning, which costs more than half of the
/// time where anything else runs on the machine. Matrix products have their own threads (`--threads`).
///
/// # Safety
/// As [`std::env::set_var`]: no other thread may be running.
unsafe fn single_thread_element_wise_ops() {
    // SAFETY: the caller's promise.
    unsafe { std::env::set_var("CANDLE_NUM_THREADS", "1") };
}

fn train_retargeter(arguments: &RetargeterArguments) -> Result<ExitCode> {
    ensure!(
        arguments.batch > 0 && arguments.steps > 0,
        "--batch and --steps must be at least 1"
    );
    let robot = arguments.robot.load()?;
    let folder = arguments
        .run
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("runs/retargeter-{}", robot.name())));
    let save_every = std::time::Duration::from_secs(arguments.save_every);
    let files = RunFiles {
        folder,
        weights: arguments.out.clone(),
        save_every,
    };
    let settings = Settings {
        steps: arguments.steps,
        batch: arguments.batch,
        learning_rate: arguments.learning_rate,
        seed: arguments.seed,
        procedural_clips: arguments.procedural_clips,
    };
    let (clips, summary) = data::load_with_summary(&arguments.motions)?;
    let dataset = Dataset::new(&clips, settings.procedural_clips, settings.seed)?;
    let (recorded, procedural) = dataset.len();
    eprintln!(
        "{} clips: {recorded} recorded and {procedural} procedural frames, mirrored ones included",
        clips.len()
    );

    linear::set_threads(arguments.threads);
    let mut trainer = if arguments.resume {
        Trainer::resume(robot, settings, &files.checkpoint())?
    } else {
        let checkpoint = files.checkpoint();
        ensure!(
            !checkpoint.exists(),
            "{} exists: continue with --resume, or remove it, or name another --run",
            checkpoint.display()
        );
        Trainer::new(robot, settings)?
    };
    let interrupt = Interrupt::listen()?;
    match trainer::train(&mut trainer, &dataset, &summary, &files, &interrupt)? {
        Outcome::Finished => {
            eprintln!("wrote {}", files.weights.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => {
            eprintln!(
                "interrupted at step {}; continue with --resume",
                trainer.steps()
            );
            Ok(ExitCode::from(3))
        }
    }
}

fn report_retargeter(arguments: &ReportArguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let weights = arguments.weights.clone().unwrap_or_else(|| {
        PathBuf::from(format!(
            "models/weights/{}-retargeter.safetensors",
            robot.name()
        ))
    });
    let retargeter = Retargeter::load(&weights, robot)?;
    let clips = if arguments.motions.is_empty() {
        let library = emp_motion::skills::library(1, 60);
        library
            .iter()
            .map(|clip| clip.resampled(data::RATE))
            .collect()
    } else {
        data::load_clips(&arguments.motions)?
    };
    let bar = run::spinner();
    let report = report::report(&retargeter, &clips, |method| {
        bar.set_message(method.to_owned());
    })?;
    bar.finish_and_clear();
    let json = serde_json::to_string_pretty(&report)?;
    if let Some(out) = &arguments.out {
        write_atomically(out, json.as_bytes())
            .with_context(|| format!("writing {}", out.display()))?;
    }
    if arguments.json {
        println!("{json}");
    } else {
        print!("{report}");
    }
    Ok(ExitCode::SUCCESS)
}

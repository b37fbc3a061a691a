//! `emp-train`: trains the models and reports on them.

mod emp_report;
mod fall_report;
mod policy_report;
mod train_emp;
mod train_world_model;
mod trial;

use std::{path::PathBuf, process::ExitCode, sync::Arc, time::Duration};

use anyhow::{Context as _, Result, ensure};
use clap::{Args, Parser, Subcommand};
use emp_models::{checkpoint::write_atomically, linear, retarget::Retargeter};
use emp_robot::Robot;
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
    retargeter::{
        data::{self, Dataset},
        report,
        trainer::{self, Settings, Trainer},
    },
    run::{self, Interrupt, Outcome, RunFiles},
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
    /// Train the lower-body policy by proximal policy optimisation (paper, section IV).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions, retargeted by the robot's retargeter.
    /// The run's checkpoint and CSV log stand in runs/policy-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    Policy(PolicyArguments),
    /// Train an Executable Motion Prior on a robot's frozen policy (paper, section V).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions. The run's checkpoint and CSV logs stand in
    /// runs/emp-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    Emp(train_emp::Arguments),
    /// Train the rows of the paper's ablation table, one after the other, and write the table.
    ///
    /// Runs, checkpoints and the table stand in runs/ablation-ROBOT; Ctrl-C saves, --resume continues.
    EmpAblation(train_emp::AblationArguments),
    /// Train a world model of a robot and its policy (paper, section V).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions. The run's checkpoint, CSV log and model
    /// stand in runs/world-model-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    WorldModel(train_world_model::Arguments),
    /// Measure how well a world model predicts, one and ten control periods ahead.
    ///
    /// Motion as for policy-report, under the hard conditions of training.
    WorldModelReport(train_world_model::ReportArguments),
    /// Draw the learning curves of policies.
    PolicyCurves(CurvesArguments),
    /// Score a trained policy, bare and behind goal filters: held-out clips, larger amplitude, full randomisation.
    ///
    /// Recorded motion comes from --motions and should be of people that were not trained on; procedural skills come from a
    /// seed of their own.
    PolicyReport(policy_report::Arguments),
    /// Compare EMPs with the policy alone and with filters that need no learning, on nominal, easy and hard conditions.
    ///
    /// Motion as for policy-report. Prints tables in Markdown, all differences on the same episodes.
    EmpReport(emp_report::Arguments),
    /// Find out what fells a policy under hard conditions: joints, directions, poses, and how early it shows.
    ///
    /// Motion as for policy-report. Prints a page in Markdown.
    FallReport(fall_report::Arguments),
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
struct PolicyArguments {
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

#[derive(Args)]
struct CurvesArguments {
    /// Logs of runs: log.csv in a run's folder. Evaluations beside it are drawn too.
    #[arg(long, num_args = 1.., required = true, value_name = "CSV")]
    log: Vec<PathBuf>,
    /// Where the picture goes, SVG.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
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
        Command::Policy(arguments) => train_policy(&arguments),
        Command::PolicyCurves(arguments) => {
            policy::curves::draw(&arguments.log, &arguments.out)?;
            Ok(ExitCode::SUCCESS)
        }
        Command::Emp(arguments) => train_emp::run(&arguments),
        Command::EmpAblation(arguments) => train_emp::run_ablation(&arguments),
        Command::WorldModel(arguments) => train_world_model::run(&arguments),
        Command::WorldModelReport(arguments) => train_world_model::report(&arguments),
        Command::PolicyReport(arguments) => policy_report::run(&arguments),
        Command::EmpReport(arguments) => emp_report::run(&arguments),
        Command::FallReport(arguments) => fall_report::run(&arguments),
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
    let save_every = Duration::from_secs(arguments.save_every);
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

fn train_policy(arguments: &PolicyArguments) -> Result<ExitCode> {
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
    ensure!(
        arguments.resume || !checkpoint.exists(),
        "{} exists: continue with --resume, or remove it, or name another --run",
        checkpoint.display()
    );
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
        Outcome::Interrupted => {
            eprintln!(
                "interrupted at step {}; continue with --resume",
                trainer.steps()
            );
            Ok(ExitCode::from(3))
        }
    }
}

fn goal_library(
    arguments: &PolicyArguments,
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

/// The weights that were named, or the robot's shipped ones.
fn retargeter_weights(named: Option<&PathBuf>, robot: &Robot) -> PathBuf {
    let shipped = || {
        PathBuf::from(format!(
            "models/weights/{}-retargeter.safetensors",
            robot.name()
        ))
    };
    named.cloned().unwrap_or_else(shipped)
}

fn report_retargeter(arguments: &ReportArguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let weights = retargeter_weights(arguments.weights.as_ref(), &robot);
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

/// A robot's policy weights: as given, or the shipped ones.
fn policy_weights(given: Option<&PathBuf>, robot: &Robot) -> PathBuf {
    given.cloned().unwrap_or_else(|| {
        let name = robot.name();
        PathBuf::from(format!("models/weights/{name}-policy.safetensors"))
    })
}

//! `emp-train emp` and `emp-train emp-ablation`.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
    sync::Arc,
    time::Duration,
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use emp_models::{policy::Policy, retarget::Retargeter};
use emp_sim::{Pool, Priority};
use emp_training::{
    emp::{
        ablation,
        data::{self, Motions},
        judge::Judge,
        settings::{Preset, Settings},
        trainer::{self, Equipment, Run, Trainer},
    },
    run::{Interrupt, Outcome, RunFiles},
};

use crate::{RobotArguments, policy_weights, retargeter_weights};

/// What every training of an EMP takes.
#[derive(Args)]
pub(crate) struct TrainingArguments {
    #[command(flatten)]
    robot: RobotArguments,
    /// Folders (or files) of recorded motion: .bvh, AMASS .npz, key-node .npz.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Settings to start from.
    #[arg(long, value_enum, default_value_t = Preset::Default)]
    preset: Preset,
    /// Change one setting, as in `risk.weight=50` or `losses.smooth_on=target`; `emp-train emp --print-settings` shows all.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    changes: Vec<String>,
    /// Seed of weights, episodes and procedural skills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Environment steps to learn from; a resumed run may be given more.
    #[arg(long, default_value_t = 8_000_000)]
    steps: u64,
    /// The frozen policy [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// Continue from the checkpoint, or from those that there are.
    #[arg(long)]
    resume: bool,
    /// Let a resumed run go on with other settings than it had.
    #[arg(long, requires = "resume")]
    change_settings: bool,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 120)]
    save_every: u64,
    /// Threads for physics and learning; the weights do not depend on it.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// What is trained.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    training: TrainingArguments,
    /// Print the settings as JSON and stop.
    #[arg(long)]
    print_settings: bool,
    /// Where the weights go, f16 safetensors; written at every evaluation [default: best.safetensors in the run's folder].
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Folder of the run's checkpoint and logs [default: runs/emp-ROBOT].
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
}

/// Which parts are left out, and where it goes.
#[derive(Args)]
pub(crate) struct AblationArguments {
    #[command(flatten)]
    training: TrainingArguments,
    /// Folder of the four runs and of the table, ablation.md and ablation.json [default: runs/ablation-ROBOT].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Trains an EMP.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let settings = settings(&arguments.training)?;
    if arguments.print_settings {
        println!("{}", serde_json::to_string_pretty(&settings)?);
        return Ok(ExitCode::SUCCESS);
    }
    let robot = &arguments.training.robot.robot;
    let default = || PathBuf::from(format!("runs/emp-{robot}"));
    let mut files = files(
        &arguments.training,
        arguments.run.clone().unwrap_or_else(default),
    );
    if let Some(out) = &arguments.out {
        files.weights.clone_from(out);
    }
    refuse_overwriting(&arguments.training, &files)?;
    let workshop = Workshop::new(&arguments.training, &settings)?;
    let interrupt = Interrupt::listen()?;
    match workshop.train(&arguments.training, settings, &files, &interrupt)? {
        Outcome::Finished => {
            eprintln!("wrote {}", files.weights.display());
            Ok(ExitCode::SUCCESS)
        }
        Outcome::Interrupted => Ok(interrupted()),
    }
}

/// Trains the rows of the paper's ablation table one after the other, and writes the table.
pub(crate) fn run_ablation(arguments: &AblationArguments) -> Result<ExitCode> {
    let full = settings(&arguments.training)?;
    let workshop = Workshop::new(&arguments.training, &full)?;
    let robot = &arguments.training.robot.robot;
    let default = || PathBuf::from(format!("runs/ablation-{robot}"));
    let folder = arguments.out.clone().unwrap_or_else(default);
    let interrupt = Interrupt::listen()?;
    let mut weights = Vec::new();
    for row in ablation::Row::ALL {
        let files = files(&arguments.training, folder.join(row.name()));
        refuse_overwriting(&arguments.training, &files)?;
        eprintln!("{row}");
        match workshop.train(&arguments.training, row.settings(&full), &files, &interrupt)? {
            Outcome::Finished => weights.push((row, files.weights)),
            Outcome::Interrupted => return Ok(interrupted()),
        }
    }
    let table = ablation::table(&workshop.judge, &workshop.equipment.robot, &weights)?;
    table.write(&folder)?;
    print!("{table}");
    Ok(ExitCode::SUCCESS)
}

fn interrupted() -> ExitCode {
    eprintln!("interrupted; continue with --resume");
    ExitCode::from(3)
}

/// What several trainings of one robot share.
struct Workshop {
    equipment: Equipment,
    judge: Judge,
    data: serde_json::Value,
}

impl Workshop {
    fn new(arguments: &TrainingArguments, settings: &Settings) -> Result<Self> {
        let robot = arguments.robot.load()?;
        let weights = retargeter_weights(arguments.retargeter.as_ref(), &robot);
        let retargeter = Retargeter::load(&weights, Arc::clone(&robot))?;
        let weights = policy_weights(arguments.policy.as_ref(), &robot);
        let policy = Arc::new(Policy::load(&weights, Arc::clone(&robot))?);
        let pool = Arc::new(Pool::new(&robot, arguments.threads, Priority::Normal)?);
        let motions = Motions {
            folders: &arguments.motions,
            procedural: settings.procedural_clips,
            seed: settings.seed,
            live: settings.live,
            frames: settings.episodes.episode_frames,
        };
        let (clips, data) = data::clips(&retargeter, &motions, arguments.threads)?;
        eprintln!("{} clips", clips.len());
        let threads = rayon::ThreadPoolBuilder::new().num_threads(arguments.threads);
        let threads = threads.build().context("starting the learner's threads")?;
        Ok(Self {
            judge: Judge::new(
                &retargeter,
                Arc::clone(&policy),
                settings.evaluation_clips,
                Arc::clone(&pool),
                arguments.threads,
            )?,
            equipment: Equipment {
                robot,
                policy,
                pool,
                clips: clips.into(),
                threads: Arc::new(threads),
            },
            data,
        })
    }

    /// Trains to the arguments' steps; from the checkpoint, if there is one.
    fn train(
        &self,
        arguments: &TrainingArguments,
        settings: Settings,
        files: &RunFiles,
        interrupt: &Interrupt,
    ) -> Result<Outcome> {
        let equipment = self.equipment.clone();
        let checkpoint = files.checkpoint();
        let mut trainer = if checkpoint.exists() {
            Trainer::resume(equipment, settings, &checkpoint, arguments.change_settings)?
        } else {
            Trainer::new(equipment, settings)?
        };
        let run = Run {
            files,
            judge: &self.judge,
            data: self.data.clone(),
        };
        trainer::train(&mut trainer, arguments.steps, &run, interrupt)
    }
}

fn files(arguments: &TrainingArguments, folder: PathBuf) -> RunFiles {
    let mut files = RunFiles {
        folder,
        weights: PathBuf::new(),
        save_every: Duration::from_secs(arguments.save_every),
    };
    files.weights = files.best();
    files
}

/// A checkpoint may be there only to be resumed.
fn refuse_overwriting(arguments: &TrainingArguments, files: &RunFiles) -> Result<()> {
    let checkpoint: &Path = &files.checkpoint();
    ensure!(
        arguments.resume || !checkpoint.exists(),
        "{} exists: continue with --resume, or remove it, or name another folder",
        checkpoint.display()
    );
    Ok(())
}

/// The preset's settings with the arguments' changes.
fn settings(arguments: &TrainingArguments) -> Result<Settings> {
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

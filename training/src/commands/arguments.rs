//! What several commands take: a robot, weights, threads, and how a run ends.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
    sync::Arc,
    time::Duration,
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use emp_robot::Robot;
use emp_training::run::RunFiles;

/// Exit code of a command that was interrupted with its state saved.
const INTERRUPTED: u8 = 3;

#[derive(Args)]
pub(super) struct RobotArguments {
    /// Robot: a folder of --robots.
    #[arg(long)]
    pub(super) robot: String,
    /// Folder of robot descriptions.
    #[arg(long, default_value = "robots")]
    robots: PathBuf,
}

impl RobotArguments {
    pub(super) fn load(&self) -> Result<Arc<Robot>> {
        let folder = self.robots.join(&self.robot);
        Ok(Arc::new(Robot::load(&folder).with_context(|| {
            format!("loading robot {}", self.robot)
        })?))
    }
}

#[derive(Args)]
pub(super) struct RunArguments {
    /// Continue the run from its checkpoint.
    #[arg(long)]
    pub(super) resume: bool,
    /// Folder of the run's checkpoint and log [default: runs/COMMAND-ROBOT].
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Seconds between two checkpoints.
    #[arg(long, default_value_t = 120)]
    save_every: u64,
    /// Threads for physics and learning; the weights do not depend on it.
    #[arg(long, default_value_t = 2)]
    pub(super) threads: usize,
}

impl RunArguments {
    /// The folder of a run of `command` for `robot`.
    pub(super) fn folder(&self, command: &str, robot: &Robot) -> PathBuf {
        let default = || run_folder(command, robot);
        self.run.clone().unwrap_or_else(default)
    }

    /// The run's files in `folder`.
    pub(super) fn files(&self, folder: PathBuf, weights: PathBuf) -> RunFiles {
        RunFiles {
            folder,
            weights,
            save_every: Duration::from_secs(self.save_every),
        }
    }
}

/// Where a run of `command` for `robot` stands by default.
pub(super) fn run_folder(command: &str, robot: &Robot) -> PathBuf {
    PathBuf::from(format!("runs/{command}-{}", robot.name()))
}

/// The weights that were named, or the robot's shipped ones.
pub(super) fn retargeter_weights(named: Option<&PathBuf>, robot: &Robot) -> PathBuf {
    let shipped = || {
        PathBuf::from(format!(
            "models/weights/{}-retargeter.safetensors",
            robot.name()
        ))
    };
    named.cloned().unwrap_or_else(shipped)
}

/// A robot's policy weights: as given, or the shipped ones.
pub(super) fn policy_weights(given: Option<&PathBuf>, robot: &Robot) -> PathBuf {
    given.cloned().unwrap_or_else(|| {
        let name = robot.name();
        PathBuf::from(format!("models/weights/{name}-policy.safetensors"))
    })
}

/// Threads of forward and backward passes.
pub(super) fn learner_threads(count: usize) -> Result<rayon::ThreadPool> {
    let threads = rayon::ThreadPoolBuilder::new().num_threads(count);
    threads.build().context("starting the learner's threads")
}

/// A checkpoint may be there only to be resumed.
pub(super) fn refuse_overwriting(checkpoint: &Path, resume: bool) -> Result<()> {
    ensure!(
        resume || !checkpoint.exists(),
        "{} exists: continue with --resume, or remove it, or name another folder",
        checkpoint.display()
    );
    Ok(())
}

/// Says that a run was interrupted after so many steps.
pub(super) fn interrupted(steps: u64) -> ExitCode {
    eprintln!("interrupted at step {steps}; continue with --resume");
    ExitCode::from(INTERRUPTED)
}

//! What every trainer shares: interruption, progress, and the facts of a run.

use std::{
    path::{Path, PathBuf},
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use anyhow::{Context as _, Result};
use indicatif::{ProgressBar, ProgressStyle};

/// Set by Ctrl-C or SIGTERM: the trainer saves and stops at the next step.
#[derive(Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Listens for Ctrl-C and SIGTERM; the second one ends the process at once.
    ///
    /// # Errors
    /// When another handler is installed already.
    pub fn listen() -> Result<Self> {
        let interrupt = Self::default();
        let flag = interrupt.clone();
        ctrlc::set_handler(move || {
            if flag.0.swap(true, Ordering::Relaxed) {
                std::process::exit(130);
            }
        })
        .context("listening for Ctrl-C")?;
        Ok(interrupt)
    }

    /// Whether the run was asked to stop.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Where a run keeps its state, and what it leaves.
pub struct RunFiles {
    /// Folder of the checkpoint and the log.
    pub folder: PathBuf,
    /// The weights for serving.
    pub weights: PathBuf,
    /// Time between two checkpoints.
    pub save_every: Duration,
}

impl RunFiles {
    /// The run's checkpoint.
    pub fn checkpoint(&self) -> PathBuf {
        self.folder.join("checkpoint.safetensors")
    }

    /// The run's log.
    pub fn log(&self) -> PathBuf {
        self.folder.join("log.csv")
    }

    /// The log of evaluations during the run.
    pub fn evaluations(&self) -> PathBuf {
        self.folder.join("evaluations.csv")
    }

    /// The best weights so far, as they would be served.
    pub fn best(&self) -> PathBuf {
        self.folder.join("best.safetensors")
    }
}

/// How a run ended.
#[derive(Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All steps are done and the weights are written.
    Finished,
    /// Interrupted; the checkpoint is written.
    Interrupted,
}

/// A progress bar on stderr, hidden where stderr is no terminal.
pub fn progress(steps: u64, done: u64) -> ProgressBar {
    let style = ProgressStyle::with_template(
        "{elapsed_precise} {wide_bar} {pos}/{len} ({per_sec}, {eta}) {msg}",
    );
    let bar = ProgressBar::new(steps)
        .with_position(done)
        .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar.reset_eta();
    bar
}

/// A spinner on stderr for work of unknown length, hidden where stderr is no terminal.
pub fn spinner() -> ProgressBar {
    let bar = ProgressBar::new_spinner();
    bar.enable_steady_tick(Duration::from_millis(100));
    bar
}

/// The revision of the checkout that the program runs in, with `+` where files are changed; `unknown` outside one.
pub fn git_revision() -> String {
    let git = |arguments: &[&str]| {
        let output = Command::new("git")
            .args(arguments)
            .output()
            .ok()
            .filter(|output| output.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    match (
        git(&["rev-parse", "--short=12", "HEAD"]),
        git(&["status", "--porcelain", "--untracked-files=no"]),
    ) {
        (Some(revision), Some(changes)) if changes.is_empty() => revision,
        (Some(revision), _) => revision + "+",
        _ => "unknown".to_owned(),
    }
}

/// The last part of a path, for messages and metadata that must not name the machine's folders.
pub fn base_name(path: &Path) -> String {
    path.file_name()
        .unwrap_or(path.as_os_str())
        .to_string_lossy()
        .into_owned()
}

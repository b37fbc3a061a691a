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
use serde::{Deserialize, Serialize};

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

/// A part of a run: from a start or a resumption to the next.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Session {
    /// Steps that were done when it began.
    pub from_step: u64,
    /// The command.
    pub command: String,
    /// The revision that ran it, with `+` where files were changed.
    pub git_revision: String,
}

impl Session {
    /// The one that begins now.
    pub fn begin(from_step: u64) -> Self {
        Self {
            from_step,
            command: command_line(),
            git_revision: git_revision(),
        }
    }
}

/// The command that this program was started by. Paths outside the working folder are given by their last part: metadata must
/// not name the machine's folders.
pub fn command_line() -> String {
    let here = std::env::current_dir().unwrap_or_default();
    let arguments = std::env::args_os().enumerate();
    let arguments = arguments.map(|(index, argument)| match index {
        0 => base_name(Path::new(&argument)),
        _ => without_folders(&argument.to_string_lossy(), &here),
    });
    arguments.collect::<Vec<_>>().join(" ")
}

/// An argument as [`command_line`] has it, quoted where a shell needs it.
fn without_folders(argument: &str, here: &Path) -> String {
    let path = Path::new(argument);
    let argument = match path.strip_prefix(here) {
        Ok(inside) => inside.to_string_lossy().into_owned(),
        Err(_) if path.is_absolute() => base_name(path),
        Err(_) => argument.to_owned(),
    };
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_=./:,+".contains(c);
    if !argument.is_empty() && argument.chars().all(is_plain) {
        return argument;
    }
    format!("'{}'", argument.replace('\'', r"'\''"))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_names_no_folder_of_the_machine() {
        let shown = |argument: &str| without_folders(argument, Path::new("/home/someone/emp"));
        for (argument, expected) in [
            ("--motions", "--motions"),
            ("/data/of/someone/train", "train"),
            ("/home/someone/emp/runs/a", "runs/a"),
            ("runs/a", "runs/a"),
            ("hindsight.weight=50", "hindsight.weight=50"),
            ("two words", "'two words'"),
            ("amplitude-cut>low-pass", "'amplitude-cut>low-pass'"),
            ("it's", r"'it'\''s'"),
            ("", "''"),
        ] {
            assert_eq!(shown(argument), expected, "{argument}");
        }
        assert!(!command_line().contains('/') || !command_line().starts_with('/'));
    }
}

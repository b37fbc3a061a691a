//! What every report on controllers takes: a policy, motion, a seed.

use std::{path::PathBuf, sync::Arc};

use anyhow::Result;
use clap::Args;
use emp_models::{policy::Policy, retarget::Retargeter};
use emp_robot::Robot;
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

use super::arguments::{policy_weights, retargeter_weights};

/// Training draws its skills from other seeds.
const PROCEDURAL_SEED: u64 = 0x7265_706f_7274;

/// Whom to try, and on what.
#[derive(Args)]
pub(crate) struct TrialArguments {
    /// Folders (or files) of recorded motion; without any, procedural skills alone.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Procedural motions, cut into clips like the recorded ones.
    #[arg(long, default_value_t = 100)]
    procedural: usize,
    /// Seed of the procedural motions: the usual one is no training's.
    #[arg(long, default_value_t = PROCEDURAL_SEED)]
    procedural_seed: u64,
    /// Play at most so many of the clips, evenly spread over them.
    #[arg(long, default_value_t = 320)]
    clips: usize,
    /// Play a quarter of that number.
    #[arg(long)]
    quick: bool,
    /// The policy [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
    /// Seed of loads, pushes and randomisation.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Threads for physics; the figures do not depend on it.
    #[arg(long, default_value_t = 2)]
    pub(crate) threads: usize,
}

impl TrialArguments {
    pub(crate) fn pool(&self, robot: &Robot) -> Result<Pool> {
        Ok(Pool::new(robot, self.threads, Priority::Normal)?)
    }

    pub(crate) fn policy(&self, robot: &Arc<Robot>) -> Result<Arc<Policy>> {
        let weights = policy_weights(self.weights.as_ref(), robot);
        Ok(Arc::new(Policy::load(&weights, Arc::clone(robot))?))
    }

    /// The clips: none of them was trained on, if --motions are other people's than in training.
    pub(crate) fn clips(&self, robot: &Arc<Robot>) -> Result<Vec<GoalClip>> {
        let weights = retargeter_weights(self.retargeter.as_ref(), robot);
        let retargeter = Retargeter::load(&weights, Arc::clone(robot))?;
        let recorded = if self.motions.is_empty() {
            Vec::new()
        } else {
            data::load_clips(&self.motions)?
        };
        let skills = emp_motion::skills::library(self.procedural_seed, self.procedural);
        let mut windows = Vec::new();
        for (motion, source) in [(recorded, Source::Recorded), (skills, Source::Procedural)] {
            let clips = GoalClip::retargeted(&retargeter, &motion, source, self.threads)?;
            windows.extend(clips.iter().flat_map(|clip| clip.windows(report::FRAMES)));
        }
        let most = if self.quick {
            self.clips / 4
        } else {
            self.clips
        };
        Ok(spread(&windows, most))
    }
}

/// At most `most` of the clips, at even distances.
fn spread(clips: &[GoalClip], most: usize) -> Vec<GoalClip> {
    let count = most.min(clips.len());
    let chosen = (0..count).map(|i| clips[i * clips.len() / count].clone());
    chosen.collect()
}

/// A report as it is printed.
pub(crate) fn printed<T: serde::Serialize + std::fmt::Display>(
    value: &T,
    json: bool,
) -> Result<String> {
    Ok(if json {
        serde_json::to_string_pretty(value)? + "\n"
    } else {
        value.to_string()
    })
}

/// Counts episodes on stderr; Ctrl-C stops them.
pub(crate) struct EpisodeProgress {
    bar: indicatif::ProgressBar,
    interrupt: Interrupt,
}

impl EpisodeProgress {
    pub(crate) fn listen() -> Result<Self> {
        Ok(Self {
            bar: run::spinner(),
            interrupt: Interrupt::listen()?,
        })
    }

    pub(crate) fn finish(&self) {
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

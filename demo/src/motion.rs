//! The motion that is shown.

use std::path::Path;

use anyhow::{Context, Result};
use emp_motion::Clip;
use emp_motion::skills::{self, Skill};

/// The medley's seed.
const SEED: u64 = 1;

/// A clip at the robot's control rate, and what its parts are called.
pub(crate) struct Motion {
    /// Name for people.
    pub(crate) name: String,
    /// The poses.
    pub(crate) clip: Clip,
    /// Names of the parts, each with its beginning in seconds, in order; empty for a recording.
    parts: Vec<(f64, &'static str)>,
}

impl Motion {
    /// Reads a recording, or performs the medley where there is none, and resamples it to `rate` Hz.
    pub(crate) fn load(file: Option<&Path>, rate: f64) -> Result<Self> {
        match file {
            Some(file) => Self::recording(file, rate),
            None => Self::medley(rate),
        }
    }

    fn recording(file: &Path, rate: f64) -> Result<Self> {
        let clip = emp_motion::load(file)?;
        let name = file
            .file_stem()
            .context("a motion file has no name")?
            .to_string_lossy()
            .into_owned();
        Ok(Self::whole(name, clip.resampled(rate)?))
    }

    /// A clip at the robot's control rate whose parts have no names.
    pub(crate) fn whole(name: String, clip: Clip) -> Self {
        Self {
            name,
            clip,
            parts: Vec::new(),
        }
    }

    fn medley(rate: f64) -> Result<Self> {
        let (clip, starts) = skills::medley_with_starts(SEED);
        let seconds = starts.iter().map(|&frame| frame as f64 / clip.fps);
        let parts = seconds.zip(Skill::ALL.map(Skill::name)).collect();
        Ok(Self {
            name: clip.name.clone(),
            clip: clip.resampled(rate)?,
            parts,
        })
    }

    /// What is going on at a time in seconds; empty where that has no name.
    pub(crate) fn part(&self, time: f64) -> &'static str {
        let last = self.parts.iter().rev().find(|(start, _)| *start <= time);
        last.map_or("", |(_, name)| name)
    }

    /// When a frame is, in seconds.
    pub(crate) fn time(&self, frame: usize) -> f64 {
        frame as f64 / self.clip.fps
    }
}

//! The goals that a policy is trained on: recorded motion and procedural skills, retargeted as they would be served.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use emp_models::retarget::Retargeter;
use emp_motion::skills;
use emp_sim::goals::{GoalClip, GoalLibrary, Source};
use serde_json::json;

use crate::{retargeter::data, sets::check_training_seed};

/// Recorded motion from `folders` and `procedural` skills that follow from `seed`, with a summary for a checkpoint's
/// metadata. The library's streams mirror its clips and vary their tempo.
///
/// # Errors
/// When a folder holds no motion or another set's, a file is broken, the seed is another set's, or the network fails.
pub fn library(
    retargeter: &Retargeter,
    folders: &[PathBuf],
    procedural: usize,
    seed: u64,
    threads: usize,
) -> Result<(GoalLibrary, serde_json::Value)> {
    check_training_seed(seed)?;
    let (recorded, summary) = data::load_with_summary(folders)?;
    let skills: Vec<_> = skills::library(seed, procedural)
        .iter()
        .map(|clip| clip.resampled(data::RATE))
        .collect::<Result<_, _>>()?;
    let retargeted = |motion: &[emp_motion::Clip], source| {
        GoalClip::retargeted(retargeter, motion, source, threads).context("retargeting the motions")
    };
    let mut clips = retargeted(&recorded, Source::Recorded)?;
    clips.extend(retargeted(&skills, Source::Procedural)?);
    let summary = json!({
        "recorded": summary,
        "procedural_clips": procedural,
        "retargeter": retargeter.metadata().version(),
    });
    Ok((GoalLibrary::new(retargeter.robot(), clips)?, summary))
}

//! The goals that an EMP is trained on: recorded motion and procedural skills, some retargeted as a recording is, some as
//! a live stream without refinement would be, with the network's jitter.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use emp_models::retarget::Retargeter;
use emp_motion::{Clip, skills};
use emp_sim::goals::{GoalClip, Source};
use serde_json::json;

use crate::{retargeter::data, sets::check_training_seed};

/// What the clips are made from.
pub struct Motions<'a> {
    /// Folders or files of recorded motion.
    pub folders: &'a [PathBuf],
    /// Number of procedural motions.
    pub procedural: usize,
    /// Seed of the procedural motions.
    pub seed: u64,
    /// Share of motions that come from the network alone.
    pub live: f64,
    /// Frames of a clip.
    pub frames: usize,
}

/// Clips, with a summary for a checkpoint's metadata.
///
/// # Errors
/// When a folder holds no motion or another set's, a file is broken, the seed is another set's, or the network fails.
pub fn clips(
    retargeter: &Retargeter,
    motions: &Motions<'_>,
    threads: usize,
) -> Result<(Vec<GoalClip>, serde_json::Value)> {
    check_training_seed(motions.seed)?;
    let (recorded, summary) = data::load_with_summary(motions.folders)?;
    let skills = skills::library(motions.seed, motions.procedural);
    let mut clips = Vec::new();
    for (motion, source) in [(recorded, Source::Recorded), (skills, Source::Procedural)] {
        let (live, refined) = divided(motion, motions.live);
        let refined = GoalClip::retargeted(retargeter, &refined, source, threads);
        clips.extend(refined.context("retargeting the motions")?);
        for clip in &live {
            let clip = GoalClip::retargeted_live(retargeter, clip, source);
            clips.push(clip.context("retargeting the motions")?);
        }
    }
    let summary = json!({
        "recorded": summary,
        "procedural_clips": motions.procedural,
        "live": motions.live,
        "retargeter": retargeter.metadata().version(),
    });
    let windows = clips.iter().flat_map(|clip| clip.windows(motions.frames));
    Ok((windows.collect(), summary))
}

/// Takes this share of the motions, evenly spread, from the others.
fn divided(motions: Vec<Clip>, share: f64) -> (Vec<Clip>, Vec<Clip>) {
    let taken = |count: usize| (count as f64 * share).floor();
    let (taken, left): (Vec<_>, Vec<_>) = motions
        .into_iter()
        .enumerate()
        .partition(|(index, _)| taken(index + 1) > taken(*index));
    let clips = |motions: Vec<(usize, Clip)>| motions.into_iter().map(|(_, clip)| clip).collect();
    (clips(taken), clips(left))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_of_the_motions_is_spread_evenly() {
        let names = |clips: &[Clip]| {
            clips
                .iter()
                .map(|clip| clip.name.clone())
                .collect::<Vec<_>>()
        };
        let motions = skills::library(1, 8);
        let all = names(&motions);
        let (live, refined) = divided(motions, 0.25);
        assert_eq!(names(&live), [all[3].clone(), all[7].clone()]);
        assert_eq!(refined.len(), 6);
        let (live, refined) = divided(skills::library(1, 4), 0.0);
        assert_eq!((live.len(), refined.len()), (0, 4));
    }
}

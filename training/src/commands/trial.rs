//! What every report on controllers takes: a policy, and motion of one set.

use std::{collections::HashMap, path::PathBuf, sync::Arc};

use anyhow::Result;
use clap::Args;
use emp_models::{policy::Policy, retarget::Retargeter};
use emp_motion::{Clip, KeyNode};
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
    sets::{ClipGroup, MotionSet},
};

use super::arguments::{policy_weights, retargeter_weights};

/// Mean speed of the faster hand below which a recording is slow, m/s.
const SLOW: f64 = 0.2;

/// Whom to try, and on what.
#[derive(Args)]
pub(crate) struct TrialArguments {
    /// Folders (or files) of recorded motion of the set; without any, procedural motion alone.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Procedural motions of the set, cut into clips like the recorded ones.
    #[arg(long, default_value_t = 100)]
    procedural: usize,
    /// What the motion is for; it decides the seed of procedural motion, loads, pushes and randomisation too. `final` is for
    /// tables of results alone: choose nothing by it.
    #[arg(long, value_enum, default_value_t = MotionSet::Development)]
    pub(crate) set: MotionSet,
    /// The policy [default: models/weights/ROBOT-policy.safetensors].
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Weights of the retargeter [default: models/weights/ROBOT-retargeter.safetensors].
    #[arg(long, value_name = "FILE")]
    retargeter: Option<PathBuf>,
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

    /// The clips by the kind of their motion, kinds without any left out.
    pub(crate) fn groups(&self, robot: &Arc<Robot>) -> Result<Vec<ClipGroup>> {
        let weights = retargeter_weights(self.retargeter.as_ref(), robot);
        let retargeter = Retargeter::load(&weights, Arc::clone(robot))?;
        self.set.check(&self.motions)?;
        let recorded = if self.motions.is_empty() {
            Vec::new()
        } else {
            with_names_of_their_own(data::load_clips(&self.motions)?)
        };
        let (slow, lively) = recorded
            .into_iter()
            .partition(|clip| hand_speed(clip) < SLOW);
        let skills = emp_motion::skills::library(self.set.seed(), self.procedural);
        let mut groups = Vec::new();
        for (name, motion, source) in [
            (ClipGroup::SLOW, slow, Source::Recorded),
            (ClipGroup::LIVELY, lively, Source::Recorded),
            (ClipGroup::PROCEDURAL, skills, Source::Procedural),
        ] {
            let motion: Vec<Clip> = motion;
            let clips = GoalClip::retargeted(&retargeter, &motion, source, self.threads)?;
            let clips = clips.iter().flat_map(|clip| clip.windows(report::FRAMES));
            let clips: Vec<GoalClip> = clips.collect();
            if !clips.is_empty() {
                groups.push(ClipGroup { name, clips });
            }
        }
        Ok(groups)
    }

    /// The clips of all kinds.
    pub(crate) fn clips(&self, robot: &Arc<Robot>) -> Result<Vec<GoalClip>> {
        let groups = self.groups(robot)?.into_iter();
        Ok(groups.flat_map(|group| group.clips).collect())
    }
}

/// Numbers recordings of the same name in different folders, which are not the same motion.
fn with_names_of_their_own(mut clips: Vec<Clip>) -> Vec<Clip> {
    let mut seen: HashMap<String, usize> = HashMap::new();
    for clip in &mut clips {
        let count = seen.entry(clip.name.clone()).or_default();
        *count += 1;
        if *count > 1 {
            clip.name += &format!(" ({count})");
        }
    }
    clips
}

/// Mean speed of the faster hand relative to the waist, m/s.
fn hand_speed(clip: &Clip) -> f64 {
    let hands = clip.frames.iter().map(|frame| {
        let waist = frame.position(KeyNode::Waist);
        [KeyNode::LeftWrist, KeyNode::RightWrist].map(|wrist| frame.position(wrist) - waist)
    });
    let hands: Vec<_> = hands.collect();
    let faster = hands.windows(2).map(|pair| {
        let moved = [0, 1].map(|hand| (pair[1][hand] - pair[0][hand]).norm());
        moved[0].max(moved[1])
    });
    let way: f64 = faster.map(f64::from).sum();
    clip.fps * way / hands.len().saturating_sub(1).max(1) as f64
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

#[cfg(test)]
mod tests {
    use emp_motion::skills::{Skill, generate};

    use super::*;

    #[test]
    fn recordings_of_one_name_stay_two() {
        let clips = vec![generate(Skill::Wave, 1); 3];
        let names: Vec<String> = with_names_of_their_own(clips)
            .into_iter()
            .map(|clip| clip.name)
            .collect();
        assert_eq!(names, ["wave-1", "wave-1 (2)", "wave-1 (3)"]);
    }

    #[test]
    fn idling_is_slow_and_punching_is_lively() {
        assert!(hand_speed(&generate(Skill::Idle, 1)) < SLOW);
        assert!(hand_speed(&generate(Skill::Punch, 1)) > SLOW);
    }
}

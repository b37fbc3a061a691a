//! Evaluation: a controller on a set of clips, from standing to the clip's end or the fall.
//!
//! What is evaluated is what is served: each control period goes through
//! [`Controller::step`](emp_models::controller::Controller::step). Episodes are independent of each other, and all that is
//! random in one follows from the seed and its number. They are run in groups of fixed size, so that the same request gives
//! the same bits on any number of threads.

mod episode;
mod observer;
mod settings;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use emp_models::controller::Controller;
use rayon::prelude::*;
use serde::Serialize;

pub use episode::EpisodeResult;
pub use observer::{ExecutedFrame, Observer};
pub use settings::{EvaluationSettings, RandomizationLevel};

use crate::environment::{EnvironmentConfig, Kind};
use crate::goals::{GoalClip, GoalStatistics, Source};
use crate::metrics::{self, Interval, Metrics, Sample};
use crate::{Pool, SimError};
use episode::{Episode, EvaluationContext};

/// Episodes that share a batch of the controller. An episode that is over keeps its row until all are.
const GROUP: usize = 64;

/// Is told how an evaluation goes on, and may stop it.
pub trait Progress {
    /// An episode is over. Episodes of a group end in the order of their ends, groups come one after the other.
    fn finished(&mut self, episode: &EpisodeResult);

    /// Whether to stop; asked before every control period of a group.
    fn is_cancelled(&self) -> bool;
}

/// Nobody listens, nobody stops it.
impl Progress for () {
    fn finished(&mut self, _: &EpisodeResult) {}

    fn is_cancelled(&self) -> bool {
        false
    }
}

/// What an evaluation came to.
///
/// As JSON it is one object: robot, controller, seed, settings, complete, episodes, motions, each metric by its name as
/// `{mean, low, high}`, goals, recorded, procedural, failures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Name of the robot.
    pub robot: String,
    /// Name of the controller.
    pub controller: String,
    /// Seed of everything random.
    pub seed: u64,
    /// The conditions.
    pub settings: EvaluationSettings,
    /// Whether every episode was run; false if it was cancelled.
    pub complete: bool,
    /// All episodes.
    #[serde(flatten)]
    pub all: Scores,
    /// The episodes on recorded motion; none where there are none.
    pub recorded: Option<Scores>,
    /// The episodes on procedural motion; none where there are none.
    pub procedural: Option<Scores>,
    /// The episodes in which the robot failed.
    pub failures: Vec<Failure>,
    /// Every episode that was finished, by number.
    #[serde(skip)]
    pub results: Vec<EpisodeResult>,
}

/// Metrics of a set of episodes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// Number of episodes.
    pub episodes: usize,
    /// Number of recordings and procedural motions that they play: what the intervals rest on.
    pub motions: usize,
    /// The metrics with their 95 % intervals.
    #[serde(flatten)]
    pub metrics: Metrics<Interval>,
    /// How hard the clips are: a success rate on easy motion says little. None where no clip has two frames.
    pub goals: Option<GoalStatistics>,
}

/// An episode in which the robot failed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Failure {
    /// Its number.
    pub episode: usize,
    /// Name of its clip.
    pub clip: String,
    /// Where the clip's motion comes from.
    pub source: Source,
    /// Seconds from the episode's start.
    pub time: f64,
    /// Why, in words.
    pub reason: String,
}

impl Evaluation {
    /// The difference `self − other` of the metrics over the episodes that both finished, with intervals over motions; none
    /// where the two are not of the same robot, seed and clips, or have no episode in common.
    pub fn difference(&self, other: &Self) -> Option<Metrics<Interval>> {
        let [ours, theirs] = self.pairs(other)?;
        Some(metrics::paired_difference(&ours, &theirs, self.seed))
    }

    /// The share of `other`'s failures that `self` does without, over the same episodes; none where there are no pairs or no
    /// failures of `other`.
    pub fn failures_cut(&self, other: &Self) -> Option<Interval> {
        let [ours, theirs] = self.pairs(other)?;
        metrics::failures_cut(&ours, &theirs, self.seed)
    }

    /// Episodes that both finished, ours and theirs in the same order.
    fn pairs(&self, other: &Self) -> Option<[Vec<Sample>; 2]> {
        if (&self.robot, self.seed) != (&other.robot, other.seed) {
            return None;
        }
        let theirs: HashMap<usize, &EpisodeResult> = other
            .results
            .iter()
            .map(|result| (result.episode, result))
            .collect();
        let mut pairs: [Vec<Sample>; 2] = [Vec::new(), Vec::new()];
        for ours in &self.results {
            let Some(theirs) = theirs.get(&ours.episode) else {
                continue;
            };
            if theirs.clip != ours.clip {
                return None;
            }
            pairs[0].push(ours.sample());
            pairs[1].push(theirs.sample());
        }
        (!pairs[0].is_empty()).then_some(pairs)
    }
}

/// Runs `controller` on `clips` and measures how well the robot stands.
///
/// `pool` simulates the controller's robot; `progress` is told of each episode that ends. If it cancels, the episodes that
/// were finished by then are the result.
///
/// # Errors
/// If there is no clip, a clip is for another robot, a setting is out of bounds, or the controller fails.
pub fn evaluate(
    pool: &Pool,
    controller: &Controller,
    clips: &[GoalClip],
    settings: &EvaluationSettings,
    progress: &mut dyn Progress,
) -> Result<Evaluation, SimError> {
    evaluate_observed(pool, controller, clips, settings, progress, &mut ())
}

/// As [`evaluate`], with somebody who watches every control period. One who changes nothing leaves every bit as it is.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_observed(
    pool: &Pool,
    controller: &Controller,
    clips: &[GoalClip],
    settings: &EvaluationSettings,
    progress: &mut dyn Progress,
    observer: &mut dyn Observer,
) -> Result<Evaluation, SimError> {
    let robot = controller.policy().robot();
    settings.check(robot)?;
    check_clips(clips, robot.goal_joints().len())?;
    let clips: Vec<GoalClip> = clips
        .iter()
        .map(|clip| clip.at_speed(robot, settings.speed))
        .map(|clip| clip.scaled_amplitude(robot, settings.amplitude as f32))
        .collect();
    let randomization = settings.randomization(robot);
    let runner = Runner {
        pool,
        controller,
        clips: &clips,
        context: EvaluationContext {
            kind: Kind::new(Arc::clone(robot)),
            seed: settings.seed,
            pushes: settings.pushes(&randomization),
            randomization,
            limits: EnvironmentConfig::default(),
            default: robot.default_goal(),
        },
    };
    let episodes = settings.episodes.unwrap_or(clips.len());
    let mut results = Vec::with_capacity(episodes);
    for start in (0..episodes).step_by(GROUP) {
        let group = start..(start + GROUP).min(episodes);
        runner.run(group, progress, observer, &mut results)?;
    }
    results.sort_unstable_by_key(|result| result.episode);
    let scores = |source: Option<Source>| runner.scores(&results, source);
    Ok(Evaluation {
        robot: robot.name().to_owned(),
        controller: controller.name().to_owned(),
        seed: settings.seed,
        settings: *settings,
        complete: results.len() == episodes,
        all: scores(None),
        recorded: Some(scores(Some(Source::Recorded))).filter(|scores| scores.episodes > 0),
        procedural: Some(scores(Some(Source::Procedural))).filter(|scores| scores.episodes > 0),
        failures: runner.failures(&results),
        results,
    })
}

fn check_clips(clips: &[GoalClip], joints: usize) -> Result<(), SimError> {
    let setting = |expected: String, found: String| SimError::Setting {
        name: "clips".to_owned(),
        expected,
        found,
    };
    if clips.is_empty() {
        return Err(setting("at least one clip".to_owned(), "none".to_owned()));
    }
    match clips.iter().find(|clip| clip.joints() != joints) {
        Some(clip) => Err(setting(
            format!("goals of {joints} joints"),
            format!("{} in {:?}", clip.joints(), clip.name),
        )),
        None => Ok(()),
    }
}

/// Runs groups of episodes.
struct Runner<'a> {
    pool: &'a Pool,
    controller: &'a Controller,
    /// The clips as they are played.
    clips: &'a [GoalClip],
    context: EvaluationContext,
}

impl<'a> Runner<'a> {
    fn clip(&self, episode: usize) -> &'a GoalClip {
        &self.clips[episode % self.clips.len()]
    }

    /// Runs one group and adds the episodes that were finished.
    fn run(
        &self,
        group: Range<usize>,
        progress: &mut dyn Progress,
        observer: &mut dyn Observer,
        results: &mut Vec<EpisodeResult>,
    ) -> Result<(), SimError> {
        if progress.is_cancelled() {
            return Ok(());
        }
        let mut episodes = self.place(group)?;
        while !episodes.iter().all(Episode::is_over) && !progress.is_cancelled() {
            let mut batch: Vec<_> = episodes.iter_mut().map(Episode::input).collect();
            let mut outputs = self.controller.step(&mut batch)?;
            let was_over: Vec<bool> = episodes.iter().map(Episode::is_over).collect();
            for (episode, output) in episodes.iter().zip(&mut outputs) {
                observer.send(episode.asked(), &mut output.goal);
            }
            let pairs = episodes.par_iter_mut().zip(&outputs);
            self.pool.for_each(pairs, |stage, (episode, output)| {
                if !episode.is_over() {
                    episode.step(&self.context, stage, output);
                }
            });
            for ((episode, output), was_over) in episodes.iter().zip(&outputs).zip(was_over) {
                if was_over {
                    continue;
                }
                observer.executed(&episode.executed(output));
                if let Some(result) = episode.result() {
                    progress.finished(&result);
                    results.push(result);
                }
            }
        }
        Ok(())
    }

    /// Places the robots of a group, each where its controller would have it before the clip begins: at its answer to the
    /// clip's first goal. A served robot has followed its filter all along.
    fn place(&self, group: Range<usize>) -> Result<Vec<Episode<'a>>, SimError> {
        let first: Vec<&[f32]> = group.clone().map(|n| self.clip(n).frame(0)).collect();
        let starts = self.controller.settled_goals(&first)?;
        let mut slots: Vec<Option<Episode<'a>>> = group.clone().map(|_| None).collect();
        let places = slots.par_iter_mut().zip(&starts).enumerate();
        self.pool.for_each(places, |stage, (index, (slot, start))| {
            let number = group.start + index;
            let (clip, state) = (self.clip(number), self.controller.state());
            let context = &self.context;
            *slot = Some(Episode::new(context, number, clip, start, state, stage));
        });
        Ok(slots.into_iter().flatten().collect())
    }

    /// Scores of the episodes on motion of `source`, or of all.
    fn scores(&self, results: &[EpisodeResult], source: Option<Source>) -> Scores {
        let is_of = |result: &&EpisodeResult| source.is_none_or(|source| source == result.source);
        let chosen: Vec<&EpisodeResult> = results.iter().filter(is_of).collect();
        let samples: Vec<Sample> = chosen.iter().map(|result| result.sample()).collect();
        let clips = chosen.iter().map(|result| self.clip(result.episode));
        Scores {
            episodes: chosen.len(),
            motions: metrics::motions(&samples),
            metrics: metrics::summary(&samples, self.context.seed),
            goals: GoalStatistics::of(&self.context.kind.robot, clips),
        }
    }

    fn failures(&self, results: &[EpisodeResult]) -> Vec<Failure> {
        let rate = self.context.kind.robot.control_rate_hz();
        let failure = |result: &EpisodeResult| {
            Some(Failure {
                episode: result.episode,
                clip: result.clip.clone(),
                source: result.source,
                time: result.frames as f64 / rate,
                reason: result.failure?.to_string(),
            })
        };
        results.iter().filter_map(failure).collect()
    }
}

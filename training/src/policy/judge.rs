//! Deterministic evaluation of a policy in training: survival while exploring understates it.
//!
//! A policy is judged by what it is for, slow work and lively gestures of people whom it was not trained on, and by what
//! can happen to it: faster and wider motion, pushes, loads, robots that differ from the model. All in exact physics.

use std::{path::PathBuf, sync::Arc};

use anyhow::{Result, ensure};
use emp_models::{controller::Controller, policy::Policy, retarget::Retargeter};
use emp_motion::{Clip, KeyNodeFrame, Side, arm_motion::ArmMotion, skills};
use emp_robot::Robot;
use emp_sim::{
    Pool,
    evaluation::{EvaluationSettings, RandomizationLevel, evaluate},
    goals::{GoalClip, Source},
    pushes::Kick,
};
use serde::Serialize;

use crate::{
    retargeter::data,
    sets::{self, MotionSet},
};

/// Frames of a clip, as in the paper.
const FRAMES: usize = 200;

/// Seed of the procedural clips. Training clips are made from other seeds.
const SEED: u64 = sets::POLICY_JUDGE_SEED;

/// Speed of a hand, 95th percentile, at the measure of [`ArmMotion`], from which a clip is lively, m/s.
const LIVELY: f64 = 1.0;

/// Time between two pushes, seconds: a clip has two or three.
const PUSH_INTERVAL: f64 = 1.5;

/// Load in each hand as a multiple of the paper's largest in training: 3 kg for 60 kg of robot.
const LOAD: f64 = 1.2;

/// What a trial changes.
#[derive(Clone, Copy, Debug)]
enum Change {
    Nothing,
    Speed(f64),
    Amplitude(f64),
    Push(f64),
    Load,
    Randomized,
}

impl Change {
    fn settings(self, robot: &Robot) -> EvaluationSettings {
        let nominal = EvaluationSettings::default();
        match self {
            Self::Nothing => nominal,
            Self::Speed(speed) => EvaluationSettings { speed, ..nominal },
            Self::Amplitude(amplitude) => EvaluationSettings {
                amplitude,
                ..nominal
            },
            Self::Push(speed) => EvaluationSettings {
                push: Some(Kick {
                    speed,
                    interval: PUSH_INTERVAL,
                }),
                ..nominal
            },
            Self::Load => EvaluationSettings {
                hand_load: Some([LOAD * robot.added_masses().hand[1]; 2]),
                ..nominal
            },
            Self::Randomized => EvaluationSettings {
                conditions: RandomizationLevel::Full,
                ..nominal
            },
        }
    }
}

/// A trial: its name, whether on lively clips, the largest number of them, what it changes.
const TRIALS: [(&str, bool, usize, Change); 9] = [
    ("slow", false, 32, Change::Nothing),
    ("lively", true, 64, Change::Nothing),
    ("lively_speed_1.5", true, 64, Change::Speed(1.5)),
    ("lively_amplitude_1.5", true, 64, Change::Amplitude(1.5)),
    ("push_0.4", false, 32, Change::Push(0.4)),
    ("push_0.6", false, 32, Change::Push(0.6)),
    ("push_0.8", false, 32, Change::Push(0.8)),
    ("load", true, 32, Change::Load),
    ("randomized", true, 64, Change::Randomized),
];

/// Most clips of a source and kind.
const MOST: usize = 64;

/// Judges policies on clips that they were not trained on.
pub struct Judge {
    robot: Arc<Robot>,
    /// Slow and lively clips.
    slow: Vec<GoalClip>,
    lively: Vec<GoalClip>,
    pool: Arc<Pool>,
}

/// What a policy reaches under one trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Figures {
    /// The trial's name.
    pub trial: &'static str,
    /// Number of clips.
    pub clips: usize,
    /// Share of clips in which the robot stood to the end.
    pub suc: f64,
    /// The paper's base orientation metric.
    pub mbo: f64,
    /// The paper's base velocity metric.
    pub mbv: f64,
}

/// What a policy reaches.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Verdict {
    /// Each trial.
    pub trials: Vec<Figures>,
    /// Mean over the trials of success × base orientation: by this, policies are chosen.
    pub score: f64,
}

impl Verdict {
    /// Columns of a log.
    pub fn columns() -> Vec<String> {
        let mut columns = vec!["step".to_owned()];
        for (trial, ..) in TRIALS {
            columns.extend(["suc", "mbo", "mbv"].map(|metric| format!("{metric}_{trial}")));
        }
        columns.push("score".to_owned());
        columns
    }

    /// The numbers of a log's row.
    pub fn row(&self) -> Vec<f64> {
        let trials = self.trials.iter();
        let numbers = trials.flat_map(|figures| [figures.suc, figures.mbo, figures.mbv]);
        numbers.chain([self.score]).collect()
    }
}

impl Judge {
    /// A judge on `pool` with the recordings in `folders` and one clip of each of `procedural` procedural motions.
    ///
    /// # Errors
    /// When a folder holds no motion, a file is broken, the network fails, or no clip is left.
    pub fn new(
        retargeter: &Retargeter,
        folders: &[PathBuf],
        procedural: usize,
        pool: Arc<Pool>,
        threads: usize,
    ) -> Result<Self> {
        let robot = Arc::clone(retargeter.robot());
        MotionSet::Development.check(folders)?;
        let recorded = data::load_clips(folders)?;
        let skills: Vec<Clip> = skills::library(SEED, procedural)
            .iter()
            .map(|clip| clip.resampled(data::RATE))
            .collect::<Result<_, _>>()?;
        let windows = recorded.iter().flat_map(windows_of);
        let first = skills
            .iter()
            .flat_map(|clip| windows_of(clip).into_iter().take(1));
        let (mut slow, mut lively) = (Vec::new(), Vec::new());
        for (clips, source) in [
            (windows.collect::<Vec<_>>(), Source::Recorded),
            (first.collect(), Source::Procedural),
        ] {
            let (fast, calm): (Vec<Clip>, Vec<Clip>) = clips.into_iter().partition(is_lively);
            for (clips, goals) in [(calm, &mut slow), (fast, &mut lively)] {
                // No trial plays more: the rest need not be retargeted.
                let chosen = spread(&clips, MOST);
                goals.extend(GoalClip::retargeted(retargeter, &chosen, source, threads)?);
            }
        }
        ensure!(
            !slow.is_empty() || !lively.is_empty(),
            "expected motion to judge a policy by, found none"
        );
        Ok(Self {
            robot,
            slow,
            lively,
            pool,
        })
    }

    /// At most `most` slow or lively clips, spread evenly over them; the other kind where there are none.
    fn clips(&self, lively: bool, most: usize) -> Vec<GoalClip> {
        let (wanted, other) = if lively {
            (&self.lively, &self.slow)
        } else {
            (&self.slow, &self.lively)
        };
        spread(if wanted.is_empty() { other } else { wanted }, most)
    }

    /// Judges a policy. The same policy always gets the same verdict.
    ///
    /// # Errors
    /// When the policy fails.
    pub fn judge(&self, policy: Policy) -> Result<Verdict> {
        let controller = Controller::new(Arc::new(policy), None);
        let trials = TRIALS.into_iter().map(|(trial, lively, most, change)| {
            let clips = self.clips(lively, most);
            let settings = change.settings(&self.robot);
            let evaluation = evaluate(&self.pool, &controller, &clips, &settings, &mut ())?;
            let metrics = evaluation.all.metrics;
            Ok(Figures {
                trial,
                clips: clips.len(),
                suc: metrics.suc.mean,
                mbo: metrics.mbo.mean,
                mbv: metrics.mbv.mean,
            })
        });
        let trials = trials.collect::<Result<Vec<_>>>()?;
        let score = trials.iter().map(|figures| figures.suc * figures.mbo);
        Ok(Verdict {
            score: score.sum::<f64>() / TRIALS.len() as f64,
            trials,
        })
    }
}

/// Whether a hand is fast in it.
fn is_lively(clip: &Clip) -> bool {
    let arms = Side::BOTH.map(|side| ArmMotion::of(clip, side));
    arms.iter().flatten().any(|arm| arm.hand_speed[0] >= LIVELY)
}

/// Consecutive pieces of [`FRAMES`] frames; what remains at the end is dropped, but a clip that is shorter stays whole.
fn windows_of(clip: &Clip) -> Vec<Clip> {
    if clip.frames.len() < FRAMES {
        return vec![clip.clone()];
    }
    let pieces = clip.frames.chunks_exact(FRAMES).enumerate();
    let piece = |(index, frames): (usize, &[KeyNodeFrame])| Clip {
        name: format!("{}@{}", clip.name, index * FRAMES),
        fps: clip.fps,
        frames: frames.to_vec(),
    };
    pieces.map(piece).collect()
}

/// At most `most` of the clips, at even distances.
fn spread<T: Clone>(clips: &[T], most: usize) -> Vec<T> {
    let count = most.min(clips.len());
    let chosen = (0..count).map(|i| clips[i * clips.len() / count].clone());
    chosen.collect()
}

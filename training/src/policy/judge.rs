//! Deterministic evaluation of a policy in training: survival while exploring understates it.

use std::sync::Arc;

use anyhow::Result;
use emp_models::{controller::Controller, policy::Policy, retarget::Retargeter};
use emp_motion::skills;
use emp_sim::{
    Pool,
    evaluation::{EvaluationSettings, RandomizationLevel, evaluate},
    goals::{GoalClip, Source},
};
use serde::Serialize;

use crate::sets;

/// Frames of a clip, as in the paper.
const FRAMES: usize = 200;

/// Seed of the clips.
const SEED: u64 = sets::POLICY_JUDGE_SEED;

/// Under what a policy is judged: name, factor on the goals' amplitude, conditions.
const TRIALS: [(&str, f64, RandomizationLevel); 3] = [
    ("nominal", 1.0, RandomizationLevel::Nominal),
    ("amplitude", 1.2, RandomizationLevel::Nominal),
    ("randomized", 1.0, RandomizationLevel::Full),
];

/// Judges policies on procedural clips that they were not trained on.
pub struct Judge {
    clips: Vec<GoalClip>,
    pool: Arc<Pool>,
}

/// What a policy reaches under one trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Figures {
    /// The trial's name.
    pub trial: &'static str,
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
    /// A judge with one clip of each of `clips` procedural motions, on `pool`.
    ///
    /// # Errors
    /// When the network fails.
    pub fn new(
        retargeter: &Retargeter,
        clips: usize,
        pool: Arc<Pool>,
        threads: usize,
    ) -> Result<Self> {
        let motion = skills::library(SEED, clips);
        let goals = GoalClip::retargeted(retargeter, &motion, Source::Procedural, threads)?;
        let first_window = |clip: &GoalClip| clip.windows(FRAMES).into_iter().next();
        Ok(Self {
            clips: goals.iter().filter_map(first_window).collect(),
            pool,
        })
    }

    /// Judges a policy. The same policy always gets the same verdict.
    ///
    /// # Errors
    /// When the policy fails.
    pub fn judge(&self, policy: Policy) -> Result<Verdict> {
        let controller = Controller::new(Arc::new(policy), None);
        let trials = TRIALS.into_iter().map(|(trial, amplitude, conditions)| {
            let settings = EvaluationSettings {
                amplitude,
                conditions,
                ..EvaluationSettings::default()
            };
            let evaluation = evaluate(&self.pool, &controller, &self.clips, &settings, &mut ())?;
            let metrics = evaluation.all.metrics;
            Ok(Figures {
                trial,
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

//! Deterministic evaluation of an EMP in training, beside the policy without one on the same seeds.

use std::sync::Arc;

use anyhow::Result;
use emp_models::{
    controller::Controller, emp::Emp, filters::EmpFilter, policy::Policy, retarget::Retargeter,
};
use emp_motion::skills;
use emp_sim::{
    Pool,
    evaluation::{Evaluation, evaluate},
    goals::{GoalClip, Source},
    suite::Condition,
};
use serde::Serialize;

use crate::sets;

/// Frames of a clip, as in the paper.
const FRAMES: usize = 200;

/// Seed of the clips.
const SEED: u64 = sets::EMP_JUDGE_SEED;

/// Under what an EMP is judged.
const TRIALS: [Condition; 5] = [
    Condition::Nominal,
    Condition::Wide,
    Condition::WideHeavy,
    Condition::Pushed,
    Condition::WidePushed,
];

/// Judges EMPs on procedural clips that they were not trained on.
pub struct Judge {
    clips: Vec<GoalClip>,
    pool: Arc<Pool>,
    policy: Arc<Policy>,
    /// Without an EMP, trial by trial.
    decoupled: Vec<Evaluation>,
}

/// What an EMP reaches under one trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Figures {
    /// The trial.
    pub trial: Condition,
    /// Share of clips in which the robot fell.
    pub falls: f64,
    /// The same without the EMP.
    pub falls_decoupled: f64,
    /// Mean absolute change of a goal angle, rad.
    pub change: f64,
    /// Self-collision force as a share of that without the EMP.
    pub msc_ratio: f64,
    /// The paper's joint position metric.
    pub mjp: f64,
    /// Its difference to that without the EMP.
    pub mjp_difference: f64,
}

impl Figures {
    const NAMES: [&'static str; 6] = [
        "falls",
        "falls_decoupled",
        "change",
        "msc_ratio",
        "mjp",
        "mjp_difference",
    ];

    fn numbers(&self) -> [f64; 6] {
        [
            self.falls,
            self.falls_decoupled,
            self.change,
            self.msc_ratio,
            self.mjp,
            self.mjp_difference,
        ]
    }
}

/// What an EMP reaches.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Verdict {
    /// Each trial.
    pub trials: Vec<Figures>,
    /// Mean over the trials of the share that stood × joint tracking: by this, weights are chosen.
    pub score: f64,
}

impl Verdict {
    fn new(trials: Vec<Figures>) -> Self {
        let scores = trials
            .iter()
            .map(|figures| (1.0 - figures.falls) * figures.mjp);
        Self {
            score: scores.sum::<f64>() / trials.len() as f64,
            trials,
        }
    }

    /// Columns of a log.
    pub fn columns() -> Vec<String> {
        let mut columns = vec!["step".to_owned()];
        for trial in TRIALS {
            let names = Figures::NAMES.map(|name| format!("{name}_{}", trial.name()));
            columns.extend(names);
        }
        columns.push("score".to_owned());
        columns
    }

    /// The numbers of a log's row.
    pub fn row(&self) -> Vec<f64> {
        let numbers = self.trials.iter().flat_map(Figures::numbers);
        numbers.chain([self.score]).collect()
    }
}

impl Judge {
    /// A judge with one clip of each of `clips` procedural motions, on `pool`.
    ///
    /// # Errors
    /// When the retargeter or the policy fails.
    pub fn new(
        retargeter: &Retargeter,
        policy: Arc<Policy>,
        clips: usize,
        pool: Arc<Pool>,
        threads: usize,
    ) -> Result<Self> {
        let motion = skills::library(SEED, clips);
        let goals = GoalClip::retargeted(retargeter, &motion, Source::Procedural, threads)?;
        let first_window = |clip: &GoalClip| clip.windows(FRAMES).into_iter().next();
        let mut judge = Self {
            clips: goals.iter().filter_map(first_window).collect(),
            pool,
            decoupled: Vec::new(),
            policy,
        };
        judge.decoupled = judge.evaluations(None)?;
        Ok(judge)
    }

    /// The evaluations of the policy behind an EMP, or of the policy alone: one for each condition. The same EMP always gets
    /// the same.
    ///
    /// # Errors
    /// When the EMP fails.
    pub fn evaluations(&self, emp: Option<Emp>) -> Result<Vec<Evaluation>> {
        let filter = emp.map(|emp| Arc::new(EmpFilter::always(Arc::new(emp))) as _);
        let controller = Controller::new(Arc::clone(&self.policy), filter);
        let evaluations = TRIALS.into_iter().map(|trial| {
            let settings = trial.settings(self.policy.robot(), SEED);
            Ok(evaluate(
                &self.pool,
                &controller,
                &self.clips,
                &settings,
                &mut (),
            )?)
        });
        evaluations.collect()
    }

    /// The conditions of [`evaluations`](Self::evaluations), in their order.
    pub fn trials(&self) -> [Condition; TRIALS.len()] {
        TRIALS
    }

    /// Judges an EMP.
    ///
    /// # Errors
    /// When the EMP fails.
    pub fn judge(&self, emp: Emp) -> Result<Verdict> {
        let evaluations = self.evaluations(Some(emp))?;
        let trials = TRIALS.into_iter().zip(evaluations).zip(&self.decoupled);
        let figures = trials.map(|((trial, with), without)| {
            let (with, without) = (&with.all.metrics, &without.all.metrics);
            Figures {
                trial,
                falls: 1.0 - with.suc.mean,
                falls_decoupled: 1.0 - without.suc.mean,
                change: with.change.mean,
                msc_ratio: with.msc.mean / without.msc.mean.max(1e-9),
                mjp: with.mjp.mean,
                mjp_difference: with.mjp.mean - without.mjp.mean,
            }
        });
        Ok(Verdict::new(figures.collect()))
    }
}

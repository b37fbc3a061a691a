//! The episodes that are compared, controller by controller.

use std::sync::Arc;

use anyhow::{Context as _, Result, ensure};
use emp_models::{
    controller::Controller,
    emp::Emp,
    filters::{DECOUPLED, EmpFilter},
    policy::Policy,
};
use emp_sim::{
    Pool,
    evaluation::{EpisodeResult, Evaluation, Observer, Progress, evaluate_observed},
    metrics::Sample,
    suite::Condition,
};

use super::{
    family::Family,
    rows::{GroupOutcome, HARD, Outcome, Row},
};
use crate::sets::{ClipGroup, MotionSet};

/// Conditions beside the hard ones.
const OTHERS: [Condition; 2] = [Condition::Nominal, Condition::Easy];

/// An EMP with the name that tables call it by.
pub struct Candidate {
    /// What tables call it.
    pub name: String,
    /// The EMP.
    pub emp: Arc<Emp>,
}

/// What is compared, and on what.
pub struct EmpRun<'a> {
    /// Simulates.
    pub pool: &'a Pool,
    /// The policy behind every filter.
    pub policy: &'a Arc<Policy>,
    /// Motion, kind by kind.
    pub groups: &'a [ClipGroup],
    /// What the motion is for.
    pub set: MotionSet,
    /// EMPs.
    pub candidates: &'a [Candidate],
    /// What they have to beat.
    pub families: &'a [Family],
    /// Index of the candidate whose danger gates are compared; none: no gates.
    pub gates: Option<usize>,
}

/// The episodes of one controller.
pub(super) struct Played {
    pub(super) name: String,
    pub(super) family: String,
    pub(super) learned: bool,
    /// Those of each condition and kind of motion.
    pub(super) parts: Vec<Part>,
}

/// The episodes of one condition and kind of motion.
pub(super) struct Part {
    pub(super) condition: Condition,
    pub(super) group: &'static str,
    pub(super) samples: Vec<Sample>,
}

/// A controller with its place in the tables.
pub(super) struct Contender {
    pub(super) name: String,
    pub(super) family: String,
    pub(super) learned: bool,
    pub(super) controller: Controller,
}

impl Contender {
    pub(super) fn raw(run: &EmpRun<'_>) -> Self {
        Self {
            name: DECOUPLED.to_owned(),
            family: DECOUPLED.to_owned(),
            learned: false,
            controller: Controller::new(Arc::clone(run.policy), None),
        }
    }
}

pub(super) fn contenders(run: &EmpRun<'_>) -> Result<Vec<Contender>> {
    let emp = |candidate: &Candidate| {
        let filter = Arc::new(EmpFilter::always(Arc::clone(&candidate.emp)));
        Contender {
            name: candidate.name.clone(),
            family: candidate.name.clone(),
            learned: true,
            controller: Controller::new(Arc::clone(run.policy), Some(filter)),
        }
    };
    let mut contenders: Vec<Contender> = run.candidates.iter().map(emp).collect();
    for family in run.families {
        for member in &family.members {
            contenders.push(Contender {
                name: member.clone(),
                family: family.name.clone(),
                learned: false,
                controller: Controller::by_name(member, run.policy, None)?,
            });
        }
    }
    Ok(contenders)
}

pub(super) fn evaluation(
    run: &EmpRun<'_>,
    controller: &Controller,
    condition: Condition,
    group: &ClipGroup,
    observer: &mut dyn Observer,
    progress: &mut dyn Progress,
) -> Result<Evaluation> {
    let settings = condition.settings(run.policy.robot(), run.set.seed());
    let clips = &group.clips;
    let evaluation = evaluate_observed(run.pool, controller, clips, &settings, progress, observer)?;
    ensure!(
        evaluation.complete,
        "interrupted under {}",
        condition.name()
    );
    Ok(evaluation)
}

impl Part {
    pub(super) fn new(condition: Condition, group: &ClipGroup, evaluation: &Evaluation) -> Self {
        let samples = evaluation.results.iter().map(EpisodeResult::sample);
        Self {
            condition,
            group: group.name,
            samples: samples.collect(),
        }
    }
}

pub(super) fn play(
    run: &EmpRun<'_>,
    contender: &Contender,
    progress: &mut dyn Progress,
) -> Result<Played> {
    let mut parts = Vec::new();
    for condition in OTHERS.into_iter().chain(Condition::HARD) {
        for group in run.groups {
            let controller = &contender.controller;
            let evaluation = evaluation(run, controller, condition, group, &mut (), progress)
                .with_context(|| format!("evaluating {}", contender.name))?;
            parts.push(Part::new(condition, group, &evaluation));
        }
    }
    Ok(Played {
        name: contender.name.clone(),
        family: contender.family.clone(),
        learned: contender.learned,
        parts,
    })
}

impl Played {
    /// The episodes of the parts that are chosen.
    pub(super) fn samples(&self, is_chosen: impl Fn(&Part) -> bool) -> Vec<Sample> {
        let parts = self.parts.iter().filter(|part| is_chosen(part));
        parts.flat_map(|part| part.samples.clone()).collect()
    }

    /// The episodes of all hard conditions.
    pub(super) fn hard(&self) -> Vec<Sample> {
        self.samples(Part::is_hard)
    }

    pub(super) fn row(&self, raw: &Self, run: &EmpRun<'_>) -> Row {
        let outcome = |name: &'static str, is_chosen: &dyn Fn(&Part) -> bool| {
            let [ours, raw] = [self, raw].map(|played| played.samples(is_chosen));
            Outcome::new(name, &ours, &raw, run.set.seed())
        };
        let conditions = OTHERS.into_iter().chain(Condition::HARD);
        Row {
            name: self.name.clone(),
            family: self.family.clone(),
            learned: self.learned,
            hard: outcome(HARD, &Part::is_hard),
            groups: run
                .groups
                .iter()
                .map(|group| GroupOutcome {
                    name: group.name,
                    outcome: outcome(HARD, &|part| part.is_hard() && part.group == group.name),
                })
                .collect(),
            conditions: conditions
                .map(|condition| outcome(condition.name(), &|part| part.condition == condition))
                .collect(),
        }
    }
}

impl Part {
    fn is_hard(&self) -> bool {
        Condition::HARD.contains(&self.condition)
    }
}

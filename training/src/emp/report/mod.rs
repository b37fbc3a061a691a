//! What an EMP is worth: against the policy alone and against filters that need no learning, on the same episodes.

mod frontier;
mod gates;
mod matched;
#[cfg(test)]
mod tests;
mod text;

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
    metrics::{
        Interval, Metrics, Sample, failures, failures_cut, motions, paired_difference, summary,
    },
    suite::Condition,
};
use serde::Serialize;

use super::settings::{EmpSettings, HindsightSettings, Preset, Remedy};
use crate::sets::{Basis, ClipGroup, MotionSet};

pub use frontier::draw;
pub use gates::GateRow;
pub use matched::{Match, Price};

/// What the hard conditions together are called.
const HARD: &str = "hard suite";

/// Conditions beside the hard ones.
const OTHERS: [Condition; 2] = [Condition::Nominal, Condition::Easy];

/// Filters that need no learning: the name of a family, and its members from mild to strong.
pub struct Family {
    /// Its name.
    pub name: String,
    /// Specifications of [`emp_models::filters`].
    pub members: Vec<String>,
}

impl Family {
    /// Those that every EMP has to beat. `knee` are the parameters of a soft knee but for its slope.
    pub fn usual(knee: &str) -> Vec<Self> {
        let family = |name: &str, members: &[String]| Self {
            name: name.to_owned(),
            members: members.to_vec(),
        };
        let each = |values: &[&str], specification: &str| -> Vec<String> {
            values
                .iter()
                .map(|value| format!("{specification}={value}"))
                .collect()
        };
        vec![
            family(
                "uniform cut",
                &each(
                    &["0.95", "0.9", "0.85", "0.8", "0.7"],
                    "amplitude-cut:factor",
                ),
            ),
            family(
                "low-pass",
                &each(&["3", "2", "1.4", "1", "0.7"], "low-pass:cutoff"),
            ),
            family(
                "velocity limit",
                &each(&["4", "3", "2", "1.5", "1"], "velocity-limit:limit"),
            ),
            family(
                "velocity limit, waist and shoulders",
                &each(
                    &["4", "3", "2", "1.5", "1"],
                    "velocity-limit:joints=waist+shoulder,limit",
                ),
            ),
            family("the EMP's own remedies", &Self::remedies()),
            family(
                "static clamp",
                &each(&["0.03", "0.05", "0.06", "0.07"], "static-clamp:margin"),
            ),
            family(
                "soft knee",
                &each(
                    &["0.8", "0.6", "0.4", "0.2", "0"],
                    &format!("soft-knee:{knee},slope"),
                ),
            ),
        ]
    }
}

impl Family {
    /// What the default EMP's training tries against falls, as plain filters.
    fn remedies() -> Vec<String> {
        let HindsightSettings { against_falls, .. } =
            EmpSettings::preset(Preset::Default).hindsight;
        against_falls.iter().map(Remedy::filter).collect()
    }
}

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

/// Everything that was compared. As JSON one object; [`Display`](std::fmt::Display) writes a page in Markdown.
#[derive(Clone, Debug, Serialize)]
pub struct EmpReport {
    /// Name of the robot.
    robot: String,
    /// What it rests on.
    basis: Basis,
    /// The policy alone, the EMPs, then each family from mild to strong.
    rows: Vec<Row>,
    /// Each EMP against each filter that needs no learning, over the hard conditions.
    duels: Vec<Duel>,
    /// Each EMP beside each family where that cuts as many falls.
    matches: Vec<Match>,
    /// The gates of one EMP.
    gates: Vec<GateRow>,
}

/// One controller.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Name of the controller.
    name: String,
    /// Its family; an EMP is one of its own.
    family: String,
    /// Whether it is learned.
    learned: bool,
    /// All hard conditions together.
    hard: Outcome,
    /// The same by the kind of motion.
    groups: Vec<GroupOutcome>,
    /// Each condition by itself.
    conditions: Vec<Outcome>,
}

/// What came of a set of episodes.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Name of the condition.
    condition: &'static str,
    /// Number of episodes.
    episodes: usize,
    /// Number of motions that they play: what the intervals rest on.
    motions: usize,
    /// Number of those in which the robot fell.
    falls: usize,
    /// Share of the policy's own falls that are gone; none where it has none.
    falls_cut: Option<Interval>,
    /// The metrics.
    metrics: Metrics<Interval>,
    /// Their difference from the policy's own, pair by pair.
    difference: Metrics<Interval>,
}

/// What came of the episodes on one kind of motion.
#[derive(Clone, Debug, Serialize)]
pub struct GroupOutcome {
    /// The kind of motion.
    name: &'static str,
    /// What came of them.
    #[serde(flatten)]
    outcome: Outcome,
}

/// An EMP against a filter.
#[derive(Clone, Debug, Serialize)]
pub struct Duel {
    /// The EMP.
    emp: String,
    /// The filter.
    filter: String,
    /// The EMP's metrics minus the filter's.
    difference: Metrics<Interval>,
}

/// The episodes of one controller.
struct Played {
    name: String,
    family: String,
    learned: bool,
    /// Those of each condition and kind of motion.
    parts: Vec<Part>,
}

/// The episodes of one condition and kind of motion.
struct Part {
    condition: Condition,
    group: &'static str,
    samples: Vec<Sample>,
}

/// Compares.
///
/// # Errors
/// When there is no clip, a filter does not exist, a model fails, or `progress` cancels.
pub fn report(run: &EmpRun<'_>, progress: &mut dyn Progress) -> Result<EmpReport> {
    let mut played = vec![play(run, &Contender::raw(run), progress)?];
    for contender in contenders(run)? {
        played.push(play(run, &contender, progress)?);
    }
    let gates = match run.gates.and_then(|index| run.candidates.get(index)) {
        Some(candidate) => gates::compare(run, candidate, &played, progress)?,
        None => Vec::new(),
    };
    let raw = &played[0];
    let rows: Vec<Row> = played.iter().map(|one| one.row(raw, run)).collect();
    Ok(EmpReport {
        robot: run.policy.robot().name().to_owned(),
        basis: Basis::new(run.set, run.groups),
        matches: matched::matches(&rows),
        rows,
        duels: duels(&played, run.set.seed()),
        gates,
    })
}

/// A controller with its place in the tables.
struct Contender {
    name: String,
    family: String,
    learned: bool,
    controller: Controller,
}

impl Contender {
    fn raw(run: &EmpRun<'_>) -> Self {
        Self {
            name: DECOUPLED.to_owned(),
            family: DECOUPLED.to_owned(),
            learned: false,
            controller: Controller::new(Arc::clone(run.policy), None),
        }
    }
}

fn contenders(run: &EmpRun<'_>) -> Result<Vec<Contender>> {
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

fn evaluation(
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
    fn new(condition: Condition, group: &ClipGroup, evaluation: &Evaluation) -> Self {
        let samples = evaluation.results.iter().map(EpisodeResult::sample);
        Self {
            condition,
            group: group.name,
            samples: samples.collect(),
        }
    }
}

fn play(run: &EmpRun<'_>, contender: &Contender, progress: &mut dyn Progress) -> Result<Played> {
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
    fn samples(&self, is_chosen: impl Fn(&Part) -> bool) -> Vec<Sample> {
        let parts = self.parts.iter().filter(|part| is_chosen(part));
        parts.flat_map(|part| part.samples.clone()).collect()
    }

    /// The episodes of all hard conditions.
    fn hard(&self) -> Vec<Sample> {
        self.samples(Part::is_hard)
    }

    fn row(&self, raw: &Self, run: &EmpRun<'_>) -> Row {
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

impl Row {
    fn under(&self, condition: Condition) -> Option<&Outcome> {
        let mut outcomes = self.conditions.iter();
        outcomes.find(|outcome| outcome.condition == condition.name())
    }
}

impl Outcome {
    fn new(condition: &'static str, ours: &[Sample], raw: &[Sample], seed: u64) -> Self {
        Self {
            condition,
            episodes: ours.len(),
            motions: motions(ours),
            falls: failures(ours),
            falls_cut: failures_cut(ours, raw, seed),
            metrics: summary(ours, seed),
            difference: paired_difference(ours, raw, seed),
        }
    }

    /// Share of episodes in which the robot fell.
    fn fallen(&self) -> f64 {
        self.falls as f64 / self.episodes.max(1) as f64
    }
}

fn duels(played: &[Played], seed: u64) -> Vec<Duel> {
    let mut duels = Vec::new();
    for emp in played.iter().filter(|one| one.learned) {
        for filter in played.iter().skip(1).filter(|one| !one.learned) {
            duels.push(Duel {
                emp: emp.name.clone(),
                filter: filter.name.clone(),
                difference: paired_difference(&emp.hard(), &filter.hard(), seed),
            });
        }
    }
    duels
}

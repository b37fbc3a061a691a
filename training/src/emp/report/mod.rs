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
    evaluation::{Evaluation, Observer, Progress, evaluate_observed},
    goals::GoalClip,
    metrics::{EpisodeSums, Interval, Metrics, failures_cut, paired_difference, summary},
    suite::Condition,
};
use serde::Serialize;

pub use frontier::draw;
pub use gates::GateRow;
pub use matched::{Match, Price};

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
                &each(&["3", "2", "1.4", "1"], "velocity-limit:limit"),
            ),
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
    /// Motion.
    pub clips: &'a [GoalClip],
    /// Seed of loads, pushes and randomisation.
    pub seed: u64,
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
    /// Clips under each condition.
    clips: usize,
    /// Seed of loads, pushes and randomisation.
    seed: u64,
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
    /// Number of those in which the robot fell.
    falls: usize,
    /// Share of the policy's own falls that are gone; none where it has none.
    falls_cut: Option<Interval>,
    /// The metrics.
    metrics: Metrics<Interval>,
    /// Their difference from the policy's own, pair by pair.
    difference: Metrics<Interval>,
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

/// The episodes of one controller, condition by condition.
struct Played {
    name: String,
    family: String,
    learned: bool,
    conditions: Vec<(Condition, Vec<EpisodeSums>)>,
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
    let rows: Vec<Row> = played.iter().map(|one| one.row(raw, run.seed)).collect();
    Ok(EmpReport {
        robot: run.policy.robot().name().to_owned(),
        clips: run.clips.len(),
        seed: run.seed,
        matches: matched::matches(&rows),
        rows,
        duels: duels(&played, run.seed),
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
    observer: &mut dyn Observer,
    progress: &mut dyn Progress,
) -> Result<Evaluation> {
    let settings = condition.settings(run.policy.robot(), run.seed);
    let clips = run.clips;
    let evaluation = evaluate_observed(run.pool, controller, clips, &settings, progress, observer)?;
    ensure!(
        evaluation.complete,
        "interrupted under {}",
        condition.name()
    );
    Ok(evaluation)
}

fn sums(evaluation: &Evaluation) -> Vec<EpisodeSums> {
    evaluation
        .results
        .iter()
        .map(|result| result.sums)
        .collect()
}

fn play(run: &EmpRun<'_>, contender: &Contender, progress: &mut dyn Progress) -> Result<Played> {
    let conditions = OTHERS.into_iter().chain(Condition::HARD);
    let play = |condition| {
        let evaluation = evaluation(run, &contender.controller, condition, &mut (), progress)
            .with_context(|| format!("evaluating {}", contender.name))?;
        Ok((condition, sums(&evaluation)))
    };
    Ok(Played {
        name: contender.name.clone(),
        family: contender.family.clone(),
        learned: contender.learned,
        conditions: conditions.map(play).collect::<Result<_>>()?,
    })
}

impl Played {
    /// The episodes of all hard conditions.
    fn hard(&self) -> Vec<EpisodeSums> {
        let hard = self.conditions.iter();
        hard.filter(|(condition, _)| Condition::HARD.contains(condition))
            .flat_map(|(_, sums)| sums)
            .copied()
            .collect()
    }

    fn row(&self, raw: &Self, seed: u64) -> Row {
        let pairs = self.conditions.iter().zip(&raw.conditions);
        Row {
            name: self.name.clone(),
            family: self.family.clone(),
            learned: self.learned,
            hard: Outcome::new("hard suite", &self.hard(), &raw.hard(), seed),
            conditions: pairs
                .map(|((condition, ours), (_, raw))| {
                    Outcome::new(condition.name(), ours, raw, seed)
                })
                .collect(),
        }
    }
}

impl Row {
    fn under(&self, condition: Condition) -> Option<&Outcome> {
        let mut outcomes = self.conditions.iter();
        outcomes.find(|outcome| outcome.condition == condition.name())
    }
}

impl Outcome {
    fn new(condition: &'static str, ours: &[EpisodeSums], raw: &[EpisodeSums], seed: u64) -> Self {
        Self {
            condition,
            episodes: ours.len(),
            falls: falls(ours),
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

fn falls(sums: &[EpisodeSums]) -> usize {
    sums.iter()
        .filter(|episode| episode.sums.suc == 0.0)
        .count()
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

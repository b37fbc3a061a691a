//! Danger gates of an EMP, side by side.

use std::sync::Arc;

use anyhow::Result;
use emp_models::{controller::Controller, emp::DangerGate, filters::EmpFilter};
use emp_sim::{
    evaluation::{ExecutedFrame, Observer, Progress},
    metrics::Sample,
    quantile::quantile_of,
    suite::Condition,
};
use serde::Serialize;

use super::{
    play::{Candidate, EmpRun, Part, Played, evaluation},
    rows::{HARD, Outcome},
};

/// Shares of safe frames that a gate lets pass.
const PERCENTILES: [f64; 3] = [0.5, 0.9, 0.99];

/// Tilts at which a gate opens, rad: from what a standing robot has now and then to a fall that has begun.
const TILTS: [f32; 4] = [0.03, 0.05, 0.1, 0.2];

/// A gate that opens so many control periods before the fall, or fewer, opens too late.
const TOO_LATE: usize = 15;

/// One gate.
#[derive(Clone, Debug, Serialize)]
pub struct GateRow {
    /// The EMP.
    pub(super) emp: String,
    /// What opens the gate; none: it is always open.
    pub(super) gate: Option<DangerGate>,
    /// How the threshold came about.
    pub(super) origin: String,
    /// Nominal conditions.
    pub(super) nominal: Outcome,
    /// The hard conditions together.
    pub(super) hard: Outcome,
    /// Falls under hard conditions in episodes in which the EMP stands when it is always on.
    pub(super) missed: usize,
    /// Falls under hard conditions before which the gate opened less than 15 control periods, or not at all.
    pub(super) too_late: usize,
}

/// The gates of `candidate`: none, its own, the paper's, by percentile of regloss in frames of the policy alone under nominal conditions,
/// and by tilt.
pub(super) fn compare(
    run: &EmpRun<'_>,
    candidate: &Candidate,
    played: &[Played],
    progress: &mut dyn Progress,
) -> Result<Vec<GateRow>> {
    let always = played
        .iter()
        .find(|one| one.learned && one.name == candidate.name);
    let (Some(raw), Some(always)) = (played.first(), always) else {
        return Ok(Vec::new());
    };
    let seed = run.set.seed();
    let mut rows = vec![GateRow {
        emp: candidate.name.clone(),
        gate: None,
        origin: "always on".to_owned(),
        nominal: nominal(always, raw, seed),
        hard: Outcome::new(HARD, &always.hard(), &raw.hard(), seed),
        missed: 0,
        too_late: 0,
    }];
    for (gate, origin) in gates(run, candidate, progress)? {
        let (gated, too_late) = play(run, candidate, gate, progress)?;
        let pairs = gated.hard().into_iter().zip(always.hard());
        let is_missed =
            |(gated, always): &(Sample, Sample)| gated.sums.sums.suc < always.sums.sums.suc;
        rows.push(GateRow {
            emp: candidate.name.clone(),
            gate: Some(gate),
            origin,
            nominal: nominal(&gated, raw, seed),
            hard: Outcome::new(HARD, &gated.hard(), &raw.hard(), seed),
            missed: pairs.filter(is_missed).count(),
            too_late,
        });
    }
    Ok(rows)
}

fn nominal(played: &Played, raw: &Played, seed: u64) -> Outcome {
    let of = |played: &Played| played.samples(|part| part.condition == Condition::Nominal);
    Outcome::new(Condition::Nominal.name(), &of(played), &of(raw), seed)
}

/// The gates to compare, and how each threshold came about.
fn gates(
    run: &EmpRun<'_>,
    candidate: &Candidate,
    progress: &mut dyn Progress,
) -> Result<Vec<(DangerGate, String)>> {
    let never = DangerGate::Regloss(f32::INFINITY);
    let mut safe = Regloss::default();
    let controller = gated(run, candidate, never);
    for group in run.groups {
        evaluation(
            run,
            &controller,
            Condition::Nominal,
            group,
            &mut safe,
            progress,
        )?;
    }
    let mut gates = vec![
        (candidate.emp.config().gate, "the checkpoint's".to_owned()),
        (DangerGate::PAPER, "the paper's".to_owned()),
    ];
    for share in PERCENTILES {
        let limit = quantile_of(safe.0.clone(), share);
        let origin = format!("p{:.0} of nominal frames", 100.0 * share);
        gates.extend(limit.map(|limit| (DangerGate::Regloss(limit as f32), origin)));
    }
    let tilts = TILTS.map(|limit| (DangerGate::Tilt(limit), "fixed".to_owned()));
    gates.extend(tilts);
    Ok(gates)
}

fn gated(run: &EmpRun<'_>, candidate: &Candidate, gate: DangerGate) -> Controller {
    let filter = EmpFilter::when_danger(Arc::clone(&candidate.emp), gate);
    Controller::new(Arc::clone(run.policy), Some(Arc::new(filter)))
}

/// The episodes behind one gate under nominal and hard conditions, and the number of falls that it opened too late for.
fn play(
    run: &EmpRun<'_>,
    candidate: &Candidate,
    gate: DangerGate,
    progress: &mut dyn Progress,
) -> Result<(Played, usize)> {
    let controller = gated(run, candidate, gate);
    let mut parts = Vec::new();
    let mut too_late = 0;
    for condition in [Condition::Nominal].into_iter().chain(Condition::HARD) {
        for group in run.groups {
            let mut openings = Openings::default();
            let evaluation =
                evaluation(run, &controller, condition, group, &mut openings, progress)?;
            if condition != Condition::Nominal {
                let fallen = evaluation
                    .results
                    .iter()
                    .filter(|result| result.failure.is_some());
                let late = fallen.filter(|result| openings.frames(result.episode) < TOO_LATE);
                too_late += late.count();
            }
            parts.push(Part::new(condition, group, &evaluation));
        }
    }
    let played = Played {
        name: candidate.name.clone(),
        family: candidate.name.clone(),
        learned: true,
        parts,
    };
    Ok((played, too_late))
}

/// The regloss of every frame.
#[derive(Default)]
struct Regloss(Vec<f64>);

impl Observer for Regloss {
    fn executed(&mut self, frame: &ExecutedFrame<'_>) {
        let regloss = frame.output.risk.map(|risk| f64::from(risk.regloss));
        self.0.extend(regloss);
    }
}

/// For how many frames the gate has been open, by episode.
#[derive(Default)]
pub(super) struct Openings(Vec<usize>);

impl Openings {
    pub(super) fn frames(&self, episode: usize) -> usize {
        self.0.get(episode).copied().unwrap_or_default()
    }
}

impl Observer for Openings {
    fn executed(&mut self, frame: &ExecutedFrame<'_>) {
        if self.0.len() <= frame.episode {
            self.0.resize(frame.episode + 1, 0);
        }
        let is_open = frame.output.risk.is_some_and(|risk| risk.applied > 0.0);
        let open = &mut self.0[frame.episode];
        *open = if is_open { *open + 1 } else { 0 };
    }
}

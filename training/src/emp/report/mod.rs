//! What an EMP is worth: against the policy alone and against filters that need no learning, on the same episodes.

mod family;
mod frontier;
mod gates;
mod matched;
mod play;
mod rows;
#[cfg(test)]
mod tests;
mod text;

use anyhow::Result;
use emp_sim::{evaluation::Progress, metrics::paired_difference};
use serde::Serialize;

pub use family::Family;
pub use frontier::draw;
pub use gates::GateRow;
pub use matched::{Match, Price};
pub use play::{Candidate, EmpRun};
pub use rows::{Duel, GroupOutcome, Outcome, Row};

use crate::sets::Basis;
use play::{Contender, Played, contenders, play};

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

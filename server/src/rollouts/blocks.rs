//! Rollouts as messages: blocks of environments, each below the message limit.

use std::ops::Range;

use emp_proto::v1::{
    RewardTerm, RolloutBlock, StepEnd, TimedOutState, TrainingEnd, TrainingEpisode,
};
use emp_sim::{
    Divergence, End, Rollout, RolloutStatistics,
    environment::{EndReason, REWARD_NAMES},
};

use crate::wire;

/// Bytes of numbers in one block, about.
const BLOCK_BYTES: usize = 4 << 20;

/// The rollout's blocks in order.
pub(super) fn of(rollout: &Rollout, iteration: u64) -> impl Iterator<Item = RolloutBlock> {
    let environments = rollout.environments;
    let numbers = [
        &rollout.features,
        &rollout.privileged,
        &rollout.last_privileged,
        &rollout.means,
        &rollout.actions,
        &rollout.rewards,
    ];
    let bytes: usize = numbers.iter().map(|values| size_of_val(&values[..])).sum();
    let blocks = bytes.div_ceil(BLOCK_BYTES).clamp(1, environments.max(1));
    let size = environments.div_ceil(blocks).max(1);
    (0..environments)
        .step_by(size)
        .map(move |start| block(rollout, iteration, start..environments.min(start + size)))
}

fn block(rollout: &Rollout, iteration: u64, environments: Range<usize>) -> RolloutBlock {
    let (all, horizon) = (rollout.environments, rollout.horizon);
    let rows = |values: &[f32]| columns(values, all, horizon, &environments);
    let timed_out = rollout
        .timed_out_privileged
        .iter()
        .filter(|(row, _)| environments.contains(&(row % all)))
        .map(|(row, privileged)| TimedOutState {
            step: wire::count(row / all),
            environment: wire::count(row % all - environments.start),
            privileged: privileged.clone(),
        });
    let ends = rollout.ends.chunks_exact(all);
    RolloutBlock {
        iteration,
        first_environment: wire::count(environments.start),
        environments: wire::count(environments.len()),
        horizon: wire::count(horizon),
        features: rows(&rollout.features),
        privileged: rows(&rollout.privileged),
        last_privileged: columns(&rollout.last_privileged, all, 1, &environments),
        means: rows(&rollout.means),
        actions: rows(&rollout.actions),
        rewards: rows(&rollout.rewards),
        ends: ends
            .flat_map(|step| &step[environments.clone()])
            .map(|&end| step_end(end).into())
            .collect(),
        timed_out: timed_out.collect(),
    }
}

/// The rows of some environments out of `steps` batches with one row for each of `all` environments.
fn columns(values: &[f32], all: usize, steps: usize, environments: &Range<usize>) -> Vec<f32> {
    let width = values.len() / (all * steps).max(1);
    values
        .chunks_exact((all * width).max(1))
        .flat_map(|batch| &batch[environments.start * width..environments.end * width])
        .copied()
        .collect()
}

fn step_end(end: End) -> StepEnd {
    match end {
        End::None => StepEnd::None,
        End::Terminated => StepEnd::Terminated,
        End::TimedOut => StepEnd::TimedOut,
        End::Diverged => StepEnd::Diverged,
    }
}

pub(super) fn reward_terms(statistics: &RolloutStatistics) -> Vec<RewardTerm> {
    let terms = REWARD_NAMES.iter().zip(&statistics.reward_terms);
    terms
        .map(|(name, &mean)| RewardTerm {
            name: (*name).to_owned(),
            mean,
        })
        .collect()
}

pub(super) fn episodes(statistics: &RolloutStatistics) -> Vec<TrainingEpisode> {
    let episodes = statistics.episodes.iter();
    episodes
        .map(|episode| TrainingEpisode {
            length: episode.length,
            end: training_end(episode.end).into(),
            clip: episode.clip,
        })
        .collect()
}

fn training_end(end: EndReason) -> TrainingEnd {
    match end {
        EndReason::Tilted => TrainingEnd::Tilted,
        EndReason::Sank => TrainingEnd::Sank,
        EndReason::TimedOut => TrainingEnd::TimedOut,
        EndReason::Diverged(Divergence::Inertia) => TrainingEnd::DivergedInertia,
        EndReason::Diverged(Divergence::Contacts) => TrainingEnd::DivergedContacts,
        EndReason::Diverged(Divergence::Constraints) => TrainingEnd::DivergedConstraints,
        EndReason::Diverged(Divergence::Position) => TrainingEnd::DivergedPosition,
        EndReason::Diverged(Divergence::Velocity) => TrainingEnd::DivergedVelocity,
        EndReason::Diverged(Divergence::Acceleration) => TrainingEnd::DivergedAcceleration,
        EndReason::Diverged(Divergence::Control) => TrainingEnd::DivergedControl,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_hold_every_row_once_and_stay_below_the_limit() {
        let (environments, horizon, features) = (300, 24, 228);
        let row = |t: usize, n: usize| (t * environments + n) as f32;
        let rows: Vec<f32> = (0..horizon)
            .flat_map(|t| (0..environments).map(move |n| row(t, n)))
            .collect();
        let mut rollout = Rollout {
            environments,
            horizon,
            features: rows.iter().flat_map(|&x| vec![x; features]).collect(),
            rewards: rows.clone(),
            last_privileged: (0..environments).map(|n| n as f32).collect(),
            ends: vec![End::None; rows.len()],
            ..Rollout::default()
        };
        let timed_out = 7 * environments + 299;
        rollout.ends[timed_out] = End::TimedOut;
        rollout.timed_out_privileged.push((timed_out, vec![0.5]));

        let blocks: Vec<_> = of(&rollout, 9).collect();
        assert!(blocks.len() > 1);
        let mut next = 0;
        for block in &blocks {
            assert_eq!((block.iteration, block.horizon), (9, 24));
            assert_eq!(block.first_environment, next);
            assert!(prost::Message::encoded_len(block) < 5 << 20);
            for t in 0..horizon {
                for n in 0..block.environments {
                    let index = t * block.environments as usize + n as usize;
                    let expected = row(t, (next + n) as usize);
                    assert_eq!(block.rewards[index], expected);
                    assert_eq!(block.features[index * features + 5], expected);
                }
            }
            assert_eq!(block.last_privileged[0], next as f32);
            next += block.environments;
        }
        assert_eq!(next as usize, environments);
        let last = blocks.last().expect("a block");
        assert_eq!(last.timed_out.len(), 1);
        assert_eq!(last.timed_out[0].step, 7);
        assert_eq!(last.timed_out[0].environment, last.environments - 1);
        let at = 7 * last.environments + last.timed_out[0].environment;
        assert_eq!(last.ends[at as usize], i32::from(StepEnd::TimedOut));
        assert!(blocks[0].timed_out.is_empty());
    }
}

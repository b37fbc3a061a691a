//! Rollouts as messages: blocks of environments and control periods, each below the message limit.

use std::ops::Range;

use emp_proto::v1::{
    RewardTerm, RolloutBlock, StepEnd, TimedOutState, TrainingEnd, TrainingEpisode,
};
use emp_sim::{
    End, Rollout, RolloutStatistics,
    environment::{EndReason, REWARD_NAMES},
};

use crate::encode;

/// Bytes of a message with one block, at most, unless a single row has more.
const BLOCK_BYTES: usize = 1 << 20;
/// Bytes that a block's other fields take at most, and how much more its numbers take than they are.
const OVERHEAD: usize = 1 << 10;

/// The rollout's blocks in order: as many robots as fit with all their control periods, or fewer of those where not even one does.
pub(super) fn of(rollout: &Rollout, iteration: u64) -> impl Iterator<Item = RolloutBlock> {
    let Rollout {
        environments,
        horizon,
        ..
    } = *rollout;
    let rows = (environments * horizon).max(1);
    let numbers = [
        &rollout.features,
        &rollout.privileged,
        &rollout.means,
        &rollout.actions,
        &rollout.rewards,
    ];
    let bytes: usize = numbers.iter().map(|values| size_of_val(&values[..])).sum();
    // Twice the privileged state: at the end, and where an episode timed out in every row at worst.
    let last = size_of_val(&rollout.last_privileged[..]) / environments.max(1);
    let row = bytes / rows + last + 2 * OVERHEAD / 64;
    let fitting = ((BLOCK_BYTES - OVERHEAD - last.min(BLOCK_BYTES / 2)) / row.max(1)).max(1);
    let steps = horizon.min(fitting).max(1);
    let size = (fitting / steps).max(1);
    let starts = (0..environments).step_by(size);
    starts.flat_map(move |start| {
        let robots = start..environments.min(start + size);
        (0..horizon).step_by(steps).map(move |first| {
            let periods = first..horizon.min(first + steps);
            block(rollout, iteration, robots.clone(), periods)
        })
    })
}

fn block(
    rollout: &Rollout,
    iteration: u64,
    environments: Range<usize>,
    periods: Range<usize>,
) -> RolloutBlock {
    let (all, horizon) = (rollout.environments, rollout.horizon);
    let rows = |values: &[f32]| columns(values, all, horizon, &environments, &periods);
    let timed_out = rollout
        .timed_out_privileged
        .iter()
        .filter(|(row, _)| environments.contains(&(row % all)) && periods.contains(&(row / all)))
        .map(|(row, privileged)| TimedOutState {
            step: encode::count(row / all - periods.start),
            environment: encode::count(row % all - environments.start),
            privileged: privileged.clone(),
        });
    let ends = rollout.ends.chunks_exact(all);
    let ends = ends.skip(periods.start).take(periods.len());
    let last_privileged = if periods.end == horizon {
        columns(&rollout.last_privileged, all, 1, &environments, &(0..1))
    } else {
        Vec::new()
    };
    RolloutBlock {
        iteration,
        first_environment: encode::count(environments.start),
        environments: encode::count(environments.len()),
        first_step: encode::count(periods.start),
        horizon: encode::count(periods.len()),
        features: rows(&rollout.features),
        privileged: rows(&rollout.privileged),
        last_privileged,
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

/// The rows of some environments and periods out of `steps` batches with one row for each of `all` environments.
fn columns(
    values: &[f32],
    all: usize,
    steps: usize,
    environments: &Range<usize>,
    periods: &Range<usize>,
) -> Vec<f32> {
    let width = values.len() / (all * steps).max(1);
    values
        .chunks_exact((all * width).max(1))
        .skip(periods.start)
        .take(periods.len())
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
        .map(|episode| {
            let (end, divergence) = training_end(episode.end);
            TrainingEpisode {
                length: episode.length,
                end: end.into(),
                divergence,
            }
        })
        .collect()
}

fn training_end(end: EndReason) -> (TrainingEnd, String) {
    match end {
        EndReason::Tilted => (TrainingEnd::Tilted, String::new()),
        EndReason::Sank => (TrainingEnd::Sank, String::new()),
        EndReason::TimedOut => (TrainingEnd::TimedOut, String::new()),
        EndReason::Diverged(divergence) => (TrainingEnd::Diverged, divergence.name().to_owned()),
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

        // All of a robot's control periods fit.
        check(&rollout, features);
        // Not even one robot's do.
        let (environments, horizon) = (2, 3_000);
        let rows: Vec<f32> = (0..environments * horizon).map(|row| row as f32).collect();
        let mut long = Rollout {
            environments,
            horizon,
            features: rows.iter().flat_map(|&x| vec![x; features]).collect(),
            rewards: rows.clone(),
            last_privileged: vec![0.0, 1.0],
            ends: vec![End::None; rows.len()],
            ..Rollout::default()
        };
        long.ends[5_999] = End::TimedOut;
        long.timed_out_privileged.push((5_999, vec![0.5]));
        check(&long, features);
    }

    fn check(rollout: &Rollout, features: usize) {
        let (all, horizon) = (rollout.environments, rollout.horizon);
        let mut seen = vec![false; all * horizon];
        let (mut lasts, mut timed_out) = (vec![None; all], Vec::new());
        let blocks: Vec<_> = of(rollout, 9).collect();
        assert!(blocks.len() > 1);
        for block in &blocks {
            assert_eq!(block.iteration, 9);
            assert!(prost::Message::encoded_len(block) <= BLOCK_BYTES);
            let (robots, steps) = (block.environments as usize, block.horizon as usize);
            for t in 0..steps {
                for n in 0..robots {
                    let index = t * robots + n;
                    let row = (block.first_step as usize + t) * all
                        + block.first_environment as usize
                        + n;
                    assert!(!std::mem::replace(&mut seen[row], true));
                    assert_eq!(block.rewards[index], rollout.rewards[row]);
                    assert_eq!(block.features[index * features + 5], rollout.rewards[row]);
                }
            }
            for (n, &last) in block.last_privileged.iter().enumerate() {
                lasts[block.first_environment as usize + n] = Some(last);
            }
            for state in &block.timed_out {
                let at = state.step as usize * robots + state.environment as usize;
                assert_eq!(block.ends[at], i32::from(StepEnd::TimedOut));
                let t = block.first_step as usize + state.step as usize;
                let n = block.first_environment as usize + state.environment as usize;
                timed_out.push(t * all + n);
            }
        }
        assert!(seen.into_iter().all(|seen| seen), "every row once");
        let expected = rollout.last_privileged.iter().copied().map(Some);
        assert!(lasts.into_iter().eq(expected));
        let expected = rollout.timed_out_privileged.iter().map(|(row, _)| *row);
        assert!(timed_out.into_iter().eq(expected));
    }
}

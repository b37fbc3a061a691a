//! Rollouts: what a learner learns from.

use std::time::{Duration, Instant};

use emp_models::policy::Policy;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::SimError;
use crate::environment::{EndReason, REWARD_TERMS, VecEnvironment};

/// What the exploration noise's generators have in their seed beside the environments' seed.
const NOISE: u64 = 0x6e_6f69_7365;

/// How a control period ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum End {
    /// The episode goes on.
    None,
    /// The robot fell.
    Terminated,
    /// The episode reached its full length.
    TimedOut,
    /// The simulation diverged.
    Diverged,
}

impl From<Option<EndReason>> for End {
    fn from(reason: Option<EndReason>) -> Self {
        match reason {
            None => Self::None,
            Some(EndReason::Tilted | EndReason::Sank) => Self::Terminated,
            Some(EndReason::TimedOut) => Self::TimedOut,
            Some(EndReason::Diverged(_)) => Self::Diverged,
        }
    }
}

/// Trajectories of N environments over T control periods. Row t·N + n of a batch is control period t of environment n.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Rollout {
    /// N.
    pub environments: usize,
    /// T.
    pub horizon: usize,
    /// The policy's features, not normalised, T·N × [`emp_models::policy::PolicyConfig::features`].
    pub features: Vec<f32>,
    /// Privileged observations, T·N × [`PrivilegedLayout::width`](crate::environment::PrivilegedLayout::width).
    pub privileged: Vec<f32>,
    /// Privileged observations after the last control period, N rows.
    pub last_privileged: Vec<f32>,
    /// The policy's mean actions, T·N × leg joints.
    pub means: Vec<f32>,
    /// The actions that were taken, T·N × leg joints.
    pub actions: Vec<f32>,
    /// Rewards, T·N.
    pub rewards: Vec<f32>,
    /// How the control periods ended, T·N.
    pub ends: Vec<End>,
    /// Rows of the control periods in which an episode timed out, each with the privileged observation at its end; in the order of
    /// the rows.
    pub timed_out_privileged: Vec<(usize, Vec<f32>)>,
    /// Means and counts.
    pub statistics: RolloutStatistics,
}

/// What a rollout came to.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RolloutStatistics {
    /// Mean of each weighted reward term, in the order of [`REWARD_NAMES`](crate::environment::REWARD_NAMES).
    pub reward_terms: Vec<f64>,
    /// The episodes that ended, in the order of the rows.
    pub episodes: Vec<Episode>,
}

/// An episode that ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Episode {
    /// Its control periods.
    pub length: u32,
    /// Why it ended.
    pub end: EndReason,
    /// Index of the clip in the goal library that was played at its end.
    pub clip: u32,
}

/// Environments that are explored with a policy.
#[derive(Debug)]
pub struct Collector {
    environments: VecEnvironment,
    /// One generator of exploration noise an environment.
    noise: Vec<ChaCha8Rng>,
    inference_time: Duration,
}

impl Collector {
    /// A collector from `environments`, the first of which is number `first`. `seed` is that of the exploration noise.
    pub fn new(environments: VecEnvironment, first: u64, seed: u64) -> Self {
        let noise = (0..environments.len() as u64).map(|index| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed ^ NOISE);
            rng.set_stream(first + index);
            rng
        });
        Self {
            noise: noise.collect(),
            environments,
            inference_time: Duration::ZERO,
        }
    }

    /// The environments.
    pub fn environments(&self) -> &VecEnvironment {
        &self.environments
    }

    /// Time that the policy took of the last rollout.
    pub fn inference_time(&self) -> Duration {
        self.inference_time
    }

    /// How hard episodes are that start from now on; see [`VecEnvironment::set_curriculum`].
    pub fn set_curriculum(&mut self, randomization: f64, difficulty: f32) {
        self.environments.set_curriculum(randomization, difficulty);
    }

    /// How often each clip is drawn from now on; see [`VecEnvironment::set_clip_weights`].
    pub fn set_clip_weights(&mut self, weights: &[f32]) {
        self.environments.set_clip_weights(weights);
    }

    /// Runs the environments for `horizon` control periods. Actions are the policy's plus normal noise, whose standard
    /// deviation is exp(`log_std`), one number a leg joint.
    ///
    /// # Errors
    /// If the policy is for another robot, `log_std` has another number of joints, or the policy fails. The environments are then
    /// between two control periods.
    pub fn collect(
        &mut self,
        policy: &Policy,
        log_std: &[f32],
        horizon: usize,
    ) -> Result<Rollout, SimError> {
        self.collect_unless(policy, log_std, horizon, || false)
    }

    /// [`collect`](Self::collect), but asks before every control period whether to stop; then the rollout is as long as it got.
    ///
    /// # Errors
    /// As [`collect`](Self::collect).
    pub fn collect_unless(
        &mut self,
        policy: &Policy,
        log_std: &[f32],
        horizon: usize,
        mut stop: impl FnMut() -> bool,
    ) -> Result<Rollout, SimError> {
        self.check(policy, log_std)?;
        let std: Vec<f32> = log_std.iter().map(|log| log.exp()).collect();
        let mut rollout = self.empty_rollout(policy, horizon);
        let mut terms = [0.0; REWARD_TERMS];
        let mut features = Vec::new();
        self.inference_time = Duration::ZERO;
        for t in 0..horizon {
            if stop() {
                rollout.horizon = t;
                break;
            }
            let start = Instant::now();
            let observations = self.environments.observations();
            let config = policy.config();
            config
                .history_map
                .apply(&config.observation, observations, &mut features);
            let means = policy.actions_from_features(features.clone())?;
            self.inference_time += start.elapsed();
            let actions = explore(&mut self.noise, &means, &std);
            rollout.features.extend_from_slice(&features);
            rollout
                .privileged
                .extend_from_slice(self.environments.privileged());
            rollout.step(t, &mut self.environments, &actions, &mut terms);
            rollout.means.extend_from_slice(&means);
            rollout.actions.extend_from_slice(&actions);
        }
        rollout
            .last_privileged
            .extend_from_slice(self.environments.privileged());
        let rows = rollout.rewards.len().max(1) as f64;
        rollout.statistics.reward_terms = terms.iter().map(|term| term / rows).collect();
        Ok(rollout)
    }

    /// Everything that later rollouts depend on, but for the policy, the settings and the curriculum.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        let parts = (self.environments.snapshot()?, &self.noise);
        postcard::to_stdvec(&parts).map_err(|e| SimError::Snapshot(e.to_string()))
    }

    /// Goes on from a snapshot of a collector of the same robot, number of environments and settings, bit for bit.
    ///
    /// # Errors
    /// If it is no such snapshot; then nothing has changed.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<(), SimError> {
        let (environments, noise): (Vec<u8>, Vec<ChaCha8Rng>) =
            postcard::from_bytes(snapshot).map_err(|e| SimError::Snapshot(e.to_string()))?;
        if noise.len() != self.noise.len() {
            return Err(SimError::Snapshot(format!(
                "expected {} environments, found {}",
                self.noise.len(),
                noise.len()
            )));
        }
        self.environments.restore(&environments)?;
        self.noise = noise;
        Ok(())
    }

    /// A rollout with room for all that comes.
    fn empty_rollout(&self, policy: &Policy, horizon: usize) -> Rollout {
        let environments = self.environments.len();
        let rows = horizon * environments;
        let actions = self.environments.layout().last_action().len();
        Rollout {
            environments,
            horizon,
            features: Vec::with_capacity(rows * policy.config().features()),
            privileged: Vec::with_capacity(rows * self.environments.privileged_layout().width()),
            means: Vec::with_capacity(rows * actions),
            actions: Vec::with_capacity(rows * actions),
            rewards: Vec::with_capacity(rows),
            ends: Vec::with_capacity(rows),
            ..Rollout::default()
        }
    }

    fn check(&self, policy: &Policy, log_std: &[f32]) -> Result<(), SimError> {
        let layout = self.environments.layout();
        if policy.layout() != layout {
            return Err(SimError::Setting {
                name: "policy".to_owned(),
                expected: format!("one that reads {layout:?}"),
                found: format!("{:?}", policy.layout()),
            });
        }
        let legs = layout.last_action().len();
        if log_std.len() != legs {
            return Err(SimError::Setting {
                name: "log_std".to_owned(),
                expected: format!("{legs} numbers"),
                found: log_std.len().to_string(),
            });
        }
        Ok(())
    }
}

impl Rollout {
    /// Runs control period `t` and records what came of it; adds the reward terms to `terms`.
    fn step(
        &mut self,
        t: usize,
        environments: &mut VecEnvironment,
        actions: &[f32],
        terms: &mut [f64; REWARD_TERMS],
    ) {
        let width = environments.privileged_layout().width();
        let step = environments.step(actions);
        self.rewards.extend_from_slice(step.rewards);
        for row in step.terms.chunks_exact(REWARD_TERMS) {
            for (sum, term) in terms.iter_mut().zip(row) {
                *sum += term;
            }
        }
        let finals = step.final_privileged.chunks_exact(width);
        let ended = step.ends.iter().zip(step.lengths).zip(step.clips);
        for (n, (((&end, &length), &clip), privileged)) in ended.zip(finals).enumerate() {
            self.ends.push(End::from(end));
            let Some(end) = end else { continue };
            self.statistics.episodes.push(Episode { length, end, clip });
            if end == EndReason::TimedOut {
                let row = t * self.environments + n;
                self.timed_out_privileged.push((row, privileged.to_vec()));
            }
        }
    }
}

/// Adds noise to rows of mean actions.
fn explore(noise: &mut [ChaCha8Rng], means: &[f32], std: &[f32]) -> Vec<f32> {
    let mut actions = means.to_vec();
    for (row, rng) in actions.chunks_exact_mut(std.len()).zip(noise) {
        for (action, std) in row.iter_mut().zip(std) {
            let normal: f32 = StandardNormal.sample(rng);
            *action += std * normal;
        }
    }
    actions
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::environment::{EnvironmentConfig, REWARD_NAMES};
    use crate::testing::{emp27, goal_library, policy};
    use crate::{Pool, Priority};

    fn collector(count: u64, threads: usize) -> Collector {
        let robot = emp27();
        let pool = Arc::new(Pool::new(&robot, threads, Priority::Normal).unwrap());
        let library = Arc::new(goal_library(&robot));
        let config = EnvironmentConfig {
            episode_frames: 12,
            ..EnvironmentConfig::default()
        };
        let environments = VecEnvironment::new(robot, pool, config, library, 0..count, 9).unwrap();
        Collector::new(environments, 0, 9)
    }

    #[test]
    fn rows_of_a_rollout_belong_together() {
        let mut collector = collector(6, 2);
        let policy = policy(collector.environments().robot());
        let log_std = [-1.0; 12];
        let (n, t) = (6, 30);
        let first = policy.features(collector.environments().observations());
        let privileged = collector.environments().privileged().to_vec();
        let rollout = collector.collect(&policy, &log_std, t).unwrap();
        let width = collector.environments().privileged_layout().width();
        assert_eq!((rollout.environments, rollout.horizon), (n, t));
        assert_eq!(rollout.features.len(), t * n * policy.config().features());
        assert_eq!(rollout.features[..first.len()], first);
        assert_eq!(rollout.privileged.len(), t * n * width);
        assert_eq!(rollout.privileged[..privileged.len()], privileged);
        assert_eq!(
            rollout.last_privileged,
            collector.environments().privileged()
        );
        assert_eq!(rollout.actions.len(), t * n * 12);
        assert_eq!(
            rollout.means,
            policy
                .actions_from_features(rollout.features.clone())
                .unwrap()
        );
        assert_eq!((rollout.rewards.len(), rollout.ends.len()), (t * n, t * n));
        let of = |end: End| rollout.ends.iter().filter(|&&e| e == end).count();
        assert_eq!(of(End::TimedOut), rollout.timed_out_privileged.len());
        assert!(of(End::TimedOut) > 6);
        assert_eq!(t * n - of(End::None), rollout.statistics.episodes.len());
        for (row, privileged) in &rollout.timed_out_privileged {
            assert_eq!(rollout.ends[*row], End::TimedOut);
            assert_eq!(privileged.len(), width);
            // The end of the old episode, not the start of the new one.
            let next = (row + n) * width..(row + n + 1) * width;
            assert!(
                rollout
                    .privileged
                    .get(next)
                    .is_none_or(|next| next != privileged)
            );
        }
        let deviations = rollout.actions.iter().zip(&rollout.means);
        let variance: f32 = deviations.map(|(a, mean)| (a - mean).powi(2)).sum();
        let std = (variance / (t * n * 12) as f32).sqrt();
        assert!((std / (-1.0_f32).exp() - 1.0).abs() < 0.05, "{std}");
        let terms = &rollout.statistics.reward_terms;
        assert_eq!(terms.len(), REWARD_NAMES.len());
        let mean: f64 = rollout.rewards.iter().map(|&r| f64::from(r)).sum::<f64>() / (t * n) as f64;
        assert!((terms.iter().sum::<f64>() * 0.02 - mean).abs() < 1e-6);
    }

    #[test]
    fn a_restored_collector_goes_on_bit_for_bit_at_any_number_of_threads() {
        let mut original = collector(5, 2);
        let policy = policy(original.environments().robot());
        original.set_curriculum(0.5, 1.0);
        original.collect(&policy, &[-1.0; 12], 7).unwrap();
        let snapshot = original.snapshot().unwrap();
        let expected = original.collect(&policy, &[-1.0; 12], 20).unwrap();
        for threads in [1, 3] {
            let mut restored = collector(5, threads);
            restored.set_curriculum(0.5, 1.0);
            restored.restore(&snapshot).unwrap();
            assert!(restored.collect(&policy, &[-1.0; 12], 20).unwrap() == expected);
        }
        let stored = postcard::to_stdvec(&expected).unwrap();
        assert!(postcard::from_bytes::<Rollout>(&stored).unwrap() == expected);
        let error = collector(4, 1).restore(&snapshot).unwrap_err().to_string();
        assert!(
            error.contains("expected 4 environments, found 5"),
            "{error}"
        );
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let mut collector = collector(2, 1);
        let policy = policy(collector.environments().robot());
        let error = collector
            .collect(&policy, &[0.0; 3], 1)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("log_std: expected 12 numbers, found 3"),
            "{error}"
        );
        let nothing = collector.collect(&policy, &[0.0; 12], 0).unwrap();
        assert!(nothing.rewards.is_empty() && nothing.last_privileged.len() > 2);
    }
}

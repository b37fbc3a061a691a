//! Rollouts: what a learner learns from.

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
}

/// Environments that are explored with a policy.
#[derive(Debug)]
pub struct Collector {
    environments: VecEnvironment,
    /// One generator of exploration noise an environment.
    noise: Vec<ChaCha8Rng>,
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
        }
    }

    /// The environments.
    pub fn environments(&self) -> &VecEnvironment {
        &self.environments
    }

    /// How hard episodes are that start from now on; see [`VecEnvironment::set_curriculum`].
    pub fn set_curriculum(&mut self, randomization: f64, difficulty: f32) {
        self.environments.set_curriculum(randomization, difficulty);
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
        self.check(policy, log_std)?;
        let std: Vec<f32> = log_std.iter().map(|log| log.exp()).collect();
        let mut rollout = Rollout {
            environments: self.environments.len(),
            horizon,
            ..Rollout::default()
        };
        let mut terms = [0.0; REWARD_TERMS];
        let mut features = Vec::new();
        for t in 0..horizon {
            let observations = self.environments.observations();
            policy.config().map_history(observations, &mut features);
            let means = policy.actions_from_features(features.clone())?;
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
        for (n, ((&end, &length), privileged)) in
            step.ends.iter().zip(step.lengths).zip(finals).enumerate()
        {
            self.ends.push(End::from(end));
            let Some(end) = end else { continue };
            self.statistics.episodes.push(Episode { length, end });
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

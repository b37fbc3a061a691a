//! The learner: from one rollout to the next weights.
//!
//! Each mini-batch is cut into a fixed number of shards; the gradient of each is computed on one thread, and they are
//! added in order. So the weights have the same bits at any number of threads.

use std::time::Instant;

use anyhow::{Context as _, Result};
use emp_models::{
    Mirror,
    checkpoint::Tensors,
    mlp::Normalizer,
    optimizer::{Adam, AdamConfig},
};
use emp_sim::{End, Rollout};
use rand::{SeedableRng as _, seq::SliceRandom as _};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    moments::RunningMoments,
    network::{ActorCritic, Gradient, Symmetry, Weights, Widths},
    objective::{self, Losses, Samples},
    returns::{self, Trajectories},
    settings::PpoSettings,
};
use crate::{rows::gather, variables};

/// Rows of a forward pass without gradient.
const ROWS: usize = 1024;

/// Names of the moments in a checkpoint.
const FEATURES: &str = "moments.features";
const PRIVILEGED: &str = "moments.privileged";

/// Learns a policy from rollouts.
pub struct Learner {
    settings: PpoSettings,
    seed: u64,
    widths: Widths,
    network: ActorCritic,
    adam: Adam,
    features: RunningMoments,
    privileged: RunningMoments,
    progress: Progress,
    threads: rayon::ThreadPool,
}

/// What a learner counts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Updates made.
    pub updates: u64,
    /// Steps of the optimiser.
    pub optimizer_steps: u64,
    /// Step size.
    pub learning_rate: f64,
}

/// What one update measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStatistics {
    /// Mean clipped surrogate loss.
    pub policy_loss: f64,
    /// Mean squared value error.
    pub value_loss: f64,
    /// Share of the returns' variance that the critic explains.
    pub explained_variance: f64,
    /// Mean divergence over the mini-batches.
    pub divergence: f64,
    /// Mean norm of the gradient before it was bounded.
    pub gradient_norm: f64,
    /// Step size after the update.
    pub learning_rate: f64,
    /// Mean deviation of exploration.
    pub std: f64,
    /// Seconds that it took.
    pub seconds: f64,
}

impl Learner {
    /// A learner with random weights, symmetric with a `symmetry`.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        widths: Widths,
        settings: PpoSettings,
        symmetry: Option<Symmetry>,
        seed: u64,
        threads: usize,
    ) -> Result<Self> {
        let network = ActorCritic::new(widths, &settings, symmetry, seed)?;
        let config = AdamConfig {
            epsilon: 1e-5,
            max_gradient_norm: settings.max_gradient_norm,
            ..AdamConfig::default()
        };
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("learner-{index}"));
        Ok(Self {
            adam: Adam::new(network.vars(), config)?,
            features: RunningMoments::new(widths.features),
            privileged: RunningMoments::new(widths.privileged),
            progress: Progress {
                updates: 0,
                optimizer_steps: 0,
                learning_rate: settings.learning_rate[1],
            },
            threads: threads.build().context("starting the learner's threads")?,
            settings,
            seed,
            widths,
            network,
        })
    }

    /// What the learner has counted.
    pub fn progress(&self) -> Progress {
        self.progress
    }

    /// The actor's tensors, by the names of a policy's checkpoint.
    ///
    /// # Errors
    /// When the variables' lock is poisoned.
    pub fn actor(&self) -> Result<Tensors> {
        self.network.actor_tensors()
    }

    /// The normalisation of the actor's features.
    pub fn normalizer(&self) -> Normalizer {
        match self.network.symmetry() {
            Some(symmetry) => self
                .features
                .symmetrized(&symmetry.policy.features)
                .normalizer(),
            None => self.features.normalizer(),
        }
    }

    /// The normalisation of what the critic reads.
    fn privileged_normalizer(&self) -> Normalizer {
        match self.network.symmetry() {
            Some(symmetry) => self
                .privileged
                .symmetrized(&symmetry.privileged)
                .normalizer(),
            None => self.privileged.normalizer(),
        }
    }

    /// Logarithms of the deviations of exploration.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn log_std(&self) -> Result<Vec<f32>> {
        Ok(self.network.weights()?.log_std)
    }

    /// Weights, moments and the optimiser's state, for a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn state(&self) -> Result<Tensors> {
        let mut tensors = variables::values(self.network.vars())?;
        tensors.extend(self.adam.state()?);
        self.features.save(FEATURES, &mut tensors)?;
        self.privileged.save(PRIVILEGED, &mut tensors)?;
        Ok(tensors)
    }

    /// Continues from a saved [`state`](Self::state).
    ///
    /// # Errors
    /// When a tensor is missing or has another shape.
    pub fn restore(&mut self, tensors: &Tensors, progress: Progress) -> Result<()> {
        variables::restore(self.network.vars(), tensors)?;
        self.adam.restore(tensors, progress.optimizer_steps)?;
        self.features.restore(FEATURES, tensors)?;
        self.privileged.restore(PRIVILEGED, tensors)?;
        self.progress = progress;
        Ok(())
    }

    /// Lets normalisation see all of a rollout, before learning starts.
    pub fn warm_up(&mut self, rollout: &Rollout) {
        self.features.update(&rollout.features);
        self.privileged.update(&rollout.privileged);
    }

    /// Learns from a rollout.
    ///
    /// # Errors
    /// When a gradient is not a number.
    pub fn update(&mut self, rollout: &Rollout) -> Result<UpdateStatistics> {
        let start = Instant::now();
        let batch = self.batch(rollout)?;
        let mut statistics = self.learn(&batch)?;
        // The newest frames alone: normalisation moves slower than the policy.
        let newest = |rows: &'_ [f32], width: usize| rows.len() - rollout.environments * width;
        let features = newest(&rollout.features, self.widths.features);
        let privileged = newest(&rollout.privileged, self.widths.privileged);
        self.features.update(&rollout.features[features..]);
        self.privileged.update(&rollout.privileged[privileged..]);
        self.progress.updates += 1;
        self.progress.optimizer_steps = self.adam.steps();
        statistics.learning_rate = self.progress.learning_rate;
        let log_std = self.log_std()?;
        let deviations = log_std.iter().map(|log| f64::from(log.exp()));
        statistics.std = deviations.sum::<f64>() / log_std.len() as f64;
        statistics.seconds = start.elapsed().as_secs_f64();
        Ok(statistics)
    }

    /// Normalises a rollout and works out what is to be learnt from it.
    fn batch(&self, rollout: &Rollout) -> Result<Batch> {
        let log_std = self.log_std()?;
        let normalizer = self.privileged_normalizer();
        let privileged = Rows::new(
            normalized(&rollout.privileged, &normalizer),
            self.network.symmetry().map(|symmetry| &symmetry.privileged),
        );
        let state_values = self.values(&privileged)?;
        let later_values = |rows: &[f32]| {
            let mirror = self.network.symmetry().map(|symmetry| &symmetry.privileged);
            self.values(&Rows::new(normalized(rows, &normalizer), mirror))
        };
        let mut rewards = rollout.rewards.clone();
        let timed_out = rollout.timed_out_privileged.iter();
        let states: Vec<f32> = timed_out.flat_map(|(_, state)| state).copied().collect();
        let values = later_values(&states)?;
        for ((index, _), value) in rollout.timed_out_privileged.iter().zip(values) {
            // The episode would have gone on: what it would have earned counts.
            rewards[*index] += self.settings.discount as f32 * value;
        }
        let ended: Vec<bool> = rollout.ends.iter().map(|end| *end != End::None).collect();
        let trajectories = Trajectories {
            environments: rollout.environments,
            rewards: &rewards,
            values: &state_values,
            last_values: &later_values(&rollout.last_privileged)?,
            ended: &ended,
        };
        let advantages = returns::advantages(
            &trajectories,
            self.settings.discount,
            self.settings.trace_decay,
        );
        let returns: Vec<f32> = advantages
            .iter()
            .zip(&state_values)
            .map(|(a, v)| a + v)
            .collect();
        let mirror = self.network.symmetry().map(|symmetry| &symmetry.policy);
        Ok(Batch {
            log_probabilities: objective::log_probabilities(
                &rollout.actions,
                &rollout.means,
                &log_std,
            ),
            explained_variance: returns::explained_variance(&returns, &advantages),
            advantages: returns::standardized(&advantages),
            returns,
            features: Rows::new(
                normalized(&rollout.features, &self.normalizer()),
                mirror.map(|mirror| &mirror.features),
            ),
            privileged,
            actions: rollout.actions.clone(),
            means: rollout.means.clone(),
            log_std,
        })
    }

    /// Values of normalised privileged observations.
    fn values(&self, privileged: &Rows) -> Result<Vec<f32>> {
        let width = self.widths.privileged;
        let weights = self.network.weights()?;
        let indices: Vec<usize> = (0..privileged.rows.len() / width).collect();
        let chunk = |rows: &[usize]| weights.values(privileged.gathered(width, rows)).numbers;
        let chunks: Vec<Vec<f32>> = self
            .threads
            .install(|| indices.par_chunks(ROWS).map(chunk).collect());
        Ok(chunks.concat())
    }

    fn learn(&mut self, batch: &Batch) -> Result<UpdateStatistics> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        // Stream 0 drew the weights.
        rng.set_stream(self.progress.updates + 1);
        let mut order: Vec<usize> = (0..batch.returns.len()).collect();
        let rows = order.len().div_ceil(self.settings.mini_batches);
        let mut sums = Sums::default();
        for _ in 0..self.settings.epochs {
            order.shuffle(&mut rng);
            for rows in order.chunks(rows) {
                self.step(batch, rows, &mut sums)
                    .with_context(|| format!("update {}", self.progress.updates))?;
            }
        }
        let samples = (self.settings.epochs * batch.returns.len()) as f64;
        Ok(UpdateStatistics {
            policy_loss: sums.policy / samples,
            value_loss: sums.value / samples,
            divergence: sums.divergence / samples,
            gradient_norm: sums.gradient_norm
                / (self.settings.epochs * self.settings.mini_batches) as f64,
            explained_variance: batch.explained_variance,
            ..UpdateStatistics::default()
        })
    }

    /// One step of the optimiser on the given rows.
    fn step(&mut self, batch: &Batch, rows: &[usize], sums: &mut Sums) -> Result<()> {
        let shard_rows = rows.len().div_ceil(self.settings.shards);
        let weights = self.network.weights()?;
        let shards: Vec<Shard> = self.threads.install(|| {
            let shards = rows.par_chunks(shard_rows);
            shards
                .map(|shard| self.shard(batch, &weights, shard))
                .collect()
        });
        let divergence: f64 = shards.iter().map(|shard| shard.divergence).sum();
        let rate = &mut self.progress.learning_rate;
        *rate = objective::adapted_learning_rate(
            *rate,
            divergence / rows.len() as f64,
            self.settings.target_divergence,
            self.settings.learning_rate,
        );
        sums.divergence += divergence;
        sums.policy += shards.iter().map(|shard| shard.policy).sum::<f64>();
        sums.value += shards.iter().map(|shard| shard.value).sum::<f64>();
        let mut gradients = shards.into_iter().map(|shard| shard.gradient);
        let mut gradient = gradients.next().context("a mini-batch has no rows")?;
        gradients.for_each(|part| gradient.add(&part));
        gradient.divide(rows.len() as f32);
        let rate = self.progress.learning_rate;
        sums.gradient_norm += self.adam.step_by_name(gradient.0, rate)?;
        self.network.bound_std(self.settings.min_std)?;
        Ok(())
    }

    /// What one shard of a mini-batch adds to the gradient.
    fn shard(&self, batch: &Batch, weights: &Weights<'_>, rows: &[usize]) -> Shard {
        let column = |values: &[f32]| gather(values, 1, rows);
        let samples = Samples {
            actions: gather(&batch.actions, self.widths.actions, rows),
            log_probabilities: column(&batch.log_probabilities),
            advantages: column(&batch.advantages),
            returns: column(&batch.returns),
        };
        let means = weights.means(batch.features.gathered(self.widths.features, rows));
        let values = weights.values(batch.privileged.gathered(self.widths.privileged, rows));
        let log_std = &weights.log_std;
        let losses = Losses::new(
            &samples,
            &means.numbers,
            log_std,
            &values.numbers,
            &self.settings,
        );
        let old_means = gather(&batch.means, self.widths.actions, rows);
        Shard {
            divergence: objective::divergence(&old_means, &means.numbers, &batch.log_std, log_std),
            policy: losses.policy,
            value: losses.value,
            gradient: weights.gradient(
                (&means, losses.by_means),
                (&values, losses.by_values),
                losses.by_log_std,
            ),
        }
    }
}

/// A rollout, ready to learn from.
struct Batch {
    /// What the actor saw.
    features: Rows,
    /// What the critic saw.
    privileged: Rows,
    actions: Vec<f32>,
    means: Vec<f32>,
    log_probabilities: Vec<f32>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
    /// Logarithms of the deviations with which the actions were drawn.
    log_std: Vec<f32>,
    explained_variance: f64,
}

/// Normalised rows, and their mirror images where the networks are symmetric.
struct Rows {
    rows: Vec<f32>,
    images: Option<Vec<f32>>,
}

impl Rows {
    fn new(rows: Vec<f32>, mirror: Option<&Mirror>) -> Self {
        let images = mirror.map(|mirror| mirror.rows(&rows));
        Self { rows, images }
    }

    /// The rows of these numbers, followed by their images.
    fn gathered(&self, width: usize, rows: &[usize]) -> Vec<f32> {
        let sides = [Some(&self.rows), self.images.as_ref()];
        let mut gathered = Vec::with_capacity(2 * rows.len() * width);
        for side in sides.into_iter().flatten() {
            for row in rows {
                gathered.extend_from_slice(&side[row * width..(row + 1) * width]);
            }
        }
        gathered
    }
}

/// What one shard of a mini-batch adds.
struct Shard {
    gradient: Gradient,
    divergence: f64,
    policy: f64,
    value: f64,
}

/// Sums over an update's mini-batches.
#[derive(Default)]
struct Sums {
    divergence: f64,
    policy: f64,
    value: f64,
    gradient_norm: f64,
}

fn normalized(rows: &[f32], normalizer: &Normalizer) -> Vec<f32> {
    let mut rows = rows.to_vec();
    normalizer.apply(&mut rows);
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use emp_models::policy::PolicyMirror;
    use rand::RngExt as _;

    const ENVIRONMENTS: usize = 32;
    const HORIZON: usize = 32;

    /// Points on a line that must come to 0 and stay: an action is a velocity, an episode has 50 steps and ends early beyond 3.
    struct Points {
        positions: Vec<f32>,
        ages: Vec<usize>,
        rng: ChaCha8Rng,
    }

    impl Points {
        fn new() -> Self {
            Self {
                positions: vec![0.5; ENVIRONMENTS],
                ages: (0..ENVIRONMENTS).collect(),
                rng: ChaCha8Rng::seed_from_u64(5),
            }
        }

        fn privileged(&self) -> Vec<f32> {
            self.positions.iter().flat_map(|x| [*x, x * x]).collect()
        }

        fn collect(&mut self, learner: &Learner) -> Rollout {
            let std = learner.log_std().unwrap()[0].exp();
            let mut rollout = Rollout {
                environments: ENVIRONMENTS,
                horizon: HORIZON,
                ..Rollout::default()
            };
            for t in 0..HORIZON {
                let features = normalized(&self.positions, &learner.normalizer());
                let both: Vec<f32> = features
                    .iter()
                    .copied()
                    .chain(features.iter().map(|x| -x))
                    .collect();
                let means = learner.network.weights().unwrap().means(both).numbers;
                rollout.features.extend(&self.positions);
                rollout.privileged.extend(self.privileged());
                for (n, mean) in means.into_iter().enumerate() {
                    let noise: f32 = (0..12).map(|_| self.rng.random::<f32>()).sum::<f32>() - 6.0;
                    let action = mean + std * noise;
                    rollout.means.push(mean);
                    rollout.actions.push(action);
                    let x = &mut self.positions[n];
                    *x += 0.2 * action;
                    self.ages[n] += 1;
                    rollout.rewards.push(-x.abs());
                    let end = if x.abs() > 3.0 {
                        End::Terminated
                    } else if self.ages[n] >= 50 {
                        let privileged = vec![*x, *x * *x];
                        rollout
                            .timed_out_privileged
                            .push((t * ENVIRONMENTS + n, privileged));
                        End::TimedOut
                    } else {
                        End::None
                    };
                    if end != End::None {
                        *x = self.rng.random_range(-2.0..2.0);
                        self.ages[n] = 0;
                    }
                    rollout.ends.push(end);
                }
            }
            rollout.last_privileged = self.privileged();
            rollout
        }
    }

    fn learner(threads: usize) -> Learner {
        // The points are their own mirror image about zero: so is what there is to learn.
        let symmetry = Symmetry {
            policy: PolicyMirror {
                features: Mirror::signs(&[-1.0]),
                actions: Mirror::signs(&[-1.0]),
            },
            privileged: Mirror::signs(&[-1.0, 1.0]),
        };
        let widths = Widths {
            features: 1,
            privileged: 2,
            actions: 1,
        };
        let settings = PpoSettings {
            actor_hidden: vec![16],
            critic_hidden: vec![16],
            initial_std: 0.5,
            ..PpoSettings::default()
        };
        Learner::new(widths, settings, Some(symmetry), 11, threads).unwrap()
    }

    fn mean_reward(rollout: &Rollout) -> f32 {
        rollout.rewards.iter().sum::<f32>() / rollout.rewards.len() as f32
    }

    fn train(learner: &mut Learner, updates: usize) -> Vec<f32> {
        let mut points = Points::new();
        learner.warm_up(&points.collect(learner));
        let update = |_| {
            let rollout = points.collect(learner);
            learner.update(&rollout).unwrap();
            mean_reward(&rollout)
        };
        (0..updates).map(update).collect()
    }

    #[test]
    fn points_learn_to_stand_at_zero() {
        let mut learner = learner(1);
        let rewards = train(&mut learner, 60);
        let (first, last) = (rewards[1], rewards[59]);
        assert!(first < -0.8 && last > -0.35, "{rewards:?}");
    }

    #[test]
    fn weights_do_not_depend_on_the_thread_count() {
        let weights = |threads| {
            let mut learner = learner(threads);
            let rewards = train(&mut learner, 5);
            let state = learner.state().unwrap().into_iter().map(|(name, tensor)| {
                let values = tensor
                    .flatten_all()
                    .unwrap()
                    .to_dtype(candle_core::DType::F64)
                    .unwrap();
                (name, values.to_vec1::<f64>().unwrap())
            });
            (rewards, state.collect::<Vec<_>>(), learner.progress())
        };
        assert_eq!(weights(1), weights(2));
    }

    #[test]
    fn a_restored_learner_continues_bit_for_bit() {
        let (mut whole, mut points) = (learner(1), Points::new());
        let first = points.collect(&whole);
        whole.warm_up(&first);
        whole.update(&first).unwrap();
        let mut restored = learner(1);
        restored
            .restore(&whole.state().unwrap(), whole.progress())
            .unwrap();
        let second = points.collect(&whole);
        let statistics = [&mut whole, &mut restored].map(|learner| UpdateStatistics {
            seconds: 0.0,
            ..learner.update(&second).unwrap()
        });
        assert_eq!(statistics[0], statistics[1]);
        assert_eq!(whole.progress(), restored.progress());
    }
}

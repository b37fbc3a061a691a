//! The learner of an EMP: from one rollout to the next weights.
//!
//! The loss is the paper's weighted sum of six, through imagined control periods where the settings ask for them, plus the
//! lesson of falls (see [`HindsightSettings`](super::settings::HindsightSettings)) and the price of contacts and falls (see
//! [`RiskSettings`](super::settings::RiskSettings)). Each mini-batch is cut into a fixed number of shards whose
//! gradients are added in order, so the weights have the same bits at any number of threads.

use std::{sync::Arc, time::Instant};

use anyhow::{Context as _, Result};
use candle_core::{DType, Device, Tensor, backprop::GradStore};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    checkpoint::Tensors,
    emp::{EmpConfig, EmpNetwork, Output},
    observation::ObservationLayout,
    optimizer::{Adam, AdamConfig},
    policy::{Mlp, Normalizer},
};
use emp_robot::Robot;
use emp_sim::End;
use rand::{SeedableRng as _, seq::SliceRandom as _};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    imagination::{Imagination, ImaginedStep},
    objective::{Moments, Objective},
    rollout::Rollout,
    settings::Settings,
};
use crate::{
    policy::{
        moments::RunningMoments,
        objective::{self as ppo, adapted_learning_rate},
        returns::{self, Trajectories},
    },
    rows::{add_gradients, gather, gathered, tensor},
    variables,
};

/// Rows of a forward pass without gradient.
const ROWS: usize = 1024;

/// A residual EMP starts this near to leaving goals as they are.
const RESIDUAL_GAIN: f64 = 0.01;

/// Names in a checkpoint.
const EMP: &str = "emp";
const CRITIC: &str = "critic";
const AVERAGE: &str = "average";
const PRIVILEGED: &str = "moments.privileged";
const NORMALIZER: &str = "emp-normalizer";

/// Learns an EMP from rollouts.
pub struct Learner {
    settings: Settings,
    layout: ObservationLayout,
    network: EmpNetwork,
    normalizer: Normalizer,
    vars: VarMap,
    adam: Adam,
    /// Running mean of the EMP's weights.
    average: Tensors,
    critic: Critic,
    objective: Objective,
    /// Angles of the goal joints in the default pose, rad.
    default_pose: Vec<f32>,
    /// 1 for the goal joints of which hindsight speaks, else 0.
    lesson_joints: Vec<f32>,
    reference: [f64; 2],
    progress: Progress,
}

/// What a learner counts, and what it measured once.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Updates made.
    pub updates: u64,
    /// Steps of the EMP's optimiser.
    pub optimizer_steps: u64,
    /// Steps of the critic's.
    pub critic_steps: u64,
    /// Step size of the EMP.
    pub learning_rate: f64,
    /// The policy's operating point as it is measured, m.
    pub measured_reference: [f64; 2],
    /// The same as the centroid loss sees it, m.
    pub loss_reference: [f64; 2],
}

/// What one update measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStatistics {
    /// Means of the six losses, in the order of [`Terms::NAMES`](super::objective::Terms::NAMES).
    pub terms: [f64; 6],
    /// Mean weighted loss of hindsight.
    pub hindsight: f64,
    /// Mean weighted surrogate of the risk.
    pub risk: f64,
    /// Share of the returns' variance that the critic explains.
    pub explained_variance: f64,
    /// Mean divergence of the EMP from the one that explored.
    pub divergence: f64,
    /// Mean norm of the EMP's gradient before it was bounded.
    pub gradient_norm: f64,
    /// Step size after the update.
    pub learning_rate: f64,
    /// Seconds that it took.
    pub seconds: f64,
}

/// The value of a state, from what only a simulation knows.
struct Critic {
    network: Mlp,
    vars: VarMap,
    adam: Adam,
    moments: RunningMoments,
}

impl Learner {
    /// A learner with random weights. Normalisation and operating points follow from `warm_up`, a rollout with goals as they were
    /// asked for.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(robot: &Arc<Robot>, settings: &Settings, warm_up: &WarmUp) -> Result<Self> {
        let config = settings.network.config(robot);
        let layout = config.observation;
        let normalizer = warm_up.normalizer(&config);
        let mut objective = Objective::new(robot, layout, settings.losses)?;
        let loss_reference = match settings.losses.cen_ref {
            super::losses::CenRef::Center => [0.0; 2],
            super::losses::CenRef::Measured => objective.operating_point(&warm_up.safe_stacks)?,
        };
        objective.set_reference(loss_reference);
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let network = EmpNetwork::new(config, normalizer.clone(), &builder)?;
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        variables::initialise(&vars, &mut rng)?;
        if settings.network.output == Output::Residual {
            let last = format!("decoder.{}", settings.network.decoder_hidden.len());
            shrink(&vars, &last)?;
        }
        let adam = Adam::new(
            &vars,
            AdamConfig {
                max_gradient_norm: settings.optimizer.max_gradient_norm,
                ..AdamConfig::default()
            },
        )?;
        let mut critic = Critic::new(warm_up.privileged_width, settings, &mut rng)?;
        critic.moments.update(&warm_up.privileged);
        Ok(Self {
            progress: Progress {
                updates: 0,
                optimizer_steps: 0,
                critic_steps: 0,
                learning_rate: settings.optimizer.learning_rate[1],
                measured_reference: warm_up.reference,
                loss_reference,
            },
            settings: settings.clone(),
            layout,
            average: variables::values(&vars)?,
            network,
            normalizer,
            vars,
            adam,
            critic,
            objective,
            default_pose: robot
                .goal_joints()
                .iter()
                .map(|joint| joint.default as f32)
                .collect(),
            lesson_joints: robot
                .goal_joints()
                .iter()
                .map(|joint| {
                    let mut words = settings.hindsight.joints.iter();
                    f32::from(u8::from(words.any(|word| joint.name.contains(word))))
                })
                .collect(),
            reference: warm_up.reference,
        })
    }

    /// The EMP as it is now; its tensors follow the learner.
    pub fn network(&self) -> &EmpNetwork {
        &self.network
    }

    /// The weights to serve, named as [`EmpNetwork::new`] names them: a running mean of those after each rollout.
    pub fn average(&self) -> &Tensors {
        &self.average
    }

    /// The normalisation of the EMP's features.
    pub fn normalizer(&self) -> &Normalizer {
        &self.normalizer
    }

    /// What the learner has counted.
    pub fn progress(&self) -> Progress {
        self.progress
    }

    /// The policy's operating point as it is measured: offset of the centre of mass from the middle of the feet, m.
    pub fn reference(&self) -> [f64; 2] {
        self.reference
    }

    /// Weights, moments and the optimisers' state, for a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn state(&self) -> Result<Tensors> {
        let mut tensors = Tensors::new();
        for (prefix, vars, adam) in [
            (EMP, &self.vars, &self.adam),
            (CRITIC, &self.critic.vars, &self.critic.adam),
        ] {
            let parts = variables::values(vars)?.into_iter().chain(adam.state()?);
            tensors.extend(parts.map(|(name, tensor)| (format!("{prefix}/{name}"), tensor)));
        }
        for (name, tensor) in self.normalizer.tensors()? {
            tensors.insert(format!("{NORMALIZER}/{name}"), tensor);
        }
        for (name, tensor) in &self.average {
            tensors.insert(format!("{AVERAGE}/{name}"), tensor.clone());
        }
        self.critic.moments.save(PRIVILEGED, &mut tensors)?;
        Ok(tensors)
    }

    /// Continues from a saved [`state`](Self::state).
    ///
    /// # Errors
    /// When a tensor is missing or has another shape.
    pub fn restore(&mut self, tensors: &Tensors, progress: Progress) -> Result<()> {
        let part = |prefix: &str| -> Tensors {
            let parts = tensors.iter().filter_map(|(name, tensor)| {
                let name = name.strip_prefix(prefix)?.strip_prefix('/')?;
                Some((name.to_owned(), tensor.clone()))
            });
            parts.collect()
        };
        let emp = part(EMP);
        variables::restore(&self.vars, &emp)?;
        self.adam.restore(&emp, progress.optimizer_steps)?;
        let critic = part(CRITIC);
        variables::restore(&self.critic.vars, &critic)?;
        self.critic.adam.restore(&critic, progress.critic_steps)?;
        self.critic.moments.restore(PRIVILEGED, tensors)?;
        self.average = part(AVERAGE);
        let config = self.network.config().clone();
        self.normalizer = Normalizer::from_tensors(&part(NORMALIZER), config.features())
            .map_err(anyhow::Error::msg)?;
        let builder = VarBuilder::from_varmap(&self.vars, DType::F32, &Device::Cpu);
        self.network = EmpNetwork::new(config, self.normalizer.clone(), &builder)?;
        self.reference = progress.measured_reference;
        self.objective.set_reference(progress.loss_reference);
        self.progress = progress;
        Ok(())
    }

    /// Learns from a rollout; `imagination` is what the settings' horizon needs, if it is not 0.
    ///
    /// # Errors
    /// When a gradient is not a number.
    pub fn update(
        &mut self,
        rollout: &Rollout,
        imagination: Option<&Imagination>,
        threads: &rayon::ThreadPool,
    ) -> Result<UpdateStatistics> {
        let start = Instant::now();
        let batch = self.batch(rollout, threads)?;
        let mut rng = ChaCha8Rng::seed_from_u64(self.settings.seed);
        // Stream 0 drew the weights.
        rng.set_stream(self.progress.updates + 1);
        let mut order = Vec::new();
        let mut sums = Sums::default();
        let optimizer = self.settings.optimizer.clone();
        for update in 0..optimizer.updates {
            if order.is_empty() {
                order.clone_from(&batch.usable);
                order.shuffle(&mut rng);
            }
            let left = order.len().saturating_sub(optimizer.rows);
            let rows = order.split_off(left);
            self.step(rollout, &batch, &rows, imagination, threads, &mut sums)
                .with_context(|| format!("rollout {}, update {update}", self.progress.updates))?;
        }
        self.follow()?;
        let newest = rollout.privileged.len() - self.critic.moments.width() * rollout.environments;
        self.critic.moments.update(&rollout.privileged[newest..]);
        self.progress.updates += 1;
        self.progress.optimizer_steps = self.adam.steps();
        self.progress.critic_steps = self.critic.adam.steps();
        Ok(sums.statistics(&batch, self.progress.learning_rate, start))
    }

    /// Lets the running mean of the weights follow them.
    fn follow(&mut self) -> Result<()> {
        let kept = self.settings.optimizer.averaging;
        for (name, value) in variables::values(&self.vars)? {
            if let Some(average) = self.average.get_mut(&name) {
                *average = ((&*average * kept)? + (value * (1.0 - kept))?)?;
            }
        }
        Ok(())
    }

    /// Works out what is to be learnt from a rollout.
    fn batch(&self, rollout: &Rollout, threads: &rayon::ThreadPool) -> Result<Batch> {
        let mut usable = usable_rows(rollout, self.settings.horizon);
        let hindsight = &self.settings.hindsight;
        let mut lessons = vec![false; rollout.rows()];
        if hindsight.weight > 0.0 {
            let foreseen = rollout.foreseen(hindsight.frames);
            usable.retain(|row| foreseen[*row]);
            let before_fall =
                |periods: Option<usize>| periods.is_some_and(|n| n < hindsight.frames);
            lessons = rollout.until_fall().into_iter().map(before_fall).collect();
        }
        let risk = &self.settings.risk;
        if risk.weight == 0.0 {
            return Ok(Batch {
                usable,
                lessons,
                ..Batch::default()
            });
        }
        let normalizer = self.critic.moments.normalizer();
        let normalized = |rows: &[f32]| {
            let mut rows = rows.to_vec();
            normalizer.apply(&mut rows);
            rows
        };
        let privileged = normalized(&rollout.privileged);
        let values = self.critic.values(&privileged, threads)?;
        let mut rewards: Vec<f32> = rollout.costs.iter().map(|cost| -cost).collect();
        for (row, privileged) in &rollout.timed_out_privileged {
            // The episode would have gone on: what it would have cost counts.
            let value = self.critic.values(&normalized(privileged), threads)?[0];
            rewards[*row] += risk.discount as f32 * value;
        }
        let ended: Vec<bool> = rollout.ends.iter().map(|end| *end != End::None).collect();
        let trajectories = Trajectories {
            environments: rollout.environments,
            rewards: &rewards,
            values: &values,
            last_values: &self
                .critic
                .values(&normalized(&rollout.last_privileged), threads)?,
            ended: &ended,
        };
        let advantages = returns::advantages(&trajectories, risk.discount, risk.trace_decay);
        let returns: Vec<f32> = advantages.iter().zip(&values).map(|(a, v)| a + v).collect();
        let joints = self.layout.goal().len();
        let (samples, means) = (&rollout.samples, &rollout.means);
        Ok(Batch {
            usable,
            lessons,
            log_probabilities: ppo::log_probabilities(
                &tensor(samples, joints)?,
                &tensor(means, joints)?,
                &self.log_std()?,
            )?
            .to_vec1()?,
            explained_variance: returns::explained_variance(&returns, &advantages),
            advantages,
            returns,
            privileged,
        })
    }

    fn log_std(&self) -> candle_core::Result<Tensor> {
        let log_std = vec![self.settings.risk.std.ln() as f32; self.layout.goal().len()];
        Tensor::new(log_std, &Device::Cpu)
    }

    /// One step of the optimisers on the given rows.
    fn step(
        &mut self,
        rollout: &Rollout,
        batch: &Batch,
        rows: &[usize],
        imagination: Option<&Imagination>,
        threads: &rayon::ThreadPool,
        sums: &mut Sums,
    ) -> Result<()> {
        let shard_rows = rows.len().div_ceil(self.settings.optimizer.shards);
        let shards = threads.install(|| {
            let shards = rows.par_chunks(shard_rows);
            shards
                .map(|shard| self.shard(rollout, batch, shard, rows.len(), imagination))
                .collect::<Result<Vec<_>>>()
        })?;
        let risk = &self.settings.risk;
        let divergence = shards.iter().map(|shard| shard.divergence).sum::<f64>();
        let divergence = divergence / rows.len() as f64;
        if risk.weight > 0.0 {
            let rate = &mut self.progress.learning_rate;
            *rate = adapted_learning_rate(
                *rate,
                divergence,
                risk.target_divergence,
                self.settings.optimizer.learning_rate,
            );
        }
        sums.add(&shards, divergence);
        let gradients = shards.into_iter().map(|shard| shard.gradient);
        let gradient = add_gradients(gradients, &[&self.vars, &self.critic.vars])?;
        sums.gradient_norm += self.adam.step(&gradient, self.progress.learning_rate)?;
        if risk.weight > 0.0 {
            self.critic
                .adam
                .step(&gradient, risk.critic_learning_rate)?;
        }
        Ok(())
    }

    /// The gradient of one shard of a mini-batch of `total` rows.
    fn shard(
        &self,
        rollout: &Rollout,
        batch: &Batch,
        rows: &[usize],
        total: usize,
        imagination: Option<&Imagination>,
    ) -> Result<Shard> {
        let share = rows.len() as f64 / total as f64;
        let stacks = gather(&rollout.stacks, self.layout.width(), rows);
        let moments = self.moments(rollout, rows)?;
        let steps = match imagination {
            Some(imagination) => {
                let stacks = tensor(&stacks, self.layout.width())?;
                imagination.unroll(&self.network, &stacks, &moments.goals_ahead)?
            }
            None => vec![self.unimagined(&stacks)?],
        };
        let terms = self.objective.terms(&moments, &steps)?;
        let mut loss = (terms.total(&self.settings.losses.weights)? * share)?;
        let hindsight = self.hindsight(rollout, batch, rows, &steps[0].goal)?;
        let lesson = f64::from(hindsight.to_scalar::<f32>()?) / total as f64;
        loss = (loss + (hindsight / total as f64)?)?;
        let (mut surrogate, mut divergence) = (0.0, 0.0);
        if self.settings.risk.weight > 0.0 {
            let risk = self.risk(rollout, batch, rows, &steps[0].goal)?;
            surrogate = f64::from(risk.surrogate.to_scalar::<f32>()?) / total as f64;
            divergence = risk.divergence;
            loss = (loss + ((risk.surrogate + risk.value_error)? / total as f64)?)?;
        }
        Ok(Shard {
            gradient: loss.backward()?,
            terms: terms.means()?.map(|mean| mean * share),
            hindsight: lesson,
            risk: surrogate,
            divergence,
        })
    }

    /// What the losses look at. The smoothness loss looks back at answers, not at what was explored around them.
    fn moments(&self, rollout: &Rollout, rows: &[usize]) -> Result<Moments> {
        let layout = &self.layout;
        let joints = layout.goal().len();
        let mut stacks = gather(&rollout.stacks, layout.width(), rows);
        for (stack, &row) in stacks.chunks_exact_mut(layout.width()).zip(rows) {
            let newest = layout.newest_goal();
            for (periods, means) in (1..).zip(rollout.means_before.iter().rev()) {
                let start = newest.start - periods * layout.frame_width();
                let mean = &means[row * joints..(row + 1) * joints];
                stack[start..start + joints].copy_from_slice(mean);
            }
        }
        let ahead = (1..self.settings.horizon).map(|ahead| {
            let rows: Vec<usize> = rows
                .iter()
                .map(|row| row + ahead * rollout.environments)
                .collect();
            gathered(&rollout.goals, joints, &rows)
        });
        let [before_that, before] = &rollout.goals_before;
        Ok(Moments {
            stacks: Tensor::from_vec(stacks, (rows.len(), layout.width()), &Device::Cpu)?,
            goals_ahead: ahead.collect::<candle_core::Result<_>>()?,
            goals_before: [
                gathered(before_that, joints, rows)?,
                gathered(before, joints, rows)?,
            ],
        })
    }

    /// The EMP's answer, and the robot as it is measured.
    fn unimagined(&self, stacks: &[f32]) -> Result<ImaginedStep> {
        let layout = &self.layout;
        let features = tensor(
            &self.network.features(stacks),
            self.network.config().features(),
        )?;
        let stacks = tensor(stacks, layout.width())?;
        let newest = |part: std::ops::Range<usize>| {
            let start = layout.newest().start + part.start;
            stacks.narrow(1, start, part.len())
        };
        let goals = newest(layout.goal())?;
        let (goal, latent) = self.network.forward_features(&features, &goals)?;
        Ok(ImaginedStep {
            goal,
            latent,
            joint_positions: newest(layout.joint_positions())?,
            orientation: newest(layout.orientation())?,
        })
    }

    /// The weighted loss of hindsight, summed over the rows: distance from the goals that should have been asked for.
    fn hindsight(
        &self,
        rollout: &Rollout,
        batch: &Batch,
        rows: &[usize],
        answers: &Tensor,
    ) -> candle_core::Result<Tensor> {
        let settings = &self.settings.hindsight;
        let joints = self.layout.goal().len();
        let weight = |&row: &usize| {
            if batch.lessons[row] {
                settings.weight as f32
            } else {
                0.0
            }
        };
        let weights: Vec<f32> = rows.iter().map(weight).collect();
        let default = Tensor::new(self.default_pose.as_slice(), &Device::Cpu)?;
        let distances = gathered(&rollout.goals, joints, rows)?.broadcast_sub(&default)?;
        let wiser = (distances * settings.amplitude)?.broadcast_add(&default)?;
        let joints = Tensor::new(self.lesson_joints.as_slice(), &Device::Cpu)?;
        let errors = (answers - wiser)?.sqr()?.broadcast_mul(&joints)?.sum(1)?;
        (errors * Tensor::from_vec(weights, rows.len(), &Device::Cpu)?)?.sum_all()
    }

    /// The surrogate of the expected cost, and the critic's error.
    fn risk(
        &self,
        rollout: &Rollout,
        batch: &Batch,
        rows: &[usize],
        means: &Tensor,
    ) -> Result<Risk> {
        let risk = &self.settings.risk;
        let joints = self.layout.goal().len();
        let column =
            |values: &[f32]| Tensor::from_vec(gather(values, 1, rows), rows.len(), &Device::Cpu);
        let log_std = self.log_std()?;
        let samples = ppo::Samples {
            actions: gathered(&rollout.samples, joints, rows)?,
            log_probabilities: column(&batch.log_probabilities)?,
            advantages: column(&batch.advantages)?,
            returns: column(&batch.returns)?,
        };
        let privileged = gathered(&batch.privileged, self.critic.moments.width(), rows)?;
        let values = self.critic.network.forward(&privileged)?.flatten_all()?;
        let losses = ppo::Losses::new(&samples, means, &log_std, &values, risk.clip)?;
        let old = gather(&rollout.means, joints, rows);
        let new = means.flatten_all()?.to_vec1::<f32>()?;
        let log_std = log_std.to_vec1::<f32>()?;
        Ok(Risk {
            divergence: ppo::divergence(&old, &new, &log_std, &log_std),
            surrogate: (losses.policy * risk.weight)?,
            value_error: losses.value,
        })
    }
}

/// What a learner starts from: a rollout with goals as they were asked for.
pub struct WarmUp {
    /// Stacks of the rollout, N × width.
    stacks: Vec<f32>,
    /// Those of them that no fall follows in the rollout.
    safe_stacks: Tensor,
    privileged: Vec<f32>,
    privileged_width: usize,
    /// Where the centre of mass stands over the feet in safe frames, m.
    reference: [f64; 2],
}

impl WarmUp {
    /// What `rollout` says, whose observations are laid out as `layout` says.
    ///
    /// # Errors
    /// When the robot fell in every environment.
    pub fn new(rollout: Rollout, layout: &ObservationLayout) -> Result<Self> {
        let safe = safe_rows(&rollout);
        anyhow::ensure!(
            !safe.is_empty(),
            "the robot fell in every environment while warming up: is this its policy?"
        );
        let mean = |axis: usize| {
            let sum = safe
                .iter()
                .map(|row| f64::from(rollout.centers_of_mass[2 * row + axis]));
            sum.sum::<f64>() / safe.len() as f64
        };
        Ok(Self {
            reference: [mean(0), mean(1)],
            safe_stacks: gathered(&rollout.stacks, layout.width(), &safe)?,
            privileged_width: rollout.last_privileged.len() / rollout.environments,
            stacks: rollout.stacks,
            privileged: rollout.privileged,
        })
    }

    fn normalizer(&self, config: &EmpConfig) -> Normalizer {
        let mut features = Vec::new();
        config
            .history_map
            .apply(&config.observation, &self.stacks, &mut features);
        let mut moments = RunningMoments::new(config.features());
        moments.update(&features);
        moments.normalizer()
    }
}

impl Critic {
    fn new(inputs: usize, settings: &Settings, rng: &mut ChaCha8Rng) -> Result<Self> {
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let hidden = &settings.risk.critic_hidden;
        let network = Mlp::new(inputs, hidden, 1, &builder)?;
        variables::initialise(&vars, rng)?;
        Ok(Self {
            adam: Adam::new(&vars, AdamConfig::default())?,
            moments: RunningMoments::new(inputs),
            network,
            vars,
        })
    }

    /// Values of normalised privileged observations.
    fn values(&self, privileged: &[f32], threads: &rayon::ThreadPool) -> Result<Vec<f32>> {
        let width = self.moments.width();
        let chunk = |rows: &[f32]| -> Result<Vec<f32>> {
            let values = self.network.forward(&tensor(rows, width)?)?;
            Ok(values.flatten_all()?.to_vec1()?)
        };
        let chunks = threads.install(|| {
            let chunks = privileged.par_chunks(ROWS * width).map(chunk);
            chunks.collect::<Result<Vec<_>>>()
        })?;
        Ok(chunks.concat())
    }
}

/// What is to be learnt from a rollout; without risk only the rows.
#[derive(Default)]
struct Batch {
    /// Rows from which the horizon can be imagined, and whose future is known as far as hindsight goes.
    usable: Vec<usize>,
    /// Whether a fall follows a row so soon that hindsight counts.
    lessons: Vec<bool>,
    log_probabilities: Vec<f32>,
    advantages: Vec<f32>,
    returns: Vec<f32>,
    /// Normalised.
    privileged: Vec<f32>,
    explained_variance: f64,
}

struct Risk {
    /// Summed over the rows, weighted.
    surrogate: Tensor,
    /// Summed over the rows.
    value_error: Tensor,
    divergence: f64,
}

/// What one shard of a mini-batch adds.
struct Shard {
    gradient: GradStore,
    terms: [f64; 6],
    hindsight: f64,
    risk: f64,
    divergence: f64,
}

/// Sums over an update's mini-batches.
#[derive(Default)]
struct Sums {
    batches: f64,
    terms: [f64; 6],
    hindsight: f64,
    risk: f64,
    divergence: f64,
    gradient_norm: f64,
}

impl Sums {
    fn add(&mut self, shards: &[Shard], divergence: f64) {
        self.batches += 1.0;
        self.divergence += divergence;
        for shard in shards {
            self.hindsight += shard.hindsight;
            self.risk += shard.risk;
            for (sum, term) in self.terms.iter_mut().zip(shard.terms) {
                *sum += term;
            }
        }
    }

    fn statistics(&self, batch: &Batch, learning_rate: f64, start: Instant) -> UpdateStatistics {
        UpdateStatistics {
            terms: self.terms.map(|sum| sum / self.batches),
            hindsight: self.hindsight / self.batches,
            risk: self.risk / self.batches,
            explained_variance: batch.explained_variance,
            divergence: self.divergence / self.batches,
            gradient_norm: self.gradient_norm / self.batches,
            learning_rate,
            seconds: start.elapsed().as_secs_f64(),
        }
    }
}

/// Makes a layer's weights small and its biases zero.
fn shrink(vars: &VarMap, layer: &str) -> Result<()> {
    let vars = variables::lock(vars)?;
    for (part, gain) in [("weight", RESIDUAL_GAIN), ("bias", 0.0)] {
        let name = format!("{layer}.{part}");
        let var = vars
            .get(&name)
            .with_context(|| format!("no variable `{name}`"))?;
        var.set(&(var.as_detached_tensor() * gain)?)?;
    }
    Ok(())
}

/// Rows that are followed by `horizon` − 1 more of the same episode within the rollout.
pub(super) fn usable_rows(rollout: &Rollout, horizon: usize) -> Vec<usize> {
    let ahead = horizon.saturating_sub(1);
    let follows = |row: usize| {
        let next = row + ahead * rollout.environments;
        let periods = (row..next).step_by(rollout.environments);
        next < rollout.rows() && periods.clone().all(|row| rollout.ends[row] == End::None)
    };
    (0..rollout.rows()).filter(|&row| follows(row)).collect()
}

/// Rows of environments in which nobody fell.
fn safe_rows(rollout: &Rollout) -> Vec<usize> {
    let n = rollout.environments;
    let stood = |environment: usize| {
        let mut ends = rollout.ends[environment..].iter().step_by(n);
        ends.all(|end| matches!(end, End::None | End::TimedOut))
    };
    let safe: Vec<bool> = (0..n).map(stood).collect();
    (0..rollout.rows()).filter(|row| safe[row % n]).collect()
}

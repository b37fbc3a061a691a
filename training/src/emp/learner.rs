//! The learner of an EMP: from one rollout to the next weights.
//!
//! The loss is the paper's weighted sum of six, through imagined control periods where the settings ask for them, plus the
//! lesson of falls and contacts (see [`Hindsight`](super::hindsight::Hindsight)). Each mini-batch is cut into a fixed number of
//! shards whose gradients are added in order, so the weights have the same bits at any number of threads.

use std::{sync::Arc, time::Instant};

use anyhow::{Context as _, Result};
use candle_core::{DType, Device, Tensor, backprop::GradStore};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    checkpoint::Tensors,
    emp::{EmpConfig, EmpNetwork, Output},
    mlp::Normalizer,
    observation::ObservationLayout,
    optimizer::{Adam, AdamConfig},
};
use emp_robot::Robot;
use emp_sim::End;
use rand::{SeedableRng as _, seq::SliceRandom as _};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    hindsight::{Label, Labels},
    imagination::{Imagination, ImaginedStep},
    memory::Memory,
    objective::{Objective, StateBatch},
    rollout::EmpRollout,
    settings::EmpSettings,
};
use crate::{
    policy::moments::RunningMoments,
    rows::{add_gradients, gather, gathered, tensor},
    variables,
};

/// A residual EMP starts this near to leaving goals as they are.
const RESIDUAL_GAIN: f64 = 0.01;

/// Names in a checkpoint.
const EMP: &str = "emp";
const AVERAGE: &str = "average";
const NORMALIZER: &str = "emp-normalizer";

/// Learns an EMP from rollouts.
pub struct Learner {
    settings: EmpSettings,
    layout: ObservationLayout,
    network: EmpNetwork,
    normalizer: Normalizer,
    vars: VarMap,
    adam: Adam,
    /// Running mean of the EMP's weights.
    average: Tensors,
    memory: Memory,
    objective: Objective,
    progress: Progress,
}

/// What a learner counts, and what it measured once.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Updates made.
    pub updates: u64,
    /// Steps of the EMP's optimiser.
    pub optimizer_steps: u64,
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
    /// Mean norm of the EMP's gradient before it was bounded.
    pub gradient_norm: f64,
    /// Seconds that it took.
    pub seconds: f64,
}

impl Learner {
    /// A learner with random weights. Normalisation and operating points follow from `warm_up`, a rollout with goals as they were
    /// asked for.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(robot: &Arc<Robot>, settings: &EmpSettings, warm_up: &WarmUp) -> Result<Self> {
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
        Ok(Self {
            progress: Progress {
                updates: 0,
                optimizer_steps: 0,
                measured_reference: warm_up.reference,
                loss_reference,
            },
            settings: settings.clone(),
            layout,
            average: variables::values(&vars)?,
            memory: Memory::new(
                settings.hindsight.memory,
                network.config().features(),
                layout.goal().len(),
            ),
            network,
            normalizer,
            vars,
            adam,
            objective,
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
        self.progress.measured_reference
    }

    /// Weights, moments and the optimisers' state, for a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn state(&self) -> Result<Tensors> {
        let mut tensors = Tensors::new();
        let parts = variables::values(&self.vars)?
            .into_iter()
            .chain(self.adam.state()?);
        tensors.extend(parts.map(|(name, tensor)| (format!("{EMP}/{name}"), tensor)));
        for (name, tensor) in self.normalizer.tensors()? {
            tensors.insert(format!("{NORMALIZER}/{name}"), tensor);
        }
        for (name, tensor) in &self.average {
            tensors.insert(format!("{AVERAGE}/{name}"), tensor.clone());
        }
        self.memory.save(&mut tensors)?;
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
        self.memory.restore(tensors)?;
        self.average = part(AVERAGE);
        let config = self.network.config().clone();
        self.normalizer = Normalizer::from_tensors(&part(NORMALIZER), config.features())
            .map_err(anyhow::Error::msg)?;
        let builder = VarBuilder::from_varmap(&self.vars, DType::F32, &Device::Cpu);
        self.network = EmpNetwork::new(config, self.normalizer.clone(), &builder)?;
        self.objective.set_reference(progress.loss_reference);
        self.progress = progress;
        Ok(())
    }

    /// Learns from a rollout; `labels` are what hindsight says of it, `imagination` what the settings' horizon needs, if it is
    /// not 0.
    ///
    /// # Errors
    /// When a gradient is not a number.
    pub fn update(
        &mut self,
        rollout: &EmpRollout,
        labels: Option<&Labels>,
        imagination: Option<&Imagination>,
        threads: &rayon::ThreadPool,
    ) -> Result<UpdateStatistics> {
        let start = Instant::now();
        if let Some(labels) = labels {
            self.memory
                .add(rollout, labels, &self.network, &self.layout);
        }
        let usable = usable_rows(rollout, self.settings.horizon);
        let source = Source {
            rollout,
            labels,
            imagination,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(self.settings.seed);
        // Stream 0 drew the weights.
        rng.set_stream(self.progress.updates + 1);
        let mut order = Vec::new();
        let mut sums = Sums::default();
        let optimizer = self.settings.optimizer.clone();
        for update in 0..optimizer.updates {
            if order.is_empty() {
                order.clone_from(&usable);
                order.shuffle(&mut rng);
            }
            let left = order.len().saturating_sub(optimizer.rows);
            let rows = MiniBatch {
                rows: order.split_off(left),
                lessons: self.memory.draw(self.settings.hindsight.rows, &mut rng),
            };
            self.step(&source, &rows, threads, &mut sums)
                .with_context(|| format!("rollout {}, update {update}", self.progress.updates))?;
        }
        self.follow()?;
        self.progress.updates += 1;
        self.progress.optimizer_steps = self.adam.steps();
        Ok(sums.statistics(start))
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

    /// One step of the optimiser on the given rows.
    fn step(
        &mut self,
        source: &Source<'_>,
        mini_batch: &MiniBatch,
        threads: &rayon::ThreadPool,
        sums: &mut Sums,
    ) -> Result<()> {
        let count = mini_batch.shards(self.settings.optimizer.shards);
        let shards = threads.install(|| {
            let shards = (0..count).into_par_iter().map(|shard| {
                let part = mini_batch.part(shard, count);
                self.shard(source, &part, mini_batch)
            });
            shards.collect::<Result<Vec<_>>>()
        })?;
        sums.add(&shards);
        let gradients = shards.into_iter().map(|shard| shard.gradient);
        let gradient = add_gradients(gradients, &[&self.vars])?;
        let rate = self.settings.optimizer.learning_rate;
        sums.gradient_norm += self.adam.step(&gradient, rate)?;
        Ok(())
    }

    /// The gradient of one shard, a part of a mini-batch.
    fn shard(&self, source: &Source<'_>, part: &MiniBatch, whole: &MiniBatch) -> Result<Shard> {
        let (rows, rollout) = (&part.rows, source.rollout);
        let share = rows.len() as f64 / whole.rows.len() as f64;
        let stacks = gather(&rollout.stacks, self.layout.width(), rows);
        let states = self.states(rollout, rows)?;
        let steps = match source.imagination {
            Some(imagination) => {
                let stacks = tensor(&stacks, self.layout.width())?;
                imagination.unroll(&self.network, &stacks, &states.goals_ahead)?
            }
            None => vec![self.unimagined(&stacks)?],
        };
        let mut terms = self.objective.terms(&states, &steps)?;
        if let Some(labels) = source.labels {
            let right = labelled(labels, rows, Label::Right)?.repeat(steps.len())?;
            terms.reconstruction = (&terms.reconstruction * right)?;
        }
        let mut loss = (terms.total(&self.settings.losses.weights)? * share)?;
        let mut lesson = 0.0;
        if let Some(labels) = source.labels {
            let contacts = self.contacts(labels, rows, &steps[0].goal)?;
            let contacts = (contacts / whole.rows.len() as f64)?;
            lesson += f64::from(contacts.to_scalar::<f32>()?);
            loss = (loss + contacts)?;
        }
        if !part.lessons.is_empty() {
            let hindsight = (self.falls(&part.lessons)? / whole.lessons.len() as f64)?;
            lesson += f64::from(hindsight.to_scalar::<f32>()?);
            loss = (loss + hindsight)?;
        }
        Ok(Shard {
            gradient: loss.backward()?,
            terms: terms.means()?.map(|mean| mean * share),
            hindsight: lesson,
        })
    }

    /// What the losses look at. The smoothness loss looks back at answers, not at what was executed of them.
    fn states(&self, rollout: &EmpRollout, rows: &[usize]) -> Result<StateBatch> {
        let layout = &self.layout;
        let joints = layout.goal().len();
        let mut stacks = gather(&rollout.stacks, layout.width(), rows);
        for (stack, &row) in stacks.chunks_exact_mut(layout.width()).zip(rows) {
            let newest = layout.newest_goal();
            for (periods, answers) in (1..).zip(rollout.answers_before.iter().rev()) {
                let start = newest.start - periods * layout.frame_width();
                let answer = &answers[row * joints..(row + 1) * joints];
                stack[start..start + joints].copy_from_slice(answer);
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
        Ok(StateBatch {
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

    /// The weighted lesson of falls, summed over remembered rows: distance from the goals that should have been executed. It
    /// weighs as much as if such rows were as frequent as in rollouts.
    fn falls(&self, rows: &[usize]) -> candle_core::Result<Tensor> {
        let lessons = self.memory.lessons(rows)?;
        let (answers, _) = self
            .network
            .forward_features(&lessons.features, &lessons.goals)?;
        let errors = (answers - lessons.targets)?;
        let errors = self.settings.losses.distance.of(&errors)?.sum_all()?;
        errors * (self.settings.hindsight.weight * self.memory.share())
    }

    /// The weighted lesson of contacts, summed over rows of the rollout.
    fn contacts(
        &self,
        labels: &Labels,
        rows: &[usize],
        answers: &Tensor,
    ) -> candle_core::Result<Tensor> {
        let targets = gathered(&labels.targets, self.layout.goal().len(), rows)?;
        let errors = self.settings.losses.distance.of(&(answers - targets)?)?;
        let touches = labelled(labels, rows, Label::Touches)?;
        (errors * touches)?.sum_all()? * self.settings.hindsight.contact_weight
    }
}

/// What a learner starts from: a rollout with goals as they were asked for.
pub struct WarmUp {
    /// Stacks of the rollout, N × width.
    stacks: Vec<f32>,
    /// Those of them that no fall follows in the rollout.
    safe_stacks: Tensor,
    /// Where the centre of mass stands over the feet in safe frames, m.
    reference: [f64; 2],
}

impl WarmUp {
    /// What `rollout` says, whose observations are laid out as `layout` says.
    ///
    /// # Errors
    /// When the robot fell in every environment.
    pub fn new(rollout: EmpRollout, layout: &ObservationLayout) -> Result<Self> {
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
            stacks: rollout.stacks,
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

/// What is learnt from.
struct Source<'a> {
    rollout: &'a EmpRollout,
    /// What hindsight says of the rows.
    labels: Option<&'a Labels>,
    imagination: Option<&'a Imagination>,
}

/// Rows of a step of the optimiser.
struct MiniBatch {
    /// Of the rollout.
    rows: Vec<usize>,
    /// Of the memory.
    lessons: Vec<usize>,
}

impl MiniBatch {
    /// How many parts it is cut into, `most` at most: none is without rows, whose mean is no number.
    fn shards(&self, most: usize) -> usize {
        most.min(self.rows.len())
    }

    /// One of `count` parts.
    fn part(&self, part: usize, count: usize) -> Self {
        let slice = |rows: &[usize]| {
            let [start, end] = [part, part + 1].map(|part| part * rows.len() / count);
            rows[start..end].to_vec()
        };
        Self {
            rows: slice(&self.rows),
            lessons: slice(&self.lessons),
        }
    }
}

/// What one shard of a mini-batch adds.
struct Shard {
    gradient: GradStore,
    terms: [f64; 6],
    hindsight: f64,
}

/// Sums over an update's mini-batches.
#[derive(Default)]
struct Sums {
    batches: f64,
    terms: [f64; 6],
    hindsight: f64,
    gradient_norm: f64,
}

impl Sums {
    fn add(&mut self, shards: &[Shard]) {
        self.batches += 1.0;
        for shard in shards {
            self.hindsight += shard.hindsight;
            for (sum, term) in self.terms.iter_mut().zip(shard.terms) {
                *sum += term;
            }
        }
    }

    fn statistics(&self, start: Instant) -> UpdateStatistics {
        UpdateStatistics {
            terms: self.terms.map(|sum| sum / self.batches),
            hindsight: self.hindsight / self.batches,
            gradient_norm: self.gradient_norm / self.batches,
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

/// 1 for the rows with this label, else 0.
fn labelled(labels: &Labels, rows: &[usize], label: Label) -> candle_core::Result<Tensor> {
    let rows = rows
        .iter()
        .map(|&row| f32::from(u8::from(labels.labels[row] == label)));
    Tensor::from_iter(rows, &Device::Cpu)
}

/// Rows that are followed by `horizon` − 1 more of the same episode within the rollout.
pub(super) fn usable_rows(rollout: &EmpRollout, horizon: usize) -> Vec<usize> {
    let ahead = horizon.saturating_sub(1);
    let follows = |row: usize| {
        let next = row + ahead * rollout.environments;
        let periods = (row..next).step_by(rollout.environments);
        next < rollout.rows() && periods.clone().all(|row| rollout.ends[row] == End::None)
    };
    (0..rollout.rows()).filter(|&row| follows(row)).collect()
}

/// Rows of environments in which nobody fell.
fn safe_rows(rollout: &EmpRollout) -> Vec<usize> {
    let n = rollout.environments;
    let stood = |environment: usize| {
        let mut ends = rollout.ends[environment..].iter().step_by(n);
        ends.all(|end| matches!(end, End::None | End::TimedOut))
    };
    let safe: Vec<bool> = (0..n).map(stood).collect();
    (0..rollout.rows()).filter(|row| safe[row % n]).collect()
}

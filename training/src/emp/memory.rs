//! The lessons of falls in earlier rollouts. They are rare, and stay true: they are learnt from more than once.

use std::iter;

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use emp_models::{checkpoint::Tensors, emp::EmpNetwork, observation::ObservationLayout};
use rand::{Rng, RngExt as _};

use super::{
    hindsight::{Label, Labels},
    rollout::EmpRollout,
};
use crate::rows::{gather, gathered};

/// Rollouts over which the share of lessons is averaged.
const AVERAGED: u64 = 40;

/// Prefix of its tensors in a checkpoint.
const PREFIX: &str = "memory";

/// Rows whose goals had to be changed against a fall: what the EMP saw, and what it should have answered. The oldest make room for new ones.
#[derive(Debug)]
pub struct Memory {
    capacity: usize,
    /// Features, goals as asked for, goals as they should have been.
    parts: [Part; 3],
    /// Row to be written next.
    next: usize,
    /// Share of such rows, averaged over rollouts.
    share: f64,
    rollouts: u64,
}

#[derive(Debug)]
struct Part {
    name: &'static str,
    width: usize,
    values: Vec<f32>,
}

/// Lessons, N rows each.
pub struct Lessons {
    /// Features of the EMP.
    pub features: Tensor,
    /// Goals as they were asked for, rad.
    pub goals: Tensor,
    /// Goals as they should have been executed, rad.
    pub targets: Tensor,
}

impl Memory {
    /// An empty memory of at most `capacity` rows of `features` numbers and `joints` goal angles.
    pub fn new(capacity: usize, features: usize, joints: usize) -> Self {
        let part = |name, width| Part {
            name,
            width,
            values: Vec::new(),
        };
        Self {
            capacity,
            parts: [
                part("features", features),
                part("goals", joints),
                part("targets", joints),
            ],
            next: 0,
            share: 0.0,
            rollouts: 0,
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.parts[0].values.len() / self.parts[0].width
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Share of a rollout's rows whose goals had to be changed against a fall, averaged over rollouts.
    pub fn share(&self) -> f64 {
        self.share
    }

    /// Remembers what hindsight says of a rollout.
    pub fn add(
        &mut self,
        rollout: &EmpRollout,
        labels: &Labels,
        network: &EmpNetwork,
        layout: &ObservationLayout,
    ) {
        let rows: Vec<usize> = (0..rollout.rows())
            .filter(|&row| labels.labels[row] == Label::Falls)
            .collect();
        let share = rows.len() as f64 / rollout.rows().max(1) as f64;
        self.rollouts += 1;
        self.share += (share - self.share) / self.rollouts.min(AVERAGED) as f64;
        let stacks = gather(&rollout.stacks, layout.width(), &rows);
        let joints = layout.goal().len();
        let columns = [
            network.features(&stacks),
            gather(&rollout.goals, joints, &rows),
            gather(&labels.targets, joints, &rows),
        ];
        for row in 0..rows.len() {
            for (part, values) in self.parts.iter_mut().zip(&columns) {
                part.set(self.next, &values[row * part.width..(row + 1) * part.width]);
            }
            self.next = (self.next + 1) % self.capacity;
        }
    }

    /// Any `rows` rows.
    pub fn draw(&self, rows: usize, rng: &mut impl Rng) -> Vec<usize> {
        let rows = if self.is_empty() { 0 } else { rows };
        let draws = iter::repeat_with(|| rng.random_range(0..self.len()));
        draws.take(rows).collect()
    }

    /// The rows with these numbers.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn lessons(&self, rows: &[usize]) -> candle_core::Result<Lessons> {
        let [features, goals, targets] = &self.parts;
        let gathered = |part: &Part| gathered(&part.values, part.width, rows);
        Ok(Lessons {
            features: gathered(features)?,
            goals: gathered(goals)?,
            targets: gathered(targets)?,
        })
    }

    /// Everything, for a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn save(&self, tensors: &mut Tensors) -> Result<()> {
        for part in &self.parts {
            let values = Tensor::new(part.values.as_slice(), &Device::Cpu)?;
            tensors.insert(format!("{PREFIX}.{}", part.name), values);
        }
        let counts = [self.next as f64, self.share, self.rollouts as f64];
        let counts = Tensor::new(&counts, &Device::Cpu)?;
        tensors.insert(format!("{PREFIX}.counts"), counts);
        Ok(())
    }

    /// Reads what [`save`](Self::save) wrote.
    ///
    /// # Errors
    /// When a tensor is missing or does not fit.
    pub fn restore(&mut self, tensors: &Tensors) -> Result<()> {
        let tensor = |name: &str| {
            let name = format!("{PREFIX}.{name}");
            tensors
                .get(&name)
                .with_context(|| format!("no tensor `{name}`"))
        };
        for part in &mut self.parts {
            part.values = tensor(part.name)?.to_vec1()?;
        }
        let rows = self.len();
        ensure!(
            rows <= self.capacity
                && self
                    .parts
                    .iter()
                    .all(|part| part.values.len() == rows * part.width),
            "the memory's tensors do not fit one another or its capacity, {}",
            self.capacity
        );
        let counts: Vec<f64> = tensor("counts")?.to_vec1()?;
        let [next, share, rollouts] = counts[..] else {
            anyhow::bail!(
                "tensor `{PREFIX}.counts`: expected 3 numbers, got {}",
                counts.len()
            );
        };
        ensure!(
            (0.0..=rows as f64).contains(&next) && next < self.capacity as f64,
            "tensor `{PREFIX}.counts`: row {next} of {rows} cannot be the next"
        );
        self.next = next as usize;
        self.share = share;
        self.rollouts = rollouts as u64;
        Ok(())
    }
}

impl Part {
    /// Writes a row, at most one beyond the last.
    fn set(&mut self, row: usize, values: &[f32]) {
        let start = row * self.width;
        if start == self.values.len() {
            self.values.extend_from_slice(values);
        } else {
            self.values[start..start + self.width].copy_from_slice(values);
        }
    }
}

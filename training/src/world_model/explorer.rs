//! Robots on many clips, whose goals wander a little from what is asked for.

use anyhow::Result;
use emp_sim::tracking::TrackingEnvironments;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};

use super::replay::Replay;

/// What the noise's generators have in their seed beside the environments' seed.
const NOISE: u64 = 0x776d_5f6e_6f69_7365;

/// Share of the noise that is left after a control period: it lasts about a fifth of a second.
const LEFT: f32 = 0.9;

/// Environments with noise on their goals.
pub struct Explorer {
    environments: TrackingEnvironments,
    wanderers: Vec<Wanderer>,
    /// Largest standard deviation, rad.
    noise: f64,
}

/// The noise of one environment.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Wanderer {
    rng: ChaCha8Rng,
    /// Standard deviation in this episode, rad.
    deviation: f32,
    offset: Vec<f32>,
}

impl Wanderer {
    fn new(seed: u64, number: u64, joints: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ NOISE);
        rng.set_stream(number);
        Self {
            rng,
            deviation: 0.0,
            offset: vec![0.0; joints],
        }
    }

    /// Begins an episode without an offset and with a deviation of its own.
    fn restart(&mut self, largest: f64) {
        self.deviation = (largest * self.rng.random::<f64>()) as f32;
        self.offset.fill(0.0);
    }

    fn step(&mut self) {
        let drawn = self.deviation * (1.0 - LEFT * LEFT).sqrt();
        for offset in &mut self.offset {
            let normal: f32 = StandardNormal.sample(&mut self.rng);
            *offset = LEFT * *offset + drawn * normal;
        }
    }
}

impl Explorer {
    /// An explorer of `environments`, whose goals wander with a standard deviation of up to `noise`, rad, drawn for each
    /// episode.
    pub fn new(environments: TrackingEnvironments, noise: f64, seed: u64) -> Self {
        let joints = environments.layout().goal().len();
        let wanderers = 0..environments.len() as u64;
        Self {
            wanderers: wanderers.map(|n| Wanderer::new(seed, n, joints)).collect(),
            noise,
            environments,
        }
    }

    /// Runs the environments for `frames` control periods, which `replay` keeps.
    ///
    /// # Errors
    /// If the policy fails.
    pub fn collect(&mut self, frames: usize, replay: &mut Replay) -> Result<()> {
        for _ in 0..frames {
            let executed = self.executed();
            replay.step(&mut self.environments, &executed)?;
        }
        replay.cut();
        Ok(())
    }

    /// The goals that are asked for, and the noise, inside the joints' ranges.
    fn executed(&mut self) -> Vec<f32> {
        let mut goals = self.environments.goals().to_vec();
        let robot = self.environments.robot();
        let rows = goals.chunks_exact_mut(robot.goal_joints().len());
        let starts = self.environments.starts();
        for ((goal, wanderer), &start) in rows.zip(&mut self.wanderers).zip(starts) {
            if start {
                wanderer.restart(self.noise);
            }
            wanderer.step();
            for (angle, offset) in goal.iter_mut().zip(&wanderer.offset) {
                *angle += offset;
            }
            robot.clamp_goal(goal);
        }
        goals
    }

    /// Everything that later control periods depend on.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>> {
        Ok(postcard::to_stdvec(&(
            self.environments.snapshot()?,
            &self.wanderers,
        ))?)
    }

    /// Goes on from a snapshot of an explorer with the same settings, bit for bit.
    ///
    /// # Errors
    /// If it is not a snapshot of such an explorer.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<()> {
        let (environments, wanderers): (Vec<u8>, _) = postcard::from_bytes(snapshot)?;
        self.environments.restore(&environments)?;
        self.wanderers = wanderers;
        Ok(())
    }
}

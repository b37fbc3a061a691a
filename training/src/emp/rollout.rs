//! Rollouts of an EMP: what it saw, what it answered, what came of it.

use anyhow::Result;
use candle_core::{Device, Tensor};
use emp_models::emp::EmpNetwork;
use emp_sim::{
    End,
    tracking::{TrackingEnvironments, TrackingStep},
};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{losses, settings::RiskSettings};

/// What the exploration noise's generators have in their seed beside the environments' seed.
const NOISE: u64 = 0x656d_705f_6e6f;

/// Rows of a forward pass. Fixed: the last bits of an answer may depend on the size of its batch.
const ROWS: usize = 64;

/// Past periods that the smoothness loss reads.
const PAST: usize = 2;

/// Trajectories of N environments over T control periods; row t·N + n is period t of environment n.
#[derive(Debug, Default)]
pub struct Rollout {
    /// N.
    pub environments: usize,
    /// Stacks `S_t` with the goal that was asked for in the newest frame.
    pub stacks: Vec<f32>,
    /// Goals that were asked for.
    pub goals: Vec<f32>,
    /// What the EMP answered, not held inside the joints' ranges.
    pub means: Vec<f32>,
    /// What was drawn around it, without what stays of earlier exploration.
    pub samples: Vec<f32>,
    /// Goals that were asked for two periods ago, and one. At an episode's start: the present one.
    pub goals_before: [Vec<f32>; PAST],
    /// What the EMP answered two periods ago, and one. At an episode's start: the present goal.
    pub means_before: [Vec<f32>; PAST],
    /// Leg actions.
    pub actions: Vec<f32>,
    /// Joint positions and roll, pitch, yaw of the next frame, before any reset.
    pub next: Vec<f32>,
    /// Privileged observations.
    pub privileged: Vec<f32>,
    /// Privileged observations after the last period, N rows.
    pub last_privileged: Vec<f32>,
    /// Horizontal way from the middle between the feet to the measured centre of mass after each period, m.
    pub centers_of_mass: Vec<f32>,
    /// Cost of each period.
    pub costs: Vec<f32>,
    /// How the periods ended.
    pub ends: Vec<End>,
    /// Rows in which an episode timed out, each with the privileged observation at its end.
    pub timed_out_privileged: Vec<(usize, Vec<f32>)>,
    /// Sums of the terms of the cost over the rows.
    pub sums: CostSums,
}

/// Sums of what costs are made of, unweighted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CostSums {
    /// Falls.
    pub falls: f64,
    /// `L_ori` of the measured base.
    pub orientation: f64,
    /// The positive part of `L_cen` of the measured centre of mass.
    pub centroid: f64,
    /// Force between the robot's own links, N.
    pub contact: f64,
}

/// What a period costs.
#[derive(Clone, Copy, Debug)]
pub struct Cost<'a> {
    /// The weights.
    pub settings: &'a RiskSettings,
    /// The policy's operating point: offset of the centre of mass from the middle of the feet, m.
    pub reference: [f64; 2],
}

impl Cost<'_> {
    /// Cost of period `n` of a step, whose parts are added to `sums`.
    fn of(&self, step: &TrackingStep<'_>, n: usize, sums: &mut CostSums) -> f32 {
        let pair = |values: &[f32]| [0, 1].map(|i| f64::from(values[2 * n + i]));
        let [x, y] = pair(step.gravity);
        let orientation = 1.0 - (-(x * x + y * y)).exp();
        let [forward, left] = pair(step.com);
        let distance = (forward - self.reference[0]).hypot(left - self.reference[1]);
        let centroid = losses::centroid_of(distance).max(0.0);
        let contact = f64::from(step.contact[n]);
        let fall = f64::from(u8::from(step.ends[n] == End::Terminated));
        sums.falls += fall;
        sums.orientation += orientation;
        sums.centroid += centroid;
        sums.contact += contact;
        let settings = self.settings;
        (settings.fall * fall
            + settings.orientation * orientation
            + settings.centroid * centroid
            + settings.contact * contact / 100.0) as f32
    }
}

/// Environments in which an EMP is explored.
pub struct Explorer {
    environments: TrackingEnvironments,
    /// Of each goal joint, rad.
    ranges: Vec<[f32; 2]>,
    noise: Vec<Noise>,
    past: Past,
}

/// Exploration of one environment: noise that stays for a while.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Noise {
    rng: ChaCha8Rng,
    /// What was added to each goal joint in the last control period, rad.
    lasting: Vec<f32>,
}

/// How an EMP is explored.
#[derive(Clone, Copy, Debug, Default)]
pub struct Exploration {
    /// Standard deviation of what is new in a control period, rad.
    pub std: f64,
    /// Share of the noise of one control period that stays in the next.
    pub persistence: f64,
}

impl Noise {
    /// Adds noise to a row of answers: what is new to `sample`, what stays too to `executed`.
    fn explore(&mut self, exploration: Exploration, sample: &mut [f32], executed: &mut [f32]) {
        if exploration.std == 0.0 {
            return;
        }
        let rows = sample.iter_mut().zip(executed).zip(&mut self.lasting);
        for ((sample, executed), lasting) in rows {
            let normal: f32 = StandardNormal.sample(&mut self.rng);
            let new = exploration.std as f32 * normal;
            *lasting = exploration.persistence as f32 * *lasting + new;
            *sample += new;
            *executed += *lasting;
        }
    }
}

/// What was asked for and answered two periods ago, and one; N rows each.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Past {
    goals: [Vec<f32>; PAST],
    means: [Vec<f32>; PAST],
}

impl Past {
    fn new(numbers: usize) -> Self {
        let zeros = || [vec![0.0; numbers], vec![0.0; numbers]];
        Self {
            goals: zeros(),
            means: zeros(),
        }
    }

    /// At an episode's start there is no past: the goal was asked for and executed all along.
    fn start(&mut self, starts: &[bool], goals: &[f32]) {
        let width = goals.len() / starts.len().max(1);
        for (n, _) in starts.iter().enumerate().filter(|(_, start)| **start) {
            let row = n * width..(n + 1) * width;
            for past in self.goals.iter_mut().chain(&mut self.means) {
                past[row.clone()].copy_from_slice(&goals[row.clone()]);
            }
        }
    }

    fn push(&mut self, goals: &[f32], means: &[f32]) {
        for (past, now) in [(&mut self.goals, goals), (&mut self.means, means)] {
            past.swap(0, 1);
            past[1].copy_from_slice(now);
        }
    }
}

impl Explorer {
    /// An explorer of `environments`; `seed` is that of the noise.
    pub fn new(environments: TrackingEnvironments, seed: u64) -> Self {
        let joints = environments.robot().goal_joints();
        let noise = (0..environments.len() as u64).map(|number| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed ^ NOISE);
            rng.set_stream(number);
            Noise {
                rng,
                lasting: vec![0.0; joints.len()],
            }
        });
        let ranges = joints
            .iter()
            .map(|joint| joint.range.map(|limit| limit as f32));
        Self {
            ranges: ranges.collect(),
            noise: noise.collect(),
            past: Past::new(environments.goals().len()),
            environments,
        }
    }

    /// The environments.
    pub fn environments(&self) -> &TrackingEnvironments {
        &self.environments
    }

    /// Runs the environments for `frames` control periods. Goals are `network`'s answers (without one, those that are asked
    /// for) plus normal noise. Forward passes run on `threads`.
    ///
    /// # Errors
    /// When the network or the simulation fails.
    pub fn collect(
        &mut self,
        network: Option<&EmpNetwork>,
        exploration: Exploration,
        frames: usize,
        cost: &Cost<'_>,
        threads: &rayon::ThreadPool,
    ) -> Result<Rollout> {
        let mut rollout = Rollout {
            environments: self.environments.len(),
            ..Rollout::default()
        };
        for t in 0..frames {
            let goals = self.environments.goals().to_vec();
            self.past.start(self.environments.starts(), &goals);
            let means = match network {
                Some(network) => answers(network, &self.environments, threads)?,
                None => goals.clone(),
            };
            let (samples, executed) = self.explore(exploration, &means);
            let environments = &self.environments;
            rollout
                .stacks
                .extend_from_slice(environments.observations());
            let privileged = environments.privileged();
            rollout.privileged.extend_from_slice(privileged);
            for (all, past) in rollout.goals_before.iter_mut().zip(&self.past.goals) {
                all.extend_from_slice(past);
            }
            for (all, past) in rollout.means_before.iter_mut().zip(&self.past.means) {
                all.extend_from_slice(past);
            }
            self.past.push(&goals, &means);
            let step = self.environments.step(&inside(&executed, &self.ranges))?;
            rollout.add(t, &step, cost);
            rollout.goals.extend_from_slice(&goals);
            rollout.means.extend_from_slice(&means);
            rollout.samples.extend_from_slice(&samples);
        }
        rollout
            .last_privileged
            .extend_from_slice(self.environments.privileged());
        Ok(rollout)
    }

    /// Answers with what is new in their noise, and with all of it. Noise does not outlast an episode.
    fn explore(&mut self, exploration: Exploration, means: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut samples, mut executed) = (means.to_vec(), means.to_vec());
        let width = self.ranges.len();
        let rows = samples
            .chunks_exact_mut(width)
            .zip(executed.chunks_exact_mut(width));
        let robots = self.noise.iter_mut().zip(self.environments.starts());
        for ((sample, executed), (noise, start)) in rows.zip(robots) {
            if *start {
                noise.lasting.fill(0.0);
            }
            noise.explore(exploration, sample, executed);
        }
        (samples, executed)
    }

    /// Everything that later rollouts depend on, but for the network.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>> {
        let parts = (self.environments.snapshot()?, &self.noise, &self.past);
        Ok(postcard::to_stdvec(&parts)?)
    }

    /// Goes on from a snapshot of an explorer with the same settings, bit for bit.
    ///
    /// # Errors
    /// When it is no such snapshot.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<()> {
        let (environments, noise, past): (Vec<u8>, _, _) = postcard::from_bytes(snapshot)?;
        self.environments.restore(&environments)?;
        (self.noise, self.past) = (noise, past);
        Ok(())
    }
}

impl Rollout {
    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.ends.len()
    }

    /// How many control periods after each row the robot falls, 0 for the row of the fall itself; none where it does not within
    /// the episode, and within the rollout.
    pub fn until_fall(&self) -> Vec<Option<usize>> {
        let mut until = vec![None; self.rows()];
        for row in (0..self.rows()).rev() {
            until[row] = match self.ends[row] {
                End::Terminated => Some(0),
                End::None => {
                    let next = until.get(row + self.environments).copied().flatten();
                    next.map(|periods| periods + 1)
                }
                End::TimedOut | End::Diverged => None,
            };
        }
        until
    }

    /// Rows of which it is known what follows in the next `periods` control periods, or to the episode's end.
    pub fn foreseen(&self, periods: usize) -> Vec<bool> {
        let n = self.environments;
        let mut ends = vec![false; self.rows()];
        for row in (0..self.rows()).rev() {
            let later = ends.get(row + n).copied().unwrap_or(false);
            ends[row] = self.ends[row] != End::None || later;
        }
        let rows = (0..self.rows()).map(|row| ends[row] || row + periods * n < self.rows());
        rows.collect()
    }

    /// Number of episodes that ended.
    pub fn episodes(&self) -> usize {
        self.ends.iter().filter(|end| **end != End::None).count()
    }

    fn add(&mut self, t: usize, step: &TrackingStep<'_>, cost: &Cost<'_>) {
        self.actions.extend_from_slice(step.actions);
        self.next.extend_from_slice(step.next);
        self.centers_of_mass.extend_from_slice(step.com);
        let width = step.final_privileged.len() / step.ends.len().max(1);
        for (n, (&end, privileged)) in step
            .ends
            .iter()
            .zip(step.final_privileged.chunks_exact(width))
            .enumerate()
        {
            self.costs.push(cost.of(step, n, &mut self.sums));
            if end == End::TimedOut {
                let row = t * self.environments + n;
                self.timed_out_privileged.push((row, privileged.to_vec()));
            }
        }
        self.ends.extend_from_slice(step.ends);
    }
}

/// What `network` answers to every environment, in batches of fixed size.
fn answers(
    network: &EmpNetwork,
    environments: &TrackingEnvironments,
    threads: &rayon::ThreadPool,
) -> Result<Vec<f32>> {
    let width = network.config().observation.width();
    let joints = network.config().observation.goal().len();
    let inputs = network.config().features();
    let stacks = environments.observations().par_chunks(ROWS * width);
    let goals = environments.goals().par_chunks(ROWS * joints);
    let answers = threads.install(|| {
        let batches = stacks.zip(goals).map(|(stacks, goals)| {
            let rows = goals.len() / joints;
            let features = network.features(stacks);
            let features = Tensor::from_vec(features, (rows, inputs), &Device::Cpu)?;
            let goals = Tensor::from_slice(goals, (rows, joints), &Device::Cpu)?;
            let (executable, _) = network.forward_features(&features, &goals)?;
            executable.flatten_all()?.to_vec1::<f32>()
        });
        batches.collect::<candle_core::Result<Vec<_>>>()
    })?;
    Ok(answers.concat())
}

/// Rows of goals, held inside the joints' ranges.
fn inside(goals: &[f32], ranges: &[[f32; 2]]) -> Vec<f32> {
    let angles = goals.iter().zip(ranges.iter().cycle());
    angles
        .map(|(angle, [lower, upper])| angle.clamp(*lower, *upper))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_a_row_is_known_within_its_episode_and_the_rollout() {
        // Two environments, four periods: the first falls in the third, the second's episode times out in the second.
        let mut rollout = Rollout {
            environments: 2,
            ..Rollout::default()
        };
        rollout.ends = vec![End::None; 8];
        rollout.ends[4] = End::Terminated;
        rollout.ends[3] = End::TimedOut;
        let until = rollout.until_fall();
        let expected = [Some(2), None, Some(1), None, Some(0), None, None, None];
        assert_eq!(until, expected);
        let foreseen = rollout.foreseen(2);
        // Two periods on, the rows of the last two periods are beyond the rollout, but for the episode that ends.
        let expected = [true, true, true, true, true, false, false, false];
        assert_eq!(foreseen, expected);
    }
}

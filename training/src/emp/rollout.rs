//! Rollouts of an EMP: what it saw, what it answered, what came of it.

use anyhow::Result;
use candle_core::{Device, Tensor};
use emp_models::emp::EmpNetwork;
use emp_sim::{
    End,
    tracking::{TrackingEnvironments, TrackingState, TrackingStep},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Rows of a forward pass. Fixed: the last bits of an answer may depend on the size of its batch.
const ROWS: usize = 64;

/// Past periods that the smoothness loss reads.
const PAST: usize = 2;

/// Trajectories of N environments over T control periods; row t·N + n is period t of environment n.
#[derive(Debug, Default)]
pub struct EmpRollout {
    /// N.
    pub environments: usize,
    /// Stacks `S_t` with the goal that was asked for in the newest frame.
    pub stacks: Vec<f32>,
    /// Goals that were asked for.
    pub goals: Vec<f32>,
    /// What the EMP answered, not held inside the joints' ranges.
    pub answers: Vec<f32>,
    /// Goals that were asked for two periods ago, and one. At an episode's start: the present one.
    pub goals_before: [Vec<f32>; PAST],
    /// What the EMP answered two periods ago, and one. At an episode's start: the present goal.
    pub answers_before: [Vec<f32>; PAST],
    /// Leg actions.
    pub actions: Vec<f32>,
    /// Joint positions and roll, pitch, yaw of the next frame, before any reset.
    pub next: Vec<f32>,
    /// Horizontal way from the middle between the feet to the measured centre of mass after each period, m.
    pub centers_of_mass: Vec<f32>,
    /// Force between the robot's own links in each period, N.
    pub contact: Vec<f32>,
    /// How the periods ended.
    pub ends: Vec<End>,
    /// Fork points from which other goals can be tried.
    pub fork_points: Vec<ForkPoint>,
}

/// The environments at the start of a control period.
#[derive(Clone, Debug, Default)]
pub struct ForkPoint {
    /// Number of the control period.
    pub period: usize,
    pub(super) states: Vec<TrackingState>,
}

/// Environments in which an EMP's goals are executed.
pub struct EmpCollector {
    environments: TrackingEnvironments,
    past: Past,
}

/// What was asked for and answered two periods ago, and one; N rows each.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Past {
    goals: [Vec<f32>; PAST],
    answers: [Vec<f32>; PAST],
}

impl Past {
    fn new(numbers: usize) -> Self {
        let zeros = || [vec![0.0; numbers], vec![0.0; numbers]];
        Self {
            goals: zeros(),
            answers: zeros(),
        }
    }

    /// At an episode's start there is no past: the goal was asked for and executed all along.
    fn start(&mut self, starts: &[bool], goals: &[f32]) {
        let width = goals.len() / starts.len().max(1);
        for (n, _) in starts.iter().enumerate().filter(|(_, start)| **start) {
            let row = n * width..(n + 1) * width;
            for past in self.goals.iter_mut().chain(&mut self.answers) {
                past[row.clone()].copy_from_slice(&goals[row.clone()]);
            }
        }
    }

    fn push(&mut self, goals: &[f32], answers: &[f32]) {
        for (past, now) in [(&mut self.goals, goals), (&mut self.answers, answers)] {
            past.swap(0, 1);
            past[1].copy_from_slice(now);
        }
    }
}

impl EmpCollector {
    /// A collector of rollouts in `environments`.
    pub fn new(environments: TrackingEnvironments) -> Self {
        Self {
            past: Past::new(environments.goals().len()),
            environments,
        }
    }

    /// The environments.
    pub fn environments(&self) -> &TrackingEnvironments {
        &self.environments
    }

    /// Runs the environments for `frames` control periods with `network`'s answers, without one with the goals that are asked
    /// for. Forward passes run on `threads`. Every `fork_interval` control periods, if not 0, there is a fork point from which other goals
    /// can be tried.
    ///
    /// # Errors
    /// When the network or the simulation fails.
    pub fn collect(
        &mut self,
        network: Option<&EmpNetwork>,
        frames: usize,
        fork_interval: usize,
        threads: &rayon::ThreadPool,
    ) -> Result<EmpRollout> {
        let mut rollout = EmpRollout {
            environments: self.environments.len(),
            ..EmpRollout::default()
        };
        for period in 0..frames {
            if fork_interval > 0 && period % fork_interval == 0 {
                rollout.fork_points.push(ForkPoint {
                    period,
                    states: self.environments.states(),
                });
            }
            let goals = self.environments.goals().to_vec();
            self.past.start(self.environments.starts(), &goals);
            let answers = match network {
                Some(network) => self.answers(network, threads)?,
                None => goals.clone(),
            };
            rollout.remember(self.environments.observations(), &self.past);
            self.past.push(&goals, &answers);
            rollout.add(&self.execute(&answers)?);
            rollout.goals.extend_from_slice(&goals);
            rollout.answers.extend_from_slice(&answers);
        }
        Ok(rollout)
    }

    /// Robots that go on from fork points of a rollout of this collector, one a row: each from its fork point and environment.
    pub fn fork<'a>(&self, origins: impl Iterator<Item = (&'a ForkPoint, usize)>) -> Self {
        let states = origins.map(|(fork_point, environment)| &fork_point.states[environment]);
        Self::new(self.environments.fork(states))
    }

    /// Runs every environment for one control period with `goals`, held inside the joints' ranges.
    ///
    /// # Errors
    /// When the simulation fails.
    pub fn execute(&mut self, goals: &[f32]) -> Result<TrackingStep<'_>> {
        let robot = self.environments.robot();
        let mut executed = goals.to_vec();
        for goal in executed.chunks_exact_mut(robot.goal_joints().len()) {
            robot.clamp_goal(goal);
        }
        Ok(self.environments.step(&executed)?)
    }

    /// What `network` answers to every environment, in batches of fixed size.
    ///
    /// # Errors
    /// When the network fails.
    pub fn answers(&self, network: &EmpNetwork, threads: &rayon::ThreadPool) -> Result<Vec<f32>> {
        let width = network.config().observation.width();
        let joints = network.config().observation.goal().len();
        let inputs = network.config().features();
        let stacks = self.environments.observations().par_chunks(ROWS * width);
        let goals = self.environments.goals().par_chunks(ROWS * joints);
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

    /// Everything that later rollouts depend on, but for the network.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>> {
        let parts = (self.environments.snapshot()?, &self.past);
        Ok(postcard::to_stdvec(&parts)?)
    }

    /// Goes on from a snapshot of a collector with the same settings, bit for bit.
    ///
    /// # Errors
    /// When it is no such snapshot.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<()> {
        let (environments, past): (Vec<u8>, _) = postcard::from_bytes(snapshot)?;
        self.environments.restore(&environments)?;
        self.past = past;
        Ok(())
    }
}

impl EmpRollout {
    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.ends.len()
    }

    /// How many control periods an environment goes on from the start of `period` until its episode ends, at most `horizon`,
    /// and how the last of them ends; none where that lies beyond the rollout.
    pub fn lived(&self, period: usize, environment: usize, horizon: usize) -> Option<(usize, End)> {
        let ends = self.ends[period * self.environments + environment..]
            .iter()
            .step_by(self.environments);
        let mut ends = (1..=horizon).zip(ends);
        ends.find(|(lived, end)| **end != End::None || *lived == horizon)
            .map(|(lived, end)| (lived, *end))
    }

    /// Number of episodes that ended.
    pub fn episodes(&self) -> usize {
        self.ends.iter().filter(|end| **end != End::None).count()
    }

    /// Number of falls.
    pub fn falls(&self) -> usize {
        let ends = self.ends.iter();
        ends.filter(|end| **end == End::Terminated).count()
    }

    /// What is seen before a control period.
    fn remember(&mut self, stacks: &[f32], past: &Past) {
        self.stacks.extend_from_slice(stacks);
        for (all, past) in self.goals_before.iter_mut().zip(&past.goals) {
            all.extend_from_slice(past);
        }
        for (all, past) in self.answers_before.iter_mut().zip(&past.answers) {
            all.extend_from_slice(past);
        }
    }

    /// What came of a control period.
    fn add(&mut self, step: &TrackingStep<'_>) {
        self.actions.extend_from_slice(step.actions);
        self.next.extend_from_slice(step.next);
        self.centers_of_mass.extend_from_slice(step.com);
        self.contact.extend_from_slice(step.contact);
        self.ends.extend_from_slice(step.ends);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_a_period_is_known_within_its_episode_and_the_rollout() {
        // Two environments, four periods: the first falls in the third, the second's episode times out in the second.
        let mut rollout = EmpRollout {
            environments: 2,
            ends: vec![End::None; 8],
            ..EmpRollout::default()
        };
        rollout.ends[4] = End::Terminated;
        rollout.ends[3] = End::TimedOut;
        for (period, environment, horizon, expected) in [
            (0, 0, 4, Some((3, End::Terminated))),
            (0, 0, 2, Some((2, End::None))),
            (2, 0, 9, Some((1, End::Terminated))),
            (3, 0, 2, None),
            (0, 1, 2, Some((2, End::TimedOut))),
            (2, 1, 2, Some((2, End::None))),
            (2, 1, 3, None),
        ] {
            assert_eq!(rollout.lived(period, environment, horizon), expected);
        }
    }
}

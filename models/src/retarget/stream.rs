//! A stream of poses, answered one from the other: continuous at any speed of the person.
//!
//! A pose has several answers (a shoulder of three axes reaches every direction in two ways), and where two axes of a
//! shoulder line up, following exactly would ask for any speed. So each frame is solved from the stream's previous answer,
//! no joint faster than the person's own motion gives reason for, and another way is taken only where it is clearly and
//! lastingly better.

use std::f64::consts::PI;

use emp_robot::Robot;
use nalgebra::Vector2;

use super::{Effort, Search, Solver, Target};

/// How fast a joint may turn while the person stands still, rad/s.
const BASE_SPEED: f64 = 1.8;
/// How much faster it may turn for each rad/s of the person's arm (for the trunk's joints: of the trunk).
const SPEED_GAIN: f64 = 1.4;
/// No joint turns faster, rad/s: about the speed of a punch, and what [`Smoother`](super::Smoother) lets pass.
const TOP_SPEED: f64 = 12.0;
/// Weight of the squared travel from the previous answer. Directions weigh [`DIRECTION`](super::objective::weights::DIRECTION):
/// only where a joint hardly turns a bone, near a singularity, does travel count.
const TRAVEL: f64 = 1.0;
/// An arm whose part of the objective is below this has no reason to look for a better way: 100 times the square of 4°.
const CONTENT: f64 = 0.5;
/// By how much another way must be better.
const BETTER_BY: f64 = 0.5;
/// The other way is taken when staying has cost this much of what going there costs. Both are the root of the objective
/// (10 times an angle) over time. Going costs less than is estimated, for joints that have time make up for the others.
const REGRET: f64 = 0.2;
/// On the way to another branch, joints that need less than this share of the time stay free to follow the person.
const FREE: f64 = 0.5;

/// What a stream's first frame and the search for a better way spend.
const SEARCH: Effort = Effort {
    steps: 15,
    tolerance: 1e-3,
};
/// What each later frame spends.
const FOLLOW: Effort = Effort {
    steps: 6,
    tolerance: 1e-4,
};

/// Turns of the person that count for the bounds of a frame.
const RECENT: usize = 3;

/// Another answer is another way, and not the same one further on, where a joint is this far away, radians.
const ANOTHER_WAY: f64 = 0.8;

/// How fast a person turns, rad/s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Turns {
    arms: [f64; 2],
    trunk: f64,
}

impl Turns {
    fn between(before: &Target, after: &Target, seconds: f64) -> Self {
        Self {
            arms: before.arm_turns(after).map(|turn| turn / seconds),
            trunk: line_angle(&before.shoulder_line, &after.shoulder_line) / seconds,
        }
    }
}

fn line_angle(a: &Vector2<f64>, b: &Vector2<f64>) -> f64 {
    a.perp(b).atan2(a.dot(b)).abs()
}

/// What a stream remembers from one pose to the next.
#[derive(Clone, Debug, PartialEq)]
pub struct Memory {
    /// The last answer, goal order, radians.
    answer: Vec<f64>,
    /// What it answered.
    target: Target,
    /// How fast the person turned lately, newest first.
    turns: [Turns; RECENT],
    /// A better way for each arm, as far as one is in sight.
    rivals: [Option<Rival>; 2],
}

/// A better way for an arm.
#[derive(Clone, Debug, PartialEq)]
struct Rival {
    /// The whole answer, of which the arm's joints count.
    angles: Vec<f64>,
    /// What it has cost so far not to be there: the difference of the objective's roots over time, in seconds.
    regret: f64,
    /// Whether the arm is on its way there.
    walking: bool,
}

impl Memory {
    /// What a stream would remember after `answer` (goal order, radians) of which nothing else is known: the person is taken
    /// to have shown what the robot does there.
    ///
    /// # Panics
    /// If `answer` is not one angle for each goal joint.
    pub fn after(robot: &Robot, answer: &[f32]) -> Self {
        let joints = robot.goal_joints().iter();
        let answer: Vec<f64> = answer
            .iter()
            .zip(joints)
            .map(|(angle, joint)| f64::from(*angle).clamp(joint.range[0], joint.range[1]))
            .collect();
        let target = Solver::new(robot).shown(&answer);
        Self::new(answer, target)
    }

    fn new(answer: Vec<f64>, target: Target) -> Self {
        Self {
            answer,
            target,
            turns: [Turns::default(); RECENT],
            rivals: [None, None],
        }
    }

    /// The last answer, goal order, radians.
    pub fn answer(&self) -> &[f64] {
        &self.answer
    }
    /// The last answer as it goes out, goal order, radians.
    pub fn angles(&self) -> Vec<f32> {
        self.answer.iter().map(|angle| *angle as f32).collect()
    }
}

impl Solver<'_> {
    /// The first answer of a stream: the best for each arm that is found from `starts`, the default pose and the other
    /// ways of both.
    pub fn begin(&mut self, target: &Target, starts: &[Vec<f64>]) -> Memory {
        let mut best = Best::new();
        best.try_from(self, target, &self.default_pose());
        for start in starts {
            best.try_from(self, target, start);
        }
        for side in 0..2 {
            for start in self.other_ways(&best.arms[side].1.clone(), side) {
                best.try_from(self, target, &start);
            }
        }
        let mut answer = best.arms[0].1.clone();
        for &joint in &self.arms()[1] {
            answer[joint] = best.arms[1].1[joint];
        }
        self.minimise(target, &mut answer, SEARCH);
        Memory::new(answer, target.clone())
    }

    /// The stream's next answer, `seconds` after the one before.
    pub fn follow(&mut self, target: &Target, mut memory: Memory, seconds: f64) -> Memory {
        memory.turns.rotate_right(1);
        memory.turns[0] = Turns::between(&memory.target, target, seconds);
        memory.target.clone_from(target);
        let reach = self.reach(&memory, seconds);
        let (mut lower, mut upper) = self.bounds(&memory.answer, &reach);
        for side in 0..2 {
            self.walk(target, &mut memory, side, &reach, &mut lower, &mut upper);
        }
        let previous = std::mem::take(&mut memory.answer);
        let mut answer = previous.clone();
        let search = Search {
            lower: &lower,
            upper: &upper,
            travel: Some((&previous, TRAVEL)),
        };
        self.minimise_within(target, &mut answer, &search, FOLLOW);
        memory.answer = answer;
        let objectives = self.arm_objectives(target, &memory.answer);
        for side in 0..2 {
            self.look_around(target, &mut memory, side, objectives[side], &reach, seconds);
        }
        memory
    }

    /// How far each joint may move.
    fn reach(&self, memory: &Memory, seconds: f64) -> Vec<f64> {
        let fastest =
            |turn: &dyn Fn(&Turns) -> f64| memory.turns.iter().map(turn).fold(0.0, f64::max);
        let mut reach = Vec::new();
        for (i, joint) in self.robot().goal_joints().iter().enumerate() {
            let turn = match self.arms().iter().position(|arm| arm.contains(&i)) {
                Some(side) => fastest(&|turns: &Turns| turns.arms[side]),
                None => fastest(&|turns: &Turns| turns.trunk),
            };
            let speed = BASE_SPEED + SPEED_GAIN * turn;
            let speed = speed.min(joint.velocity_limit).min(TOP_SPEED);
            reach.push(speed * seconds);
        }
        reach
    }

    fn bounds(&self, answer: &[f64], reach: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let joints = self.robot().goal_joints().iter();
        let around = answer.iter().zip(reach);
        joints
            .zip(around)
            .map(|(joint, (angle, reach))| {
                let [lower, upper] = joint.range;
                (
                    (angle - reach).clamp(lower, upper),
                    (angle + reach).clamp(lower, upper),
                )
            })
            .unzip()
    }

    /// Where an arm is on its way to another branch, holds its slowest joints to the next pose on that way.
    fn walk(
        &mut self,
        target: &Target,
        memory: &mut Memory,
        side: usize,
        reach: &[f64],
        lower: &mut [f64],
        upper: &mut [f64],
    ) {
        let Some(rival) = memory.rivals[side].as_mut().filter(|rival| rival.walking) else {
            return;
        };
        self.minimise(target, &mut rival.angles, Effort::REFINE);
        let arm = &self.arms()[side];
        let frames = frames_between(&memory.answer, &rival.angles, arm, reach);
        if frames <= 1.0 {
            memory.rivals[side] = None;
            return;
        }
        for &joint in arm {
            let away = rival.angles[joint] - memory.answer[joint];
            if away.abs() < FREE * frames * reach[joint] {
                continue;
            }
            let next = memory.answer[joint] + away / frames;
            let next = next.clamp(lower[joint], upper[joint]);
            (lower[joint], upper[joint]) = (next, next);
        }
    }

    /// Looks for a better way where an arm is far off, and starts to walk there once staying has cost enough.
    fn look_around(
        &mut self,
        target: &Target,
        memory: &mut Memory,
        side: usize,
        objective: f64,
        reach: &[f64],
        seconds: f64,
    ) {
        let is_walking = |rival: &Rival| rival.walking;
        if memory.rivals[side].as_ref().is_some_and(is_walking) {
            return;
        }
        let known = memory.rivals[side].take();
        if objective < CONTENT {
            return;
        }
        let mut best = Best::new();
        let regret = known.as_ref().map_or(0.0, |rival| rival.regret);
        if let Some(rival) = known {
            best.try_from(self, target, &rival.angles);
        } else {
            best.try_from(self, target, &self.default_pose());
            for start in self.other_ways(&memory.answer, side) {
                best.try_from(self, target, &start);
            }
        }
        let (value, angles) = best.arms[side].clone();
        let is_another = self.arms()[side]
            .iter()
            .any(|joint| (angles[*joint] - memory.answer[*joint]).abs() > ANOTHER_WAY);
        if value > objective - BETTER_BY || !is_another {
            return;
        }
        let here = objective.sqrt();
        let (on_the_way, frames) = self.way(target, &memory.answer, &angles, side, reach);
        let cost = (on_the_way - here) * frames * seconds;
        let regret = regret + (here - value.sqrt()) * seconds;
        memory.rivals[side] = Some(Rival {
            angles,
            regret,
            walking: regret > REGRET * cost,
        });
    }

    /// The mean root of the arm's objective on the straight way between two answers, and how many frames that takes.
    fn way(
        &mut self,
        target: &Target,
        from: &[f64],
        to: &[f64],
        side: usize,
        reach: &[f64],
    ) -> (f64, f64) {
        const SAMPLES: [f64; 3] = [0.25, 0.5, 0.75];
        let arm = self.arms()[side].clone();
        let mut between = from.to_vec();
        let roots = SAMPLES.map(|share| {
            for &joint in &arm {
                between[joint] = from[joint] + share * (to[joint] - from[joint]);
            }
            self.arm_objectives(target, &between)[side].sqrt()
        });
        let mean = roots.iter().sum::<f64>() / SAMPLES.len() as f64;
        (mean, frames_between(from, to, &arm, reach))
    }

    fn default_pose(&self) -> Vec<f64> {
        let joints = self.robot().goal_joints().iter();
        joints.map(|joint| joint.default).collect()
    }

    /// Poses near which an arm may have other answers: shoulders that reach the same direction the other way round.
    fn other_ways(&self, angles: &[f64], side: usize) -> Vec<Vec<f64>> {
        let [first, second, third, ..] = self.arms()[side][..] else {
            return Vec::new();
        };
        let joints = self.robot().goal_joints();
        // Those inside the range, or else both at its ends: which of them is tried must not depend on the side.
        let inside = |joint: usize, angles: [f64; 2]| -> Vec<f64> {
            let [lower, upper] = joints[joint].range;
            let reached = angles.into_iter();
            let reached: Vec<f64> = reached
                .filter(|angle| (lower..=upper).contains(angle))
                .collect();
            if reached.is_empty() {
                angles.map(|angle| angle.clamp(lower, upper)).to_vec()
            } else {
                reached
            }
        };
        let turned = |joint: usize| inside(joint, [angles[joint] + PI, angles[joint] - PI]);
        let mirrored = inside(second, [PI - angles[second], -PI - angles[second]]);
        let mut poses = Vec::new();
        for first_angle in turned(first) {
            for third_angle in turned(third) {
                for &second_angle in mirrored.iter().chain([&angles[second]]) {
                    let mut pose = angles.to_vec();
                    pose[first] = first_angle;
                    pose[second] = second_angle;
                    pose[third] = third_angle;
                    poses.push(pose);
                }
            }
        }
        poses
    }
}

/// How many frames an arm needs from one answer to another.
fn frames_between(from: &[f64], to: &[f64], arm: &[usize], reach: &[f64]) -> f64 {
    let frames = arm
        .iter()
        .map(|&joint| (to[joint] - from[joint]).abs() / reach[joint]);
    frames.fold(0.0, f64::max)
}

/// The best answers so far, for each arm.
struct Best {
    arms: [(f64, Vec<f64>); 2],
}

impl Best {
    fn new() -> Self {
        Self {
            arms: [0, 1].map(|_| (f64::INFINITY, Vec::new())),
        }
    }

    fn try_from(&mut self, solver: &mut Solver<'_>, target: &Target, start: &[f64]) {
        let mut angles = start.to_vec();
        solver.minimise(target, &mut angles, SEARCH);
        let objectives = solver.arm_objectives(target, &angles);
        for (best, value) in self.arms.iter_mut().zip(objectives) {
            if value < best.0 {
                *best = (value, angles.clone());
            }
        }
    }
}

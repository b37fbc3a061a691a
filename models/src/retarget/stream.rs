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
/// Weight of the squared travel from the previous answer. Directions weigh [`DIRECTION`](super::objective::weights::DIRECTION):
/// only where a joint hardly turns a bone, near a singularity, does travel count.
const TRAVEL: f64 = 1.0;
/// An arm whose part of the objective is below this has no reason to look for a better way: 100 times the square of 7°.
const CONTENT: f64 = 1.5;
/// By how much another way must be better.
const BETTER_BY: f64 = 1.5;
/// For how long, seconds.
const PATIENCE: f64 = 0.15;

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
    /// For how long it has been better, seconds.
    better_for: f64,
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
        for (side, objective) in objectives.into_iter().enumerate() {
            self.look_around(target, &mut memory, side, objective, seconds);
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
            let speed = (BASE_SPEED + SPEED_GAIN * turn).min(joint.velocity_limit);
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

    /// Where an arm is on its way to another branch, holds it to the next pose on that way.
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
        let away = |joint: &usize| rival.angles[*joint] - memory.answer[*joint];
        let frames = arm
            .iter()
            .map(|joint| away(joint).abs() / reach[*joint])
            .fold(0.0, f64::max);
        if frames <= 1.0 {
            memory.rivals[side] = None;
            return;
        }
        for joint in arm {
            let next = memory.answer[*joint] + away(joint) / frames;
            let next = next.clamp(lower[*joint], upper[*joint]);
            (lower[*joint], upper[*joint]) = (next, next);
        }
    }

    /// Looks for a better way where an arm is far off, and starts to walk there once it has been better for long.
    fn look_around(
        &mut self,
        target: &Target,
        memory: &mut Memory,
        side: usize,
        objective: f64,
        seconds: f64,
    ) {
        if memory.rivals[side]
            .as_ref()
            .is_some_and(|rival| rival.walking)
        {
            return;
        }
        if objective < CONTENT {
            memory.rivals[side] = None;
            return;
        }
        let known = memory.rivals[side].take();
        let mut better_for = 0.0;
        let mut best = Best::new();
        if let Some(rival) = known {
            best.try_from(self, target, &rival.angles);
            better_for = rival.better_for;
        } else {
            for start in self.other_ways(&memory.answer, side) {
                best.try_from(self, target, &start);
            }
            best.try_from(self, target, &self.default_pose());
        }
        let (value, angles) = best.arms[side].clone();
        let is_another = self.arms()[side]
            .iter()
            .any(|joint| (angles[*joint] - memory.answer[*joint]).abs() > ANOTHER_WAY);
        if value < objective - BETTER_BY && is_another {
            let better_for = better_for + seconds;
            memory.rivals[side] = Some(Rival {
                angles,
                better_for,
                walking: better_for > PATIENCE,
            });
        }
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
        let nearest = |joint: usize, ways: [f64; 2]| {
            let [lower, upper] = joints[joint].range;
            let outside = |angle: f64| (lower - angle).max(angle - upper);
            let [one, other] = ways;
            let way = if outside(one) <= outside(other) {
                one
            } else {
                other
            };
            way.clamp(lower, upper)
        };
        let turned = |joint: usize| nearest(joint, [angles[joint] + PI, angles[joint] - PI]);
        let mirrored = |joint: usize| nearest(joint, [PI - angles[joint], -PI - angles[joint]]);
        let mut flipped = angles.to_vec();
        flipped[first] = turned(first);
        flipped[second] = mirrored(second);
        flipped[third] = turned(third);
        let mut twisted = angles.to_vec();
        twisted[first] = turned(first);
        twisted[third] = turned(third);
        let mut only_first = angles.to_vec();
        only_first[first] = turned(first);
        vec![flipped, twisted, only_first]
    }
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

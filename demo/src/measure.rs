//! What the robot made of the motion, in numbers.

use std::fmt;

use anyhow::{Context, Result};
use emp_client::{BatchStatistics, Percentiles};
use emp_motion::{KeyNodeFrame, Side};
use emp_robot::Robot;
use emp_sim::{Replay, SelfCollision};
use nalgebra::Vector3;
use serde::Serialize;

use crate::motion::Motion;
use crate::output::robot_pose;
use crate::stream::Answers;

/// A joint that moves farther than this from one frame to the next jumps, radians.
const JUMP: f32 = 0.25;
/// Arm bones of a frame: upper arm and forearm of both sides.
const BONES: usize = 4;

/// The content of `summary.json`.
#[derive(Debug, Serialize)]
pub(crate) struct Summary {
    /// The robot's name.
    robot: String,
    /// The motion's name.
    motion: String,
    /// The model that answered.
    model: String,
    /// Its version.
    model_version: String,
    /// Frames sent, all of them answered.
    frames: usize,
    /// Length of the motion, seconds.
    seconds: f64,
    /// Frames answered a second, each sent when the one before it was answered.
    fps: f64,
    /// From sending a frame to its answer, milliseconds.
    latency_ms: Percentiles,
    /// Waiting for the model, milliseconds.
    queue_ms: Percentiles,
    /// In the model, milliseconds.
    inference_ms: Percentiles,
    /// Frames a batch.
    batch: BatchStatistics,
    /// Between the person's arm bones and those of a robot that stands in the answered targets, degrees.
    direction_error_deg: Spread,
    /// Between the person's arm bones and those of the robot in MuJoCo at the same moment, degrees.
    direction_error_in_physics_deg: Spread,
    /// Frames in which a joint target jumps: moves more than 0.25 rad from the frame before.
    jumps: usize,
    /// Largest move of a joint target from one frame to the next, radians.
    largest_jump_rad: f32,
    /// Share of frames with a joint at a limit, 0 to 1.
    limit_share: f64,
    /// Share of frames whose targets touch the robot itself, 0 to 1.
    self_collision_share: f64,
    /// Share of frames in which the robot touched itself in MuJoCo, 0 to 1.
    self_collision_in_physics_share: f64,
    /// Share of goal actuators and physics steps at the torque limit, 0 to 1.
    saturated_share: f64,
}

/// A mean and a 95th percentile.
#[derive(Debug, Serialize)]
struct Spread {
    mean: f32,
    p95: f32,
}

/// The summary, and each frame's mean direction error in MuJoCo in degrees.
pub(crate) fn summary(
    robot: &Robot,
    motion: &Motion,
    answers: &Answers,
    replay: &Replay,
) -> Result<(Summary, Vec<f32>)> {
    let frames = &motion.clip.frames;
    let asked = direction_errors(frames, &target_poses(robot, &answers.targets));
    let reached: Vec<KeyNodeFrame> = replay
        .frames
        .iter()
        .map(|frame| robot_pose(&frame.key_nodes, &frame.wrist_rotations))
        .collect();
    let reached = direction_errors(frames, &reached);
    let moves: Vec<f32> = answers
        .targets
        .windows(2)
        .map(|pair| largest_move(&pair[0], &pair[1]))
        .collect();
    let statistics = &answers.statistics;
    let summary = Summary {
        robot: robot.name().to_owned(),
        motion: motion.name.clone(),
        model: answers.model.0.clone(),
        model_version: answers.model.1.clone(),
        frames: frames.len(),
        seconds: motion.time(frames.len()),
        fps: statistics.fps,
        latency_ms: statistics.latency_ms,
        queue_ms: statistics.queue_ms,
        inference_ms: statistics.inference_ms,
        batch: statistics.batch,
        direction_error_deg: Spread::of(asked.as_flattened()),
        direction_error_in_physics_deg: Spread::of(reached.as_flattened()),
        jumps: moves.iter().filter(|&&step| step > JUMP).count(),
        largest_jump_rad: moves.iter().copied().fold(0.0, f32::max),
        limit_share: statistics
                .retargeting
                .map_or(0.0, |retargeting| retargeting.limit_share),
        self_collision_share: SelfCollision::new(robot)?.share(&answers.targets)?,
        self_collision_in_physics_share: replay.self_collision_share(),
        saturated_share: replay.saturated_share,
    };
    let by_frame = reached
        .iter()
        .map(|errors| errors.iter().sum::<f32>() / BONES as f32)
        .collect();
    Ok((summary, by_frame))
}

/// The robot's key nodes with its goal joints at each row of targets.
fn target_poses(robot: &Robot, targets: &[Vec<f32>]) -> Vec<KeyNodeFrame> {
    let mut kinematics = robot.kinematics().frame();
    let pose = |target: &Vec<f32>| {
        kinematics.update(
            &target
                .iter()
                .map(|&angle| f64::from(angle))
                .collect::<Vec<_>>(),
        );
        robot_pose(kinematics.positions(), kinematics.wrist_rotations())
    };
    targets.iter().map(pose).collect()
}

/// Angles between the person's and the robot's arm bones, degrees, frame by frame.
fn direction_errors(human: &[KeyNodeFrame], robot: &[KeyNodeFrame]) -> Vec<[f32; BONES]> {
    human
        .iter()
        .zip(robot)
        .map(|(human, robot)| frame_errors(human, robot))
        .collect()
}

fn frame_errors(human: &KeyNodeFrame, robot: &KeyNodeFrame) -> [f32; BONES] {
    let [human, robot] = [human, robot].map(arm_bones);
    std::array::from_fn(|bone| human[bone].angle(&robot[bone]).to_degrees())
}

fn arm_bones(frame: &KeyNodeFrame) -> [Vector3<f32>; BONES] {
    let [left, right] = Side::BOTH.map(|side| [frame.upper_arm(side), frame.forearm(side)]);
    [left[0], left[1], right[0], right[1]]
}

fn largest_move(before: &[f32], after: &[f32]) -> f32 {
    before
        .iter()
        .zip(after)
        .map(|(before, after)| (after - before).abs())
        .fold(0.0, f32::max)
}

impl Spread {
    /// Of any number of values; zero of none.
    fn of(values: &[f32]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f32::total_cmp);
        let rank = (0.95 * sorted.len() as f64).ceil() as usize;
        Self {
            mean: sorted.iter().sum::<f32>() / sorted.len().max(1) as f32,
            p95: sorted.get(rank.saturating_sub(1)).copied().unwrap_or(0.0),
        }
    }
}

impl Summary {
    /// As the text of `summary.json`.
    pub(crate) fn json(&self) -> Result<String> {
        let text =
            serde_json::to_string_pretty(self).context("cannot write the summary as JSON")?;
        Ok(text + "\n")
    }

    /// Title and subtitle of the contact sheet.
    pub(crate) fn titles(&self) -> [String; 2] {
        let Spread { mean, p95 } = self.direction_error_in_physics_deg;
        [
            format!("{} follows {}", self.robot, self.motion),
            format!(
                "above the person, below the robot in MuJoCo; arm directions {mean:.1}° apart on average, {p95:.1}° at p95"
            ),
        ]
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            latency_ms,
            batch,
            direction_error_deg: asked,
            direction_error_in_physics_deg: reached,
            ..
        } = self;
        writeln!(
            f,
            "{} follows {}: {} frames, {:.1} s",
            self.robot, self.motion, self.frames, self.seconds
        )?;
        writeln!(
            f,
            "  over the wire   {:.0} frames/s one by one; latency {:.2} ms (p50), {:.2} ms (p99); {:.1} frames a batch",
            self.fps, latency_ms.p50, latency_ms.p99, batch.mean
        )?;
        writeln!(
            f,
            "  arm directions  {:.1}° off (p95 {:.1}°) as answered",
            asked.mean, asked.p95
        )?;
        writeln!(
            f,
            "                  {:.1}° off (p95 {:.1}°) as moved in MuJoCo",
            reached.mean, reached.p95
        )?;
        writeln!(
            f,
            "  joints          {} jumps over {JUMP} rad, largest step {:.2} rad; at a limit in {} of frames",
            self.jumps,
            self.largest_jump_rad,
            percent(self.limit_share)
        )?;
        writeln!(
            f,
            "  robot           touches itself in {} of frames as answered, {} in MuJoCo; {} of torques at their limit",
            percent(self.self_collision_share),
            percent(self.self_collision_in_physics_share),
            percent(self.saturated_share)
        )
    }
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use emp_motion::skills;

    use super::*;

    #[test]
    fn equal_poses_are_no_degrees_apart_and_a_turned_bone_its_angle() {
        let human = skills::medley(1).frames[0].clone();
        assert!(
            frame_errors(&human, &human)
                .iter()
                .all(|&error| error < 0.05)
        );

        let mut robot = human.clone();
        let [shoulder, elbow, wrist] = Side::Right.arm().map(|node| node as usize);
        // The forearm at a right angle to the upper arm's plane of view: built from the upper arm, so known exactly.
        let upper = robot.positions[elbow] - robot.positions[shoulder];
        let across = upper.cross(&Vector3::new(0.3, 0.5, 0.7)).normalize();
        let mut person = human.clone();
        person.positions[wrist] = person.positions[elbow] + 0.25 * upper.normalize();
        robot.positions[wrist] = robot.positions[elbow] + 0.2 * across;
        let errors = frame_errors(&person, &robot);
        assert!((errors[3] - 90.0).abs() < 0.01, "{errors:?}");
        assert!(errors[..3].iter().all(|&error| error < 0.05), "{errors:?}");
    }

    #[test]
    fn spread_is_mean_and_percentile() {
        let values: Vec<f32> = (1..=100).rev().map(|value| value as f32).collect();
        let spread = Spread::of(&values);
        assert_eq!((spread.mean, spread.p95), (50.5, 95.0));
        let none = Spread::of(&[]);
        assert_eq!((none.mean, none.p95), (0.0, 0.0));
        assert_eq!(Spread::of(&[3.0]).p95, 3.0);
    }

    #[test]
    fn a_move_is_that_of_the_fastest_joint() {
        assert_eq!(largest_move(&[0.0, 1.0, 0.5], &[0.25, 0.0, 0.5]), 1.0);
    }
}

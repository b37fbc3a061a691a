//! What the robot made of the motion, in numbers.

use std::fmt;

use anyhow::{Context, Result};
use emp_motion::{KeyNodeFrame, Side};
use emp_robot::Robot;
use emp_sim::SelfCollision;
use nalgebra::Vector3;
use serde::Serialize;

use crate::comparison::ComparisonSummary;
use crate::control::Run;
use crate::disturbances::Disturbances;
use crate::episode::{Episode, percent, percentile};
use crate::hard::goal_poses;
use crate::models::Models;
use crate::motion::Motion;
use crate::posture::Posture;

/// A joint that moves farther than this from one frame to the next jumps, radians.
const JUMP: f32 = 0.25;
/// Arm bones of a frame: upper arm and forearm of both sides.
const BONES: usize = 4;
/// A joint that is as near to a limit as this stands at it, radians.
const AT_LIMIT: f32 = 1e-3;

/// The content of `summary.json`.
#[derive(Debug, Serialize)]
pub(crate) struct Summary {
    /// The robot's name.
    robot: String,
    /// The motion's name.
    motion: String,
    /// Length of the motion, seconds.
    seconds: f64,
    /// Seed of the disturbances.
    seed: u64,
    /// Mass added to the left and the right hand, kg.
    hand_load_kg: [f64; 2],
    /// What each push added to the base's speed, m/s.
    push_m_per_s: f64,
    /// The models that answered.
    models: Models,
    /// How it went.
    #[serde(flatten)]
    episode: Episode,
    /// Between the person's arm bones and those of a robot that stands in the person's goals, degrees.
    direction_error_deg: Spread,
    /// Between the person's arm bones and those of the robot in MuJoCo at the same moment, each seen from its pelvis,
    /// degrees.
    direction_error_in_physics_deg: Spread,
    /// Frames in which a joint of the person's goal jumps: moves more than 0.25 rad from the frame before.
    jumps: usize,
    /// Largest move of a joint of the person's goal from one frame to the next, radians.
    largest_jump_rad: f32,
    /// Share of the person's goals with a joint at a limit, 0 to 1.
    limit_share: f64,
    /// Share of frames whose person's goals touch the robot itself, 0 to 1.
    touching_goal_share: f64,
    /// The hard motion with the EMP off and on, where it was done.
    hard_motion: Option<ComparisonSummary>,
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
    (seed, disturbances): (u64, &Disturbances),
    models: Models,
    run: &Run,
    postures: &[Posture],
    hard_motion: Option<ComparisonSummary>,
) -> Result<(Summary, Vec<f32>)> {
    let human = &motion.clip.frames;
    let answers = run.periods.iter().map(|period| &period.answer);
    let goals: Vec<&Vec<f32>> = answers.map(|answer| &answer.person).collect();
    let poses = goal_poses(robot, goals.iter().map(|goal| goal.as_slice()));
    let asked = direction_errors(human, &poses);
    let reached: Vec<KeyNodeFrame> = postures
        .iter()
        .map(|posture| posture.pose.clone())
        .collect();
    let reached = direction_errors(human, &reached);
    let moves: Vec<f32> = goals
        .windows(2)
        .map(|pair| largest_move(pair[0], pair[1]))
        .collect();
    let summary = Summary {
        robot: robot.name().to_owned(),
        motion: motion.name.clone(),
        seconds: motion.time(human.len()),
        seed,
        hand_load_kg: disturbances.hand_load,
        push_m_per_s: disturbances.pushes.speed,
        models,
        episode: Episode::new(robot, run),
        direction_error_deg: Spread::of(asked.as_flattened()),
        direction_error_in_physics_deg: Spread::of(reached.as_flattened()),
        jumps: moves.iter().filter(|&&step| step > JUMP).count(),
        largest_jump_rad: moves.iter().copied().fold(0.0, f32::max),
        limit_share: limit_share(robot, &goals),
        touching_goal_share: SelfCollision::new(robot)?.share(&goals)?,
        hard_motion,
    };
    let by_frame = reached
        .iter()
        .map(|errors| errors.iter().sum::<f32>() / BONES as f32)
        .collect();
    Ok((summary, by_frame))
}

/// Share of goals with a joint at a limit.
fn limit_share(robot: &Robot, goals: &[&Vec<f32>]) -> f64 {
    let at_limit = |goal: &&&Vec<f32>| {
        let mut joints = goal.iter().zip(robot.goal_joints());
        joints.any(|(&angle, joint)| {
            let [lower, upper] = joint.range.map(|limit| limit as f32);
            angle <= lower + AT_LIMIT || angle >= upper - AT_LIMIT
        })
    };
    goals.iter().filter(at_limit).count() as f64 / goals.len().max(1) as f64
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
        Self {
            mean: sorted.iter().sum::<f32>() / sorted.len().max(1) as f32,
            p95: percentile(&sorted, 0.95),
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

    /// When the robot fell, seconds, if it did.
    pub(crate) fn fall_time(&self) -> Option<f64> {
        self.episode.fall().map(|fall| fall.time)
    }

    /// What happened, in a line.
    pub(crate) fn title(&self) -> String {
        let Self {
            robot,
            motion,
            seconds,
            ..
        } = self;
        match self.fall_time() {
            None => format!("{robot} follows {motion} on its own feet"),
            Some(fall) => {
                format!("{robot} follows {motion} and falls after {fall:.1} of {seconds:.1} s")
            }
        }
    }

    /// Second line of the contact sheet.
    pub(crate) fn contact_subtitle(&self) -> String {
        let Spread { mean, p95 } = self.direction_error_in_physics_deg;
        format!(
            "above the person, below the robot in MuJoCo; arm directions {mean:.1}° apart on average, {p95:.1}° at p95"
        )
    }

    /// Second line of the stance sheet.
    pub(crate) fn stance_subtitle(&self) -> String {
        let [left, right] = self.hand_load_kg;
        let tilt = self.episode.largest_tilt_deg;
        let mut text = format!(
            "base tilted by {tilt:.1}° at most; {left:.2} kg in the left hand, {right:.2} kg in the right"
        );
        match self.episode.pushes {
            0 => {}
            1 => text += &format!(", pushed once by {} m/s", self.push_m_per_s),
            pushes => text += &format!(", pushed {pushes} times by {} m/s", self.push_m_per_s),
        }
        text
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            episode,
            hand_load_kg: [left, right],
            direction_error_deg: asked,
            direction_error_in_physics_deg: reached,
            ..
        } = self;
        writeln!(f, "{}", self.title())?;
        writeln!(f, "  balance         {}", episode.balance())?;
        writeln!(
            f,
            "  conditions      {left:.2} and {right:.2} kg in the hands, {} pushes of {} m/s; seed {}",
            episode.pushes, self.push_m_per_s, self.seed
        )?;
        writeln!(f, "  control loop    {}", episode.waiting())?;
        writeln!(f, "  EMP             {}", episode.filtering())?;
        writeln!(f, "  guards          {}", episode.guarding())?;
        writeln!(f, "  metrics         {}", episode.paper())?;
        writeln!(f, "  robot           {}", episode.body())?;
        writeln!(
            f,
            "  arm directions  {:.1}° off (p95 {:.1}°) as answered, {:.1}° (p95 {:.1}°) as moved in MuJoCo",
            asked.mean, asked.p95, reached.mean, reached.p95
        )?;
        writeln!(
            f,
            "  joints          {} jumps over {JUMP} rad, largest step {:.2} rad; at a limit in {} of frames",
            self.jumps,
            self.largest_jump_rad,
            percent(self.limit_share)
        )?;
        match &self.hard_motion {
            None => Ok(()),
            Some(hard) => write!(f, "{hard}"),
        }
    }
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

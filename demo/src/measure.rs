//! What the robot made of the motion, in numbers.

use std::fmt;
use std::time::Duration;

use anyhow::{Context, Result};
use emp_client::{BatchStatistics, Percentiles};
use emp_motion::{KeyNodeFrame, Side};
use emp_robot::Robot;
use emp_sim::SelfCollision;
use emp_sim::metrics::{EpisodeSums, Frame, Metrics};
use nalgebra::Vector3;
use serde::Serialize;

use crate::conditions::Conditions;
use crate::control::{Run, StreamReport};
use crate::motion::Motion;
use crate::posture::{Posture, robot_pose};

/// A joint that moves farther than this from one frame to the next jumps, radians.
const JUMP: f32 = 0.25;
/// Arm bones of a frame: upper arm and forearm of both sides.
const BONES: usize = 4;
/// Share of its torque limit from which a motor counts as saturated.
const SATURATED: f32 = 0.999;

/// The content of `summary.json`.
#[derive(Debug, Serialize)]
pub(crate) struct Summary {
    /// The robot's name.
    robot: String,
    /// The motion's name.
    motion: String,
    /// Length of the motion, seconds.
    seconds: f64,
    /// Frames that the robot went through: all, or those up to its fall.
    frames: usize,
    /// Seed of the conditions.
    seed: u64,
    /// Mass added to the left and the right hand, kg.
    hand_load_kg: [f64; 2],
    /// What each push added to the base's speed, m/s.
    push_m_per_s: f64,
    /// Pushes.
    pushes: usize,
    /// Whether the robot stood to the motion's end.
    stood: bool,
    /// When and why it fell, if it did.
    fall: Option<Fall>,
    /// Largest angle between the base's axis and the vertical, degrees.
    largest_tilt_deg: f32,
    /// The paper's metrics of this one episode.
    metrics: Metrics<f64>,
    /// Simulated seconds a second.
    real_time_factor: f64,
    /// From the robot's state to its new targets, over both streams, milliseconds; an unanswered period counts as long as
    /// the robot waited.
    round_trip_ms: Percentiles,
    /// Control periods without an answer in time, in which the robot kept the targets that it had.
    missed_periods: usize,
    /// The stream of poses.
    retargeting: Stream,
    /// The stream of robot states.
    policy: Stream,
    /// Between the person's arm bones and those of a robot that stands in the answered goals, degrees.
    direction_error_deg: Spread,
    /// Between the person's arm bones and those of the robot in MuJoCo at the same moment, each seen from its pelvis,
    /// degrees.
    direction_error_in_physics_deg: Spread,
    /// Frames in which a joint of the goal jumps: moves more than 0.25 rad from the frame before.
    jumps: usize,
    /// Largest move of a joint of the goal from one frame to the next, radians.
    largest_jump_rad: f32,
    /// Share of answers with a joint at a limit, 0 to 1.
    limit_share: f64,
    /// Share of frames whose goals touch the robot itself, 0 to 1.
    self_collision_share: f64,
    /// Share of motors and frames at the torque limit, 0 to 1.
    saturated_share: f64,
}

/// When and why the robot fell.
#[derive(Debug, Serialize)]
pub(crate) struct Fall {
    /// Since the motion began, seconds.
    pub(crate) time: f64,
    /// In words.
    reason: String,
}

/// One stream to the server.
#[derive(Debug, Serialize)]
struct Stream {
    /// The model that answered.
    model: String,
    /// Its version.
    version: String,
    /// From sending a frame to its answer, milliseconds.
    latency_ms: Percentiles,
    /// Waiting for the model, milliseconds.
    queue_ms: Percentiles,
    /// In the model, milliseconds.
    inference_ms: Percentiles,
    /// Frames a batch.
    batch: BatchStatistics,
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
    (seed, conditions): (u64, &Conditions),
    run: &Run,
    postures: &[Posture],
) -> Result<(Summary, Vec<f32>)> {
    let human = &motion.clip.frames;
    let goals: Vec<&Vec<f32>> = run.periods.iter().map(|period| &period.goal).collect();
    let asked = direction_errors(human, &goal_poses(robot, &goals));
    let reached: Vec<KeyNodeFrame> = postures
        .iter()
        .map(|posture| posture.pose.clone())
        .collect();
    let reached = direction_errors(human, &reached);
    let moves: Vec<f32> = goals
        .windows(2)
        .map(|pair| largest_move(pair[0], pair[1]))
        .collect();
    let seconds = run.periods.len() as f64 / robot.control_rate_hz();
    let tilts = postures.iter().map(|posture| posture.stance.tilt());
    let retargeted = &run.retargeting.statistics.retargeting;
    let summary = Summary {
        robot: robot.name().to_owned(),
        motion: motion.name.clone(),
        seconds: motion.time(human.len()),
        frames: run.periods.len(),
        seed,
        hand_load_kg: conditions.hand_load,
        push_m_per_s: conditions.push_speed,
        pushes: run.periods.iter().filter(|period| period.pushed).count(),
        stood: run.fall.is_none(),
        fall: run.fall.map(|reason| Fall {
            time: seconds,
            reason: reason.to_string(),
        }),
        largest_tilt_deg: tilts.fold(0.0, f32::max).to_degrees(),
        metrics: metrics(robot, run),
        real_time_factor: seconds / run.wall_time.as_secs_f64(),
        round_trip_ms: percentiles(run.periods.iter().map(|period| period.round_trip)),
        missed_periods: run.periods.iter().filter(|period| !period.answered).count(),
        retargeting: Stream::new(&run.retargeting),
        policy: Stream::new(&run.policy),
        direction_error_deg: Spread::of(asked.as_flattened()),
        direction_error_in_physics_deg: Spread::of(reached.as_flattened()),
        jumps: moves.iter().filter(|&&step| step > JUMP).count(),
        largest_jump_rad: moves.iter().copied().fold(0.0, f32::max),
        limit_share: retargeted.map_or(0.0, |retargeted| retargeted.limit_share),
        self_collision_share: SelfCollision::new(robot)?.share(&goals)?,
        saturated_share: saturated_share(robot, run),
    };
    let by_frame = reached
        .iter()
        .map(|errors| errors.iter().sum::<f32>() / BONES as f32)
        .collect();
    Ok((summary, by_frame))
}

/// The paper's metrics, as the evaluation computes them.
fn metrics(robot: &Robot, run: &Run) -> Metrics<f64> {
    let mut sums = EpisodeSums::default();
    let joints = robot.goal_joints().iter();
    let default: Vec<f32> = joints.map(|joint| joint.default as f32).collect();
    let readings = run.periods.iter().map(|period| &period.reading);
    let before = std::iter::once(&run.start).chain(readings);
    for (period, before) in run.periods.iter().zip(before) {
        if period.reading.divergence.is_none() {
            sums.add(&Frame {
                reading: &period.reading,
                goal: &period.goal,
                executed: &period.goal,
                default: &default,
                speeds_before: &before.joint_velocities[..default.len()],
            });
        }
    }
    sums.sums.suc = f64::from(u8::from(run.fall.is_none()));
    sums.means()
}

/// Share of motors and frames at the torque limit.
fn saturated_share(robot: &Robot, run: &Run) -> f64 {
    let saturated = |torques: &[f32]| {
        let motors = torques.iter().zip(robot.joints());
        motors
            .filter(|(torque, joint)| torque.abs() >= SATURATED * joint.torque_limit as f32)
            .count()
    };
    let torques = run.periods.iter().map(|period| &period.reading.torques);
    let all = run.periods.len() * robot.joints().count();
    torques.map(|torques| saturated(torques)).sum::<usize>() as f64 / all.max(1) as f64
}

fn percentiles(times: impl Iterator<Item = Duration>) -> Percentiles {
    let mut sorted: Vec<f64> = times.map(|time| 1e3 * time.as_secs_f64()).collect();
    sorted.sort_by(f64::total_cmp);
    Percentiles {
        p50: percentile(&sorted, 0.5),
        p90: percentile(&sorted, 0.9),
        p99: percentile(&sorted, 0.99),
        max: percentile(&sorted, 1.0),
    }
}

/// The smallest of sorted values that a share of them does not exceed; 0 of none.
fn percentile<T: Copy + Default>(sorted: &[T], share: f64) -> T {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    let value = sorted.get(rank.saturating_sub(1));
    value.copied().unwrap_or_default()
}

/// The robot's key nodes with its goal joints at each of the goals.
fn goal_poses(robot: &Robot, goals: &[&Vec<f32>]) -> Vec<KeyNodeFrame> {
    let mut kinematics = robot.kinematics().frame();
    let pose = |goal: &&Vec<f32>| {
        kinematics.update(
            &goal
                .iter()
                .map(|&angle| f64::from(angle))
                .collect::<Vec<_>>(),
        );
        robot_pose(kinematics.positions(), kinematics.wrist_rotations())
    };
    goals.iter().map(pose).collect()
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

impl Stream {
    fn new(report: &StreamReport) -> Self {
        let (model, version) = report.model.clone();
        let statistics = &report.statistics;
        Self {
            model,
            version,
            latency_ms: statistics.latency_ms,
            queue_ms: statistics.queue_ms,
            inference_ms: statistics.inference_ms,
            batch: statistics.batch,
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

    /// When and why the robot fell, if it did.
    pub(crate) fn fall(&self) -> Option<&Fall> {
        self.fall.as_ref()
    }

    /// What happened, in a line.
    pub(crate) fn title(&self) -> String {
        let Self {
            robot,
            motion,
            seconds,
            ..
        } = self;
        match &self.fall {
            None => format!("{robot} follows {motion} on its own feet"),
            Some(fall) => format!(
                "{robot} follows {motion} and falls after {:.1} of {seconds:.1} s",
                fall.time
            ),
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
        let tilt = self.largest_tilt_deg;
        let mut text = format!(
            "base tilted by {tilt:.1}° at most; {left:.2} kg in the left hand, {right:.2} kg in the right"
        );
        match self.pushes {
            0 => {}
            1 => text += &format!(", pushed once by {} m/s", self.push_m_per_s),
            pushes => text += &format!(", pushed {pushes} times by {} m/s", self.push_m_per_s),
        }
        text
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.title())?;
        match &self.fall {
            None => writeln!(
                f,
                "  balance         stood for {:.1} s, base tilted by {:.1}° at most",
                self.seconds, self.largest_tilt_deg
            )?,
            Some(Fall { time, reason }) => {
                writeln!(f, "  balance         FELL after {time:.2} s: {reason}")?;
            }
        }
        let [left, right] = self.hand_load_kg;
        writeln!(
            f,
            "  conditions      {left:.2} and {right:.2} kg in the hands, {} pushes of {} m/s; seed {}",
            self.pushes, self.push_m_per_s, self.seed
        )?;
        let trip = &self.round_trip_ms;
        writeln!(
            f,
            "  control loop    {:.3} × real time; round trip {:.2} ms (p50), {:.2} ms (p99); {} of {} periods missed",
            self.real_time_factor, trip.p50, trip.p99, self.missed_periods, self.frames
        )?;
        self.write_metrics(f)?;
        self.write_retargeting(f)
    }
}

impl Summary {
    fn write_metrics(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Metrics {
            suc,
            mjp,
            msc,
            mbv,
            mba,
            mbo,
            mus,
            self_collision_share,
        } = &self.metrics;
        writeln!(
            f,
            "  metrics         SUC {suc:.0}, MJP {mjp:.3}, MSC {msc:.2} N, MBV {mbv:.3}, MBA {mba:.3}, MBO {mbo:.3}, MUS {mus:.3} (rad/s)²"
        )?;
        writeln!(
            f,
            "  robot           touches itself in {} of frames, {} as answered; {} of torques at their limit",
            percent(*self_collision_share),
            percent(self.self_collision_share),
            percent(self.saturated_share)
        )
    }

    fn write_retargeting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            direction_error_deg: asked,
            direction_error_in_physics_deg: reached,
            ..
        } = self;
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

//! How fast and how far a set of clips moves.

use emp_robot::Robot;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::GoalClip;
use crate::quantile::quantile;

/// Key nodes of the wrists, left and right: the last of [`emp_robot::KEY_NODE_NAMES`].
const WRISTS: [usize; 2] = [6, 7];

/// How hard a set of goals is: what a success rate has to be read with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GoalStatistics {
    /// Number of goals.
    pub frames: usize,
    /// Speed of each frame's fastest joint, rad/s.
    pub joint_speed: Spread,
    /// Speed of each frame's faster hand in the pelvis frame, m/s.
    pub hand_speed: Spread,
    /// Distance of each frame's farthest joint from the default pose, rad.
    pub amplitude: Spread,
}

/// Mean and 95th percentile.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// 95th percentile.
    pub p95: f64,
}

impl GoalStatistics {
    /// Statistics over all frames of `clips`; none where no clip has two frames.
    pub fn of<'a>(robot: &Robot, clips: impl IntoIterator<Item = &'a GoalClip>) -> Option<Self> {
        let mut kinematics = robot.kinematics().frame();
        let mut wrists = |goal: &[f32]| -> [Vector3<f64>; 2] {
            let angles: Vec<f64> = goal.iter().map(|&angle| f64::from(angle)).collect();
            kinematics.update(&angles);
            WRISTS.map(|node| kinematics.positions()[node])
        };
        let rate = robot.control_rate_hz();
        let default: Vec<f32> = robot
            .goal_joints()
            .iter()
            .map(|joint| joint.default as f32)
            .collect();
        let (mut joints, mut hands, mut amplitudes) = (Vec::new(), Vec::new(), Vec::new());
        for clip in clips {
            let mut previous: Option<(&[f32], [Vector3<f64>; 2])> = None;
            for goal in clip.frames() {
                let here = wrists(goal);
                if let Some((goal_before, before)) = previous {
                    joints.push(rate * farthest(goal, goal_before));
                    let moved = here.iter().zip(&before).map(|(a, b)| (a - b).norm());
                    hands.push(rate * moved.fold(0.0, f64::max));
                }
                amplitudes.push(farthest(goal, &default));
                previous = Some((goal, here));
            }
        }
        Some(Self {
            frames: amplitudes.len(),
            joint_speed: Spread::of(joints)?,
            hand_speed: Spread::of(hands)?,
            amplitude: Spread::of(amplitudes)?,
        })
    }
}

/// Speed of each frame's faster hand in the pelvis frame, m/s, slowest first; empty for a clip of one frame.
pub(super) fn hand_speeds(robot: &Robot, clip: &GoalClip) -> Vec<f64> {
    let mut kinematics = robot.kinematics().frame();
    let mut before: Option<[Vector3<f64>; 2]> = None;
    let mut speeds = Vec::with_capacity(clip.len());
    for goal in clip.frames() {
        let angles: Vec<f64> = goal.iter().map(|&angle| f64::from(angle)).collect();
        kinematics.update(&angles);
        let here = WRISTS.map(|node| kinematics.positions()[node]);
        if let Some(before) = before {
            let moved = here.iter().zip(&before).map(|(a, b)| (a - b).norm());
            speeds.push(robot.control_rate_hz() * moved.fold(0.0, f64::max));
        }
        before = Some(here);
    }
    speeds.sort_by(f64::total_cmp);
    speeds
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        Some(Self {
            p95: quantile(&values, 0.95)?,
            mean: values.iter().sum::<f64>() / values.len() as f64,
        })
    }
}

/// Largest difference of a joint between two poses, rad.
fn farthest(a: &[f32], b: &[f32]) -> f64 {
    let distances = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs()));
    distances.fold(0.0, f64::max)
}

//! Hard motions: what fells a robot now and then.

use anyhow::{Context, Result};
use emp_client::{Client, StreamConfig};
use emp_motion::{Clip, KeyNodeFrame, skills};
use emp_robot::Robot;
use emp_sim::goals::{GoalClip, Source};

use crate::motion::Motion;
use crate::posture::robot_pose;
use crate::stream::Stream;

/// Motions that reach farther than people do.
///
/// The amplitude is that of evaluations: it multiplies the distance of the retargeted goals from the robot's default pose. The
/// person of such a motion holds the arms as a robot does that stands in these goals.
pub(crate) struct HardMotions {
    /// The motions as people do them.
    pub(crate) sources: Vec<Clip>,
    pub(crate) amplitude: f64,
}

impl HardMotions {
    /// The first `count` motions of the procedural library with this seed.
    pub(crate) fn procedural(seed: u64, count: usize, amplitude: f64) -> Self {
        Self {
            sources: skills::library(seed, count),
            amplitude,
        }
    }

    /// One recording.
    pub(crate) fn recorded(clip: Clip, amplitude: f64) -> Self {
        Self {
            sources: vec![clip],
            amplitude,
        }
    }

    /// Motion `number`, counted from 0, as a person of that amplitude does it; at the robot's control rate.
    pub(crate) async fn perform(
        &self,
        number: usize,
        client: &Client,
        robot: &Robot,
    ) -> Result<Motion> {
        let source = &self.sources[number];
        let clip = source.resampled(robot.control_rate_hz())?;
        let goals = retargeted(client, robot, &clip).await?;
        let goals = GoalClip::new(robot, &clip.name, Source::Procedural, &goals)?;
        let wide = goals.scaled_amplitude(robot, self.amplitude as f32);
        let name = without_seed(&clip.name).to_owned();
        let frames = goal_poses(robot, wide.frames());
        Ok(Motion::whole(name, Clip { frames, ..clip }))
    }
}

/// The server's goals for a clip, refined and smoothed.
async fn retargeted(client: &Client, robot: &Robot, clip: &Clip) -> Result<Vec<Vec<f32>>> {
    let config = StreamConfig {
        refine: true,
        smoothing: true,
        ..StreamConfig::for_robot(robot.name())
    };
    let mut stream = Stream::new(client.stream(config).await?);
    let mut goals = Vec::with_capacity(clip.frames.len());
    for pose in &clip.frames {
        let answer = stream.ask(pose).await.context("retargeting")?;
        goals.push(answer.joint_angles);
    }
    stream.finish().await?;
    Ok(goals)
}

/// The key nodes of a robot with its goal joints at each of the goals, in the frame of its base.
pub(crate) fn goal_poses<'a>(
    robot: &Robot,
    goals: impl Iterator<Item = &'a [f32]>,
) -> Vec<KeyNodeFrame> {
    let mut kinematics = robot.kinematics().frame();
    let pose = |goal: &[f32]| {
        let goal: Vec<f64> = goal.iter().map(|&angle| f64::from(angle)).collect();
        kinematics.update(&goal);
        robot_pose(kinematics.positions(), kinematics.wrist_rotations())
    };
    goals.map(pose).collect()
}

/// A procedural motion's name without the seed at its end.
fn without_seed(name: &str) -> &str {
    match name.rsplit_once('-') {
        Some((skill, seed)) if seed.bytes().all(|digit| digit.is_ascii_digit()) => skill,
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_no_names() {
        assert_eq!(without_seed("lift-box-18281320560898357213"), "lift-box");
        assert_eq!(without_seed("person_1-walk"), "person_1-walk");
        let motions = HardMotions::procedural(1, 4, 1.8);
        assert_eq!(motions.sources.len(), 4);
        assert_eq!(
            motions.sources[..2],
            HardMotions::procedural(1, 2, 1.8).sources
        );
    }
}

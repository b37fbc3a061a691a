//! A robot at the other end of the wire that is teleoperated at its control rate: what the benchmarks measure.

use std::time::Duration;

use anyhow::bail;
use emp_client::{Client, EmpMode, Event, PolicyConfig, RobotFrame, StreamConfig};
use nalgebra::UnitQuaternion;

use crate::{emp27, poses};

const ROBOT: &str = "emp27";

/// Control rate of the robot, Hz.
pub const RATE: f64 = 50.0;
/// How long the robot is teleoperated.
pub const TELEOPERATED: Duration = Duration::from_secs(20);

/// Round trips of a robot's control periods, in order of length: a pose becomes a goal; goal and state become an executable goal
/// and leg targets.
///
/// # Errors
/// When a stream fails or a frame is not answered.
pub async fn teleoperate(client: &Client, emp_mode: EmpMode) -> anyhow::Result<Vec<Duration>> {
    let robot = emp27()?;
    let retarget = StreamConfig {
        refine: true,
        smoothing: true,
        ..StreamConfig::for_robot(ROBOT)
    };
    let policy = PolicyConfig {
        emp_mode,
        ..PolicyConfig::for_robot(ROBOT)
    };
    let (mut poses_out, mut goals) = client.stream(retarget).await?;
    let (mut states_out, mut targets) = client.policy_stream(policy).await?;
    let frames = (TELEOPERATED.as_secs_f64() * RATE) as usize;
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
    let mut times = Vec::with_capacity(frames);
    for pose in &poses(1, frames) {
        let tick = ticks.tick().await;
        poses_out.send(pose, None).await?;
        let Some(Event::Answer(goal)) = goals.next().await? else {
            bail!("a pose without an answer")
        };
        let state = RobotFrame {
            joint_positions: robot.default_pose(),
            orientation: UnitQuaternion::identity(),
            goal: goal.joint_angles,
            reset: false,
        };
        states_out.send(&state, None).await?;
        let Some(Event::Answer(_)) = targets.next().await? else {
            bail!("a state without an answer")
        };
        times.push(tick.elapsed());
    }
    times.sort_unstable();
    Ok(times)
}

/// Milliseconds of a share of times in order; NaN of none.
pub fn at(times: &[Duration], share: f64) -> f64 {
    let place = times.len().saturating_sub(1) as f64 * share;
    times
        .get(place as usize)
        .map_or(f64::NAN, |time| 1e3 * time.as_secs_f64())
}

//! The control loop: a person's pose and the robot's state go over the wire, joint targets come back, into the physics.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use emp_client::{Client, EmpMode};
use emp_motion::Clip;
use emp_robot::Robot;
use emp_sim::Reading;
use emp_sim::environment::{EndReason, EnvironmentConfig};
use tokio::time::{Instant, sleep_until, timeout_at};

use crate::disturbances::Disturbances;
use crate::simulator::Simulator;
use crate::teleoperation::{Answered, Teleoperation};

/// When control periods begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    /// By the clock. If the answer is not there when the period ends, the robot keeps the targets that it has, as a real one
    /// would, and what comes late is thrown away.
    RealTime,
    /// When the one before is over, however long its answer takes: a run depends on nothing but what goes in.
    LockStep,
}

/// One control period.
pub(crate) struct Period {
    /// What the server answered; of an unanswered period the answer before.
    pub(crate) answer: Answered,
    /// Whether the answer came before the period's end. If not, the robot kept the targets that it had.
    pub(crate) answered: bool,
    /// From the robot's state to its new targets; of an unanswered period, how long the robot waited.
    pub(crate) round_trip: Duration,
    /// Whether the robot was pushed at its beginning.
    pub(crate) pushed: bool,
    /// What was measured at its end.
    pub(crate) reading: Reading,
}

/// Everything that happened.
pub(crate) struct Run {
    /// What was measured before the first period.
    pub(crate) start: Reading,
    /// The control periods that the robot went through: all of the motion, or those up to its fall.
    pub(crate) periods: Vec<Period>,
    /// Why the robot fell in the last of them, if it did.
    pub(crate) fall: Option<EndReason>,
    /// From the first period's beginning to the last one's end.
    pub(crate) wall_time: Duration,
}

/// Lets the robot follow the clip until the clip's end or the robot's fall. It starts in its default pose; the server brings it
/// to the person's.
pub(crate) async fn run(
    client: &Client,
    robot: &Arc<Robot>,
    clip: &Clip,
    mut disturbances: Disturbances,
    emp_mode: EmpMode,
    pace: Pace,
) -> Result<Run> {
    ensure!(!clip.frames.is_empty(), "the motion has no frames");
    let mut server = Teleoperation::start(client, robot, emp_mode).await?;
    let mut last = Answered::resting(robot);
    let goal = last.targets.goal.clone();
    let (mut simulator, start) = Simulator::start(robot, disturbances.hand_load, &goal).await?;

    let limits = EnvironmentConfig::default();
    let length = Duration::from_secs_f64(1.0 / robot.control_rate_hz());
    let begin = Instant::now();
    let due = |number: usize| begin + length * number as u32;
    let mut periods: Vec<Period> = Vec::with_capacity(clip.frames.len());
    let mut fall = None;
    for (number, pose) in clip.frames.iter().enumerate() {
        if pace == Pace::RealTime {
            sleep_until(due(number)).await;
        }
        let woke = Instant::now();
        let reading = periods.last().map_or(&start, |period| &period.reading);
        let asked = server.ask(pose, reading);
        let answer = match pace {
            Pace::RealTime => timeout_at(due(number + 1), asked).await.ok().transpose(),
            Pace::LockStep => asked.await.map(Some),
        };
        let answer = answer.with_context(|| format!("frame {number}"))?;
        let round_trip = woke.elapsed();
        let answered = answer.is_some();
        last = answer.unwrap_or_else(|| last.again());
        let push = disturbances.push(number);
        let reading = simulator.step(last.targets.clone(), push).await?;
        fall = limits.fall(&reading, robot.standing_height());
        periods.push(Period {
            answer: last.clone(),
            answered,
            round_trip,
            pushed: push.is_some(),
            reading,
        });
        if fall.is_some() {
            break;
        }
    }
    if pace == Pace::RealTime {
        sleep_until(due(periods.len())).await;
    }
    let wall_time = begin.elapsed();
    server.finish().await?;
    Ok(Run {
        start,
        periods,
        fall,
        wall_time,
    })
}

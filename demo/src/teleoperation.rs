//! The stream that closes the loop: `Teleoperate` with both ends in one client.

use std::time::Duration;

use anyhow::{Context, Result};
use emp_client::{
    Client, EmpMode, GoalPhase, GuardReport, OperatorInput, RampCause, TeleoperatedFrame,
    TeleoperationAnswer, TeleoperationConfig, TeleoperationFrame,
};
use emp_motion::KeyNodeFrame;
use emp_robot::Robot;
use emp_sim::Reading;

use crate::simulator::JointTargets;
use crate::stream::{Numbered, Stream};

/// What the server answers to a control period.
#[derive(Clone)]
pub(crate) struct Answered {
    /// What the person's pose asks of the goal joints, radians.
    pub(crate) person: Vec<f32>,
    /// The goal before the EMP, radians: that of the person, or on a ramp to it.
    pub(crate) goal: Vec<f32>,
    /// What the robot's motors are to follow.
    pub(crate) targets: JointTargets,
    /// When the EMP changes goals.
    pub(crate) emp_mode: EmpMode,
    /// How far the centre of mass is inside the support polygon of the feet, metres; none before the first answer.
    pub(crate) margin: Option<f32>,
    /// What the guards did, in words.
    pub(crate) guards: Vec<String>,
    /// Time in the retargeter, and in EMP and policy; none where nothing was computed.
    pub(crate) times: Option<[Duration; 2]>,
}

impl Answered {
    /// A robot in its default pose that was not told anything yet.
    pub(crate) fn resting(robot: &Robot) -> Self {
        let goal = robot.default_goal();
        Self {
            person: goal.clone(),
            goal: goal.clone(),
            targets: JointTargets {
                goal,
                legs: robot.default_legs(),
            },
            emp_mode: EmpMode::Unspecified,
            margin: None,
            guards: Vec::new(),
            times: None,
        }
    }

    /// The same for a period that was not answered.
    pub(crate) fn again(&self) -> Self {
        Self {
            guards: Vec::new(),
            times: None,
            ..self.clone()
        }
    }

    fn new(frame: TeleoperatedFrame, joints: &[String]) -> Result<Self> {
        let emp_mode = frame.emp_mode();
        let pose = frame.pose.context("an answer without a pose")?;
        let filter = frame.filter.context("an answer without an assessment")?;
        let time = |timing: Option<&emp_client::Timing>| -> Option<Duration> {
            timing?.inference_time?.try_into().ok()
        };
        let times = time(pose.timing.as_ref()).zip(time(frame.timing.as_ref()));
        Ok(Self {
            person: pose.goal,
            goal: frame.goal,
            targets: JointTargets {
                goal: filter.executable_goal,
                legs: frame.leg_targets,
            },
            emp_mode,
            margin: Some(filter.center_of_mass_margin),
            guards: frame
                .guard
                .as_ref()
                .map_or_else(Vec::new, |guard| in_words(guard, joints)),
            times: times.map(|(retargeter, policy)| [retargeter, policy]),
        })
    }
}

/// What the guards did in a control period.
fn in_words(report: &GuardReport, joints: &[String]) -> Vec<String> {
    let phase = match (report.phase(), report.cause()) {
        (GoalPhase::Unspecified | GoalPhase::Following, _) => None,
        (GoalPhase::Ramping, RampCause::OperatorReturned) => Some("ramp to the person's pose"),
        (GoalPhase::Ramping, _) => Some("ramp from the measured pose"),
        (GoalPhase::Holding, _) => Some("hold without a fresh pose"),
        (GoalPhase::Returning, _) => Some("return to the default pose"),
        (GoalPhase::Resting, _) => Some("rest in the default pose"),
    };
    let fade = report.emp_progress.map(|_| "blend the EMP in");
    let limited = report.speed_limited_joints.iter();
    let limited = limited.filter_map(|&joint| joints.get(joint as usize));
    let limited = limited.map(|joint| format!("limit the speed of {joint}"));
    let stages = phase.into_iter().chain(fade).map(str::to_owned);
    stages.chain(limited).collect()
}

/// A stream in which the robot follows the person.
pub(crate) struct Teleoperation {
    stream: Stream<TeleoperationFrame, TeleoperationAnswer>,
    /// Names of the goal joints.
    joints: Vec<String>,
    /// The simulated robot's clock, and how far it goes on in a control period.
    time: Duration,
    period: Duration,
}

impl Numbered for TeleoperationAnswer {
    fn number(&self) -> u64 {
        self.sequence_number
    }
}

impl Teleoperation {
    pub(crate) async fn start(client: &Client, robot: &Robot, emp_mode: EmpMode) -> Result<Self> {
        let config = TeleoperationConfig {
            emp_mode: Some(emp_mode),
            simulated: true,
            ..TeleoperationConfig::new(robot.name(), "")
        };
        let stream = Stream::new(client.teleoperate(config).await?);
        stream.check_joints(robot.joints().map(|joint| joint.name.as_str()))?;
        let goal_joints = robot.goal_joints().iter();
        Ok(Self {
            stream,
            joints: goal_joints.map(|joint| joint.name.clone()).collect(),
            time: Duration::ZERO,
            period: Duration::from_secs_f64(1.0 / robot.control_rate_hz()),
        })
    }

    /// A pose and the robot's state become targets.
    pub(crate) async fn ask(&mut self, pose: &KeyNodeFrame, reading: &Reading) -> Result<Answered> {
        self.time += self.period;
        let frame = TeleoperationFrame {
            operator: Some(OperatorInput::pose(pose)),
            joint_positions: reading.joint_positions.clone(),
            orientation: reading.orientation,
            measured: Some(self.time),
            reset: false,
        };
        Answered::new(self.stream.ask(&frame).await?.result, &self.joints)
    }

    /// Ends the stream and waits for what is still on its way.
    pub(crate) async fn finish(self) -> Result<()> {
        self.stream.finish().await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_guard_has_its_words() {
        let mut report = GuardReport {
            phase: GoalPhase::Following.into(),
            ..GuardReport::default()
        };
        let joints = ["waist_yaw".to_owned()];
        let words = |report: &GuardReport| in_words(report, &joints);
        assert!(words(&report).is_empty());
        report.phase = GoalPhase::Ramping.into();
        report.cause = RampCause::FirstFrame.into();
        report.emp_progress = Some(0.5);
        report.speed_limited_joints = vec![0];
        assert_eq!(
            words(&report),
            [
                "ramp from the measured pose",
                "blend the EMP in",
                "limit the speed of waist_yaw"
            ]
        );
        report.cause = RampCause::OperatorReturned.into();
        assert_eq!(words(&report)[0], "ramp to the person's pose");
    }
}

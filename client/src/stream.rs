//! Both ends of a stream as a program holds them.

use std::time::Duration;

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    Delivery, DropReason, EmpMode, FilterResult, StreamFilterGoalConfig, StreamPolicyConfig,
    StreamRetargetConfig,
};
use nalgebra::UnitQuaternion;
use tokio::sync::mpsc;

use crate::ClientError;

/// What holds for a whole stream of poses.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamConfig {
    /// The robot's name.
    pub robot: String,
    /// The model's name; empty for the robot's own.
    pub model: String,
    /// The version that the model must have; empty for any.
    pub model_version: String,
    /// Whether every frame is computed, or only the newest.
    pub delivery: Delivery,
    /// Whether each answer is refined.
    pub refine: bool,
    /// Whether the answers are smoothed over time.
    pub smoothing: bool,
}

impl StreamConfig {
    /// Every frame, with the robot's own model, as the network answers.
    pub fn for_robot(robot: impl Into<String>) -> Self {
        Self {
            robot: robot.into(),
            model: String::new(),
            model_version: String::new(),
            delivery: Delivery::All,
            refine: false,
            smoothing: false,
        }
    }

    pub(crate) fn message(&self) -> StreamRetargetConfig {
        StreamRetargetConfig {
            robot: self.robot.clone(),
            model: self.model.clone(),
            model_version: self.model_version.clone(),
            delivery: self.delivery.into(),
            refine: self.refine,
            smoothing: self.smoothing,
        }
    }
}

/// What holds for a whole stream of robot states.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyConfig {
    /// The robot's name.
    pub robot: String,
    /// The policy's name; empty for the robot's own.
    pub model: String,
    /// The version that the policy must have; empty for any.
    pub model_version: String,
    /// Whether every frame is computed, or only the newest.
    pub delivery: Delivery,
    /// When the robot's EMP changes goals before the policy sees them; unspecified for always, where it has one.
    pub emp_mode: EmpMode,
}

impl PolicyConfig {
    /// The newest frame, with the robot's own policy, goals changed by its EMP where it has one.
    pub fn for_robot(robot: impl Into<String>) -> Self {
        Self {
            robot: robot.into(),
            model: String::new(),
            model_version: String::new(),
            delivery: Delivery::Latest,
            emp_mode: EmpMode::Unspecified,
        }
    }

    pub(crate) fn message(&self) -> StreamPolicyConfig {
        StreamPolicyConfig {
            robot: self.robot.clone(),
            model: self.model.clone(),
            model_version: self.model_version.clone(),
            delivery: self.delivery.into(),
            emp_mode: self.emp_mode.into(),
        }
    }
}

/// What holds for a whole stream of goals to filter, or for a single one.
#[derive(Debug, Clone, PartialEq)]
pub struct FilterConfig {
    /// The robot's name.
    pub robot: String,
    /// The EMP's name; empty for the robot's own.
    pub model: String,
    /// The version that the EMP must have; empty for any.
    pub model_version: String,
    /// Whether every frame is computed, or only the newest.
    pub delivery: Delivery,
    /// When the EMP changes goals; unspecified for always.
    pub emp_mode: EmpMode,
}

impl FilterConfig {
    /// The newest frame, always with the robot's own EMP.
    pub fn for_robot(robot: impl Into<String>) -> Self {
        Self {
            robot: robot.into(),
            model: String::new(),
            model_version: String::new(),
            delivery: Delivery::Latest,
            emp_mode: EmpMode::On,
        }
    }

    pub(crate) fn message(&self) -> StreamFilterGoalConfig {
        StreamFilterGoalConfig {
            robot: self.robot.clone(),
            model: self.model.clone(),
            model_version: self.model_version.clone(),
            delivery: self.delivery.into(),
            emp_mode: self.emp_mode.into(),
        }
    }
}

/// One control period of a robot whose legs are moved by the program: what it measures, what its upper body is asked to do.
#[derive(Debug, Clone, PartialEq)]
pub struct GoalFrame {
    /// Angles of all joints, the goal joints before the leg joints, radians.
    pub joint_positions: Vec<f32>,
    /// Orientation of the base in a world frame with z up.
    pub orientation: UnitQuaternion<f64>,
    /// Angles that the goal joints are asked to take, radians.
    pub goal: Vec<f32>,
    /// The action of the control period before, one number a leg joint: (leg target − default angle) / the robot's action
    /// scale; empty at the start of an episode.
    pub last_action: Vec<f32>,
    /// Whether this is the first control period of an episode.
    pub reset: bool,
}

/// The last control periods of a robot, for a single call.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GoalHistory<'a> {
    /// Oldest first; the last one is now, those before it have the goals that were executed.
    pub frames: &'a [GoalFrame],
    /// Yaw of the base when the episode started, radians; none for that of the oldest frame.
    pub start_heading: Option<f32>,
    /// Share of the EMP's correction that was executed in the control period before, 0 to 1.
    pub last_applied: f32,
}

/// The answer to one goal.
#[derive(Debug, Clone, PartialEq)]
pub struct FilterAnswer {
    /// The frame's number, as [`FrameSender::send`] gave it.
    pub sequence_number: u64,
    /// What became of the goal.
    pub result: FilterResult,
    /// Where the time went.
    pub times: AnswerTimes,
}

/// One control period of a robot: what it measures, and what its upper body is to do.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotFrame {
    /// Angles of all joints, the goal joints before the leg joints, radians.
    pub joint_positions: Vec<f32>,
    /// Orientation of the base in a world frame with z up.
    pub orientation: UnitQuaternion<f64>,
    /// Angles that the goal joints are to take, radians.
    pub goal: Vec<f32>,
    /// Whether this is the first control period of an episode.
    pub reset: bool,
}

/// The answer to one control period.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyAnswer {
    /// The frame's number, as [`FrameSender::send`] gave it.
    pub sequence_number: u64,
    /// Angles for the goal joints as they should be executed, radians.
    pub executable_goal: Vec<f32>,
    /// The policy's action, one number a leg joint.
    pub action: Vec<f32>,
    /// Target angles of the leg joints, radians.
    pub leg_targets: Vec<f32>,
    /// What became of the goal; none where the EMP is off.
    pub filter: Option<FilterResult>,
    /// Where the time went.
    pub times: AnswerTimes,
}

/// Where the time of one answer went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AnswerTimes {
    /// How long the frame waited for the model.
    pub queue_time: Duration,
    /// How long the model took for the batch.
    pub inference_time: Duration,
    /// How many frames the batch had.
    pub batch_size: u32,
    /// From sending the frame to receiving the answer, on the client's clock. A frame that was sent again counts from
    /// its first time.
    pub latency: Duration,
}

/// The answer to one pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// The frame's number, as [`FrameSender::send`] gave it.
    pub sequence_number: u64,
    /// Joint angles in the robot's goal order, radians.
    pub joint_angles: Vec<f32>,
    /// Mean angle between the person's and the robot's arm bones, radians.
    pub direction_error: f32,
    /// The goal joints that stand at a limit, by their places.
    pub joints_at_limit: Vec<u32>,
    /// Where the time went.
    pub times: AnswerTimes,
}

/// A frame without an answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dropped {
    /// The frame's number.
    pub sequence_number: u64,
    /// Why.
    pub cause: DropCause,
    /// The field that is wrong, where one is.
    pub field: String,
    /// What happened, in words.
    pub description: String,
}

/// Why a frame was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DropCause {
    /// The server said so.
    Server(DropReason),
    /// It was on its way when the connection was lost, or sent while there was none.
    ConnectionLost,
}

impl DropCause {
    /// The cause in lower case, for example `superseded`.
    pub fn name(self) -> String {
        match self {
            Self::Server(reason) => {
                let name = reason.as_str_name();
                name.strip_prefix("DROP_REASON_")
                    .unwrap_or(name)
                    .to_lowercase()
            }
            Self::ConnectionLost => "connection_lost".to_owned(),
        }
    }
}

/// What a stream tells; `A` is what it answers to a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Event<A = Answer> {
    /// A frame was answered.
    Answer(A),
    /// A frame was dropped.
    Dropped(Dropped),
    /// The connection was lost, or an attempt to restore it failed.
    ConnectionLost {
        /// What the transport or the server said.
        reason: String,
        /// The attempt that comes next, counted from 1.
        attempt: u32,
        /// When it comes.
        retry_in: Duration,
    },
    /// The server is being stopped. A robot is served on for a while; a program that knows another server moves there.
    GoingAway {
        /// For how long.
        grace: Duration,
    },
    /// The connection stands again.
    Reconnected {
        /// How many frames are sent again: poses with delivery `ALL`.
        resent: usize,
    },
}

/// The sending end. Dropping it half-closes the stream: what is on its way is still answered.
#[derive(Debug)]
pub struct FrameSender<F = KeyNodeFrame> {
    pub(crate) frames: mpsc::Sender<Outbound<F>>,
    pub(crate) next_number: u64,
}

/// A frame on its way to the connection.
#[derive(Debug)]
pub(crate) struct Outbound<F> {
    pub(crate) number: u64,
    pub(crate) frame: F,
    pub(crate) time_budget: Option<Duration>,
}

/// The stream has ended; its [`StreamEvents`] say why.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the stream has ended")]
pub struct StreamClosed;

impl<F: Clone> FrameSender<F> {
    /// Sends a frame and gives its number: 0, 1, 2 … Waits while the server is behind (delivery `ALL`).
    ///
    /// # Errors
    /// When the stream has ended.
    pub async fn send(
        &mut self,
        frame: &F,
        time_budget: Option<Duration>,
    ) -> Result<u64, StreamClosed> {
        let number = self.next_number;
        let outbound = Outbound {
            number,
            frame: frame.clone(),
            time_budget,
        };
        self.frames.send(outbound).await.map_err(|_| StreamClosed)?;
        self.next_number += 1;
        Ok(number)
    }
}

/// The receiving end. Dropping it cancels the stream.
#[derive(Debug)]
pub struct StreamEvents<A = Answer> {
    pub(crate) joint_names: Vec<String>,
    pub(crate) model: String,
    pub(crate) model_version: String,
    pub(crate) events: mpsc::Receiver<Result<Event<A>, ClientError>>,
}

impl<A> StreamEvents<A> {
    /// Names of the joints: those of every answer to a pose, or those of a robot's state (the goal joints, then the leg
    /// joints), in order.
    pub fn joint_names(&self) -> &[String] {
        &self.joint_names
    }

    /// Name and version of the model that answers.
    pub fn model(&self) -> (&str, &str) {
        (&self.model, &self.model_version)
    }

    /// The next event; none once every frame was answered or dropped and the sender is gone.
    ///
    /// # Errors
    /// When the stream ended before that. It is the last event.
    pub async fn next(&mut self) -> Result<Option<Event<A>>, ClientError> {
        self.events.recv().await.transpose()
    }
}

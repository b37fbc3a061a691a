//! Teleoperation as a program holds it: one config for every end of a session, what its ends send, what they are told.

use std::time::Duration;

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    self, Delivery, EmpMode, TeleoperateConfig, TeleoperateRequest, TeleoperateResponse,
    TeleoperatedFrame, TeleoperationPresence, TeleoperationRole, TeleoperationStarted,
    motion_service_client::MotionServiceClient, teleoperate_request::Message as Request,
    teleoperate_response::Message as Response,
};
use nalgebra::UnitQuaternion;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::{
    AnswerTimes, ClientError, Dropped, StreamClosed,
    endpoint::Channel,
    kind::{Incoming, Kind, Started},
    wire,
};

/// What holds for a whole stream of a teleoperation session. Each end takes from it what concerns it.
#[derive(Debug, Clone, PartialEq)]
pub struct TeleoperationConfig {
    /// Name of the session. Only a client with both ends may leave it empty: then nobody can join.
    pub session: String,
    /// The robot's name; everyone in a session names the same.
    pub robot: String,
    /// Whether every frame of the robot is computed, or only the newest.
    pub delivery: Delivery,
    /// When the EMP changes goals; unspecified for what the session has.
    pub emp_mode: EmpMode,
    /// The policy's name; empty for the robot's own.
    pub policy: String,
    /// The version that the policy must have; empty for any.
    pub policy_version: String,
    /// The retargeting model's name; empty for the robot's own.
    pub retargeter: String,
    /// The version that the retargeting model must have; empty for any.
    pub retargeter_version: String,
    /// Whether each answer of the retargeting network is refined.
    pub refine: bool,
    /// Whether the goal is smoothed over time.
    pub smoothing: bool,
}

impl TeleoperationConfig {
    /// Every frame, with the robot's own models, refined and smoothed.
    pub fn new(robot: impl Into<String>, session: impl Into<String>) -> Self {
        Self {
            session: session.into(),
            robot: robot.into(),
            delivery: Delivery::All,
            emp_mode: EmpMode::Unspecified,
            policy: String::new(),
            policy_version: String::new(),
            retargeter: String::new(),
            retargeter_version: String::new(),
            refine: true,
            smoothing: true,
        }
    }

    pub(crate) fn request(&self, role: TeleoperationRole) -> TeleoperateRequest {
        let config = TeleoperateConfig {
            session: self.session.clone(),
            role: role.into(),
            robot: self.robot.clone(),
            delivery: self.delivery.into(),
            emp_mode: self.emp_mode.into(),
            policy: self.policy.clone(),
            policy_version: self.policy_version.clone(),
            retargeter: self.retargeter.clone(),
            retargeter_version: self.retargeter_version.clone(),
            refine: self.refine,
            smoothing: self.smoothing,
        };
        TeleoperateRequest {
            message: Some(Request::Config(config)),
        }
    }
}

/// One control period of a teleoperated robot.
#[derive(Debug, Clone, PartialEq)]
pub struct TeleoperationFrame {
    /// The person's pose, where the client holds that end too and has a newer one.
    pub pose: Option<KeyNodeFrame>,
    /// Angles of all joints, the goal joints before the leg joints, radians.
    pub joint_positions: Vec<f32>,
    /// Orientation of the base in a world frame with z up.
    pub orientation: UnitQuaternion<f64>,
    /// Whether this is the first control period of an episode.
    pub reset: bool,
    /// When the EMP changes goals from now on; unspecified for no change.
    pub emp_mode: EmpMode,
}

/// The answer to one control period.
#[derive(Debug, Clone, PartialEq)]
pub struct TeleoperationAnswer {
    /// The frame's number, as [`FrameSender::send`](crate::FrameSender::send) gave it.
    pub sequence_number: u64,
    /// What the robot is to do, and how it came about.
    pub result: TeleoperatedFrame,
    /// From sending the frame to receiving the answer, on the client's clock.
    pub latency: Duration,
}

/// What an operator or an observer is told.
#[derive(Debug, Clone, PartialEq)]
pub enum SessionEvent {
    /// A control period of the session's robot.
    Executed(Box<TeleoperatedFrame>),
    /// Someone came or left.
    Presence(TeleoperationPresence),
    /// A pose of this operator is not used.
    Dropped(Dropped),
    /// The connection was lost, or an attempt to restore it failed. Poses that are sent meanwhile are lost.
    ConnectionLost {
        /// What the transport or the server said.
        reason: String,
        /// The attempt that comes next, counted from 1.
        attempt: u32,
        /// When it comes.
        retry_in: Duration,
    },
    /// The connection stands again.
    Reconnected,
}

/// An operator's sending end. Dropping it leaves the session.
#[derive(Debug)]
pub struct PoseSender {
    pub(crate) poses: mpsc::Sender<TeleoperateRequest>,
    pub(crate) next_number: u64,
}

impl PoseSender {
    /// Sends a pose, with another mode of the EMP unless that is unspecified, and gives its number: 0, 1, 2 …
    ///
    /// # Errors
    /// When the stream has ended.
    pub async fn send(
        &mut self,
        pose: &KeyNodeFrame,
        emp_mode: EmpMode,
    ) -> Result<u64, StreamClosed> {
        let number = self.next_number;
        let frame = v1::TeleoperationFrame {
            header: Some(wire::header(number, None)),
            pose: Some(wire::pose(pose)),
            emp_mode: emp_mode.into(),
            ..v1::TeleoperationFrame::default()
        };
        let request = TeleoperateRequest {
            message: Some(Request::Frame(frame)),
        };
        self.poses.send(request).await.map_err(|_| StreamClosed)?;
        self.next_number += 1;
        Ok(number)
    }
}

/// The receiving end of an operator or an observer. Dropping it leaves the session.
#[derive(Debug)]
pub struct SessionEvents {
    pub(crate) started: TeleoperationStarted,
    pub(crate) events: mpsc::Receiver<Result<SessionEvent, ClientError>>,
}

impl SessionEvents {
    /// What the server said when the stream joined the session.
    pub fn started(&self) -> &TeleoperationStarted {
        &self.started
    }

    /// The next event; none once an operator has left.
    ///
    /// # Errors
    /// When the stream ended before that. It is the last event.
    pub async fn next(&mut self) -> Result<Option<SessionEvent>, ClientError> {
        self.events.recv().await.transpose()
    }
}

/// An end that sends the robot's frames.
#[derive(Debug, Clone)]
pub(crate) struct RobotEnd {
    pub(crate) config: TeleoperationConfig,
    pub(crate) role: TeleoperationRole,
}

pub(crate) async fn call(
    mut service: MotionServiceClient<Channel>,
    requests: ReceiverStream<TeleoperateRequest>,
) -> Result<Streaming<TeleoperateResponse>, Status> {
    Ok(service.teleoperate(requests).await?.into_inner())
}

impl Kind for RobotEnd {
    type Frame = TeleoperationFrame;
    type Answer = TeleoperationAnswer;
    type Request = TeleoperateRequest;
    type Response = TeleoperateResponse;
    type Result = TeleoperatedFrame;

    const RESENDS: bool = false;

    fn first(&self) -> TeleoperateRequest {
        self.config.request(self.role)
    }

    fn delivery(&self) -> Delivery {
        self.config.delivery
    }

    fn frame(header: v1::FrameHeader, frame: &TeleoperationFrame) -> TeleoperateRequest {
        let frame = v1::TeleoperationFrame {
            header: Some(header),
            pose: frame.pose.as_ref().map(wire::pose),
            state: Some(wire::state(&frame.joint_positions, &frame.orientation)),
            reset: frame.reset,
            emp_mode: frame.emp_mode.into(),
        };
        TeleoperateRequest {
            message: Some(Request::Frame(frame)),
        }
    }

    async fn call(
        service: MotionServiceClient<Channel>,
        requests: ReceiverStream<TeleoperateRequest>,
    ) -> Result<Streaming<TeleoperateResponse>, Status> {
        call(service, requests).await
    }

    fn sort(response: TeleoperateResponse) -> Option<Incoming<Self>> {
        match response.message? {
            Response::Started(started) => Some(Incoming::Started(Started {
                model: started.policy,
                model_version: started.policy_version,
                joint_names: [started.goal_joint_names, started.leg_joint_names].concat(),
            })),
            Response::Result(result) => Some(Incoming::Result {
                number: result.header.unwrap_or_default().sequence_number,
                timing: result.timing,
                result: Some(result),
            }),
            Response::Dropped(message) => Some(Incoming::Dropped(message)),
            // Only listeners are told who comes and goes.
            Response::Presence(_) => None,
        }
    }

    fn answer(number: u64, result: TeleoperatedFrame, times: AnswerTimes) -> TeleoperationAnswer {
        TeleoperationAnswer {
            sequence_number: number,
            result,
            latency: times.latency,
        }
    }
}

//! Teleoperation as a program holds it: one config for every end of a session, what its ends send, what they are told.

use std::time::Duration;

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    self, BothConfig, BothFrame, EmpMode, ObserverConfig, OperatorConfig, OperatorFrame,
    RobotConfig, SessionPresence, TeleoperateConfig, TeleoperateRequest, TeleoperateResponse,
    TeleoperatedFrame, TeleoperationStarted, teleoperate_config::Role as WireRole,
    teleoperate_request::Message as Request, teleoperate_response::Message as Response,
    teleoperation_service_client::TeleoperationServiceClient,
};
use nalgebra::UnitQuaternion;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

use crate::{
    AnswerTimes, ClientError, Dropped, StreamClosed,
    kind::{Incoming, Kind, Started},
    wire,
};

/// What holds for a whole stream of a teleoperation session. Each end takes from it what concerns it.
#[derive(Debug, Clone, PartialEq)]
pub struct TeleoperationConfig {
    /// Name of the session. Only a client with both ends may leave it empty: then nobody can join.
    pub session: String,
    /// The robot's name; everyone in a session names the same. An observer of an open session may leave it empty.
    pub robot: String,
    /// When the EMP changes goals; none for what the session has.
    pub emp_mode: Option<EmpMode>,
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
    /// Whether a session that this robot opens begins as stopped, until it is armed.
    pub start_stopped: bool,
    /// Whether a client with both ends simulates its robot in step with the answers: the robot's own clock alone counts, and every
    /// control period waits for its pose. Never for a real robot.
    pub simulated: bool,
    /// The token of the seat to take over, as [`SessionEvents::started`] had it; empty for a free seat.
    pub resume_token: String,
}

impl TeleoperationConfig {
    /// With the robot's own models, refined and smoothed.
    pub fn new(robot: impl Into<String>, session: impl Into<String>) -> Self {
        Self {
            session: session.into(),
            robot: robot.into(),
            emp_mode: None,
            policy: String::new(),
            policy_version: String::new(),
            retargeter: String::new(),
            retargeter_version: String::new(),
            refine: true,
            smoothing: true,
            start_stopped: false,
            simulated: false,
            resume_token: String::new(),
        }
    }

    pub(crate) fn request(&self, role: Role) -> TeleoperateRequest {
        let operator = || OperatorConfig {
            retargeter: self.retargeter.clone(),
            retargeter_version: self.retargeter_version.clone(),
            refine: self.refine,
            smoothing: self.smoothing,
        };
        let robot = || RobotConfig {
            policy: self.policy.clone(),
            policy_version: self.policy_version.clone(),
            start_stopped: self.start_stopped,
        };
        let config = TeleoperateConfig {
            session: self.session.clone(),
            robot: self.robot.clone(),
            emp_mode: self.emp_mode.map(i32::from),
            resume_token: self.resume_token.clone(),
            role: Some(match role {
                Role::Operator => WireRole::Operator(operator()),
                Role::Robot => WireRole::RobotEnd(robot()),
                Role::Both => WireRole::Both(BothConfig {
                    robot: Some(robot()),
                    operator: Some(operator()),
                    simulated: self.simulated,
                }),
                Role::Observer => WireRole::Observer(ObserverConfig {}),
            }),
        };
        TeleoperateRequest {
            message: Some(Request::Config(config)),
        }
    }
}

/// Which end of a session a stream holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    Operator,
    Robot,
    Both,
    Observer,
}

/// One control period of a teleoperated robot.
#[derive(Debug, Clone, PartialEq)]
pub struct TeleoperationFrame {
    /// What the person does, where the client holds that end too and there is something new.
    pub operator: Option<OperatorInput>,
    /// Angles of all joints, the goal joints before the leg joints, radians.
    pub joint_positions: Vec<f32>,
    /// Orientation of the base in a world frame with z up.
    pub orientation: UnitQuaternion<f64>,
    /// When this was measured, on the robot's own steady clock, from any origin; none where the robot has none.
    pub measured: Option<Duration>,
    /// Whether this is the first control period of an episode.
    pub reset: bool,
}

/// What an operator sends.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OperatorInput {
    /// The person's pose.
    pub pose: Option<KeyNodeFrame>,
    /// Whether the person has let go of the robot, which holds its goal meanwhile.
    pub clutch: bool,
    /// Stops the session: the robot returns to its default pose until it is armed.
    pub stop: bool,
    /// The person faces forward in this pose.
    pub recentre: bool,
    /// When the EMP changes goals from now on; none for no change.
    pub emp_mode: Option<EmpMode>,
}

impl OperatorInput {
    /// A pose, and no more.
    pub fn pose(pose: &KeyNodeFrame) -> Self {
        Self {
            pose: Some(pose.clone()),
            ..Self::default()
        }
    }

    fn message(&self, header: Option<v1::FrameHeader>) -> OperatorFrame {
        OperatorFrame {
            header,
            pose: self.pose.as_ref().map(wire::pose),
            clutch: self.clutch,
            stop: self.stop,
            recentre: self.recentre,
            emp_mode: self.emp_mode.map(i32::from),
        }
    }
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
    /// Someone came or left, or the session's state changed.
    Presence(SessionPresence),
    /// A frame of this operator is not used.
    Dropped(Dropped),
    /// The server is being stopped.
    GoingAway {
        /// How long it serves on.
        grace: Duration,
    },
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
    pub(crate) frames: mpsc::Sender<TeleoperateRequest>,
    pub(crate) next_number: u64,
}

impl PoseSender {
    /// Sends a pose and gives its number: 0, 1, 2 …
    ///
    /// # Errors
    /// When the stream has ended.
    pub async fn send(&mut self, pose: &KeyNodeFrame) -> Result<u64, StreamClosed> {
        self.send_input(&OperatorInput::pose(pose)).await
    }

    /// Sends a pose, or commands, or both, and gives the frame's number.
    ///
    /// # Errors
    /// When the stream has ended.
    pub async fn send_input(&mut self, input: &OperatorInput) -> Result<u64, StreamClosed> {
        let number = self.next_number;
        let frame = input.message(Some(wire::header(number, None)));
        let request = TeleoperateRequest {
            message: Some(Request::Operator(frame)),
        };
        self.frames.send(request).await.map_err(|_| StreamClosed)?;
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
    pub(crate) role: Role,
}

pub(crate) async fn call(
    channel: Channel,
    requests: ReceiverStream<TeleoperateRequest>,
) -> Result<Streaming<TeleoperateResponse>, Status> {
    let mut service = TeleoperationServiceClient::new(channel);
    Ok(service.teleoperate(requests).await?.into_inner())
}

impl Kind for RobotEnd {
    type Frame = TeleoperationFrame;
    type Answer = TeleoperationAnswer;
    type Request = TeleoperateRequest;
    type Response = TeleoperateResponse;
    type Result = TeleoperatedFrame;

    fn first(&self) -> TeleoperateRequest {
        self.config.request(self.role)
    }

    fn resends(&self) -> bool {
        false
    }

    fn accepted(&mut self, started: &Started) {
        self.config.resume_token.clone_from(&started.resume_token);
    }

    fn frame(&self, header: v1::FrameHeader, frame: &TeleoperationFrame) -> TeleoperateRequest {
        let (positions, orientation) = (&frame.joint_positions, &frame.orientation);
        let robot = v1::RobotFrame {
            header: Some(header),
            state: Some(wire::state(positions, orientation, frame.measured)),
            reset: frame.reset,
        };
        let operator = frame.operator.as_ref();
        let message = match self.role {
            Role::Both => Request::Both(BothFrame {
                robot: Some(robot),
                operator: operator.map(|operator| operator.message(None)),
            }),
            _ => Request::Robot(robot),
        };
        TeleoperateRequest {
            message: Some(message),
        }
    }

    async fn call(
        channel: Channel,
        requests: ReceiverStream<TeleoperateRequest>,
    ) -> Result<Streaming<TeleoperateResponse>, Status> {
        call(channel, requests).await
    }

    fn sort(response: TeleoperateResponse) -> Option<Incoming<Self>> {
        Some(match response.message? {
            Response::Started(started) => Incoming::Started(Started {
                resume_token: started.resume_token,
                model: started.policy,
                model_version: started.policy_version,
                joint_names: [started.goal_joint_names, started.leg_joint_names].concat(),
            }),
            Response::Result(result) => Incoming::Result {
                number: result.header.unwrap_or_default().sequence_number,
                timing: result.timing,
                result: Some(result),
            },
            Response::Dropped(message) => Incoming::Dropped(message),
            Response::GoingAway(notice) => Incoming::GoingAway(notice),
            // Listeners are told who comes and goes.
            Response::Presence(_) => Incoming::Other,
        })
    }

    fn answer(number: u64, result: TeleoperatedFrame, times: AnswerTimes) -> TeleoperationAnswer {
        TeleoperationAnswer {
            sequence_number: number,
            result,
            latency: times.latency,
        }
    }
}

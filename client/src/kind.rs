//! The kinds of streams: their messages and the call behind them. All else about a stream is the driver's.

use std::future::Future;

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    Delivery, DroppedFrame, FilterResult, FrameHeader, GoingAway, PolicyResult, RetargetFrame,
    RetargetResult, StreamFilterGoalRequest, StreamFilterGoalResponse, StreamPolicyRequest,
    StreamPolicyResponse, StreamRetargetRequest, StreamRetargetResponse, Timing,
    motion_service_client::MotionServiceClient, stream_filter_goal_request,
    stream_filter_goal_response, stream_policy_request, stream_policy_response,
    stream_retarget_request, stream_retarget_response,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

use crate::{
    Answer, AnswerTimes, FilterAnswer, FilterConfig, GoalFrame, PolicyAnswer, PolicyConfig,
    RobotFrame, StreamConfig, wire,
};

/// A stream's config, which says of what kind the stream is.
pub(crate) trait Kind: Clone + Send + Sync + 'static {
    type Frame: Clone + Send + Sync + 'static;
    type Answer: Send + 'static;
    type Request: Clone + Send + Sync + 'static;
    type Response: Send + 'static;
    /// What answers a frame.
    type Result;

    /// The first message.
    fn first(&self) -> Self::Request;

    /// Whether a frame that has no answer is worth sending again on another connection: a person's motion, not what a robot
    /// measured a while ago.
    fn resends(&self) -> bool;

    /// The stream was accepted, with what it needs to be taken up again.
    fn accepted(&mut self, _started: &Started) {}

    fn frame(&self, header: FrameHeader, frame: &Self::Frame) -> Self::Request;

    fn call(
        channel: Channel,
        requests: ReceiverStream<Self::Request>,
    ) -> impl Future<Output = Result<Streaming<Self::Response>, Status>> + Send;

    fn sort(response: Self::Response) -> Option<Incoming<Self>>;

    fn answer(number: u64, result: Self::Result, times: AnswerTimes) -> Self::Answer;
}

/// A message from the server.
pub(crate) enum Incoming<K: Kind> {
    Started(Started),
    Result {
        number: u64,
        result: Option<K::Result>,
        timing: Option<Timing>,
    },
    Dropped(DroppedFrame),
    /// The server is being stopped.
    GoingAway(GoingAway),
    /// Nothing that a stream tells.
    Other,
}

/// The stream was accepted.
pub(crate) struct Started {
    /// What takes this stream's seat over later; empty where it has none.
    pub(crate) resume_token: String,
    pub(crate) model: String,
    pub(crate) model_version: String,
    pub(crate) joint_names: Vec<String>,
}

fn number(header: Option<FrameHeader>) -> u64 {
    header.unwrap_or_default().sequence_number
}

impl Kind for StreamConfig {
    type Frame = KeyNodeFrame;
    type Answer = Answer;
    type Request = StreamRetargetRequest;
    type Response = StreamRetargetResponse;
    type Result = RetargetResult;

    fn first(&self) -> StreamRetargetRequest {
        let message = Some(stream_retarget_request::Message::Config(self.message()));
        StreamRetargetRequest { message }
    }

    fn resends(&self) -> bool {
        self.delivery == Delivery::All
    }

    fn frame(&self, header: FrameHeader, frame: &KeyNodeFrame) -> StreamRetargetRequest {
        let frame = RetargetFrame {
            header: Some(header),
            pose: Some(wire::pose(frame)),
        };
        let message = Some(stream_retarget_request::Message::Frame(frame));
        StreamRetargetRequest { message }
    }

    async fn call(
        channel: Channel,
        requests: ReceiverStream<StreamRetargetRequest>,
    ) -> Result<Streaming<StreamRetargetResponse>, Status> {
        let mut service = MotionServiceClient::new(channel);
        Ok(service.stream_retarget(requests).await?.into_inner())
    }

    fn sort(response: StreamRetargetResponse) -> Option<Incoming<Self>> {
        use stream_retarget_response::Message;
        Some(match response.message? {
            Message::Started(started) => Incoming::Started(Started {
                resume_token: String::new(),
                model: started.model,
                model_version: started.model_version,
                joint_names: started.joint_names,
            }),
            Message::Result(message) => Incoming::Result {
                number: number(message.header),
                result: message.result,
                timing: message.timing,
            },
            Message::Dropped(message) => Incoming::Dropped(message),
            Message::GoingAway(notice) => Incoming::GoingAway(notice),
        })
    }

    fn answer(number: u64, result: RetargetResult, times: AnswerTimes) -> Answer {
        wire::answer(number, result, times)
    }
}

impl Kind for PolicyConfig {
    type Frame = RobotFrame;
    type Answer = PolicyAnswer;
    type Request = StreamPolicyRequest;
    type Response = StreamPolicyResponse;
    type Result = PolicyResult;

    fn first(&self) -> StreamPolicyRequest {
        let message = Some(stream_policy_request::Message::Config(self.message()));
        StreamPolicyRequest { message }
    }

    fn resends(&self) -> bool {
        false
    }

    fn frame(&self, header: FrameHeader, frame: &RobotFrame) -> StreamPolicyRequest {
        let frame = wire::robot_frame(header, frame);
        let message = Some(stream_policy_request::Message::Frame(frame));
        StreamPolicyRequest { message }
    }

    async fn call(
        channel: Channel,
        requests: ReceiverStream<StreamPolicyRequest>,
    ) -> Result<Streaming<StreamPolicyResponse>, Status> {
        let mut service = MotionServiceClient::new(channel);
        Ok(service.stream_policy(requests).await?.into_inner())
    }

    fn sort(response: StreamPolicyResponse) -> Option<Incoming<Self>> {
        use stream_policy_response::Message;
        Some(match response.message? {
            Message::Started(started) => Incoming::Started(Started {
                resume_token: String::new(),
                model: started.model,
                model_version: started.model_version,
                joint_names: [started.goal_joint_names, started.leg_joint_names].concat(),
            }),
            Message::Result(message) => Incoming::Result {
                number: number(message.header),
                result: message.result,
                timing: message.timing,
            },
            Message::Dropped(message) => Incoming::Dropped(message),
            Message::GoingAway(notice) => Incoming::GoingAway(notice),
        })
    }

    fn answer(number: u64, result: PolicyResult, times: AnswerTimes) -> PolicyAnswer {
        wire::policy_answer(number, result, times)
    }
}

impl Kind for FilterConfig {
    type Frame = GoalFrame;
    type Answer = FilterAnswer;
    type Request = StreamFilterGoalRequest;
    type Response = StreamFilterGoalResponse;
    type Result = FilterResult;

    fn first(&self) -> StreamFilterGoalRequest {
        let message = Some(stream_filter_goal_request::Message::Config(self.message()));
        StreamFilterGoalRequest { message }
    }

    fn resends(&self) -> bool {
        false
    }

    fn frame(&self, header: FrameHeader, frame: &GoalFrame) -> StreamFilterGoalRequest {
        let frame = wire::goal_frame(header, frame);
        let message = Some(stream_filter_goal_request::Message::Frame(frame));
        StreamFilterGoalRequest { message }
    }

    async fn call(
        channel: Channel,
        requests: ReceiverStream<StreamFilterGoalRequest>,
    ) -> Result<Streaming<StreamFilterGoalResponse>, Status> {
        let mut service = MotionServiceClient::new(channel);
        Ok(service.stream_filter_goal(requests).await?.into_inner())
    }

    fn sort(response: StreamFilterGoalResponse) -> Option<Incoming<Self>> {
        use stream_filter_goal_response::Message;
        Some(match response.message? {
            Message::Started(started) => Incoming::Started(Started {
                resume_token: String::new(),
                model: started.model,
                model_version: started.model_version,
                joint_names: [started.goal_joint_names, started.leg_joint_names].concat(),
            }),
            Message::Result(message) => Incoming::Result {
                number: number(message.header),
                result: message.result,
                timing: message.timing,
            },
            Message::Dropped(message) => Incoming::Dropped(message),
            Message::GoingAway(notice) => Incoming::GoingAway(notice),
        })
    }

    fn answer(number: u64, result: FilterResult, times: AnswerTimes) -> FilterAnswer {
        wire::filter_answer(number, result, times)
    }
}

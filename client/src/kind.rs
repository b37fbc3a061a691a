//! The kinds of streams: their messages and the call behind them. All else about a stream is the driver's.

use std::{future::Future, time::Duration};

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    Delivery, DroppedFrame, FilteredFrame, FrameHeader, RetargetFrame, RetargetedFrame,
    SteppedFrame, StreamFilterGoalRequest, StreamFilterGoalResponse, StreamPolicyRequest,
    StreamPolicyResponse, StreamRetargetRequest, StreamRetargetResponse,
    motion_service_client::MotionServiceClient, stream_filter_goal_request,
    stream_filter_goal_response, stream_policy_request, stream_policy_response,
    stream_retarget_request, stream_retarget_response,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

use crate::{
    Answer, ClientError, FilterAnswer, FilterConfig, GoalFrame, PolicyAnswer, PolicyConfig,
    RobotFrame, StreamConfig, wire,
};

/// A stream's config, which says of what kind the stream is.
pub(crate) trait Kind: Clone + Send + Sync + 'static {
    type Frame: Clone + Send + Sync + 'static;
    type Answer: Send + 'static;
    type Request: Clone + Send + Sync + 'static;
    type Response: Send + 'static;
    /// The message that answers a frame.
    type Result;

    /// The first message.
    fn first(&self) -> Self::Request;

    fn delivery(&self) -> Delivery;

    fn frame(header: FrameHeader, frame: &Self::Frame) -> Self::Request;

    fn call(
        service: MotionServiceClient<Channel>,
        requests: ReceiverStream<Self::Request>,
    ) -> impl Future<Output = Result<Streaming<Self::Response>, Status>> + Send;

    fn sort(response: Self::Response) -> Option<Incoming<Self>>;

    fn answer(
        number: u64,
        message: Self::Result,
        latency: Duration,
    ) -> Result<Self::Answer, ClientError>;
}

/// A message from the server.
pub(crate) enum Incoming<K: Kind> {
    Started(Started),
    Result { number: u64, message: K::Result },
    Dropped(DroppedFrame),
}

/// The stream was accepted.
pub(crate) struct Started {
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
    type Result = RetargetedFrame;

    fn first(&self) -> StreamRetargetRequest {
        let message = stream_retarget_request::Message::Config(self.message());
        StreamRetargetRequest {
            message: Some(message),
        }
    }

    fn delivery(&self) -> Delivery {
        self.delivery
    }

    fn frame(header: FrameHeader, frame: &KeyNodeFrame) -> StreamRetargetRequest {
        let frame = RetargetFrame {
            header: Some(header),
            pose: Some(wire::pose(frame)),
        };
        StreamRetargetRequest {
            message: Some(stream_retarget_request::Message::Frame(frame)),
        }
    }

    async fn call(
        mut service: MotionServiceClient<Channel>,
        requests: ReceiverStream<StreamRetargetRequest>,
    ) -> Result<Streaming<StreamRetargetResponse>, Status> {
        Ok(service.stream_retarget(requests).await?.into_inner())
    }

    fn sort(response: StreamRetargetResponse) -> Option<Incoming<Self>> {
        use stream_retarget_response::Message;
        Some(match response.message? {
            Message::Started(started) => Incoming::Started(Started {
                model: started.model,
                model_version: started.model_version,
                joint_names: started.joint_names,
            }),
            Message::Result(message) => Incoming::Result {
                number: number(message.header),
                message,
            },
            Message::Dropped(message) => Incoming::Dropped(message),
        })
    }

    fn answer(
        number: u64,
        message: RetargetedFrame,
        latency: Duration,
    ) -> Result<Answer, ClientError> {
        let result = message
            .result
            .ok_or(ClientError::Contract("an answer without a result"))?;
        Ok(wire::answer(number, result, message.timing, latency))
    }
}

impl Kind for PolicyConfig {
    type Frame = RobotFrame;
    type Answer = PolicyAnswer;
    type Request = StreamPolicyRequest;
    type Response = StreamPolicyResponse;
    type Result = SteppedFrame;

    fn first(&self) -> StreamPolicyRequest {
        let message = stream_policy_request::Message::Config(self.message());
        StreamPolicyRequest {
            message: Some(message),
        }
    }

    fn delivery(&self) -> Delivery {
        self.delivery
    }

    fn frame(header: FrameHeader, frame: &RobotFrame) -> StreamPolicyRequest {
        let frame = wire::robot_frame(header, frame);
        StreamPolicyRequest {
            message: Some(stream_policy_request::Message::Frame(frame)),
        }
    }

    async fn call(
        mut service: MotionServiceClient<Channel>,
        requests: ReceiverStream<StreamPolicyRequest>,
    ) -> Result<Streaming<StreamPolicyResponse>, Status> {
        Ok(service.stream_policy(requests).await?.into_inner())
    }

    fn sort(response: StreamPolicyResponse) -> Option<Incoming<Self>> {
        use stream_policy_response::Message;
        Some(match response.message? {
            Message::Started(started) => Incoming::Started(Started {
                model: started.model,
                model_version: started.model_version,
                joint_names: [started.goal_joint_names, started.leg_joint_names].concat(),
            }),
            Message::Result(message) => Incoming::Result {
                number: number(message.header),
                message,
            },
            Message::Dropped(message) => Incoming::Dropped(message),
        })
    }

    fn answer(
        number: u64,
        message: SteppedFrame,
        latency: Duration,
    ) -> Result<PolicyAnswer, ClientError> {
        let result = message
            .result
            .ok_or(ClientError::Contract("an answer without a result"))?;
        Ok(wire::policy_answer(number, result, message.timing, latency))
    }
}

impl Kind for FilterConfig {
    type Frame = GoalFrame;
    type Answer = FilterAnswer;
    type Request = StreamFilterGoalRequest;
    type Response = StreamFilterGoalResponse;
    type Result = FilteredFrame;

    fn first(&self) -> StreamFilterGoalRequest {
        let message = stream_filter_goal_request::Message::Config(self.message());
        StreamFilterGoalRequest {
            message: Some(message),
        }
    }

    fn delivery(&self) -> Delivery {
        self.delivery
    }

    fn frame(header: FrameHeader, frame: &GoalFrame) -> StreamFilterGoalRequest {
        let frame = wire::goal_frame(header, frame);
        StreamFilterGoalRequest {
            message: Some(stream_filter_goal_request::Message::Frame(frame)),
        }
    }

    async fn call(
        mut service: MotionServiceClient<Channel>,
        requests: ReceiverStream<StreamFilterGoalRequest>,
    ) -> Result<Streaming<StreamFilterGoalResponse>, Status> {
        Ok(service.stream_filter_goal(requests).await?.into_inner())
    }

    fn sort(response: StreamFilterGoalResponse) -> Option<Incoming<Self>> {
        use stream_filter_goal_response::Message;
        Some(match response.message? {
            Message::Started(started) => Incoming::Started(Started {
                model: started.model,
                model_version: started.model_version,
                joint_names: [started.goal_joint_names, started.leg_joint_names].concat(),
            }),
            Message::Result(message) => Incoming::Result {
                number: number(message.header),
                message,
            },
            Message::Dropped(message) => Incoming::Dropped(message),
        })
    }

    fn answer(
        number: u64,
        message: FilteredFrame,
        latency: Duration,
    ) -> Result<FilterAnswer, ClientError> {
        let result = message
            .result
            .ok_or(ClientError::Contract("an answer without a result"))?;
        Ok(wire::filter_answer(number, result, message.timing, latency))
    }
}

//! Messages and calls as any gRPC client would make them, without the client library's care.

use std::fmt::Debug;

use emp_motion::{KeyNode, KeyNodeFrame};
use emp_proto::v1::{self, FrameHeader, HumanPose, Position, Quaternion, RobotState};
use nalgebra::UnitQuaternion;
use prost::bytes::{Buf as _, BufMut as _};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    Code, Response, Status, Streaming,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
};
use tonic_types::StatusExt as _;

use crate::within;

/// Messages between a test and the transport.
const HAND_OVER: usize = 64;

/// A pose as a message.
pub fn pose(frame: &KeyNodeFrame) -> HumanPose {
    let position = |node: KeyNode| {
        let p = frame.positions[node as usize];
        Some(Position {
            x: p.x,
            y: p.y,
            z: p.z,
        })
    };
    HumanPose {
        waist: position(KeyNode::Waist),
        torso: position(KeyNode::Torso),
        left_shoulder: position(KeyNode::LeftShoulder),
        right_shoulder: position(KeyNode::RightShoulder),
        left_elbow: position(KeyNode::LeftElbow),
        right_elbow: position(KeyNode::RightElbow),
        left_wrist: position(KeyNode::LeftWrist),
        right_wrist: position(KeyNode::RightWrist),
        ..HumanPose::default()
    }
}

/// A robot's state as a message.
pub fn state(joint_positions: &[f32], orientation: &UnitQuaternion<f64>) -> RobotState {
    let q = orientation.cast::<f32>();
    RobotState {
        joint_positions: joint_positions.to_vec(),
        base_orientation: Some(Quaternion {
            w: q.w,
            x: q.i,
            y: q.j,
            z: q.k,
        }),
        ..RobotState::default()
    }
}

/// The header of the frame with this number.
pub fn header(sequence_number: u64) -> FrameHeader {
    FrameHeader {
        sequence_number,
        ..FrameHeader::default()
    }
}

/// The field that a call was refused for.
///
/// # Panics
/// When it was not refused for a field.
pub fn wrong_field(status: &Status) -> String {
    assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
    let details = status.get_error_details();
    assert_eq!(details.error_info().expect("ErrorInfo").domain, "emp.v1");
    details.bad_request().expect("BadRequest").field_violations[0]
        .field
        .clone()
}

/// A message that holds one of several others.
pub trait OneOf {
    /// What it holds.
    type Content: Debug;

    /// The message around its content.
    fn holding(content: Option<Self::Content>) -> Self;

    /// What the message holds.
    fn content(self) -> Option<Self::Content>;
}

macro_rules! one_of {
    ($($name:ident: $module:ident,)*) => {$(
        impl OneOf for v1::$name {
            type Content = v1::$module::Message;

            fn holding(message: Option<Self::Content>) -> Self {
                Self { message }
            }

            fn content(self) -> Option<Self::Content> {
                self.message
            }
        }
    )*};
}

one_of! {
    StreamRetargetRequest: stream_retarget_request,
    StreamRetargetResponse: stream_retarget_response,
    StreamFilterGoalRequest: stream_filter_goal_request,
    StreamFilterGoalResponse: stream_filter_goal_response,
    StreamPolicyRequest: stream_policy_request,
    StreamPolicyResponse: stream_policy_response,
    TeleoperateRequest: teleoperate_request,
    TeleoperateResponse: teleoperate_response,
    CollectRolloutsRequest: collect_rollouts_request,
    CollectRolloutsResponse: collect_rollouts_response,
}

/// An open stream of requests `Q` and responses `R`.
pub struct RawStream<Q, R> {
    /// None once half-closed.
    requests: Option<mpsc::Sender<Q>>,
    responses: Streaming<R>,
}

impl<Q: OneOf, R: OneOf> RawStream<Q, R> {
    /// Opens a stream by `call`; its headers come at once, before any message.
    ///
    /// # Errors
    /// When the server refuses the call.
    pub async fn open(
        call: impl AsyncFnOnce(ReceiverStream<Q>) -> Result<Response<Streaming<R>>, Status>,
    ) -> anyhow::Result<Self> {
        let (requests, outbound) = mpsc::channel(HAND_OVER);
        let call = call(ReceiverStream::new(outbound));
        Ok(Self {
            requests: Some(requests),
            responses: within("the headers", call).await??.into_inner(),
        })
    }

    /// Sends a message with this content, or without any; a stream that has ended says why when it is read.
    pub async fn send(&self, content: impl Into<Option<Q::Content>>) {
        if let Some(requests) = &self.requests {
            let _ = requests.send(Q::holding(content.into())).await;
        }
    }

    /// Half-closes.
    pub fn finish(&mut self) {
        self.requests = None;
    }

    /// What the next message holds, none at the end; or the status that ended the stream.
    ///
    /// # Errors
    /// When nothing comes for too long.
    pub async fn next(&mut self) -> anyhow::Result<Result<Option<R::Content>, Status>> {
        let response = within("a message", self.responses.message()).await?;
        Ok(response.map(|response| response.and_then(R::content)))
    }

    /// The status that ends the stream, and what comes before it.
    ///
    /// # Errors
    /// When the stream ends well, or nothing comes for too long.
    pub async fn failure(&mut self) -> anyhow::Result<(Vec<R::Content>, Status)> {
        let mut before = Vec::new();
        loop {
            match self.next().await? {
                Ok(Some(content)) => before.push(content),
                Ok(None) => anyhow::bail!("the stream ended well, after {before:?}"),
                Err(status) => return Ok((before, status)),
            }
        }
    }
}

/// Sends bytes as they are, whatever message the server expects, and gives those that come back.
#[derive(Debug, Clone, Copy, Default)]
pub struct Bytes;

impl Codec for Bytes {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Bytes {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, bytes: Vec<u8>, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put_slice(&bytes);
        Ok(())
    }
}

impl Decoder for Bytes {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let mut bytes = vec![0; buffer.remaining()];
        buffer.copy_to_slice(&mut bytes);
        Ok(Some(bytes))
    }
}

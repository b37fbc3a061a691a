//! Messages and calls as any gRPC client would make them, without the client library's care.

use emp_motion::{KeyNode, KeyNodeFrame};
use emp_proto::v1::{
    Delivery, FrameHeader, HumanPose, Position, RetargetFrame, StreamRetargetConfig,
    StreamRetargetRequest, StreamRetargetResponse, motion_service_client::MotionServiceClient,
    stream_retarget_request::Message, stream_retarget_response,
};
use prost::bytes::{Buf as _, BufMut as _};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    Status, Streaming,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
    transport::Channel,
};

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
        left_wrist_orientation: None,
        right_wrist_orientation: None,
    }
}

/// A stream's config for a robot.
pub fn config(robot: &str, delivery: Delivery) -> StreamRetargetRequest {
    let config = StreamRetargetConfig {
        robot: robot.to_owned(),
        delivery: delivery.into(),
        ..StreamRetargetConfig::default()
    };
    StreamRetargetRequest {
        message: Some(Message::Config(config)),
    }
}

/// A frame with this number.
pub fn frame(sequence_number: u64, pose: HumanPose) -> StreamRetargetRequest {
    let header = Some(FrameHeader {
        sequence_number,
        ..FrameHeader::default()
    });
    StreamRetargetRequest {
        message: Some(Message::Frame(RetargetFrame {
            header,
            pose: Some(pose),
        })),
    }
}

/// An open stream.
pub struct RawStream {
    /// Where messages go; dropping it half-closes.
    pub requests: Option<mpsc::Sender<StreamRetargetRequest>>,
    /// Where messages come from.
    pub responses: Streaming<StreamRetargetResponse>,
}

impl RawStream {
    /// Opens a stream; its headers come at once, before any message.
    ///
    /// # Errors
    /// When the server refuses the call.
    pub async fn open(client: &MotionServiceClient<Channel>) -> Result<Self, Status> {
        let (requests, outbound) = mpsc::channel(64);
        let responses = client
            .clone()
            .stream_retarget(ReceiverStream::new(outbound))
            .await?
            .into_inner();
        Ok(Self {
            requests: Some(requests),
            responses,
        })
    }

    /// Sends a message; a stream that has ended says why when it is read.
    pub async fn send(&self, request: StreamRetargetRequest) {
        if let Some(requests) = &self.requests {
            let _ = requests.send(request).await;
        }
    }

    /// Half-closes.
    pub fn finish(&mut self) {
        self.requests = None;
    }

    /// The next message; none at the end.
    ///
    /// # Errors
    /// The status that ended the stream.
    pub async fn next(&mut self) -> Result<Option<stream_retarget_response::Message>, Status> {
        Ok(self
            .responses
            .message()
            .await?
            .and_then(|response| response.message))
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

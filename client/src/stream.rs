//! Both ends of a stream as a program holds them.

use std::time::Duration;

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{Delivery, DropReason, StreamRetargetConfig};
use tokio::sync::mpsc;

use crate::ClientError;

/// What holds for a whole stream.
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

/// The answer to one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// The frame's number, as [`FrameSender::send`] gave it.
    pub sequence_number: u64,
    /// Joint angles in the robot's goal order, radians.
    pub joint_angles: Vec<f32>,
    /// Mean angle between the person's and the robot's arm bones, radians.
    pub direction_error: f32,
    /// Names of the joints that stand at a limit.
    pub joints_at_limit: Vec<String>,
    /// How long the frame waited for the model.
    pub queue_time: Duration,
    /// How long the model took for the batch.
    pub inference_time: Duration,
    /// How many frames the batch had.
    pub batch_size: u32,
    /// From sending the frame to receiving this, on the client's clock. A frame that was sent again counts from its
    /// first time.
    pub latency: Duration,
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
    /// It was on its way when the connection was lost, or sent while there was none (delivery `LATEST` only).
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

/// What a stream tells.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A frame was answered.
    Answer(Answer),
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
    /// The connection stands again.
    Reconnected {
        /// How many frames are sent again (delivery `ALL`).
        resent: usize,
    },
}

/// The sending end. Dropping it half-closes the stream: what is on its way is still answered.
#[derive(Debug)]
pub struct FrameSender {
    pub(crate) frames: mpsc::Sender<Outbound>,
    pub(crate) next_number: u64,
}

/// A frame on its way to the connection.
#[derive(Debug)]
pub(crate) struct Outbound {
    pub(crate) number: u64,
    pub(crate) pose: KeyNodeFrame,
    pub(crate) time_budget: Option<Duration>,
}

/// The stream has ended; its [`StreamEvents`] say why.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the stream has ended")]
pub struct StreamClosed;

impl FrameSender {
    /// Sends a pose and gives its number: 0, 1, 2 … Waits while the server is behind (delivery `ALL`).
    ///
    /// # Errors
    /// When the stream has ended.
    pub async fn send(
        &mut self,
        pose: &KeyNodeFrame,
        time_budget: Option<Duration>,
    ) -> Result<u64, StreamClosed> {
        let number = self.next_number;
        let outbound = Outbound {
            number,
            pose: pose.clone(),
            time_budget,
        };
        self.frames.send(outbound).await.map_err(|_| StreamClosed)?;
        self.next_number += 1;
        Ok(number)
    }
}

/// The receiving end. Dropping it cancels the stream.
#[derive(Debug)]
pub struct StreamEvents {
    pub(crate) joint_names: Vec<String>,
    pub(crate) model: String,
    pub(crate) model_version: String,
    pub(crate) events: mpsc::Receiver<Result<Event, ClientError>>,
}

impl StreamEvents {
    /// Names of the joints, in the order of every answer.
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
    pub async fn next(&mut self) -> Result<Option<Event>, ClientError> {
        self.events.recv().await.transpose()
    }
}

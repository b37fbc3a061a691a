//! `RolloutService` as a program uses it: an evaluation's messages as they come, and environments to learn from.

use emp_motion::Clip;
use emp_proto::v1::{
    CollectFinished, CollectRequest, CollectRolloutsConfig, CollectRolloutsRequest,
    CollectRolloutsResponse, CollectStarted, EnvironmentSnapshot, EvaluateConfig, EvaluateRequest,
    EvaluateResponse, GoalClip, MotionClip, MotionPoses, RolloutBlock, SnapshotRequest,
    collect_rollouts_request, collect_rollouts_response, evaluate_request, evaluate_response,
    rollout_service_client::RolloutServiceClient,
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;

use crate::endpoint::Channel;
use crate::{ClientError, wire};

/// Largest message of a job.
const MAX_MESSAGE: usize = 16 << 20;
/// Poses in one message; a pose takes about 200 bytes.
const POSES: usize = 4096;
/// Messages between the program and the transport.
const HAND_OVER: usize = 4;
/// Bytes of a snapshot in one message.
const SNAPSHOT_PART: usize = 4 << 20;

const OTHER_REQUEST: ClientError = ClientError::Contract("an answer to another request");

fn service(channel: Channel) -> RolloutServiceClient<Channel> {
    RolloutServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE)
}

/// A running evaluation. Dropping it cancels the job.
#[derive(Debug)]
pub struct Evaluation {
    responses: Streaming<EvaluateResponse>,
}

impl Evaluation {
    pub(crate) async fn start(
        channel: Channel,
        config: EvaluateConfig,
        motions: Vec<Clip>,
    ) -> Result<Self, ClientError> {
        let (requests, outbound) = mpsc::channel(HAND_OVER);
        // The responses say why a call ended that takes no more motions.
        tokio::spawn(async move {
            let messages = std::iter::once(evaluate_request::Message::Config(config))
                .chain(motions.iter().flat_map(messages));
            for message in messages {
                let message = Some(message);
                if requests.send(EvaluateRequest { message }).await.is_err() {
                    return;
                }
            }
        });
        let response = service(channel)
            .evaluate(ReceiverStream::new(outbound))
            .await?;
        Ok(Self {
            responses: response.into_inner(),
        })
    }

    /// The next message; none after the result.
    ///
    /// # Errors
    /// When the evaluation ended before its result.
    pub async fn next(&mut self) -> Result<Option<evaluate_response::Message>, ClientError> {
        match self.responses.message().await? {
            Some(response) => response.message.map(Some).ok_or(ClientError::EMPTY_MESSAGE),
            None => Ok(None),
        }
    }
}

/// A motion in messages below the limit.
fn messages(clip: &Clip) -> impl Iterator<Item = evaluate_request::Message> + use<'_> {
    let poses = |frames: &[emp_motion::KeyNodeFrame]| frames.iter().map(wire::pose).collect();
    let mut parts = clip.frames.chunks(POSES);
    let first = evaluate_request::Message::Clip(MotionClip {
        name: clip.name.clone(),
        fps: clip.fps,
        poses: parts.next().map(poses).unwrap_or_default(),
    });
    let rest =
        parts.map(move |part| evaluate_request::Message::Poses(MotionPoses { poses: poses(part) }));
    std::iter::once(first).chain(rest)
}

/// Simulated robots on a server, for a learner. Dropping it lets them go.
#[derive(Debug)]
pub struct Collection {
    requests: mpsc::Sender<CollectRolloutsRequest>,
    responses: Streaming<CollectRolloutsResponse>,
    started: CollectStarted,
}

impl Collection {
    /// `config.clips` is set to the number of `library`'s clips.
    pub(crate) async fn start(
        channel: Channel,
        mut config: CollectRolloutsConfig,
        library: Vec<GoalClip>,
    ) -> Result<Self, ClientError> {
        use collect_rollouts_request::Message;
        config.clips = u32::try_from(library.len()).unwrap_or(u32::MAX);
        let (requests, outbound) = mpsc::channel(HAND_OVER);
        let sending = {
            let requests = requests.clone();
            async move {
                let clips = library.into_iter().map(Message::Clip);
                for message in std::iter::once(Message::Config(config)).chain(clips) {
                    let message = Some(message);
                    if requests
                        .send(CollectRolloutsRequest { message })
                        .await
                        .is_err()
                    {
                        return;
                    }
                }
            }
        };
        tokio::spawn(sending);
        let responses = service(channel)
            .collect_rollouts(ReceiverStream::new(outbound))
            .await?
            .into_inner();
        let mut collection = Self {
            requests,
            responses,
            started: CollectStarted::default(),
        };
        match collection.receive().await? {
            collect_rollouts_response::Message::Started(started) => collection.started = started,
            _ => return Err(ClientError::Contract("rollouts that do not start")),
        }
        Ok(collection)
    }

    /// Widths of the rows in every block.
    pub fn started(&self) -> &CollectStarted {
        &self.started
    }

    /// Runs the robots; the blocks are those of all robots, in order.
    ///
    /// # Errors
    /// When the server refuses the request or the job ends.
    pub async fn collect(
        &mut self,
        request: CollectRequest,
    ) -> Result<(Vec<RolloutBlock>, CollectFinished), ClientError> {
        use collect_rollouts_response::Message;
        let iteration = request.iteration;
        self.send(collect_rollouts_request::Message::Collect(request))
            .await?;
        let mut blocks = Vec::new();
        loop {
            match self.receive().await? {
                Message::Block(block) if block.iteration == iteration => blocks.push(block),
                Message::Finished(finished) if finished.iteration == iteration => {
                    return Ok((blocks, finished));
                }
                _ => return Err(OTHER_REQUEST),
            }
        }
    }

    /// Everything that later rollouts depend on, but for the requests themselves.
    ///
    /// # Errors
    /// When the job ends.
    pub async fn snapshot(&mut self) -> Result<Vec<u8>, ClientError> {
        self.send(collect_rollouts_request::Message::TakeSnapshot(
            SnapshotRequest {},
        ))
        .await?;
        let mut snapshot = Vec::new();
        loop {
            match self.receive().await? {
                collect_rollouts_response::Message::Snapshot(part) => {
                    snapshot.extend(part.data);
                    if part.last {
                        return Ok(snapshot);
                    }
                }
                _ => return Err(OTHER_REQUEST),
            }
        }
    }

    /// Goes on from a [`snapshot`](Self::snapshot) of robots with the same config and library.
    ///
    /// # Errors
    /// When it does not fit, or the job ends.
    pub async fn restore(&mut self, snapshot: &[u8]) -> Result<(), ClientError> {
        let parts = snapshot.chunks(SNAPSHOT_PART);
        let last = parts.len().saturating_sub(1);
        for (index, part) in parts.enumerate() {
            let part = EnvironmentSnapshot {
                data: part.to_vec(),
                last: index == last,
            };
            self.send(collect_rollouts_request::Message::Restore(part))
                .await?;
        }
        match self.receive().await? {
            collect_rollouts_response::Message::Restored(_) => Ok(()),
            _ => Err(OTHER_REQUEST),
        }
    }

    async fn send(
        &mut self,
        message: collect_rollouts_request::Message,
    ) -> Result<(), ClientError> {
        let message = Some(message);
        let sent = self.requests.send(CollectRolloutsRequest { message }).await;
        if sent.is_ok() {
            return Ok(());
        }
        // The call has ended; the responses say why.
        loop {
            self.receive().await?;
        }
    }

    async fn receive(&mut self) -> Result<collect_rollouts_response::Message, ClientError> {
        match self.responses.message().await? {
            Some(response) => response.message.ok_or(ClientError::EMPTY_MESSAGE),
            None => Err(ClientError::Silence("the server ended the rollouts early")),
        }
    }
}

//! `RolloutService` as a program uses it: an evaluation's messages as they come, and environments to learn from.

use emp_motion::Clip;
use emp_proto::v1::{
    CollectFinished, CollectRequest, CollectRolloutsConfig, CollectRolloutsRequest,
    CollectRolloutsResponse, CollectStarted, EnvironmentSnapshot, EvaluationConfig, GoalClip,
    MotionClip, MotionPoses, PolicyPart, RolloutBlock, SnapshotRequest, StartEvaluationRequest,
    WatchEvaluationRequest, WatchEvaluationResponse, collect_rollouts_request,
    collect_rollouts_response, rollout_service_client::RolloutServiceClient,
    start_evaluation_request, watch_evaluation_response,
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Streaming, transport::Channel};

use crate::{ClientError, wire};

/// Poses in one message; a pose takes about 200 bytes.
const POSES: usize = 2048;
/// Messages between the program and the transport.
const HAND_OVER: usize = 4;
/// Bytes of a snapshot or a policy in one message, which is below 1 MiB.
const PART: usize = (1 << 20) - 64;

const OTHER_REQUEST: ClientError = ClientError::Contract("an answer to another request");

fn service(channel: Channel) -> RolloutServiceClient<Channel> {
    RolloutServiceClient::new(channel)
}

/// An evaluation that is watched. The job goes on without its watchers; [`Client::cancel_job`](crate::Client::cancel_job) ends it.
#[derive(Debug)]
pub struct Evaluation {
    job: String,
    next_event: u64,
    responses: Streaming<WatchEvaluationResponse>,
}

impl Evaluation {
    pub(crate) async fn start(
        channel: Channel,
        config: EvaluationConfig,
        motions: Vec<Clip>,
    ) -> Result<Self, ClientError> {
        use start_evaluation_request::Message;
        let (requests, outbound) = mpsc::channel(HAND_OVER);
        // The answer says why a call ended that takes no more motions.
        tokio::spawn(async move {
            let messages =
                std::iter::once(Message::Config(config)).chain(motions.iter().flat_map(messages));
            for message in messages {
                let message = Some(message);
                let request = StartEvaluationRequest { message };
                if requests.send(request).await.is_err() {
                    return;
                }
            }
        });
        let response = service(channel.clone())
            .start_evaluation(ReceiverStream::new(outbound))
            .await?;
        Self::watch(channel, response.into_inner().job, 0).await
    }

    pub(crate) async fn watch(
        channel: Channel,
        job: String,
        first_event: u64,
    ) -> Result<Self, ClientError> {
        let request = WatchEvaluationRequest {
            job: job.clone(),
            first_event,
        };
        let response = service(channel).watch_evaluation(request).await?;
        Ok(Self {
            job,
            next_event: first_event,
            responses: response.into_inner(),
        })
    }

    /// The job's id.
    pub fn job(&self) -> &str {
        &self.job
    }

    /// Number of the next event: where a watcher goes on that was cut off.
    pub fn next_event(&self) -> u64 {
        self.next_event
    }

    /// The next message; none after the result.
    ///
    /// # Errors
    /// When the evaluation ended before its result.
    pub async fn next(
        &mut self,
    ) -> Result<Option<watch_evaluation_response::Message>, ClientError> {
        match self.responses.message().await? {
            Some(response) => {
                self.next_event = response.event + 1;
                response.message.map(Some).ok_or(ClientError::EMPTY_MESSAGE)
            }
            None => Ok(None),
        }
    }
}

/// A motion in messages below the limit.
fn messages(clip: &Clip) -> impl Iterator<Item = start_evaluation_request::Message> + use<'_> {
    use start_evaluation_request::Message;
    let poses = |frames: &[emp_motion::KeyNodeFrame]| frames.iter().map(wire::pose).collect();
    let mut parts = clip.frames.chunks(POSES);
    let first = Message::Clip(MotionClip {
        name: clip.name.clone(),
        fps: clip.fps,
        poses: parts.next().map(poses).unwrap_or_default(),
    });
    let rest = parts.map(move |part| Message::Poses(MotionPoses { poses: poses(part) }));
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

    /// Runs the robots with a policy, a file in the safetensors format; the blocks are those of all robots, in order.
    ///
    /// # Errors
    /// When the server refuses the request or the job ends.
    pub async fn collect(
        &mut self,
        policy: &[u8],
        request: CollectRequest,
    ) -> Result<(Vec<RolloutBlock>, CollectFinished), ClientError> {
        use collect_rollouts_response::Message;
        let iteration = request.iteration;
        let parts = policy.chunks(PART);
        let last = parts.len().saturating_sub(1);
        for (index, part) in parts.enumerate() {
            let part = PolicyPart {
                data: part.to_vec(),
                last: index == last,
            };
            self.send(collect_rollouts_request::Message::Policy(part))
                .await?;
        }
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
        let parts = snapshot.chunks(PART);
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

//! Streams with one model: poses to retarget, goals to filter, robots to balance. What differs between them is a [`Codec`] (their
//! messages and their model) and a [`Memory`] (what they remember from frame to frame).
//!
//! A session is one task that reads and computes at once. It has at most one frame in the model's queue; the others wait in its
//! [`Inbox`].

mod filter;
mod inbox;
mod policy;
mod retarget;
mod stream;

use std::{sync::Arc, time::Instant};

use emp_proto::v1::{DroppedFrame, FrameHeader, GoingAway};
use emp_robot::Robot;

pub(crate) use self::{
    filter::FilterStream,
    inbox::{Inbox, Next, Queued},
    policy::PolicyStream,
    retarget::RetargetStream,
    stream::{Drain, Gone, Outbound, Reader, ResponseStream, StreamContext, serve},
};
use crate::decode::deadline;
use crate::{
    catalog::{Catalog, Served},
    dropped::NotComputed,
    error::{FieldError, ServiceError},
    inference::{
        batcher::{Batcher, Rejected},
        queue::{Answer, Priority},
    },
};

/// The messages of a kind of stream, and the model behind it.
pub(crate) trait Codec: Sized + Send + 'static {
    /// A message from the client.
    type Request: Send + 'static;
    /// A message to the client.
    type Response: Send + 'static;
    /// The first message's content.
    type Config: Send + Sync;
    /// A frame off the wire.
    type WireFrame: Send + Sync;
    /// A frame that was understood.
    type Frame: Send;
    /// What the model takes.
    type Input: Send + 'static;
    /// What the model answers.
    type Output: Send + 'static;
    /// The model itself.
    type Model: Send + Sync + 'static;

    /// Whether the stream ends as soon as the server shuts down; otherwise it is served until the grace time is over.
    const ENDS_AT_ONCE: bool;

    fn sort(request: Self::Request) -> Option<Incoming<Self>>;

    fn dropped(notice: DroppedFrame) -> Self::Response;

    fn going_away(notice: GoingAway) -> Self::Response;

    /// The number of the config's delivery, off the wire.
    fn delivery(config: &Self::Config) -> i32;

    /// The model that the config asks for.
    fn model(catalog: &Catalog, config: &Self::Config)
    -> Result<Arc<ServedBy<Self>>, ServiceError>;

    fn header(frame: &Self::WireFrame) -> Option<FrameHeader>;

    /// Whether a frame starts a new episode.
    fn resets(_frame: &Self::WireFrame) -> bool {
        false
    }

    fn read(robot: &Robot, frame: Self::WireFrame) -> Result<Self::Frame, FieldError>;
}

/// What a stream remembers.
pub(crate) trait Memory: Codec {
    /// A stream before its first frame.
    fn open(config: &Self::Config, model: &Arc<ServedBy<Self>>) -> Result<Self, FieldError>;

    /// The message that says that the stream was accepted.
    fn started(&self) -> Self::Response;

    /// Forgets the episode.
    fn reset(&mut self) {}

    /// What the model gets for a frame, given the answers so far.
    fn input(&self, frame: Self::Frame) -> Self::Input;

    /// The message with a frame's answer, which is remembered. Only called for answers that are sent.
    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<Self::Output>,
    ) -> Self::Response;
}

/// The model of a kind of stream, behind its queue.
pub(crate) type ServedBy<K> =
    Served<<K as Codec>::Input, <K as Codec>::Output, <K as Codec>::Model>;

/// A message from the client.
pub(crate) enum Incoming<K: Codec> {
    Config(K::Config),
    Frame(K::WireFrame),
}

/// A frame that was understood.
struct Frame<F> {
    header: Option<FrameHeader>,
    content: F,
    /// Whether an episode starts with it.
    resets: bool,
    deadline: Option<Instant>,
}

impl<F> Queued for Frame<F> {
    fn header(&self) -> Option<FrameHeader> {
        self.header
    }

    fn supersede(&mut self, old: &Self) {
        self.resets |= old.resets;
    }
}

/// Serves one stream to its end.
pub(crate) async fn run<M: Memory>(
    context: StreamContext,
    mut inbound: Reader<M::Request>,
    outbound: Outbound<M::Response>,
) -> Result<(), ServiceError> {
    let config_of = |message| match M::sort(message) {
        Some(Incoming::Config(config)) => Some(config),
        _ => None,
    };
    let config = inbound.config(&context, config_of).await?;
    let delivery = inbox::read_delivery(M::delivery(&config))?;
    let model = M::model(&context.catalog, &config)?;
    let memory = M::open(&config, &model)?;
    check_room(&model.batcher)?;
    tracing::info!(model = model.card.name, ?delivery, "stream started");
    if outbound.send(memory.started()).await.is_err() {
        return Ok(());
    }
    let session = Session::<M> {
        context: &context,
        robot: &model.robot,
        inbox: Inbox::new(delivery, context.buffer),
        outbound: &outbound,
    };
    let reading = async {
        let end = session.read(inbound).await;
        session.inbox.close();
        end
    };
    let computing = async {
        // A client that is gone ends the stream, whatever it still sends.
        session
            .compute(memory, &model.batcher)
            .await
            .map_err(|Gone| None)
    };
    match tokio::try_join!(async { reading.await.map_err(Some) }, computing) {
        Ok((None, ())) | Err(None) => Ok(()),
        Ok((Some(end), ())) | Err(Some(end)) => Err(end),
    }
}

struct Session<'a, M: Memory> {
    context: &'a StreamContext,
    robot: &'a Robot,
    inbox: Inbox<Frame<M::Frame>>,
    outbound: &'a Outbound<M::Response>,
}

impl<M: Memory> Session<'_, M> {
    /// Reads frames until the client or the server wants no more of them; gives the reason where it is the server.
    async fn read(
        &self,
        mut inbound: Reader<M::Request>,
    ) -> Result<Option<ServiceError>, ServiceError> {
        let drain = &self.context.drain;
        let over = drain.over();
        tokio::pin!(over);
        let mut is_told = false;
        // A frame that was to start an episode has arrived; the next good one does.
        let mut must_reset = false;
        loop {
            let next = async {
                self.inbox.room().await;
                inbound.next().await
            };
            let message = tokio::select! {
                message = next => message?,
                () = drain.begun.cancelled(), if !is_told => {
                    is_told = true;
                    // A client that is gone ends the stream elsewhere.
                    let _ = self.outbound.send(M::going_away(drain.notice())).await;
                    if M::ENDS_AT_ONCE {
                        return Ok(Some(ServiceError::ShuttingDown));
                    }
                    continue;
                }
                () = &mut over => return Ok(Some(ServiceError::ShuttingDown)),
            };
            let frame = match message.map(M::sort) {
                None => return Ok(None),
                Some(Some(Incoming::Frame(frame))) => frame,
                Some(Some(Incoming::Config(_))) => return Err(FieldError::second_config().into()),
                Some(None) => return Err(FieldError::missing_frame().into()),
            };
            let header = M::header(&frame);
            must_reset |= M::resets(&frame);
            match self.read_frame(header, frame, must_reset) {
                Ok(frame) => {
                    must_reset = false;
                    self.inbox.push(frame)?;
                }
                Err(error) => self
                    .inbox
                    .push_notice(NotComputed::from(error).notice(header))?,
            }
        }
    }

    fn read_frame(
        &self,
        header: Option<FrameHeader>,
        frame: M::WireFrame,
        resets: bool,
    ) -> Result<Frame<M::Frame>, FieldError> {
        Ok(Frame {
            header,
            deadline: deadline::of_frame(header.as_ref(), Instant::now())?,
            content: M::read(self.robot, frame)?,
            resets,
        })
    }

    /// Computes what waits, until nothing more comes.
    async fn compute(
        &self,
        mut memory: M,
        batcher: &Batcher<M::Input, M::Output>,
    ) -> Result<(), Gone> {
        while let Some(next) = self.inbox.next().await {
            let message = match next {
                Next::Notice(notice) => M::dropped(notice),
                Next::Frame(Frame {
                    header,
                    content,
                    resets,
                    deadline,
                }) => {
                    if resets {
                        memory.reset();
                    }
                    let input = memory.input(content);
                    match batcher.compute(Priority::Stream, input, deadline).await {
                        Ok(answer) => memory.answer(header, answer),
                        Err(why) => M::dropped(NotComputed::from(why).notice(header)),
                    }
                }
            };
            self.outbound.send(message).await?;
        }
        Ok(())
    }
}

/// Refuses a stream while its model has no room.
pub(crate) fn check_room<I: Send + 'static, O: Send + 'static>(
    batcher: &Batcher<I, O>,
) -> Result<(), ServiceError> {
    match batcher.overload(Priority::Stream) {
        Some(retry) => Err(Rejected::Full(retry).into()),
        None => Ok(()),
    }
}

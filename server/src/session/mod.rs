//! One open stream: its config, the frames that wait, its end. What its frames hold and what a robot's past does to them
//! is up to its [`Kind`].
//!
//! A session is one task. It has at most one frame in the model's queue; the others wait here (`ALL`) or replace each
//! other (`LATEST`).

mod dropped;
mod filter;
mod policy;
mod retarget;

use std::{collections::VecDeque, sync::Arc, time::Instant};

use emp_proto::v1::{Delivery, DroppedFrame, FrameHeader};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

pub(crate) use self::{
    dropped::NotComputed, filter::FilterStream, policy::PolicyStream, retarget::RetargetStream,
};
use crate::{
    batcher::{Batcher, Rejected, Ticket},
    catalog::{Catalog, Served},
    deadline,
    error::{FieldError, ServiceError},
    identity::{Caller, Role},
    queue::{Answer, Outcome, Priority},
};

/// What differs between the kinds of streams: their messages, their model, and what they remember from frame to frame.
pub(crate) trait Kind: Sized + Send + 'static {
    /// What the caller has to be for the robot.
    const ROLE: Role;
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

    fn sort(request: Self::Request) -> Option<Incoming<Self>>;

    fn dropped(notice: DroppedFrame) -> Self::Response;

    /// The number of the config's delivery, off the wire.
    fn delivery(config: &Self::Config) -> i32;

    /// The model that the config asks for.
    fn model<'a>(
        catalog: &'a Catalog,
        config: &Self::Config,
    ) -> Result<&'a Arc<ServedBy<Self>>, ServiceError>;

    /// A stream before its first frame.
    fn open(config: &Self::Config, model: &Arc<ServedBy<Self>>) -> Result<Self, FieldError>;

    /// The message that says that the stream was accepted.
    fn started(&self) -> Self::Response;

    fn header(frame: &Self::WireFrame) -> Option<FrameHeader>;

    /// Sees every frame in the order of their arrival, bad ones included, before it is read.
    fn arrived(&mut self, _frame: &Self::WireFrame) {}

    fn read(&mut self, frame: Self::WireFrame) -> Result<Self::Frame, FieldError>;

    /// Tells a frame that it takes the place of an older one that still waited in the session.
    fn supersede(_old: &Self::Frame, _new: &mut Self::Frame) {}

    /// What the model gets for a frame, given the answers so far.
    fn input(&mut self, frame: &Self::Frame) -> Self::Input;

    /// The message with a frame's answer, which is remembered. Only called for answers that are sent.
    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<Self::Output>,
    ) -> Self::Response;
}

/// The model of a kind of stream, behind its queue.
pub(crate) type ServedBy<K> = Served<<K as Kind>::Input, <K as Kind>::Output, <K as Kind>::Model>;

/// A message from the client.
pub(crate) enum Incoming<K: Kind> {
    Config(K::Config),
    Frame(K::WireFrame),
}

/// What a session sends to its client.
pub(crate) type Response<K> = Result<<K as Kind>::Response, Status>;

/// What a session needs from the server.
pub(crate) struct SessionContext {
    pub(crate) catalog: Arc<Catalog>,
    /// Most frames that wait in the session.
    pub(crate) buffer: usize,
    /// Cancelled when the server shuts down.
    pub(crate) drain: CancellationToken,
    /// When the call must have ended.
    pub(crate) deadline: Option<Instant>,
    /// Whose stream it is.
    pub(crate) caller: Caller,
}

/// Serves one stream to its end. Returns at once when the client is gone, which cancels what is still queued.
pub(crate) async fn run<K: Kind>(
    context: SessionContext,
    inbound: Streaming<K::Request>,
    outbound: mpsc::Sender<Response<K>>,
) {
    let conversation = converse::<K>(&context, inbound, &outbound);
    conclude(context.deadline, &outbound, conversation).await;
}

/// Brings a stream's conversation to its end, and tells the client why it ended.
pub(crate) async fn conclude<R>(
    deadline: Option<Instant>,
    outbound: &mpsc::Sender<Result<R, Status>>,
    conversation: impl Future<Output = Result<(), ServiceError>>,
) {
    let end = tokio::select! {
        end = conversation => end,
        () = deadline::passed(deadline) => Err(ServiceError::DeadlineExceeded),
        () = outbound.closed() => return tracing::info!("the client left its stream"),
    };
    match end {
        Ok(()) => tracing::info!("stream ended"),
        Err(error) => {
            tracing::info!(%error, "stream ended early");
            // The client may be gone; then nobody waits for the reason.
            let _ = outbound.send(Err(error.into())).await;
        }
    }
}

async fn converse<K: Kind>(
    context: &SessionContext,
    mut inbound: Streaming<K::Request>,
    outbound: &mpsc::Sender<Response<K>>,
) -> Result<(), ServiceError> {
    let config_of = |message| match K::sort(message) {
        Some(Incoming::Config(config)) => Some(config),
        _ => None,
    };
    let config = read_config(context, &mut inbound, config_of).await?;
    let mut session = Session::<K>::open(context, &config)?;
    let mut end = None;
    loop {
        session.dispatch();
        while let Some(message) = session.outbox.pop_front() {
            if outbound.send(Ok(message)).await.is_err() {
                return Ok(());
            }
        }
        if session.is_idle()
            && let Some(end) = end
        {
            return end;
        }
        let reading = end.is_none();
        tokio::select! {
            message = inbound.message(), if reading && session.has_room() => match message {
                Ok(Some(message)) => session.accept(message)?,
                Ok(None) => end = Some(Ok(())),
                Err(status) => return Err(ServiceError::Transport(status)),
            },
            outcome = in_flight(&mut session.in_flight) => session.finish(outcome),
            () = context.drain.cancelled(), if reading => end = Some(Err(ServiceError::ShuttingDown)),
        }
    }
}

/// The config of a stream, which its first message holds.
pub(crate) async fn read_config<T, C>(
    context: &SessionContext,
    inbound: &mut Streaming<T>,
    config_of: impl FnOnce(T) -> Option<C>,
) -> Result<C, ServiceError> {
    let message = tokio::select! {
        message = inbound.message() => message.map_err(ServiceError::Transport)?,
        () = context.drain.cancelled() => return Err(ServiceError::ShuttingDown),
    };
    let config = message.and_then(config_of);
    config.ok_or_else(|| FieldError::missing_config().into())
}

/// Waits for the frame that is with the model; forever if there is none.
async fn in_flight<O>(frame: &mut Option<InFlight<O>>) -> Outcome<O> {
    match frame {
        Some(frame) => (&mut frame.ticket).await,
        None => std::future::pending().await,
    }
}

/// A frame that was understood.
struct Frame<F> {
    header: Option<FrameHeader>,
    content: F,
    deadline: Option<Instant>,
}

/// The frame that is with the model.
struct InFlight<O> {
    ticket: Ticket<O>,
    header: Option<FrameHeader>,
    deadline: Option<Instant>,
}

/// What waits its turn. Notices wait with `ALL`, so that the answers keep the order of the frames.
enum Waiting<F> {
    Frame(Frame<F>),
    Notice(DroppedFrame),
}

struct Session<K: Kind> {
    kind: K,
    model: Arc<ServedBy<K>>,
    delivery: Delivery,
    buffer: usize,
    waiting: VecDeque<Waiting<K::Frame>>,
    in_flight: Option<InFlight<K::Output>>,
    outbox: VecDeque<K::Response>,
}

impl<K: Kind> Session<K> {
    fn open(context: &SessionContext, config: &K::Config) -> Result<Self, ServiceError> {
        let delivery = read_delivery(K::delivery(config))?;
        let model = K::model(&context.catalog, config)?;
        context.caller.may(K::ROLE, &model.card.robot, "")?;
        let kind = K::open(config, model)?;
        check_room(&model.batcher)?;
        tracing::info!(model = model.card.name, ?delivery, "stream started");
        let started = kind.started();
        Ok(Self {
            kind,
            model: Arc::clone(model),
            delivery,
            buffer: context.buffer,
            waiting: VecDeque::new(),
            in_flight: None,
            outbox: VecDeque::from([started]),
        })
    }

    fn is_idle(&self) -> bool {
        self.in_flight.is_none() && self.waiting.is_empty() && self.outbox.is_empty()
    }

    /// With `LATEST` there is always room: a newer frame takes the place of an older one.
    fn has_room(&self) -> bool {
        self.delivery == Delivery::Latest || self.waiting.len() < self.buffer
    }

    fn accept(&mut self, message: K::Request) -> Result<(), ServiceError> {
        let frame = match K::sort(message) {
            Some(Incoming::Frame(frame)) => frame,
            Some(Incoming::Config(_)) => return Err(FieldError::second_config().into()),
            None => return Err(FieldError::missing_frame().into()),
        };
        let header = K::header(&frame);
        match (self.read_frame(header, frame), self.delivery) {
            (Ok(frame), Delivery::Latest) => self.accept_latest(frame),
            (Ok(frame), _) => self.waiting.push_back(Waiting::Frame(frame)),
            (Err(error), Delivery::Latest) => self.drop_frame(header, error.into()),
            (Err(error), _) => self
                .waiting
                .push_back(Waiting::Notice(NotComputed::from(error).notice(header))),
        }
        Ok(())
    }

    fn read_frame(
        &mut self,
        header: Option<FrameHeader>,
        frame: K::WireFrame,
    ) -> Result<Frame<K::Frame>, FieldError> {
        self.kind.arrived(&frame);
        let deadline = deadline::of_frame(header.as_ref(), Instant::now())?;
        let content = self.kind.read(frame)?;
        Ok(Frame {
            header,
            content,
            deadline,
        })
    }

    fn accept_latest(&mut self, mut frame: Frame<K::Frame>) {
        if let Some(Waiting::Frame(old)) = self.waiting.pop_front() {
            K::supersede(&old.content, &mut frame.content);
            self.drop_frame(old.header, NotComputed::superseded());
        } else if let Some(in_flight) = &mut self.in_flight {
            let input = self.kind.input(&frame.content);
            if self
                .model
                .batcher
                .replace(&mut in_flight.ticket, input, frame.deadline)
                .is_ok()
            {
                let old = std::mem::replace(&mut in_flight.header, frame.header);
                in_flight.deadline = frame.deadline;
                return self.drop_frame(old, NotComputed::superseded());
            }
        }
        self.waiting.push_back(Waiting::Frame(frame));
    }

    /// Sends the next waiting frame to the model, if none is there.
    fn dispatch(&mut self) {
        while self.in_flight.is_none() {
            match self.waiting.pop_front() {
                Some(Waiting::Frame(frame)) => self.submit(frame),
                Some(Waiting::Notice(notice)) => self.outbox.push_back(K::dropped(notice)),
                None => return,
            }
        }
    }

    fn submit(&mut self, frame: Frame<K::Frame>) {
        let Frame {
            header,
            content,
            deadline,
        } = frame;
        let input = self.kind.input(&content);
        if deadline::has_passed(deadline) {
            return self.drop_frame(header, NotComputed::late());
        }
        match self.model.batcher.submit(Priority::Stream, input, deadline) {
            Ok(ticket) => {
                self.in_flight = Some(InFlight {
                    ticket,
                    header,
                    deadline,
                });
            }
            Err(rejected) => self.drop_frame(header, rejected.into()),
        }
    }

    /// Takes the model's answer to the frame in flight.
    fn finish(&mut self, outcome: Outcome<K::Output>) {
        let Some(InFlight {
            header, deadline, ..
        }) = self.in_flight.take()
        else {
            return;
        };
        match outcome {
            Ok(_) if deadline::has_passed(deadline) => self.drop_frame(header, NotComputed::late()),
            Ok(answer) => {
                let response = self.kind.answer(header, answer);
                self.outbox.push_back(response);
            }
            Err(error) => self.drop_frame(header, error.into()),
        }
    }

    fn drop_frame(&mut self, header: Option<FrameHeader>, why: NotComputed) {
        self.outbox.push_back(K::dropped(why.notice(header)));
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

pub(crate) fn read_delivery(number: i32) -> Result<Delivery, FieldError> {
    match Delivery::try_from(number) {
        Ok(Delivery::Unspecified | Delivery::All) => Ok(Delivery::All),
        Ok(Delivery::Latest) => Ok(Delivery::Latest),
        Err(_) => Err(FieldError::not_in("Delivery", "config.delivery", number)),
    }
}

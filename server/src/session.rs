//! One open `StreamRetarget`: its config, the frames that wait, its history, its end.
//!
//! A session is one task. It has at most one frame in the model's queue; the others wait here (`ALL`) or replace each
//! other (`LATEST`).

use std::{collections::VecDeque, sync::Arc, time::Instant};

use emp_models::retarget::{RetargetInput, RetargetOutput, Smoother};
use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    Delivery, DropReason, DroppedFrame, FrameHeader, RetargetFrame, RetargetedFrame,
    StreamRetargetConfig, StreamRetargetRequest, StreamRetargetResponse, StreamStarted,
    stream_retarget_request::Message as Incoming, stream_retarget_response::Message as Outgoing,
};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

use crate::{
    batcher::{Rejected, Ticket},
    catalog::{Catalog, RetargetModel},
    deadline,
    error::{FieldError, ServiceError},
    pose,
    queue::{JobError, Outcome, Priority},
    wire,
};

/// What a session sends to its client.
pub(crate) type Response = Result<StreamRetargetResponse, Status>;

/// What a session needs from the server.
pub(crate) struct SessionContext {
    pub(crate) catalog: Arc<Catalog>,
    /// Most frames that wait in the session.
    pub(crate) buffer: usize,
    /// Cancelled when the server shuts down.
    pub(crate) drain: CancellationToken,
    /// When the call must have ended.
    pub(crate) deadline: Option<Instant>,
}

/// Serves one stream to its end. Returns at once when the client is gone, which cancels what is still queued.
pub(crate) async fn run(
    context: SessionContext,
    inbound: Streaming<StreamRetargetRequest>,
    outbound: mpsc::Sender<Response>,
) {
    let end = tokio::select! {
        end = converse(&context, inbound, &outbound) => end,
        () = deadline::passed(context.deadline) => Err(ServiceError::DeadlineExceeded),
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

async fn converse(
    context: &SessionContext,
    mut inbound: Streaming<StreamRetargetRequest>,
    outbound: &mpsc::Sender<Response>,
) -> Result<(), ServiceError> {
    let config = tokio::select! {
        config = first_message(&mut inbound) => config?,
        () = context.drain.cancelled() => return Err(ServiceError::ShuttingDown),
    };
    let mut session = Session::open(context, &config)?;
    let mut end = None;
    loop {
        session.dispatch();
        while let Some(message) = session.outbox.pop_front() {
            if outbound
                .send(Ok(StreamRetargetResponse {
                    message: Some(message),
                }))
                .await
                .is_err()
            {
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
                Ok(Some(message)) => session.accept(&message)?,
                Ok(None) => end = Some(Ok(())),
                Err(status) => return Err(ServiceError::Transport(status)),
            },
            outcome = in_flight(&mut session.in_flight) => session.finish(outcome),
            () = context.drain.cancelled(), if reading => end = Some(Err(ServiceError::ShuttingDown)),
        }
    }
}

async fn first_message(
    inbound: &mut Streaming<StreamRetargetRequest>,
) -> Result<StreamRetargetConfig, ServiceError> {
    let message = inbound.message().await.map_err(ServiceError::Transport)?;
    match message.and_then(|message| message.message) {
        Some(Incoming::Config(config)) => Ok(config),
        _ => Err(FieldError::new(
            "config",
            "it is missing; a stream's first message is its config",
        )
        .into()),
    }
}

/// Waits for the frame that is with the model; forever if there is none.
async fn in_flight(frame: &mut Option<InFlight>) -> Outcome<RetargetOutput> {
    match frame {
        Some(frame) => (&mut frame.ticket).await,
        None => std::future::pending().await,
    }
}

/// A frame that was understood.
struct Frame {
    header: Option<FrameHeader>,
    pose: KeyNodeFrame,
    deadline: Option<Instant>,
}

/// The frame that is with the model.
struct InFlight {
    ticket: Ticket<RetargetOutput>,
    header: Option<FrameHeader>,
    deadline: Option<Instant>,
}

/// What waits its turn. Notices wait with `ALL`, so that the answers keep the order of the frames.
enum Waiting {
    Frame(Frame),
    Notice(DroppedFrame),
}

struct Session {
    model: Arc<RetargetModel>,
    delivery: Delivery,
    refine: bool,
    smoother: Option<Smoother>,
    /// The last refined answer, before smoothing.
    previous: Option<Vec<f32>>,
    buffer: usize,
    waiting: VecDeque<Waiting>,
    in_flight: Option<InFlight>,
    outbox: VecDeque<Outgoing>,
}

impl Session {
    fn open(context: &SessionContext, config: &StreamRetargetConfig) -> Result<Self, ServiceError> {
        let delivery = match Delivery::try_from(config.delivery) {
            Ok(Delivery::Unspecified | Delivery::All) => Delivery::All,
            Ok(Delivery::Latest) => Delivery::Latest,
            Err(_) => {
                let description =
                    format!("{}; expected a value of emp.v1.Delivery", config.delivery);
                return Err(FieldError::new("config.delivery", description).into());
            }
        };
        let model =
            context
                .catalog
                .retargeter_for(&config.robot, &config.model, &config.model_version)?;
        if let Some(retry) = model.batcher.overload(Priority::Stream) {
            return Err(Rejected::Full(retry).into());
        }
        tracing::info!(model = model.card.name, ?delivery, "stream started");
        let started = StreamStarted {
            robot: model.card.robot.clone(),
            model: model.card.name.clone(),
            model_version: model.card.version.clone(),
            joint_names: model.card.joint_names.clone(),
        };
        Ok(Self {
            model: Arc::clone(model),
            delivery,
            refine: config.refine,
            smoother: config.smoothing.then(Smoother::new),
            previous: None,
            buffer: context.buffer,
            waiting: VecDeque::new(),
            in_flight: None,
            outbox: VecDeque::from([Outgoing::Started(started)]),
        })
    }

    fn is_idle(&self) -> bool {
        self.in_flight.is_none() && self.waiting.is_empty() && self.outbox.is_empty()
    }

    /// With `LATEST` there is always room: a newer frame takes the place of an older one.
    fn has_room(&self) -> bool {
        self.delivery == Delivery::Latest || self.waiting.len() < self.buffer
    }

    fn accept(&mut self, message: &StreamRetargetRequest) -> Result<(), ServiceError> {
        let frame = match &message.message {
            Some(Incoming::Frame(frame)) => frame,
            Some(Incoming::Config(_)) => {
                return Err(
                    FieldError::new("config", "only the first message may be a config").into(),
                );
            }
            None => {
                return Err(FieldError::new("message", "it is missing; expected a frame").into());
            }
        };
        let header = frame.header;
        match (read_frame(frame), self.delivery) {
            (Ok(frame), Delivery::Latest) => self.accept_latest(frame),
            (Ok(frame), _) => self.waiting.push_back(Waiting::Frame(frame)),
            (Err(error), Delivery::Latest) => self
                .outbox
                .push_back(Outgoing::Dropped(invalid(header, error))),
            (Err(error), _) => self
                .waiting
                .push_back(Waiting::Notice(invalid(header, error))),
        }
        Ok(())
    }

    fn accept_latest(&mut self, mut frame: Frame) {
        if let Some(in_flight) = &mut self.in_flight {
            let input = RetargetInput {
                frame: frame.pose,
                refine: self.refine,
                previous: self.previous.clone(),
            };
            match self
                .model
                .batcher
                .replace(&mut in_flight.ticket, input, frame.deadline)
            {
                Ok(_) => {
                    let old = std::mem::replace(&mut in_flight.header, frame.header);
                    in_flight.deadline = frame.deadline;
                    return self.supersede(old);
                }
                Err(input) => frame.pose = input.frame,
            }
        }
        if let Some(Waiting::Frame(old)) = self.waiting.pop_front() {
            self.supersede(old.header);
        }
        self.waiting.push_back(Waiting::Frame(frame));
    }

    fn supersede(&mut self, header: Option<FrameHeader>) {
        self.drop_frame(
            header,
            DropReason::Superseded,
            "a newer frame took its place",
        );
    }

    /// Sends the next waiting frame to the model, if none is there.
    fn dispatch(&mut self) {
        while self.in_flight.is_none() {
            match self.waiting.pop_front() {
                Some(Waiting::Frame(frame)) => self.submit(frame),
                Some(Waiting::Notice(notice)) => self.outbox.push_back(Outgoing::Dropped(notice)),
                None => return,
            }
        }
    }

    fn submit(&mut self, frame: Frame) {
        let Frame {
            header,
            pose,
            deadline,
        } = frame;
        if deadline::has_passed(deadline) {
            return self.drop_late(header);
        }
        let input = RetargetInput {
            frame: pose,
            refine: self.refine,
            previous: self.previous.clone(),
        };
        match self.model.batcher.submit(Priority::Stream, input, deadline) {
            Ok(ticket) => {
                self.in_flight = Some(InFlight {
                    ticket,
                    header,
                    deadline,
                });
            }
            Err(Rejected::Full(_)) => {
                self.drop_frame(header, DropReason::Overloaded, "the model's queue is full");
            }
            Err(Rejected::Unavailable) => {
                self.drop_frame(
                    header,
                    DropReason::ModelUnavailable,
                    "the model is being rebuilt",
                );
            }
        }
    }

    /// Takes the model's answer to the frame in flight.
    fn finish(&mut self, outcome: Outcome<RetargetOutput>) {
        let Some(InFlight {
            header, deadline, ..
        }) = self.in_flight.take()
        else {
            return;
        };
        let answer = match outcome {
            Ok(answer) => answer,
            Err(JobError::DeadlineExceeded) => return self.drop_late(header),
            Err(error @ JobError::ModelFailed(_)) => {
                return self.drop_frame(header, DropReason::ModelFailed, &error.to_string());
            }
            Err(error @ JobError::ModelUnavailable) => {
                return self.drop_frame(header, DropReason::ModelUnavailable, &error.to_string());
            }
        };
        let timing = wire::timing(&answer);
        let mut angles = answer.output.angles;
        if self.refine {
            self.previous = Some(angles.clone());
        }
        if let Some(smoother) = &mut self.smoother {
            smoother.step(&mut angles);
        }
        if deadline::has_passed(deadline) {
            return self.drop_late(header);
        }
        let result =
            wire::retarget_result(&self.model.robot, angles, answer.output.direction_error);
        let answered = RetargetedFrame {
            header,
            result: Some(result),
            timing: Some(timing),
        };
        self.outbox.push_back(Outgoing::Result(answered));
    }

    fn drop_late(&mut self, header: Option<FrameHeader>) {
        self.drop_frame(
            header,
            DropReason::DeadlineExceeded,
            "its time budget ran out",
        );
    }

    fn drop_frame(&mut self, header: Option<FrameHeader>, reason: DropReason, description: &str) {
        self.outbox.push_back(Outgoing::Dropped(DroppedFrame {
            header,
            reason: reason.into(),
            field: String::new(),
            description: description.to_owned(),
        }));
    }
}

fn read_frame(frame: &RetargetFrame) -> Result<Frame, FieldError> {
    let deadline = deadline::of_frame(frame.header.as_ref(), Instant::now())?;
    let pose = pose::read(frame.pose.as_ref())?;
    Ok(Frame {
        header: frame.header,
        pose,
        deadline,
    })
}

fn invalid(header: Option<FrameHeader>, error: FieldError) -> DroppedFrame {
    let FieldError { field, description } = error;
    DroppedFrame {
        header,
        reason: DropReason::Invalid.into(),
        field,
        description,
    }
}

//! The task behind an open stream: it keeps a window of unanswered frames and carries them over lost connections.

use std::{collections::VecDeque, time::Instant};

use emp_proto::v1::{Delivery, motion_service_client::MotionServiceClient};
use tokio::{
    sync::mpsc,
    time::{sleep_until, timeout},
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

use crate::{
    Backoff, ClientError, DropCause, Dropped, Event, FrameSender, StreamEvents,
    backoff::Break,
    kind::{Incoming, Kind, Started},
    stream::Outbound,
    wire,
};

/// Most frames without an answer.
const WINDOW: usize = 64;
/// Frames between the program and the driver, and between the driver and the transport.
const HAND_OVER: usize = 4;
/// Events that wait for the program.
const EVENTS: usize = 256;
/// How long a server may take to accept a stream.
const OPEN_TIMEOUT: std::time::Duration = std::time::Duration::from_secs(10);

/// Opens a stream and starts its driver.
pub(crate) async fn start<K: Kind>(
    service: MotionServiceClient<Channel>,
    config: K,
    backoff: Backoff,
) -> Result<(FrameSender<K::Frame>, StreamEvents<K::Answer>), ClientError> {
    let (connection, started) = open(&service, &config).await?;
    let (frames, from_program) = mpsc::channel(HAND_OVER);
    let (to_program, events) = mpsc::channel(EVENTS);
    let Started {
        model,
        model_version,
        joint_names,
    } = started;
    let driver = Driver {
        service,
        config,
        backoff,
        frames: from_program,
        sending: true,
        events: to_program,
        joint_names: joint_names.clone(),
        window: VecDeque::new(),
        unsent: 0,
    };
    tokio::spawn(driver.run(connection));
    let sender = FrameSender {
        frames,
        next_number: 0,
    };
    Ok((
        sender,
        StreamEvents {
            joint_names,
            model,
            model_version,
            events,
        },
    ))
}

/// One call.
struct Connection<K: Kind> {
    /// None once half-closed.
    requests: Option<mpsc::Sender<K::Request>>,
    responses: Streaming<K::Response>,
}

async fn open<K: Kind>(
    service: &MotionServiceClient<Channel>,
    config: &K,
) -> Result<(Connection<K>, Started), Break> {
    let (requests, outbound) = mpsc::channel(HAND_OVER);
    let opening = async {
        // The channel is new and has room.
        let _ = requests.send(config.first()).await;
        let call = K::call(service.clone(), ReceiverStream::new(outbound));
        let mut responses = call.await?;
        match responses.message().await?.and_then(K::sort) {
            Some(Incoming::Started(started)) => Ok((
                Connection {
                    requests: Some(requests),
                    responses,
                },
                started,
            )),
            _ => Err(Break::Silence("the stream ended before it was accepted")),
        }
    };
    timeout(OPEN_TIMEOUT, opening).await.unwrap_or_else(|_| {
        Err(Break::Silence(
            "the server did not accept the stream in time",
        ))
    })
}

/// A frame without an answer.
struct Unanswered<K: Kind> {
    number: u64,
    message: K::Request,
    first_sent: Instant,
}

struct Driver<K: Kind> {
    service: MotionServiceClient<Channel>,
    config: K,
    backoff: Backoff,
    frames: mpsc::Receiver<Outbound<K::Frame>>,
    /// Whether the program may still send.
    sending: bool,
    events: mpsc::Sender<Result<Event<K::Answer>, ClientError>>,
    /// Names and order of the joints.
    joint_names: Vec<String>,
    window: VecDeque<Unanswered<K>>,
    /// Index in the window of the first frame that this connection has not seen.
    unsent: usize,
}

/// Why a connection's turn is over.
enum End {
    /// Every frame has its answer, and the program sends no more.
    Finished,
    /// The program let go of its events.
    Abandoned,
    /// The connection or the server ended it.
    Broken(Break),
    /// The stream cannot go on.
    Failed(ClientError),
}

/// What happens next on a connection.
enum Step<K: Kind> {
    /// The next frame went out, or found the transport gone.
    Sent(bool),
    /// The program has another frame, or sends no more.
    Frame(Option<Outbound<K::Frame>>),
    Response(Result<Option<K::Response>, Status>),
}

impl<K: Kind> Driver<K> {
    async fn run(mut self, mut connection: Connection<K>) {
        loop {
            let end = self.converse(connection).await;
            let end = match end {
                End::Broken(end) if end.is_worth_retrying() => match self.reconnect(end).await {
                    Ok(new) => {
                        connection = new;
                        continue;
                    }
                    Err(end) => end,
                },
                end => end,
            };
            let error = match end {
                End::Finished | End::Abandoned => return,
                End::Broken(end) => end.into(),
                End::Failed(error) => error,
            };
            // Whoever let go of the events does not want to know.
            let _ = self.events.send(Err(error)).await;
            return;
        }
    }

    async fn converse(&mut self, mut connection: Connection<K>) -> End {
        loop {
            if !self.sending && self.unsent == self.window.len() {
                connection.requests = None;
            }
            let has_unsent = self.unsent < self.window.len();
            let has_room = self.window.len() < WINDOW;
            let step: Step<K> = tokio::select! {
                () = self.events.closed() => return End::Abandoned,
                sent = send::<K>(connection.requests.as_ref(), self.window.get(self.unsent)), if has_unsent => Step::Sent(sent),
                frame = self.frames.recv(), if self.sending && has_room => Step::Frame(frame),
                response = connection.responses.message() => Step::Response(response),
            };
            match step {
                Step::Sent(true) => self.unsent += 1,
                // The transport is gone; the responses say why.
                Step::Sent(false) => connection.requests = None,
                Step::Frame(Some(frame)) => self.window.push_back(unanswered(frame)),
                Step::Frame(None) => self.sending = false,
                Step::Response(Ok(Some(response))) => match self.event(response) {
                    Ok(event) => {
                        if !self.tell(event).await {
                            return End::Abandoned;
                        }
                    }
                    Err(error) => return End::Failed(error),
                },
                Step::Response(Ok(None)) if !self.sending && self.window.is_empty() => {
                    return End::Finished;
                }
                Step::Response(Ok(None)) => {
                    return End::Broken(Break::Silence("the server ended the stream early"));
                }
                Step::Response(Err(status)) => return End::Broken(status.into()),
            }
        }
    }

    /// Takes an answered or dropped frame out of the window.
    fn event(&mut self, response: K::Response) -> Result<Event<K::Answer>, ClientError> {
        match K::sort(response) {
            Some(Incoming::Result { number, message }) => {
                let first_sent = self.settle(number)?;
                let answer = K::answer(number, message, first_sent.elapsed())?;
                Ok(Event::Answer(answer))
            }
            Some(Incoming::Dropped(message)) => {
                let dropped = wire::dropped(message);
                self.settle(dropped.sequence_number)?;
                Ok(Event::Dropped(dropped))
            }
            Some(Incoming::Started(_)) => Err(ClientError::Contract("a stream that starts twice")),
            None => Err(ClientError::Contract(
                "a message without content; is the server newer?",
            )),
        }
    }

    fn settle(&mut self, number: u64) -> Result<Instant, ClientError> {
        let index = self
            .window
            .iter()
            .take(self.unsent)
            .position(|frame| frame.number == number);
        let frame = index.and_then(|index| self.window.remove(index));
        let frame = frame.ok_or(ClientError::Contract(
            "an answer to a frame that was not sent",
        ))?;
        self.unsent -= 1;
        Ok(frame.first_sent)
    }

    /// Restores the connection, or says why it cannot be.
    async fn reconnect(&mut self, mut last: Break) -> Result<Connection<K>, End> {
        let start = Instant::now();
        self.unsent = 0;
        for attempt in 1.. {
            let retry_in = self.backoff.pause(attempt, &last);
            let reason = last.reason().to_owned();
            if start.elapsed() + retry_in > self.backoff.give_up {
                let seconds = start.elapsed().as_secs_f64();
                return Err(End::Failed(ClientError::Lost {
                    seconds,
                    last: reason,
                }));
            }
            if !self
                .tell(Event::ConnectionLost {
                    reason,
                    attempt,
                    retry_in,
                })
                .await
                || !self.wait(Instant::now() + retry_in).await
            {
                return Err(End::Abandoned);
            }
            match open(&self.service, &self.config).await {
                Ok((_, started)) if started.joint_names != self.joint_names => {
                    let what = "the server came back with other joints";
                    return Err(End::Failed(ClientError::Contract(what)));
                }
                Ok((connection, _)) => {
                    let resent = self.window.len();
                    return if self.tell(Event::Reconnected { resent }).await {
                        Ok(connection)
                    } else {
                        Err(End::Abandoned)
                    };
                }
                Err(end) if end.is_worth_retrying_again() => last = end,
                Err(end) => return Err(End::Broken(end)),
            }
        }
        Err(End::Broken(last))
    }

    /// Waits for the next attempt. With `LATEST` whatever is unanswered or sent meanwhile is dropped: it would be stale.
    async fn wait(&mut self, until: Instant) -> bool {
        let latest = self.config.delivery() == Delivery::Latest;
        loop {
            while latest && let Some(frame) = self.window.pop_front() {
                if !self.tell(lost(frame.number)).await {
                    return false;
                }
            }
            tokio::select! {
                () = sleep_until(until.into()) => return true,
                () = self.events.closed() => return false,
                frame = self.frames.recv(), if latest && self.sending => match frame {
                    Some(frame) => self.window.push_back(unanswered(frame)),
                    None => self.sending = false,
                },
            }
        }
    }

    /// Hands an event to the program; false when it let go.
    async fn tell(&self, event: Event<K::Answer>) -> bool {
        self.events.send(Ok(event)).await.is_ok()
    }
}

/// Hands a frame to the transport; false when that is gone.
async fn send<K: Kind>(
    requests: Option<&mpsc::Sender<K::Request>>,
    frame: Option<&Unanswered<K>>,
) -> bool {
    match (requests, frame) {
        (Some(requests), Some(frame)) => match requests.reserve().await {
            Ok(permit) => {
                permit.send(frame.message.clone());
                true
            }
            Err(_) => false,
        },
        _ => std::future::pending().await,
    }
}

fn unanswered<K: Kind>(outbound: Outbound<K::Frame>) -> Unanswered<K> {
    let Outbound {
        number,
        frame,
        time_budget,
    } = outbound;
    Unanswered {
        number,
        message: K::frame(wire::header(number, time_budget), &frame),
        first_sent: Instant::now(),
    }
}

fn lost<A>(number: u64) -> Event<A> {
    Event::Dropped(Dropped {
        sequence_number: number,
        cause: DropCause::ConnectionLost,
        field: String::new(),
        description: "the connection was lost".to_owned(),
    })
}

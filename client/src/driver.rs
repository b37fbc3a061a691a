//! The task behind an open stream: it keeps a window of unanswered frames and carries them over lost connections.

use std::{collections::VecDeque, time::Instant};

use tokio::{sync::mpsc, time::sleep_until};
use tonic::{Status, transport::Channel};

use crate::{
    Backoff, ClientError, DropCause, Dropped, Event, FrameSender, StreamEvents,
    backoff::Break,
    connection::{self, Attempts, EVENTS, End, HAND_OVER},
    kind::{Incoming, Kind, Started},
    stream::Outbound,
    wire,
};

/// Most frames without an answer.
const WINDOW: usize = 64;

/// Opens a stream and starts its driver.
pub(crate) async fn start<K: Kind>(
    channel: Channel,
    mut config: K,
    backoff: Backoff,
) -> Result<(FrameSender<K::Frame>, StreamEvents<K::Answer>), ClientError> {
    let (connection, started) = open(&channel, &config).await?;
    config.accepted(&started);
    let (frames, from_program) = mpsc::channel(HAND_OVER);
    let (to_program, events) = mpsc::channel(EVENTS);
    let Started {
        model,
        model_version,
        joint_names,
        ..
    } = started;
    let driver = Driver {
        channel,
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
type Connection<K> = connection::Connection<<K as Kind>::Request, <K as Kind>::Response>;

async fn open<K: Kind>(channel: &Channel, config: &K) -> Result<(Connection<K>, Started), Break> {
    let call = |requests| K::call(channel.clone(), requests);
    let started = |response| match K::sort(response) {
        Some(Incoming::Started(started)) => Some(started),
        _ => None,
    };
    connection::open(config.first(), call, started).await
}

/// A frame without an answer.
struct Unanswered<K: Kind> {
    number: u64,
    message: K::Request,
    first_sent: Instant,
}

struct Driver<K: Kind> {
    channel: Channel,
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
        let mut attempts: Option<Attempts> = None;
        let end = loop {
            let since = Instant::now();
            match self.converse(connection).await {
                End::Broken(end) if end.is_worth_retrying() => {
                    let next = Attempts::after(end, self.backoff, attempts.take(), since.elapsed());
                    let next = attempts.insert(next);
                    match self.reconnect(next).await {
                        Ok(new) => connection = new,
                        Err(end) => break end,
                    }
                }
                end => break end,
            }
        };
        if let Some(error) = end.error() {
            // Whoever let go of the events does not want to know.
            let _ = self.events.send(Err(error)).await;
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
                Step::Frame(Some(frame)) => self.window.push_back(self.unanswered(frame)),
                Step::Frame(None) => self.sending = false,
                Step::Response(Ok(Some(response))) => {
                    if let Err(end) = self.take(response).await {
                        return end;
                    }
                }
                Step::Response(Ok(None)) if !self.sending && self.window.is_empty() => {
                    return End::Finished;
                }
                Step::Response(Ok(None)) => return End::early(),
                Step::Response(Err(status)) => return End::Broken(status.into()),
            }
        }
    }

    /// Takes a message and tells the program of it.
    async fn take(&mut self, response: K::Response) -> Result<(), End> {
        match self.event(response).map_err(End::Failed)? {
            Some(event) => self.tell(event).await,
            None => Ok(()),
        }
    }

    /// Takes an answered or dropped frame out of the window.
    fn event(&mut self, response: K::Response) -> Result<Option<Event<K::Answer>>, ClientError> {
        match K::sort(response) {
            Some(Incoming::Result {
                number,
                result,
                timing,
            }) => {
                let first_sent = self.settle(number)?;
                let result = result.ok_or(ClientError::Contract("an answer without a result"))?;
                let times = wire::times(timing, first_sent.elapsed());
                let answer = K::answer(number, result, times);
                Ok(Some(Event::Answer(answer)))
            }
            Some(Incoming::Dropped(message)) => {
                let dropped = wire::dropped(message);
                self.settle(dropped.sequence_number)?;
                Ok(Some(Event::Dropped(dropped)))
            }
            Some(Incoming::GoingAway(notice)) => Ok(Some(Event::GoingAway {
                grace: wire::duration(notice.grace),
            })),
            Some(Incoming::Other) => Ok(None),
            Some(Incoming::Started(_)) => Err(ClientError::Contract("a stream that starts twice")),
            None => Err(ClientError::EMPTY_MESSAGE),
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
    async fn reconnect(&mut self, attempts: &mut Attempts) -> Result<Connection<K>, End> {
        self.unsent = 0;
        loop {
            let (reason, attempt, retry_in) = attempts.another()?;
            self.tell(Event::ConnectionLost {
                reason,
                attempt,
                retry_in,
            })
            .await?;
            self.wait(Instant::now() + retry_in).await?;
            let opened = self.open_again().await?;
            match opened {
                Ok((_, started)) if started.joint_names != self.joint_names => {
                    return Err(End::contract("the server came back with other joints"));
                }
                Ok((connection, started)) => {
                    self.config.accepted(&started);
                    let resent = self.window.len();
                    self.tell(Event::Reconnected { resent }).await?;
                    return Ok(connection);
                }
                Err(why) => attempts.failed(why)?,
            }
        }
    }

    /// One attempt; what would be stale by then is dropped meanwhile.
    async fn open_again(&mut self) -> Result<Result<(Connection<K>, Started), Break>, End> {
        let (channel, config) = (self.channel.clone(), self.config.clone());
        let opening = open(&channel, &config);
        tokio::pin!(opening);
        let stale = !self.config.resends();
        loop {
            tokio::select! {
                opened = &mut opening => return Ok(opened),
                () = self.events.closed() => return Err(End::Abandoned),
                frame = self.frames.recv(), if stale && self.sending => match frame {
                    Some(frame) => self.tell(lost(frame.number)).await?,
                    None => self.sending = false,
                },
            }
        }
    }

    /// Waits for the next attempt. What would be stale, unanswered or sent meanwhile, is dropped.
    async fn wait(&mut self, until: Instant) -> Result<(), End> {
        let latest = !self.config.resends();
        loop {
            while latest && let Some(frame) = self.window.pop_front() {
                self.tell(lost(frame.number)).await?;
            }
            tokio::select! {
                () = sleep_until(until.into()) => return Ok(()),
                () = self.events.closed() => return Err(End::Abandoned),
                frame = self.frames.recv(), if latest && self.sending => match frame {
                    Some(frame) => self.tell(lost(frame.number)).await?,
                    None => self.sending = false,
                },
            }
        }
    }

    fn unanswered(&self, outbound: Outbound<K::Frame>) -> Unanswered<K> {
        let Outbound {
            number,
            frame,
            time_budget,
        } = outbound;
        let header = wire::header(number, time_budget);
        Unanswered {
            number,
            message: self.config.frame(header, &frame),
            first_sent: Instant::now(),
        }
    }

    /// Hands an event to the program.
    async fn tell(&self, event: Event<K::Answer>) -> Result<(), End> {
        let sent = self.events.send(Ok(event)).await;
        sent.map_err(|_| End::Abandoned)
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

fn lost<A>(number: u64) -> Event<A> {
    Event::Dropped(Dropped {
        sequence_number: number,
        cause: DropCause::ConnectionLost,
        field: String::new(),
        description: "the connection was lost".to_owned(),
    })
}

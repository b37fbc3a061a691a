//! The task behind an operator's or an observer's stream: it passes poses on and tells what the session tells, and carries
//! both over lost connections.

use std::time::{Duration, Instant};

use emp_proto::v1::{
    TeleoperateRequest, TeleoperateResponse, TeleoperationRole, TeleoperationStarted,
    motion_service_client::MotionServiceClient, teleoperate_response::Message,
};
use tokio::{
    sync::mpsc,
    time::{sleep_until, timeout},
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

use crate::{
    Backoff, ClientError, PoseSender, SessionEvent, SessionEvents, TeleoperationConfig,
    backoff::Break, teleoperation, wire,
};

/// Poses between the program and the transport.
const HAND_OVER: usize = 4;
/// Events that wait for the program.
const EVENTS: usize = 256;
/// How long a server may take to accept a stream.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);

/// Joins a session and starts the stream's driver.
pub(crate) async fn start(
    service: MotionServiceClient<Channel>,
    config: TeleoperationConfig,
    role: TeleoperationRole,
    backoff: Backoff,
) -> Result<(PoseSender, SessionEvents), ClientError> {
    let (poses, from_program) = mpsc::channel(HAND_OVER);
    let (to_program, events) = mpsc::channel(EVENTS);
    let listener = Listener {
        service,
        config,
        role,
        backoff,
        poses: from_program,
        events: to_program,
    };
    let (connection, started) = listener.open().await?;
    tokio::spawn(listener.run(connection));
    let sender = PoseSender {
        poses,
        next_number: 0,
    };
    Ok((sender, SessionEvents { started, events }))
}

/// One call.
struct Connection {
    /// None once half-closed.
    requests: Option<mpsc::Sender<TeleoperateRequest>>,
    responses: Streaming<TeleoperateResponse>,
}

struct Listener {
    service: MotionServiceClient<Channel>,
    config: TeleoperationConfig,
    role: TeleoperationRole,
    backoff: Backoff,
    poses: mpsc::Receiver<TeleoperateRequest>,
    events: mpsc::Sender<Result<SessionEvent, ClientError>>,
}

/// Why a connection's turn is over.
enum End {
    /// The operator left, and the server has said all.
    Finished,
    /// The program let go of its events.
    Abandoned,
    /// The connection or the server ended it.
    Broken(Break),
    /// The stream cannot go on.
    Failed(ClientError),
}

impl Listener {
    async fn open(&self) -> Result<(Connection, TeleoperationStarted), Break> {
        let (requests, outbound) = mpsc::channel(HAND_OVER);
        let opening = async {
            // The channel is new and has room.
            let _ = requests.send(self.config.request(self.role)).await;
            let call = teleoperation::call(self.service.clone(), ReceiverStream::new(outbound));
            let mut responses = call.await?;
            let first = responses.message().await?;
            match first.and_then(|response| response.message) {
                Some(Message::Started(started)) => Ok((
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

    async fn run(mut self, mut connection: Connection) {
        loop {
            let end = match self.converse(connection).await {
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

    async fn converse(&mut self, mut connection: Connection) -> End {
        let is_operator = self.role == TeleoperationRole::Operator;
        loop {
            let may_send = is_operator && connection.requests.is_some();
            let response = tokio::select! {
                () = self.events.closed() => return End::Abandoned,
                response = connection.responses.message() => response,
                pose = self.poses.recv(), if may_send => {
                    // Without a pose the operator has left; a transport that is gone says why in the responses.
                    let gone = match (pose, &connection.requests) {
                        (Some(pose), Some(requests)) => requests.send(pose).await.is_err(),
                        _ => true,
                    };
                    if gone {
                        connection.requests = None;
                    }
                    continue;
                }
            };
            match self.tell(response, connection.requests.is_none()).await {
                Ok(()) => {}
                Err(end) => return end,
            }
        }
    }

    /// Hands a message to the program.
    async fn tell(
        &self,
        response: Result<Option<TeleoperateResponse>, Status>,
        has_left: bool,
    ) -> Result<(), End> {
        let message = match response {
            Ok(Some(response)) => response.message,
            Ok(None) if has_left => return Err(End::Finished),
            Ok(None) => {
                let silence = Break::Silence("the server ended the stream early");
                return Err(End::Broken(silence));
            }
            Err(status) => return Err(End::Broken(status.into())),
        };
        let event = match message {
            Some(Message::Result(result)) => SessionEvent::Executed(Box::new(result)),
            Some(Message::Presence(presence)) => SessionEvent::Presence(presence),
            Some(Message::Dropped(dropped)) => SessionEvent::Dropped(wire::dropped(dropped)),
            Some(Message::Started(_)) => return Err(broken_contract("a stream that starts twice")),
            None => {
                let what = "a message without content; is the server newer?";
                return Err(broken_contract(what));
            }
        };
        self.pass_on(event).await
    }

    async fn pass_on(&self, event: SessionEvent) -> Result<(), End> {
        let sent = self.events.send(Ok(event)).await;
        sent.map_err(|_| End::Abandoned)
    }

    /// Restores the connection, or says why it cannot be.
    async fn reconnect(&mut self, mut last: Break) -> Result<Connection, End> {
        let start = Instant::now();
        for attempt in 1.. {
            let retry_in = self.backoff.pause(attempt, &last);
            let reason = last.reason().to_owned();
            if start.elapsed() + retry_in > self.backoff.give_up {
                return Err(End::Failed(ClientError::Lost {
                    seconds: start.elapsed().as_secs_f64(),
                    last: reason,
                }));
            }
            self.pass_on(SessionEvent::ConnectionLost {
                reason,
                attempt,
                retry_in,
            })
            .await?;
            self.wait(Instant::now() + retry_in).await?;
            match self.open().await {
                Ok((connection, started)) => {
                    self.pass_on(SessionEvent::Reconnected).await?;
                    if let Some(presence) = started.presence {
                        self.pass_on(SessionEvent::Presence(presence)).await?;
                    }
                    return Ok(connection);
                }
                Err(end) if end.is_worth_retrying_again() => last = end,
                Err(end) => return Err(End::Broken(end)),
            }
        }
        Err(End::Broken(last))
    }

    /// Waits for the next attempt. Poses that are sent meanwhile would be stale.
    async fn wait(&mut self, until: Instant) -> Result<(), End> {
        loop {
            tokio::select! {
                () = sleep_until(until.into()) => return Ok(()),
                () = self.events.closed() => return Err(End::Abandoned),
                pose = self.poses.recv(), if self.role == TeleoperationRole::Operator => {
                    if pose.is_none() {
                        return Err(End::Finished);
                    }
                }
            }
        }
    }
}

fn broken_contract(what: &'static str) -> End {
    End::Failed(ClientError::Contract(what))
}

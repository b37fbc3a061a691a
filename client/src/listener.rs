//! The task behind an operator's or an observer's stream: it passes poses on and tells what the session tells, and carries
//! both over lost connections.

use std::time::Instant;

use emp_proto::v1::{
    TeleoperateRequest, TeleoperateResponse, TeleoperationStarted, teleoperate_response::Message,
};
use tokio::{sync::mpsc, time::sleep_until};
use tonic::{Status, transport::Channel};

use crate::{
    Backoff, ClientError, PoseSender, SessionEvent, SessionEvents, TeleoperationConfig,
    backoff::Break,
    connection::{self, Attempts, EVENTS, End, HAND_OVER},
    teleoperation::{self, Role},
    wire,
};

/// Joins a session and starts the stream's driver.
pub(crate) async fn start(
    channel: Channel,
    config: TeleoperationConfig,
    role: Role,
    backoff: Backoff,
) -> Result<(PoseSender, SessionEvents), ClientError> {
    let (frames, from_program) = mpsc::channel(HAND_OVER);
    let (to_program, events) = mpsc::channel(EVENTS);
    let mut listener = Listener {
        channel,
        config,
        role,
        backoff,
        frames: from_program,
        events: to_program,
    };
    let (connection, started) = listener.open().await?;
    listener
        .config
        .resume_token
        .clone_from(&started.resume_token);
    tokio::spawn(listener.run(connection));
    let sender = PoseSender {
        frames,
        next_number: 0,
    };
    Ok((sender, SessionEvents { started, events }))
}

/// One call.
type Connection = connection::Connection<TeleoperateRequest, TeleoperateResponse>;

struct Listener {
    channel: Channel,
    config: TeleoperationConfig,
    role: Role,
    backoff: Backoff,
    frames: mpsc::Receiver<TeleoperateRequest>,
    events: mpsc::Sender<Result<SessionEvent, ClientError>>,
}

impl Listener {
    async fn open(&self) -> Result<(Connection, TeleoperationStarted), Break> {
        let call = |requests| teleoperation::call(self.channel.clone(), requests);
        let started = |response: TeleoperateResponse| match response.message {
            Some(Message::Started(started)) => Some(started),
            _ => None,
        };
        connection::open(self.config.request(self.role), call, started).await
    }

    async fn run(mut self, mut connection: Connection) {
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

    async fn converse(&mut self, mut connection: Connection) -> End {
        let is_operator = self.role == Role::Operator;
        loop {
            let may_send = is_operator && connection.requests.is_some();
            let response = tokio::select! {
                () = self.events.closed() => return End::Abandoned,
                response = connection.responses.message() => response,
                pose = self.frames.recv(), if may_send => {
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
            let has_left = connection.requests.is_none();
            if let Err(end) = self.take(response, has_left).await {
                return end;
            }
        }
    }

    /// Takes a message and tells the program of it.
    async fn take(
        &self,
        response: Result<Option<TeleoperateResponse>, Status>,
        has_left: bool,
    ) -> Result<(), End> {
        let message = match response {
            Ok(Some(response)) => response.message,
            Ok(None) if has_left => return Err(End::Finished),
            Ok(None) => return Err(End::early()),
            Err(status) => return Err(End::Broken(status.into())),
        };
        let event = match message {
            Some(Message::Result(result)) => SessionEvent::Executed(Box::new(result)),
            Some(Message::Presence(presence)) => SessionEvent::Presence(presence),
            Some(Message::Dropped(dropped)) => SessionEvent::Dropped(wire::dropped(dropped)),
            Some(Message::GoingAway(notice)) => SessionEvent::GoingAway {
                grace: wire::duration(notice.grace),
            },
            Some(Message::Started(_)) => return Err(End::contract("a stream that starts twice")),
            None => return Err(End::Failed(ClientError::EMPTY_MESSAGE)),
        };
        self.tell(event).await
    }

    /// Hands an event to the program.
    async fn tell(&self, event: SessionEvent) -> Result<(), End> {
        let sent = self.events.send(Ok(event)).await;
        sent.map_err(|_| End::Abandoned)
    }

    /// Restores the connection, or says why it cannot be.
    async fn reconnect(&mut self, attempts: &mut Attempts) -> Result<Connection, End> {
        loop {
            let (reason, attempt, retry_in) = attempts.another()?;
            self.tell(SessionEvent::ConnectionLost {
                reason,
                attempt,
                retry_in,
            })
            .await?;
            self.wait(Instant::now() + retry_in).await?;
            match self.open().await {
                Ok((connection, started)) => {
                    self.config.resume_token = started.resume_token;
                    self.tell(SessionEvent::Reconnected).await?;
                    if let Some(presence) = started.presence {
                        self.tell(SessionEvent::Presence(presence)).await?;
                    }
                    return Ok(connection);
                }
                Err(why) => attempts.failed(why)?,
            }
        }
    }

    /// Waits for the next attempt. Poses that are sent meanwhile would be stale.
    async fn wait(&mut self, until: Instant) -> Result<(), End> {
        loop {
            tokio::select! {
                () = sleep_until(until.into()) => return Ok(()),
                () = self.events.closed() => return Err(End::Abandoned),
                pose = self.frames.recv(), if self.role == Role::Operator => {
                    if pose.is_none() {
                        return Err(End::Finished);
                    }
                }
            }
        }
    }
}

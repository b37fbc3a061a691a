//! A call that streams both ways: how it is opened, why it ends, and when to open the next in its place.

use std::{
    future::Future,
    time::{Duration, Instant},
};

use tokio::{sync::mpsc, time::timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::{Backoff, ClientError, backoff::Break};

/// Messages between the program and a stream's task, and between the task and the transport.
pub(crate) const HAND_OVER: usize = 4;
/// Events that wait for the program.
pub(crate) const EVENTS: usize = 256;
/// A connection that stood for this long was a good one.
const STEADY: Duration = Duration::from_secs(5);
/// How long a server may take to accept a stream.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);

/// One call.
pub(crate) struct Connection<Q, R> {
    /// None once half-closed.
    pub(crate) requests: Option<mpsc::Sender<Q>>,
    pub(crate) responses: Streaming<R>,
}

/// Opens a stream by `call` with its first message, and waits for the response that says that it has `started`.
pub(crate) async fn open<Q, R, S, F>(
    first: Q,
    call: impl FnOnce(ReceiverStream<Q>) -> F,
    started: impl FnOnce(R) -> Option<S>,
) -> Result<(Connection<Q, R>, S), Break>
where
    F: Future<Output = Result<Streaming<R>, Status>>,
{
    let (requests, outbound) = mpsc::channel(HAND_OVER);
    let opening = async {
        // The channel is new and has room.
        let _ = requests.send(first).await;
        let mut responses = call(ReceiverStream::new(outbound)).await?;
        let started = responses.message().await?.and_then(started);
        let started = started.ok_or(Break::Silence("the stream ended before it was accepted"))?;
        let connection = Connection {
            requests: Some(requests),
            responses,
        };
        Ok((connection, started))
    };
    let late = Break::Silence("the server did not accept the stream in time");
    timeout(OPEN_TIMEOUT, opening).await.unwrap_or(Err(late))
}

/// Why a connection's turn is over.
pub(crate) enum End {
    /// The program sends no more, and the server has said all.
    Finished,
    /// The program let go of its events.
    Abandoned,
    /// The connection or the server ended it.
    Broken(Break),
    /// The stream cannot go on.
    Failed(ClientError),
}

impl End {
    pub(crate) fn contract(what: &'static str) -> Self {
        Self::Failed(ClientError::Contract(what))
    }

    /// The server half-closed before all was said.
    pub(crate) fn early() -> Self {
        Self::Broken(Break::Silence("the server ended the stream early"))
    }

    /// What the program is told, if anything.
    pub(crate) fn error(self) -> Option<ClientError> {
        match self {
            Self::Finished | Self::Abandoned => None,
            Self::Broken(end) => Some(end.into()),
            Self::Failed(error) => Some(error),
        }
    }
}

/// Attempts to restore a connection.
pub(crate) struct Attempts {
    backoff: Backoff,
    start: Instant,
    number: u32,
    last: Break,
}

impl Attempts {
    /// Attempts after a connection that `stood` for a while broke. One that broke at once counts as another failed attempt of
    /// those `before` it: a server that accepts and fails is not asked for ever at the shortest pause.
    pub(crate) fn after(
        last: Break,
        backoff: Backoff,
        before: Option<Self>,
        stood: Duration,
    ) -> Self {
        match before {
            Some(before) if stood < STEADY => Self { last, ..before },
            _ => Self {
                backoff,
                start: Instant::now(),
                number: 0,
                last,
            },
        }
    }

    /// Why another attempt is due, its number from 1, and when it comes; unless it is time to give up.
    pub(crate) fn another(&mut self) -> Result<(String, u32, Duration), End> {
        self.number += 1;
        let retry_in = self.backoff.pause(self.number, &self.last);
        let reason = self.last.reason().to_owned();
        let elapsed = self.start.elapsed();
        if elapsed + retry_in > self.backoff.give_up {
            return Err(End::Failed(ClientError::Lost {
                seconds: elapsed.as_secs_f64(),
                last: reason,
            }));
        }
        Ok((reason, self.number, retry_in))
    }

    /// Remembers why an attempt failed, if another may succeed.
    pub(crate) fn failed(&mut self, why: Break) -> Result<(), End> {
        if !why.is_worth_retrying_again() {
            return Err(End::Broken(why));
        }
        self.last = why;
        Ok(())
    }
}

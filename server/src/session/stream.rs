//! Both ends of a stream as the server has them: what it reads with patience, what it sends with patience, and how it ends.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::{Duration, Instant},
};

use emp_proto::v1::GoingAway;
use tokio::{
    sync::{OwnedSemaphorePermit, mpsc, oneshot},
    time::timeout,
};
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};
use tracing::Instrument as _;

use crate::inference::due;
use crate::{
    catalog::Catalog,
    encode,
    error::{FieldError, ServiceError, task_failed},
};

/// Messages that wait for a slow reader: about a third of a second of control periods.
const OUTBOUND: usize = 16;
/// How long a client may take no message before its stream is given up.
const READ_PATIENCE: Duration = Duration::from_secs(30);
/// How much sooner than the server cuts streams off they are told of their end.
const LAST_WORDS: Duration = Duration::from_millis(100);

/// What a stream needs from the server.
#[derive(Clone)]
pub(crate) struct StreamContext {
    pub(crate) catalog: Arc<Catalog>,
    /// Most frames that wait in the stream.
    pub(crate) buffer: usize,
    /// How long the first message may take.
    pub(crate) config_timeout: Duration,
    /// How long every further one may take.
    pub(crate) idle_timeout: Duration,
    pub(crate) drain: Drain,
    /// When the call must have ended.
    pub(crate) deadline: Option<Instant>,
}

/// The server's end.
#[derive(Clone)]
pub(crate) struct Drain {
    /// Cancelled when the server shuts down.
    pub(crate) begun: CancellationToken,
    /// How long it serves on after that.
    pub(crate) grace: Duration,
}

impl Drain {
    pub(crate) fn has_begun(&self) -> bool {
        self.begun.is_cancelled()
    }

    /// Resolves when the grace time is over.
    pub(crate) async fn over(&self) {
        self.begun.cancelled().await;
        tokio::time::sleep(self.grace.saturating_sub(LAST_WORDS)).await;
    }

    /// What clients are told when it begins.
    pub(crate) fn notice(&self) -> GoingAway {
        GoingAway {
            grace: Some(encode::duration(self.grace)),
        }
    }
}

/// The client's messages.
pub(crate) struct Reader<T> {
    inbound: Streaming<T>,
    idle_timeout: Duration,
}

impl<T> Reader<T> {
    pub(crate) fn new(inbound: Streaming<T>, idle_timeout: Duration) -> Self {
        Self {
            inbound,
            idle_timeout,
        }
    }

    /// The next message; none after the half-close.
    pub(crate) async fn next(&mut self) -> Result<Option<T>, ServiceError> {
        match timeout(self.idle_timeout, self.inbound.message()).await {
            Ok(message) => message.map_err(ServiceError::Transport),
            Err(_) => Err(ServiceError::Silent("the client sent nothing for too long")),
        }
    }

    /// The config of a stream, which its first message holds.
    pub(crate) async fn config<C>(
        &mut self,
        context: &StreamContext,
        config_of: impl FnOnce(T) -> Option<C>,
    ) -> Result<C, ServiceError> {
        let message = tokio::select! {
            message = timeout(context.config_timeout, self.inbound.message()) => match message {
                Ok(message) => message.map_err(ServiceError::Transport)?,
                Err(_) => return Err(ServiceError::Silent("the client sent no config in time")),
            },
            () = context.drain.begun.cancelled() => return Err(ServiceError::ShuttingDown),
        };
        let config = message.and_then(config_of);
        config.ok_or_else(|| FieldError::missing_config().into())
    }
}

/// Sends messages to the client.
#[derive(Clone)]
pub(crate) struct Outbound<R>(mpsc::Sender<R>);

/// The client is gone, or does not read.
#[derive(Debug)]
pub(crate) struct Gone;

impl<R> Outbound<R> {
    pub(crate) async fn send(&self, message: R) -> Result<(), Gone> {
        match self.0.send_timeout(message, READ_PATIENCE).await {
            Ok(()) => Ok(()),
            Err(_) => Err(Gone),
        }
    }

    /// Waits for room.
    pub(crate) async fn reserve(&self) -> Result<mpsc::Permit<'_, R>, Gone> {
        match timeout(READ_PATIENCE, self.0.reserve()).await {
            Ok(Ok(permit)) => Ok(permit),
            _ => Err(Gone),
        }
    }
}

/// What a stream's client gets: its messages, then why it ended. It holds the stream's place until the transport has let go of it.
pub(crate) struct ResponseStream<R> {
    messages: mpsc::Receiver<R>,
    end: oneshot::Receiver<Result<(), Status>>,
    has_ended: bool,
    _place: Option<OwnedSemaphorePermit>,
}

/// Serves a stream on a task of its own: the response's headers go out at once, whatever the client sends first. A task that
/// panics ends its stream with INTERNAL.
pub(crate) fn serve<R: Send + 'static, S>(
    deadline: Option<Instant>,
    place: Option<OwnedSemaphorePermit>,
    conversation: impl FnOnce(Outbound<R>) -> S,
) -> ResponseStream<R>
where
    S: Future<Output = Result<(), ServiceError>> + Send + 'static,
{
    let (sender, messages) = mpsc::channel(OUTBOUND);
    let (finish, end) = oneshot::channel();
    let conversation = conversation(Outbound(sender.clone()));
    let task = async move {
        let ended = tokio::select! {
            ended = conversation => ended,
            () = due::passed(deadline) => Err(ServiceError::DeadlineExceeded),
            () = sender.closed() => return tracing::info!("the client left its stream"),
        };
        match &ended {
            Ok(()) => tracing::info!("stream ended"),
            Err(error) => tracing::info!(%error, "stream ended early"),
        }
        // The client may be gone; then nobody waits for the reason.
        let _ = finish.send(ended.map_err(Status::from));
    };
    tokio::spawn(task.in_current_span());
    ResponseStream {
        messages,
        end,
        has_ended: false,
        _place: place,
    }
}

impl<R> Stream for ResponseStream<R> {
    type Item = Result<R, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.has_ended {
            return Poll::Ready(None);
        }
        if let Some(message) = ready!(self.messages.poll_recv(context)) {
            return Poll::Ready(Some(Ok(message)));
        }
        let end = ready!(Pin::new(&mut self.end).poll(context));
        self.has_ended = true;
        // Without a word the task panicked.
        Poll::Ready(match end.unwrap_or_else(|_| Err(task_failed())) {
            Ok(()) => None,
            Err(status) => Some(Err(status)),
        })
    }
}

#[cfg(test)]
mod tests {
    use tokio_stream::StreamExt as _;
    use tonic::Code;

    use super::*;

    #[tokio::test]
    async fn a_task_that_panics_ends_its_stream_with_internal() {
        let mut stream = serve(None, None, async |outbound: Outbound<u32>| {
            assert!(outbound.send(1).await.is_ok());
            panic!("told to")
        });
        assert_eq!(stream.next().await.expect("a message").expect("sent"), 1);
        let status = stream.next().await.expect("an end").expect_err("failed");
        assert_eq!(status.code(), Code::Internal);
        assert!(stream.next().await.is_none());
    }
}

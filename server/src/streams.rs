//! What the services with streams share: how many there may be, how long they may be silent, and how one is opened.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Streaming};

use crate::decode::deadline;
use crate::{
    catalog::Catalog,
    error::ServiceError,
    session::{Drain, Outbound, Reader, ResponseStream, StreamContext, serve},
    settings::Settings,
};

/// When to ask again for a stream; streams are long.
const STREAM_RETRY: Duration = Duration::from_secs(1);

/// Who a stream's place is for. Robots have places of their own: nobody who only looks on keeps one out.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Place {
    Robot,
    Other,
}

/// The server's streams.
pub(crate) struct Streams {
    catalog: Arc<Catalog>,
    robots: Arc<Semaphore>,
    others: Arc<Semaphore>,
    buffer: usize,
    config_timeout: Duration,
    idle_timeout: Duration,
    drain: Drain,
}

impl Streams {
    pub(crate) fn new(
        catalog: Arc<Catalog>,
        settings: &Settings,
        shutdown: CancellationToken,
    ) -> Self {
        let streams = &settings.streams;
        let places = |most: usize| Arc::new(Semaphore::new(most.min(Semaphore::MAX_PERMITS)));
        let seconds = |seconds| Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
        Self {
            catalog,
            robots: places(streams.max_robots.get()),
            others: places(streams.max_open.get()),
            buffer: streams.buffer.get(),
            config_timeout: seconds(streams.config_seconds),
            idle_timeout: seconds(streams.idle_seconds),
            drain: Drain {
                begun: shutdown,
                grace: settings.grace(),
            },
        }
    }

    pub(crate) fn drain(&self) -> &Drain {
        &self.drain
    }

    /// A place for a stream, if one is free.
    pub(crate) fn enter(&self, place: Place) -> Result<OwnedSemaphorePermit, ServiceError> {
        let (places, what) = match place {
            Place::Robot => (&self.robots, "there is no room for another robot"),
            Place::Other => (&self.others, "there is no room for another stream"),
        };
        let permit = Arc::clone(places).try_acquire_owned();
        permit.map_err(|_| ServiceError::Overloaded {
            what,
            retry: STREAM_RETRY,
        })
    }

    /// What a call's stream needs from the server.
    pub(crate) fn context<T>(&self, request: &Request<T>) -> Result<StreamContext, ServiceError> {
        if self.drain.has_begun() {
            return Err(ServiceError::ShuttingDown);
        }
        Ok(StreamContext {
            catalog: Arc::clone(&self.catalog),
            buffer: self.buffer,
            config_timeout: self.config_timeout,
            idle_timeout: self.idle_timeout,
            drain: self.drain.clone(),
            deadline: deadline::of_call(request.metadata(), Instant::now())?,
        })
    }

    /// Serves a stream on a task of its own.
    pub(crate) fn open<Q, R: Send + 'static, S>(
        &self,
        request: Request<Streaming<Q>>,
        place: Option<OwnedSemaphorePermit>,
        conversation: impl FnOnce(StreamContext, Reader<Q>, Outbound<R>) -> S,
    ) -> Result<ResponseStream<R>, ServiceError>
    where
        S: Future<Output = Result<(), ServiceError>> + Send + 'static,
    {
        let context = self.context(&request)?;
        let inbound = Reader::new(request.into_inner(), context.idle_timeout);
        Ok(serve(context.deadline, place, |outbound| {
            conversation(context, inbound, outbound)
        }))
    }
}

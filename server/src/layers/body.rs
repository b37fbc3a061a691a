//! The two bodies of a call, watched: what is read counts against the caller's rate, a single request has to arrive in time, and
//! a stream ends with its caller's credentials.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use axum::body::Body;
use bytes::Bytes;
use http::HeaderMap;
use http_body::{Body as HttpBody, Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};
use tonic::{Code, Status};

use super::open::Open;
use crate::{
    error::ServiceError,
    identity::{Identity, methods::Kind},
};

/// How long the request of a single call may take to arrive.
const REQUEST_TIME: Duration = Duration::from_secs(20);

/// What the client sends.
pub(super) struct Inbound {
    body: Body,
    identity: Arc<Identity>,
    /// Until when nothing more is read, if the caller was too fast.
    pause: Option<Pin<Box<Sleep>>>,
    /// When the whole body must have arrived.
    limit: Option<Pin<Box<Sleep>>>,
}

impl Inbound {
    pub(super) fn new(body: Body, open: &Open) -> Self {
        let limit = || Box::pin(sleep_until(Instant::now() + REQUEST_TIME));
        Self {
            body,
            identity: Arc::clone(&open.caller.identity),
            pause: None,
            limit: (open.method.kind == Kind::Call).then(limit),
        }
    }
}

impl HttpBody for Inbound {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = &mut *self;
        if let Some(limit) = &mut this.limit
            && limit.as_mut().poll(context).is_ready()
        {
            let late = std::io::Error::from(std::io::ErrorKind::TimedOut);
            return Poll::Ready(Some(Err(axum::Error::new(late))));
        }
        if let Some(pause) = &mut this.pause {
            ready!(pause.as_mut().poll(context));
            this.pause = None;
        }
        let frame = ready!(Pin::new(&mut this.body).poll_frame(context));
        if let Some(Ok(frame)) = &frame
            && let Some(data) = frame.data_ref()
        {
            let wait = this.identity.read(data.len());
            if !wait.is_zero() {
                this.pause = Some(Box::pin(sleep_until(Instant::now() + wait)));
            }
        }
        if frame.is_none() {
            this.limit = None;
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

type Ended = Pin<Box<dyn Future<Output = ServiceError> + Send>>;

/// What the client is sent. The call's place is free again when this is dropped.
pub(super) struct Outbound {
    /// None once the credentials ended.
    body: Option<Body>,
    open: Arc<Open>,
    /// Resolves when the credentials end; for streams.
    ended: Option<Ended>,
    /// How the call ended, once that is known.
    code: Option<Code>,
}

impl Outbound {
    pub(super) fn new(body: Body, open: Arc<Open>, headers: &HeaderMap) -> Self {
        let identity = Arc::clone(&open.caller.identity);
        let ended = || -> Ended { Box::pin(async move { identity.ended().await }) };
        Self {
            body: Some(body),
            ended: (open.method.kind != Kind::Call).then(ended),
            open,
            code: code_of(headers),
        }
    }
}

impl HttpBody for Outbound {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = &mut *self;
        let Some(body) = &mut this.body else {
            return Poll::Ready(None);
        };
        if let Some(ended) = &mut this.ended
            && let Poll::Ready(error) = ended.as_mut().poll(context)
        {
            tracing::info!(%error, "stream ended");
            // Dropping the body cancels what makes it.
            this.body = None;
            let status = Status::from(error);
            this.code = Some(status.code());
            let trailers = status.into_http::<()>().into_parts().0.headers;
            return Poll::Ready(Some(Ok(Frame::trailers(trailers))));
        }
        let frame = ready!(Pin::new(body).poll_frame(context));
        if let Some(Ok(frame)) = &frame
            && let Some(trailers) = frame.trailers_ref()
        {
            this.code = code_of(trailers).or(this.code);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.as_ref().is_none_or(HttpBody::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::default()
    }
}

impl Drop for Outbound {
    fn drop(&mut self) {
        // Without a status the client left before the end.
        let code = self.code.unwrap_or(Code::Cancelled);
        self.open.end(name(code));
    }
}

fn code_of(headers: &HeaderMap) -> Option<Code> {
    Status::from_header_map(headers).map(|status| status.code())
}

fn name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

//! `RolloutService`: evaluations and rollouts for learners, as jobs on threads of their own.

mod blocks;
mod collect;
mod evaluate;
mod job;
mod motion;
mod read;
mod scores;

use std::{sync::Arc, time::Instant};

use emp_proto::v1::{
    CollectRolloutsRequest, CollectRolloutsResponse, EvaluateRequest, EvaluateResponse,
    rollout_service_server::RolloutService,
};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming, metadata::MetadataMap};
use tracing::Instrument as _;

use self::job::{Jobs, Line};
use crate::{
    catalog::Catalog, deadline, error::ServiceError, identity::Caller, settings::RolloutSettings,
};

/// The service.
pub(crate) struct Rollouts {
    context: RolloutContext,
    drain: CancellationToken,
}

/// What a call needs from the server.
#[derive(Clone)]
struct RolloutContext {
    catalog: Arc<Catalog>,
    jobs: Arc<Jobs>,
    /// Most frames of motion that a call may send.
    max_frames: usize,
    caller: Caller,
}

impl RolloutContext {
    fn called_by<T>(&self, request: &Request<T>) -> Self {
        Self {
            caller: Caller::of(request.extensions()),
            ..self.clone()
        }
    }

    fn budget(&self, robot: &emp_robot::Robot) -> read::Budget {
        read::Budget::new(self.max_frames, robot.control_rate_hz())
    }
}

type Answers<T> = ReceiverStream<Result<T, Status>>;

impl Rollouts {
    pub(crate) fn new(
        catalog: Arc<Catalog>,
        settings: &RolloutSettings,
        drain: CancellationToken,
    ) -> Self {
        let context = RolloutContext {
            catalog,
            jobs: Arc::new(Jobs::new(settings)),
            max_frames: settings.max_frames.get(),
            caller: Caller::nobody(),
        };
        Self { context, drain }
    }

    fn open<T: Send + 'static>(
        &self,
        metadata: &MetadataMap,
    ) -> Result<(Line<T>, Answers<T>), ServiceError> {
        if self.drain.is_cancelled() {
            return Err(ServiceError::ShuttingDown);
        }
        let deadline = deadline::of_call(metadata, Instant::now())?;
        let (line, answers) = Line::new(self.drain.clone(), deadline);
        Ok((line, ReceiverStream::new(answers)))
    }
}

#[tonic::async_trait]
impl RolloutService for Rollouts {
    type EvaluateStream = Answers<EvaluateResponse>;

    async fn evaluate(
        &self,
        request: Request<Streaming<EvaluateRequest>>,
    ) -> Result<Response<Answers<EvaluateResponse>>, Status> {
        let (line, answers) = self.open(request.metadata())?;
        let context = self.context.called_by(&request);
        let call = evaluate::run(context, request.into_inner(), line);
        tokio::spawn(call.in_current_span());
        Ok(Response::new(answers))
    }

    type CollectRolloutsStream = Answers<CollectRolloutsResponse>;

    async fn collect_rollouts(
        &self,
        request: Request<Streaming<CollectRolloutsRequest>>,
    ) -> Result<Response<Answers<CollectRolloutsResponse>>, Status> {
        let (line, answers) = self.open(request.metadata())?;
        let context = self.context.called_by(&request);
        let call = collect::run(context, request.into_inner(), line);
        tokio::spawn(call.in_current_span());
        Ok(Response::new(answers))
    }
}

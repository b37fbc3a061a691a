//! `RolloutService`: what each call does, on top of the jobs.

use std::{sync::Arc, time::Instant};

use emp_proto::v1::{
    CancelJobRequest, CancelJobResponse, CollectRolloutsRequest, CollectRolloutsResponse,
    ListControllersRequest, ListControllersResponse, ListJobsRequest, ListJobsResponse,
    StartEvaluationRequest, StartEvaluationResponse, WatchEvaluationRequest,
    WatchEvaluationResponse, rollout_service_server::RolloutService,
};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};
use tracing::Instrument as _;

use crate::decode::deadline;
use crate::inference::due;
use crate::{
    catalog::Catalog,
    error::ServiceError,
    rollouts::{self, JobStream, RolloutContext, controllers, evaluate},
    session::{ResponseStream, serve},
    settings::Settings,
};

/// The service.
pub(crate) struct Rollouts {
    context: RolloutContext,
    drain: CancellationToken,
}

impl Rollouts {
    pub(crate) fn new(
        catalog: Arc<Catalog>,
        settings: &Settings,
        drain: CancellationToken,
    ) -> Self {
        Self {
            context: RolloutContext::new(catalog, settings, drain.clone()),
            drain,
        }
    }

    fn check_open(&self) -> Result<(), ServiceError> {
        match self.drain.is_cancelled() {
            true => Err(ServiceError::ShuttingDown),
            false => Ok(()),
        }
    }
}

#[tonic::async_trait]
impl RolloutService for Rollouts {
    async fn list_controllers(
        &self,
        request: Request<ListControllersRequest>,
    ) -> Result<Response<ListControllersResponse>, Status> {
        let robot = &request.get_ref().robot;
        let controllers = controllers::list(&self.context.catalog, robot)?;
        Ok(Response::new(ListControllersResponse { controllers }))
    }

    async fn start_evaluation(
        &self,
        request: Request<Streaming<StartEvaluationRequest>>,
    ) -> Result<Response<StartEvaluationResponse>, Status> {
        self.check_open()?;
        let deadline =
            deadline::of_call(request.metadata(), Instant::now()).map_err(ServiceError::from)?;
        let starting = evaluate::start(self.context.clone(), request.into_inner());
        let job = tokio::select! {
            job = starting.in_current_span() => job?,
            () = due::passed(deadline) => return Err(ServiceError::DeadlineExceeded.into()),
            () = self.drain.cancelled() => return Err(ServiceError::ShuttingDown.into()),
        };
        Ok(Response::new(StartEvaluationResponse { job }))
    }

    type WatchEvaluationStream = ResponseStream<WatchEvaluationResponse>;

    async fn watch_evaluation(
        &self,
        request: Request<WatchEvaluationRequest>,
    ) -> Result<Response<Self::WatchEvaluationStream>, Status> {
        let deadline =
            deadline::of_call(request.metadata(), Instant::now()).map_err(ServiceError::from)?;
        let WatchEvaluationRequest { job, first_event } = request.into_inner();
        let job = self.context.jobs.evaluation(&job)?;
        let watcher = self.context.enter_watch()?;
        let stream = serve(deadline, Some(watcher), move |outbound| {
            rollouts::watch(job, first_event, outbound)
        });
        Ok(Response::new(stream))
    }

    async fn list_jobs(
        &self,
        _: Request<ListJobsRequest>,
    ) -> Result<Response<ListJobsResponse>, Status> {
        let jobs = self.context.jobs.list();
        Ok(Response::new(ListJobsResponse { jobs }))
    }

    async fn cancel_job(
        &self,
        request: Request<CancelJobRequest>,
    ) -> Result<Response<CancelJobResponse>, Status> {
        self.context.jobs.cancel(&request.get_ref().id)?;
        Ok(Response::new(CancelJobResponse {}))
    }

    type CollectRolloutsStream = ReceiverStream<Result<CollectRolloutsResponse, Status>>;

    async fn collect_rollouts(
        &self,
        request: Request<Streaming<CollectRolloutsRequest>>,
    ) -> Result<Response<Self::CollectRolloutsStream>, Status> {
        self.check_open()?;
        let deadline =
            deadline::of_call(request.metadata(), Instant::now()).map_err(ServiceError::from)?;
        let (line, answers) = JobStream::new(self.drain.clone(), deadline);
        let call = rollouts::collect::run(self.context.clone(), request.into_inner(), line);
        tokio::spawn(call.in_current_span());
        Ok(Response::new(ReceiverStream::new(answers)))
    }
}

//! The services of `emp.v1`: what each call does, on top of the catalog and the sessions.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use emp_models::retarget::RetargetInput;
use emp_proto::v1::{
    GetModelRequest, GetModelResponse, GetRobotRequest, GetRobotResponse, ListModelsRequest,
    ListModelsResponse, RetargetRequest, RetargetResponse, StreamRetargetRequest,
    model_service_server::ModelService, motion_service_server::MotionService,
};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};
use tracing::Instrument as _;

use crate::{
    catalog::Catalog,
    deadline,
    error::ServiceError,
    pose,
    queue::Priority,
    session::{self, SessionContext},
    settings::StreamSettings,
    wire,
};

/// Answers that wait for a slow reader before its session stops.
const OUTBOUND: usize = 16;
/// When to ask again for a stream; streams are long.
const STREAM_RETRY: Duration = Duration::from_secs(1);

/// Retargeting, one pose or a stream of them.
pub(crate) struct Motion {
    catalog: Arc<Catalog>,
    drain: CancellationToken,
    places: Arc<Semaphore>,
    buffer: usize,
}

impl Motion {
    pub(crate) fn new(
        catalog: Arc<Catalog>,
        streams: &StreamSettings,
        drain: CancellationToken,
    ) -> Self {
        let places = streams.max_open.get().min(Semaphore::MAX_PERMITS);
        Self {
            catalog,
            drain,
            places: Arc::new(Semaphore::new(places)),
            buffer: streams.buffer.get(),
        }
    }

    async fn retarget_one(
        &self,
        request: Request<RetargetRequest>,
    ) -> Result<RetargetResponse, ServiceError> {
        let received = Instant::now();
        let call_deadline = deadline::of_call(request.metadata(), received)?;
        let RetargetRequest {
            header,
            robot,
            model,
            model_version,
            refine,
            pose,
        } = request.into_inner();
        let model = self
            .catalog
            .retargeter_for(&robot, &model, &model_version)?;
        let frame = pose::read(pose.as_ref())?;
        let deadline = deadline::sooner(
            call_deadline,
            deadline::of_frame(header.as_ref(), received)?,
        );
        if deadline::has_passed(deadline) {
            return Err(ServiceError::DeadlineExceeded);
        }
        let input = RetargetInput {
            frame,
            refine,
            previous: None,
        };
        let ticket = model.batcher.submit(Priority::Unary, input, deadline)?;
        let answer = tokio::select! {
            outcome = ticket => outcome?,
            () = deadline::passed(deadline) => return Err(ServiceError::DeadlineExceeded),
        };
        if deadline::has_passed(deadline) {
            return Err(ServiceError::DeadlineExceeded);
        }
        let timing = wire::timing(&answer);
        let result = wire::retarget_result(
            &model.robot,
            answer.output.angles,
            answer.output.direction_error,
        );
        Ok(RetargetResponse {
            header,
            result: Some(result),
            timing: Some(timing),
        })
    }

    fn open_session(
        &self,
        request: Request<Streaming<StreamRetargetRequest>>,
    ) -> Result<SessionStream, ServiceError> {
        if self.drain.is_cancelled() {
            return Err(ServiceError::ShuttingDown);
        }
        let deadline = deadline::of_call(request.metadata(), Instant::now())?;
        let permit =
            Arc::clone(&self.places)
                .try_acquire_owned()
                .map_err(|_| ServiceError::Overloaded {
                    what: "there is no room for another stream",
                    retry: STREAM_RETRY,
                })?;
        let (sender, responses) = mpsc::channel(OUTBOUND);
        let context = SessionContext {
            catalog: Arc::clone(&self.catalog),
            buffer: self.buffer,
            drain: self.drain.clone(),
            deadline,
        };
        // The session has a task of its own: the response's headers go out at once, whatever the client sends first.
        tokio::spawn(session::run(context, request.into_inner(), sender).in_current_span());
        Ok(SessionStream {
            responses,
            _permit: permit,
        })
    }
}

/// A session's answers. It holds the stream's place until the transport has let go of it.
pub(crate) struct SessionStream {
    responses: mpsc::Receiver<session::Response>,
    _permit: OwnedSemaphorePermit,
}

impl Stream for SessionStream {
    type Item = session::Response;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.responses.poll_recv(context)
    }
}

#[tonic::async_trait]
impl MotionService for Motion {
    async fn retarget(
        &self,
        request: Request<RetargetRequest>,
    ) -> Result<Response<RetargetResponse>, Status> {
        Ok(Response::new(self.retarget_one(request).await?))
    }

    type StreamRetargetStream = SessionStream;

    async fn stream_retarget(
        &self,
        request: Request<Streaming<StreamRetargetRequest>>,
    ) -> Result<Response<SessionStream>, Status> {
        Ok(Response::new(self.open_session(request)?))
    }
}

/// What is served.
pub(crate) struct Models {
    catalog: Arc<Catalog>,
}

impl Models {
    pub(crate) fn new(catalog: Arc<Catalog>) -> Self {
        Self { catalog }
    }
}

#[tonic::async_trait]
impl ModelService for Models {
    async fn list_models(
        &self,
        _: Request<ListModelsRequest>,
    ) -> Result<Response<ListModelsResponse>, Status> {
        let models = self
            .catalog
            .retargeters()
            .map(|model| model.card.clone())
            .collect();
        Ok(Response::new(ListModelsResponse { models }))
    }

    async fn get_model(
        &self,
        request: Request<GetModelRequest>,
    ) -> Result<Response<GetModelResponse>, Status> {
        let model = self.catalog.model(&request.get_ref().name)?.clone();
        Ok(Response::new(GetModelResponse { model: Some(model) }))
    }

    async fn get_robot(
        &self,
        request: Request<GetRobotRequest>,
    ) -> Result<Response<GetRobotResponse>, Status> {
        let robot = wire::robot(self.catalog.robot(&request.get_ref().name)?);
        Ok(Response::new(GetRobotResponse { robot: Some(robot) }))
    }
}

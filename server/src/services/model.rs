//! `ModelService`: what is served, and loading it anew.

use std::{sync::Arc, time::Instant};

use emp_proto::v1::{
    GetModelRequest, GetModelResponse, GetRobotRequest, GetRobotResponse, GetServerInfoRequest,
    GetServerInfoResponse, GuardTimes, ListModelsRequest, ListModelsResponse, ListRobotsRequest,
    ListRobotsResponse, ModelKind, ReloadRequest, ReloadResponse, ServerLimits,
    model_service_server::ModelService,
};
use tonic::{Request, Response, Status};

use super::{MAX_JOB_MESSAGE, MAX_MESSAGE};
use crate::{
    catalog::Catalog,
    encode,
    error::{FieldError, ServiceError},
    session::Drain,
    settings::Settings,
};

/// What is served.
pub(crate) struct Models {
    catalog: Arc<Catalog>,
    limits: ServerLimits,
    guard_times: GuardTimes,
    drain: Drain,
    since: Instant,
}

impl Models {
    pub(crate) fn new(catalog: Arc<Catalog>, settings: &Settings, drain: Drain) -> Self {
        let guard = settings.teleoperation.guard();
        Self {
            catalog,
            limits: ServerLimits {
                max_batch: encode::count(settings.batching.max_batch.get()),
                queue: encode::count(settings.batching.queue.get()),
                max_streams: encode::count(settings.streams.max_open.get()),
                max_robots: encode::count(settings.streams.max_robots.get()),
                max_jobs: encode::count(settings.rollouts.max_jobs.get()),
                max_frames: settings.rollouts.max_frames.get() as u64,
                max_message_bytes: MAX_MESSAGE as u64,
                max_job_message_bytes: MAX_JOB_MESSAGE as u64,
            },
            guard_times: GuardTimes {
                ramp: Some(encode::duration(guard.ramp)),
                stale_after: Some(encode::duration(guard.stale_after)),
                return_after: Some(encode::duration(guard.return_after)),
            },
            drain,
            since: Instant::now(),
        }
    }
}

#[tonic::async_trait]
impl ModelService for Models {
    async fn get_server_info(
        &self,
        _: Request<GetServerInfoRequest>,
    ) -> Result<Response<GetServerInfoResponse>, Status> {
        Ok(Response::new(GetServerInfoResponse {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            up_time: Some(encode::duration(self.since.elapsed())),
            shutting_down: self.drain.has_begun(),
            limits: Some(self.limits),
            guard_times: Some(self.guard_times),
        }))
    }

    async fn list_models(
        &self,
        request: Request<ListModelsRequest>,
    ) -> Result<Response<ListModelsResponse>, Status> {
        let ListModelsRequest { robot, kind } = request.into_inner();
        ModelKind::try_from(kind)
            .map_err(|_| ServiceError::from(FieldError::not_in("ModelKind", "kind", kind)))?;
        let mut models = self.catalog.cards();
        models.retain(|model| robot.is_empty() || model.robot == robot);
        models.retain(|model| kind == 0 || model.kind == kind);
        Ok(Response::new(ListModelsResponse { models }))
    }

    async fn get_model(
        &self,
        request: Request<GetModelRequest>,
    ) -> Result<Response<GetModelResponse>, Status> {
        let model = self.catalog.model(&request.get_ref().name)?;
        Ok(Response::new(GetModelResponse { model: Some(model) }))
    }

    async fn list_robots(
        &self,
        _: Request<ListRobotsRequest>,
    ) -> Result<Response<ListRobotsResponse>, Status> {
        let robots = self.catalog.robots();
        Ok(Response::new(ListRobotsResponse { robots }))
    }

    async fn get_robot(
        &self,
        request: Request<GetRobotRequest>,
    ) -> Result<Response<GetRobotResponse>, Status> {
        let robot = encode::robot(&*self.catalog.robot(&request.get_ref().name)?);
        Ok(Response::new(GetRobotResponse { robot: Some(robot) }))
    }

    async fn reload(
        &self,
        request: Request<ReloadRequest>,
    ) -> Result<Response<ReloadResponse>, Status> {
        let catalog = Arc::clone(&self.catalog);
        let robot = request.into_inner().robot;
        let loading = tokio::task::spawn_blocking(move || catalog.reload(&robot));
        let models = match loading.await {
            Ok(models) => models?,
            Err(error) => return Err(ServiceError::JobFailed(error.to_string()).into()),
        };
        Ok(Response::new(ReloadResponse { models }))
    }
}

//! `TeleoperationService`: what each call does, on top of the sessions.

use std::sync::Arc;

use emp_proto::v1::{
    ControlRequest, ControlResponse, EndSessionRequest, EndSessionResponse, GetSessionRequest,
    GetSessionResponse, ListSessionsRequest, ListSessionsResponse, ObserveRequest, ObserveResponse,
    TeleoperateRequest, TeleoperateResponse, teleoperation_service_server::TeleoperationService,
};
use tokio::sync::Semaphore;
use tonic::{Request, Response, Status, Streaming};

use crate::{
    catalog::Catalog,
    decode::robot_state,
    error::ServiceError,
    session::{self, ResponseStream},
    settings::Settings,
    streams::{Place, Streams},
    teleoperation::{self, Sessions, TeleoperationContext},
};

/// Sessions of people and robots.
pub(crate) struct Teleoperation {
    catalog: Arc<Catalog>,
    context: TeleoperationContext,
    /// Streams that have not said yet which end they hold.
    unknown: Arc<Semaphore>,
}

impl Teleoperation {
    pub(crate) fn new(catalog: Arc<Catalog>, settings: &Settings, streams: Arc<Streams>) -> Self {
        let most = settings.streams.max_open.get() + settings.streams.max_robots.get();
        Self {
            catalog,
            context: TeleoperationContext {
                sessions: Arc::new(Sessions::new(settings.streams.buffer.get())),
                guard: settings.teleoperation.guard(),
                streams,
            },
            unknown: Arc::new(Semaphore::new(most.min(Semaphore::MAX_PERMITS))),
        }
    }

    fn sessions(&self) -> &Sessions {
        &self.context.sessions
    }
}

#[tonic::async_trait]
impl TeleoperationService for Teleoperation {
    type TeleoperateStream = ResponseStream<TeleoperateResponse>;

    async fn teleoperate(
        &self,
        request: Request<Streaming<TeleoperateRequest>>,
    ) -> Result<Response<Self::TeleoperateStream>, Status> {
        let context = self.context.clone();
        let place = Arc::clone(&self.unknown).try_acquire_owned();
        let place = place.map_err(|_| ServiceError::Overloaded {
            what: "there is no room for another stream",
            retry: std::time::Duration::from_secs(1),
        })?;
        let serve =
            |stream, inbound, outbound| teleoperation::run(stream, context, inbound, outbound);
        let stream = self.context.streams.open(request, Some(place), serve)?;
        Ok(Response::new(stream))
    }

    type ObserveStream = ResponseStream<ObserveResponse>;

    async fn observe(
        &self,
        request: Request<ObserveRequest>,
    ) -> Result<Response<Self::ObserveStream>, Status> {
        let place = self.context.streams.enter(Place::Other)?;
        let stream = self.context.streams.context(&request)?;
        let (context, request) = (self.context.clone(), request.into_inner());
        let serve = |outbound| teleoperation::observe(stream.clone(), context, request, outbound);
        let stream = session::serve(stream.deadline, Some(place), serve);
        Ok(Response::new(stream))
    }

    async fn control(
        &self,
        request: Request<ControlRequest>,
    ) -> Result<Response<ControlResponse>, Status> {
        let request = request.into_inner();
        let mode = |robot: &str| {
            let has_emp = self
                .catalog
                .policy_for(robot, "", "")?
                .model
                .emp()
                .is_some();
            let read = |mode| robot_state::read_mode("emp_mode", mode, has_emp);
            Ok(request.emp_mode.map(read).transpose()?)
        };
        Ok(Response::new(self.sessions().control(&request, mode)?))
    }

    async fn list_sessions(
        &self,
        request: Request<ListSessionsRequest>,
    ) -> Result<Response<ListSessionsResponse>, Status> {
        let sessions = self.sessions().list(&request.get_ref().robot);
        Ok(Response::new(ListSessionsResponse { sessions }))
    }

    async fn get_session(
        &self,
        request: Request<GetSessionRequest>,
    ) -> Result<Response<GetSessionResponse>, Status> {
        let session = Some(self.sessions().get(&request.get_ref().name)?);
        Ok(Response::new(GetSessionResponse { session }))
    }

    async fn end_session(
        &self,
        request: Request<EndSessionRequest>,
    ) -> Result<Response<EndSessionResponse>, Status> {
        self.sessions().end(&request.get_ref().name)?;
        Ok(Response::new(EndSessionResponse {}))
    }
}

//! A connection and its single calls.

use std::time::{Duration, Instant};

use emp_motion::{Clip, KeyNodeFrame};
use emp_proto::v1::{
    CancelJobRequest, CollectRolloutsConfig, ControlRequest, ControlResponse,
    ControllerDescription, EndSessionRequest, EvaluationConfig, FilterGoalRequest, GetModelRequest,
    GetRobotRequest, GetServerInfoRequest, GetServerInfoResponse, GetSessionRequest, GoalClip, Job,
    ListControllersRequest, ListJobsRequest, ListModelsRequest, ListRobotsRequest,
    ListSessionsRequest, Model, ReloadRequest, ReloadedModel, RetargetRequest, Robot, RobotSummary,
    Session, model_service_client::ModelServiceClient, motion_service_client::MotionServiceClient,
    rollout_service_client::RolloutServiceClient,
    teleoperation_service_client::TeleoperationServiceClient,
};
use tonic::transport::{Channel, Endpoint};

use crate::{
    Answer, Backoff, ClientError, Collection, Evaluation, FilterAnswer, FilterConfig, FrameSender,
    GoalFrame, GoalHistory, PolicyAnswer, PolicyConfig, PoseSender, RobotFrame, SessionEvents,
    StreamConfig, StreamEvents, TeleoperationAnswer, TeleoperationConfig, TeleoperationFrame,
    driver, listener,
    teleoperation::{RobotEnd, Role},
    wire,
};

/// Both ends of a stream with a robot at its end.
type TeleoperationStream = (
    FrameSender<TeleoperationFrame>,
    StreamEvents<TeleoperationAnswer>,
);

/// How long a connection may take to stand.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// A silent connection is asked after this long, and given up when it does not answer in time.
const KEEPALIVE: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(5)];

/// A client of one server. Cheap to clone; clones share the connection, which comes back by itself.
#[derive(Debug, Clone)]
pub struct Client {
    channel: Channel,
    backoff: Backoff,
}

impl Client {
    /// Connects to a server, for example `http://127.0.0.1:50051`.
    ///
    /// # Errors
    /// When the URL is none or nothing answers there.
    pub async fn connect(url: &str) -> Result<Self, ClientError> {
        let failed = |error: tonic::transport::Error| ClientError::Connect {
            url: url.to_owned(),
            reason: root_cause(&error),
        };
        let endpoint = Endpoint::from_shared(url.to_owned())
            .map_err(failed)?
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(KEEPALIVE[0])
            .keep_alive_timeout(KEEPALIVE[1])
            .keep_alive_while_idle(true);
        let channel = endpoint.connect().await.map_err(failed)?;
        Ok(Self {
            channel,
            backoff: Backoff::default(),
        })
    }

    /// The same client with other pauses between attempts to restore a stream's connection.
    #[must_use]
    pub fn with_backoff(self, backoff: Backoff) -> Self {
        Self { backoff, ..self }
    }

    /// Every model that the server has.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn models(&self) -> Result<Vec<Model>, ClientError> {
        let mut service = self.model_service();
        let response = service.list_models(ListModelsRequest::default()).await?;
        Ok(response.into_inner().models)
    }

    /// One model.
    ///
    /// # Errors
    /// When the call fails, with `NOT_FOUND` for an unknown name.
    pub async fn model(&self, name: &str) -> Result<Model, ClientError> {
        let name = name.to_owned();
        let mut service = self.model_service();
        let response = service.get_model(GetModelRequest { name }).await?;
        let model = response.into_inner().model;
        model.ok_or(ClientError::Contract("GetModel without a model"))
    }

    /// What the server is: its version, limits and guard times.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn server_info(&self) -> Result<GetServerInfoResponse, ClientError> {
        let mut service = self.model_service();
        let response = service.get_server_info(GetServerInfoRequest {}).await?;
        Ok(response.into_inner())
    }

    /// Every robot that the server has, those that it cannot serve too.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn robots(&self) -> Result<Vec<RobotSummary>, ClientError> {
        let mut service = self.model_service();
        let response = service.list_robots(ListRobotsRequest {}).await?;
        Ok(response.into_inner().robots)
    }

    /// Has the weights of a robot loaded anew, or of every robot where `robot` is empty.
    ///
    /// # Errors
    /// When the call fails. What became of each model, the answer says.
    pub async fn reload(&self, robot: &str) -> Result<Vec<ReloadedModel>, ClientError> {
        let robot = robot.to_owned();
        let mut service = self.model_service();
        let response = service.reload(ReloadRequest { robot }).await?;
        Ok(response.into_inner().models)
    }

    /// One robot.
    ///
    /// # Errors
    /// When the call fails, with `NOT_FOUND` for an unknown name.
    pub async fn robot(&self, name: &str) -> Result<Robot, ClientError> {
        let name = name.to_owned();
        let mut service = self.model_service();
        let response = service.get_robot(GetRobotRequest { name }).await?;
        let robot = response.into_inner().robot;
        robot.ok_or(ClientError::Contract("GetRobot without a robot"))
    }

    /// Retargets one pose for a robot, with the robot's own model. The answer's number is 0.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn retarget(
        &self,
        robot: &str,
        pose: &KeyNodeFrame,
        refine: bool,
    ) -> Result<Answer, ClientError> {
        let request = RetargetRequest {
            header: Some(wire::header(0, None)),
            robot: robot.to_owned(),
            refine,
            pose: Some(wire::pose(pose)),
            ..RetargetRequest::default()
        };
        let sent = Instant::now();
        let response = self.motion_service().retarget(request).await?.into_inner();
        let result = response
            .result
            .ok_or(ClientError::Contract("Retarget without a result"))?;
        let times = wire::times(response.timing, sent.elapsed());
        Ok(wire::answer(0, result, times))
    }

    /// Opens a stream of poses. A lost connection is restored with backoff: with delivery `ALL` whatever was not answered
    /// is sent again, with `LATEST` it is dropped.
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn stream(
        &self,
        config: StreamConfig,
    ) -> Result<(FrameSender, StreamEvents), ClientError> {
        driver::start(self.channel.clone(), config, self.backoff).await
    }

    /// Filters one goal: moves it as far as the robot's state needs, and says how the robot stands with it. The answer's
    /// number is 0. The config's delivery is that of streams.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn filter_goal(
        &self,
        config: &FilterConfig,
        history: GoalHistory<'_>,
    ) -> Result<FilterAnswer, ClientError> {
        let request = FilterGoalRequest {
            header: Some(wire::header(0, None)),
            robot: config.robot.clone(),
            model: config.model.clone(),
            model_version: config.model_version.clone(),
            history: history.frames.iter().map(wire::observation).collect(),
            start_heading: history.start_heading,
            emp_mode: config.emp_mode.into(),
            last_applied: history.last_applied,
        };
        let sent = Instant::now();
        let mut service = self.motion_service();
        let response = service.filter_goal(request).await?.into_inner();
        let result = response
            .result
            .ok_or(ClientError::Contract("FilterGoal without a result"))?;
        let times = wire::times(response.timing, sent.elapsed());
        Ok(wire::filter_answer(0, result, times))
    }

    /// Opens a stream of goals to filter, one a control period, for a robot whose legs the program moves itself. The first
    /// frame starts an episode, and so does one with `reset`. A lost connection is restored as that of
    /// [`Self::policy_stream`].
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn filter_stream(
        &self,
        config: FilterConfig,
    ) -> Result<(FrameSender<GoalFrame>, StreamEvents<FilterAnswer>), ClientError> {
        driver::start(self.channel.clone(), config, self.backoff).await
    }

    /// Opens a stream of robot states, one a control period; its answers are leg targets. The first frame starts an
    /// episode, and so does one with `reset`.
    ///
    /// A lost connection is restored with backoff. What a robot measured before is never sent again, and the server's history of
    /// the robot is lost: after [`Event::Reconnected`](crate::Event::Reconnected) the next frame starts a new episode.
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn policy_stream(
        &self,
        config: PolicyConfig,
    ) -> Result<(FrameSender<RobotFrame>, StreamEvents<PolicyAnswer>), ClientError> {
        driver::start(self.channel.clone(), config, self.backoff).await
    }

    /// Opens a teleoperation session and holds both its ends: poses and robot states in, the whole path's answers out. Observers
    /// may join by its name.
    ///
    /// A lost connection is restored as that of [`Self::policy_stream`]; the session then begins anew with the config's mode of
    /// the EMP, unless someone else kept it open.
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn teleoperate(
        &self,
        config: TeleoperationConfig,
    ) -> Result<TeleoperationStream, ClientError> {
        let role = Role::Both;
        let end = RobotEnd { config, role };
        driver::start(self.channel.clone(), end, self.backoff).await
    }

    /// Joins a teleoperation session as its robot: states in, one a control period, the whole path's answers out. The poses are
    /// the operator's.
    ///
    /// # Errors
    /// When the server refuses the stream, with `ALREADY_EXISTS` where the session has its robot.
    pub async fn join_as_robot(
        &self,
        config: TeleoperationConfig,
    ) -> Result<TeleoperationStream, ClientError> {
        let role = Role::Robot;
        let end = RobotEnd { config, role };
        driver::start(self.channel.clone(), end, self.backoff).await
    }

    /// Joins a teleoperation session as its operator: poses in, what the robot executes out. A lost connection is restored with
    /// backoff; poses that are sent meanwhile are lost.
    ///
    /// # Errors
    /// When the server refuses the stream, with `ALREADY_EXISTS` where the session has its operator.
    pub async fn operate(
        &self,
        config: TeleoperationConfig,
    ) -> Result<(PoseSender, SessionEvents), ClientError> {
        let role = Role::Operator;
        listener::start(self.channel.clone(), config, role, self.backoff).await
    }

    /// Listens to a teleoperation session. A lost connection is restored with backoff.
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn observe(&self, config: TeleoperationConfig) -> Result<SessionEvents, ClientError> {
        let role = Role::Observer;
        let (_, events) = listener::start(self.channel.clone(), config, role, self.backoff).await?;
        Ok(events)
    }

    /// Commands a session. The answer's lease goes into the next command.
    ///
    /// # Errors
    /// When the call fails, with `FAILED_PRECONDITION` where another controller has the session.
    pub async fn control(&self, request: ControlRequest) -> Result<ControlResponse, ClientError> {
        let mut service = self.teleoperation_service();
        Ok(service.control(request).await?.into_inner())
    }

    /// The open sessions.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn sessions(&self) -> Result<Vec<Session>, ClientError> {
        let mut service = self.teleoperation_service();
        let response = service
            .list_sessions(ListSessionsRequest::default())
            .await?;
        Ok(response.into_inner().sessions)
    }

    /// One session.
    ///
    /// # Errors
    /// When the call fails, with `NOT_FOUND` where there is none.
    pub async fn session(&self, name: &str) -> Result<Session, ClientError> {
        let name = name.to_owned();
        let mut service = self.teleoperation_service();
        let response = service.get_session(GetSessionRequest { name }).await?;
        let session = response.into_inner().session;
        session.ok_or(ClientError::Contract("GetSession without a session"))
    }

    /// Ends a session: the streams of everyone in it end.
    ///
    /// # Errors
    /// When the call fails, with `NOT_FOUND` where there is none.
    pub async fn end_session(&self, name: &str) -> Result<(), ClientError> {
        let name = name.to_owned();
        let mut service = self.teleoperation_service();
        service.end_session(EndSessionRequest { name }).await?;
        Ok(())
    }

    /// The controllers that can be evaluated for a robot; for any where `robot` is empty.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn controllers(
        &self,
        robot: &str,
    ) -> Result<Vec<ControllerDescription>, ClientError> {
        let robot = robot.to_owned();
        let mut service = RolloutServiceClient::new(self.channel.clone());
        let response = service
            .list_controllers(ListControllersRequest { robot })
            .await?;
        Ok(response.into_inner().controllers)
    }

    /// The jobs that run, and the last evaluations that have ended.
    ///
    /// # Errors
    /// When the call fails.
    pub async fn jobs(&self) -> Result<Vec<Job>, ClientError> {
        let mut service = RolloutServiceClient::new(self.channel.clone());
        let response = service.list_jobs(ListJobsRequest {}).await?;
        Ok(response.into_inner().jobs)
    }

    /// Cancels a job, or throws the results of one that has ended away.
    ///
    /// # Errors
    /// When the call fails, with `NOT_FOUND` where there is none.
    pub async fn cancel_job(&self, id: &str) -> Result<(), ClientError> {
        let id = id.to_owned();
        let mut service = RolloutServiceClient::new(self.channel.clone());
        service.cancel_job(CancelJobRequest { id }).await?;
        Ok(())
    }

    /// Watches an evaluation, from its start or from a later event on.
    ///
    /// # Errors
    /// When the call fails, with `NOT_FOUND` where there is none.
    pub async fn watch(&self, job: &str, first_event: u64) -> Result<Evaluation, ClientError> {
        Evaluation::watch(self.channel.clone(), job.to_owned(), first_event).await
    }

    /// Has a controller evaluated on recorded motions, beside the procedural ones of the config.
    ///
    /// # Errors
    /// When the server cannot be reached, or refuses the evaluation.
    pub async fn evaluate(
        &self,
        config: EvaluationConfig,
        motions: Vec<Clip>,
    ) -> Result<Evaluation, ClientError> {
        Evaluation::start(self.channel.clone(), config, motions).await
    }

    /// Places simulated robots on the server, for a learner. The config's number of clips is set to that of `library`.
    ///
    /// # Errors
    /// When the server refuses.
    pub async fn collect_rollouts(
        &self,
        config: CollectRolloutsConfig,
        library: Vec<GoalClip>,
    ) -> Result<Collection, ClientError> {
        Collection::start(self.channel.clone(), config, library).await
    }

    fn motion_service(&self) -> MotionServiceClient<Channel> {
        MotionServiceClient::new(self.channel.clone())
    }

    fn teleoperation_service(&self) -> TeleoperationServiceClient<Channel> {
        TeleoperationServiceClient::new(self.channel.clone())
    }

    fn model_service(&self) -> ModelServiceClient<Channel> {
        ModelServiceClient::new(self.channel.clone())
    }
}

/// The last link of an error's chain, which is the system's own word.
fn root_cause(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
}

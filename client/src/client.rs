//! A connection and its single calls.

use std::{fmt, time::Instant};

use emp_motion::{Clip, KeyNodeFrame};
use emp_proto::v1::{
    CollectRolloutsConfig, EvaluateConfig, FilterGoalRequest, GetModelRequest, GetRobotRequest,
    GoalClip, ListModelsRequest, Model, RetargetRequest, Robot, TeleoperationRole,
    model_service_client::ModelServiceClient, motion_service_client::MotionServiceClient,
};
use tonic::metadata::MetadataMap;

use crate::{
    Answer, Backoff, ClientError, Collection, ConnectOptions, Evaluation, FilterAnswer,
    FilterConfig, FrameSender, GoalFrame, GoalHistory, PolicyAnswer, PolicyConfig, PoseSender,
    RobotFrame, SessionEvents, StreamConfig, StreamEvents, TeleoperationAnswer,
    TeleoperationConfig, TeleoperationFrame, driver,
    endpoint::{self, Channel, Metadata},
    listener,
    teleoperation::RobotEnd,
    wire,
};

/// Both ends of a stream with a robot at its end.
type TeleoperationStream = (
    FrameSender<TeleoperationFrame>,
    StreamEvents<TeleoperationAnswer>,
);

/// A client of one server. Cheap to clone; clones share the connection, which comes back by itself.
#[derive(Clone)]
pub struct Client {
    channel: tonic::transport::Channel,
    metadata: Metadata,
    backoff: Backoff,
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client")
            .field("backoff", &self.backoff)
            .finish_non_exhaustive()
    }
}

impl Client {
    /// Connects to a server, for example `http://127.0.0.1:50051`.
    ///
    /// # Errors
    /// When the URL is none or nothing answers there.
    pub async fn connect(url: &str) -> Result<Self, ClientError> {
        Self::connect_with(url, ConnectOptions::default()).await
    }

    /// Connects to a server with credentials, or one whose certificate an authority of its own signed.
    ///
    /// # Errors
    /// When the URL is none, nothing answers there, the certificates do not fit, or a token would go over a network in the
    /// clear.
    pub async fn connect_with(url: &str, options: ConnectOptions) -> Result<Self, ClientError> {
        let (channel, metadata) = endpoint::connect(url, options).await?;
        Ok(Self {
            channel,
            metadata,
            backoff: Backoff::default(),
        })
    }

    /// A client over a channel that the program made itself, for example through a proxy.
    pub fn from_channel(channel: tonic::transport::Channel) -> Self {
        Self {
            channel,
            metadata: Metadata::default(),
            backoff: Backoff::default(),
        }
    }

    /// The same client, whose every call passes its metadata to `hook`, which may add to it: a token that changes, a trace.
    #[must_use]
    pub fn with_metadata(self, hook: impl Fn(&mut MetadataMap) + Send + Sync + 'static) -> Self {
        Self {
            metadata: self.metadata.with_hook(hook),
            ..self
        }
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
        let response = service.list_models(ListModelsRequest {}).await?;
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
        driver::start(self.motion_service(), config, self.backoff).await
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
        driver::start(self.motion_service(), config, self.backoff).await
    }

    /// Opens a stream of robot states, one a control period; its answers are leg targets. The first frame starts an
    /// episode, and so does one with `reset`.
    ///
    /// A lost connection is restored as that of [`Self::stream`], but the server's history of the robot is lost with it:
    /// after [`Event::Reconnected`](crate::Event::Reconnected) the next frame starts a new episode.
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn policy_stream(
        &self,
        config: PolicyConfig,
    ) -> Result<(FrameSender<RobotFrame>, StreamEvents<PolicyAnswer>), ClientError> {
        driver::start(self.motion_service(), config, self.backoff).await
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
        let role = TeleoperationRole::Both;
        let end = RobotEnd { config, role };
        driver::start(self.motion_service(), end, self.backoff).await
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
        let role = TeleoperationRole::Robot;
        let end = RobotEnd { config, role };
        driver::start(self.motion_service(), end, self.backoff).await
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
        let role = TeleoperationRole::Operator;
        listener::start(self.motion_service(), config, role, self.backoff).await
    }

    /// Listens to a teleoperation session. A lost connection is restored with backoff.
    ///
    /// # Errors
    /// When the server refuses the stream.
    pub async fn observe(&self, config: TeleoperationConfig) -> Result<SessionEvents, ClientError> {
        let role = TeleoperationRole::Observer;
        let (_, events) =
            listener::start(self.motion_service(), config, role, self.backoff).await?;
        Ok(events)
    }

    /// Has a controller evaluated on recorded motions, beside the procedural ones of the config.
    ///
    /// # Errors
    /// When the server cannot be reached. What else it refuses, the evaluation's messages say.
    pub async fn evaluate(
        &self,
        config: EvaluateConfig,
        motions: Vec<Clip>,
    ) -> Result<Evaluation, ClientError> {
        Evaluation::start(self.channel(), config, motions).await
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
        Collection::start(self.channel(), config, library).await
    }

    fn channel(&self) -> Channel {
        Channel::new(self.channel.clone(), self.metadata.clone())
    }

    fn motion_service(&self) -> MotionServiceClient<Channel> {
        MotionServiceClient::new(self.channel())
    }

    fn model_service(&self) -> ModelServiceClient<Channel> {
        ModelServiceClient::new(self.channel())
    }
}

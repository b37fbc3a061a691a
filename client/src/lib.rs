//! The client library: human poses, goals and robot states go to a server of `emp.v1`, joint targets come back, by single calls
//! or as a stream that survives a lost connection; controllers are evaluated there on a set of motions.
//!
//! It links neither MuJoCo nor candle and computes no joint angle: it installs in a minute on an operator's laptop.
//!
//! ```no_run
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! use emp_client::{Client, Delivery, Event, StreamConfig};
//!
//! let client = Client::connect("http://127.0.0.1:50051").await?;
//! let config = StreamConfig { delivery: Delivery::All, ..StreamConfig::for_robot("emp27") };
//! let (mut sender, mut events) = client.stream(config).await?;
//! let clip = emp_motion::load("motion.bvh".as_ref())?.resampled(50.0)?;
//! tokio::spawn(async move {
//!     for frame in &clip.frames {
//!         if sender.send(frame, None).await.is_err() {
//!             break;
//!         }
//!     } // Dropping the sender half-closes the stream: what is on its way is still answered.
//! });
//! while let Some(event) = events.next().await? {
//!     if let Event::Answer(answer) = event {
//!         println!("{}: {:?}", answer.sequence_number, answer.joint_angles);
//!     }
//! }
//! # Ok(())
//! # }
//! ```

#![forbid(unsafe_code)]

mod backoff;
mod client;
mod connection;
mod controller;
mod driver;
mod error;
mod kind;
mod listener;
mod rollouts;
mod statistics;
mod stream;
mod teleoperation;
mod wire;

pub use backoff::Backoff;
pub use client::Client;
pub use controller::{ControllerError, controller};
pub use emp_proto::v1::{
    AddedMass, ChangeReason, ClipSource, CollectFinished, CollectRequest, CollectRolloutsConfig,
    CollectStarted, ControlCommand, ControlRequest, ControlResponse, Controller,
    ControllerDescription, Delivery, DropReason, EmpMode, EnvironmentRandomization,
    EnvironmentSettings, EpisodeEnd, EpisodeFinished, EpisodeMetrics, EpisodeResult,
    EvaluationConfig, EvaluationMetrics, EvaluationResult, EvaluationStarted, FilterResult,
    GetServerInfoResponse as ServerInfo, GoalClip, GoalPhase, GoalStatistics, GoingAway,
    GuardReport, Hang, Job, JobKind, JobState, Joint, KeyNode, Link, MassRange, Metric, Model,
    ModelKind, PoseReport, ProceduralClips, Push, RampCause, Randomization, Range, ReloadedModel,
    RewardWeight, Robot, RobotMass, RobotSummary, RolloutBlock, Session, SessionPresence,
    SessionState, Spread, StepEnd, TeleoperatedFrame, TeleoperationStarted, Timing, TrainingEnd,
    TrainingEpisode, TrainingPush, added_mass::Choice as MassChoice,
    watch_evaluation_response::Message as EvaluationEvent,
};
pub use error::ClientError;
pub use rollouts::{Collection, Evaluation};
pub use statistics::{
    BatchStatistics, Counted, DirectionError, Percentiles, RetargetingSummary, Statistics, Summary,
};
pub use stream::{
    Answer, AnswerTimes, DropCause, Dropped, Event, FilterAnswer, FilterConfig, FrameSender,
    GoalFrame, GoalHistory, PolicyAnswer, PolicyConfig, RobotFrame, StreamClosed, StreamConfig,
    StreamEvents,
};
pub use teleoperation::{
    OperatorInput, PoseSender, SessionEvent, SessionEvents, TeleoperationAnswer,
    TeleoperationConfig, TeleoperationFrame,
};

//! `Teleoperate`: the whole path from a person's pose and a robot's state to joint targets, in sessions with several ends.
//!
//! A session ([`sessions`]) is what its members share: who is there, the person's newest pose, the EMP's mode, and a
//! channel on which everybody is told what the robot executes. The robot's stream ([`robot`]) sets the pace: each of its frames
//! goes down the [`path`] once. Operators and observers ([`listener`]) bring poses, or nothing, and listen.

mod falls;
mod inbox;
mod listener;
mod messages;
mod path;
mod robot;
mod sessions;

use std::sync::Arc;

use emp_models::guard::GuardSettings;
use emp_proto::v1::{
    TeleoperateConfig, TeleoperateRequest, TeleoperateResponse, TeleoperationFrame,
    TeleoperationRole, teleoperate_request::Message as Request,
};
use tokio::sync::mpsc;
use tonic::{Status, Streaming};

pub(crate) use self::sessions::Sessions;
use self::{
    path::Path,
    sessions::{Member, Retargeting},
};
use crate::{
    catalog::PolicyModel,
    control::EmpMode,
    error::{FieldError, ServiceError},
    identity, robot_state,
    session::{self, SessionContext},
};

/// Longest name of a session, bytes.
const LONGEST_NAME: usize = 64;

type Outbound = mpsc::Sender<Result<TeleoperateResponse, Status>>;

/// Which end of a session a stream holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Both,
    Operator,
    Robot,
    Observer,
}

impl Role {
    fn read(number: i32) -> Result<Self, FieldError> {
        match TeleoperationRole::try_from(number) {
            Ok(TeleoperationRole::Unspecified | TeleoperationRole::Both) => Ok(Self::Both),
            Ok(TeleoperationRole::Operator) => Ok(Self::Operator),
            Ok(TeleoperationRole::Robot) => Ok(Self::Robot),
            Ok(TeleoperationRole::Observer) => Ok(Self::Observer),
            Err(_) => {
                let field = "config.role";
                Err(FieldError::not_in("TeleoperationRole", field, number))
            }
        }
    }

    /// What a caller has to be.
    fn needs(self) -> &'static [identity::Role] {
        match self {
            Self::Both => &[identity::Role::Operator, identity::Role::Robot],
            Self::Operator => &[identity::Role::Operator],
            Self::Robot => &[identity::Role::Robot],
            Self::Observer => &[identity::Role::Observer],
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Both => "both",
            Self::Operator => "operator",
            Self::Robot => "robot",
            Self::Observer => "observer",
        }
    }

    fn has_robot(self) -> bool {
        matches!(self, Self::Both | Self::Robot)
    }

    fn has_person(self) -> bool {
        matches!(self, Self::Both | Self::Operator)
    }
}

/// What teleoperation needs from the server, beside what every stream does.
#[derive(Clone)]
pub(crate) struct TeleoperationContext {
    pub(crate) sessions: Arc<Sessions>,
    pub(crate) guard: GuardSettings,
}

/// Serves one stream to its end.
pub(crate) async fn run(
    context: SessionContext,
    teleoperation: TeleoperationContext,
    inbound: Streaming<TeleoperateRequest>,
    outbound: Outbound,
) {
    let conversation = converse(&context, &teleoperation, inbound, &outbound);
    session::conclude(context.deadline, &outbound, conversation).await;
}

async fn converse(
    context: &SessionContext,
    teleoperation: &TeleoperationContext,
    mut inbound: Streaming<TeleoperateRequest>,
    outbound: &Outbound,
) -> Result<(), ServiceError> {
    let config_of = |message: TeleoperateRequest| match message.message {
        Some(Request::Config(config)) => Some(config),
        _ => None,
    };
    let config = session::read_config(context, &mut inbound, config_of).await?;
    let joined = Joined::open(context, teleoperation, &config)?;
    // Whoever listens hears everything from the presence in `started` on.
    let told = joined.member.listen();
    let started = joined.started();
    if outbound.send(Ok(started)).await.is_err() {
        return Ok(());
    }
    tracing::info!(session = config.session, role = ?joined.member.role(), "stream started");
    if !joined.member.role().has_robot() {
        return listener::run(context, &joined, told, inbound, outbound).await;
    }
    drop(told);
    let delivery = session::read_delivery(config.delivery)?;
    let path = Path::new(&joined, &teleoperation.guard);
    robot::run(context, &joined, delivery, path, inbound, outbound).await
}

/// The frame in a message that is not the first.
fn frame_of(request: TeleoperateRequest) -> Result<TeleoperationFrame, FieldError> {
    match request.message {
        Some(Request::Frame(frame)) => Ok(frame),
        Some(Request::Config(_)) => Err(FieldError::second_config()),
        None => Err(FieldError::missing_frame()),
    }
}

/// A stream that is in its session.
struct Joined {
    /// Among the sessions that the caller may be in.
    _place: identity::Place,
    member: Member,
    policy: Arc<PolicyModel>,
    retargeting: Arc<Retargeting>,
}

impl Joined {
    fn open(
        context: &SessionContext,
        teleoperation: &TeleoperationContext,
        config: &TeleoperateConfig,
    ) -> Result<Self, ServiceError> {
        let role = Role::read(config.role)?;
        check_name(&config.session, role)?;
        for needed in role.needs() {
            context
                .caller
                .may(*needed, &config.robot, &config.session)?;
        }
        let place = context.caller.enter_session()?;
        session::read_delivery(config.delivery)?;
        let catalog = &context.catalog;
        let policy = catalog.policy_for(&config.robot, &config.policy, &config.policy_version)?;
        let model = catalog.retargeter_for(
            &config.robot,
            &config.retargeter,
            &config.retargeter_version,
        )?;
        let default = if policy.model.emp().is_some() {
            EmpMode::On
        } else {
            EmpMode::Off
        };
        let mode = asked_mode("config.emp_mode", config.emp_mode, policy)?;
        session::check_room(&model.batcher)?;
        session::check_room(&policy.batcher)?;
        let member = teleoperation
            .sessions
            .join(&config.session, role, &config.robot, default)?;
        if let Some(mode) = mode.filter(|_| role != Role::Observer) {
            member.set_emp_mode(mode);
        }
        context.caller.record(
            "session joined",
            serde_json::json!({"session": config.session, "robot": config.robot, "role": role.name()}),
        );
        Ok(Self {
            _place: place,
            member,
            policy: Arc::clone(policy),
            retargeting: Arc::new(Retargeting {
                model: Arc::clone(model),
                refine: config.refine,
                smoothing: config.smoothing,
            }),
        })
    }

    fn started(&self) -> TeleoperateResponse {
        messages::started(&self.member, &self.policy.card, &self.retargeting.model)
    }

    /// The mode that a frame switches to.
    fn mode_of(&self, frame: &TeleoperationFrame) -> Result<Option<EmpMode>, FieldError> {
        asked_mode("emp_mode", frame.emp_mode, &self.policy)
    }
}

fn check_name(name: &str, role: Role) -> Result<(), FieldError> {
    if name.is_empty() && role != Role::Both {
        return Err(FieldError::new(
            "config.session",
            "it is empty; this role joins a session by its name",
        ));
    }
    if name.len() > LONGEST_NAME {
        let description = format!("{} bytes; expected at most {LONGEST_NAME}", name.len());
        return Err(FieldError::new("config.session", description));
    }
    Ok(())
}

/// The mode that a field asks for, if it asks for one.
fn asked_mode(
    field: &str,
    number: i32,
    policy: &PolicyModel,
) -> Result<Option<EmpMode>, FieldError> {
    if number == 0 {
        return Ok(None);
    }
    let has_emp = policy.model.emp().is_some();
    robot_state::read_mode(field, number, EmpMode::Off, has_emp).map(Some)
}

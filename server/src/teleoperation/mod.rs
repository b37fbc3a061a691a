//! `Teleoperate` and `Observe`: the whole path for a robot and the person who drives it, who may be one client or two that meet in
//! a session by its name, with any number of observers.
//!
//! The operator's poses become goals on the operator's side ([`operator`]), as they arrive; the robot's frames set the pace and take
//! the newest goal that there is ([`robot`], [`pipeline`]): the legs never wait for the arms. Everybody else is told what the robot
//! executes ([`listener`]).

mod joined;
mod listener;
mod messages;
mod operator;
mod pipeline;
mod robot;
mod sessions;

use emp_proto::v1::{
    ObserveRequest, ObserveResponse, TeleoperateConfig, TeleoperateRequest, TeleoperateResponse,
    teleoperate_config::Role as WireRole, teleoperate_request::Message as Request,
};

use self::{joined::Joined, sessions::Role};
pub(crate) use self::{joined::TeleoperationContext, sessions::Sessions};
use crate::{
    error::ServiceError,
    session::{Outbound, Reader, StreamContext},
    streams::Place,
};

/// Serves one stream to its end.
pub(crate) async fn run(
    context: StreamContext,
    teleoperation: TeleoperationContext,
    mut inbound: Reader<TeleoperateRequest>,
    outbound: Outbound<TeleoperateResponse>,
) -> Result<(), ServiceError> {
    let config_of = |request: TeleoperateRequest| match request.message {
        Some(Request::Config(config)) => Some(config),
        _ => None,
    };
    let config = inbound.config(&context, config_of).await?;
    let joined = Joined::open(&context, &teleoperation, &config)?;
    let role = joined.member.role();
    let _place = teleoperation.streams.enter(match role.has_robot() {
        true => Place::Robot,
        false => Place::Other,
    })?;
    let session = joined.member.session();
    tracing::info!(session, ?role, "joined a session");
    // From here on nothing is missed.
    let told = joined.member.listen();
    if outbound.send(messages::started(&joined)).await.is_err() {
        return Ok(());
    }
    let serving = async {
        match role {
            Role::Both | Role::Robot => {
                drop(told);
                let guard = &teleoperation.guard;
                robot::run(&context, &joined, guard, inbound, &outbound).await
            }
            Role::Operator | Role::Observer => {
                listener::run(&context, &joined, told, Some(inbound), &outbound).await
            }
        }
    };
    tokio::select! {
        end = serving => end,
        reason = joined.member.dismissed() => Err(reason),
    }
}

/// Serves an observer who only listens.
pub(crate) async fn observe(
    context: StreamContext,
    teleoperation: TeleoperationContext,
    request: ObserveRequest,
    outbound: Outbound<ObserveResponse>,
) -> Result<(), ServiceError> {
    let config = TeleoperateConfig {
        session: request.session,
        robot: request.robot,
        role: Some(WireRole::Observer(emp_proto::v1::ObserverConfig {})),
        ..TeleoperateConfig::default()
    };
    let joined = Joined::open(&context, &teleoperation, &config)?;
    let told = joined.member.listen();
    if outbound.send(messages::started(&joined)).await.is_err() {
        return Ok(());
    }
    tokio::select! {
        end = listener::run(&context, &joined, told, None, &outbound) => end,
        reason = joined.member.dismissed() => Err(reason),
    }
}

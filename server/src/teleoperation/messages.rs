//! Teleoperation's own values as messages.

use emp_models::{
    controller::ControllerOutput,
    guard::{self, Execution},
};
use emp_proto::v1::{
    self, DroppedFrame, GoingAway, ObserveResponse, SessionPresence, TeleoperateResponse,
    TeleoperatedFrame, TeleoperationStarted, observe_response, teleoperate_response,
};

use super::joined::Joined;
use crate::{catalog::PolicyModel, encode};

/// What a client is told.
pub(super) enum Notice {
    Started(Box<TeleoperationStarted>),
    Result(Box<TeleoperatedFrame>),
    Dropped(DroppedFrame),
    Presence(SessionPresence),
    GoingAway(GoingAway),
}

impl From<Notice> for TeleoperateResponse {
    fn from(notice: Notice) -> Self {
        use teleoperate_response::Message;
        let message = Some(match notice {
            Notice::Started(started) => Message::Started(*started),
            Notice::Result(result) => Message::Result(*result),
            Notice::Dropped(dropped) => Message::Dropped(dropped),
            Notice::Presence(presence) => Message::Presence(presence),
            Notice::GoingAway(notice) => Message::GoingAway(notice),
        });
        Self { message }
    }
}

impl From<Notice> for ObserveResponse {
    fn from(notice: Notice) -> Self {
        use observe_response::Message;
        let message = match notice {
            Notice::Started(started) => Some(Message::Started(*started)),
            Notice::Result(result) => Some(Message::Result(*result)),
            Notice::Presence(presence) => Some(Message::Presence(presence)),
            Notice::GoingAway(notice) => Some(Message::GoingAway(notice)),
            // Whoever sends no frames has none dropped.
            Notice::Dropped(_) => None,
        };
        Self { message }
    }
}

pub(super) fn started<R: From<Notice>>(joined: &Joined) -> R {
    let Joined {
        member,
        policy,
        retargeting,
        ..
    } = joined;
    let PolicyModel { card, robot, .. } = &**policy;
    let retargeter = retargeting.as_ref().map(|by| &by.model.card);
    let of = |field: fn(&v1::Model) -> &String| retargeter.map(field).cloned().unwrap_or_default();
    Notice::Started(Box::new(TeleoperationStarted {
        session: member.session().to_owned(),
        robot: card.robot.clone(),
        policy: card.name.clone(),
        policy_version: card.version.clone(),
        retargeter: of(|card| &card.name),
        retargeter_version: of(|card| &card.version),
        goal_joint_names: encode::joint_names(robot.goal_joints()),
        leg_joint_names: encode::joint_names(robot.leg_joints()),
        emp_mode: encode::emp_mode(member.emp_mode()).into(),
        presence: Some(member.presence()),
        resume_token: member.resume_token().to_owned(),
    }))
    .into()
}

/// What the guards did: the one before the EMP, and the one after it.
pub(super) fn guard_report(phase: guard::GoalPhase, output: &ControllerOutput) -> v1::GuardReport {
    use guard::GoalPhase::{Following, Holding, Ramping, Resting, Returning};
    let unspecified = v1::RampCause::Unspecified;
    let (phase, cause, progress) = match phase {
        Following => (v1::GoalPhase::Following, unspecified, None),
        Ramping { cause, progress } => (v1::GoalPhase::Ramping, ramp_cause(cause), Some(progress)),
        Holding => (v1::GoalPhase::Holding, unspecified, None),
        Returning { progress } => (v1::GoalPhase::Returning, unspecified, Some(progress)),
        Resting => (v1::GoalPhase::Resting, unspecified, None),
    };
    let Execution { fade, limited, .. } = output.execution.clone().unwrap_or_default();
    v1::GuardReport {
        phase: phase.into(),
        cause: cause.into(),
        progress,
        emp_progress: fade,
        speed_limited_joints: limited.into_iter().map(encode::count).collect(),
        ..v1::GuardReport::default()
    }
}

fn ramp_cause(cause: guard::RampCause) -> v1::RampCause {
    match cause {
        guard::RampCause::FirstFrame => v1::RampCause::FirstFrame,
        guard::RampCause::RobotResumed => v1::RampCause::RobotResumed,
        guard::RampCause::OperatorReturned => v1::RampCause::OperatorReturned,
    }
}

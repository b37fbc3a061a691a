//! Teleoperation's own values as messages.

use emp_models::{
    controller::ControllerOutput,
    guard::{self, Execution},
};
use emp_proto::v1::{
    self, DroppedFrame, TeleoperateResponse, TeleoperationPresence, TeleoperationStarted,
    teleoperate_response::Message,
};
use emp_robot::Robot;

use super::{Role, sessions::Member};
use crate::{catalog::RetargetModel, control::EmpMode, metrics::metrics, wire};

fn response(message: Message) -> TeleoperateResponse {
    TeleoperateResponse {
        message: Some(message),
    }
}

pub(super) fn result(frame: v1::TeleoperatedFrame) -> TeleoperateResponse {
    response(Message::Result(frame))
}

pub(super) fn dropped(notice: DroppedFrame) -> TeleoperateResponse {
    response(Message::Dropped(notice))
}

pub(super) fn presence(presence: TeleoperationPresence) -> TeleoperateResponse {
    response(Message::Presence(presence))
}

pub(super) fn started(
    member: &Member,
    policy: &v1::Model,
    retargeter: &RetargetModel,
) -> TeleoperateResponse {
    let RetargetModel { card, robot, .. } = retargeter;
    response(Message::Started(TeleoperationStarted {
        session: member.session().to_owned(),
        role: role(member.role()).into(),
        robot: card.robot.clone(),
        policy: policy.name.clone(),
        policy_version: policy.version.clone(),
        retargeter: card.name.clone(),
        retargeter_version: card.version.clone(),
        goal_joint_names: wire::joint_names(robot.goal_joints()),
        leg_joint_names: wire::joint_names(robot.leg_joints()),
        emp_mode: emp_mode(member.emp_mode()).into(),
        presence: Some(member.presence()),
    }))
}

fn role(role: Role) -> v1::TeleoperationRole {
    match role {
        Role::Both => v1::TeleoperationRole::Both,
        Role::Operator => v1::TeleoperationRole::Operator,
        Role::Robot => v1::TeleoperationRole::Robot,
        Role::Observer => v1::TeleoperationRole::Observer,
    }
}

pub(super) fn emp_mode(mode: EmpMode) -> v1::EmpMode {
    match mode {
        EmpMode::Off => v1::EmpMode::Off,
        EmpMode::On => v1::EmpMode::On,
        EmpMode::WhenDanger => v1::EmpMode::WhenDanger,
    }
}

/// What the guards did: the one before the EMP, and the one after it.
pub(super) fn guard_report(
    robot: &Robot,
    phase: guard::GoalPhase,
    output: &ControllerOutput,
) -> v1::GuardReport {
    use guard::GoalPhase::{Following, Holding, Ramping, Resting, Returning};
    let unspecified = v1::RampCause::Unspecified;
    let (phase, cause, progress) = match phase {
        Following => (v1::GoalPhase::Following, unspecified, 0.0),
        Ramping { cause, progress } => (v1::GoalPhase::Ramping, ramp_cause(cause), progress),
        Holding => (v1::GoalPhase::Holding, unspecified, 0.0),
        Returning { progress } => (v1::GoalPhase::Returning, unspecified, progress),
        Resting => (v1::GoalPhase::Resting, unspecified, 0.0),
    };
    let Execution { fade, limited, .. } = output.execution.clone().unwrap_or_default();
    let names = limited
        .iter()
        .map(|&index| robot.goal_joints()[index].name.clone());
    metrics().guard_period(phase.as_str_name());
    v1::GuardReport {
        phase: phase.into(),
        cause: cause.into(),
        progress,
        emp_progress: fade,
        speed_limited_joints: names.collect(),
    }
}

fn ramp_cause(cause: guard::RampCause) -> v1::RampCause {
    match cause {
        guard::RampCause::FirstFrame => v1::RampCause::FirstFrame,
        guard::RampCause::RobotResumed => v1::RampCause::RobotResumed,
        guard::RampCause::OperatorReturned => v1::RampCause::OperatorReturned,
    }
}

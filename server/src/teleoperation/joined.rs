//! A stream in its session: who it is, and which models it has.

use std::sync::Arc;

use emp_models::guard::GuardSettings;
use emp_proto::v1::{
    BothConfig, FrameHeader, OperatorConfig, RobotConfig, TeleoperateConfig,
    teleoperate_config::Role as WireRole,
};

use super::sessions::{Member, Role, Sessions, Start};
use crate::{
    catalog::{PolicyModel, RetargetModel},
    decode::{fields, robot_state},
    error::{FieldError, ServiceError},
    inference::controllers::EmpMode,
    session::{self, StreamContext},
    streams::Streams,
};

/// Longest name of a session, bytes.
const LONGEST_NAME: usize = 64;

/// What teleoperation needs from the server beside what every stream needs.
#[derive(Clone)]
pub(crate) struct TeleoperationContext {
    pub(crate) sessions: Arc<Sessions>,
    pub(crate) guard: GuardSettings,
    pub(crate) streams: Arc<Streams>,
}

/// How an operator's poses become goals.
pub(super) struct Retargeting {
    pub(super) model: Arc<RetargetModel>,
    pub(super) refine: bool,
    pub(super) smoothing: bool,
}

/// A stream that is in its session.
pub(super) struct Joined {
    pub(super) member: Member,
    pub(super) policy: Arc<PolicyModel>,
    /// How its person's poses become goals, where it has one.
    pub(super) retargeting: Option<Arc<Retargeting>>,
    /// The robot is simulated, in step with the answers.
    pub(super) simulated: bool,
}

impl Joined {
    pub(super) fn open(
        context: &StreamContext,
        teleoperation: &TeleoperationContext,
        config: &TeleoperateConfig,
    ) -> Result<Self, ServiceError> {
        let missing = || FieldError::new("config.role", "it is missing");
        let (role, robot_end, operator) = match config.role.clone().ok_or_else(missing)? {
            WireRole::Operator(operator) => (Role::Operator, None, Some(operator)),
            WireRole::RobotEnd(robot) => (Role::Robot, Some(robot), None),
            WireRole::Both(BothConfig {
                robot, operator, ..
            }) => (
                Role::Both,
                Some(robot.unwrap_or_default()),
                Some(operator.unwrap_or_default()),
            ),
            WireRole::Observer(_) => (Role::Observer, None, None),
        };
        let session = check_name(&config.session, role)?;
        let sessions = &teleoperation.sessions;
        let robot = match (config.robot.as_str(), role) {
            ("", Role::Observer) => {
                sessions
                    .robot_of(session)
                    .ok_or_else(|| ServiceError::NotFound {
                        what: "session",
                        name: session.to_owned(),
                        served: "name its robot to wait for it".to_owned(),
                    })?
            }
            (robot, _) => robot.to_owned(),
        };
        let RobotConfig {
            policy,
            policy_version,
            start_stopped,
        } = robot_end.unwrap_or_default();
        let catalog = &context.catalog;
        let policy = catalog.policy_for(&robot, &policy, &policy_version)?;
        session::check_room(&policy.batcher)?;
        let retargeting = operator
            .map(|operator| open_retargeting(context, &robot, &operator))
            .transpose()?;
        let has_emp = policy.model.emp().is_some();
        let mode = config.emp_mode;
        let mode = mode.map(|mode| robot_state::read_mode("config.emp_mode", mode, has_emp));
        let mode = mode.transpose()?;
        let start = Start {
            emp_mode: EmpMode::usual(has_emp),
            stopped: start_stopped,
        };
        let member = sessions.join(session, role, &robot, &config.resume_token, start)?;
        if let Some(mode) = mode.filter(|_| role != Role::Observer) {
            member.set_emp_mode(mode);
        }
        Ok(Self {
            member,
            policy,
            retargeting,
            simulated: matches!(
                &config.role,
                Some(WireRole::Both(BothConfig {
                    simulated: true,
                    ..
                }))
            ),
        })
    }

    /// The mode that a frame switches to.
    pub(super) fn mode_of(
        &self,
        field: &str,
        mode: Option<i32>,
    ) -> Result<Option<EmpMode>, FieldError> {
        let has_emp = self.policy.model.emp().is_some();
        mode.map(|mode| robot_state::read_mode(field, mode, has_emp))
            .transpose()
    }
}

fn open_retargeting(
    context: &StreamContext,
    robot: &str,
    config: &OperatorConfig,
) -> Result<Arc<Retargeting>, ServiceError> {
    let OperatorConfig {
        retargeter,
        retargeter_version,
        refine,
        smoothing,
    } = config;
    let catalog = &context.catalog;
    let model = catalog.retargeter_for(robot, retargeter, retargeter_version)?;
    session::check_room(&model.batcher)?;
    Ok(Arc::new(Retargeting {
        model,
        refine: *refine,
        smoothing: *smoothing,
    }))
}

fn check_name(name: &str, role: Role) -> Result<&str, FieldError> {
    if name.is_empty() && role != Role::Both {
        return Err(FieldError::new(
            "config.session",
            "it is empty; this role joins a session by its name",
        ));
    }
    if !name.is_empty() {
        fields::name("config.session", name.to_owned(), LONGEST_NAME)?;
    }
    Ok(name)
}

/// Counts the frames that never came, by the gaps in their numbers.
#[derive(Default)]
pub(super) struct LossCounter(Option<u64>);

impl LossCounter {
    /// A frame came; how many before it did not.
    pub(super) fn count(&mut self, header: Option<&FrameHeader>) -> u64 {
        let Some(number) = header.map(|header| header.sequence_number) else {
            return 0;
        };
        let expected = self.0.map(|last| last.wrapping_add(1));
        self.0 = Some(number);
        match expected {
            // A number that goes back is a sender that counts otherwise.
            Some(expected) if number > expected => number - expected,
            _ => 0,
        }
    }
}

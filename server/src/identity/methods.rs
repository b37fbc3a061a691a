//! The table of every method: the least role that may call it, and what it counts as. What is not in it cannot be called.

use super::role::Role;

/// Who may call a method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Needs {
    /// Anyone, without credentials: health, for probes.
    Nothing,
    /// Whoever has one of these roles; the handler asks for the robot and the session.
    Role(&'static [Role]),
}

/// What a call counts as in quotas and metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// One answer to one request.
    Call,
    /// A stream in one direction or both.
    Stream,
    /// Long work on threads of its own.
    Job,
}

/// A method of the wire contract.
#[derive(Debug)]
pub(crate) struct Method {
    /// As HTTP has it.
    pub(crate) path: &'static str,
    pub(crate) needs: Needs,
    pub(crate) kind: Kind,
    /// Whether a call is written to the audit log.
    pub(crate) audited: bool,
}

const fn row(path: &'static str, needs: Needs, kind: Kind, audited: bool) -> Method {
    Method {
        path,
        needs,
        kind,
        audited,
    }
}

const SEE: Needs = Needs::Role(&[Role::Observer]);
const OPERATE: Needs = Needs::Role(&[Role::Operator]);
const POSE: Needs = Needs::Role(&[Role::Operator, Role::Robot]);
const MOVE: Needs = Needs::Role(&[Role::Robot]);
const EVALUATE: Needs = Needs::Role(&[Role::Evaluator]);
const ADMINISTER: Needs = Needs::Role(&[Role::Admin]);

/// Every method that can be called.
pub(crate) static METHODS: &[Method] = &[
    row("/emp.v1.ModelService/GetModel", SEE, Kind::Call, false),
    row("/emp.v1.ModelService/GetRobot", SEE, Kind::Call, false),
    row("/emp.v1.ModelService/ListModels", SEE, Kind::Call, false),
    row("/emp.v1.ModelService/ListRobots", SEE, Kind::Call, false),
    row("/emp.v1.ModelService/GetServerInfo", SEE, Kind::Call, false),
    row("/emp.v1.ModelService/Reload", ADMINISTER, Kind::Call, true),
    row("/emp.v1.MotionService/Retarget", POSE, Kind::Call, false),
    row(
        "/emp.v1.MotionService/StreamRetarget",
        POSE,
        Kind::Stream,
        false,
    ),
    row("/emp.v1.MotionService/FilterGoal", MOVE, Kind::Call, false),
    row(
        "/emp.v1.MotionService/StreamFilterGoal",
        MOVE,
        Kind::Stream,
        true,
    ),
    row("/emp.v1.MotionService/StepPolicy", MOVE, Kind::Call, false),
    row(
        "/emp.v1.MotionService/StreamPolicy",
        MOVE,
        Kind::Stream,
        true,
    ),
    // The end of the session that is asked for needs its own role; the handler asks.
    row("/emp.v1.MotionService/Teleoperate", SEE, Kind::Stream, true),
    row(
        "/emp.v1.TeleoperationService/Teleoperate",
        SEE,
        Kind::Stream,
        true,
    ),
    row(
        "/emp.v1.TeleoperationService/Observe",
        SEE,
        Kind::Stream,
        true,
    ),
    row(
        "/emp.v1.TeleoperationService/Control",
        OPERATE,
        Kind::Call,
        true,
    ),
    row(
        "/emp.v1.TeleoperationService/ListSessions",
        SEE,
        Kind::Call,
        false,
    ),
    row(
        "/emp.v1.TeleoperationService/GetSession",
        SEE,
        Kind::Call,
        false,
    ),
    row(
        "/emp.v1.TeleoperationService/EndSession",
        ADMINISTER,
        Kind::Call,
        true,
    ),
    row("/emp.v1.RolloutService/Evaluate", EVALUATE, Kind::Job, true),
    row(
        "/emp.v1.RolloutService/ListControllers",
        SEE,
        Kind::Call,
        false,
    ),
    row(
        "/emp.v1.RolloutService/StartEvaluation",
        EVALUATE,
        Kind::Stream,
        true,
    ),
    row(
        "/emp.v1.RolloutService/WatchEvaluation",
        EVALUATE,
        Kind::Stream,
        false,
    ),
    row(
        "/emp.v1.RolloutService/ListJobs",
        EVALUATE,
        Kind::Call,
        false,
    ),
    row(
        "/emp.v1.RolloutService/CancelJob",
        EVALUATE,
        Kind::Call,
        true,
    ),
    row(
        "/emp.v1.RolloutService/CollectRollouts",
        EVALUATE,
        Kind::Job,
        true,
    ),
    row(
        "/grpc.health.v1.Health/Check",
        Needs::Nothing,
        Kind::Call,
        false,
    ),
    row(
        "/grpc.health.v1.Health/List",
        Needs::Nothing,
        Kind::Call,
        false,
    ),
    row(
        "/grpc.health.v1.Health/Watch",
        Needs::Nothing,
        Kind::Stream,
        false,
    ),
    row(
        "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        SEE,
        Kind::Stream,
        false,
    ),
    row(
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
        SEE,
        Kind::Stream,
        false,
    ),
];

/// The row of a path.
pub(crate) fn find(path: &str) -> Option<&'static Method> {
    METHODS.iter().find(|method| method.path == path)
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use prost_types::FileDescriptorSet;

    use super::*;

    /// Every method of the descriptors that the server registers: path, and whether it streams.
    fn described() -> Vec<(String, bool)> {
        [
            emp_proto::FILE_DESCRIPTOR_SET,
            tonic_health::pb::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET,
        ]
        .into_iter()
        .flat_map(|bytes| FileDescriptorSet::decode(bytes).expect("descriptors").file)
        .flat_map(|file| {
            let package = file.package().to_owned();
            file.service.into_iter().flat_map(move |service| {
                let service_name = format!("/{package}.{}", service.name());
                service.method.into_iter().map(move |method| {
                    let streams = method.client_streaming() || method.server_streaming();
                    (format!("{service_name}/{}", method.name()), streams)
                })
            })
        })
        .collect()
    }

    #[test]
    fn every_method_has_a_row_that_fits_it() {
        let described = described();
        assert!(described.len() > 10);
        for (path, streams) in described {
            let method = find(&path).unwrap_or_else(|| panic!("{path} has no row"));
            assert_eq!(method.kind != Kind::Call, streams, "{path}");
        }
    }

    #[test]
    fn only_health_is_open_to_all() {
        for method in METHODS {
            let is_health = method.path.starts_with("/grpc.health.v1.Health/");
            assert_eq!(method.needs == Needs::Nothing, is_health, "{}", method.path);
        }
    }
}

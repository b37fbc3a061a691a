//! Every way in which a call can fail, and the one place that turns it into a gRPC status.

use std::{collections::HashMap, time::Duration};

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

use crate::inference::{
    batcher::{Rejected, Unanswered},
    queue::JobError,
};

/// The domain of every `ErrorInfo`.
const DOMAIN: &str = "emp.v1";
/// When to try again while a model is rebuilt. A server that shuts down does not say: another may be there already.
const UNAVAILABLE_RETRY: Duration = Duration::from_secs(1);

/// A field of a request that breaks the contract.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {description}")]
pub(crate) struct FieldError {
    /// Path of the field from the message that holds it, for example `pose.left_elbow.x`.
    pub(crate) field: String,
    /// What was found and what was expected.
    pub(crate) description: String,
}

impl FieldError {
    pub(crate) fn new(field: impl Into<String>, description: impl Into<String>) -> Self {
        Self {
            field: shortened(field.into()),
            description: shortened(description.into()),
        }
    }

    pub(crate) fn missing_config() -> Self {
        Self::new(
            "config",
            "it is missing; a stream's first message is its config",
        )
    }

    pub(crate) fn missing_frame() -> Self {
        Self::new("message", "it is missing; expected a frame")
    }

    /// `number` is not in this enumeration of the contract.
    pub(crate) fn not_in(enumeration: &str, field: &str, number: i32) -> Self {
        let description = format!("{number}; expected a value of emp.v1.{enumeration}");
        Self::new(field, description)
    }

    pub(crate) fn second_config() -> Self {
        Self::new("config", "only the first message may be a config")
    }
}

/// Most bytes of what a client sent that are repeated to it: its own headers have a limit.
const LONGEST_TEXT: usize = 512;

/// A text of a length that fits a header.
pub(crate) fn shortened(mut text: String) -> String {
    if text.len() > LONGEST_TEXT {
        text.truncate(text.floor_char_boundary(LONGEST_TEXT));
        text.push('…');
    }
    text
}

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ServiceError {
    #[error("{0}")]
    InvalidField(#[from] FieldError),
    /// A request to move or a stream's config names something that is not served.
    #[error("{field}: there is no {what} {name:?}; served: {served}")]
    NotServed {
        field: &'static str,
        what: &'static str,
        name: String,
        served: String,
    },
    /// A look-up by name found nothing.
    #[error("there is no {what} {name:?}; served: {served}")]
    NotFound {
        what: &'static str,
        name: String,
        served: String,
    },
    #[error("the deadline passed before an answer was ready")]
    DeadlineExceeded,
    #[error("{what}; try again in {} ms", retry.as_millis())]
    Overloaded { what: &'static str, retry: Duration },
    #[error("the model failed: {0}")]
    ModelFailed(String),
    #[error("the model is being rebuilt after a failure")]
    ModelUnavailable,
    /// A robot's file is damaged: it is not served until that is mended.
    #[error("robot {robot:?} is not served: {reason}")]
    NotServing { robot: String, reason: String },
    #[error("the job failed: {0}")]
    JobFailed(String),
    #[error("the job was cancelled")]
    JobCancelled,
    /// The client sent nothing for too long.
    #[error("{0}")]
    Silent(&'static str),
    /// Another stream took the place of this one.
    #[error("{0}")]
    Replaced(&'static str),
    /// Another controller commands the session.
    #[error("session {session:?} has another controller; its lease ends in {} ms", left.as_millis())]
    LeaseTaken { session: String, left: Duration },
    /// A session has one robot and one operator at most.
    #[error("session {session:?} has its {seat} already")]
    SeatTaken { session: String, seat: &'static str },
    #[error("the server is shutting down")]
    ShuttingDown,
    /// The transport ended the call (reset by the client, message too large, not decodable): its status stands.
    #[error("{}", .0.message())]
    Transport(Status),
}

impl From<JobError> for ServiceError {
    fn from(error: JobError) -> Self {
        match error {
            JobError::DeadlineExceeded => Self::DeadlineExceeded,
            JobError::ModelFailed(explanation) => Self::ModelFailed(explanation),
            JobError::ModelUnavailable => Self::ModelUnavailable,
        }
    }
}

impl From<Rejected> for ServiceError {
    fn from(rejected: Rejected) -> Self {
        match rejected {
            Rejected::Full(retry) => Self::Overloaded {
                what: "the model's queue is full",
                retry,
            },
            Rejected::Unavailable => Self::ModelUnavailable,
        }
    }
}

impl From<Unanswered> for ServiceError {
    fn from(why: Unanswered) -> Self {
        match why {
            Unanswered::Late => Self::DeadlineExceeded,
            Unanswered::Rejected(rejected) => rejected.into(),
            Unanswered::Failed(error) => error.into(),
        }
    }
}

/// What a call says that was not answered, or whose task is gone.
pub(crate) fn task_failed() -> Status {
    let details = ErrorDetails::with_error_info("TASK_FAILED", DOMAIN, HashMap::new());
    let message = "the server failed in this call; its log says how";
    Status::with_error_details(Code::Internal, message, details)
}

impl ServiceError {
    fn code(&self) -> Code {
        match self {
            Self::InvalidField(_) | Self::NotServed { .. } => Code::InvalidArgument,
            Self::NotFound { .. } => Code::NotFound,
            Self::DeadlineExceeded | Self::Silent(_) => Code::DeadlineExceeded,
            Self::SeatTaken { .. } => Code::AlreadyExists,
            Self::LeaseTaken { .. } => Code::FailedPrecondition,
            Self::Replaced(_) | Self::JobCancelled => Code::Aborted,
            Self::Overloaded { .. } => Code::ResourceExhausted,
            Self::ModelFailed(_) | Self::JobFailed(_) => Code::Internal,
            Self::ModelUnavailable | Self::ShuttingDown | Self::NotServing { .. } => {
                Code::Unavailable
            }
            Self::Transport(status) => status.code(),
        }
    }

    /// The `reason` of the `ErrorInfo`; stable, for programs to match on.
    fn reason(&self) -> &'static str {
        match self {
            Self::InvalidField(_) => "INVALID_FIELD",
            Self::NotServed { .. } => "NOT_SERVED",
            Self::NotFound { .. } => "NOT_FOUND",
            Self::DeadlineExceeded => "DEADLINE_EXCEEDED",
            Self::Overloaded { .. } => "OVERLOADED",
            Self::ModelFailed(_) => "MODEL_FAILED",
            Self::NotServing { .. } => "NOT_SERVING",
            Self::JobFailed(_) => "JOB_FAILED",
            Self::JobCancelled => "JOB_CANCELLED",
            Self::Silent(_) => "SILENT",
            Self::Replaced(_) => "REPLACED",
            Self::LeaseTaken { .. } => "LEASE_TAKEN",
            Self::SeatTaken { .. } => "SEAT_TAKEN",
            Self::ModelUnavailable => "MODEL_UNAVAILABLE",
            Self::ShuttingDown => "SHUTTING_DOWN",
            Self::Transport(_) => "TRANSPORT",
        }
    }

    fn metadata(&self) -> HashMap<String, String> {
        let pairs = match self {
            Self::InvalidField(error) => vec![("field", error.field.clone())],
            Self::NotServed {
                what, name, served, ..
            }
            | Self::NotFound { what, name, served } => {
                vec![
                    ("kind", (*what).to_owned()),
                    ("name", name.clone()),
                    ("served", served.clone()),
                ]
            }
            Self::NotServing { robot, reason } => {
                vec![("robot", robot.clone()), ("reason", reason.clone())]
            }
            Self::LeaseTaken { session, .. } => vec![("session", session.clone())],
            Self::SeatTaken { session, seat } => {
                vec![("session", session.clone()), ("seat", (*seat).to_owned())]
            }
            _ => Vec::new(),
        };
        pairs
            .into_iter()
            .map(|(key, value)| (key.to_owned(), value))
            .collect()
    }

    fn details(&self) -> ErrorDetails {
        let mut details = ErrorDetails::with_error_info(self.reason(), DOMAIN, self.metadata());
        match self {
            Self::InvalidField(error) => {
                details.add_bad_request_violation(&error.field, &error.description);
            }
            Self::NotServed {
                field,
                what,
                name,
                served,
            } => {
                let description = format!("there is no {what} {name:?}; served: {served}");
                details.add_bad_request_violation(*field, description);
            }
            Self::Overloaded { retry, .. } => {
                details.set_retry_info(Some(*retry));
            }
            Self::ModelUnavailable => {
                details.set_retry_info(Some(UNAVAILABLE_RETRY));
            }
            _ => {}
        }
        details
    }
}

impl From<ServiceError> for Status {
    fn from(error: ServiceError) -> Self {
        match error {
            ServiceError::Transport(status) => status,
            error => {
                let message = shortened(error.to_string());
                Self::with_error_details(error.code(), message, error.details())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_field_is_named_in_both_details() {
        let error = FieldError::new("pose.torso.x", "NaN; expected a finite number");
        let status = Status::from(ServiceError::from(error));
        assert_eq!(status.code(), Code::InvalidArgument);
        let details = status.get_error_details();
        let info = details.error_info().expect("ErrorInfo");
        assert_eq!(
            (info.reason.as_str(), info.domain.as_str()),
            ("INVALID_FIELD", DOMAIN)
        );
        assert_eq!(info.metadata["field"], "pose.torso.x");
        let violations = &details.bad_request().expect("BadRequest").field_violations;
        assert_eq!(violations[0].field, "pose.torso.x");
    }

    #[test]
    fn overload_says_when_to_try_again() {
        let retry = Duration::from_millis(40);
        let status = Status::from(ServiceError::from(Rejected::Full(retry)));
        assert_eq!(status.code(), Code::ResourceExhausted);
        let details = status.get_error_details();
        assert_eq!(
            details.retry_info().and_then(|info| info.retry_delay),
            Some(retry)
        );
    }
}

//! Every way in which a call can fail, and the one place that turns it into a gRPC status.

use std::{collections::HashMap, time::Duration};

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

use crate::{batcher::Rejected, queue::JobError};

/// The domain of every `ErrorInfo`.
const DOMAIN: &str = "emp.v1";
/// When to try again while a model is rebuilt or the server is replaced.
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
            field: field.into(),
            description: description.into(),
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
    #[error("the job failed: {0}")]
    JobFailed(String),
    /// A session has one robot and one operator at most.
    #[error("session {session:?} has its {seat} already")]
    SeatTaken { session: String, seat: &'static str },
    /// The reason is one of the `CREDENTIALS_` reasons.
    #[error("{}", credentials(.0))]
    Unauthenticated(&'static str),
    #[error("{name:?} may not {what}")]
    PermissionDenied { name: String, what: String },
    #[error("there is no such method")]
    UnknownMethod,
    #[error("the server is shutting down")]
    ShuttingDown,
    /// The transport ended the call (reset by the client, message too large, not decodable): its status stands.
    #[error("{}", .0.message())]
    Transport(Status),
}

fn credentials(reason: &str) -> &'static str {
    match reason {
        "CREDENTIALS_MISSING" => {
            "this server asks for credentials: metadata `authorization: Bearer TOKEN`, or a client certificate"
        }
        "CREDENTIALS_EXPIRED" => "the credentials have expired",
        "CREDENTIALS_REVOKED" => "the credentials were revoked or changed",
        _ => "the credentials are not known",
    }
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

impl ServiceError {
    fn code(&self) -> Code {
        match self {
            Self::InvalidField(_) | Self::NotServed { .. } => Code::InvalidArgument,
            Self::NotFound { .. } => Code::NotFound,
            Self::DeadlineExceeded => Code::DeadlineExceeded,
            Self::SeatTaken { .. } => Code::AlreadyExists,
            Self::Unauthenticated(_) => Code::Unauthenticated,
            Self::PermissionDenied { .. } => Code::PermissionDenied,
            Self::UnknownMethod => Code::Unimplemented,
            Self::Overloaded { .. } => Code::ResourceExhausted,
            Self::ModelFailed(_) | Self::JobFailed(_) => Code::Internal,
            Self::ModelUnavailable | Self::ShuttingDown => Code::Unavailable,
            Self::Transport(status) => status.code(),
        }
    }

    /// The `reason` of the `ErrorInfo`; stable, for programs to match on.
    pub(crate) fn reason(&self) -> &'static str {
        match self {
            Self::InvalidField(_) => "INVALID_FIELD",
            Self::NotServed { .. } => "NOT_SERVED",
            Self::NotFound { .. } => "NOT_FOUND",
            Self::DeadlineExceeded => "DEADLINE_EXCEEDED",
            Self::Overloaded { .. } => "OVERLOADED",
            Self::ModelFailed(_) => "MODEL_FAILED",
            Self::JobFailed(_) => "JOB_FAILED",
            Self::SeatTaken { .. } => "SEAT_TAKEN",
            Self::Unauthenticated(reason) => reason,
            Self::PermissionDenied { .. } => "PERMISSION_DENIED",
            Self::UnknownMethod => "UNKNOWN_METHOD",
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
            Self::SeatTaken { session, seat } => {
                vec![("session", session.clone()), ("seat", (*seat).to_owned())]
            }
            _ => Vec::new(),
        };
        pairs
            .into_iter()
            .map(|(key, value)| (key.to_owned(), shortened(&value)))
            .collect()
    }

    fn details(&self) -> ErrorDetails {
        let mut details = ErrorDetails::with_error_info(self.reason(), DOMAIN, self.metadata());
        match self {
            Self::InvalidField(error) => {
                let description = shortened(&error.description);
                details.add_bad_request_violation(shortened(&error.field), description);
            }
            Self::NotServed {
                field,
                what,
                name,
                served,
            } => {
                let description = format!("there is no {what} {name:?}; served: {served}");
                details.add_bad_request_violation(*field, shortened(&description));
            }
            Self::Overloaded { retry, .. } => {
                details.set_retry_info(Some(*retry));
            }
            // A server that shuts down does not say when: another may be there already.
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
                let message = shortened(&error.to_string());
                Self::with_error_details(error.code(), message, error.details())
            }
        }
    }
}

/// A text that may repeat what a client sent, cut so that the answer's headers stay within every client's limit.
fn shortened(text: &str) -> String {
    const LONGEST: usize = 1024;
    if text.len() <= LONGEST {
        return text.to_owned();
    }
    let mut end = LONGEST;
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    format!("{}…", &text[..end])
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
    fn what_a_client_sent_is_not_repeated_at_length() {
        let error = FieldError::new("config.robot", "ä".repeat(20_000));
        let status = Status::from(ServiceError::from(error));
        assert!(status.message().len() < 1100, "{}", status.message().len());
        let details = status.get_error_details();
        let violations = &details.bad_request().expect("BadRequest").field_violations;
        assert!(violations[0].description.len() < 1100);
        assert!(violations[0].description.ends_with('…'));
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

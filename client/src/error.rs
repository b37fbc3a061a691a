//! What can go wrong between a client and its server.

use tonic::{Code, Status};
use tonic_types::StatusExt as _;

/// Why a call or a stream failed.
#[derive(Debug, Clone, thiserror::Error)]
pub enum ClientError {
    /// The URL is none, or nothing answers there.
    #[error("cannot connect to {url}: {reason}")]
    Connect {
        /// The URL as it was given.
        url: String,
        /// What the system or the transport said.
        reason: String,
    },
    /// The server refused or failed.
    #[error("the server answered {}: {}", code_name(.0.code()), .0.message())]
    Status(Status),
    /// The server fell silent, or ended a stream without a reason.
    #[error("{0}")]
    Silence(&'static str),
    /// The connection was lost and could not be restored in time.
    #[error("connection lost and not restored within {seconds:.0} s: {last}")]
    Lost {
        /// For how long it was tried, seconds.
        seconds: f64,
        /// What the last attempt said.
        last: String,
    },
    /// The server's answer breaks the contract.
    #[error("the server's answer breaks the contract: {0}")]
    Contract(&'static str),
}

impl ClientError {
    /// A message whose kind this client does not know.
    pub(crate) const EMPTY_MESSAGE: Self =
        Self::Contract("a message without content; is the server newer?");

    /// The code, where the server answered with a status.
    pub fn code(&self) -> Option<Code> {
        match self {
            Self::Status(status) => Some(status.code()),
            _ => None,
        }
    }

    /// The stable reason of the server's `ErrorInfo`, for example `INVALID_FIELD`.
    pub fn reason(&self) -> Option<String> {
        match self {
            Self::Status(status) => status.get_details_error_info().map(|info| info.reason),
            _ => None,
        }
    }
}

impl From<Status> for ClientError {
    fn from(status: Status) -> Self {
        Self::Status(status)
    }
}

/// The code as the gRPC documents write it.
fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

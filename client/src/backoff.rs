//! When to try again.

use std::time::Duration;

use rand::RngExt as _;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::ClientError;

/// The server's reason when somebody holds the place in a session that was asked for.
const SEAT_TAKEN: &str = "SEAT_TAKEN";

/// Exponential backoff with equal jitter: each pause is half fixed, half random.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Backoff {
    /// Upper end of the first pause.
    pub first: Duration,
    /// Upper end of the longest pause.
    pub longest: Duration,
    /// How long to try before the connection counts as lost for good.
    pub give_up: Duration,
}

impl Default for Backoff {
    fn default() -> Self {
        Self {
            first: Duration::from_millis(100),
            longest: Duration::from_secs(5),
            give_up: Duration::from_secs(60),
        }
    }
}

impl Backoff {
    /// The pause before an attempt, counted from 1: at least what the server asked for, random otherwise, so that many
    /// clients do not come back at the same moment.
    pub(crate) fn pause(&self, attempt: u32, last: &Break) -> Duration {
        let doubled = self
            .first
            .saturating_mul(1_u32.checked_shl(attempt - 1).unwrap_or(u32::MAX));
        let jitter = rand::rng().random_range(0.5..1.0);
        let asked = last.asked_pause();
        doubled.min(self.longest).mul_f64(jitter).max(asked)
    }
}

/// What ended a connection.
#[derive(Debug, Clone)]
pub(crate) enum Break {
    /// A status, from the server or made up by the transport.
    Status(Status),
    /// The server fell silent, or ended the stream without a reason.
    Silence(&'static str),
}

impl Break {
    /// Whether the same call may succeed later: the server said so, or something other than the server ended it.
    pub(crate) fn is_worth_retrying(&self) -> bool {
        let Self::Status(status) = self else {
            return true;
        };
        match status.code() {
            Code::Unavailable | Code::ResourceExhausted => true,
            // The transport's own words for a broken connection. The server explains what it ends itself.
            Code::Unknown | Code::Internal | Code::Cancelled => {
                status.get_details_error_info().is_none()
            }
            _ => false,
        }
    }

    /// Whether it may succeed after a connection was lost: the server may not have noticed yet, and keep the place in a session
    /// for whoever held it.
    pub(crate) fn is_worth_retrying_again(&self) -> bool {
        let is_taken = |status: &Status| {
            let info = status.get_details_error_info();
            info.is_some_and(|info| info.reason == SEAT_TAKEN)
        };
        self.is_worth_retrying() || matches!(self, Self::Status(status) if is_taken(status))
    }

    /// What happened, in words.
    pub(crate) fn reason(&self) -> &str {
        match self {
            Self::Status(status) => status.message(),
            Self::Silence(reason) => reason,
        }
    }

    fn asked_pause(&self) -> Duration {
        let Self::Status(status) = self else {
            return Duration::ZERO;
        };
        status
            .get_details_retry_info()
            .and_then(|info| info.retry_delay)
            .unwrap_or_default()
    }
}

impl From<Break> for ClientError {
    fn from(end: Break) -> Self {
        match end {
            Break::Status(status) => Self::Status(status),
            Break::Silence(reason) => Self::Silence(reason),
        }
    }
}

impl From<Status> for Break {
    fn from(status: Status) -> Self {
        Self::Status(status)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn pauses_double_up_to_the_longest() {
        let backoff = Backoff::default();
        let lost = Break::Silence("gone");
        for (attempt, longest) in [(1, 100), (2, 200), (3, 400), (10, 5_000), (200, 5_000)] {
            let pause = backoff.pause(attempt, &lost);
            let longest = Duration::from_millis(longest);
            assert!(
                pause <= longest && pause >= longest / 2,
                "attempt {attempt}: {pause:?}"
            );
        }
    }

    #[test]
    fn the_server_can_ask_for_a_longer_pause() {
        let details = ErrorDetails::with_retry_info(Some(Duration::from_secs(2)));
        let status = Status::with_error_details(Code::ResourceExhausted, "full", details);
        assert!(Backoff::default().pause(1, &status.into()) >= Duration::from_secs(2));
    }

    #[test]
    fn what_the_server_explains_is_final() {
        let retried = |status: Status| Break::from(status).is_worth_retrying();
        let info = ErrorDetails::with_error_info("MODEL_FAILED", "emp.v1", HashMap::new());
        assert!(!retried(Status::with_error_details(
            Code::Internal,
            "model",
            info
        )));
        assert!(!retried(Status::invalid_argument("robot")));
        let taken = ErrorDetails::with_error_info(SEAT_TAKEN, "emp.v1", HashMap::new());
        let taken = Status::with_error_details(Code::AlreadyExists, "robot", taken);
        assert!(Break::from(taken.clone()).is_worth_retrying_again());
        assert!(!retried(taken));
        assert!(retried(Status::unknown("h2 protocol error")));
        assert!(retried(Status::unavailable("draining")));
        assert!(Break::Silence("no answer").is_worth_retrying());
    }
}

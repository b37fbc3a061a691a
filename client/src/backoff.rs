//! When to try again.

use std::time::Duration;

use rand::RngExt as _;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

/// Exponential backoff with full jitter.
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
    pub(crate) fn pause(&self, attempt: u32, last: &Status) -> Duration {
        let doubled = self
            .first
            .saturating_mul(1_u32.checked_shl(attempt - 1).unwrap_or(u32::MAX));
        let jitter = rand::rng().random_range(0.5..1.0);
        let asked = last
            .get_details_retry_info()
            .and_then(|info| info.retry_delay)
            .unwrap_or_default();
        doubled.min(self.longest).mul_f64(jitter).max(asked)
    }
}

/// Whether the same call may succeed later: the server said so, or something other than the server ended it.
pub(crate) fn is_worth_retrying(status: &Status) -> bool {
    match status.code() {
        Code::Unavailable | Code::ResourceExhausted => true,
        // The transport's own words for a broken connection. The server explains what it ends itself.
        Code::Unknown | Code::Internal | Code::Cancelled => {
            status.get_details_error_info().is_none()
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn pauses_double_up_to_the_longest() {
        let backoff = Backoff::default();
        let lost = Status::unavailable("gone");
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
        assert!(Backoff::default().pause(1, &status) >= Duration::from_secs(2));
    }

    #[test]
    fn what_the_server_explains_is_final() {
        let info = ErrorDetails::with_error_info(
            "MODEL_FAILED",
            "emp.v1",
            [("", ""); 0].map(|(k, v): (&str, &str)| (k.to_owned(), v.to_owned())),
        );
        assert!(!is_worth_retrying(&Status::with_error_details(
            Code::Internal,
            "model",
            info
        )));
        assert!(!is_worth_retrying(&Status::invalid_argument("robot")));
        assert!(is_worth_retrying(&Status::unknown("h2 protocol error")));
        assert!(is_worth_retrying(&Status::unavailable("draining")));
    }
}

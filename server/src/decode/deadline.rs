//! When an answer is due: the call's `grpc-timeout` and the frame's own time budget, whichever is sooner.

use std::time::{Duration, Instant};

use emp_proto::v1::FrameHeader;
use tonic::metadata::MetadataMap;

use crate::error::FieldError;

/// tonic answers an expired `grpc-timeout` with `CANCELLED`. Finishing this part earlier lets the server say
/// `DEADLINE_EXCEEDED`, as the protocol wants.
const HEAD_START: f64 = 0.02;
/// The head start's bounds.
const HEAD_START_BOUNDS: [Duration; 2] = [Duration::from_millis(1), Duration::from_millis(50)];

/// When a call must have ended, by its `grpc-timeout`.
pub(crate) fn of_call(
    metadata: &MetadataMap,
    received: Instant,
) -> Result<Option<Instant>, FieldError> {
    let Some(value) = metadata.get("grpc-timeout") else {
        return Ok(None);
    };
    let timeout = value.to_str().ok().and_then(parse_timeout).ok_or_else(|| {
        FieldError::new(
            "grpc-timeout",
            format!("{value:?}; expected up to 8 digits and one of H M S m u n"),
        )
    })?;
    let head_start = timeout
        .mul_f64(HEAD_START)
        .clamp(HEAD_START_BOUNDS[0], HEAD_START_BOUNDS[1]);
    Ok(received.checked_add(timeout.saturating_sub(head_start)))
}

/// When a frame's answer stops being useful, by its `time_budget`.
pub(crate) fn of_frame(
    header: Option<&FrameHeader>,
    received: Instant,
) -> Result<Option<Instant>, FieldError> {
    let Some(budget) = header.and_then(|header| header.time_budget) else {
        return Ok(None);
    };
    let budget = duration("header.time_budget", &budget)?;
    Ok(received.checked_add(budget))
}

/// A time that is not negative.
pub(crate) fn duration(
    field: &str,
    duration: &prost_types::Duration,
) -> Result<Duration, FieldError> {
    let prost_types::Duration { seconds, nanos } = *duration;
    let found = || format!("{seconds} s and {nanos} ns");
    match (u64::try_from(seconds), u32::try_from(nanos)) {
        (Ok(seconds), Ok(nanos @ 0..1_000_000_000)) => Ok(Duration::new(seconds, nanos)),
        (Ok(_), Ok(_)) => {
            let description = format!("{}; expected less than 10⁹ ns", found());
            Err(FieldError::new(field, description))
        }
        _ => {
            let description = format!("{}; expected zero or more", found());
            Err(FieldError::new(field, description))
        }
    }
}

fn parse_timeout(value: &str) -> Option<Duration> {
    let (digits, unit) = value.split_at_checked(value.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let count: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(count * 3600)),
        "M" => Some(Duration::from_secs(count * 60)),
        "S" => Some(Duration::from_secs(count)),
        "m" => Some(Duration::from_millis(count)),
        "u" => Some(Duration::from_micros(count)),
        "n" => Some(Duration::from_nanos(count)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_are_read_in_every_unit_and_nothing_else() {
        assert_eq!(parse_timeout("2H"), Some(Duration::from_secs(7200)));
        assert_eq!(parse_timeout("3M"), Some(Duration::from_secs(180)));
        assert_eq!(parse_timeout("15S"), Some(Duration::from_secs(15)));
        assert_eq!(parse_timeout("250m"), Some(Duration::from_millis(250)));
        assert_eq!(parse_timeout("9u"), Some(Duration::from_micros(9)));
        assert_eq!(
            parse_timeout("99999999n"),
            Some(Duration::from_nanos(99_999_999))
        );
        for bad in ["", "m", "5", "123456789m", "-1m", "+1m", "1 m", "5x", "5ä"] {
            assert_eq!(parse_timeout(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn budgets_at_their_extremes_are_taken_or_refused_by_name() {
        let of = |seconds, nanos| {
            let time_budget = Some(prost_types::Duration { seconds, nanos });
            let header = FrameHeader {
                time_budget,
                ..FrameHeader::default()
            };
            of_frame(Some(&header), Instant::now())
        };
        for (seconds, nanos) in [
            (-1, 0),
            (0, -1),
            (i64::MIN, 0),
            (i64::MIN, i32::MIN),
            (1, i32::MAX),
            (i64::MAX, -1),
        ] {
            let error = of(seconds, nanos).expect_err("refused");
            assert_eq!(error.field, "header.time_budget");
        }
        assert_eq!(of(i64::MAX, 999_999_999), Ok(None), "no limit");
        assert!(of(0, 0).expect("zero").is_some());
    }
}

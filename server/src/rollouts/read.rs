//! Reading what the calls of `RolloutService` have in common.

use std::{fmt::Display, ops::RangeInclusive};

use emp_proto::v1::ClipSource;
use emp_sim::goals::Source;
use tonic::Streaming;

use crate::error::{FieldError, ServiceError};

/// The client's next message; none after its half-close.
pub(super) async fn message<T>(inbound: &mut Streaming<T>) -> Result<Option<T>, ServiceError> {
    inbound.message().await.map_err(ServiceError::Transport)
}

/// A number inside its range. NaN is in none.
pub(super) fn within<T: PartialOrd + Display + Copy>(
    field: &str,
    value: T,
    range: RangeInclusive<T>,
) -> Result<T, FieldError> {
    if range.contains(&value) {
        return Ok(value);
    }
    let (least, most) = (range.start(), range.end());
    Err(FieldError::new(
        field,
        format!("{value}; expected {least} to {most}"),
    ))
}

/// Longest name of a clip, bytes.
const LONGEST_NAME: usize = 128;

/// A clip's name.
pub(super) fn name(field: &str, name: String) -> Result<String, FieldError> {
    match name.len() {
        0 => Err(FieldError::new(field, "it is missing")),
        // It stands in every episode's report.
        length if length > LONGEST_NAME => {
            let description = format!("{length} bytes; expected at most {LONGEST_NAME}");
            Err(FieldError::new(field, description))
        }
        _ => Ok(name),
    }
}

/// Where a goal clip comes from, off the wire.
pub(super) fn source(field: &str, number: i32) -> Result<Source, FieldError> {
    match ClipSource::try_from(number) {
        Ok(ClipSource::Unspecified | ClipSource::Recorded) => Ok(Source::Recorded),
        Ok(ClipSource::Procedural) => Ok(Source::Procedural),
        Err(_) => Err(FieldError::not_in("ClipSource", field, number)),
    }
}

/// How many frames, at the robot's control rate, a call may still send or have made.
pub(super) struct Budget {
    /// Rate of the frames that count, Hz.
    pub(super) control_rate: f64,
    limit: usize,
    left: usize,
}

impl Budget {
    pub(super) fn new(limit: usize, control_rate: f64) -> Self {
        Self {
            control_rate,
            limit,
            left: limit,
        }
    }

    /// Takes `frames` that `field` brought.
    pub(super) fn spend(&mut self, field: &str, frames: usize) -> Result<(), FieldError> {
        match self.left.checked_sub(frames) {
            Some(left) => {
                self.left = left;
                Ok(())
            }
            None => Err(FieldError::new(
                field,
                format!("more frames than the {} that this server takes", self.limit),
            )),
        }
    }
}

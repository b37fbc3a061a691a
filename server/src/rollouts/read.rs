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

/// A clip's name.
pub(super) fn name(field: &str, name: String) -> Result<String, FieldError> {
    if name.is_empty() {
        return Err(FieldError::new(field, "it is missing"));
    }
    Ok(name)
}

/// Where a goal clip comes from, off the wire.
pub(super) fn source(field: &str, number: i32) -> Result<Source, FieldError> {
    match ClipSource::try_from(number) {
        Ok(ClipSource::Unspecified | ClipSource::Recorded) => Ok(Source::Recorded),
        Ok(ClipSource::Procedural) => Ok(Source::Procedural),
        Err(_) => Err(FieldError::not_in("ClipSource", field, number)),
    }
}

/// How many frames a call may still send.
pub(super) struct Budget {
    limit: usize,
    left: usize,
}

impl Budget {
    pub(super) fn new(limit: usize) -> Self {
        Self { limit, left: limit }
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

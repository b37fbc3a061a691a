//! Reading what the calls of `RolloutService` have in common.

use emp_proto::v1::ClipSource;
use emp_sim::goals::Source;

use super::fields;
use crate::error::FieldError;

/// A clip's name: as short as a name is, for it stands in every episode's report.
pub(crate) fn name(field: &str, name: String) -> Result<String, FieldError> {
    fields::name(field, name, 128)
}

/// Where a goal clip comes from, off the wire.
pub(crate) fn source(field: &str, number: i32) -> Result<Source, FieldError> {
    match ClipSource::try_from(number) {
        Ok(ClipSource::Unspecified | ClipSource::Recorded) => Ok(Source::Recorded),
        Ok(ClipSource::Procedural) => Ok(Source::Procedural),
        Err(_) => Err(FieldError::not_in("ClipSource", field, number)),
    }
}

/// How many frames of motion a job may still have, at the robot's control rate.
pub(crate) struct Budget {
    limit: usize,
    left: usize,
}

impl Budget {
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit, left: limit }
    }

    /// Takes `frames` that `field` brought, or that will be made of what it brought.
    pub(crate) fn spend(&mut self, field: &str, frames: usize) -> Result<(), FieldError> {
        match self.left.checked_sub(frames) {
            Some(left) => {
                self.left = left;
                Ok(())
            }
            None => Err(FieldError::new(
                field,
                format!(
                    "more frames, at the robot's control rate, than the {} that this server takes",
                    self.limit
                ),
            )),
        }
    }
}

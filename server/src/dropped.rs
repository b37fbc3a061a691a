//! Why a frame of a stream has no answer.

use emp_proto::v1::{DropReason, DroppedFrame, FrameHeader};

use crate::{
    error::FieldError,
    inference::{
        batcher::{Rejected, Unanswered},
        queue::JobError,
    },
};

/// A frame was not computed.
#[derive(Debug, PartialEq)]
pub(crate) struct NotComputed {
    reason: DropReason,
    /// The field that is wrong, where one is.
    field: String,
    description: String,
}

impl NotComputed {
    fn new(reason: DropReason, description: impl Into<String>) -> Self {
        Self {
            reason,
            field: String::new(),
            description: description.into(),
        }
    }

    pub(crate) fn late() -> Self {
        Self::new(DropReason::DeadlineExceeded, "its time budget ran out")
    }

    pub(crate) fn superseded() -> Self {
        Self::new(DropReason::Superseded, "a newer frame took its place")
    }

    /// The message about the frame with this header.
    pub(crate) fn notice(self, header: Option<FrameHeader>) -> DroppedFrame {
        DroppedFrame {
            header,
            reason: self.reason.into(),
            field: self.field,
            description: self.description,
        }
    }
}

impl From<FieldError> for NotComputed {
    fn from(error: FieldError) -> Self {
        let FieldError { field, description } = error;
        Self {
            field,
            ..Self::new(DropReason::Invalid, description)
        }
    }
}

impl From<Unanswered> for NotComputed {
    fn from(why: Unanswered) -> Self {
        match why {
            Unanswered::Late => Self::late(),
            Unanswered::Rejected(rejected) => rejected.into(),
            Unanswered::Failed(error) => error.into(),
        }
    }
}

impl From<Rejected> for NotComputed {
    fn from(rejected: Rejected) -> Self {
        match rejected {
            Rejected::Full(_) => Self::new(DropReason::Overloaded, "the model's queue is full"),
            Rejected::Unavailable => {
                Self::new(DropReason::ModelUnavailable, "the model is being rebuilt")
            }
        }
    }
}

impl From<JobError> for NotComputed {
    fn from(error: JobError) -> Self {
        let reason = match &error {
            JobError::DeadlineExceeded => return Self::late(),
            JobError::ModelFailed(_) => DropReason::ModelFailed,
            JobError::ModelUnavailable => DropReason::ModelUnavailable,
        };
        Self::new(reason, error.to_string())
    }
}

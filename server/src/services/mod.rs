//! The services of `emp.v1`: each call's messages in and out, on top of what does the work.

pub(crate) mod model;
pub(crate) mod motion;
pub(crate) mod rollout;
pub(crate) mod teleoperation;

/// Largest message that is about single frames: one pose takes about 200 bytes, fifteen robot states 4 KiB.
pub(crate) const MAX_MESSAGE: usize = 256 << 10;
/// Largest message of jobs: parts of motions, policies and snapshots.
pub(crate) const MAX_JOB_MESSAGE: usize = 4 << 20;

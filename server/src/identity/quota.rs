//! How much one identity may have at once.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::methods::Kind;
use crate::error::ServiceError;

/// When to ask again for something that others of the same identity hold.
const RETRY: Duration = Duration::from_secs(1);

/// What an identity may have at once, and read each second.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Quota {
    /// Most open calls and streams.
    pub(super) streams: u64,
    /// Most sessions that it is in, each end of one counted.
    pub(super) sessions: u64,
    /// Most evaluations and rollouts.
    pub(super) jobs: u64,
    /// Most bytes a second that the server reads from it; more wait.
    pub(super) bytes_per_second: u64,
}

impl Default for Quota {
    fn default() -> Self {
        Self {
            streams: 64,
            sessions: 16,
            jobs: 2,
            bytes_per_second: 16 << 20,
        }
    }
}

impl Quota {
    pub(super) fn unlimited() -> Self {
        Self {
            streams: u64::MAX,
            sessions: u64::MAX,
            jobs: u64::MAX,
            bytes_per_second: u64::MAX,
        }
    }
}

/// What an identity has now.
#[derive(Debug, Default)]
pub(crate) struct Usage {
    streams: Arc<AtomicU64>,
    sessions: Arc<AtomicU64>,
    jobs: Arc<AtomicU64>,
    read: Mutex<Option<Reading>>,
}

/// Bytes that were read and not yet worked off at the quota's rate.
#[derive(Debug, Clone, Copy)]
struct Reading {
    ahead: f64,
    at: Instant,
}

/// Something that counts against a quota; free again when it is dropped.
#[derive(Debug)]
pub(crate) struct Place(Arc<AtomicU64>);

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

fn enter(count: &Arc<AtomicU64>, most: u64, what: &'static str) -> Result<Place, ServiceError> {
    let one_more = |count: u64| (count < most).then_some(count + 1);
    count
        .fetch_update(Ordering::AcqRel, Ordering::Acquire, one_more)
        .map(|_| Place(Arc::clone(count)))
        .map_err(|_| ServiceError::Overloaded { what, retry: RETRY })
}

impl Usage {
    pub(super) fn enter_call(&self, kind: Kind, quota: &Quota) -> Result<Place, ServiceError> {
        match kind {
            Kind::Call | Kind::Stream => enter(
                &self.streams,
                quota.streams,
                "these credentials have as many calls open as they may",
            ),
            Kind::Job => enter(
                &self.jobs,
                quota.jobs,
                "these credentials have as many jobs as they may",
            ),
        }
    }

    pub(super) fn enter_session(&self, quota: &Quota) -> Result<Place, ServiceError> {
        enter(
            &self.sessions,
            quota.sessions,
            "these credentials are in as many sessions as they may be",
        )
    }

    pub(super) fn read(&self, bytes: usize, quota: &Quota) -> Duration {
        if quota.bytes_per_second == u64::MAX {
            return Duration::ZERO;
        }
        let now = Instant::now();
        let rate = quota.bytes_per_second.max(1) as f64;
        let mut reading = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        let before = reading.unwrap_or(Reading {
            ahead: 0.0,
            at: now,
        });
        let worked_off = now.duration_since(before.at).as_secs_f64() * rate;
        let ahead = (before.ahead - worked_off).max(0.0) + bytes as f64;
        *reading = Some(Reading { ahead, at: now });
        // A second's worth may come at once.
        Duration::try_from_secs_f64(ahead / rate - 1.0).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_bounded_and_come_back() {
        let usage = Usage::default();
        let quota = Quota {
            streams: 2,
            jobs: 1,
            ..Quota::default()
        };
        let call = || usage.enter_call(Kind::Stream, &quota);
        let one = call().expect("a place");
        let _two = call().expect("a place");
        assert!(call().is_err());
        assert!(usage.enter_call(Kind::Job, &quota).is_ok());
        drop(one);
        assert!(call().is_ok());
    }

    #[test]
    fn bytes_beyond_the_rate_wait() {
        let usage = Usage::default();
        let quota = Quota {
            bytes_per_second: 1000,
            ..Quota::default()
        };
        assert_eq!(usage.read(500, &quota), Duration::ZERO);
        let wait = usage.read(10_000, &quota);
        assert!(
            (Duration::from_secs(8)..Duration::from_secs(10)).contains(&wait),
            "{wait:?}"
        );
        assert_eq!(
            usage.read(usize::MAX >> 1, &Quota::unlimited()),
            Duration::ZERO
        );
    }
}

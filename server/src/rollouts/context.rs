//! What the calls of `RolloutService` need from the server.

use std::{sync::Arc, time::Duration};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;

use super::{jobs::Jobs, places::enter};
use crate::{catalog::Catalog, decode::rollouts::Budget, error::ServiceError, settings::Settings};

/// Most calls that send the motions of a job at once, beyond as many as there are jobs.
const MORE_UPLOADS: usize = 2;
/// Most calls that watch evaluations at once.
const MOST_WATCHERS: usize = 64;
/// How long a client may be silent while it sends motions or requests.
pub(super) const IDLE: Duration = Duration::from_secs(60);

/// What a call needs from the server.
#[derive(Clone)]
pub(crate) struct RolloutContext {
    pub(crate) catalog: Arc<Catalog>,
    pub(crate) jobs: Arc<Jobs>,
    uploads: Arc<Semaphore>,
    watchers: Arc<Semaphore>,
    /// Most frames of motion that a job may have.
    max_frames: usize,
    pub(super) drain: CancellationToken,
}

impl RolloutContext {
    pub(crate) fn new(
        catalog: Arc<Catalog>,
        settings: &Settings,
        drain: CancellationToken,
    ) -> Self {
        let rollouts = &settings.rollouts;
        let uploads = rollouts.max_jobs.get().saturating_add(MORE_UPLOADS);
        Self {
            catalog,
            jobs: Arc::new(Jobs::new(rollouts)),
            uploads: Arc::new(Semaphore::new(uploads.min(Semaphore::MAX_PERMITS))),
            watchers: Arc::new(Semaphore::new(MOST_WATCHERS)),
            max_frames: rollouts.max_frames.get(),
            drain,
        }
    }

    pub(super) fn budget(&self) -> Budget {
        Budget::new(self.max_frames)
    }

    /// A place for a call that sends motions.
    pub(super) fn enter_upload(&self) -> Result<OwnedSemaphorePermit, ServiceError> {
        let what = "as many calls send motions as the server allows";
        enter(&self.uploads, what)
    }

    /// A place for a call that watches.
    pub(crate) fn enter_watch(&self) -> Result<OwnedSemaphorePermit, ServiceError> {
        enter(
            &self.watchers,
            "as many calls watch evaluations as the server allows",
        )
    }
}

//! Places that there is a limited number of.

use std::{sync::Arc, time::Duration};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::error::ServiceError;

/// When to ask again for a place; jobs are long.
pub(super) const RETRY: Duration = Duration::from_secs(5);

/// A place, if one is free.
pub(super) fn enter(
    places: &Arc<Semaphore>,
    what: &'static str,
) -> Result<OwnedSemaphorePermit, ServiceError> {
    let permit = Arc::clone(places).try_acquire_owned();
    permit.map_err(|_| ServiceError::Overloaded { what, retry: RETRY })
}

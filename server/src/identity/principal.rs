//! Somebody who may use the server.

use std::{
    collections::BTreeSet,
    sync::Arc,
    time::{Duration, SystemTime},
};

use tokio_util::sync::CancellationToken;

use super::{
    methods::Kind,
    patterns::Patterns,
    quota::{Place, Quota, Usage},
    role::Role,
};
use crate::error::ServiceError;

/// Somebody who may do something.
pub(crate) struct Identity {
    pub(super) name: String,
    pub(super) roles: BTreeSet<Role>,
    pub(super) robots: Patterns,
    pub(super) sessions: Patterns,
    pub(super) expires: Option<SystemTime>,
    pub(super) quota: Quota,
    pub(super) usage: Arc<Usage>,
    /// Cancelled when the identity is gone or changed: what it has open ends.
    pub(super) revoked: CancellationToken,
}

impl Identity {
    /// Whoever reaches a server that asks for no credentials.
    pub(super) fn anyone() -> Self {
        Self::new("anyone", BTreeSet::from([Role::Admin]))
    }

    /// Has no role, so may do nothing.
    pub(super) fn nobody() -> Self {
        Self::new("nobody", BTreeSet::new())
    }

    pub(super) fn new(name: &str, roles: BTreeSet<Role>) -> Self {
        Self {
            name: name.to_owned(),
            roles,
            robots: Patterns::any(),
            sessions: Patterns::any(),
            expires: None,
            quota: Quota::unlimited(),
            usage: Arc::default(),
            revoked: CancellationToken::new(),
        }
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    pub(crate) fn has(&self, needed: Role) -> bool {
        self.roles.iter().any(|role| role.covers(needed))
    }

    pub(crate) fn has_expired(&self, now: SystemTime) -> bool {
        self.expires.is_some_and(|expires| expires <= now)
    }

    /// Resolves when what the identity has open must end, with the reason.
    pub(crate) async fn ended(&self) -> ServiceError {
        let expiry = async {
            match self.expires {
                Some(expires) => {
                    let left = expires.duration_since(SystemTime::now());
                    tokio::time::sleep(left.unwrap_or_default()).await;
                }
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = self.revoked.cancelled() => ServiceError::Unauthenticated("CREDENTIALS_REVOKED"),
            () = expiry => ServiceError::Unauthenticated("CREDENTIALS_EXPIRED"),
        }
    }

    /// A place among the calls of this kind that the identity may have open.
    pub(crate) fn enter_call(&self, kind: Kind) -> Result<Place, ServiceError> {
        self.usage.enter_call(kind, &self.quota)
    }

    /// How long to wait before more is read, after this many bytes were.
    pub(crate) fn read(&self, bytes: usize) -> Duration {
        self.usage.read(bytes, &self.quota)
    }
}

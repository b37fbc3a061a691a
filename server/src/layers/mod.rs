//! What every request passes before a handler sees it, in one place. From the outside in:
//!
//! 1. [`request`]: number and trace of the request, the span that its log lines carry, where browsers may come from.
//! 2. The pages that are not gRPC (`http`), or gRPC-Web made gRPC.
//! 3. [`call`]: whose call it is, whether that may call it, quotas, metrics, the audit log.

mod body;
pub(crate) mod call;
mod open;
pub(crate) mod request;

use std::sync::Arc;

use crate::{
    identity::{Audit, Directory},
    settings::HttpSettings,
};

/// What the layers need from the server.
pub(crate) struct Gate {
    pub(crate) directory: Arc<Directory>,
    pub(crate) audit: Audit,
    pub(crate) http: HttpSettings,
}

impl Gate {
    /// Whether anyone who reaches the server may use it.
    pub(crate) fn is_open(&self) -> bool {
        matches!(*self.directory, Directory::Open(_))
    }
}

//! Files that are read again while the server runs: when they change, and when the server is told to (SIGHUP).

use std::{
    fs,
    os::unix::fs::MetadataExt as _,
    path::PathBuf,
    sync::Arc,
    time::{Duration, SystemTime},
};

use tokio::{sync::Notify, time::sleep};
use tokio_util::sync::CancellationToken;

use crate::metrics::metrics;

/// How often files are looked at. Looking works on every file system and through the links by which mounted secrets change.
const INTERVAL: Duration = Duration::from_secs(2);

/// Files, and what reads them again.
pub(crate) struct Watched {
    /// What they are, for the log and metrics.
    pub(crate) what: &'static str,
    pub(crate) files: Vec<PathBuf>,
    pub(crate) reload: Box<dyn Fn() -> Result<(), String> + Send + Sync>,
}

/// What tells a file from what it was.
#[derive(Debug, PartialEq, Eq)]
struct Stamp(Option<(SystemTime, u64, u64)>);

impl Watched {
    fn stamps(&self) -> Vec<Stamp> {
        let stamp = |path: &PathBuf| {
            let metadata = fs::metadata(path).ok()?;
            Some((metadata.modified().ok()?, metadata.len(), metadata.ino()))
        };
        self.files.iter().map(|path| Stamp(stamp(path))).collect()
    }

    fn read_again(&self) {
        let outcome = (self.reload)();
        metrics().reloaded(self.what, outcome.is_ok());
        match outcome {
            Ok(()) => tracing::info!(what = self.what, "read again"),
            Err(error) => tracing::error!(
                what = self.what,
                error,
                "not read again; what was read before stays"
            ),
        }
    }
}

/// Reads files again when they changed, or all when `now` says so; until `stop`.
pub(crate) async fn watch(watched: Vec<Watched>, now: Arc<Notify>, stop: CancellationToken) {
    let mut state: Vec<_> = watched
        .into_iter()
        .map(|watched| (watched.stamps(), watched))
        .collect();
    loop {
        let all = tokio::select! {
            () = stop.cancelled() => return,
            () = now.notified() => true,
            () = sleep(INTERVAL) => false,
        };
        let look = tokio::task::spawn_blocking(move || {
            for (before, watched) in &mut state {
                let stamps = watched.stamps();
                if all || stamps != *before {
                    watched.read_again();
                    *before = stamps;
                }
            }
            state
        });
        match look.await {
            Ok(looked) => state = looked,
            Err(error) => return tracing::error!(%error, "files are not looked at any more"),
        }
    }
}

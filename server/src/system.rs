//! What the server and the system it runs on tell each other: systemd's notices, the limit of file descriptors.

use std::time::Duration;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use sd_notify::NotifyState;

/// Descriptors beside connections: files, the runtime, standard streams.
const OTHERS: u64 = 64;

/// Tells systemd, if it waits for that, that the server serves; and from then on that it is alive.
pub(crate) fn ready() {
    tell(&[NotifyState::Ready]);
    if let Some(interval) = sd_notify::watchdog_enabled() {
        tokio::spawn(watchdog(interval / 2));
    }
}

pub(crate) fn stopping() {
    tell(&[NotifyState::Stopping]);
}

/// Runs among the server's own tasks: it falls silent when they do not get their turn.
async fn watchdog(interval: Duration) {
    loop {
        tell(&[NotifyState::Watchdog]);
        tokio::time::sleep(interval).await;
    }
}

fn tell(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::warn!(%error, "systemd");
    }
}

/// Takes as many file descriptors as the system allows, and warns if they are too few.
pub(crate) fn raise_descriptor_limit(connections: usize) {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current != maximum {
        let raised = Rlimit {
            current: maximum,
            maximum,
        };
        if let Err(error) = setrlimit(Resource::Nofile, raised) {
            tracing::warn!(%error, "cannot raise the limit of file descriptors");
        }
    }
    let needed = OTHERS + connections as u64;
    let limit = getrlimit(Resource::Nofile).current;
    if let Some(limit) = limit.filter(|&limit| limit < needed) {
        tracing::warn!(
            limit,
            needed,
            "fewer file descriptors than connections.max may need; see LimitNOFILE in systemd, ulimit -n"
        );
    }
}

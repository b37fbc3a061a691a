//! Accepts connections, for as long as there is anyone to serve them.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use tokio::{
    net::{TcpListener, TcpStream},
    sync::mpsc,
    time::{sleep, timeout},
};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

use super::{
    Connection, Limits, Peer, Tls,
    connection::Transport,
    places::{Place, Places},
};
use crate::metrics::metrics;

/// How long to wait when the system has no more connections to give; file descriptors do not come back sooner for asking.
const PAUSE: Duration = Duration::from_millis(100);
/// Connections that wait to be served.
const HAND_OVER: usize = 16;

/// Takes connections from a listener.
pub(crate) struct Acceptor {
    listener: TcpListener,
    tls: Option<Arc<Tls>>,
    limits: Limits,
}

impl Acceptor {
    pub(crate) fn new(listener: TcpListener, tls: Option<Arc<Tls>>, limits: Limits) -> Self {
        Self {
            listener,
            tls,
            limits,
        }
    }

    /// Connections that have begun to speak, until `stop`; those that have not are closed then.
    pub(crate) fn start(
        self,
        stop: CancellationToken,
    ) -> impl tokio_stream::Stream<Item = std::io::Result<Connection>> {
        let (ready, connections) = mpsc::channel(HAND_OVER);
        tokio::spawn(self.run(ready, stop));
        ReceiverStream::new(connections)
    }

    async fn run(self, ready: mpsc::Sender<std::io::Result<Connection>>, stop: CancellationToken) {
        let places = Places::default();
        loop {
            let accepted = tokio::select! {
                biased;
                () = stop.cancelled() => return,
                () = ready.closed() => return,
                accepted = self.listener.accept() => accepted,
            };
            let (stream, address) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    metrics().accept_failed();
                    tracing::warn!(%error, pause = ?PAUSE, "cannot accept a connection");
                    sleep(PAUSE).await;
                    continue;
                }
            };
            match places.enter(address.ip(), &self.limits) {
                Ok(place) => {
                    let tls = self.tls.clone();
                    let begin = begin(stream, address, tls, place);
                    let limit = self.limits.handshake;
                    tokio::spawn(hand_over(
                        begin,
                        address,
                        limit,
                        ready.clone(),
                        stop.clone(),
                    ));
                }
                Err(reason) => {
                    metrics().connection_refused(reason);
                    tracing::debug!(peer = %address, reason, "connection refused");
                }
            }
        }
    }
}

/// Why a connection came to nothing.
#[derive(Debug, thiserror::Error)]
enum BeginError {
    #[error("TLS: {0}")]
    Tls(std::io::Error),
    #[error("{0}")]
    Closed(std::io::Error),
}

async fn begin(
    stream: TcpStream,
    address: SocketAddr,
    tls: Option<Arc<Tls>>,
    place: Place,
) -> Result<Connection, BeginError> {
    // Where the system refuses, answers come a little later.
    let _ = stream.set_nodelay(true);
    let (transport, certificate) = match tls {
        None => (Transport::Clear(stream), Arc::default()),
        Some(tls) => {
            let (stream, names) = tls.accept(stream).await.map_err(BeginError::Tls)?;
            (Transport::Tls(Box::new(stream)), names)
        }
    };
    let peer = Peer {
        address,
        certificate,
    };
    Connection::begin(transport, peer, place)
        .await
        .map_err(BeginError::Closed)
}

async fn hand_over(
    begin: impl Future<Output = Result<Connection, BeginError>>,
    address: SocketAddr,
    limit: Duration,
    ready: mpsc::Sender<std::io::Result<Connection>>,
    stop: CancellationToken,
) {
    let begun = tokio::select! {
        begun = timeout(limit, begin) => begun,
        () = stop.cancelled() => return,
    };
    let reason = match begun {
        Ok(Ok(connection)) => {
            // The server that it was for may have ended.
            let _ = ready.send(Ok(connection)).await;
            return;
        }
        Ok(Err(error @ BeginError::Tls(_))) => {
            tracing::info!(peer = %address, %error, "connection refused");
            "tls"
        }
        // A probe that only looks whether the port is open.
        Ok(Err(BeginError::Closed(_))) => "closed",
        Err(_) => {
            tracing::debug!(peer = %address, ?limit, "a silent connection was closed");
            "silent"
        }
    };
    metrics().connection_refused(reason);
}

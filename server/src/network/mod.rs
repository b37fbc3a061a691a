//! Connections: how they are accepted, how many, how long they may be silent, and who is at the other end.
//!
//! A connection is handed to HTTP once its first bytes are there and, with TLS, its handshake is done; until then it costs a
//! task and a place, for [`handshake`](Limits::handshake) at most.

mod accept;
mod connection;
mod places;
mod tls;

use std::{net::SocketAddr, sync::Arc, time::Duration};

pub use self::tls::TlsError;
pub(crate) use self::{accept::Acceptor, connection::Connection, tls::Tls};

/// What connections may be.
#[derive(Debug, Clone)]
pub(crate) struct Limits {
    /// Most at once.
    pub(crate) connections: usize,
    /// Most at once from one address.
    pub(crate) per_address: usize,
    /// How long the handshake and the first bytes may take.
    pub(crate) handshake: Duration,
}

/// The other end of a connection; in the extensions of every request.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    pub(crate) address: SocketAddr,
    /// The DNS names in its certificate, which was verified; none without one.
    pub(crate) certificate: Arc<[String]>,
}

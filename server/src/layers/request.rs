//! The outermost layer: gives a request its number, its span, and refuses browsers from pages that may not call.

use std::{
    net::IpAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use axum::{
    extract::{Request, State},
    middleware::Next,
    response::{IntoResponse as _, Response},
};
use http::{
    HeaderMap, HeaderName, HeaderValue, StatusCode, Uri,
    header::{HOST, ORIGIN},
    uri::Authority,
};
use tracing::{Instrument as _, field::Empty};

use super::Gate;
use crate::network::Peer;

/// The number of a request, which a caller may choose and every answer repeats.
pub(crate) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
const TRACEPARENT: &str = "traceparent";
/// Longest number that a caller may choose, and longest path in a log line.
const LONGEST_ID: usize = 64;
const LONGEST_PATH: usize = 128;

/// The number of a request; in its extensions.
#[derive(Debug, Clone)]
pub(crate) struct RequestId(pub(crate) Arc<str>);

impl RequestId {
    /// The caller's, if it fits, or a new one.
    fn of(headers: &HeaderMap) -> Self {
        let fits = |id: &&str| {
            let plain = |c: u8| c.is_ascii_alphanumeric() || b"._-".contains(&c);
            (1..=LONGEST_ID).contains(&id.len()) && id.bytes().all(plain)
        };
        let own = headers.get(REQUEST_ID).and_then(|id| id.to_str().ok());
        Self(own.filter(fits).map_or_else(Self::new_id, Arc::from))
    }

    /// Unlike that of any other request of this process, and of another by chance only.
    fn new_id() -> Arc<str> {
        static START: std::sync::LazyLock<u64> = std::sync::LazyLock::new(rand::random);
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        format!("{:08x}{number:08x}", *START >> 32).into()
    }
}

/// The trace that a request belongs to, by W3C's `traceparent`.
fn trace_id(headers: &HeaderMap) -> Option<&str> {
    let header = headers.get(TRACEPARENT)?.to_str().ok()?;
    let mut parts = header.split('-');
    let (version, trace, parent) = (parts.next()?, parts.next()?, parts.next()?);
    let hex = |text: &str, length| {
        let lower = |c: u8| c.is_ascii_digit() || (b'a'..=b'f').contains(&c);
        text.len() == length && text.bytes().all(lower) && text.bytes().any(|c| c != b'0')
    };
    let is_trace = version != "ff" && version.len() == 2 && hex(trace, 32) && hex(parent, 16);
    is_trace.then_some(trace)
}

pub(crate) async fn layer(
    State(gate): State<Arc<Gate>>,
    mut request: Request,
    next: Next,
) -> Response {
    let id = RequestId::of(request.headers());
    let path: String = request.uri().path().chars().take(LONGEST_PATH).collect();
    let span = tracing::info_span!(
        "call",
        path,
        request = &*id.0,
        peer = Empty,
        identity = Empty,
        trace = Empty
    );
    if let Some(peer) = request.extensions().get::<Peer>() {
        span.record("peer", tracing::field::display(peer.address));
    }
    if let Some(trace) = trace_id(request.headers()) {
        span.record("trace", trace);
    }
    #[cfg(feature = "otel")]
    crate::telemetry::continue_trace(&span, request.headers());
    let header = HeaderValue::from_str(&id.0);
    request.extensions_mut().insert(id);
    let mut response = if may_come_from(request.headers(), request.uri(), &gate) {
        next.run(request).instrument(span).await
    } else {
        tracing::info!(parent: &span, "a page of another origin was refused");
        StatusCode::FORBIDDEN.into_response()
    };
    if let Ok(header) = header {
        response.headers_mut().insert(REQUEST_ID, header);
    }
    response
}

/// Whether a browser may send this from the page that it is on. Requests of programs have no origin.
///
/// Where the server asks for no credentials, its own name must be an address or `localhost`: a page could otherwise reach a server
/// on the visitor's machine by a name of its own that it has point there.
fn may_come_from(headers: &HeaderMap, uri: &Uri, gate: &Gate) -> bool {
    let Some(origin) = headers.get(ORIGIN) else {
        return true;
    };
    let Ok(origin) = origin.to_str() else {
        return false;
    };
    if gate
        .http
        .allowed_origins
        .iter()
        .any(|allowed| allowed == origin)
    {
        return true;
    }
    let host = headers.get(HOST).and_then(|host| host.to_str().ok());
    let own = uri.authority().map(Authority::as_str).or(host);
    let origin = origin.split_once("://").map(|(_, authority)| authority);
    match (own, origin) {
        (Some(own), Some(origin)) => own == origin && (!gate.is_open() || is_plain(own)),
        _ => false,
    }
}

/// Whether this names the machine by an address, or its own machine by `localhost`.
fn is_plain(authority: &str) -> bool {
    authority.parse::<Authority>().is_ok_and(|authority| {
        let host = authority.host().trim_matches(['[', ']']);
        host == "localhost" || host.parse::<IpAddr>().is_ok()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        identity::{Audit, Directory},
        settings::Settings,
    };

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        pairs
            .iter()
            .map(|&(name, value)| {
                let name = HeaderName::from_static(name);
                (name, value.parse().expect("a value"))
            })
            .collect()
    }

    #[test]
    fn a_browser_comes_from_the_servers_own_pages_or_from_those_that_are_allowed() {
        let gate = |file: Option<&std::path::Path>| {
            let mut http = Settings::default().http;
            http.allowed_origins
                .push("https://console.example".to_owned());
            Gate {
                directory: Arc::new(Directory::open(file).expect("sound")),
                audit: Audit::off(),
                http,
            }
        };
        let folder = tempfile::tempdir().expect("a folder");
        let access = folder.path().join("access.toml");
        std::fs::write(&access, "").expect("written");
        let (open, closed) = (gate(None), gate(Some(&access)));
        let may = |gate: &Gate, host: &str, origin: &str| {
            may_come_from(
                &headers(&[("host", host), ("origin", origin)]),
                &Uri::from_static("/"),
                gate,
            )
        };
        assert!(may(&open, "127.0.0.1:50051", "http://127.0.0.1:50051"));
        assert!(may(&open, "localhost:50051", "http://localhost:50051"));
        assert!(may(&open, "[::1]:50051", "http://[::1]:50051"));
        assert!(may(&open, "127.0.0.1:50051", "https://console.example"));
        assert!(!may(&open, "127.0.0.1:50051", "https://evil.example"));
        assert!(!may(&open, "127.0.0.1:50051", "null"));
        // A name that was pointed at this machine.
        assert!(!may(
            &open,
            "evil.example:50051",
            "http://evil.example:50051"
        ));
        assert!(may(&closed, "robots.example", "https://robots.example"));
        assert!(!may(&closed, "robots.example", "https://evil.example"));
        assert!(may_come_from(
            &HeaderMap::new(),
            &Uri::from_static("/"),
            &open
        ));
    }

    #[test]
    fn numbers_and_traces_are_taken_if_they_are_some() {
        let id = |value: &str| RequestId::of(&headers(&[("x-request-id", value)])).0;
        assert_eq!(&*id("a-1.b_2"), "a-1.b_2");
        assert_ne!(&*id("two words"), "two words");
        assert_ne!(id(&"x".repeat(65)), id(&"x".repeat(65)));
        let trace = "0af7651916cd43dd8448eb211c80319c";
        let parent = |value: String| headers(&[("traceparent", &value)]);
        let sound = parent(format!("00-{trace}-b7ad6b7169203331-01"));
        assert_eq!(trace_id(&sound), Some(trace));
        for bad in [
            format!("ff-{trace}-b7ad6b7169203331-01"),
            format!("00-{}-b7ad6b7169203331-01", "0".repeat(32)),
            format!("00-{trace}-b7ad-01"),
            "00".to_owned(),
        ] {
            assert_eq!(trace_id(&parent(bad)), None);
        }
    }
}

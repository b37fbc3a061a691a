//! What the server's port answers beside gRPC: `/livez`, `/readyz`, `/metrics`; and gRPC-Web, for browsers.

use std::{sync::Arc, time::Duration};

use axum::{
    Router,
    body::Body,
    extract::{Request, State},
    middleware::{Next, from_fn, from_fn_with_state},
    response::{IntoResponse as _, Response},
    routing::get,
};
use http::{
    HeaderName, HeaderValue, Method, StatusCode,
    header::{AUTHORIZATION, CACHE_CONTROL, CONTENT_TYPE, WWW_AUTHENTICATE},
};
use tokio::sync::watch;
use tonic::service::Routes;
use tonic_web::GrpcWebLayer;
use tower_http::cors::{AllowOrigin, CorsLayer};

use crate::{
    error::ServiceError,
    identity::Role,
    layers::{Gate, call, request},
    metrics::{self, metrics},
    network::Peer,
};

/// How long a browser may remember what it may send.
const PREFLIGHT_AGE: Duration = Duration::from_secs(600);

/// Headers of gRPC-Web that browsers send or need to see.
const SENT: [HeaderName; 6] = [
    AUTHORIZATION,
    CONTENT_TYPE,
    HeaderName::from_static("grpc-timeout"),
    HeaderName::from_static("traceparent"),
    HeaderName::from_static("x-grpc-web"),
    HeaderName::from_static("x-user-agent"),
];
const SEEN: [HeaderName; 4] = [
    HeaderName::from_static("grpc-status"),
    HeaderName::from_static("grpc-message"),
    HeaderName::from_static("grpc-status-details-bin"),
    request::REQUEST_ID,
];

/// Everything that the port answers: gRPC `services` under the layers, and the pages beside them. `ready` says whether calls can
/// be answered.
pub(crate) fn router(services: Routes, gate: &Arc<Gate>, ready: watch::Receiver<bool>) -> Router {
    let grpc = services
        .into_axum_router()
        .layer(from_fn_with_state(Arc::clone(gate), call::layer))
        .layer(GrpcWebLayer::new())
        .layer(from_fn(only_grpc));
    Router::new()
        .route("/livez", get(async || "ok\n"))
        .route("/readyz", get(readyz).with_state(ready))
        .route("/metrics", get(show_metrics).with_state(Arc::clone(gate)))
        .fallback_service(grpc)
        .layer(cors(gate))
        .layer(from_fn_with_state(Arc::clone(gate), request::layer))
}

async fn only_grpc(request: Request, next: Next) -> Response {
    let content = request.headers().get(CONTENT_TYPE);
    if content.is_some_and(|content| content.as_bytes().starts_with(b"application/grpc")) {
        next.run(request).await
    } else {
        (StatusCode::NOT_FOUND, "not found\n").into_response()
    }
}

/// What browsers let pages of other origins do. Pages of the server's own origin need none of this.
fn cors(gate: &Gate) -> CorsLayer {
    let origins = gate.http.allowed_origins.iter();
    let origins = origins.filter_map(|origin| HeaderValue::from_str(origin).ok());
    CorsLayer::new()
        .allow_origin(AllowOrigin::list(origins))
        .allow_methods([Method::GET, Method::POST])
        .allow_headers(SENT)
        .expose_headers(SEEN)
        .max_age(PREFLIGHT_AGE)
}

async fn readyz(State(ready): State<watch::Receiver<bool>>) -> Response {
    if *ready.borrow() {
        "ok\n".into_response()
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, "not ready\n").into_response()
    }
}

async fn show_metrics(State(gate): State<Arc<Gate>>, request: Request) -> Response {
    if !gate.http.open_metrics
        && let Some(refusal) = refusal(&gate, &request)
    {
        return refusal;
    }
    let headers = [
        (CONTENT_TYPE, metrics::CONTENT_TYPE),
        (CACHE_CONTROL, "no-store"),
    ];
    (headers, metrics().text()).into_response()
}

/// The answer to who may not see the metrics.
fn refusal(gate: &Gate, request: &Request) -> Option<Response> {
    let peer = request.extensions().get::<Peer>();
    let certificate = peer.map(|peer| &*peer.certificate).unwrap_or_default();
    match gate.directory.find(request.headers(), certificate) {
        Ok(identity) if identity.has(Role::Observer) => None,
        Ok(_) => Some(StatusCode::FORBIDDEN.into_response()),
        Err(error) => Some(unauthorized(&error)),
    }
}

fn unauthorized(error: &ServiceError) -> Response {
    metrics().call_refused(error.reason());
    let mut response = Response::new(Body::from(format!("{error}\n")));
    *response.status_mut() = StatusCode::UNAUTHORIZED;
    response
        .headers_mut()
        .insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    response
}

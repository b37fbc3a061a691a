//! The layer around every gRPC call: whose it is, whether that may call it, quotas, metrics, the audit log.

use std::sync::Arc;

use axum::{
    body::Body,
    extract::{Request, State},
    middleware::Next,
    response::Response,
};
use tonic::Status;

use super::{
    Gate,
    body::{Inbound, Outbound},
    open::Open,
    request::RequestId,
};
use crate::{
    error::ServiceError,
    identity::{
        Caller,
        methods::{self, Needs},
    },
    metrics::metrics,
    network::Peer,
};

pub(crate) async fn layer(
    State(gate): State<Arc<Gate>>,
    mut request: Request,
    next: Next,
) -> Response {
    let open = match admit(&gate, &request) {
        Ok(open) => Arc::new(open),
        Err(error) => return refuse(error),
    };
    tracing::Span::current().record("identity", open.caller.identity.name());
    request.extensions_mut().insert(open.caller.clone());
    let request = request.map(|body| Body::new(Inbound::new(body, &open)));
    let response = next.run(request).await;
    let (parts, body) = response.into_parts();
    let body = Outbound::new(body, open, &parts.headers);
    Response::from_parts(parts, Body::new(body))
}

fn admit(gate: &Gate, request: &Request) -> Result<Open, ServiceError> {
    let extensions = request.extensions();
    let peer = extensions.get::<Peer>();
    let id = extensions.get::<RequestId>();
    let caller = |identity| Caller {
        identity,
        peer: peer.map(|peer| peer.address),
        request: id.map_or_else(|| Arc::from(""), |id| Arc::clone(&id.0)),
        audit: gate.audit.clone(),
    };
    let certificate = peer.map(|peer| &*peer.certificate).unwrap_or_default();
    let method = methods::find(request.uri().path());
    if let Some(method) = method.filter(|method| method.needs == Needs::Nothing) {
        let identity = gate.directory.anonymous();
        let place = identity.enter_call(method.kind)?;
        return Ok(Open::begin(method, caller(identity), place));
    }
    let identity = gate.directory.find(request.headers(), certificate)?;
    let method = method.ok_or(ServiceError::UnknownMethod)?;
    if let Needs::Role(roles) = method.needs
        && !roles.iter().any(|&role| identity.has(role))
    {
        caller(Arc::clone(&identity)).record("refused", serde_json::json!({"method": method.path}));
        let names: Vec<_> = roles.iter().map(|role| role.name()).collect();
        return Err(ServiceError::PermissionDenied {
            name: identity.name().to_owned(),
            what: format!(
                "call {}, which needs role {}",
                method.path,
                names.join(" or ")
            ),
        });
    }
    let place = identity.enter_call(method.kind)?;
    Ok(Open::begin(method, caller(identity), place))
}

fn refuse(error: ServiceError) -> Response {
    metrics().call_refused(error.reason());
    tracing::info!(%error, "call refused");
    Status::from(error).into_http()
}

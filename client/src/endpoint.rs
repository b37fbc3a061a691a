//! How a server is reached: TLS, credentials, and what every call carries.

use std::{fmt, net::IpAddr, sync::Arc, time::Duration};

use http::Uri;
use tonic::{
    Request, Status,
    metadata::{Ascii, MetadataMap, MetadataValue},
    service::{Interceptor, interceptor::InterceptedService},
    transport::{Certificate, ClientTlsConfig, Endpoint, Identity},
};

use crate::ClientError;

/// How long a connection may take to stand.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// A silent connection is asked after this long, and given up when it does not answer in time.
const KEEPALIVE: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(5)];
const AUTHORIZATION: &str = "authorization";

/// A connection whose calls all carry what they should.
pub(crate) type Channel = InterceptedService<tonic::transport::Channel, Metadata>;

/// Credentials, and whom to trust.
#[derive(Clone, Default)]
pub struct ConnectOptions {
    ca: Option<Certificate>,
    identity: Option<Identity>,
    token: Option<String>,
}

impl ConnectOptions {
    /// Trusts servers whose certificate one of these authorities signed, in PEM, instead of the system's.
    #[must_use]
    pub fn with_ca(mut self, pem: impl AsRef<[u8]>) -> Self {
        self.ca = Some(Certificate::from_pem(pem));
        self
    }

    /// Shows the server this certificate, in PEM, as its client.
    #[must_use]
    pub fn with_certificate(
        mut self,
        certificate: impl AsRef<[u8]>,
        key: impl AsRef<[u8]>,
    ) -> Self {
        self.identity = Some(Identity::from_pem(certificate, key));
        self
    }

    /// Sends this token with every call.
    #[must_use]
    pub fn with_token(mut self, token: impl Into<String>) -> Self {
        self.token = Some(token.into());
        self
    }
}

/// Secrets are not shown.
impl fmt::Debug for ConnectOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ConnectOptions")
            .field("ca", &self.ca.is_some())
            .field("certificate", &self.identity.is_some())
            .field("token", &self.token.is_some())
            .finish()
    }
}

type Hook = Arc<dyn Fn(&mut MetadataMap) + Send + Sync>;

/// Adds to the metadata of every call.
#[derive(Clone, Default)]
pub(crate) struct Metadata {
    authorization: Option<MetadataValue<Ascii>>,
    hooks: Vec<Hook>,
}

impl Metadata {
    pub(crate) fn with_hook(
        mut self,
        hook: impl Fn(&mut MetadataMap) + Send + Sync + 'static,
    ) -> Self {
        self.hooks.push(Arc::new(hook));
        self
    }
}

impl Interceptor for Metadata {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        let metadata = request.metadata_mut();
        if let Some(authorization) = &self.authorization {
            metadata.insert(AUTHORIZATION, authorization.clone());
        }
        for hook in &self.hooks {
            hook(metadata);
        }
        Ok(request)
    }
}

/// Connects, and gives what every call is to carry.
pub(crate) async fn connect(
    url: &str,
    options: ConnectOptions,
) -> Result<(tonic::transport::Channel, Metadata), ClientError> {
    let failed = |reason: String| ClientError::Connect {
        url: url.to_owned(),
        reason,
    };
    let cause = |error: tonic::transport::Error| failed(root_cause(&error));
    let uri: Uri = url
        .parse()
        .map_err(|error: http::uri::InvalidUri| failed(error.to_string()))?;
    let is_tls = uri.scheme_str() == Some("https");
    let ConnectOptions {
        ca,
        identity,
        token,
    } = options;
    if !is_tls && (ca.is_some() || identity.is_some()) {
        return Err(failed("certificates need a URL with https".to_owned()));
    }
    if !is_tls && token.is_some() && !is_own_machine(&uri) {
        return Err(failed(
            "a token would go over the network in the clear; expected https".to_owned(),
        ));
    }
    let authorization = token
        .map(|token| MetadataValue::try_from(format!("Bearer {}", token.trim())))
        .transpose()
        .map_err(|_| failed("the token has characters that no token has".to_owned()))?
        .map(|mut value| {
            value.set_sensitive(true);
            value
        });
    let mut endpoint = Endpoint::from(uri)
        .connect_timeout(CONNECT_TIMEOUT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(KEEPALIVE[0])
        .keep_alive_timeout(KEEPALIVE[1])
        .keep_alive_while_idle(true);
    if is_tls {
        endpoint = endpoint.tls_config(tls(ca, identity)).map_err(cause)?;
    }
    let channel = endpoint.connect().await.map_err(cause)?;
    let metadata = Metadata {
        authorization,
        hooks: Vec::new(),
    };
    Ok((channel, metadata))
}

fn tls(ca: Option<Certificate>, identity: Option<Identity>) -> ClientTlsConfig {
    let config = ClientTlsConfig::new();
    let config = match ca {
        Some(ca) => config.ca_certificate(ca),
        None => config.with_native_roots(),
    };
    match identity {
        Some(identity) => config.identity(identity),
        None => config,
    }
}

fn is_own_machine(uri: &Uri) -> bool {
    let host = uri.host().unwrap_or_default().trim_matches(['[', ']']);
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|host| host.is_loopback())
}

/// The last link of an error's chain, which is the system's own word.
fn root_cause(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
}

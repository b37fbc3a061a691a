//! What tests about connections, TLS and identities share: a folder with tokens and certificates, calls of any method, and
//! HTTP/1.1 by hand.

use std::{net::SocketAddr, path::PathBuf, time::Duration};

use anyhow::Context as _;
use emp_server::{AccessFile, CertificateFor, NewIdentity, Role, Settings, make_certificate};
use tempfile::TempDir;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
    sync::mpsc,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    Code, Request, Status, Streaming,
    client::Grpc,
    codegen::http::uri::PathAndQuery,
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity},
};

use crate::{raw::Bytes, within};

/// Days that what tests make is valid.
const DAYS: u32 = 2;

/// A folder with an access file and certificates.
pub struct Folder(TempDir);

impl Folder {
    /// A new one, with an authority and a certificate of the server for `localhost`.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn new() -> anyhow::Result<Self> {
        let folder = Self(TempDir::new()?);
        folder.make_server_certificate()?;
        Ok(folder)
    }

    /// Makes the server's certificate, anew if there is one.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn make_server_certificate(&self) -> anyhow::Result<()> {
        for name in ["server.pem", "server-key.pem"] {
            let _ = std::fs::remove_file(self.path(name));
        }
        let names = ["localhost".to_owned(), "127.0.0.1".to_owned()];
        make_certificate(
            self.0.path(),
            "server",
            &names,
            DAYS,
            CertificateFor::Server,
        )?;
        Ok(())
    }

    /// A file in it.
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// A file's content.
    ///
    /// # Errors
    /// When there is none.
    pub fn read(&self, name: &str) -> anyhow::Result<String> {
        std::fs::read_to_string(self.path(name)).with_context(|| name.to_owned())
    }

    /// Adds an identity with a token, which it gives.
    ///
    /// # Errors
    /// When it is there already.
    pub fn token(&self, name: &str, roles: &[Role], sessions: &[&str]) -> anyhow::Result<String> {
        let new = NewIdentity {
            name: name.to_owned(),
            roles: roles.to_vec(),
            sessions: sessions.iter().map(|&session| session.to_owned()).collect(),
            ..NewIdentity::default()
        };
        self.add(new)?.context("a token")
    }

    /// Adds an identity.
    ///
    /// # Errors
    /// When it is there already.
    pub fn add(&self, new: NewIdentity) -> anyhow::Result<Option<String>> {
        Ok(AccessFile::add(&self.path("access.toml"), new)?)
    }

    /// Takes an identity out.
    ///
    /// # Errors
    /// When it is not there.
    pub fn revoke(&self, name: &str) -> anyhow::Result<()> {
        Ok(AccessFile::revoke(&self.path("access.toml"), name)?)
    }

    /// A client's certificate and key.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn client_certificate(&self, name: &str) -> anyhow::Result<Identity> {
        let names = [name.to_owned()];
        make_certificate(self.0.path(), name, &names, DAYS, CertificateFor::Client)?;
        Ok(Identity::from_pem(
            self.read(&format!("{name}.pem"))?,
            self.read(&format!("{name}-key.pem"))?,
        ))
    }

    /// Settings of a server that asks for credentials.
    pub fn closed(&self, settings: &mut Settings) {
        settings.access.file = Some(self.path("access.toml"));
    }

    /// Settings of a server with TLS.
    pub fn with_tls(&self, settings: &mut Settings) {
        settings.tls.certificate = Some(self.path("server.pem"));
        settings.tls.key = Some(self.path("server-key.pem"));
    }

    /// The endpoint of a server with TLS, for a client that trusts this folder's authority.
    ///
    /// # Errors
    /// When the certificates are none.
    pub fn endpoint(&self, port: u16, identity: Option<Identity>) -> anyhow::Result<Endpoint> {
        let ca = Certificate::from_pem(self.read("ca.pem")?);
        let tls = ClientTlsConfig::new().ca_certificate(ca);
        let tls = match identity {
            Some(identity) => tls.identity(identity),
            None => tls,
        };
        Ok(Endpoint::from_shared(format!("https://localhost:{port}"))?.tls_config(tls)?)
    }
}

/// Calls any method with one empty message and gives the status of its end, or OK when it answers.
///
/// # Errors
/// When there is no answer in time.
pub async fn call(channel: &Channel, path: &str, token: Option<&str>) -> anyhow::Result<Status> {
    call_with(channel, path, token, Vec::new()).await
}

/// [`call`] with a message.
///
/// # Errors
/// When there is no answer in time.
pub async fn call_with(
    channel: &Channel,
    path: &str,
    token: Option<&str>,
    message: Vec<u8>,
) -> anyhow::Result<Status> {
    let mut request = Request::new(tokio_stream::once(message));
    if let Some(token) = token {
        let value = format!("Bearer {token}").parse()?;
        request.metadata_mut().insert("authorization", value);
    }
    let path: PathAndQuery = path.parse()?;
    let mut client = Grpc::new(channel.clone());
    let answer = async {
        client
            .ready()
            .await
            .map_err(|error| Status::unknown(error.to_string()))?;
        let mut answers = client.streaming(request, path, Bytes).await?.into_inner();
        answers.message().await
    };
    Ok(match within("an answer", answer).await? {
        Ok(_) => Status::new(Code::Ok, ""),
        Err(status) => status,
    })
}

/// A stream on which nothing is sent. Dropping it half-closes.
pub struct HeldStream {
    /// What the server says.
    pub answers: Streaming<Vec<u8>>,
    _requests: mpsc::Sender<Vec<u8>>,
}

impl HeldStream {
    /// Opens one and waits for its headers; the inner error is the server's refusal.
    ///
    /// # Errors
    /// When there is no answer in time.
    pub async fn open(
        channel: &Channel,
        path: &str,
        token: Option<&str>,
    ) -> anyhow::Result<Result<Self, Status>> {
        let (requests, messages) = mpsc::channel(1);
        let mut request = Request::new(ReceiverStream::new(messages));
        if let Some(token) = token {
            let value = format!("Bearer {token}").parse()?;
            request.metadata_mut().insert("authorization", value);
        }
        let mut client = Grpc::new(channel.clone());
        client.ready().await?;
        let answers = client.streaming(request, path.parse()?, Bytes);
        let answers = within("the headers", answers).await?;
        Ok(answers.map(|answers| Self {
            answers: answers.into_inner(),
            _requests: requests,
        }))
    }
}

/// Sends bytes over TCP and reads until the other end closes.
///
/// # Errors
/// When it does not.
pub async fn exchange(address: SocketAddr, bytes: &[u8]) -> anyhow::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(bytes).await?;
    let mut answer = Vec::new();
    within("the end of the answer", stream.read_to_end(&mut answer)).await??;
    Ok(answer)
}

/// An answer of HTTP/1.1.
#[derive(Debug)]
pub struct Answer {
    /// The status.
    pub status: u16,
    /// Header lines, names in lower case.
    pub headers: Vec<(String, String)>,
    /// The body, chunks put together.
    pub body: Vec<u8>,
}

impl Answer {
    /// A header's value.
    pub fn header(&self, name: &str) -> Option<&str> {
        let found = self.headers.iter().find(|(found, _)| found == name);
        found.map(|(_, value)| value.as_str())
    }

    /// The body as text.
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }
}

/// Makes one request of HTTP/1.1 by hand.
///
/// # Errors
/// When the answer is none.
pub async fn http(
    address: SocketAddr,
    method: &str,
    path: &str,
    headers: &[(&str, &str)],
    body: &[u8],
) -> anyhow::Result<Answer> {
    let mut request = format!("{method} {path} HTTP/1.1\r\nconnection: close\r\n");
    if !headers.iter().any(|(name, _)| *name == "host") {
        request += &format!("host: {address}\r\n");
    }
    for (name, value) in headers {
        request += &format!("{name}: {value}\r\n");
    }
    request += &format!("content-length: {}\r\n\r\n", body.len());
    let bytes = exchange(address, &[request.as_bytes(), body].concat()).await?;
    parse(&bytes).with_context(|| String::from_utf8_lossy(&bytes).into_owned())
}

fn parse(bytes: &[u8]) -> anyhow::Result<Answer> {
    let end = bytes.windows(4).position(|window| window == b"\r\n\r\n");
    let end = end.context("headers")?;
    let head = std::str::from_utf8(&bytes[..end])?;
    let mut lines = head.split("\r\n");
    let status = lines.next().and_then(|line| line.split(' ').nth(1));
    let headers: Vec<_> = lines
        .filter_map(|line| line.split_once(": "))
        .map(|(name, value)| (name.to_ascii_lowercase(), value.to_owned()))
        .collect();
    let chunked = headers
        .iter()
        .any(|(name, value)| name == "transfer-encoding" && value == "chunked");
    let rest = &bytes[end + 4..];
    Ok(Answer {
        status: status.context("a status")?.parse()?,
        headers,
        body: if chunked {
            unchunk(rest)?
        } else {
            rest.to_vec()
        },
    })
}

fn unchunk(mut rest: &[u8]) -> anyhow::Result<Vec<u8>> {
    let mut body = Vec::new();
    loop {
        let end = rest.windows(2).position(|window| window == b"\r\n");
        let end = end.context("a chunk's length")?;
        let length = usize::from_str_radix(std::str::from_utf8(&rest[..end])?, 16)?;
        if length == 0 {
            return Ok(body);
        }
        let chunk = rest.get(end + 2..end + 2 + length).context("a chunk")?;
        body.extend_from_slice(chunk);
        rest = &rest[end + 4 + length..];
    }
}

/// Waits until something holds.
///
/// # Errors
/// When it does not for too long.
pub async fn until(what: &str, mut holds: impl AsyncFnMut() -> bool) -> anyhow::Result<()> {
    within(what, async {
        while !holds().await {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await
}

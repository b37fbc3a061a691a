//! The server around the services: listening, health, reflection, files that are read again, and the end.

use std::{
    collections::BTreeSet,
    net::SocketAddr,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use emp_proto::{
    FILE_DESCRIPTOR_SET,
    v1::{
        model_service_server::ModelServiceServer, motion_service_server::MotionServiceServer,
        rollout_service_server::RolloutServiceServer,
    },
};
use tokio::{
    net::TcpListener,
    sync::{Notify, watch},
    time::timeout,
};
use tokio_stream::{StreamExt as _, StreamMap, wrappers::WatchStream};
use tokio_util::sync::CancellationToken;
use tonic::{service::Routes, transport::Server as Transport};
use tonic_health::{ServingStatus, server::HealthReporter};

use crate::{
    batcher::ModelState,
    catalog::Catalog,
    http,
    identity::{AccessError, Audit, Directory},
    layers::Gate,
    models::Models,
    motion::Motion,
    network::{Acceptor, Limits, Tls, TlsError},
    reload::{self, Watched},
    rollouts::Rollouts,
    settings::{Settings, SettingsError},
};

/// Names of the services in `grpc.health.v1`; the empty one is the whole server.
const MOTION: &str = "emp.v1.MotionService";
const MODELS: &str = "emp.v1.ModelService";
const ROLLOUTS: &str = "emp.v1.RolloutService";
const WHOLE: &str = "";
const HEALTH: [&str; 4] = [WHOLE, MOTION, MODELS, ROLLOUTS];

/// A silent connection is asked after this long, and closed when it does not answer in time.
const KEEPALIVE: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(5)];
/// Largest message that is about single frames: one pose takes about 200 bytes, fifteen robot states 4 KiB.
const MAX_MESSAGE: usize = 256 << 10;
/// Largest message of jobs: parts of motions, policies.
const MAX_JOB_MESSAGE: usize = 16 << 20;
/// Streams that a client may reset before they were accepted. h2's own 20 is too few for a client that cancels many
/// calls at once; it would lose its connection.
const MAX_RESETS: usize = 1_000;
/// Most bytes of a request's headers.
const MAX_HEADERS: u32 = 16 << 10;

/// A server that listens and is ready to run.
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    catalog: Arc<Catalog>,
    settings: Settings,
    tls: Option<Arc<Tls>>,
    directory: Arc<Directory>,
    audit: Audit,
    reload: Arc<Notify>,
}

/// Why the server could not start or had to stop.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address cannot be listened on.
    #[error("listen on {address}: {reason}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        reason: std::io::Error,
    },
    /// The settings ask for what is not safe.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A certificate or key cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The access file cannot be used.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// The audit log cannot be written.
    #[error("audit log {}: {reason}", path.display())]
    Audit {
        /// Its file.
        path: PathBuf,
        /// The system's reason.
        reason: std::io::Error,
    },
    /// The descriptors do not make a reflection service.
    #[error("reflection: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// The transport failed.
    #[error("transport: {0}")]
    Transport(#[from] tonic::transport::Error),
}

/// How a server ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drain {
    /// Every call ended by itself.
    Complete,
    /// The grace time ran out with calls still open; they were cut off.
    CutOff,
}

impl Server {
    /// Binds the address of the settings; port 0 takes a free one.
    ///
    /// # Errors
    /// When the address is taken, not this machine's, or other machines reach it without TLS and identities; or when a file
    /// that the settings name cannot be used.
    pub async fn bind(settings: Settings, catalog: Catalog) -> Result<Self, ServeError> {
        settings.check_exposure()?;
        let tls = Tls::open(&settings.tls)?;
        let directory = Arc::new(Directory::open(settings.access.file.as_deref())?);
        let audit = open_audit(settings.access.audit.as_deref())?;
        let address = settings.listen;
        let listening = async {
            let listener = TcpListener::bind(address).await?;
            let address = listener.local_addr()?;
            Ok((listener, address))
        };
        let (listener, address) = listening
            .await
            .map_err(|reason| ServeError::Listen { address, reason })?;
        Ok(Self {
            listener,
            address,
            catalog: Arc::new(catalog),
            settings,
            tls,
            directory,
            audit,
            reload: Arc::new(Notify::new()),
        })
    }

    /// Notified, the running server reads its certificates and identities again, and opens its audit log anew.
    pub fn reload(&self) -> Arc<Notify> {
        Arc::clone(&self.reload)
    }

    /// The address that clients reach.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves until `shutdown` is cancelled; then streams answer what waits and end, and after the grace time
    /// whatever is left is cut off.
    ///
    /// # Errors
    /// When the transport fails.
    pub async fn run(self, shutdown: CancellationToken) -> Result<Drain, ServeError> {
        let (reporter, health) = tonic_health::server::health_reporter();
        for service in HEALTH {
            reporter
                .set_service_status(service, ServingStatus::Serving)
                .await;
        }
        let (ready, is_ready) = watch::channel(true);
        tokio::spawn(report_models(
            Arc::clone(&self.catalog),
            reporter.clone(),
            ready,
            shutdown.clone(),
        ));
        tokio::spawn(reload::watch(
            self.watched(),
            self.reload(),
            shutdown.clone(),
        ));

        let reflect = || {
            tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
                // So that grpcurl can print the details of an error.
                .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET)
        };
        let motion = Motion::new(Arc::clone(&self.catalog), &self.settings, shutdown.clone());
        let models = Models::new(Arc::clone(&self.catalog));
        let rollouts = Rollouts::new(
            Arc::clone(&self.catalog),
            &self.settings.rollouts,
            shutdown.clone(),
        );
        let services = Routes::new(health)
            .add_service(reflect().build_v1()?)
            .add_service(reflect().build_v1alpha()?)
            .add_service(MotionServiceServer::new(motion).max_decoding_message_size(MAX_MESSAGE))
            .add_service(ModelServiceServer::new(models).max_decoding_message_size(MAX_MESSAGE))
            .add_service(
                RolloutServiceServer::new(rollouts).max_decoding_message_size(MAX_JOB_MESSAGE),
            );
        let audit = self.audit.clone();
        let gate = Arc::new(Gate {
            directory: Arc::clone(&self.directory),
            audit: self.audit.clone(),
            http: self.settings.http.clone(),
        });
        let connections = &self.settings.connections;
        let limits = Limits {
            connections: connections.max.get(),
            per_address: connections.max_per_address.get(),
            handshake: Duration::try_from_secs_f64(connections.handshake_seconds)
                .unwrap_or_default(),
        };
        let incoming = Acceptor::new(self.listener, self.tls, limits).start(shutdown.clone());
        let serving = Transport::builder()
            .accept_http1(true)
            .max_concurrent_streams(connections.max_streams.get())
            .http2_max_header_list_size(MAX_HEADERS)
            .http2_keepalive_interval(Some(KEEPALIVE[0]))
            .http2_keepalive_timeout(Some(KEEPALIVE[1]))
            .http2_max_pending_accept_reset_streams(Some(MAX_RESETS))
            .serve_with_incoming_shutdown(
                http::router(services, &gate, is_ready),
                incoming,
                shutdown.clone().cancelled_owned(),
            );
        tokio::pin!(serving);

        tokio::select! {
            ended = &mut serving => return ended.map(|()| Drain::Complete).map_err(Into::into),
            () = shutdown.cancelled() => {}
        }
        tracing::info!(grace = ?self.settings.grace(), "draining");
        close_health(reporter).await;
        let ended = timeout(self.settings.grace(), serving).await;
        tokio::task::spawn_blocking(move || audit.flush())
            .await
            .unwrap_or_default();
        match ended {
            Ok(ended) => ended.map(|()| Drain::Complete).map_err(Into::into),
            Err(_) => Ok(Drain::CutOff),
        }
    }

    /// What is read again while the server runs.
    fn watched(&self) -> Vec<Watched> {
        let tls_files = &self.settings.tls;
        let files = [&tls_files.certificate, &tls_files.key, &tls_files.client_ca];
        let tls = self.tls.clone();
        let directory = Arc::clone(&self.directory);
        let audit = self.audit.clone();
        vec![
            Watched {
                what: "certificates",
                files: files.into_iter().flatten().cloned().collect(),
                reload: Box::new(move || match &tls {
                    Some(tls) => tls.reload().map_err(|error| error.to_string()),
                    None => Ok(()),
                }),
            },
            Watched {
                what: "access",
                files: self.settings.access.file.iter().cloned().collect(),
                reload: Box::new(move || directory.reload().map_err(|error| error.to_string())),
            },
            // Opened anew when told to; the file itself changes all the time.
            Watched {
                what: "audit",
                files: Vec::new(),
                reload: Box::new(move || {
                    audit.reopen();
                    Ok(())
                }),
            },
        ]
    }
}

fn open_audit(path: Option<&Path>) -> Result<Audit, ServeError> {
    let Some(path) = path else {
        return Ok(Audit::off());
    };
    Audit::open(path).map_err(|reason| ServeError::Audit {
        path: path.to_owned(),
        reason,
    })
}

/// Keeps the motion service's health at that of its models, until the server shuts down.
async fn report_models(
    catalog: Arc<Catalog>,
    reporter: HealthReporter,
    ready: watch::Sender<bool>,
    shutdown: CancellationToken,
) {
    let mut changes: StreamMap<_, _> = catalog
        .states()
        .into_iter()
        .map(|(name, state)| (name, WatchStream::new(state)))
        .collect();
    let mut failed = BTreeSet::new();
    let mut reported = ServingStatus::Serving;
    loop {
        let (model, state) = tokio::select! {
            biased;
            () = shutdown.cancelled() => {
                ready.send_replace(false);
                return;
            }
            Some(change) = changes.next() => change,
        };
        match state {
            ModelState::Serving => failed.remove(&model),
            ModelState::Rebuilding => failed.insert(model),
        };
        let status = if failed.is_empty() {
            ServingStatus::Serving
        } else {
            ServingStatus::NotServing
        };
        // Those who watch are told of every report, changed or not.
        if status != reported {
            reporter.set_service_status(MOTION, status).await;
            ready.send_replace(status == ServingStatus::Serving);
            reported = status;
        }
    }
}

/// Tells those who watch that the server goes, and ends their watches, which would hold it up otherwise.
async fn close_health(mut reporter: HealthReporter) {
    for service in HEALTH {
        reporter
            .set_service_status(service, ServingStatus::NotServing)
            .await;
        reporter.clear_service_status(service).await;
    }
}

//! The server around the services: listening, health, reflection, and the end.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use emp_proto::{
    FILE_DESCRIPTOR_SET,
    v1::{
        model_service_server::ModelServiceServer, motion_service_server::MotionServiceServer,
        rollout_service_server::RolloutServiceServer,
        teleoperation_service_server::TeleoperationServiceServer,
    },
};
use tokio::{net::TcpListener, time::timeout};
use tokio_util::sync::CancellationToken;
use tonic::transport::{Server as Transport, server::TcpIncoming};

use crate::{
    catalog::Catalog,
    health,
    services::{
        MAX_JOB_MESSAGE, MAX_MESSAGE, model::Models, motion::Motion, rollout::Rollouts,
        teleoperation::Teleoperation,
    },
    settings::Settings,
    streams::Streams,
};

/// A silent connection is asked after this long, and closed when it does not answer in time.
const KEEPALIVE: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(5)];
/// Streams that a client may reset before they were accepted. h2's own 20 is too few for a client that cancels many
/// calls at once; it would lose its connection.
const MAX_RESETS: usize = 1_000;

/// A server that listens and is ready to run.
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    catalog: Arc<Catalog>,
    settings: Settings,
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
    /// When the address is taken or not this machine's.
    pub async fn bind(settings: Settings, catalog: Catalog) -> Result<Self, ServeError> {
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
        })
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
        let reported = health::begin(&self.catalog, &reporter).await;
        tokio::spawn(health::report(
            reported,
            Arc::clone(&self.catalog),
            reporter.clone(),
            shutdown.clone(),
        ));

        let reflect = || {
            tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
                // So that grpcurl can print the details of an error.
                .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET)
        };
        let catalog = || Arc::clone(&self.catalog);
        let streams = Arc::new(Streams::new(catalog(), &self.settings, shutdown.clone()));
        let motion = Motion::new(catalog(), Arc::clone(&streams));
        let models = Models::new(catalog(), &self.settings, streams.drain().clone());
        let teleoperation = Teleoperation::new(catalog(), &self.settings, streams);
        let rollouts = Rollouts::new(catalog(), &self.settings, shutdown.clone());
        let incoming = TcpIncoming::from(self.listener).with_nodelay(Some(true));
        let serving = Transport::builder()
            .trace_fn(|request| tracing::info_span!("call", path = request.uri().path()))
            .http2_keepalive_interval(Some(KEEPALIVE[0]))
            .http2_keepalive_timeout(Some(KEEPALIVE[1]))
            .http2_max_pending_accept_reset_streams(Some(MAX_RESETS))
            .add_service(health)
            .add_service(reflect().build_v1()?)
            .add_service(reflect().build_v1alpha()?)
            .add_service(MotionServiceServer::new(motion).max_decoding_message_size(MAX_MESSAGE))
            .add_service(
                TeleoperationServiceServer::new(teleoperation)
                    .max_decoding_message_size(MAX_MESSAGE),
            )
            .add_service(ModelServiceServer::new(models).max_decoding_message_size(MAX_MESSAGE))
            .add_service(
                RolloutServiceServer::new(rollouts).max_decoding_message_size(MAX_JOB_MESSAGE),
            )
            .serve_with_incoming_shutdown(incoming, shutdown.clone().cancelled_owned());
        tokio::pin!(serving);

        tokio::select! {
            ended = &mut serving => return ended.map(|()| Drain::Complete).map_err(Into::into),
            () = shutdown.cancelled() => {}
        }
        tracing::info!(grace = ?self.settings.grace(), "draining");
        health::close(&self.catalog, reporter).await;
        match timeout(self.settings.grace(), serving).await {
            Ok(ended) => ended.map(|()| Drain::Complete).map_err(Into::into),
            Err(_) => Ok(Drain::CutOff),
        }
    }
}

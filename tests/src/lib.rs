//! What the end-to-end tests share: servers to start and kill, models under a test's control, poses, binaries.
//!
//! The tests themselves are in `tests/`. A server runs on a runtime of its own, so that killing it closes its
//! connections as a crash would. This crate is for tests and benchmarks only; no other crate may depend on it.

#![forbid(unsafe_code)]

pub mod emp;
pub mod fake;
pub mod fuzz;
pub mod load;
pub mod policy;
pub mod process;
pub mod raw;

use std::{
    future::Future,
    net::SocketAddr,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use anyhow::Context as _;
use emp_motion::{KeyNodeFrame, skills};
use emp_proto::v1::motion_service_client::MotionServiceClient;
use emp_robot::Robot;
use emp_server::{Catalog, Drain, Overrides, ServeError, Server, Settings};
use tokio::{runtime::Runtime, task::JoinHandle};
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

/// No step of a test takes this long on a slow machine; one that does hangs.
const PATIENCE: Duration = Duration::from_secs(60);

/// A server inside the test's process.
pub struct TestServer {
    address: SocketAddr,
    shutdown: CancellationToken,
    running: Option<JoinHandle<Result<Drain, ServeError>>>,
    runtime: Option<Runtime>,
}

impl TestServer {
    /// Starts a server on a free loopback port.
    ///
    /// # Errors
    /// When it cannot listen.
    pub fn start(settings: Settings, catalog: Catalog) -> anyhow::Result<Self> {
        Self::start_on(0, settings, catalog)
    }

    /// Starts a server on a port.
    ///
    /// # Errors
    /// When it cannot listen.
    pub fn start_on(port: u16, mut settings: Settings, catalog: Catalog) -> anyhow::Result<Self> {
        settings.listen = SocketAddr::from(([127, 0, 0, 1], port));
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()?;
        let shutdown = CancellationToken::new();
        let (bound_sender, bound) = std::sync::mpsc::sync_channel(1);
        let stop = shutdown.clone();
        let running = runtime.spawn(async move {
            match Server::bind(settings, catalog).await {
                Ok(server) => {
                    let _ = bound_sender.send(Ok(server.address()));
                    server.run(stop).await
                }
                Err(error) => {
                    let _ = bound_sender.send(Err(error.to_string()));
                    Ok(Drain::Complete)
                }
            }
        });
        let address = bound.recv()?.map_err(anyhow::Error::msg)?;
        Ok(Self {
            address,
            shutdown,
            running: Some(running),
            runtime: Some(runtime),
        })
    }

    /// Starts a server as it ships, with the robots and weights of the checkout.
    ///
    /// # Errors
    /// When nothing can be served.
    pub fn start_real() -> anyhow::Result<Self> {
        Self::start_with(&weights()?, |_| {})
    }

    /// Starts a server with the robots of the checkout and the weights of a folder, its settings changed by `change`.
    ///
    /// # Errors
    /// When nothing can be served.
    pub fn start_with(weights: &Path, change: impl FnOnce(&mut Settings)) -> anyhow::Result<Self> {
        Self::start_with_on(0, weights, change)
    }

    /// [`start_with`](Self::start_with) on a port.
    ///
    /// # Errors
    /// When it cannot listen, or nothing can be served.
    pub fn start_with_on(
        port: u16,
        weights: &Path,
        change: impl FnOnce(&mut Settings),
    ) -> anyhow::Result<Self> {
        let mut settings = Settings {
            weights: Some(weights.to_owned()),
            ..settings()?
        };
        change(&mut settings);
        let catalog = Catalog::load(&settings)?;
        Self::start_on(port, settings, catalog)
    }

    /// The server's URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// The server's port.
    pub fn port(&self) -> u16 {
        self.address.port()
    }

    /// A client without the client library's care.
    ///
    /// # Errors
    /// When it cannot connect.
    pub async fn raw_client(&self) -> anyhow::Result<MotionServiceClient<Channel>> {
        Ok(MotionServiceClient::connect(self.url()).await?)
    }

    /// Tells the server to drain, as SIGTERM does.
    pub fn begin_shutdown(&self) {
        self.shutdown.cancel();
    }

    /// Waits until a server that was told to drain has ended.
    ///
    /// # Errors
    /// When it failed.
    pub async fn ended(mut self) -> anyhow::Result<Drain> {
        let running = self.running.take().context("a server that runs")?;
        Ok(within("the server's end", running).await???)
    }

    /// Ends the server as a crash would: connections break in the middle of what they do.
    pub fn kill(self) {
        drop(self);
    }
}

impl Drop for TestServer {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // A runtime must not be dropped, and so waited for, inside another.
            runtime.shutdown_background();
        }
    }
}

/// The checkout's root.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .map_or_else(PathBuf::new, Path::to_owned)
}

fn settings() -> anyhow::Result<Settings> {
    let robots = Some(root().join("robots"));
    Ok(Settings::load(
        None,
        Overrides {
            robots,
            ..Overrides::default()
        },
    )?)
}

/// The folder of the weights: the checkout's, unless the environment names another for the server.
///
/// # Errors
/// When the server's environment variables are wrong.
pub fn weights() -> anyhow::Result<PathBuf> {
    Ok(settings()?
        .weights
        .unwrap_or_else(|| root().join("models/weights")))
}

/// The robot that ships with the project.
///
/// # Errors
/// When its files are broken.
pub fn emp27() -> anyhow::Result<Arc<Robot>> {
    Ok(Arc::new(Robot::load(&root().join("robots/emp27"))?))
}

/// Poses of a procedural motion at 50 Hz, the same for the same seed.
pub fn poses(seed: u64, count: usize) -> Vec<KeyNodeFrame> {
    skills::medley(seed)
        .resampled(50.0)
        .expect("an ordinary rate")
        .frames
        .into_iter()
        .cycle()
        .take(count)
        .collect()
}

/// Compares numbers one by one.
///
/// # Panics
/// When two differ by more than `tolerance`.
pub fn assert_near(a: &[f32], b: &[f32], tolerance: f32) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        assert!((a - b).abs() <= tolerance, "{a} {b}");
    }
}

/// Waits for a step of a test, but not forever.
///
/// # Errors
/// When the step takes longer than any machine should need.
pub async fn within<T>(what: &str, step: impl Future<Output = T>) -> anyhow::Result<T> {
    tokio::time::timeout(PATIENCE, step)
        .await
        .with_context(|| format!("still waiting for {what}"))
}

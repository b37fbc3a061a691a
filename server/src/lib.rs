//! The gRPC server: it takes human poses and robot states off the wire, brings them to the models in batches, and sends
//! joint targets back.
//!
//! Every request passes the `layers`, which know who calls (`identity`); connections are accepted, and their number and silence
//! bounded, in `network`. Evaluations and rollouts are jobs (`rollouts`) on threads of their own, behind every stream.
//!
//! Transport (`motion`, `models`, `rollouts`, `session`) knows messages and deadlines; the core (`batcher`, `queue`) knows neither; a model
//! is known only through [`Backend`]. Statuses are made in `error` and nowhere else. This crate never computes a joint
//! angle itself, and it runs no model and no foreign code on a tokio thread.

#![forbid(unsafe_code)]

mod backend;
mod batcher;
mod catalog;
mod certificates;
mod check;
mod control;
mod deadline;
mod error;
mod http;
mod identity;
mod layers;
mod lines;
mod logging;
mod metrics;
mod models;
mod motion;
mod network;
mod pose;
mod queue;
mod reload;
mod robot_state;
mod rollouts;
mod serve;
mod session;
mod settings;
#[cfg(feature = "otel")]
mod telemetry;
mod teleoperation;
mod wire;

pub use backend::{Backend, BackendError, BoxedBackend, Build, RetargetBackend};
pub use catalog::{Catalog, CatalogError};
pub use certificates::{CertificateFiles, CertificateFor, make_certificate};
pub use identity::{AccessError, AccessFile, NewIdentity, Role};
pub use logging::Log;
pub use network::TlsError;
pub use serve::{Drain, ServeError, Server};
pub use settings::{
    AccessSettings, BatchingSettings, ClientCertificates, ConnectionSettings, DEFAULT_SETTINGS,
    HttpSettings, LogFormat, LogSettings, Overrides, RolloutSettings, Settings, SettingsError,
    ShutdownSettings, StreamSettings, TeleoperationSettings, TlsSettings,
};

//! The gRPC server: it takes human poses and robot states off the wire, brings them to the models in batches, and sends
//! joint targets back.
//!
//! Evaluations and rollouts are jobs (`rollouts`) on threads of their own, behind every stream.
//!
//! Transport (`motion`, `models`, `rollouts`, `session`) knows messages and deadlines; the core (`batcher`, `queue`) knows neither; a model
//! is known only through [`Backend`]. Statuses are made in `error` and nowhere else. This crate never computes a joint
//! angle itself, and it runs no model and no foreign code on a tokio thread.

#![forbid(unsafe_code)]

mod backend;
mod batcher;
mod catalog;
mod check;
mod control;
mod deadline;
mod error;
mod models;
mod motion;
mod pose;
mod queue;
mod robot_state;
mod rollouts;
mod serve;
mod session;
mod settings;
mod teleoperation;
mod wire;

pub use backend::{Backend, BackendError, BoxedBackend, Build, RetargetBackend};
pub use catalog::{Catalog, CatalogError};
pub use serve::{Drain, ServeError, Server};
pub use settings::{
    BatchingSettings, DEFAULT_SETTINGS, LogFormat, LogSettings, Overrides, RolloutSettings,
    Settings, SettingsError, ShutdownSettings, StreamSettings, TeleoperationSettings,
};

//! The gRPC server: it takes human poses and robot states off the wire, brings them to the models in batches, and sends
//! joint targets back.
//!
//! Evaluations and rollouts are jobs (`rollouts`) on threads of their own, behind every stream.
//!
//! `services` has what each call does. Messages become the server's own values in `decode` and nowhere else, and values messages in
//! `encode`. Streams with one model live in `session`, a robot's and its person's in `teleoperation`, jobs in `rollouts`. They bring
//! work to models through `inference`, which knows no message; a model is known only through [`Backend`]. Statuses are made in
//! `error` and nowhere else. This crate never computes a joint angle itself, and it runs no model and no foreign code on a tokio
//! thread.

#![forbid(unsafe_code)]

mod catalog;
mod decode;
mod dropped;
mod encode;
mod error;
mod health;
mod inference;
mod rollouts;
mod serve;
mod services;
mod session;
mod settings;
mod streams;
mod teleoperation;

pub use catalog::{Catalog, CatalogError};
pub use inference::backend::{Backend, BackendError, BoxedBackend, Build, RetargetBackend};
pub use serve::{Drain, ServeError, Server};
pub use settings::{
    BatchingSettings, DEFAULT_SETTINGS, LogFormat, LogSettings, Overrides, RolloutSettings,
    Settings, SettingsError, ShutdownSettings, StreamSettings, TeleoperationSettings,
};

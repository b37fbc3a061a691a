//! The server's settings: an embedded default, then a file, then the environment, then flags.

use std::{
    net::SocketAddr,
    num::{NonZeroU32, NonZeroUsize},
    path::{Path, PathBuf},
    time::Duration,
};

use config::{Config, ConfigError, Environment, File, FileFormat};
use emp_models::guard::GuardSettings;
use serde::Deserialize;

/// The shipped defaults, comments included.
pub const DEFAULT_SETTINGS: &str = include_str!("default.toml");

/// Bounds of how long a guard may wait or take, seconds.
const SHORTEST_WAIT: f64 = 0.05;
const LONGEST_WAIT: f64 = 60.0;

/// Every setting. What each means and its default: [`DEFAULT_SETTINGS`].
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Address and port to listen on.
    pub listen: SocketAddr,
    /// The folder with one folder a robot.
    pub robots: Option<PathBuf>,
    /// The folder with the weights.
    pub weights: Option<PathBuf>,
    /// Logging.
    pub log: LogSettings,
    /// Connections.
    pub connections: ConnectionSettings,
    /// TLS.
    pub tls: TlsSettings,
    /// Who may use the server.
    pub access: AccessSettings,
    /// Browsers and monitoring.
    pub http: HttpSettings,
    /// How frames meet models.
    pub batching: BatchingSettings,
    /// Open streams.
    pub streams: StreamSettings,
    /// The guards around a robot that is teleoperated.
    pub teleoperation: TeleoperationSettings,
    /// Evaluations and rollouts.
    pub rollouts: RolloutSettings,
    /// The end.
    pub shutdown: ShutdownSettings,
}

/// Logging.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogSettings {
    /// Form of a line.
    pub format: LogFormat,
    /// Filter, in tracing's form.
    pub filter: String,
    /// Most lines a second, of warnings and errors and of all others; five seconds' worth may come at once.
    pub lines_per_second: NonZeroU32,
}

/// Connections.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConnectionSettings {
    /// Most open connections.
    pub max: NonZeroUsize,
    /// Most open connections from one address.
    pub max_per_address: NonZeroUsize,
    /// Most calls that are open on one connection.
    pub max_streams: NonZeroU32,
    /// How long a connection may take until it begins to speak, TLS included, seconds.
    pub handshake_seconds: f64,
}

/// TLS. Without a certificate the server speaks in the clear.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsSettings {
    /// PEM file with the server's certificate and those that lead to its authority.
    pub certificate: Option<PathBuf>,
    /// PEM file with the certificate's private key.
    pub key: Option<PathBuf>,
    /// PEM file with the authorities of client certificates.
    pub client_ca: Option<PathBuf>,
    /// Whether a client must have a certificate.
    pub client_certificates: ClientCertificates,
}

/// Whether a client must have a certificate, where there are authorities for them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClientCertificates {
    /// A token does, too.
    Optional,
    /// A connection without one is refused.
    Required,
}

impl TlsSettings {
    fn check(&self) -> Result<(), SettingsError> {
        let pairs = [
            ("tls.certificate", &self.certificate, "tls.key", &self.key),
            ("tls.key", &self.key, "tls.certificate", &self.certificate),
            (
                "tls.client_ca",
                &self.client_ca,
                "tls.certificate",
                &self.certificate,
            ),
        ];
        for (key, value, needed, other) in pairs {
            if value.is_some() && other.is_none() {
                return Err(SettingsError::Incomplete { key, needed });
            }
        }
        Ok(())
    }
}

/// Who may use the server.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AccessSettings {
    /// The file with identities and their roles. Without one, whoever reaches the server may do everything.
    pub file: Option<PathBuf>,
    /// The file that is appended to when somebody does something that matters.
    pub audit: Option<PathBuf>,
    /// Whether to listen for other machines even without TLS and identities.
    pub insecure: bool,
}

/// Browsers and monitoring.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HttpSettings {
    /// Origins of pages that may call the server from a browser, beside those that it serves itself.
    pub allowed_origins: Vec<String>,
    /// Whether /metrics asks for no credentials.
    pub open_metrics: bool,
}

/// Form of a log line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

impl LogFormat {
    fn name(self) -> &'static str {
        match self {
            Self::Text => "text",
            Self::Json => "json",
        }
    }
}

/// How frames meet models.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchingSettings {
    /// Most frames in one batch.
    pub max_batch: NonZeroUsize,
    /// Most frames, and most unary calls, that wait for a model.
    pub queue: NonZeroUsize,
}

/// Open streams.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StreamSettings {
    /// Most open streams.
    pub max_open: NonZeroUsize,
    /// Most frames of one stream that wait inside the server.
    pub buffer: NonZeroUsize,
}

/// The guards around a robot that is teleoperated.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TeleoperationSettings {
    /// How long a blend takes at least, seconds.
    pub ramp_seconds: f64,
    /// Age at which a pose is stale, seconds.
    pub stale_after: f64,
    /// Age of the pose at which the robot returns to its default pose, seconds.
    pub return_after: f64,
}

impl TeleoperationSettings {
    /// As the guards take them; values that are out of range, which settings that were loaded never are, become zero.
    pub(crate) fn guard(&self) -> GuardSettings {
        let seconds = |seconds| Duration::try_from_secs_f64(seconds).unwrap_or_default();
        GuardSettings {
            ramp: seconds(self.ramp_seconds),
            stale_after: seconds(self.stale_after),
            return_after: seconds(self.return_after),
        }
    }

    fn check(&self) -> Result<(), SettingsError> {
        let Self {
            ramp_seconds,
            stale_after,
            return_after,
        } = *self;
        let checks = [
            (
                "teleoperation.ramp_seconds",
                ramp_seconds,
                0.0..=LONGEST_WAIT,
                "0 to 60 seconds",
            ),
            (
                "teleoperation.stale_after",
                stale_after,
                SHORTEST_WAIT..=LONGEST_WAIT,
                "0.05 to 60 seconds",
            ),
            (
                "teleoperation.return_after",
                return_after,
                stale_after..=f64::MAX,
                "at least teleoperation.stale_after",
            ),
        ];
        for (key, found, range, expected) in checks {
            if !range.contains(&found) || Duration::try_from_secs_f64(found).is_err() {
                return Err(SettingsError::Range {
                    key,
                    found: found.to_string(),
                    expected,
                });
            }
        }
        Ok(())
    }
}

/// Evaluations and rollouts.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RolloutSettings {
    /// Most jobs at once.
    pub max_jobs: NonZeroUsize,
    /// Threads of each job; 0 for one a core.
    pub threads: usize,
    /// Most frames of motion that a call may send.
    pub max_frames: NonZeroUsize,
}

/// The end.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShutdownSettings {
    /// How long open calls may take to finish, seconds.
    pub grace_seconds: f64,
}

/// What a command line sets; what it leaves out stays.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// See [`Settings::listen`].
    pub listen: Option<String>,
    /// See [`Settings::robots`].
    pub robots: Option<PathBuf>,
    /// See [`Settings::weights`].
    pub weights: Option<PathBuf>,
    /// See [`LogSettings::format`].
    pub log_format: Option<LogFormat>,
    /// See [`LogSettings::filter`].
    pub log_filter: Option<String>,
    /// See [`TlsSettings::certificate`].
    pub tls_certificate: Option<PathBuf>,
    /// See [`TlsSettings::key`].
    pub tls_key: Option<PathBuf>,
    /// See [`AccessSettings::file`].
    pub access: Option<PathBuf>,
    /// See [`AccessSettings::insecure`].
    pub insecure: Option<bool>,
}

/// Settings that cannot be used; the message names the key and where it was set.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// A source cannot be read, or a value has the wrong type or name.
    #[error("settings: {0}")]
    Source(#[from] ConfigError),
    /// A value is out of range.
    #[error("settings: {key} is {found}; expected {expected}")]
    Range {
        /// The key.
        key: &'static str,
        /// Its value.
        found: String,
        /// What would do.
        expected: &'static str,
    },
    /// A setting needs another.
    #[error("settings: {key} is set without {needed}")]
    Incomplete {
        /// The key that is set.
        key: &'static str,
        /// The key that is not.
        needed: &'static str,
    },
    /// Other machines could reach a server that asks them for nothing.
    #[error(
        "settings: listen is {address}, which other machines reach, without {missing}; set what is missing (see \
         `emp-server cert` and `emp-server token add`), listen on 127.0.0.1, or say --insecure"
    )]
    Exposed {
        /// The address.
        address: SocketAddr,
        /// What is missing.
        missing: &'static str,
    },
}

impl Settings {
    /// Layers the defaults, the file, the process's environment (`EMP_SERVER__…`) and the flags.
    ///
    /// # Errors
    /// When a source cannot be read, has an unknown key, or a value is of the wrong type or out of range.
    pub fn load(file: Option<&Path>, overrides: Overrides) -> Result<Self, SettingsError> {
        let environment = Environment::with_prefix("EMP_SERVER")
            .prefix_separator("__")
            .separator("__");
        Self::layered(file, environment, overrides)
    }

    fn layered(
        file: Option<&Path>,
        environment: Environment,
        overrides: Overrides,
    ) -> Result<Self, SettingsError> {
        let mut builder =
            Config::builder().add_source(File::from_str(DEFAULT_SETTINGS, FileFormat::Toml));
        if let Some(file) = file {
            builder = builder.add_source(File::from(file).format(FileFormat::Toml));
        }
        let path = |path: PathBuf| path.to_string_lossy().into_owned();
        let settings: Self = builder
            .add_source(environment.try_parsing(true))
            .set_override_option("listen", overrides.listen)?
            .set_override_option("robots", overrides.robots.map(path))?
            .set_override_option("weights", overrides.weights.map(path))?
            .set_override_option("log.format", overrides.log_format.map(LogFormat::name))?
            .set_override_option("log.filter", overrides.log_filter)?
            .set_override_option("tls.certificate", overrides.tls_certificate.map(path))?
            .set_override_option("tls.key", overrides.tls_key.map(path))?
            .set_override_option("access.file", overrides.access.map(path))?
            .set_override_option("access.insecure", overrides.insecure)?
            .build()?
            .try_deserialize()?;
        settings.check()?;
        Ok(settings)
    }

    /// Refuses to listen for other machines without TLS and identities, unless that was asked for.
    pub(crate) fn check_exposure(&self) -> Result<(), SettingsError> {
        let missing = match (&self.tls.certificate, &self.access.file) {
            (Some(_), Some(_)) => return Ok(()),
            (None, Some(_)) => "tls.certificate",
            (Some(_), None) => "access.file",
            (None, None) => "tls.certificate and access.file",
        };
        if self.listen.ip().to_canonical().is_loopback() || self.access.insecure {
            return Ok(());
        }
        Err(SettingsError::Exposed {
            address: self.listen,
            missing,
        })
    }

    fn check(&self) -> Result<(), SettingsError> {
        self.teleoperation.check()?;
        self.tls.check()?;
        let handshake = self.connections.handshake_seconds;
        if !(SHORTEST_WAIT..=LONGEST_WAIT).contains(&handshake) {
            return Err(SettingsError::Range {
                key: "connections.handshake_seconds",
                found: handshake.to_string(),
                expected: "0.05 to 60 seconds",
            });
        }
        let grace = self.shutdown.grace_seconds;
        if Duration::try_from_secs_f64(grace).is_err() {
            let (key, expected) = ("shutdown.grace_seconds", "zero or more seconds");
            return Err(SettingsError::Range {
                key,
                found: grace.to_string(),
                expected,
            });
        }
        Ok(())
    }

    /// How long open calls may take to finish after the server was told to stop.
    pub fn grace(&self) -> Duration {
        Duration::try_from_secs_f64(self.shutdown.grace_seconds).unwrap_or(Duration::MAX)
    }
}

impl Default for Settings {
    /// The shipped defaults.
    fn default() -> Self {
        toml_defaults()
            .unwrap_or_else(|error| unreachable!("the shipped settings are tested: {error}"))
    }
}

fn toml_defaults() -> Result<Settings, SettingsError> {
    let source = File::from_str(DEFAULT_SETTINGS, FileFormat::Toml);
    Ok(Config::builder()
        .add_source(source)
        .build()?
        .try_deserialize()?)
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    fn layered(
        file: Option<&str>,
        environment: &[(&str, &str)],
        overrides: Overrides,
    ) -> Result<Settings, SettingsError> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("server.toml");
        if let Some(text) = file {
            std::fs::write(&path, text).expect("a file");
        }
        let variables: HashMap<String, String> = environment
            .iter()
            .map(|&(key, value)| (key.to_owned(), value.to_owned()))
            .collect();
        let environment = Environment::with_prefix("EMP_SERVER")
            .prefix_separator("__")
            .separator("__")
            .source(Some(variables));
        Settings::layered(file.map(|_| path.as_path()), environment, overrides)
    }

    #[test]
    fn the_shipped_settings_are_sound() {
        let settings = layered(None, &[], Overrides::default()).expect("sound");
        assert_eq!(settings, Settings::default());
        assert!(settings.listen.ip().is_loopback());
        assert_eq!(settings.grace(), Duration::from_secs(10));
    }

    #[test]
    fn file_environment_and_flags_rise_in_precedence() {
        let file = "listen = \"127.0.0.1:1\"\n[batching]\nmax_batch = 2\nqueue = 3\n";
        let environment = [
            ("EMP_SERVER__LISTEN", "127.0.0.1:2"),
            ("EMP_SERVER__BATCHING__MAX_BATCH", "7"),
        ];
        let overrides = Overrides {
            listen: Some("127.0.0.1:3".to_owned()),
            ..Overrides::default()
        };
        let settings = layered(Some(file), &environment, overrides).expect("sound");
        assert_eq!(settings.listen.port(), 3);
        assert_eq!(settings.batching.max_batch.get(), 7);
        assert_eq!(settings.batching.queue.get(), 3);
        assert_eq!(settings.streams, Settings::default().streams);
    }

    #[test]
    fn mistakes_are_named() {
        let message = |file: &str| {
            layered(Some(file), &[], Overrides::default())
                .expect_err("refused")
                .to_string()
        };
        assert!(message("[batching]\nmax_batchh = 2").contains("max_batchh"));
        assert!(message("[batching]\nmax_batch = 0").contains("batching.max_batch"));
        assert!(message("listen = \"nowhere\"").contains("listen"));
        assert!(message("[log]\nformat = \"xml\"").contains("xml"));
        assert!(message("[shutdown]\ngrace_seconds = -1.0").contains("shutdown.grace_seconds"));
        for (setting, key) in [
            ("ramp_seconds = -1.0", "teleoperation.ramp_seconds"),
            ("ramp_seconds = nan", "teleoperation.ramp_seconds"),
            ("stale_after = 0.0", "teleoperation.stale_after"),
            ("stale_after = 3.0", "teleoperation.return_after"),
            ("return_after = inf", "teleoperation.return_after"),
        ] {
            let refused = message(&format!("[teleoperation]\n{setting}"));
            assert!(refused.contains(key), "{setting}: {refused}");
        }
        assert!(message("[tls]\ncertificate = \"a.pem\"").contains("tls.key"));
        assert!(message("[connections]\nhandshake_seconds = 0.0").contains("handshake_seconds"));
        let unknown = layered(None, &[("EMP_SERVER__LISTN", "x")], Overrides::default());
        assert!(unknown.expect_err("refused").to_string().contains("listn"));
    }

    #[test]
    fn a_server_that_asks_for_nothing_listens_for_its_own_machine_alone() {
        let exposed = |file: &str, insecure: bool| {
            let overrides = Overrides {
                insecure: Some(insecure),
                ..Overrides::default()
            };
            let settings = layered(Some(file), &[], overrides).expect("sound");
            settings.check_exposure().map_err(|error| error.to_string())
        };
        let tls = "[tls]\ncertificate = \"a\"\nkey = \"b\"\n";
        let access = "[access]\nfile = \"c\"\n";
        for own in [
            "127.0.0.1:1",
            "[::1]:1",
            "127.8.8.8:1",
            "[::ffff:127.0.0.1]:1",
        ] {
            assert_eq!(exposed(&format!("listen = \"{own}\""), false), Ok(()));
        }
        for other in ["0.0.0.0:1", "[::]:1", "192.0.2.1:1", "[::ffff:192.0.2.1]:1"] {
            let listen = format!("listen = \"{other}\"\n");
            let missing =
                |rest: &str| exposed(&format!("{listen}{rest}"), false).expect_err("refused");
            assert!(missing("").contains("tls.certificate and access.file"));
            assert!(missing(tls).contains("without access.file"));
            assert!(missing(access).contains("without tls.certificate"));
            assert_eq!(exposed(&format!("{listen}{tls}{access}"), false), Ok(()));
            assert_eq!(exposed(&listen, true), Ok(()));
        }
    }
}

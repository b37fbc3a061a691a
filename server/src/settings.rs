//! The server's settings: an embedded default, then a file, then the environment, then flags.

use std::{
    net::SocketAddr,
    num::NonZeroUsize,
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
/// Longest time that a stream may be silent, seconds.
const LONGEST_SILENCE: f64 = 86_400.0;

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
    /// Most open streams of poses, operators and observers.
    pub max_open: NonZeroUsize,
    /// Most open streams of robots.
    pub max_robots: NonZeroUsize,
    /// Most frames of one stream that wait inside the server.
    pub buffer: NonZeroUsize,
    /// How long a stream's config may take, seconds.
    pub config_seconds: f64,
    /// How long a stream may be silent, seconds.
    pub idle_seconds: f64,
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
    /// Most frames of motion that a job may have.
    pub max_frames: NonZeroUsize,
    /// How many evaluations that have ended are kept.
    pub kept_jobs: NonZeroUsize,
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
            .build()?
            .try_deserialize()?;
        settings.check()?;
        Ok(settings)
    }

    fn check(&self) -> Result<(), SettingsError> {
        self.teleoperation.check()?;
        for (key, found) in [
            ("streams.config_seconds", self.streams.config_seconds),
            ("streams.idle_seconds", self.streams.idle_seconds),
        ] {
            if !(SHORTEST_WAIT..=LONGEST_SILENCE).contains(&found) {
                return Err(SettingsError::Range {
                    key,
                    found: found.to_string(),
                    expected: "0.05 to 86400 seconds",
                });
            }
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
        let unknown = layered(None, &[("EMP_SERVER__LISTN", "x")], Overrides::default());
        assert!(unknown.expect_err("refused").to_string().contains("listn"));
    }
}

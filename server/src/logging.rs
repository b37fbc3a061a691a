//! The log on standard error: never in the way of the service, whatever happens to standard error; one event a line, whatever
//! a client put into it; of bounded length and rate.

use std::{
    io::{self, Write},
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use anyhow::Context as _;
use tracing::{Level, Metadata};
use tracing_subscriber::{
    EnvFilter, Layer, fmt::MakeWriter, layer::SubscriberExt as _, util::SubscriberInitExt as _,
};

#[cfg(feature = "otel")]
use tracing_subscriber::filter::LevelFilter;

use crate::{
    lines::Lines,
    metrics::{LeftOut, metrics},
    settings::{LogFormat, LogSettings},
};

/// Longest line, bytes.
const LONGEST: usize = 4096;
/// How many seconds' worth of lines may come at once: a drain ends every stream in the same moment.
const BURST_SECONDS: f64 = 5.0;
/// How long the end of the process may wait for the last lines.
const LAST_LINES: Duration = Duration::from_secs(1);

/// The running log. Dropping it writes what still waits.
#[derive(Debug)]
pub struct Log {
    lines: Lines,
    #[cfg(feature = "otel")]
    _telemetry: crate::telemetry::Telemetry,
}

impl Log {
    /// Starts the log on standard error. A panic anywhere becomes a line of it. Has to be called inside a tokio runtime.
    ///
    /// # Errors
    /// When the filter is none, or a log was started before.
    pub fn start(settings: &LogSettings) -> anyhow::Result<Self> {
        let filter = EnvFilter::try_new(&settings.filter)
            .with_context(|| format!("settings: log.filter {:?}", settings.filter))?;
        let format = settings.format;
        let lines = Lines::start("log", io::stderr(), move |count| note(format, count))
            .context("a thread for the log")?;
        let writer = LogWriter::new(lines.clone(), settings);
        let layer = tracing_subscriber::fmt::layer().with_writer(writer);
        let layer = match format {
            LogFormat::Text => layer.with_ansi(false).boxed(),
            LogFormat::Json => layer.json().boxed(),
        };
        let registry = tracing_subscriber::registry().with(layer.with_filter(filter));
        #[cfg(feature = "otel")]
        let telemetry = crate::telemetry::Telemetry::start()?;
        #[cfg(feature = "otel")]
        let registry = registry.with(telemetry.layer().with_filter(LevelFilter::INFO));
        registry.try_init().context("the log")?;
        std::panic::set_hook(Box::new(|panic| {
            let place = panic.location().map(ToString::to_string);
            let message = panic.payload_as_str().unwrap_or("without a message");
            tracing::error!(place, message, "panic");
        }));
        Ok(Self {
            lines,
            #[cfg(feature = "otel")]
            _telemetry: telemetry,
        })
    }
}

impl Drop for Log {
    fn drop(&mut self) {
        self.lines.flush(LAST_LINES);
    }
}

/// Makes a writer an event.
struct LogWriter {
    lines: Lines,
    format: LogFormat,
    routine: Arc<Rate>,
    /// Warnings and errors, which a flood of other lines must not hide.
    trouble: Arc<Rate>,
}

impl LogWriter {
    fn new(lines: Lines, settings: &LogSettings) -> Self {
        let rate = || Arc::new(Rate::new(settings.lines_per_second.get()));
        Self {
            lines,
            format: settings.format,
            routine: rate(),
            trouble: rate(),
        }
    }

    fn event(&self, rate: &Arc<Rate>) -> EventWriter {
        EventWriter {
            lines: self.lines.clone(),
            format: self.format,
            rate: Arc::clone(rate),
            text: Vec::new(),
        }
    }
}

impl<'a> MakeWriter<'a> for LogWriter {
    type Writer = EventWriter;

    fn make_writer(&'a self) -> EventWriter {
        self.event(&self.routine)
    }

    fn make_writer_for(&'a self, metadata: &Metadata<'_>) -> EventWriter {
        let is_trouble = *metadata.level() <= Level::WARN;
        self.event(if is_trouble {
            &self.trouble
        } else {
            &self.routine
        })
    }
}

/// Takes the text of one event; it becomes a line when the writer is dropped.
struct EventWriter {
    lines: Lines,
    format: LogFormat,
    rate: Arc<Rate>,
    text: Vec<u8>,
}

impl Write for EventWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.text.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for EventWriter {
    fn drop(&mut self) {
        let reason = if !self.rate.allows(Instant::now()) {
            self.lines.leave_out();
            LeftOut::Rate
        } else if self.lines.push(line(self.format, &self.text)) {
            return;
        } else {
            LeftOut::Full
        };
        metrics().log_line_left_out(reason);
    }
}

/// An event's text as one line of bounded length.
fn line(format: LogFormat, text: &[u8]) -> Vec<u8> {
    let text = String::from_utf8_lossy(text);
    let text = text.trim_end_matches('\n');
    let mut line = if text.len() <= LONGEST {
        text.chars().fold(String::new(), escaped)
    } else {
        let start: String = text.chars().take(LONGEST / 4).collect();
        let bytes = text.len();
        match format {
            LogFormat::Text => {
                let start = start.chars().fold(String::new(), escaped);
                format!("{start}… ({bytes} bytes)")
            }
            LogFormat::Json => {
                let message = format!("a log line of {bytes} bytes was cut");
                serde_json::json!({"level": "WARN", "message": message, "start": start}).to_string()
            }
        }
    };
    line.push('\n');
    line.into_bytes()
}

/// Adds a character, escaped if it could end the line or control a terminal. JSON has no such characters left.
fn escaped(mut line: String, c: char) -> String {
    if c.is_control() || matches!(c, '\u{2028}' | '\u{2029}' | '\u{202a}'..='\u{202e}') {
        line.extend(c.escape_default());
    } else {
        line.push(c);
    }
    line
}

fn note(format: LogFormat, count: u64) -> Vec<u8> {
    let message = format!("{count} log lines were left out");
    match format {
        LogFormat::Text => format!("WARN {message}\n").into_bytes(),
        LogFormat::Json => {
            let line = serde_json::json!({"level": "WARN", "message": message});
            format!("{line}\n").into_bytes()
        }
    }
}

/// A token bucket.
struct Rate {
    per_second: f64,
    level: Mutex<(f64, Instant)>,
}

impl Rate {
    fn new(per_second: u32) -> Self {
        let per_second = f64::from(per_second);
        Self {
            per_second,
            level: Mutex::new((per_second * BURST_SECONDS, Instant::now())),
        }
    }

    fn allows(&self, now: Instant) -> bool {
        let mut level = self.level.lock().unwrap_or_else(PoisonError::into_inner);
        let (tokens, last) = *level;
        let elapsed = now.saturating_duration_since(last).as_secs_f64();
        let tokens = (tokens + elapsed * self.per_second).min(self.per_second * BURST_SECONDS);
        let allows = tokens >= 1.0;
        *level = (if allows { tokens - 1.0 } else { tokens }, now.max(last));
        allows
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_is_one_line_whatever_is_in_it() {
        let forged = "refused \"x\n2026-01-01 INFO all is well\r\u{1b}[2J\u{2028}\"\n".as_bytes();
        let made = String::from_utf8(line(LogFormat::Text, forged)).expect("text");
        assert_eq!(made.lines().count(), 1);
        assert!(made.ends_with('\n') && !made.contains('\u{1b}'), "{made:?}");
        assert!(made.contains("\\n2026-01-01"), "{made:?}");
    }

    #[test]
    fn a_long_event_is_cut_and_json_stays_json() {
        let long = "ä".repeat(1 << 20);
        for format in [LogFormat::Text, LogFormat::Json] {
            let made = line(format, long.as_bytes());
            assert!(made.len() < LONGEST, "{}", made.len());
        }
        let event = serde_json::json!({"fields": {"name": long}}).to_string();
        let made = line(LogFormat::Json, event.as_bytes());
        let made: serde_json::Value = serde_json::from_slice(&made).expect("JSON");
        assert!(made["message"].as_str().expect("text").contains("cut"));
    }

    #[test]
    fn lines_come_at_a_bounded_rate() {
        let rate = Rate::new(10);
        let start = Instant::now();
        let allowed = (0..1000).filter(|_| rate.allows(start)).count();
        assert_eq!(allowed, 50);
        let later = start + Duration::from_secs(1);
        assert_eq!((0..1000).filter(|_| rate.allows(later)).count(), 10);
    }
}

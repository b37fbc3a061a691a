//! The audit log: who operated, stopped, evaluated what, and when; one JSON object a line.
//!
//! It never holds up what it tells of. A line that there is no room for is left out and counted.

use std::{
    fs::{File, OpenOptions},
    io::{self, Write},
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use serde_json::{Map, Value};
use time::{OffsetDateTime, format_description::well_known::Rfc3339};

use crate::{lines::Lines, metrics::metrics};

/// How long the end of the server may wait for the last lines.
const LAST_LINES: Duration = Duration::from_secs(1);

/// The way to the audit log.
#[derive(Clone)]
pub(crate) struct Audit(Option<Arc<Running>>);

struct Running {
    lines: Lines,
    reopen: Arc<AtomicBool>,
}

impl Audit {
    /// Nothing is written.
    pub(crate) fn off() -> Self {
        Self(None)
    }

    /// Appends to a file, which is made if there is none.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let reopen = Arc::new(AtomicBool::new(false));
        let file = AuditFile {
            path: path.to_owned(),
            file: Some(append(path)?),
            reopen: Arc::clone(&reopen),
        };
        let note = |count: u64| {
            let count = ("count".to_owned(), count.into());
            line("lines left out", Map::from_iter([count]))
        };
        let lines = Lines::start("audit", file, note)?;
        Ok(Self(Some(Arc::new(Running { lines, reopen }))))
    }

    /// Opens the file anew with the next line, for a file that was rotated away.
    pub(crate) fn reopen(&self) {
        if let Some(running) = &self.0 {
            running.reopen.store(true, Ordering::Release);
        }
    }

    pub(crate) fn flush(&self) {
        if let Some(running) = &self.0 {
            running.lines.flush(LAST_LINES);
        }
    }

    pub(super) fn record(&self, event: &str, facts: Map<String, Value>) {
        if let Some(running) = &self.0
            && !running.lines.push(line(event, facts))
        {
            metrics().audit_line_left_out();
        }
    }
}

fn line(event: &str, mut facts: Map<String, Value>) -> Vec<u8> {
    let time = OffsetDateTime::now_utc().format(&Rfc3339).ok();
    facts.insert("event".to_owned(), event.into());
    facts.insert("time".to_owned(), time.into());
    format!("{}\n", Value::Object(facts)).into_bytes()
}

fn append(path: &Path) -> io::Result<File> {
    OpenOptions::new()
        .create(true)
        .append(true)
        .mode(0o640)
        .open(path)
}

struct AuditFile {
    path: PathBuf,
    /// None after it could not be opened anew.
    file: Option<File>,
    reopen: Arc<AtomicBool>,
}

impl Write for AuditFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.reopen.swap(false, Ordering::AcqRel) {
            self.file = None;
        }
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(append(&self.path)?),
        };
        file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

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

use serde_json::{Value, json};
use time::{OffsetDateTime, format_description::well_known::Rfc3339};

use super::Caller;
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
        let note = |count| line("lines left out", json!({ "count": count }));
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

    pub(super) fn record(&self, caller: &Caller, event: &str, mut facts: Value) {
        let Some(running) = &self.0 else { return };
        if let Value::Object(facts) = &mut facts {
            facts.insert("identity".to_owned(), caller.identity.name().into());
            facts.insert("request".to_owned(), caller.request.as_ref().into());
            let peer = caller.peer.map(|peer| peer.to_string());
            facts.insert("peer".to_owned(), peer.into());
        }
        if !running.lines.push(line(event, facts)) {
            metrics().audit_line_left_out();
        }
    }
}

fn line(event: &str, mut facts: Value) -> Vec<u8> {
    let time = OffsetDateTime::now_utc().format(&Rfc3339).ok();
    if let Value::Object(facts) = &mut facts {
        facts.insert("event".to_owned(), event.into());
        facts.insert("time".to_owned(), time.into());
    }
    format!("{facts}\n").into_bytes()
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

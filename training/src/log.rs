//! The CSV log of a training run.

use std::{
    fs::{File, OpenOptions},
    path::Path,
};

use anyhow::{Context as _, Result, ensure};
use emp_motion::atomic;

/// Appends rows of numbers to a CSV file whose first column is the step.
pub struct CsvLog {
    writer: csv::Writer<File>,
}

impl CsvLog {
    /// Starts a log, or continues one after `resume_step`: rows beyond it are dropped, for they will be written again.
    ///
    /// # Errors
    /// When the file cannot be read or written, or has other columns.
    pub fn open(
        path: &Path,
        columns: &[impl AsRef<str>],
        resume_step: Option<u64>,
    ) -> Result<Self> {
        let columns: Vec<&str> = columns.iter().map(AsRef::as_ref).collect();
        let kept = match resume_step {
            Some(step) if path.exists() => rows_up_to(path, &columns, step)?,
            _ => Vec::new(),
        };
        let mut text = csv::Writer::from_writer(Vec::new());
        text.write_record(&columns)?;
        for row in &kept {
            text.write_record(row)?;
        }
        let bytes = text.into_inner().map_err(csv::IntoInnerError::into_error)?;
        atomic::write(path, &bytes).with_context(|| format!("writing {}", path.display()))?;
        let file = OpenOptions::new()
            .append(true)
            .open(path)
            .with_context(|| format!("opening {}", path.display()))?;
        Ok(Self {
            writer: csv::Writer::from_writer(file),
        })
    }

    /// Appends one row and flushes it.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn row(&mut self, step: u64, values: &[f64]) -> Result<()> {
        let numbers = values.iter().map(|value| format!("{value:.6}"));
        self.writer
            .write_record(std::iter::once(step.to_string()).chain(numbers))?;
        self.writer.flush()?;
        Ok(())
    }
}

fn rows_up_to(path: &Path, columns: &[&str], last_step: u64) -> Result<Vec<csv::StringRecord>> {
    let mut reader =
        csv::Reader::from_path(path).with_context(|| format!("reading {}", path.display()))?;
    let header = reader.headers()?.clone();
    ensure!(
        header.iter().eq(columns.iter().copied()),
        "{}: the columns are {header:?}, expected {columns:?}",
        path.display()
    );
    // A last line that was cut off while it was written has another length and ends the log.
    let rows = reader.records().map_while(Result::ok);
    let in_range = |row: &csv::StringRecord| {
        row.get(0)
            .and_then(|step| step.parse::<u64>().ok())
            .is_some_and(|step| step <= last_step)
    };
    Ok(rows.filter(in_range).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_log_drops_what_will_be_written_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.csv");
        let columns = ["step", "loss"];
        let mut log = CsvLog::open(&path, &columns, None).unwrap();
        for step in [10, 20, 30] {
            log.row(step, &[step as f64 / 10.0]).unwrap();
        }
        drop(log);
        let mut log = CsvLog::open(&path, &columns, Some(20)).unwrap();
        log.row(30, &[9.0]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text, "step,loss\n10,1.000000\n20,2.000000\n30,9.000000\n");
        assert!(CsvLog::open(&path, &["step", "other"], Some(20)).is_err());
    }
}

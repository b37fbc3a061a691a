//! A robot's joint angles over time as CSV: a header of `time_s` and the joints' names, one row a frame.

use std::fs::File;
use std::path::{Path, PathBuf};

use crate::{MotionError, atomic::AtomicFile};
use csv::Writer;

/// Writes rows to a temporary name beside the target, which appears, whole, with [`finish`](Self::finish).
#[derive(Debug)]
pub struct JointCsvWriter {
    path: PathBuf,
    csv: Writer<File>,
    file: AtomicFile,
    joints: usize,
}

impl JointCsvWriter {
    /// Begins a table of these joints.
    ///
    /// # Errors
    /// [`MotionError::Io`] where the folder cannot be written.
    pub fn create<S: AsRef<str>>(path: &Path, joints: &[S]) -> Result<Self, MotionError> {
        let io = |e| MotionError::io(path, e);
        let file = AtomicFile::create(path).map_err(io)?;
        let mut csv = Writer::from_writer(file.handle().map_err(io)?);
        let header = std::iter::once("time_s").chain(joints.iter().map(AsRef::as_ref));
        csv.write_record(header).map_err(|e| io(e.into()))?;
        Ok(Self {
            path: path.to_owned(),
            csv,
            file,
            joints: joints.len(),
        })
    }

    /// Adds one row: seconds since the motion's start and the angles in radians.
    ///
    /// # Errors
    /// [`MotionError::Format`] where the number of angles is not that of the joints, or the disk's refusal.
    pub fn write_row(&mut self, seconds: f64, angles: &[f32]) -> Result<(), MotionError> {
        if angles.len() != self.joints {
            let reason = format!(
                "expected {} joint angles at {seconds} s, found {}",
                self.joints,
                angles.len()
            );
            return Err(MotionError::format(&self.path, reason));
        }
        let row = std::iter::once(format!("{seconds:.4}"))
            .chain(angles.iter().map(|angle| format!("{angle:.6}")));
        self.csv
            .write_record(row)
            .map_err(|e| MotionError::io(&self.path, e.into()))
    }

    /// Completes the file under its name.
    ///
    /// # Errors
    /// [`MotionError::Io`] where the disk refuses.
    pub fn finish(mut self) -> Result<(), MotionError> {
        self.csv
            .flush()
            .map_err(|e| MotionError::io(&self.path, e))?;
        self.file
            .finish()
            .map_err(|e| MotionError::io(&self.path, e))
    }
}

//! Many motion files at once: those that can be read, and why the others cannot.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use emp_motion::{Clip, MotionError, ReadOptions};
use serde::Serialize;

use crate::command::say_understood;

/// Of at most this many files it is said what each was taken for.
const SAID_EACH: usize = 10;

/// What was read of some files and folders.
#[derive(Default)]
pub(crate) struct Recordings {
    pub(crate) clips: Vec<Clip>,
    pub(crate) left_out: Vec<LeftOut>,
}

/// A file that cannot be read.
#[derive(Debug, Serialize)]
pub(crate) struct LeftOut {
    pub(crate) file: PathBuf,
    pub(crate) reason: String,
}

impl Recordings {
    /// Reads files and, recursively, folders. What was understood and what is left out is said on standard error.
    ///
    /// # Errors
    /// A folder that cannot be listed or has no motion files.
    pub(crate) fn read(paths: &[PathBuf], options: &ReadOptions) -> Result<Self, MotionError> {
        let mut files = Vec::new();
        for path in paths {
            if path.is_dir() {
                files.extend(emp_motion::files(path)?);
            } else {
                files.push(path.clone());
            }
        }
        let mut recordings = Self::default();
        let mut formats: BTreeMap<&str, usize> = BTreeMap::new();
        for file in &files {
            if let Some(format) = recordings.add(file, options, files.len() <= SAID_EACH) {
                *formats.entry(format).or_default() += 1;
            }
        }
        if files.len() > SAID_EACH {
            let formats: Vec<String> = formats
                .iter()
                .map(|(format, count)| format!("{count} {format}"))
                .collect();
            eprintln!(
                "{} of {} files read: {}",
                recordings.clips.len(),
                files.len(),
                formats.join(", ")
            );
        }
        Ok(recordings)
    }

    /// Reads one file; answers its format.
    fn add(&mut self, file: &Path, options: &ReadOptions, say: bool) -> Option<&'static str> {
        match emp_motion::read(file, options) {
            Ok(reading) => {
                if say || !reading.understanding.warnings.is_empty() {
                    say_understood(file, &reading.understanding);
                }
                self.clips.push(reading.clip);
                Some(reading.understanding.format)
            }
            Err(error) => {
                eprintln!("left out: {error}");
                self.left_out.push(LeftOut {
                    file: file.to_owned(),
                    reason: error.to_string(),
                });
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unreadable_files_are_left_out_and_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let motion = emp_motion::skills::generate(emp_motion::skills::Skill::Wave, 1);
        emp_motion::key_nodes::write(&folder.path().join("good.npz"), &motion).expect("written");
        std::fs::write(folder.path().join("broken.bvh"), "HIERARCHY").expect("written");
        let paths = [folder.path().to_owned(), folder.path().join("missing.c3d")];
        let found =
            Recordings::read(&paths, &ReadOptions::default()).expect("a folder with motions");
        assert_eq!(found.clips.len(), 1);
        let files: Vec<_> = found
            .left_out
            .iter()
            .map(|out| out.file.file_name())
            .collect();
        assert_eq!(
            files,
            [Some("broken.bvh".as_ref()), Some("missing.c3d".as_ref())]
        );
        assert!(
            found.left_out[0].reason.contains("ROOT"),
            "{}",
            found.left_out[0].reason
        );
    }
}

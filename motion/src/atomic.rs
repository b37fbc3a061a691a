//! Files that appear whole or not at all. What is no file (a device, a pipe) is written into instead, and a link is followed.

use std::{
    fs::{File, OpenOptions},
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use tempfile::{Builder, NamedTempFile};

/// Writes `bytes` to `path`, whose folder is made where it is missing: a reader sees the old file or the new one.
///
/// # Errors
/// When the folder cannot be made or the file cannot be written.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    std::fs::create_dir_all(folder_of(path))?;
    let file = AtomicFile::create(path)?;
    let mut handle = file.handle()?;
    handle.write_all(bytes)?;
    if file.is_new() {
        handle.sync_all()?;
    }
    file.finish()
}

fn folder_of(path: &Path) -> &Path {
    path.parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
}

/// A file on its way to its name.
#[derive(Debug)]
pub struct AtomicFile(Target);

#[derive(Debug)]
enum Target {
    /// It gets its name when it is complete.
    Replaced(NamedTempFile, PathBuf),
    /// It has been there before, is no regular file, and stays.
    Kept(File),
}

impl AtomicFile {
    /// Begins a file; readable as any new file is, not only by its owner. Dropped before [`finish`](Self::finish), it leaves nothing
    /// where there was nothing.
    ///
    /// # Errors
    /// When the folder cannot be written, or what is there already cannot.
    pub fn create(path: &Path) -> io::Result<Self> {
        // Where a link leads to; a new file's own path.
        let path = match path.canonicalize() {
            Ok(path) => path,
            Err(error) if error.kind() == io::ErrorKind::NotFound => path.to_owned(),
            Err(error) => return Err(error),
        };
        if path.metadata().is_ok_and(|found| !found.is_file()) {
            let file = OpenOptions::new().write(true).open(&path)?;
            return Ok(Self(Target::Kept(file)));
        }
        let name = path.file_name().unwrap_or_default().to_owned();
        let mut builder = Builder::new();
        builder.prefix(&name).suffix(".partial");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            builder.permissions(std::fs::Permissions::from_mode(0o666));
        }
        let file = builder.tempfile_in(folder_of(&path))?;
        Ok(Self(Target::Replaced(file, path)))
    }

    /// Whether it gets its name when it is complete, and not something that was there is written into.
    fn is_new(&self) -> bool {
        matches!(self.0, Target::Replaced(..))
    }

    /// The file to write to.
    ///
    /// # Errors
    /// When the system refuses another handle of it.
    pub fn handle(&self) -> io::Result<File> {
        match &self.0 {
            Target::Replaced(file, _) => file.reopen(),
            Target::Kept(file) => file.try_clone(),
        }
    }

    /// Gives a complete file its name.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn finish(self) -> io::Result<()> {
        match self.0 {
            Target::Replaced(file, path) => file.persist(path).map(drop).map_err(|e| e.error),
            Target::Kept(_) => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;

    use super::*;

    fn write(path: &Path, text: &str) -> io::Result<()> {
        super::write(path, text.as_bytes())
    }

    #[test]
    fn a_folder_in_the_way_is_an_error_and_a_missing_one_is_made() {
        let folder = tempfile::tempdir().expect("a folder");
        assert!(write(folder.path(), "").is_err());
        let path = folder.path().join("new/file.txt");
        write(&path, "text").expect("written");
        assert_eq!(std::fs::read_to_string(&path).expect("text"), "text");
    }

    #[test]
    fn a_file_appears_whole_or_not_at_all() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("table.csv");
        let begun = AtomicFile::create(&path).expect("begun");
        drop(begun);
        assert_eq!(std::fs::read_dir(&folder).expect("a list").count(), 0);
        write(&path, "one").expect("written");
        write(&path, "two").expect("written");
        assert_eq!(std::fs::read_to_string(&path).expect("text"), "two");
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_devices_and_pipes_written_into() {
        let folder = tempfile::tempdir().expect("a folder");
        let (file, link) = (folder.path().join("file"), folder.path().join("link"));
        std::fs::write(&file, "old").expect("written");
        std::os::unix::fs::symlink(&file, &link).expect("a link");
        write(&link, "new").expect("written");
        assert!(link.is_symlink());
        assert_eq!(std::fs::read_to_string(&file).expect("text"), "new");

        write(Path::new("/dev/null"), "gone").expect("written");
        let null = Path::new("/dev/null").metadata().expect("still there");
        assert!(!null.is_file());
        let full = AtomicFile::create(Path::new("/dev/full")).expect("begun");
        let refused = full.handle().expect("a handle").write_all(b"x");
        assert!(refused.is_err(), "a full disk is an error");

        let fifo = folder.path().join("fifo");
        let made = std::process::Command::new("mkfifo").arg(&fifo).status();
        if !made.is_ok_and(|status| status.success()) {
            println!("skipped for pipes: there is no mkfifo");
            return;
        }
        let from = fifo.clone();
        let reader = std::thread::spawn(move || {
            let mut text = String::new();
            File::open(from)?.read_to_string(&mut text)?;
            io::Result::Ok(text)
        });
        write(&fifo, "through a pipe").expect("written");
        let read = reader.join().expect("read").expect("text");
        assert_eq!(read, "through a pipe");
    }
}

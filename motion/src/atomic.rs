//! Files that appear whole or not at all.

use std::path::Path;

use tempfile::{Builder, NamedTempFile};

use crate::MotionError;

/// A temporary file in the folder of `path`, gone when dropped; readable as any new file is, not only by its owner.
pub(crate) fn temporary(path: &Path) -> Result<NamedTempFile, MotionError> {
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let mut builder = Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder
        .tempfile_in(folder)
        .map_err(|e| MotionError::io(path, e))
}

/// Gives a complete temporary file its name.
pub(crate) fn persist(file: NamedTempFile, path: &Path) -> Result<(), MotionError> {
    file.persist(path)
        .map(drop)
        .map_err(|e| MotionError::io(path, e.error))
}

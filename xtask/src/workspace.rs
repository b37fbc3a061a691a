//! Where things are, and how commands are started.

use std::{
    env,
    ffi::OsStr,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail, ensure};

/// Points mujoco-rs at a folder with MuJoCo's library. `.cargo/config.toml` gives it its default.
pub(crate) const LINK_DIR: &str = "MUJOCO_DYNAMIC_LINK_DIR";

/// The checkout that xtask was started from, and the folder that it builds into.
pub(crate) struct Workspace {
    root: PathBuf,
    release: PathBuf,
}

impl Workspace {
    /// Finds the checkout from what Cargo told this process, so that it may have been moved since xtask was built.
    pub(crate) fn locate() -> Result<Self> {
        let package = env::var_os("CARGO_MANIFEST_DIR")
            .context("start this through Cargo: cargo xtask COMMAND")?;
        let root = Path::new(&package)
            .parent()
            .context("the xtask package has no parent folder")?
            .to_path_buf();
        ensure!(
            root.join("Cargo.lock").is_file(),
            "{} holds no Cargo.lock: not the workspace",
            root.display()
        );
        let exe = env::current_exe().context("cannot tell where xtask itself stands")?;
        let release = exe
            .parent()
            .context("xtask stands in no folder")?
            .to_path_buf();
        Ok(Self { root, release })
    }

    /// The workspace's root folder.
    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    /// The target folder: the parent of the profile's folder that xtask itself was built into.
    pub(crate) fn target(&self) -> &Path {
        self.release.parent().unwrap_or(&self.release)
    }

    /// A binary of the workspace, built for release as xtask itself is.
    pub(crate) fn binary(&self, name: &str) -> PathBuf {
        self.release
            .join(format!("{name}{}", env::consts::EXE_SUFFIX))
    }

    /// The user's own MuJoCo folder, if the environment names one other than the workspace's.
    pub(crate) fn own_mujoco(&self) -> Option<PathBuf> {
        env::var_os(LINK_DIR)
            .map(PathBuf::from)
            .filter(|dir| *dir != self.root.join(".mujoco/lib"))
    }

    /// A command that runs in the workspace's root.
    pub(crate) fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new(program);
        command.current_dir(&self.root);
        if self.own_mujoco().is_none() {
            // Cargo set it from its configuration when it started xtask and will again; seen as a user's own setting it
            // would make mujoco-rs build anew at every change between `cargo` and `cargo xtask`.
            command.env_remove(LINK_DIR);
        }
        command
    }

    /// The Cargo that started xtask.
    pub(crate) fn cargo(&self) -> Command {
        self.command(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
    }

    /// Runs a command that shares this terminal; a failure names it.
    pub(crate) fn run(&self, command: &mut Command) -> Result<()> {
        let status = command
            .status()
            .with_context(|| format!("cannot start {}", describe(command)))?;
        if !status.success() {
            bail!("{} failed ({status})", describe(command));
        }
        Ok(())
    }
}

/// The command line as a person would type it.
pub(crate) fn describe(command: &Command) -> String {
    let program = Path::new(command.get_program())
        .file_name()
        .unwrap_or(command.get_program());
    let words = std::iter::once(program).chain(command.get_args());
    words
        .map(OsStr::to_string_lossy)
        .collect::<Vec<_>>()
        .join(" ")
}

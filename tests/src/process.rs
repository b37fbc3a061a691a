//! The project's own binaries as child processes.

use std::{
    ffi::OsStr,
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::OnceLock,
};

use anyhow::{Context as _, bail};

/// Builds the server's and the client's binaries in the profile of this test, once, and gives the folder.
///
/// # Errors
/// When they cannot be built.
pub fn binaries() -> anyhow::Result<&'static Path> {
    static FOLDER: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| build().map_err(|error| format!("{error:#}")));
    folder
        .as_deref()
        .map_err(|error| anyhow::anyhow!("{error}"))
}

fn build() -> anyhow::Result<PathBuf> {
    let test = std::env::current_exe()?;
    // target/PROFILE/deps/TEST
    let folder = test
        .ancestors()
        .nth(2)
        .context("the test's own folder")?
        .to_owned();
    let mut command = Command::new(env!("CARGO"));
    // The same choice of packages as that of the tests, so that no dependency is compiled with other features again.
    command
        .args(["build", "--quiet", "--workspace", "--bins"])
        .current_dir(crate::root());
    if folder.ends_with("release") {
        command.arg("--release");
    }
    if !command.status()?.success() {
        bail!("{command:?} failed");
    }
    Ok(folder)
}

/// A running `emp-server`, killed when dropped.
pub struct ServerProcess {
    child: Child,
    /// Where it listens.
    pub url: String,
}

impl ServerProcess {
    /// Starts the shipped server on a free port, in a folder that is not the checkout, and waits until it listens.
    ///
    /// # Errors
    /// When it does not start.
    pub fn start(folder: &Path) -> anyhow::Result<Self> {
        Self::start_with(folder, &[])
    }

    /// [`start`](Self::start) with further arguments; also another `--listen`.
    ///
    /// # Errors
    /// When it does not start.
    pub fn start_with(folder: &Path, arguments: &[&OsStr]) -> anyhow::Result<Self> {
        let listen = [OsStr::new("--listen"), OsStr::new("127.0.0.1:0")];
        let own: &[&OsStr] = if arguments.contains(&listen[0]) {
            &[]
        } else {
            &listen
        };
        let mut child = Command::new(binaries()?.join("emp-server"))
            .args(["--log-format", "json"])
            .args(own)
            .args(arguments)
            .current_dir(folder)
            .stdout(Stdio::piped())
            .spawn()?;
        let mut line = String::new();
        let stdout = child.stdout.take().context("standard output")?;
        BufReader::new(stdout).read_line(&mut line)?;
        let Some(address) = line.trim_end().strip_prefix("listening on ") else {
            let _ = child.kill();
            bail!("expected `listening on ADDRESS`, found {line:?}");
        };
        let url = format!("http://{address}");
        Ok(Self { child, url })
    }

    /// Sends SIGTERM.
    ///
    /// # Errors
    /// When there is no `kill` command.
    pub fn terminate(&self) -> anyhow::Result<()> {
        Command::new("kill")
            .args(["-TERM", &self.child.id().to_string()])
            .status()?;
        Ok(())
    }

    /// Waits for its end.
    ///
    /// # Errors
    /// When the system cannot say.
    pub fn wait(&mut self) -> anyhow::Result<ExitStatus> {
        Ok(self.child.wait()?)
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

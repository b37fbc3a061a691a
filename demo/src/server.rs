//! The server as a child process.

use std::net::SocketAddr;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use rustix::process::{Pid, Signal, kill_process};
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::time::timeout;

use crate::folders::Folders;

/// How long the server may take to load its models and listen.
const START: Duration = Duration::from_secs(60);
/// How long it may take to end after it was told to.
const STOP: Duration = Duration::from_secs(15);
/// What it prints before its address.
const ANNOUNCEMENT: &str = "listening on ";

/// A running `emp-server`. Dropped before [`Server::stop`], it is killed.
pub(crate) struct Server {
    child: Child,
    stdout: BufReader<ChildStdout>,
}

impl Server {
    /// Starts the server on a free loopback port. Its warnings go to this process's standard error.
    pub(crate) fn spawn(folders: &Folders) -> Result<Self> {
        ensure!(
            folders.server.is_file(),
            "{} is not there; build it: cargo build --release -p emp-server",
            folders.server.display()
        );
        let mut child = Command::new(&folders.server)
            .args(["--listen", "127.0.0.1:0", "--log-filter", "warn"])
            .arg("--robots")
            .arg(&folders.robots)
            .arg("--weights")
            .arg(&folders.weights)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("cannot start {}", folders.server.display()))?;
        let stdout = child
            .stdout
            .take()
            .context("the server has no standard output")?;
        Ok(Self {
            child,
            stdout: BufReader::new(stdout),
        })
    }

    /// The server's URL, once it accepts calls.
    pub(crate) async fn url(&mut self) -> Result<String> {
        let mut line = String::new();
        let read = timeout(START, self.stdout.read_line(&mut line)).await;
        let read = read
            .with_context(|| format!("emp-server did not listen within {} s", START.as_secs()))?;
        if read.context("cannot read what emp-server prints")? == 0 {
            let status = self
                .child
                .wait()
                .await
                .context("cannot wait for emp-server")?;
            bail!("emp-server ended before it listened ({status})");
        }
        let address = line
            .trim_end()
            .strip_prefix(ANNOUNCEMENT)
            .and_then(|address| address.parse::<SocketAddr>().ok());
        let address = address
            .with_context(|| format!("emp-server printed {line:?} instead of its address"))?;
        Ok(format!("http://{address}"))
    }

    /// Tells the server to drain, waits for its end, and kills it if that takes too long.
    pub(crate) async fn stop(mut self) -> Result<()> {
        // Without a number it has ended already, and waiting tells how.
        let pid = self
            .child
            .id()
            .and_then(|id| i32::try_from(id).ok())
            .and_then(Pid::from_raw);
        if let Some(pid) = pid {
            kill_process(pid, Signal::TERM).context("cannot stop emp-server")?;
        }
        let status = match timeout(STOP, self.child.wait()).await {
            Ok(status) => status.context("cannot wait for emp-server")?,
            Err(_) => {
                self.child.kill().await.context("cannot kill emp-server")?;
                bail!(
                    "emp-server did not end within {} s of being told to",
                    STOP.as_secs()
                );
            }
        };
        ensure!(
            ExitStatus::success(&status),
            "emp-server ended badly ({status})"
        );
        Ok(())
    }
}

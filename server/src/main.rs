//! `emp-server`: settings, logging, models, listen, serve, drain.

#![forbid(unsafe_code)]

mod commands;
mod system;

use std::{io::Write as _, path::PathBuf, process::ExitCode};

use anyhow::Context as _;
use clap::Parser;
use emp_server::{Catalog, Drain, Log, LogFormat, Overrides, Server, Settings};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::commands::Command;

/// Serves human motion retargeting, the policy that keeps a robot on its feet, and evaluations of it over gRPC (package
/// emp.v1, with reflection and health).
///
/// Once it accepts calls it prints one line to standard output: `listening on ADDRESS:PORT`. Logs go to standard
/// error. SIGTERM or SIGINT let open calls finish, for at most `shutdown.grace_seconds`; a second one ends it at once. SIGHUP
/// has certificates and identities read again.
///
/// Without more it listens for its own machine alone. For others:
///
///   emp-server cert --folder tls robots.example 192.0.2.7
///   emp-server token add lab --role operator --sessions 'lab-*' --file access.toml
///   emp-server --listen 0.0.0.0:50051 --tls-certificate tls/server.pem --tls-key tls/server-key.pem --access access.toml
///
/// Settings come, in rising order of precedence, from built-in defaults (see --print-config), a file (--config),
/// environment variables (`EMP_SERVER__LISTEN`, `EMP_SERVER__BATCHING__MAX_BATCH`, …) and the flags below.
#[derive(Parser)]
#[command(version, verbatim_doc_comment)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    /// TOML file with settings
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<PathBuf>,
    /// Address and port to listen on; port 0 takes a free one [default: 127.0.0.1:50051]
    #[arg(long, value_name = "ADDR")]
    listen: Option<String>,
    /// Folder of the robots [default: `robots` of the nearest folder upward from the executable, then from the working
    /// directory, that has both `robots` and `models/weights`]
    #[arg(long, value_name = "DIR")]
    robots: Option<PathBuf>,
    /// Folder of the weights, files `ROBOT-retargeter.safetensors` and `ROBOT-policy.safetensors` for each robot [default:
    /// `models/weights` beside the default `robots`]
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
    /// PEM file with the server's certificate chain [default: none, no TLS]
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    tls_certificate: Option<PathBuf>,
    /// PEM file with the certificate's private key
    #[arg(long, value_name = "FILE", requires = "tls_certificate")]
    tls_key: Option<PathBuf>,
    /// File with identities and their roles, see `emp-server token` [default: none, anyone]
    #[arg(long, value_name = "FILE")]
    access: Option<PathBuf>,
    /// Listen for other machines even without TLS and identities: whoever reaches the port may drive any robot
    #[arg(long)]
    insecure: bool,
    /// Form of the log [default: text]
    #[arg(long, value_name = "FORMAT", value_enum)]
    log_format: Option<LogFormat>,
    /// What is logged, for example `info,emp_server=debug` [default: info]
    #[arg(long, value_name = "FILTER")]
    log_filter: Option<String>,
    /// Print the built-in settings with their explanations, and exit
    #[arg(long)]
    print_config: bool,
}

fn main() -> ExitCode {
    match run(Arguments::parse()) {
        Ok(code) => code,
        Err(error) => {
            // Standard error may be closed.
            let _ = writeln!(std::io::stderr(), "emp-server: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    if arguments.print_config {
        std::io::stdout().write_all(emp_server::DEFAULT_SETTINGS.as_bytes())?;
        return Ok(ExitCode::SUCCESS);
    }
    let overrides = Overrides {
        listen: arguments.listen,
        robots: arguments.robots,
        weights: arguments.weights,
        log_format: arguments.log_format,
        log_filter: arguments.log_filter,
        tls_certificate: arguments.tls_certificate,
        tls_key: arguments.tls_key,
        access: arguments.access,
        insecure: arguments.insecure.then_some(true),
    };
    let settings = Settings::load(arguments.config.as_deref(), overrides)?;
    if let Some(command) = arguments.command {
        return commands::run(command, &settings);
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("tokio runtime")?;
    let _inside = runtime.enter();
    let _log = Log::start(&settings.log)?;
    system::raise_descriptor_limit(settings.connections.max.get());
    let catalog = Catalog::load(&settings)?;
    runtime.block_on(serve(settings, catalog))
}

async fn serve(settings: Settings, catalog: Catalog) -> anyhow::Result<ExitCode> {
    let shutdown = CancellationToken::new();
    // Signals count from before the line that says that the server is there.
    let mut terminate = signal(SignalKind::terminate()).context("SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("SIGINT")?;
    let mut hangup = signal(SignalKind::hangup()).context("SIGHUP")?;
    let server = Server::bind(settings, catalog).await?;
    announce(server.address());
    system::ready();

    let reload = server.reload();
    let running = tokio::spawn(server.run(shutdown.clone()));
    let stop = async {
        loop {
            tokio::select! {
                _ = terminate.recv() => return,
                _ = interrupt.recv() => return,
                _ = hangup.recv() => reload.notify_one(),
            }
        }
    };
    tokio::pin!(running);
    tokio::select! {
        ended = &mut running => return report(ended),
        () = stop => {
            system::stopping();
            shutdown.cancel();
        }
    }
    tokio::select! {
        ended = &mut running => report(ended),
        _ = terminate.recv() => Ok(ExitCode::FAILURE),
        _ = interrupt.recv() => Ok(ExitCode::FAILURE),
    }
}

/// The line that a parent process waits for, if there is one that listens.
fn announce(address: std::net::SocketAddr) {
    tracing::info!(%address, "listening");
    let mut out = std::io::stdout().lock();
    let said = writeln!(out, "listening on {address}").and_then(|()| out.flush());
    if let Err(error) = said {
        tracing::warn!(%error, "standard output");
    }
}

fn report(
    ended: Result<Result<Drain, emp_server::ServeError>, tokio::task::JoinError>,
) -> anyhow::Result<ExitCode> {
    match ended.context("the server's task")?? {
        Drain::Complete => tracing::info!("every call has ended; bye"),
        Drain::CutOff => tracing::warn!("the grace time ran out; open calls were cut off"),
    }
    Ok(ExitCode::SUCCESS)
}

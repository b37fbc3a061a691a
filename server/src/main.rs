//! `emp-server`: settings, logging, models, listen, serve, drain.

#![forbid(unsafe_code)]

use std::{io::Write as _, path::PathBuf, process::ExitCode};

use anyhow::Context as _;
use clap::Parser;
use emp_server::{Catalog, Drain, LogFormat, LogSettings, Overrides, Server, Settings};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tracing_subscriber::EnvFilter;

/// Serves human motion retargeting, the policy that keeps a robot on its feet, and evaluations of it over gRPC (package
/// emp.v1, with reflection and health).
///
/// Once it accepts calls it prints one line to standard output: `listening on ADDRESS:PORT`. Logs go to standard
/// error. SIGTERM or SIGINT let open calls finish, for at most `shutdown.grace_seconds`; a second one ends it at once.
///
/// Settings come, in rising order of precedence, from built-in defaults (see --print-config), a file (--config),
/// environment variables (`EMP_SERVER__LISTEN`, `EMP_SERVER__BATCHING__MAX_BATCH`, …) and the flags below.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// TOML file with settings
    #[arg(long, value_name = "FILE")]
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
            eprintln!("emp-server: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    if arguments.print_config {
        print!("{}", emp_server::DEFAULT_SETTINGS);
        return Ok(ExitCode::SUCCESS);
    }
    let overrides = Overrides {
        listen: arguments.listen,
        robots: arguments.robots,
        weights: arguments.weights,
        log_format: arguments.log_format,
        log_filter: arguments.log_filter,
    };
    let settings = Settings::load(arguments.config.as_deref(), overrides)?;
    start_log(&settings.log)?;
    let catalog = Catalog::load(&settings)?;
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("tokio runtime")?
        .block_on(serve(settings, catalog))
}

fn start_log(log: &LogSettings) -> anyhow::Result<()> {
    let filter = EnvFilter::try_new(&log.filter)
        .with_context(|| format!("settings: log.filter {:?}", log.filter))?;
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr);
    match log.format {
        LogFormat::Text => subscriber.with_ansi(false).init(),
        LogFormat::Json => subscriber.json().init(),
    }
    Ok(())
}

async fn serve(settings: Settings, catalog: Catalog) -> anyhow::Result<ExitCode> {
    let shutdown = CancellationToken::new();
    // Signals count from before the line that says that the server is there.
    let mut terminate = signal(SignalKind::terminate()).context("SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("SIGINT")?;
    let server = Server::bind(settings, catalog).await?;
    announce(server.address()).context("standard output")?;

    let running = tokio::spawn(server.run(shutdown.clone()));
    let stop = async {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
    };
    tokio::pin!(running);
    tokio::select! {
        ended = &mut running => return report(ended),
        () = stop => shutdown.cancel(),
    }
    tokio::select! {
        ended = &mut running => report(ended),
        _ = terminate.recv() => Ok(ExitCode::FAILURE),
        _ = interrupt.recv() => Ok(ExitCode::FAILURE),
    }
}

/// The line that a parent process waits for.
fn announce(address: std::net::SocketAddr) -> std::io::Result<()> {
    tracing::info!(%address, "listening");
    let mut out = std::io::stdout().lock();
    writeln!(out, "listening on {address}")?;
    out.flush()
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

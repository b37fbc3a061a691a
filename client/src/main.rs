//! `emp`: human motion files in, robot joint targets or a controller's metrics out, by way of a server.

#![forbid(unsafe_code)]

mod cli;
mod command;
mod evaluate;
mod inspect;
mod recordings;
mod report;
mod retarget;
mod session;

use std::{path::Path, process::ExitCode};

use anyhow::Context as _;
use clap::Parser as _;
use emp_client::ConnectOptions;

use crate::cli::{Arguments, Command};

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
        .with_writer(std::io::stderr)
        .init();
    let runtime = match tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
    {
        Ok(runtime) => runtime,
        Err(error) => return failure(&error.into()),
    };
    match runtime.block_on(run(arguments)) {
        Ok(code) => code,
        Err(error) => failure(&error),
    }
}

fn failure(error: &anyhow::Error) -> ExitCode {
    eprintln!("emp: {error:#}");
    ExitCode::FAILURE
}

fn connect_options(arguments: &Arguments) -> anyhow::Result<ConnectOptions> {
    let read = |path: &Path| std::fs::read(path).with_context(|| path.display().to_string());
    let mut options = ConnectOptions::default();
    if let Some(ca) = &arguments.ca {
        options = options.with_ca(read(ca)?);
    }
    if let (Some(certificate), Some(key)) = (&arguments.cert, &arguments.key) {
        options = options.with_certificate(read(certificate)?, read(key)?);
    }
    if let Some(token) = &arguments.token {
        options = options.with_token(token);
    }
    Ok(options)
}

async fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let json = arguments.json;
    let connect = async || {
        let options = connect_options(&arguments)?;
        anyhow::Ok(emp_client::Client::connect_with(&arguments.server, options).await?)
    };
    match &arguments.command {
        Command::Inspect(command) => inspect::run(command, json),
        Command::Retarget(command) => retarget::run(&connect().await?, command, json).await,
        Command::Evaluate(command) => evaluate::run(&connect().await?, command, json).await,
        Command::Operate(command) => session::operate(&connect().await?, command, json).await,
        Command::Observe(command) => session::observe(&connect().await?, command, json).await,
        Command::Robots => report::robots(&connect().await?, json).await,
        Command::Models => report::models(&connect().await?, json).await,
    }
}

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

use std::process::ExitCode;

use clap::Parser as _;

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

async fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let json = arguments.json;
    let connect = || emp_client::Client::connect(&arguments.server);
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

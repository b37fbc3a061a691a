//! Developer commands, run as `cargo xtask COMMAND`.
//!
//! Fetches what the workspace needs but does not commit (MuJoCo, other people's robots, checking tools), and runs the
//! builds, tests, benchmarks and the demo with it. Depends on nothing that needs MuJoCo and on none of the workspace's
//! crates, so that it builds on a machine where nothing has been fetched yet.

mod ci;
mod demo;
mod fetch;
mod mujoco;
mod robots;
mod tools;
mod workspace;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};

use crate::{robots::FetchedRobot, workspace::Workspace};

/// Set up, test, measure and show the Executable Motion Prior service.
///
/// A first look:  cargo xtask demo
/// Before a push: cargo xtask ci
///
/// Needs Python 3 with pip, which fetches MuJoCo from PyPI on first use. Nothing is installed outside this folder.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", verbatim_doc_comment)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Fetch MuJoCo into .mujoco/ (every other command does this when needed)
    ///
    /// Takes the library from MuJoCo's own PyPI wheel, checks its SHA-256, and links it into the target folder, where
    /// binaries look for it. With `MUJOCO_DYNAMIC_LINK_DIR` set, that folder is checked and used instead.
    Setup,
    /// Fetch a robot that is not ours to ship, into .robots/
    Robot {
        /// Which robot: g1 is Unitree's G1, from the PyPI wheel of mjlab
        robot: FetchedRobot,
    },
    /// Let a simulated robot follow a motion on its own feet, controlled by a real server in real time
    ///
    /// Builds emp-server and emp-demo for release and runs the demo, which leaves joints.csv, summary.json,
    /// contact-sheet.png and stance-sheet.png in out/demo/. A robot that falls is a result: the exit code is 0.
    Demo(demo::DemoArgs),
    /// Run every test of the workspace, documentation tests included, in the release profile
    Test {
        /// Passed to `cargo test`, for example `-p emp-motion bvh` or `-- --nocapture`
        #[arg(
            trailing_var_arg = true,
            allow_hyphen_values = true,
            value_name = "ARGS"
        )]
        args: Vec<String>,
    },
    /// Run every benchmark of the workspace
    Bench {
        /// Passed to Criterion, for example `kinematics` to run only those, or `--quick`
        #[arg(
            trailing_var_arg = true,
            allow_hyphen_values = true,
            value_name = "ARGS"
        )]
        args: Vec<String>,
    },
    /// Everything that must pass before a change lands: format, lints, docs, licences, contract, demo, tests
    Ci,
}

fn main() -> ExitCode {
    match run(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> Result<()> {
    let workspace = Workspace::locate()?;
    match command {
        Command::Setup => {
            let library = mujoco::ensure(&workspace)?;
            println!("MuJoCo {}: {}", mujoco::VERSION, library.display());
            Ok(())
        }
        Command::Robot { robot } => {
            let folder = robots::ensure(&workspace, robot)?;
            println!("{}: {}", robot.name(), folder.display());
            Ok(())
        }
        Command::Demo(args) => demo::run(&workspace, &args),
        Command::Test { args } => {
            mujoco::ensure(&workspace)?;
            workspace.run(
                workspace
                    .cargo()
                    .args(["test", "--release", "--workspace"])
                    .args(args),
            )
        }
        Command::Bench { args } => {
            mujoco::ensure(&workspace)?;
            workspace.run(
                workspace
                    .cargo()
                    .args(["bench", "--workspace", "--bench", "*", "--"])
                    .args(args),
            )
        }
        Command::Ci => ci::run(&workspace),
    }
}

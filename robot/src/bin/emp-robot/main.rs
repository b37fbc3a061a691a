//! `emp-robot`: looks at a robot's folder before anything is trained or served for it.
//!
//! It stands in the robot's own crate, since the client links no MuJoCo and a server need not run to check a robot.

#![forbid(unsafe_code)]

mod check;
mod picture;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::{Parser, Subcommand};
use emp_robot::Robot;

/// Looks at a robot: the folder of a robot.toml and its MJCF.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Check everything that robot.toml and MJCF say, print it, and draw the robot
    ///
    /// What cannot be loaded is an error that names the file and the key (exit code 1). What can be loaded but is hardly meant
    /// so is a warning: nodes on the wrong side, hands that point elsewhere, a mirror image that does not fit, a default pose in
    /// which the robot does not stand. Exit code 2 with warnings, 0 without.
    Check {
        /// The robot's folder
        folder: PathBuf,
        /// Where to write a picture of the robot in its default pose, with its key nodes
        #[arg(long, value_name = "PNG")]
        picture: Option<PathBuf>,
    },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    tracing_subscriber::fmt()
        .with_max_level(tracing::Level::INFO)
        .with_writer(std::io::stderr)
        .without_time()
        .init();
    match run(&arguments.command) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("emp-robot: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: &Command) -> Result<ExitCode> {
    let Command::Check { folder, picture } = command;
    let robot = Robot::load(folder)?;
    let report = check::report(&robot);
    print!("{report}");
    if let Some(path) = picture {
        let image = picture::draw(&robot)?;
        image
            .write(path)
            .with_context(|| path.display().to_string())?;
        println!("picture          {}", path.display());
    }
    Ok(if report.warnings.is_empty() {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(2)
    })
}

//! `emp-demo`: a simulated robot at the other end of the wire.
//!
//! Starts the `emp-server` that stands beside it, streams a person's motion through it over TCP with the client
//! library, replays the joint targets that come back on the robot in MuJoCo (pelvis held), and leaves numbers and a
//! picture. It computes no joint angle itself, and everything that it reports is measured on what came over the wire.

#![forbid(unsafe_code)]

mod folders;
mod measure;
mod motion;
mod output;
mod picture;
mod server;
mod stream;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::Parser;
use emp_robot::Robot;
use tokio::signal::unix::{SignalKind, signal};

use crate::folders::Folders;
use crate::measure::Summary;
use crate::motion::Motion;
use crate::server::Server;
use crate::stream::Answers;

/// Streams a person's motion through a real server and shows what a simulated robot makes of it.
///
/// Leaves joints.csv (the joint targets), summary.json and contact-sheet.png in the output folder.
#[derive(Parser)]
#[command(version)]
struct Options {
    /// A recorded motion: .bvh, AMASS .npz or key-node .npz [default: a procedural medley of every skill]
    #[arg(long, value_name = "FILE")]
    motion: Option<PathBuf>,
    /// The robot, a folder of robots/
    #[arg(long, value_name = "NAME", default_value = "emp27")]
    robot: String,
    /// Where the files go; made if it is not there
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    out: PathBuf,
    /// Print summary.json alone on standard output
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    let options = Options::parse();
    match run(&options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("emp-demo: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(options: &Options) -> Result<()> {
    let folders = Folders::find()?;
    let robot = Robot::load(&folders.robot(&options.robot)?)?;
    let motion = Motion::load(options.motion.as_deref(), robot.control_rate_hz())?;
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot make {}", options.out.display()))?;

    let demo = Arc::new(Demo {
        robot,
        motion,
        out: options.out.clone(),
    });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("tokio runtime")?;
    let summary = runtime.block_on(demo.play(&folders))?;
    if options.json {
        print!("{}", summary.json()?);
    } else {
        print!("{summary}");
        println!(
            "  written to {}: {}",
            options.out.display(),
            output::FILES.join(", ")
        );
    }
    Ok(())
}

/// What is played, and where the result goes.
struct Demo {
    robot: Robot,
    motion: Motion,
    out: PathBuf,
}

impl Demo {
    /// Plays the motion through a server of its own, which is gone when this returns, whatever happened.
    async fn play(self: Arc<Self>, folders: &Folders) -> Result<Summary> {
        let mut interrupted = signal(SignalKind::interrupt()).context("SIGINT")?;
        let mut terminated = signal(SignalKind::terminate()).context("SIGTERM")?;
        let mut server = Server::spawn(folders)?;
        let result = tokio::select! {
            result = self.clone().stream_and_show(&mut server) => result,
            _ = interrupted.recv() => bail_interrupted(),
            _ = terminated.recv() => bail_interrupted(),
        };
        let stopped = server.stop().await;
        let summary = result?;
        stopped?;
        Ok(summary)
    }

    async fn stream_and_show(self: Arc<Self>, server: &mut Server) -> Result<Summary> {
        let url = server.url().await?;
        let frames = self.motion.clip.frames.len();
        eprintln!(
            "emp-server at {url}: streaming {frames} frames of {}",
            self.motion.name
        );
        let answers = stream::play(&url, &self.robot, &self.motion.clip).await?;
        eprintln!(
            "replaying the joint targets on {} in MuJoCo",
            self.robot.name()
        );
        tokio::task::spawn_blocking(move || self.show(&answers))
            .await
            .context("the replay stopped")?
    }

    /// Replays the answers, measures, draws, and writes everything down.
    fn show(&self, answers: &Answers) -> Result<Summary> {
        let replay = emp_sim::replay(&self.robot, &answers.targets)?;
        let (summary, errors) = measure::summary(&self.robot, &self.motion, answers, &replay)?;
        let sheet = output::contact_sheet(&self.robot, &self.motion, &replay, &errors, &summary)?;
        output::write(Path::new(&self.out), &self.robot, answers, &summary, &sheet)?;
        Ok(summary)
    }
}

fn bail_interrupted<T>() -> Result<T> {
    bail!("interrupted")
}

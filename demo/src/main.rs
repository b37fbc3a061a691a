//! `emp-demo`: a simulated robot at the other end of the wire.
//!
//! Starts the `emp-server` that stands beside it and closes the loop through it over TCP with the client library, fifty times
//! a second by the clock: a person's pose becomes a goal, the goal and the robot's state become joint targets, and a
//! robot in MuJoCo follows them on its own feet. Leaves numbers and pictures. It computes no joint angle itself:
//! everything that it reports is measured on what came over the wire and out of MuJoCo.

#![forbid(unsafe_code)]

mod conditions;
mod control;
mod folders;
mod measure;
mod motion;
mod output;
mod picture;
mod posture;
#[cfg(feature = "render")]
mod render;
mod server;
mod simulator;
mod stance;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use clap::Parser;
use emp_robot::Robot;
use tokio::signal::unix::{SignalKind, signal};

use crate::conditions::Conditions;
use crate::control::Run;
use crate::folders::Folders;
use crate::measure::Summary;
use crate::motion::Motion;
use crate::posture::postures;
use crate::server::Server;

/// A simulated robot follows a person's motion on its own feet, in real time, controlled by a real server.
///
/// Leaves joints.csv (goals, executed targets and measured angles), summary.json, contact-sheet.png and stance-sheet.png in
/// the output folder. A robot that falls is a result, not an error: the motion ends there, and the exit code is 0.
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
    /// The weights that the server answers with [default: models/weights of the project]
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
    /// Seed of what is random: hand loads, directions of pushes
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Mass in each hand, kg [default: drawn from the robot's range for tests]
    #[arg(long, value_name = "KG", value_parser = not_negative)]
    load: Option<f64>,
    /// Push the robot's base every 5 s: what is added to its speed, m/s
    #[arg(long, value_name = "M/S", default_value_t = 0.0, value_parser = not_negative)]
    push: f64,
    /// Also leave MuJoCo's own pictures, 25 a second, in frames/, and render.mp4 where ffmpeg is there; needs EGL
    #[arg(long)]
    render: bool,
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
    ensure!(
        cfg!(feature = "render") || !options.render,
        "this emp-demo was built without MuJoCo's renderer; build it with --features emp-demo/render"
    );
    let folders = Folders::find(options.weights.as_deref())?;
    let robot = Robot::load(&folders.robot(&options.robot)?)?;
    let motion = Motion::load(options.motion.as_deref(), robot.control_rate_hz())?;
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot make {}", options.out.display()))?;

    let demo = Arc::new(Demo {
        conditions: Conditions::new(&robot, options.seed, options.load, options.push),
        seed: options.seed,
        robot: Arc::new(robot),
        motion,
        out: options.out.clone(),
        #[cfg(feature = "render")]
        render: options.render,
    });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("tokio runtime")?;
    let outcome = runtime.block_on(demo.play(&folders));
    // Whoever interrupts the demo does not wait for pictures.
    runtime.shutdown_background();
    let (summary, files) = outcome?;
    if options.json {
        print!("{}", summary.json()?);
    } else {
        print!("{summary}");
        println!(
            "  written to {}: {}",
            options.out.display(),
            files.join(", ")
        );
    }
    Ok(())
}

/// A number of at least 0.
fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        _ => Err("expected a number of at least 0".to_owned()),
    }
}

/// What is played, and where the result goes.
struct Demo {
    robot: Arc<Robot>,
    motion: Motion,
    seed: u64,
    conditions: Conditions,
    out: PathBuf,
    #[cfg(feature = "render")]
    render: bool,
}

/// What is said of a run, and the names of the files that it left.
type Outcome = (Summary, Vec<&'static str>);

impl Demo {
    /// Plays the motion through a server of its own, which is gone when this returns, whatever happened.
    async fn play(self: Arc<Self>, folders: &Folders) -> Result<Outcome> {
        let mut interrupted = signal(SignalKind::interrupt()).context("SIGINT")?;
        let mut terminated = signal(SignalKind::terminate()).context("SIGTERM")?;
        let mut server = Server::spawn(folders)?;
        let result = tokio::select! {
            result = self.clone().follow_and_show(&mut server) => result,
            _ = interrupted.recv() => bail_interrupted(),
            _ = terminated.recv() => bail_interrupted(),
        };
        let stopped = server.stop().await;
        let outcome = result?;
        stopped?;
        Ok(outcome)
    }

    async fn follow_and_show(self: Arc<Self>, server: &mut Server) -> Result<Outcome> {
        let url = server.url().await?;
        eprintln!(
            "emp-server at {url}: {} follows {} for {:.1} s",
            self.robot.name(),
            self.motion.name,
            self.motion.time(self.motion.clip.frames.len())
        );
        let conditions = self.conditions.clone();
        let run = control::run(&url, &self.robot, &self.motion.clip, conditions).await?;
        tokio::task::spawn_blocking(move || self.show(&run))
            .await
            .context("the drawing stopped")?
    }

    /// Measures, draws, and writes everything down.
    fn show(&self, run: &Run) -> Result<Outcome> {
        let (robot, motion) = (&*self.robot, &self.motion);
        let postures = postures(robot, run)?;
        let conditions = (self.seed, &self.conditions);
        let (summary, errors) = measure::summary(robot, motion, conditions, run, &postures)?;
        let sheets = output::sheets(robot, motion, run, &postures, &errors, &summary)?;
        let files = output::write(&self.out, robot, run, &summary, &sheets)?;
        #[cfg(feature = "render")]
        let files = match self.render {
            true => [files, render::render(robot, run, &self.out)?].concat(),
            false => files,
        };
        Ok((summary, files))
    }
}

fn bail_interrupted<T>() -> Result<T> {
    bail!("interrupted")
}

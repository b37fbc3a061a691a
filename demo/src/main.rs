//! `emp-demo`: a simulated robot at the other end of the wire.
//!
//! Starts the `emp-server` that stands beside it and closes the loop through it over TCP with the client library: in every
//! control period a person's pose and the robot's state become a goal, an executable goal and joint targets, and a robot in
//! MuJoCo follows them on its own feet. Once by the clock, fifty times a second, through a motion that it can do; then through
//! one that fells it, with the EMP off and on. Leaves numbers and pictures. Everything that it reports is measured on what came
//! over the wire and out of MuJoCo.

#![forbid(unsafe_code)]

mod comparison;
mod control;
mod disturbances;
mod episode;
mod folders;
mod hard;
mod measure;
mod models;
mod motion;
mod output;
mod picture;
mod posture;
#[cfg(feature = "render")]
mod render;
mod safety;
mod server;
mod side_by_side;
mod simulator;
mod stance;
mod stream;
mod teleoperation;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use clap::Parser;
use emp_client::{Client, EmpMode};
use emp_robot::Robot;
use emp_sim::pushes::Kick;
use tokio::signal::unix::{SignalKind, signal};

use crate::comparison::{Comparison, Trials};
use crate::control::{Pace, Run};
use crate::disturbances::{Disturbances, PUSH_INTERVAL};
use crate::folders::Folders;
use crate::hard::HardMotions;
use crate::measure::Summary;
use crate::models::Models;
use crate::motion::Motion;
use crate::output::Files;
use crate::posture::postures;
use crate::server::Server;

/// A simulated robot follows a person's motion on its own feet, in real time, controlled by a real server; then a hard motion
/// with the EMP off and on.
///
/// Leaves joints.csv (goals, executed targets and measured angles), contact-sheet.png and stance-sheet.png of the motion;
/// emp-off.csv, emp-on.csv and emp-sheet.png of the hard one; and summary.json. The hard motion is the first of a list that fells
/// the robot without the EMP. A robot that falls is a result, not an error: the motion ends there, and the exit code is 0.
#[derive(Parser)]
#[command(version)]
struct Options {
    /// A recorded motion: .bvh, AMASS .npz or key-node .npz; also the only hard one [default: a procedural medley of every
    /// skill; hard motions from the procedural library]
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
    /// Seed of what is random: hard motions, hand loads, directions of pushes
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Mass in each hand, kg [default: drawn from the robot's range for tests]
    #[arg(long, value_name = "KG", value_parser = not_negative)]
    load: Option<f64>,
    /// Push the robot's base every 5 s, in the hard motion every 1.5 s: what is added to its speed, m/s
    #[arg(long, value_name = "M/S", default_value_t = 0.0, value_parser = not_negative)]
    push: f64,
    /// How far hard motions reach: times their distance from the robot's default pose
    #[arg(long, value_name = "FACTOR", default_value_t = 1.8, value_parser = not_negative)]
    amplitude: f64,
    /// How many hard motions there are to choose from and to count falls over; 0: no comparison of EMP off and on
    #[arg(long, value_name = "COUNT", default_value_t = 50)]
    hard_motions: usize,
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

    let pushes = Kick {
        speed: options.push,
        interval: PUSH_INTERVAL,
    };
    let demo = Arc::new(Demo {
        disturbances: Disturbances::new(&robot, options.seed, options.load, pushes),
        trials: trials(options, &motion),
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

/// The hard motions; none if none are wanted.
fn trials(options: &Options, motion: &Motion) -> Option<Trials> {
    let (count, amplitude) = (options.hard_motions, options.amplitude);
    let motions = match options.motion {
        Some(_) => HardMotions::recorded(motion.clip.clone(), amplitude),
        None => HardMotions::procedural(options.seed, count, amplitude),
    };
    (count > 0).then_some(Trials {
        motions,
        seed: options.seed,
        load: options.load,
        push: options.push,
    })
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
    disturbances: Disturbances,
    trials: Option<Trials>,
    out: PathBuf,
    #[cfg(feature = "render")]
    render: bool,
}

/// What is said of the runs, and the names of the files that they left.
type Outcome = (Summary, Vec<&'static str>);

impl Demo {
    /// Plays the motions through a server of its own, which is gone when this returns, whatever happened.
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
        let client = Client::connect(&url).await?;
        let models = Models::of(self.robot.name(), &client).await?;
        let run = self.follow(&client).await?;
        let comparison = match &self.trials {
            Some(trials) => {
                let has_emp = models.have_emp();
                Some(trials.play(&client, &self.robot, has_emp).await?)
            }
            None => None,
        };
        tokio::task::spawn_blocking(move || self.show(models, &run, comparison.as_ref()))
            .await
            .context("the drawing stopped")?
    }

    /// The motion in real time, with the EMP off: what it does is shown on a hard motion.
    async fn follow(&self, client: &Client) -> Result<Run> {
        let disturbances = self.disturbances.clone();
        let mode = EmpMode::Off;
        let (robot, clip) = (&self.robot, &self.motion.clip);
        control::run(client, robot, clip, disturbances, mode, Pace::RealTime).await
    }

    /// Measures, draws, and writes everything down.
    fn show(&self, models: Models, run: &Run, comparison: Option<&Comparison>) -> Result<Outcome> {
        let (robot, motion) = (&*self.robot, &self.motion);
        let postures = postures(robot, run)?;
        let hard_motion = comparison.map(|comparison| comparison.summary(robot));
        let emp_sheet = comparison
            .zip(hard_motion.as_ref())
            .map(|(comparison, summary)| side_by_side::sheet(robot, comparison, summary))
            .transpose()?;
        let disturbances = (self.seed, &self.disturbances);
        let (summary, errors) = measure::summary(
            robot,
            motion,
            disturbances,
            models,
            run,
            &postures,
            hard_motion,
        )?;
        let [contact_sheet, stance_sheet] =
            output::sheets(robot, motion, run, &postures, &errors, &summary)?;

        let mut files = Files::new(&self.out);
        files.write("summary.json", summary.json()?.as_bytes())?;
        files.write_joints("joints.csv", robot, run)?;
        files.write("contact-sheet.png", &contact_sheet)?;
        files.write("stance-sheet.png", &stance_sheet)?;
        if let Some(comparison) = comparison {
            files.write_joints("emp-off.csv", robot, &comparison.off)?;
            if let Some(on) = &comparison.on {
                files.write_joints("emp-on.csv", robot, on)?;
            }
        }
        if let Some(sheet) = emp_sheet {
            files.write("emp-sheet.png", &sheet)?;
        }
        #[cfg(feature = "render")]
        if self.render {
            files.written.extend(render::render(robot, run, &self.out)?);
        }
        Ok((summary, files.written))
    }
}

fn bail_interrupted<T>() -> Result<T> {
    bail!("interrupted")
}

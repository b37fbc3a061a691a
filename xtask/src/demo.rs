//! `cargo xtask demo`: builds the demo for release and runs it.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;

use crate::{
    mujoco,
    robots::{self, FetchedRobot},
    workspace::Workspace,
};

/// Builds the demo with MuJoCo's renderer.
pub(crate) const RENDER: [&str; 2] = ["--features", "emp-demo/render"];

/// What of `emp-demo`'s options is of use here.
#[derive(Args, Default)]
pub(crate) struct DemoArgs {
    /// A recorded motion: .bvh, AMASS .npz or key-node .npz; also the only hard one [default: a procedural medley; hard
    /// motions from the procedural library]
    #[arg(long, value_name = "FILE")]
    pub(crate) motion: Option<PathBuf>,
    /// The robot, a folder of robots/; g1 is fetched when needed
    #[arg(long, value_name = "NAME", default_value = "emp27")]
    pub(crate) robot: String,
    /// Where the tables, summary.json and the pictures go [default: out/demo]
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Other weights than those in models/weights
    #[arg(long, value_name = "DIR")]
    pub(crate) weights: Option<PathBuf>,
    /// Seed of what is random: hard motions, hand loads, directions of pushes
    #[arg(long, default_value_t = 0)]
    pub(crate) seed: u64,
    /// Mass in each hand, kg [default: drawn from the robot's range for tests]
    #[arg(long, value_name = "KG")]
    pub(crate) load: Option<f64>,
    /// Push the robot's base every 5 s, in the hard motion every 1.5 s: what is added to its speed, m/s
    #[arg(long, value_name = "M/S")]
    pub(crate) push: Option<f64>,
    /// How far hard motions reach: times their distance from the robot's default pose [default: 1.8]
    #[arg(long, value_name = "FACTOR")]
    pub(crate) amplitude: Option<f64>,
    /// How many hard motions there are to choose from and to count falls over; 0: no comparison of EMP off and on [default: 50]
    #[arg(long, value_name = "COUNT")]
    pub(crate) hard_motions: Option<usize>,
    /// Also leave MuJoCo's own pictures, 25 a second, in frames/, and render.mp4 where ffmpeg is there; needs EGL
    #[arg(long)]
    pub(crate) render: bool,
    /// Print summary.json alone on standard output
    #[arg(long)]
    pub(crate) json: bool,
}

/// Builds what the demo runs, and runs it.
pub(crate) fn run(workspace: &Workspace, args: &DemoArgs) -> Result<()> {
    mujoco::ensure(workspace)?;
    if let Some(robot) = FetchedRobot::by_name(&args.robot) {
        robots::ensure(workspace, robot)?;
    }
    // The whole workspace's programs, as the tests build them: another choice of packages would choose other features of
    // their dependencies, and compile these once more.
    let mut build = workspace.cargo();
    build.args(["build", "--release", "--workspace", "--bins"]);
    if args.render {
        build.args(RENDER);
    }
    workspace.run(&mut build)?;
    let mut demo = workspace.command(workspace.binary("emp-demo"));
    demo.args(["--robot", &args.robot, "--seed", &args.seed.to_string()]);
    for (option, path) in [
        ("--motion", &args.motion),
        ("--out", &args.out),
        ("--weights", &args.weights),
    ] {
        if let Some(path) = path {
            demo.arg(option).arg(absolute(path)?);
        }
    }
    for (option, number) in [
        ("--load", args.load),
        ("--push", args.push),
        ("--amplitude", args.amplitude),
    ] {
        if let Some(number) = number {
            demo.arg(format!("{option}={number}"));
        }
    }
    if let Some(count) = args.hard_motions {
        demo.arg(format!("--hard-motions={count}"));
    }
    for (option, wanted) in [("--render", args.render), ("--json", args.json)] {
        if wanted {
            demo.arg(option);
        }
    }
    workspace.run(&mut demo)
}

/// The demo runs in the workspace's root; paths are meant from where the user stands.
fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).with_context(|| format!("not a path: {}", path.display()))
}

//! `cargo xtask demo`: builds the demo for release and runs it.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;

use crate::{
    mujoco,
    robots::{self, FetchedRobot},
    workspace::Workspace,
};

/// What of `emp-demo`'s options is of use here.
#[derive(Args)]
pub(crate) struct DemoArgs {
    /// A recorded motion: .bvh, AMASS .npz or key-node .npz [default: a procedural medley]
    #[arg(long, value_name = "FILE")]
    pub(crate) motion: Option<PathBuf>,
    /// The robot, a folder of robots/; g1 is fetched when needed
    #[arg(long, value_name = "NAME", default_value = "emp27")]
    pub(crate) robot: String,
    /// Where joints.csv, summary.json and contact-sheet.png go [default: out/demo]
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
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
    workspace.run(
        workspace
            .cargo()
            .args(["build", "--release", "--workspace", "--bins"]),
    )?;
    let mut demo = workspace.command(workspace.binary("emp-demo"));
    demo.args(["--robot", &args.robot]);
    if let Some(motion) = &args.motion {
        demo.arg("--motion").arg(absolute(motion)?);
    }
    if let Some(out) = &args.out {
        demo.arg("--out").arg(absolute(out)?);
    }
    if args.json {
        demo.arg("--json");
    }
    workspace.run(&mut demo)
}

/// The demo runs in the workspace's root; paths are meant from where the user stands.
fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).with_context(|| format!("not a path: {}", path.display()))
}

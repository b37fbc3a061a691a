//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

/// Sends recorded human motion to an emp-server and writes the robot's joint targets.
///
/// Start a server with `emp-server`; it prints the address that it listens on. Then, for example:
///
///   emp robots
///   emp retarget walk.bvh --robot emp27 --refine --smooth --out joints.csv
///   emp retarget walk.bvh --robot emp27 --realtime --out joints.csv
///
/// Exit codes: 0 done; 1 failed (whatever was received is written); 2 wrong usage; 3 done, but frames are missing though
/// every frame was asked for; 130 interrupted (Ctrl-C; whatever was received is written).
#[derive(Parser)]
#[command(name = "emp", version, verbatim_doc_comment)]
pub(crate) struct Arguments {
    /// URL of the server
    #[arg(
        long,
        global = true,
        value_name = "URL",
        default_value = "http://127.0.0.1:50051",
        env = "EMP_SERVER_URL"
    )]
    pub(crate) server: String,
    /// Print JSON on standard output instead of text
    #[arg(long, global = true)]
    pub(crate) json: bool,
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Subcommand)]
pub(crate) enum Command {
    /// Retarget a motion file to a robot
    ///
    /// The motion is resampled to the robot's control rate and streamed. The result is a CSV table: `time_s`, then one
    /// column a joint (radians, in the robot's goal order).
    ///
    /// At the end, latency percentiles, batch sizes, direction error and dropped frames are printed. With --realtime the
    /// latency is that of a live source; without, frames are sent as fast as the server takes them, and the latency
    /// counts how long they queue behind each other.
    ///
    /// A lost connection is restored with growing pauses, for up to a minute; frames without an answer are sent again
    /// (dropped with --realtime).
    Retarget(Retarget),
    /// List the robots that the server serves
    Robots,
    /// List the models that the server serves
    Models,
}

/// What to retarget, for whom, and how.
#[derive(Args)]
pub(crate) struct Retarget {
    /// Motion file: BVH (.bvh), AMASS (.npz) or key nodes (.npz)
    pub(crate) file: PathBuf,
    /// Name of the robot, as `emp robots` lists it
    #[arg(long, value_name = "NAME")]
    pub(crate) robot: String,
    /// Where to write the joint targets
    #[arg(long, value_name = "CSV")]
    pub(crate) out: PathBuf,
    /// Send at the robot's control rate, as a live source would; the server computes the newest frame and drops those
    /// that it could not get to
    #[arg(long)]
    pub(crate) realtime: bool,
    /// Refine each answer of the network by a few Gauss-Newton steps: more exact, slower
    #[arg(long)]
    pub(crate) refine: bool,
    /// Smooth the joint angles over time, at the cost of at most one frame of delay
    #[arg(long)]
    pub(crate) smooth: bool,
}

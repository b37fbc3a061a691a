//! The command line.

use std::{path::PathBuf, str::FromStr};

use clap::{Args, Parser, Subcommand, ValueEnum};
use emp_motion::{BodyJoint, ReadOptions, UpAxis, parse_unit};

/// Sends recorded human motion to an emp-server: for a robot's joint targets, to drive a robot in a session, or to have a
/// controller evaluated there.
///
/// Start a server with `emp-server`; it prints the address that it listens on. Then, for example:
///
///   emp inspect walk.bvh
///   emp robots
///   emp retarget walk.bvh --robot emp27 --refine --smooth --out joints.csv
///   emp retarget walk.bvh --robot emp27 --realtime --out joints.csv
///   emp evaluate --robot emp27 --motions recordings/ --procedural 100 --csv episodes.csv
///   emp evaluate --robot emp27 --motions recordings/ --controller emp --amplitude 1.5
///   emp operate walk.bvh --robot emp27 --session lab
///   emp observe --robot emp27 --session lab
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
    /// PEM file with the authority of the server's certificate [default: the system's]
    #[arg(long, global = true, value_name = "FILE", env = "EMP_CA")]
    pub(crate) ca: Option<PathBuf>,
    /// PEM file with a certificate of this client
    #[arg(long, global = true, value_name = "FILE", requires = "key")]
    pub(crate) cert: Option<PathBuf>,
    /// PEM file with the certificate's private key
    #[arg(long, global = true, value_name = "FILE", requires = "cert")]
    pub(crate) key: Option<PathBuf>,
    /// Token of this client; better in the environment than on a command line, which others see
    #[arg(
        long,
        global = true,
        value_name = "TOKEN",
        env = "EMP_TOKEN",
        hide_env_values = true
    )]
    pub(crate) token: Option<String>,
    /// Print JSON on standard output instead of text
    #[arg(long, global = true)]
    pub(crate) json: bool,
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Subcommand)]
pub(crate) enum Command {
    /// Print what a motion file is taken for; needs no server
    ///
    /// Format, naming scheme, frames, rate, unit, up axis, handedness, height, the joint of each key node, hands, and warnings
    /// about what may be misread.
    Inspect(Inspect),
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
    /// Evaluate a controller on a set of motions
    ///
    /// The server retargets the motions, cuts them into clips and simulates a robot on each. SUC, MJP, MSC, MBV, MBA, MBO
    /// and MUS are printed with 95 % intervals, recorded and procedural motion apart, beside how fast and how wide the
    /// goals moved; then every clip that failed, with the time and the reason. The same request gives the same numbers.
    ///
    /// A file that cannot be read is left out and said; the result counts them. After Ctrl-C, or when the server is lost, what
    /// finished is reported and written.
    Evaluate(Evaluate),
    /// Send a motion file as the operator of a teleoperation session
    ///
    /// The motion is resampled to the robot's control rate and sent in real time, refined and smoothed on the server. Who comes
    /// and goes is said on standard error; at the end it is printed what the session's robot executed meanwhile.
    Operate(Operate),
    /// Print what the robot of a teleoperation session executes, a line a control period
    ///
    /// The age of the person's pose, the EMP's mode, what the guard does with the goal, the joint whose goal was changed most
    /// before it is executed, danger, how far the centre of mass is inside the feet's support, and the smallest distance between
    /// links. With --json everything. It goes on until Ctrl-C.
    Observe(Observe),
    /// List the robots that the server serves
    Robots,
    /// List the models that the server serves
    Models,
}

/// What to inspect.
#[derive(Args)]
pub(crate) struct Inspect {
    /// Motion file: BVH (.bvh), SMPL family or key nodes (.npz), Xsens (.mvnx), markers (.c3d)
    pub(crate) file: PathBuf,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// What a motion file does not say, or says wrongly.
#[derive(Args)]
#[command(next_help_heading = "Reading the motion")]
pub(crate) struct Reading {
    /// Frames a second [default: the file's]
    #[arg(long, value_name = "HZ")]
    pub(crate) fps: Option<f64>,
    /// Unit of length: m, cm, mm, in, ft or a number of metres [default: by the arms' length]
    #[arg(long, value_name = "UNIT", value_parser = parse_unit)]
    pub(crate) unit: Option<f64>,
    /// Axis that points up: x, y, z, -x, -y or -z [default: by the body and the floor]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    pub(crate) up: Option<UpAxis>,
    /// The file's joint (or marker) for a key node, a hip (`left_hip`, `right_hip`): `left_elbow=NAME`; may be repeated
    #[arg(long, value_name = "NODE=NAME", value_parser = mapping)]
    pub(crate) map: Vec<(BodyJoint, String)>,
    /// Whether the file holds the mirror image of its person [default: by feet, knees, thumbs and elbows]
    #[arg(long, value_name = "yes|no", num_args = 0..=1, default_missing_value = "yes", value_parser = yes_or_no)]
    pub(crate) mirror: Option<bool>,
}

impl Reading {
    pub(crate) fn options(&self) -> ReadOptions {
        ReadOptions {
            fps: self.fps,
            metres_per_unit: self.unit,
            up: self.up,
            mirror: self.mirror,
            map: self.map.clone(),
        }
    }
}

fn mapping(text: &str) -> Result<(BodyJoint, String), String> {
    let (joint, name) = text
        .split_once('=')
        .ok_or_else(|| "expected NODE=NAME, for example left_elbow=LeftForeArm".to_owned())?;
    Ok((joint.parse()?, name.to_owned()))
}

fn yes_or_no(text: &str) -> Result<bool, String> {
    match text {
        "yes" => Ok(true),
        "no" => Ok(false),
        _ => Err("expected yes or no".to_owned()),
    }
}

/// What to retarget, for whom, and how.
#[derive(Args)]
pub(crate) struct Retarget {
    /// Motion file: BVH (.bvh), SMPL family or key nodes (.npz), Xsens (.mvnx), markers (.c3d)
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
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// What to send, and to which session.
#[derive(Args)]
pub(crate) struct Operate {
    /// Motion file: BVH (.bvh), SMPL family or key nodes (.npz), Xsens (.mvnx), markers (.c3d)
    pub(crate) file: PathBuf,
    /// Name of the robot, as `emp robots` lists it
    #[arg(long, value_name = "NAME")]
    pub(crate) robot: String,
    /// Name of the session
    #[arg(long, value_name = "NAME")]
    pub(crate) session: String,
    /// When the robot's Executable Motion Prior changes goals [default: as the session has it]
    #[arg(long, value_enum)]
    pub(crate) emp_mode: Option<EmpMode>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// Which session to listen to.
#[derive(Args)]
pub(crate) struct Observe {
    /// Name of the session
    #[arg(long, value_name = "NAME")]
    pub(crate) session: String,
    /// Name of the session's robot
    #[arg(long, value_name = "NAME")]
    pub(crate) robot: String,
    /// Stop after this time [default: never]
    #[arg(long, value_name = "S")]
    pub(crate) seconds: Option<f64>,
}

/// When an Executable Motion Prior changes goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum EmpMode {
    /// Never.
    Off,
    /// In every control period.
    On,
    /// While there is danger.
    WhenDanger,
}

impl From<EmpMode> for emp_client::EmpMode {
    fn from(mode: EmpMode) -> Self {
        match mode {
            EmpMode::Off => Self::Off,
            EmpMode::On => Self::On,
            EmpMode::WhenDanger => Self::WhenDanger,
        }
    }
}

/// What to evaluate, and how.
#[derive(Args)]
pub(crate) struct Evaluate {
    /// Name of the robot, as `emp robots` lists it
    #[arg(long, value_name = "NAME")]
    pub(crate) robot: String,
    /// `decoupled`, `emp`, `emp-when-danger`, or another filter of goals before the policy, with parameters as
    /// `NAME:key=value,…`; an unknown one is answered with those that there are
    #[arg(long, value_name = "NAME", default_value = "decoupled")]
    pub(crate) controller: String,
    /// Folders (searched recursively) or files of recorded motion, as `emp inspect` reads them
    #[arg(long, value_name = "DIR", num_args = 1.., required_unless_present = "procedural")]
    pub(crate) motions: Vec<PathBuf>,
    /// Number of procedural motions, 3 to 20 s each, drawn from the seed
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) procedural: u32,
    /// Number of episodes; the clips are taken in turn [default: one a clip]
    #[arg(long, value_name = "N")]
    pub(crate) episodes: Option<u32>,
    /// Seed of everything random
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Length of a clip in control periods [default: 200]
    #[arg(long, value_name = "N")]
    pub(crate) frames: Option<u32>,
    /// Mass in each hand, kilograms, drawn per episode [default: 0.8..1.2]
    #[arg(long, value_name = "LEAST..MOST")]
    pub(crate) load: Option<Range>,
    /// Speed of pushes, m/s [default: none, with full randomization the paper's]
    #[arg(long, value_name = "M/S")]
    pub(crate) push: Option<f64>,
    /// Time between two pushes, seconds [default: 5]
    #[arg(long, value_name = "S", requires = "push")]
    pub(crate) push_interval: Option<f64>,
    /// Speed of the motions, as a multiple of their own [default: 1]
    #[arg(long, value_name = "FACTOR")]
    pub(crate) speed: Option<f64>,
    /// Scale of the goals' distance from the default pose [default: 1]
    #[arg(long, value_name = "FACTOR")]
    pub(crate) amplitude: Option<f64>,
    /// How much the robots differ from the model
    #[arg(long, value_enum, default_value_t = Randomization::Nominal)]
    pub(crate) randomization: Randomization,
    /// Where to write one row an episode
    #[arg(long, value_name = "FILE")]
    pub(crate) csv: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) reading: Reading,
}

/// How much simulated robots differ from the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Randomization {
    /// Only the load in the hands.
    Nominal,
    /// The paper's whole table.
    Full,
}

/// Two numbers, written `LEAST..MOST`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Range {
    pub(crate) least: f64,
    pub(crate) most: f64,
}

impl FromStr for Range {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || "expected LEAST..MOST, for example 0.8..1.2".to_owned();
        let (least, most) = text.split_once("..").ok_or_else(expected)?;
        let number = |text: &str| text.trim().parse::<f64>().map_err(|_| expected());
        Ok(Self {
            least: number(least)?,
            most: number(most)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_sound() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn a_motion_can_be_read_otherwise() {
        let line = "emp inspect a.bvh --fps 30 --unit cm --up -y --map left_elbow=Elle --map right_hip=Hüfte --mirror";
        let arguments = Arguments::try_parse_from(line.split(' ')).expect("valid");
        let Command::Inspect(command) = arguments.command else {
            panic!("another command");
        };
        let options = command.reading.options();
        assert_eq!(
            (
                options.fps,
                options.metres_per_unit,
                options.up,
                options.mirror
            ),
            (Some(30.0), Some(0.01), Some(UpAxis::MinusY), Some(true))
        );
        assert_eq!(
            options.map[1],
            ("right_hip".parse().expect("a joint"), "Hüfte".to_owned())
        );
        for bad in [
            "--unit yard",
            "--up w",
            "--map elbow=x",
            "--map left_elbow",
            "--mirror maybe",
            "--unit -1",
        ] {
            let line = format!("emp inspect a.bvh {bad}");
            assert!(Arguments::try_parse_from(line.split(' ')).is_err(), "{bad}");
        }
    }

    #[test]
    fn ranges_are_two_numbers() {
        let range = "0.8..1.2".parse();
        assert_eq!(
            range,
            Ok(Range {
                least: 0.8,
                most: 1.2
            })
        );
        for bad in ["", "1", "1..", "a..b"] {
            assert!(bad.parse::<Range>().is_err(), "{bad}");
        }
    }
}

//! Every mistake in a robot's files is an error that names the file, the key and what was expected.

use std::path::{Path, PathBuf};

use emp_robot::{Robot, RobotError, robot_folders};
use tempfile::TempDir;

/// A change of one file of emp27, and what the error has to say.
struct Case {
    file: &'static str,
    /// Text that stands in the file, and what replaces its first occurrence.
    change: [&'static str; 2],
    expect: &'static [&'static str],
}

const fn toml(find: &'static str, replace: &'static str, expect: &'static [&'static str]) -> Case {
    Case {
        file: "robot.toml",
        change: [find, replace],
        expect,
    }
}

const fn mjcf(find: &'static str, replace: &'static str, expect: &'static [&'static str]) -> Case {
    Case {
        file: "robot.xml",
        change: [find, replace],
        expect,
    }
}

const CASES: &[Case] = &[
    // Shape of the file.
    toml("name = \"emp27\"", "name = ", &["robot.toml", "line 4"]),
    toml(
        "imu_site =",
        "colour = \"red\"\nimu_site =",
        &[
            "robot.toml: colour",
            "unknown field `colour`",
            "expected one of",
        ],
    ),
    toml(
        "rate_hz = 50.0",
        "rate = 50.0",
        &["robot.toml: control.rate", "unknown field `rate`"],
    ),
    toml(
        "kp = 250.0, ",
        "",
        &["robot.toml: joints.goal[0]", "missing field `kp`"],
    ),
    toml(
        "kp = 250.0",
        "kp = \"stiff\"",
        &["robot.toml: joints.goal[0].kp", "expected f64"],
    ),
    toml(
        "offset = [0.0, 0.0, 0.2]",
        "offset = [0.0, 0.2]",
        &["robot.toml: key_nodes.torso.offset", "3"],
    ),
    // Values.
    toml(
        "hand_mass = [0.0, 2.5]",
        "hand_mass = [-1.0, 2.5]",
        &[
            "robot.toml: randomization.hand_mass: expected a range",
            "found [-1, 2.5]",
        ],
    ),
    toml(
        "base_mass = [-5.0, 5.0]",
        "base_mass = [5.0, -5.0]",
        &["robot.toml: randomization.base_mass: expected a range"],
    ),
    toml(
        "test_hand_load = [0.8, 1.2]",
        "test_hand_load = [0.8, inf]",
        &["robot.toml: randomization.test_hand_load", "inf"],
    ),
    toml(
        "name = \"emp27\"",
        "name = \"\"",
        &["robot.toml: name: expected a name"],
    ),
    toml(
        "imu_site = \"imu\"",
        "imu_site = \"\\u0000\"",
        &["robot.toml: imu_site: expected a name", "NUL"],
    ),
    toml(
        "rate_hz = 50.0",
        "rate_hz = 0.0",
        &["robot.toml: control.rate_hz: expected a finite number above 0, found 0"],
    ),
    toml(
        "timestep = 0.005",
        "timestep = 0.003",
        &["robot.toml: control.timestep: expected a whole number of steps"],
    ),
    toml(
        "timestep = 0.005",
        "timestep = 1.0",
        &["robot.toml: control.timestep: expected a whole number of steps"],
    ),
    toml(
        "action_scale = 0.25",
        "action_scale = inf",
        &["robot.toml: control.action_scale: expected a finite number"],
    ),
    toml(
        "kp = 250.0",
        "kp = -1.0",
        &["robot.toml: joints.goal[0].kp: expected a finite number above 0, found -1"],
    ),
    toml(
        "kp = 450.0",
        "kp = nan",
        &["robot.toml: joints.leg[3].kp: expected a finite number above 0, found NaN"],
    ),
    toml("kd = 6.0", "kd = -6.0", &["robot.toml: joints.goal[0].kd"]),
    toml(
        "torque_limit = 100.0",
        "torque_limit = 0.0",
        &["robot.toml: joints.goal[0].torque_limit"],
    ),
    toml(
        "velocity_limit = 10.0",
        "velocity_limit = 0.0",
        &["robot.toml: joints.goal[0].velocity_limit"],
    ),
    toml(
        "armature = 0.05",
        "armature = -0.05",
        &["robot.toml: joints.goal[0].armature"],
    ),
    toml(
        "damping = 1.0",
        "damping = -1.0",
        &["robot.toml: joints.goal[0].damping"],
    ),
    toml(
        "fingers = [0.0, 0.0, -1.0]",
        "fingers = [0.0, 0.0, -2.0]",
        &["robot.toml: key_nodes.left_wrist.fingers: expected a vector of length 1"],
    ),
    toml(
        "thumb = [1.0, 0.0, 0.0]",
        "thumb = [0.0, 0.0, 1.0]",
        &[
            "robot.toml: key_nodes.left_wrist.thumb: expected a direction at a right angle to fingers",
        ],
    ),
    toml(
        "offset = [0.0, 0.0, 0.2]",
        "offset = [0.0, nan, 0.2]",
        &["robot.toml: key_nodes.torso.offset: expected three finite numbers"],
    ),
    toml(
        "radius = 0.13",
        "radius = 0.0",
        &["robot.toml: links.spheres[0].radius: expected a finite number above 0"],
    ),
    toml(
        "radius = 0.13",
        "radius = 0.5",
        &[
            "robot.toml: links.pairs[0]: expected spheres more than 0.56 m apart in the default pose",
        ],
    ),
    toml(
        "radius = 0.015",
        "radius = -0.015",
        &["robot.toml: contacts.left_foot.radius"],
    ),
    toml(
        "centers = [[0.135, 0.045, -0.045], [0.135, -0.045, -0.045], ",
        "centers = [",
        &[
            "robot.toml: contacts.left_foot.centers: expected at least 3 spheres",
            "found 2",
        ],
    ),
    // Names that must agree within the file.
    toml(
        "\"left_elbow\", kp",
        "\"waist_yaw\", kp",
        &[
            "robot.toml: joints.goal[4].name: expected a name that is not taken by joints.goal[0].name",
        ],
    ),
    toml(
        "locked = []",
        "locked = [\"waist_yaw\"]",
        &["robot.toml: joints.locked[0]: expected a name that is not taken"],
    ),
    toml(
        "name = \"pelvis\", body",
        "name = \"torso\", body",
        &[
            "robot.toml: links.spheres[1].name: expected a name that is not taken by links.spheres[0].name",
        ],
    ),
    toml(
        "pairs = [\n  [\"left_hand\", \"torso\"]",
        "pairs = [\n  [\"left_hand\", \"tail\"]",
        &["robot.toml: links.pairs[0]: expected the names of two of links.spheres, found \"tail\""],
    ),
    toml(
        "pairs = [\n  [\"left_hand\", \"torso\"]",
        "pairs = [\n  [\"left_hand\", \"left_hand\"]",
        &["robot.toml: links.pairs[0]: expected two different names"],
    ),
    // Names that must be in the model.
    toml(
        "model = \"robot.xml\"",
        "model = \"other.xml\"",
        &["other.xml: cannot be read"],
    ),
    toml(
        "model = \"robot.xml\"",
        "model = \"other.xml\"\nfetch = \"cargo xtask robot emp27\"",
        &[
            "robot.toml: model:",
            "other.xml is not there",
            "run `cargo xtask robot emp27`",
        ],
    ),
    toml(
        "name = \"waist_yaw\"",
        "name = \"waist_twist\"",
        &[
            "robot.toml: joints.goal[0].name: expected a joint of",
            "robot.xml",
            "\"waist_twist\"",
        ],
    ),
    toml(
        "locked = []",
        "locked = [\"tail\"]",
        &[
            "robot.toml: joints.locked[0]: expected a joint of",
            "\"tail\"",
        ],
    ),
    toml(
        "imu_site = \"imu\"",
        "imu_site = \"nose\"",
        &[
            "robot.toml: imu_site: expected a site of",
            "robot.xml",
            "\"nose\"",
        ],
    ),
    toml(
        "torso = { body = \"torso\"",
        "torso = { body = \"trunk\"",
        &[
            "robot.toml: key_nodes.torso.body: expected a body of",
            "\"trunk\"",
        ],
    ),
    toml(
        "torso = { body = \"torso\"",
        "torso = { body = \"left_foot\"",
        &[
            "robot.toml: key_nodes.torso.body: expected a body that no leg joint moves, found \"left_foot\"",
        ],
    ),
    toml(
        "torso = { body = \"torso\"",
        "torso = { body = \"world\"",
        &["robot.toml: key_nodes.torso.body: expected a body of the robot, found \"world\""],
    ),
    toml(
        "waist = { body = \"pelvis\"",
        "waist = { body = \"torso\"",
        &["robot.toml: key_nodes.waist.body: expected the base, \"pelvis\", found \"torso\""],
    ),
    toml(
        "name = \"torso\", body = \"torso\"",
        "name = \"torso\", body = \"trunk\"",
        &[
            "robot.toml: links.spheres[0].body: expected a body of",
            "\"trunk\"",
        ],
    ),
    toml(
        "[contacts]\npairs = [\n  [\"left_hand\", \"torso\"]",
        "[contacts]\npairs = [\n  [\"left_hand\", \"tail\"]",
        &[
            "robot.toml: contacts.pairs[0]: expected geoms of",
            "\"tail\"",
        ],
    ),
    toml(
        "body = \"left_foot\"\n",
        "body = \"left_shoe\"\n",
        &[
            "robot.toml: contacts.left_foot.body: expected a body of",
            "\"left_shoe\"",
        ],
    ),
    toml(
        "hand = \"left_hand\"",
        "hand = \"left_glove\"",
        &[
            "robot.toml: key_nodes.left_wrist.hand: expected a body of",
            "\"left_glove\"",
        ],
    ),
    toml(
        "hand = \"left_hand\"",
        "hand = \"right_hand\"",
        &[
            "robot.toml: key_nodes.left_wrist.hand: expected \"left_hand\" or a body that it carries, found \"right_hand\"",
        ],
    ),
    // Values that must agree with the model.
    toml(
        "default = 0.5 ",
        "default = 2.5 ",
        &[
            "robot.toml: joints.leg[3].default: expected an angle within the joint's range [0.0, 2.2], found 2.5",
        ],
    ),
    toml(
        "default = 0.5 ",
        "default = nan ",
        &["robot.toml: joints.leg[3].default: expected an angle within"],
    ),
    mjcf(
        "<joint name=\"waist_yaw\"",
        "<joint type=\"slide\" name=\"waist_yaw\"",
        &["robot.toml: joints.goal[0].name: expected a hinge, found \"waist_yaw\""],
    ),
    mjcf(
        "axis=\"0 0 1\" range=\"-1.5 1.5\"",
        "axis=\"0 0 1\"",
        &["robot.toml: joints.goal[0].name: expected a joint with a range"],
    ),
    mjcf(
        "axis=\"0 0 1\" range=\"-1.5 1.5\"",
        "axis=\"0 0 1\" range=\"-1.5 1.5\" ref=\"0.1\"",
        &[
            "robot.toml: joints.goal[0].name: expected a joint with reference angle 0, found ref 0.1",
        ],
    ),
    mjcf(
        "<joint name=\"waist_yaw\"",
        "<joint name=\"waist_roll\" axis=\"1 0 0\" range=\"-1 1\"/><joint name=\"waist_yaw\"",
        &[
            "robot.toml: joints: expected every joint of the model in joints.goal, joints.leg or joints.locked, found \"waist_roll\"",
        ],
    ),
    mjcf(
        "<freejoint name=\"base\"/>",
        "",
        &[
            "robot.toml: model: expected a model with one free joint",
            "found 0",
        ],
    ),
    mjcf(
        "<worldbody>",
        "<worldbody><body><freejoint/><geom type=\"sphere\" size=\"1\" mass=\"1\"/></body>",
        &[
            "robot.toml: model: expected a model with one free joint",
            "found 2",
        ],
    ),
    mjcf(
        "range=\"-1.5 1.5\"",
        "range=\"1.5 -1.5\"",
        &["robot.toml: joints.goal[0].name: expected a joint with a range"],
    ),
    mjcf(
        "mass=\"14\"",
        "mass=\"NaN\"",
        &[
            "robot.toml: model: expected numbers",
            "NaN in line",
            "robot.xml",
        ],
    ),
    mjcf("mass=\"14\"", "mass=\"inf\"", &["robot."]),
    // What MuJoCo refuses.
    mjcf("</mujoco>", "", &["robot.xml: MuJoCo:"]),
    mjcf("mass=\"14\"", "mass=\"-14\"", &["robot.xml: MuJoCo:"]),
];

fn emp27() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27")
}

/// A copy of emp27 with one change.
fn broken(case: &Case) -> TempDir {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for file in ["robot.toml", "robot.xml"] {
        let mut text =
            std::fs::read_to_string(emp27().join(file)).expect("emp27 ships with the project");
        if file == case.file {
            let [find, replace] = case.change;
            assert!(text.contains(find), "{file} has no {find:?}");
            text = text.replacen(find, replace, 1);
        }
        std::fs::write(dir.path().join(file), text).expect("the copy can be written");
    }
    dir
}

#[test]
fn mistakes_are_named() {
    let mut failures = Vec::new();
    for case in CASES {
        let dir = broken(case);
        let message = match Robot::load(dir.path()) {
            Ok(_) => "no error".to_owned(),
            Err(error) => error.to_string(),
        };
        for part in case.expect.iter().filter(|part| !message.contains(**part)) {
            failures.push(format!("{:?}: no {part:?} in: {message}", case.change));
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

#[test]
fn a_text_that_is_not_utf8_is_named() {
    let dir = broken(&CASES[0]);
    std::fs::copy(emp27().join("robot.toml"), dir.path().join("robot.toml")).expect("a copy");
    std::fs::write(dir.path().join("robot.xml"), b"<mujoco model=\"\xff\"/>").expect("a file");
    let message = Robot::load(dir.path())
        .expect_err("it is no text")
        .to_string();
    assert!(message.contains("robot.xml: cannot be read"), "{message}");
}

#[test]
fn a_missing_folder_is_named() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let missing = dir.path().join("emp28");
    let error = Robot::load(&missing).expect_err("there is no such robot");
    assert!(matches!(error, RobotError::Read { .. }), "{error}");
    assert!(error.to_string().contains("emp28"), "{error}");
    let error = robot_folders(&missing).expect_err("there is no such folder");
    assert!(error.to_string().contains("emp28"), "{error}");
}

#[test]
fn folders_are_listed_sorted() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for name in ["zeta", "alpha", "empty"] {
        std::fs::create_dir(dir.path().join(name)).expect("a folder");
    }
    for name in ["zeta", "alpha"] {
        std::fs::write(dir.path().join(name).join("robot.toml"), "").expect("a file");
    }
    let folders = robot_folders(dir.path()).expect("the folder can be read");
    assert_eq!(folders, [dir.path().join("alpha"), dir.path().join("zeta")]);
}

//! Models that were written for other users: with actuators, sensors, keyframes and cameras of their own.

mod common;

use std::path::Path;

use common::robots;
use emp_robot::{Robot, RobotError};
use tempfile::TempDir;

/// emp27 with more in its MJCF, before the end of the file.
fn with(more: &str) -> (TempDir, Result<Robot, RobotError>) {
    let folder = tempfile::tempdir().expect("a folder");
    let ours = robots().join("emp27");
    let text = std::fs::read_to_string(ours.join("robot.xml")).expect("emp27's model");
    let text = text.replace("</mujoco>", &format!("{more}</mujoco>"));
    std::fs::write(folder.path().join("robot.xml"), text).expect("written");
    std::fs::copy(ours.join("robot.toml"), folder.path().join("robot.toml")).expect("copied");
    let robot = Robot::load(folder.path());
    (folder, robot)
}

fn assert_plain(robot: &Robot, what: &str) {
    let ours = Robot::load(&robots().join("emp27")).expect("emp27");
    let (model, plain) = (robot.model(), ours.model());
    let sizes = |m: &mujoco_rs::prelude::MjModel| {
        let ffi = m.ffi();
        [
            ffi.nq,
            ffi.nv,
            ffi.nu,
            ffi.na,
            ffi.nsensor,
            ffi.nkey,
            ffi.ncam,
            ffi.npair,
            ffi.nexclude,
        ]
    };
    assert_eq!(sizes(&model), sizes(&plain), "{what}");
    assert_eq!(model.ffi().nu as usize, robot.joints().count(), "{what}");
    assert_eq!(robot.standing_height(), ours.standing_height(), "{what}");
}

#[test]
fn what_belongs_to_another_way_of_driving_is_left_out() {
    let joints = "left_elbow right_elbow waist_yaw left_knee";
    let motors = |name: &dyn Fn(&str) -> String| {
        let motor = |joint: &str| format!("<motor name=\"{}\" joint=\"{joint}\"/>", name(joint));
        format!(
            "<actuator>{}</actuator>",
            joints.split(' ').map(motor).collect::<String>()
        )
    };
    for (what, more) in [
        ("actuators named as the joints", motors(&str::to_owned)),
        ("actuators of other names", motors(&|joint| format!("{joint}_motor"))),
        ("actuators without names", "<actuator><motor joint=\"left_elbow\"/><motor joint=\"left_knee\"/></actuator>".to_owned()),
        ("an actuator with a state", "<actuator><intvelocity joint=\"left_elbow\" kp=\"5\" actrange=\"-1 1\"/></actuator>".to_owned()),
        ("sensors", "<sensor><jointpos joint=\"left_elbow\"/><gyro site=\"imu\"/></sensor>".to_owned()),
        (
            "sensors of actuators",
            motors(&str::to_owned) + "<sensor><actuatorfrc actuator=\"left_elbow\"/></sensor>",
        ),
        ("a keyframe", "<keyframe><key name=\"home\" qpos=\"0 0 1 1 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0\"/></keyframe>".to_owned()),
        ("a camera", "<worldbody><camera name=\"side\" pos=\"3 0 1\"/></worldbody>".to_owned()),
        ("contact pairs", "<contact><pair geom1=\"left_hand\" geom2=\"torso\"/><exclude body1=\"pelvis\" body2=\"torso\"/></contact>".to_owned()),
    ] {
        let (_folder, robot) = with(&more);
        assert_plain(&robot.unwrap_or_else(|error| panic!("{what}: {error}")), what);
    }
}

#[test]
fn a_keyframe_of_the_unlocked_model_does_not_hinder_locking() {
    // A key for 34 coordinates, of which locking takes one.
    let (folder, robot) = with(
        "<keyframe><key qpos=\"0 0 1 1 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0\"/></keyframe>",
    );
    robot.expect("loads");
    let config = folder.path().join("robot.toml");
    let text = std::fs::read_to_string(&config).expect("robot.toml");
    let locked: String = text
        .lines()
        .filter(|line| !line.contains("name = \"waist_yaw\""))
        .map(|line| line.replace("locked = []", "locked = [\"waist_yaw\"]") + "\n")
        .collect();
    std::fs::write(&config, locked).expect("written");
    let robot = Robot::load(folder.path()).expect("loads with a locked waist");
    assert_eq!(robot.goal_joints().len(), 14);
    assert_eq!(robot.model().ffi().nu, 26);
}

#[test]
fn a_model_that_stays_inconsistent_is_refused_at_load() {
    for (more, expected) in [
        // A second thing that moves, and a body that is moved from outside.
        (
            "<worldbody><body pos=\"2 0 1\"><joint type=\"slide\" axis=\"0 0 1\"/><geom size=\"0.1\"/></body></worldbody>",
            "in none of them",
        ),
        (
            "<worldbody><body pos=\"2 0 1\"><freejoint/><geom size=\"0.1\"/></body></worldbody>",
            "2 free joints",
        ),
        (
            "<worldbody><body mocap=\"true\" pos=\"2 0 1\"><geom size=\"0.1\" contype=\"0\" conaffinity=\"0\"/></body></worldbody>",
            "nmocap",
        ),
    ] {
        let (_folder, robot) = with(more);
        let error = robot.expect_err("inconsistent").to_string();
        assert!(
            error.contains("robot.toml") && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn a_robot_can_be_checked_and_drawn() {
    let folder = tempfile::tempdir().expect("a folder");
    let picture = folder.path().join("emp27.png");
    let run = |robot: &Path| {
        std::process::Command::new(env!("CARGO_BIN_EXE_emp-robot"))
            .arg("check")
            .arg(robot)
            .arg("--picture")
            .arg(&picture)
            .output()
            .expect("runs")
    };
    let output = run(&robots().join("emp27"));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(output.status.code(), Some(0), "{text}");
    for part in [
        "emp27",
        "15 goal joints, 12 leg joints",
        "left_elbow",
        "every joint has its image",
        "after 2 s base tilted",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let decoder = png::Decoder::new(std::io::BufReader::new(
        std::fs::File::open(&picture).expect("drawn"),
    ));
    let mut reader = decoder.read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut pixels).expect("pixels");
    let bright = pixels
        .chunks(3)
        .filter(|p| p.iter().all(|c| *c > 120))
        .count();
    assert!(
        bright > pixels.len() / 3 / 50,
        "a white robot is seen: {bright}"
    );
    let missing = run(&folder.path().join("none"));
    assert_eq!(missing.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&missing.stderr).contains("robot.toml"));
}

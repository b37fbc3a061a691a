//! Robots for this crate's tests.

use std::path::Path;

use emp_robot::{Robot, RobotError};

/// Runs a test on every robot of the workspace; one whose model was not fetched is skipped, and said to be.
pub(crate) fn for_each_robot(test: impl Fn(&Robot)) {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    for folder in emp_robot::robot_folders(&robots).unwrap() {
        match Robot::load(&folder) {
            Ok(robot) => test(&robot),
            Err(error @ RobotError::NotFetched { .. }) => println!("skipped: {error}"),
            Err(error) => panic!("{error}"),
        }
    }
}

/// The default pose, with the joints whose name holds a given word at a given angle, within their range.
pub(crate) fn pose(robot: &Robot, angles: &[(&str, f32)]) -> Vec<f32> {
    let angle = |joint: &emp_robot::Joint| {
        let asked = angles
            .iter()
            .find(|(word, _)| joint.name.contains(word))
            .map(|&(_, angle)| f64::from(angle));
        asked
            .unwrap_or(joint.default)
            .clamp(joint.range[0], joint.range[1]) as f32
    };
    robot.goal_joints().iter().map(angle).collect()
}

//! Robots for this crate's tests.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use emp_models::CheckpointMetadata;
use emp_models::checkpoint::Tensors;
use emp_models::policy::{KIND, NETWORK_PREFIX, Policy, PolicyConfig};
use emp_robot::{Robot, RobotError};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::goals::{GoalClip, GoalLibrary, Source};

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

/// Folder of a robot of the workspace.
pub(crate) fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../robots")
        .join(name)
}

/// The robot that ships with the project.
pub(crate) fn emp27() -> Arc<Robot> {
    Arc::new(Robot::load(&folder("emp27")).unwrap())
}

/// Swinging arms.
pub(crate) fn goal_library(robot: &Robot) -> GoalLibrary {
    let clip = |number: usize| {
        let rows: Vec<Vec<f32>> = (0..200)
            .map(|t| {
                let swing = 0.4 * (0.02 * (t * number) as f32).sin();
                pose(robot, &[("shoulder_pitch", swing), ("waist", 0.5 * swing)])
            })
            .collect();
        GoalClip::new(robot, format!("swing {number}"), Source::Procedural, &rows).unwrap()
    };
    GoalLibrary::new(robot, (1..4).map(clip).collect()).unwrap()
}

/// A policy with small random weights.
pub(crate) fn policy(robot: &Arc<Robot>) -> Policy {
    let config = PolicyConfig::new(robot, vec![32, 16]);
    let widths = [config.features(), 32, 16, robot.leg_joints().len()];
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut tensor = |shape: &[usize]| {
        let count: usize = shape.iter().product();
        let values: Vec<f32> = (0..count).map(|_| rng.random_range(-0.1..0.1)).collect();
        Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
    };
    let mut tensors = Tensors::new();
    for (layer, pair) in widths.windows(2).enumerate() {
        let name = |part: &str| format!("{NETWORK_PREFIX}.{layer}.{part}");
        tensors.insert(name("weight"), tensor(&[pair[1], pair[0]]));
        tensors.insert(name("bias"), tensor(&[pair[1]]));
    }
    for name in ["mean", "scale"] {
        let values = Tensor::ones(widths[0], DType::F32, &Device::Cpu).unwrap();
        tensors.insert(format!("normalizer.{name}"), values);
    }
    let metadata = CheckpointMetadata::for_joints(KIND, robot, robot.joints());
    Policy::from_tensors(config, Arc::clone(robot), tensors, metadata).unwrap()
}

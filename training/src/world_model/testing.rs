//! A small world for this module's tests.

use std::sync::Arc;

use emp_models::policy::Policy;
use emp_robot::Robot;
use emp_sim::{
    Pool, Priority,
    goals::{GoalClip, Source},
    tracking::{TrackingEnvironments, TrackingSettings},
};

pub(super) fn robot() -> Arc<Robot> {
    Arc::new(Robot::load("../robots/emp27".as_ref()).unwrap())
}

/// Robots with short episodes and swinging arms.
pub(super) fn environments(count: u64, settings: TrackingSettings) -> TrackingEnvironments {
    let robot = robot();
    let weights = "../models/weights/emp27-policy.safetensors".as_ref();
    let policy = Policy::load(weights, Arc::clone(&robot)).unwrap();
    let rows: Vec<Vec<f32>> = (0..100)
        .map(|t| {
            let joints = robot.goal_joints().iter().enumerate();
            let swing = |j: usize| 0.2 * (0.1 * t as f32 + j as f32).sin();
            joints
                .map(|(j, joint)| joint.default as f32 + swing(j))
                .collect()
        })
        .collect();
    let clip = GoalClip::new(&robot, "swing", Source::Procedural, &rows).unwrap();
    TrackingEnvironments::new(
        Arc::clone(&robot),
        Arc::new(Pool::new(&robot, 2, Priority::Normal).unwrap()),
        Arc::new(policy),
        settings,
        Arc::from([clip]),
        0..count,
        3,
    )
    .unwrap()
}

pub(super) fn threads(count: usize) -> rayon::ThreadPool {
    let threads = rayon::ThreadPoolBuilder::new().num_threads(count);
    threads.build().unwrap()
}

//! What the tests of both robots share.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::path::{Path, PathBuf};

use emp_robot::{Robot, RobotError};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The project's folder of robots.
pub(crate) fn robots() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots")
}

/// emp27, and g1 where it was fetched; prints that it is skipped where not.
pub(crate) fn all() -> Vec<Robot> {
    let mut loaded =
        vec![Robot::load(&robots().join("emp27")).expect("emp27 ships with the project")];
    loaded.extend(g1());
    loaded
}

/// g1, or none with a printed reason.
fn g1() -> Option<Robot> {
    match Robot::load(&robots().join("g1")) {
        Ok(robot) => Some(robot),
        Err(error @ RobotError::NotFetched { .. }) => {
            println!("skipped: {error}");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

/// A generator with a fixed seed.
pub(crate) fn seeded(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// `rows` joint vectors within the robot's limits, row-major.
pub(crate) fn random_poses(robot: &Robot, rng: &mut impl Rng, rows: usize) -> Vec<f64> {
    (0..rows)
        .flat_map(|_| robot.joints())
        .map(|joint| joint.range)
        .map(|[lower, upper]| rng.random_range(lower..=upper))
        .collect()
}

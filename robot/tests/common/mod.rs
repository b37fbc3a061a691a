//! What the tests of both robots share.

use std::path::{Path, PathBuf};

use emp_robot::{Robot, RobotError};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The project's folder of robots.
pub fn robots() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots")
}

/// emp27, and g1 where it was fetched; prints that it is skipped where not.
pub fn all() -> Vec<Robot> {
    let mut robots =
        vec![Robot::load(&self::robots().join("emp27")).expect("emp27 ships with the project")];
    robots.extend(g1());
    robots
}

/// g1, or none with a printed reason.
pub fn g1() -> Option<Robot> {
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
pub fn seeded(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// `rows` joint vectors within the robot's limits, row-major.
pub fn random_poses(robot: &Robot, rng: &mut impl Rng, rows: usize) -> Vec<f64> {
    (0..rows)
        .flat_map(|_| robot.joints().map(|joint| joint.range).collect::<Vec<_>>())
        .map(|[lower, upper]| rng.random_range(lower..=upper))
        .collect()
}

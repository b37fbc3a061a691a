//! What the robot meets besides the motion: weights in its hands, and pushes.

use std::f64::consts::TAU;

use emp_robot::Robot;
use emp_sim::pushes::Kick;
use nalgebra::Vector3;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Time between two pushes, seconds: the paper's, and a shorter one for motions of a few seconds.
pub(crate) const PUSH_INTERVAL: f64 = 5.0;
pub(crate) const SHORT_PUSH_INTERVAL: f64 = 1.5;

/// What follows from the seed.
#[derive(Clone, Debug)]
pub(crate) struct Disturbances {
    /// Mass added to the left and the right hand, kg.
    pub(crate) hand_load: [f64; 2],
    /// Pushes of the base; a speed of 0 is none.
    pub(crate) pushes: Kick,
    push_directions: ChaCha8Rng,
    /// Frames between two pushes.
    push_interval: usize,
}

impl Disturbances {
    /// Draws the loads from the robot's range for tests, unless `load` says how much both hands carry, kg.
    pub(crate) fn new(robot: &Robot, seed: u64, load: Option<f64>, pushes: Kick) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let [low, high] = robot.added_masses().test_hand;
        let drawn = [0, 1].map(|_| rng.random_range(low..=high));
        Self {
            hand_load: load.map_or(drawn, |load| [load; 2]),
            pushes,
            push_directions: rng,
            push_interval: (pushes.interval * robot.control_rate_hz()).round() as usize,
        }
    }

    /// The push before a frame, if one is due: a change of the base's horizontal velocity in a random direction, m/s. To be asked
    /// for each frame in turn.
    pub(crate) fn push(&mut self, frame: usize) -> Option<Vector3<f64>> {
        let due = frame > 0 && frame.is_multiple_of(self.push_interval);
        if !due || self.pushes.speed == 0.0 {
            return None;
        }
        let direction = self.push_directions.random_range(0.0..TAU);
        let (y, x) = direction.sin_cos();
        Some(self.pushes.speed * Vector3::new(x, y, 0.0))
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn loads_and_pushes_follow_from_the_seed() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27");
        let robot = Robot::load(&folder).unwrap();
        let [low, high] = robot.added_masses().test_hand;
        let pushes = |speed| Kick {
            speed,
            interval: PUSH_INTERVAL,
        };
        for seed in 0..20 {
            let [mut first, mut second] =
                [0, 1].map(|_| Disturbances::new(&robot, seed, None, pushes(0.3)));
            assert_eq!(first.hand_load, second.hand_load);
            assert!(
                first
                    .hand_load
                    .iter()
                    .all(|load| (low..=high).contains(load))
            );
            for frame in 0..600 {
                let push = first.push(frame);
                assert_eq!(push, second.push(frame));
                assert_eq!(push.is_some(), frame == 250 || frame == 500);
                assert!(push.is_none_or(|push| (push.norm() - 0.3).abs() < 1e-12));
            }
        }
        let mut loaded = Disturbances::new(&robot, 1, Some(2.0), pushes(0.0));
        assert_eq!(loaded.hand_load, [2.0; 2]);
        assert!((0..600).all(|frame| loaded.push(frame).is_none()));
    }
}

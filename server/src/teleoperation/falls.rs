//! Sees from its orientation when a teleoperated robot falls, for those who watch the server. Nothing depends on it.

use nalgebra::{UnitQuaternion, Vector3};

use crate::metrics::metrics;

/// Tilt of the base beyond which a robot has fallen, and below which it stands again; radians.
const FALLEN: f64 = 1.0;
const STANDS: f64 = 0.5;

/// One robot's watch.
#[derive(Debug)]
pub(super) struct FallWatch {
    robot: String,
    lies: bool,
}

impl FallWatch {
    pub(super) fn new(robot: &str) -> Self {
        metrics().watch_falls(robot);
        Self {
            robot: robot.to_owned(),
            lies: false,
        }
    }

    /// Looks at the base's orientation in the world, once a control period.
    pub(super) fn look(&mut self, orientation: &UnitQuaternion<f64>) {
        let robot = self.robot.as_str();
        let tilt = (orientation * Vector3::z()).angle(&Vector3::z());
        if !self.lies && tilt > FALLEN {
            metrics().fell(robot);
            tracing::warn!(robot, tilt, "the robot fell");
            self.lies = true;
        } else if tilt < STANDS {
            self.lies = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fall_is_counted_once_and_again_after_the_robot_stood() {
        let mut watch = FallWatch::new("test-falls");
        let fallen = || {
            let text = metrics().text();
            text.lines()
                .find_map(|line| line.strip_prefix("emp_falls_total{robot=\"test-falls\"} "))
                .map_or(0, |count| count.parse().expect("a count"))
        };
        let mut look = |tilt: f64| {
            watch.look(&UnitQuaternion::from_euler_angles(0.3, tilt, 1.0));
            fallen()
        };
        assert_eq!(
            [0.0, 0.6, 1.2, 1.4, 0.7, 1.2, 0.0, 1.2].map(&mut look),
            [0, 0, 1, 1, 1, 1, 1, 2]
        );
    }
}

//! A made-up robot for tests of the pictures.

use emp_motion::skills;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::Still;
use crate::stance::{Footprint, Stance};

/// A still of the medley, with a robot that does exactly what the person does.
pub(super) fn still(time: f64) -> Still {
    let frame = skills::medley(1).frames[(time * 50.0) as usize].clone();
    let leg = |y: f32| {
        [
            (0.0, -0.1),
            (0.1, -0.45),
            (0.0, -0.8),
            (-0.1, -0.85),
            (0.15, -0.85),
        ]
        .map(|(x, z)| Vector3::new(x, y, z))
        .to_vec()
    };
    Still {
        time,
        name: "reach-overhead".to_owned(),
        direction_error_deg: 1.0,
        human: frame.clone(),
        robot: frame,
        legs: [leg(0.1), leg(-0.1)],
        stance: stance(0.02, 0.03),
    }
}

/// A robot whose feet stand side by side, 25 cm long.
pub(super) fn stance(pitch: f64, forward: f64) -> Stance {
    let footprint = |left: f64| Footprint {
        heel: -0.12,
        toe: 0.13,
        right: left - 0.04,
        left: left + 0.04,
    };
    Stance {
        base: Isometry3::from_parts(
            Translation3::new(0.0, 0.0, 0.85).cast(),
            UnitQuaternion::from_euler_angles(0.0, pitch as f32, 0.0),
        ),
        roll: 0.01,
        pitch,
        center_of_mass: Vector3::new(forward, 0.01, 0.9),
        feet: [footprint(0.1), footprint(-0.1)],
    }
}

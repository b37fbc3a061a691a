//! Where the robot's limbs were, frame by frame.

use anyhow::Result;
use emp_motion::{KEY_NODES, KeyNodeFrame};
use emp_robot::Robot;
use emp_sim::Skeleton;
use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::control::{Period, Run};
use crate::stance::Stance;

/// The robot at the end of a control period.
pub(crate) struct Posture {
    /// Its key nodes in the frame of its base.
    pub(crate) pose: KeyNodeFrame,
    /// Points along the left and the right leg in the same frame, metres.
    pub(crate) legs: [Vec<Vector3<f32>>; 2],
    /// How it stands.
    pub(crate) stance: Stance,
}

/// The postures of a run, one a control period.
pub(crate) fn postures(robot: &Robot, run: &Run) -> Result<Vec<Posture>> {
    let mut skeleton = Skeleton::new(robot)?;
    let posture = |period: &Period| {
        let pose = skeleton.pose(&period.reading.joint_positions);
        Posture {
            pose: robot_pose(&pose.key_nodes, &pose.wrist_rotations),
            stance: Stance::new(&period.reading, &pose),
            legs: pose
                .legs
                .map(|leg| leg.into_iter().map(Vector3::cast).collect()),
        }
    };
    Ok(run.periods.iter().map(posture).collect())
}

/// A robot's key nodes as a pose; `positions` in the frame of its base, metres.
pub(crate) fn robot_pose(
    positions: &[Vector3<f64>; KEY_NODES],
    wrists: &[Matrix3<f64>; 2],
) -> KeyNodeFrame {
    KeyNodeFrame {
        positions: positions.map(Vector3::cast),
        wrist_rotations: wrists.map(|wrist| Some(Rotation3::from_matrix_unchecked(wrist.cast()))),
    }
}

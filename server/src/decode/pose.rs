//! A pose off the wire: checked field by field, then as a body.

use emp_motion::{FrameError, KEY_NODES, KeyNode, KeyNodeFrame};
use emp_proto::v1::{HumanPose, Position, Quaternion};
use nalgebra::{Rotation3, Vector3};

use super::fields;
use crate::error::FieldError;

/// Largest distance of a node from the waist, metres.
const FARTHEST: f32 = 5.0;

/// Reads a pose and moves its origin to the waist. Field paths start at the message that holds `pose`.
pub(crate) fn read(pose: Option<&HumanPose>) -> Result<KeyNodeFrame, FieldError> {
    let pose = pose.ok_or_else(|| FieldError::new("pose", "it is missing"))?;
    read_at("pose", pose)
}

/// Reads a pose and moves its origin to the waist; `path` is where it stands in its message.
fn read_at(path: &str, pose: &HumanPose) -> Result<KeyNodeFrame, FieldError> {
    let nodes = nodes(pose);
    let given = nodes.iter().flatten().count();
    let mut positions = [Vector3::zeros(); KEY_NODES];
    for (node, position) in KeyNode::ALL.into_iter().zip(nodes) {
        let position = position.ok_or_else(|| {
            let description =
                format!("it is missing; the retargeter needs all {KEY_NODES} key nodes, this pose has {given}");
            FieldError::new(format!("{path}.{}", node.name()), description)
        })?;
        positions[node as usize] = read_position(&format!("{path}.{}", node.name()), position)?;
    }
    let waist = positions[KeyNode::Waist as usize];
    for position in &mut positions {
        *position -= waist;
    }
    let wrist_rotations = [
        read_rotation(
            &format!("{path}.left_wrist_orientation"),
            pose.left_wrist_orientation.as_ref(),
        )?,
        read_rotation(
            &format!("{path}.right_wrist_orientation"),
            pose.right_wrist_orientation.as_ref(),
        )?,
    ];
    let frame = KeyNodeFrame {
        positions,
        wrist_rotations,
    };
    // Where the retargeter does not need them they are checked all the same.
    if let Some(head) = &pose.head {
        let head = read_position(&format!("{path}.head"), head)?;
        if (head - waist).norm() > FARTHEST {
            let description = format!("more than {FARTHEST} m from the waist");
            return Err(FieldError::new(format!("{path}.head"), description));
        }
    }
    read_rotation(
        &format!("{path}.head_orientation"),
        pose.head_orientation.as_ref(),
    )?;
    frame.validate().map_err(|error| {
        FieldError::new(format!("{path}.{}", field_of(&error)), error.to_string())
    })?;
    Ok(frame)
}

/// The heading of the shoulders in a pose: the yaw that takes x to where the chest faces, rad.
pub(crate) fn heading(frame: &KeyNodeFrame) -> f32 {
    let [left, right] = [KeyNode::LeftShoulder, KeyNode::RightShoulder];
    let across = frame.positions[left as usize] - frame.positions[right as usize];
    (-across.x).atan2(across.y)
}

/// The pose turned about the vertical by `yaw`, rad.
pub(crate) fn turned(frame: &KeyNodeFrame, yaw: f32) -> KeyNodeFrame {
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw);
    KeyNodeFrame {
        positions: frame.positions.map(|position| turn * position),
        wrist_rotations: frame.wrist_rotations.map(|wrist| wrist.map(|w| turn * w)),
    }
}

/// The key nodes of a message, in the order of [`KeyNode::ALL`].
fn nodes(pose: &HumanPose) -> [Option<&Position>; KEY_NODES] {
    [
        pose.waist.as_ref(),
        pose.torso.as_ref(),
        pose.left_shoulder.as_ref(),
        pose.right_shoulder.as_ref(),
        pose.left_elbow.as_ref(),
        pose.right_elbow.as_ref(),
        pose.left_wrist.as_ref(),
        pose.right_wrist.as_ref(),
    ]
}

fn read_position(path: &str, position: &Position) -> Result<Vector3<f32>, FieldError> {
    let Position { x, y, z } = *position;
    fields::finite(path, [("x", x), ("y", y), ("z", z)])?;
    Ok(Vector3::new(x, y, z))
}

fn read_rotation(
    path: &str,
    quaternion: Option<&Quaternion>,
) -> Result<Option<Rotation3<f32>>, FieldError> {
    quaternion
        .map(|quaternion| fields::rotation(path, quaternion))
        .transpose()
        .map(|rotation| rotation.map(|rotation| rotation.cast().to_rotation_matrix()))
}

fn field_of(error: &FrameError) -> String {
    match error {
        FrameError::NotFinite { node }
        | FrameError::TooFar { node, .. }
        | FrameError::EmptyBone { node, .. } => (*node).to_owned(),
        FrameError::NotARotation { side } => format!("{side}_wrist_orientation"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn position(x: f32, y: f32, z: f32) -> Option<Position> {
        Some(Position { x, y, z })
    }

    /// Arms hanging, one metre above a free origin.
    fn pose() -> HumanPose {
        HumanPose {
            waist: position(0.0, 0.0, 1.0),
            torso: position(0.0, 0.0, 1.45),
            left_shoulder: position(0.0, 0.2, 1.4),
            right_shoulder: position(0.0, -0.2, 1.4),
            left_elbow: position(0.0, 0.25, 1.1),
            right_elbow: position(0.0, -0.25, 1.1),
            left_wrist: position(0.1, 0.25, 0.9),
            right_wrist: position(0.1, -0.25, 0.9),
            left_wrist_orientation: Some(Quaternion {
                w: 1.0,
                x: 0.0,
                y: 0.0,
                z: 0.0,
            }),
            right_wrist_orientation: None,
            ..HumanPose::default()
        }
    }

    fn refused(change: impl FnOnce(&mut HumanPose)) -> FieldError {
        let mut pose = pose();
        change(&mut pose);
        read(Some(&pose)).expect_err("refused")
    }

    #[test]
    fn the_origin_moves_to_the_waist() {
        let frame = read(Some(&pose())).expect("a good pose");
        assert_eq!(frame.positions[0], Vector3::zeros());
        assert!(
            (frame.positions[KeyNode::LeftWrist as usize] - Vector3::new(0.1, 0.25, -0.1)).norm()
                < 1e-6
        );
        assert_eq!(frame.wrist_rotations, [Some(Rotation3::identity()), None]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        assert_eq!(read(None).expect_err("refused").field, "pose");
        let missing = refused(|pose| pose.right_elbow = None);
        assert_eq!(missing.field, "pose.right_elbow");
        assert!(missing.description.contains("this pose has 7"), "{missing}");
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let error = refused(|pose| pose.left_wrist = position(0.1, value, 0.0));
            assert_eq!(error.field, "pose.left_wrist.y");
        }
        let far = refused(|pose| pose.left_elbow = position(1e30, 0.0, 0.0));
        assert_eq!(far.field, "pose.left_elbow");
        let bone = refused(|pose| pose.left_elbow = pose.left_shoulder);
        assert_eq!(bone.field, "pose.left_elbow");
        let long = refused(|pose| {
            pose.right_wrist_orientation = Some(Quaternion {
                w: 1.0,
                x: 0.5,
                y: 0.0,
                z: 0.0,
            });
        });
        assert_eq!(long.field, "pose.right_wrist_orientation");
        let zero = refused(|pose| pose.left_wrist_orientation = Some(Quaternion::default()));
        assert_eq!(zero.field, "pose.left_wrist_orientation");
        let nan = refused(|pose| {
            pose.left_wrist_orientation = Some(Quaternion {
                w: f32::NAN,
                x: 0.0,
                y: 0.0,
                z: 0.0,
            });
        });
        assert_eq!(nan.field, "pose.left_wrist_orientation.w");
    }

    #[test]
    fn the_heading_of_a_pose_can_be_taken_out() {
        let frame = read(Some(&pose())).expect("a good pose");
        for yaw in [-2.0, 0.0, 0.7] {
            let facing = turned(&frame, yaw);
            assert!((heading(&facing) - yaw).abs() < 1e-5);
            let back = turned(&facing, -heading(&facing));
            let off = back.positions.iter().zip(&frame.positions);
            assert!(off.map(|(a, b)| (a - b).norm()).sum::<f32>() < 1e-5);
        }
    }

    #[test]
    fn a_head_and_hands_name_what_the_retargeter_misses() {
        let headset = HumanPose {
            head: position(0.0, 0.0, 1.7),
            left_wrist: position(0.3, 0.2, 1.2),
            right_wrist: position(0.3, -0.2, 1.2),
            ..HumanPose::default()
        };
        let error = read(Some(&headset)).expect_err("refused");
        assert_eq!(error.field, "pose.waist");
        assert!(error.description.contains("needs all 8"), "{error}");
        let far = refused(|pose| pose.head = position(9.0, 0.0, 0.0));
        assert_eq!(far.field, "pose.head");
        let nan = refused(|pose| pose.head = position(f32::NAN, 0.0, 0.0));
        assert_eq!(nan.field, "pose.head.x");
    }

    #[test]
    fn distances_that_overflow_are_refused() {
        let error = refused(|pose| {
            pose.waist = position(f32::MAX, 0.0, 0.0);
            pose.torso = position(f32::MIN, 0.0, 0.0);
        });
        assert!(error.field.starts_with("pose."), "{error}");
    }
}

//! What one human frame asks of a robot, and how the network sees it.

use candle_core::{Device, Tensor};
use emp_motion::{KEY_NODES, KeyNode, KeyNodeFrame, Side};
use nalgebra::{Matrix3, Vector2, Vector3};

use super::angles::{angle_between, turn_between};

/// The arm bones in the order of [`Target::bones`]: left upper arm, left forearm, right upper arm, right forearm.
pub const BONES: [(KeyNode, KeyNode); 4] = [
    (KeyNode::LeftShoulder, KeyNode::LeftElbow),
    (KeyNode::LeftElbow, KeyNode::LeftWrist),
    (KeyNode::RightShoulder, KeyNode::RightElbow),
    (KeyNode::RightElbow, KeyNode::RightWrist),
];

/// Features of one human node: position (3), first two columns of the wrist's rotation (6), and whether it is known (1).
pub const NODE_FEATURES: usize = 10;

/// Where the features of a node's wrist rotation begin.
const ROTATION_FEATURES: usize = 3;

/// The body on which every human frame is redrawn before the network sees it, metres: people of all sizes, and sources
/// that place the torso node differently, look alike. Only directions matter to the losses.
mod body {
    pub(super) const TORSO_HEIGHT: f32 = 0.30;
    pub(super) const SHOULDER_HEIGHT: f32 = 0.50;
    pub(super) const HALF_SHOULDER_WIDTH: f32 = 0.20;
    pub(super) const UPPER_ARM: f32 = 0.28;
    pub(super) const FOREARM: f32 = 0.25;
}

/// The network's input for a batch: batch × [`KeyNode::ALL`] × [`NODE_FEATURES`].
///
/// # Errors
/// When the tensor cannot be made.
pub fn features(targets: &[Target]) -> candle_core::Result<Tensor> {
    let mut features = Vec::with_capacity(targets.len() * KEY_NODES * NODE_FEATURES);
    for target in targets {
        target.write_features(&mut features);
    }
    let shape = (targets.len(), KEY_NODES, NODE_FEATURES);
    Tensor::from_vec(features, shape, &Device::Cpu)
}

/// What one human frame asks of the robot, in the waist's frame (x forward, y left, z up).
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Unit directions of the arm bones, in the order of [`BONES`].
    pub bones: [Vector3<f64>; 4],
    /// Unit direction of the line from the right shoulder to the left, seen from above: the trunk's yaw.
    pub shoulder_line: Vector2<f64>,
    /// Rotations of the left and right wrist (x to the fingers, z toward the thumb), where the source has them.
    pub wrists: [Option<Matrix3<f64>>; 2],
}

impl Target {
    /// Reads the target off a validated frame.
    pub fn new(frame: &KeyNodeFrame) -> Self {
        let bones = [
            frame.upper_arm(Side::Left),
            frame.forearm(Side::Left),
            frame.upper_arm(Side::Right),
            frame.forearm(Side::Right),
        ];
        let line: Vector2<f64> = frame.shoulder_line().xy().cast();
        Self {
            bones: bones.map(Vector3::cast),
            // A trunk that lies on its side shows no yaw from above.
            shoulder_line: line.try_normalize(1e-3).unwrap_or_else(Vector2::y),
            wrists: frame
                .wrist_rotations
                .map(|wrist| wrist.map(|wrist| wrist.matrix().cast())),
        }
    }

    /// How far the left and the right arm turn on the way to `after`, radians: the most of upper arm, forearm and hand (where
    /// both poses have it).
    pub fn arm_turns(&self, after: &Self) -> [f64; 2] {
        std::array::from_fn(|side| {
            let bone = |i: usize| angle_between(&self.bones[i], &after.bones[i]);
            let hand = match (&self.wrists[side], &after.wrists[side]) {
                (Some(before), Some(after)) => turn_between(before, after),
                _ => 0.0,
            };
            bone(2 * side).max(bone(2 * side + 1)).max(hand)
        })
    }

    /// The same pose in the mirror between left and right.
    pub fn mirrored(&self) -> Self {
        let flip = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
        let [left_upper, left_fore, right_upper, right_fore] = self.bones.map(|bone| flip * bone);
        // A reflection of a rotation is none: the second column, which is made of the others, turns round.
        let [left, right] = self
            .wrists
            .map(|wrist| wrist.map(|wrist| flip * wrist * flip));
        Self {
            bones: [right_upper, right_fore, left_upper, left_fore],
            // The line is from right to left, which change places.
            shoulder_line: Vector2::new(-self.shoulder_line.x, self.shoulder_line.y),
            wrists: [right, left],
        }
    }

    /// Writes the network's input, [`KeyNode::ALL`] × [`NODE_FEATURES`], row-major.
    fn write_features(&self, out: &mut Vec<f32>) {
        let positions = self.canonical_positions();
        for node in KeyNode::ALL {
            let start = out.len();
            out.extend(positions[node as usize].iter());
            out.resize(start + NODE_FEATURES, 0.0);
            let wrist = match node {
                KeyNode::LeftWrist => self.wrists[0],
                KeyNode::RightWrist => self.wrists[1],
                _ => None,
            };
            if let Some(rotation) = wrist {
                let known = start + ROTATION_FEATURES;
                for (feature, value) in out[known..].iter_mut().zip(rotation.as_slice()[..6].iter())
                {
                    *feature = *value as f32;
                }
                out[start + NODE_FEATURES - 1] = 1.0;
            }
        }
    }

    /// Key-node positions of the canonical body in this pose.
    fn canonical_positions(&self) -> [Vector3<f32>; KEY_NODES] {
        let mut positions = [Vector3::zeros(); KEY_NODES];
        let line = self.shoulder_line.cast::<f32>() * body::HALF_SHOULDER_WIDTH;
        let shoulder = Vector3::new(line.x, line.y, body::SHOULDER_HEIGHT);
        positions[KeyNode::Torso as usize] = Vector3::z() * body::TORSO_HEIGHT;
        positions[KeyNode::LeftShoulder as usize] = shoulder;
        positions[KeyNode::RightShoulder as usize] = Vector3::new(-line.x, -line.y, shoulder.z);
        for ((from, to), direction) in BONES.iter().zip(&self.bones) {
            let length = if matches!(to, KeyNode::LeftElbow | KeyNode::RightElbow) {
                body::UPPER_ARM
            } else {
                body::FOREARM
            };
            positions[*to as usize] = positions[*from as usize] + direction.cast::<f32>() * length;
        }
        positions
    }
}

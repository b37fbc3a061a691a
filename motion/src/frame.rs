//! One human pose as eight key nodes.

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::FrameError;

/// Number of key nodes of a pose.
pub const KEY_NODES: usize = 8;

/// Bones shorter than this have no usable direction, metres.
const SHORTEST_BONE: f32 = 1e-3;
/// No node of a body lies farther from its waist, metres.
const LONGEST_REACH: f32 = 5.0;
/// Largest deviation of `RᵀR` from the identity that still counts as a rotation.
const ROTATION_TOLERANCE: f32 = 1e-3;

/// The key nodes of the upper body, in the order used everywhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(usize)]
pub enum KeyNode {
    /// The pelvis, origin of a pose.
    Waist,
    /// The chest, where both arms' chains branch from the spine.
    Torso,
    /// Left glenohumeral joint.
    LeftShoulder,
    /// Right glenohumeral joint.
    RightShoulder,
    /// Left elbow.
    LeftElbow,
    /// Right elbow.
    RightElbow,
    /// Left wrist.
    LeftWrist,
    /// Right wrist.
    RightWrist,
}

impl KeyNode {
    /// All nodes, in order.
    pub const ALL: [Self; KEY_NODES] = [
        Self::Waist,
        Self::Torso,
        Self::LeftShoulder,
        Self::RightShoulder,
        Self::LeftElbow,
        Self::RightElbow,
        Self::LeftWrist,
        Self::RightWrist,
    ];

    /// The node's name in files and messages.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Waist => "waist",
            Self::Torso => "torso",
            Self::LeftShoulder => "left_shoulder",
            Self::RightShoulder => "right_shoulder",
            Self::LeftElbow => "left_elbow",
            Self::RightElbow => "right_elbow",
            Self::LeftWrist => "left_wrist",
            Self::RightWrist => "right_wrist",
        }
    }

    /// The node on whose bone this one hangs; the waist has none.
    #[must_use]
    pub fn parent(self) -> Option<Self> {
        match self {
            Self::Waist => None,
            Self::Torso => Some(Self::Waist),
            Self::LeftShoulder | Self::RightShoulder => Some(Self::Torso),
            Self::LeftElbow => Some(Self::LeftShoulder),
            Self::RightElbow => Some(Self::RightShoulder),
            Self::LeftWrist => Some(Self::LeftElbow),
            Self::RightWrist => Some(Self::RightElbow),
        }
    }

    /// The node's mirror image.
    #[must_use]
    pub fn mirrored(self) -> Self {
        match self {
            Self::Waist | Self::Torso => self,
            Self::LeftShoulder => Self::RightShoulder,
            Self::RightShoulder => Self::LeftShoulder,
            Self::LeftElbow => Self::RightElbow,
            Self::RightElbow => Self::LeftElbow,
            Self::LeftWrist => Self::RightWrist,
            Self::RightWrist => Self::LeftWrist,
        }
    }

    /// Every bone as (near end, far end), parents first.
    pub(crate) fn bones() -> impl Iterator<Item = (Self, Self)> {
        Self::ALL
            .into_iter()
            .filter_map(|node| node.parent().map(|parent| (parent, node)))
    }
}

impl FrameError {
    pub(crate) fn empty_bone(parent: KeyNode, node: KeyNode) -> Self {
        Self::EmptyBone {
            parent: parent.name(),
            node: node.name(),
        }
    }
}

/// A side of the body; as an index, left is 0 and right is 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(usize)]
pub enum Side {
    /// The person's left.
    Left,
    /// The person's right.
    Right,
}

impl Side {
    /// Both sides, left first.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];

    /// `left` or `right`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Left => "left",
            Self::Right => "right",
        }
    }

    /// Shoulder, elbow and wrist of this side.
    #[must_use]
    pub fn arm(self) -> [KeyNode; 3] {
        match self {
            Self::Left => [
                KeyNode::LeftShoulder,
                KeyNode::LeftElbow,
                KeyNode::LeftWrist,
            ],
            Self::Right => [
                KeyNode::RightShoulder,
                KeyNode::RightElbow,
                KeyNode::RightWrist,
            ],
        }
    }
}

/// One human pose.
///
/// Metres; x forward, y left, z up (gravity-aligned); origin at the waist. The heading is removed: x points where the
/// pelvis faces (where the shoulders face if the source has no pelvis), so that the trunk's yaw over the pelvis shows
/// in the shoulder line.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyNodeFrame {
    /// Node positions in the order of [`KeyNode::ALL`], metres.
    pub positions: [Vector3<f32>; KEY_NODES],
    /// Left and right hand: columns x from the wrist to the fingers, z toward the thumb, y = z × x. `None` where the
    /// source does not know.
    pub wrist_rotations: [Option<Rotation3<f32>>; 2],
}

/// The length of each bone of one body, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoneLengths {
    /// Waist to torso.
    pub trunk: f32,
    /// Torso to shoulder, left and right.
    pub collar: [f32; 2],
    /// Shoulder to elbow, left and right.
    pub upper_arm: [f32; 2],
    /// Elbow to wrist, left and right.
    pub forearm: [f32; 2],
}

impl BoneLengths {
    /// The length of the bone that ends at `node`; 0 for the waist.
    #[must_use]
    pub fn of(&self, node: KeyNode) -> f32 {
        match node {
            KeyNode::Waist => 0.0,
            KeyNode::Torso => self.trunk,
            KeyNode::LeftShoulder => self.collar[0],
            KeyNode::RightShoulder => self.collar[1],
            KeyNode::LeftElbow => self.upper_arm[0],
            KeyNode::RightElbow => self.upper_arm[1],
            KeyNode::LeftWrist => self.forearm[0],
            KeyNode::RightWrist => self.forearm[1],
        }
    }
}

impl KeyNodeFrame {
    /// Position of one node, metres.
    #[must_use]
    pub fn position(&self, node: KeyNode) -> Vector3<f32> {
        self.positions[node as usize]
    }

    /// Checks that the pose describes a body: finite, within reach, every bone with a direction, orientations proper.
    ///
    /// # Errors
    /// The first violation, naming the node.
    pub fn validate(&self) -> Result<(), FrameError> {
        let waist = self.position(KeyNode::Waist);
        for node in KeyNode::ALL {
            let position = self.position(node);
            if !position.iter().all(|v| v.is_finite()) {
                return Err(FrameError::NotFinite { node: node.name() });
            }
            let distance = (position - waist).norm();
            // Written so that an overflowing (NaN) distance is refused too.
            if !matches!(
                distance.partial_cmp(&LONGEST_REACH),
                Some(std::cmp::Ordering::Less)
            ) {
                return Err(FrameError::TooFar {
                    node: node.name(),
                    distance,
                    limit: LONGEST_REACH,
                });
            }
        }
        for (parent, node) in KeyNode::bones() {
            if self.bone(parent, node).norm() < SHORTEST_BONE {
                return Err(FrameError::empty_bone(parent, node));
            }
        }
        for side in Side::BOTH {
            if let Some(rotation) = &self.wrist_rotations[side as usize]
                && !is_rotation(rotation.matrix())
            {
                return Err(FrameError::NotARotation { side: side.name() });
            }
        }
        Ok(())
    }

    /// The pose seen in a mirror: left and right exchanged, y negated, hands still right-handed frames.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        let flip = |p: Vector3<f32>| Vector3::new(p.x, -p.y, p.z);
        let positions = KeyNode::ALL.map(|node| flip(self.position(node.mirrored())));
        let turn = |r: &Rotation3<f32>| Rotation3::from_matrix_unchecked(mirror_hand(r.matrix()));
        let [left, right] = &self.wrist_rotations;
        Self {
            positions,
            wrist_rotations: [right.as_ref().map(turn), left.as_ref().map(turn)],
        }
    }

    /// Direction of the upper arm, shoulder to elbow, unit length.
    #[must_use]
    pub fn upper_arm(&self, side: Side) -> Vector3<f32> {
        let [shoulder, elbow, _] = side.arm();
        unit(self.bone(shoulder, elbow))
    }

    /// Direction of the forearm, elbow to wrist, unit length.
    #[must_use]
    pub fn forearm(&self, side: Side) -> Vector3<f32> {
        let [_, elbow, wrist] = side.arm();
        unit(self.bone(elbow, wrist))
    }

    /// Direction from the right to the left shoulder, unit length.
    #[must_use]
    pub fn shoulder_line(&self) -> Vector3<f32> {
        unit(self.bone(KeyNode::RightShoulder, KeyNode::LeftShoulder))
    }

    /// The length of each bone, metres.
    #[must_use]
    pub fn bone_lengths(&self) -> BoneLengths {
        let length = |node: KeyNode| {
            node.parent()
                .map_or(0.0, |parent| self.bone(parent, node).norm())
        };
        BoneLengths {
            trunk: length(KeyNode::Torso),
            collar: [
                length(KeyNode::LeftShoulder),
                length(KeyNode::RightShoulder),
            ],
            upper_arm: [length(KeyNode::LeftElbow), length(KeyNode::RightElbow)],
            forearm: [length(KeyNode::LeftWrist), length(KeyNode::RightWrist)],
        }
    }

    /// The same pose on another body: every bone keeps its direction and takes the length given.
    #[must_use]
    pub fn with_bone_lengths(&self, lengths: &BoneLengths) -> Self {
        let mut positions = self.positions;
        for (parent, node) in KeyNode::bones() {
            positions[node as usize] =
                positions[parent as usize] + unit(self.bone(parent, node)) * lengths.of(node);
        }
        Self {
            positions,
            wrist_rotations: self.wrist_rotations,
        }
    }

    pub(crate) fn bone(&self, from: KeyNode, to: KeyNode) -> Vector3<f32> {
        self.position(to) - self.position(from)
    }
}

/// `v` at unit length; x where it has none, so that a direction is always a number.
fn unit(v: Vector3<f32>) -> Vector3<f32> {
    v.try_normalize(f32::MIN_POSITIVE)
        .unwrap_or_else(Vector3::x)
}

/// A hand frame reflected in the x–z plane. The reflection turns y = z × x around, hence the second sign.
fn mirror_hand(m: &Matrix3<f32>) -> Matrix3<f32> {
    let sign = |i: usize| if i == 1 { -1.0 } else { 1.0 };
    Matrix3::from_fn(|row, column| sign(row) * sign(column) * m[(row, column)])
}

fn is_rotation(m: &Matrix3<f32>) -> bool {
    let error = (m.transpose() * m - Matrix3::identity()).amax();
    error < ROTATION_TOLERANCE && m.determinant() > 0.0
}

//! A person's proportions, and the posing of trunk and arms: two-bone inverse kinematics per arm.

use nalgebra::{Matrix, Matrix3, Rotation3, Vector3};
use rand::{Rng, RngExt};

use crate::{KEY_NODES, KeyNode, KeyNodeFrame, Side};

/// Nearest and farthest hand, as shares of the arm's length: folded elbow, almost straight elbow.
const REACH: [f64; 2] = [0.36, 0.985];
/// Width of the soft approach to either, as a share of the arm's length.
const REACH_SOFTNESS: f64 = 0.01;
/// Radius of the trunk that arms keep out of, and of the head, metres at size 1.
const TRUNK_RADIUS: f64 = 0.11;
const HEAD_RADIUS: f64 = 0.10;
/// Height of the head's centre over the shoulder line, metres at size 1.
const HEAD_HEIGHT: f64 = 0.22;
/// Wrists stay this far apart, metres at size 1.
const HANDS_APART: f64 = 0.05;

/// One arm, in the trunk's frame: x forward, y outward (left for the left arm, right for the right), z up.
#[derive(Clone, Copy, Debug)]
pub(super) struct ArmPose {
    /// Wrist from the shoulder, in arm lengths.
    pub(super) hand: Vector3<f64>,
    /// Turn of the elbow about the line from shoulder to wrist, radians; positive lifts it outward.
    pub(super) swivel: f64,
    /// Turn of the hand about the forearm, radians; positive turns the palm down, 0 is thumb up.
    pub(super) pronation: f64,
    /// Bend of the wrist toward the palm, radians.
    pub(super) flexion: f64,
    /// Bend of the wrist toward the thumb, radians.
    pub(super) deviation: f64,
}

impl ArmPose {
    /// A hand at a place, thumb up, elbow hanging.
    pub(super) fn at(forward: f64, outward: f64, up: f64) -> Self {
        Self {
            hand: Vector3::new(forward, outward, up),
            swivel: 0.0,
            pronation: 0.0,
            flexion: 0.0,
            deviation: 0.0,
        }
    }

    /// Hanging at the side, palm to the thigh.
    pub(super) fn rest() -> Self {
        Self {
            pronation: 0.2,
            ..Self::at(0.10, 0.14, -0.94)
        }
    }

    pub(super) fn swivel(self, swivel: f64) -> Self {
        Self { swivel, ..self }
    }

    /// Sets the hand's pronation, flexion and deviation.
    pub(super) fn turned(self, pronation: f64, flexion: f64, deviation: f64) -> Self {
        Self {
            pronation,
            flexion,
            deviation,
            ..self
        }
    }
}

/// Trunk and both arms.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pose {
    /// Turn of the trunk over the pelvis to the left, radians.
    pub(super) yaw: f64,
    /// Lean of the trunk forward, radians.
    pub(super) lean: f64,
    /// Left and right.
    pub(super) arms: [ArmPose; 2],
}

impl Pose {
    pub(super) fn rest() -> Self {
        Self {
            yaw: 0.0,
            lean: 0.0,
            arms: [ArmPose::rest(); 2],
        }
    }

    pub(super) fn with_arm(mut self, side: Side, arm: ArmPose) -> Self {
        self.arms[side as usize] = arm;
        self
    }

    pub(super) fn with_arms(mut self, sides: &[Side], arm: ArmPose) -> Self {
        for side in sides {
            self.arms[*side as usize] = arm;
        }
        self
    }

    pub(super) fn with_yaw(self, yaw: f64) -> Self {
        Self { yaw, ..self }
    }
}

/// One person's proportions, metres.
#[derive(Clone, Debug)]
pub(super) struct Body {
    size: f64,
    half_breadth: f64,
    waist_to_torso: Vector3<f64>,
    torso_to_shoulders: f64,
    upper_arm: f64,
    forearm: f64,
}

impl Body {
    /// An adult between 1.45 m and 2.0 m with proportions of their own.
    pub(super) fn random(rng: &mut impl Rng) -> Self {
        let size = rng.random_range(0.84..1.16);
        let mut vary =
            |mean: f64, spread: f64| size * mean * rng.random_range(1.0 - spread..1.0 + spread);
        let trunk = vary(0.44, 0.10);
        // Sources put the torso node anywhere between mid-spine and neck.
        let torso_share = vary(0.68, 0.22) / size;
        Self {
            size,
            half_breadth: vary(0.185, 0.12),
            waist_to_torso: Vector3::new(vary(0.02, 1.0) - 0.02, 0.0, trunk * torso_share),
            torso_to_shoulders: trunk * (1.0 - torso_share),
            upper_arm: vary(0.285, 0.08),
            forearm: vary(0.25, 0.08),
        }
    }

    /// Upper arm and forearm, metres.
    pub(super) fn arm_length(&self) -> f64 {
        self.upper_arm + self.forearm
    }

    /// Distance from the shoulder to the trunk's middle, in arm lengths.
    pub(super) fn half_breadth(&self) -> f64 {
        self.half_breadth / self.arm_length()
    }

    /// The key nodes of a pose.
    pub(super) fn frame(&self, pose: &Pose) -> KeyNodeFrame {
        let trunk = Rotation3::from_axis_angle(&Vector3::z_axis(), pose.yaw)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), pose.lean);
        let mut positions = [Vector3::zeros(); KEY_NODES];
        positions[KeyNode::Torso as usize] = trunk * self.waist_to_torso;
        let mut wrists = [None; 2];
        for side in Side::BOTH {
            let outward = if side == Side::Left { 1.0 } else { -1.0 };
            let mirror = |p: Vector3<f64>| Vector3::new(p.x, outward * p.y, p.z);
            let arm = self.arm(&pose.arms[side as usize]);
            let shoulder = self.waist_to_torso
                + Vector3::new(0.0, outward * self.half_breadth, self.torso_to_shoulders);
            let offsets = [Vector3::zeros(), arm.elbow, arm.wrist];
            for (node, offset) in side.arm().into_iter().zip(offsets) {
                positions[node as usize] = trunk * (shoulder + mirror(offset));
            }
            let sign = |i: usize| if i == 1 { outward } else { 1.0 };
            let hand =
                Matrix3::from_fn(|row, column| sign(row) * sign(column) * arm.hand[(row, column)]);
            wrists[side as usize] =
                Some((trunk * Rotation3::from_matrix_unchecked(hand)).cast::<f32>());
        }
        KeyNodeFrame {
            positions: positions.map(Matrix::cast::<f32>),
            wrist_rotations: wrists,
        }
    }

    /// Elbow, wrist (from the shoulder, metres) and hand of a left arm.
    fn arm(&self, pose: &ArmPose) -> LeftArm {
        let direction = pose
            .hand
            .try_normalize(1e-9)
            .unwrap_or_else(|| -Vector3::z());
        let reach = soft_clamp(pose.hand.norm(), REACH) * self.arm_length();
        let wrist = direction * reach;
        // Law of cosines: where the elbow's circle stands on the line to the wrist, and its radius.
        let along = (reach * reach + self.upper_arm.powi(2) - self.forearm.powi(2)) / (2.0 * reach);
        let radius = (self.upper_arm.powi(2) - along * along).max(0.0).sqrt();
        let bulge = elbow_side(&direction, pose.swivel);
        let elbow = direction * along + bulge * radius;
        LeftArm {
            elbow,
            wrist,
            hand: hand(&(wrist - elbow), &bulge, pose),
        }
    }

    /// Whether elbows and wrists are outside trunk and head, and the wrists apart.
    pub(super) fn is_clear(&self, frame: &KeyNodeFrame) -> bool {
        let node = |n: KeyNode| frame.position(n).cast::<f64>();
        let shoulders = (node(KeyNode::LeftShoulder) + node(KeyNode::RightShoulder)) * 0.5;
        let axis = shoulders.normalize();
        let head = shoulders + axis * HEAD_HEIGHT * self.size;
        let outside = |p: Vector3<f64>| {
            let nearest = axis * p.dot(&axis).clamp(0.0, shoulders.norm());
            (p - nearest).norm() > TRUNK_RADIUS * self.size
                && (p - head).norm() > HEAD_RADIUS * self.size
        };
        let arms = Side::BOTH.map(Side::arm);
        arms.iter()
            .all(|[_, elbow, wrist]| outside(node(*elbow)) && outside(node(*wrist)))
            && (node(KeyNode::LeftWrist) - node(KeyNode::RightWrist)).norm()
                > HANDS_APART * self.size
    }
}

struct LeftArm {
    elbow: Vector3<f64>,
    wrist: Vector3<f64>,
    hand: Matrix3<f64>,
}

/// Unit vector from the line shoulder–wrist to a left elbow.
///
/// A natural elbow direction for a hand held low, forward and outward is carried along great circles to the hand's
/// actual direction. This is smooth everywhere but at the opposite direction, up, back and inward, where no hand goes.
fn elbow_side(direction: &Vector3<f64>, swivel: f64) -> Vector3<f64> {
    let home = Vector3::new(0.6, 0.6, -0.5).normalize();
    let hanging = Vector3::new(-0.3, 0.3, -1.0);
    let hanging = (hanging - home * home.dot(&hanging)).normalize();
    let carry = Rotation3::rotation_between(&home, direction).unwrap_or_else(Rotation3::identity);
    Rotation3::from_scaled_axis(direction * swivel) * (carry * hanging)
}

/// A left hand's axes. Neutral: fingers along the forearm, thumb in the elbow's plane on the inner side of the bend.
fn hand(forearm: &Vector3<f64>, bulge: &Vector3<f64>, pose: &ArmPose) -> Matrix3<f64> {
    let x = forearm.normalize();
    let z = -(bulge - x * x.dot(bulge)).normalize();
    let neutral = Matrix3::from_columns(&[x, z.cross(&x), z]);
    let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), pose.pronation)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), -pose.flexion)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), -pose.deviation);
    neutral * turn.matrix()
}

/// `value` held between two limits with continuous derivatives.
fn soft_clamp(value: f64, [low, high]: [f64; 2]) -> f64 {
    let soft_plus = |x: f64| REACH_SOFTNESS * (x / REACH_SOFTNESS).exp().ln_1p();
    let above = low + soft_plus(value - low);
    high - soft_plus(high - above)
}

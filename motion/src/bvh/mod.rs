//! BVH files: any joint names of the alias table, any Euler order, 3- and 6-channel joints.
//!
//! Position channels replace a joint's OFFSET. The waist is the pelvis joint, the torso the joint where both arms'
//! chains part. The first frame is dropped where it is an inserted rest pose, that is where the body jumps between it
//! and the next one. Facing follows from which joints are left and right, so it needs no convention.

mod aliases;
mod parse;
mod skeleton;

use std::path::Path;

use nalgebra::{Rotation3, Unit, Vector3};

use crate::source::{self, Heading, WorldFrame};
use crate::{Clip, KEY_NODES, KeyNode, MotionError, Side};
use parse::{Channel, Document, Joint};
use skeleton::Skeleton;

/// Metres in one file unit, for the units that occur: metre, centimetre, millimetre, inch, and the CMU database's own.
const UNITS: [f64; 5] = [1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45];
/// Upper arm and forearm of an average adult, metres.
const ARM_LENGTH: f64 = 0.53;
/// Arm lengths that a known unit may result in, metres; outside, the skeleton is scaled to the average adult.
const PLAUSIBLE_ARM: std::ops::RangeInclusive<f64> = 0.33..=0.80;
/// Where the arms part at the waist itself, the torso is put at this share of the way to the shoulders.
const TORSO_SHARE: f64 = 0.6;
/// Frames looked at to find the up axis and the arms' length.
const PROBES: usize = 200;
/// An inserted rest pose moves some node at least this far, metres, …
const REST_POSE_JUMP: f32 = 0.05;
/// … and this many times as far as any of the following frames.
const REST_POSE_RATIO: f32 = 4.0;
/// Number of following frames compared with.
const REST_POSE_CONTEXT: usize = 10;

/// The axis of a file that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UpAxis {
    /// x points up.
    X,
    /// y points up, as in most BVH files.
    Y,
    /// z points up.
    Z,
}

/// What a BVH file does not say.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BvhOptions {
    /// Metres in one unit of the file. `None`: detected by the arms' length.
    pub metres_per_unit: Option<f64>,
    /// `None`: detected as the axis along which the shoulders are above the waist on average.
    pub up: Option<UpAxis>,
}

/// Reads a BVH file.
///
/// # Errors
/// [`MotionError`] with the line for broken text, with the frame for a pose that is no body's.
pub fn read(path: &Path, options: &BvhOptions) -> Result<Clip, MotionError> {
    from_bytes(path, &source::read_file(path)?, options)
}

/// Reads a BVH file's content; `path` names the clip and the errors.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(path: &Path, bytes: &[u8], options: &BvhOptions) -> Result<Clip, MotionError> {
    if let Some(scale) = options.metres_per_unit
        && !(scale.is_finite() && scale > 0.0)
    {
        return Err(MotionError::format(
            path,
            format!("{scale} metres a unit: expected a positive number"),
        ));
    }
    let document = parse::parse(path, &String::from_utf8_lossy(bytes))?;
    let body = Body::new(path, &document)?;
    let probes: Vec<WorldFrame> = (0..document.frames)
        .step_by(document.frames.div_ceil(PROBES))
        .map(|i| body.frame(document.frame(i)))
        .collect();
    let to_metres = options
        .metres_per_unit
        .unwrap_or_else(|| metres_per_unit(&probes));
    let upright = upright(options.up.unwrap_or_else(|| up_axis(&probes)));
    let frames: Vec<WorldFrame> = (0..document.frames)
        .map(|i| oriented(&body.frame(document.frame(i)), to_metres, &upright))
        .collect();
    let heading = if body.skeleton.hips.is_some() {
        Heading::Steady
    } else {
        Heading::Exact
    };
    let clip = source::into_clip(path, document.fps, &frames, heading)?;
    Ok(without_rest_pose(clip))
}

/// A skeleton ready to pose.
struct Body<'a> {
    joints: &'a [Joint],
    skeleton: Skeleton,
    /// Per side, from the hand joint's frame to the hand convention.
    hands: [Option<Rotation3<f64>>; 2],
}

impl<'a> Body<'a> {
    fn new(path: &Path, document: &'a Document) -> Result<Self, MotionError> {
        let joints = &document.joints;
        let skeleton = Skeleton::find(path, joints)?;
        let rest = skeleton::rest_positions(joints);
        let hands = Side::BOTH.map(|side| skeleton::hand_frame(joints, &skeleton, &rest, side));
        Ok(Self {
            joints,
            skeleton,
            hands,
        })
    }

    /// The pose of one line of values, in the file's units and axes.
    fn frame(&self, values: &[f64]) -> WorldFrame {
        let (positions, rotations) = forward(self.joints, values);
        let [left, right] = &self.skeleton.arms;
        let [hip_left, hip_right] = self
            .skeleton
            .hips
            .unwrap_or([left.shoulder, right.shoulder]);
        let shoulders = (positions[left.shoulder] + positions[right.shoulder]) * 0.5;
        let waist = positions[self.skeleton.waist];
        let torso = self.skeleton.torso.map_or_else(
            || waist.lerp(&shoulders, TORSO_SHARE),
            |torso| positions[torso],
        );
        let mut nodes = [waist; KEY_NODES];
        nodes[KeyNode::Torso as usize] = torso;
        for (side, arm) in Side::BOTH.into_iter().zip(&self.skeleton.arms) {
            for (node, joint) in side
                .arm()
                .into_iter()
                .zip([arm.shoulder, arm.elbow, arm.wrist])
            {
                nodes[node as usize] = positions[joint];
            }
        }
        let wrist = |side: Side| {
            self.hands[side as usize]
                .map(|hand| rotations[self.skeleton.arms[side as usize].wrist] * hand)
        };
        WorldFrame {
            positions: nodes,
            left: positions[hip_left] - positions[hip_right],
            wrists: Side::BOTH.map(wrist),
        }
    }
}

/// Position and orientation of every joint.
fn forward(joints: &[Joint], values: &[f64]) -> (Vec<Vector3<f64>>, Vec<Rotation3<f64>>) {
    let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
    let mut positions: Vec<Vector3<f64>> = Vec::with_capacity(joints.len());
    let mut rotations: Vec<Rotation3<f64>> = Vec::with_capacity(joints.len());
    for joint in joints {
        let mut offset = joint.offset;
        let mut turn = Rotation3::identity();
        for (channel, value) in joint.channels.iter().zip(&values[joint.first_value..]) {
            match channel {
                Channel::Position(axis) => offset[*axis] = *value,
                Channel::Rotation(axis) => {
                    turn *= Rotation3::from_axis_angle(&axes[*axis], value.to_radians());
                }
            }
        }
        let (position, rotation) = joint.parent.map_or_else(
            || (offset, turn),
            |p| (positions[p] + rotations[p] * offset, rotations[p] * turn),
        );
        positions.push(position);
        rotations.push(rotation);
    }
    (positions, rotations)
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
    sum / count
}

/// The known unit in which the arms come out nearest to an adult's; the average adult's where none is plausible.
fn metres_per_unit(probes: &[WorldFrame]) -> f64 {
    let length = |frame: &WorldFrame| {
        let bone = |a: KeyNode, b: KeyNode| {
            (frame.positions[b as usize] - frame.positions[a as usize]).norm()
        };
        Side::BOTH
            .iter()
            .map(|side| side.arm())
            .map(|[s, e, w]| bone(s, e) + bone(e, w))
            .sum::<f64>()
            / 2.0
    };
    let arm = mean(probes.iter().map(length));
    let miss = |unit: f64| (arm * unit / ARM_LENGTH).ln().abs();
    let best = UNITS
        .into_iter()
        .min_by(|a, b| miss(*a).total_cmp(&miss(*b)))
        .unwrap_or(1.0);
    if PLAUSIBLE_ARM.contains(&(arm * best)) {
        best
    } else {
        ARM_LENGTH / arm
    }
}

fn up_axis(probes: &[WorldFrame]) -> UpAxis {
    let trunk = |frame: &WorldFrame| {
        let node = |n: KeyNode| frame.positions[n as usize];
        (node(KeyNode::LeftShoulder) + node(KeyNode::RightShoulder)) * 0.5 - node(KeyNode::Waist)
    };
    let height = |axis: usize| mean(probes.iter().map(|frame| trunk(frame)[axis]));
    let (x, y, z) = (height(0), height(1), height(2));
    if y >= x && y >= z {
        UpAxis::Y
    } else if z >= x {
        UpAxis::Z
    } else {
        UpAxis::X
    }
}

/// The rotation that takes the up axis to z.
fn upright(up: UpAxis) -> Rotation3<f64> {
    use std::f64::consts::FRAC_PI_2;
    let (axis, angle): (Unit<Vector3<f64>>, f64) = match up {
        UpAxis::X => (Vector3::y_axis(), -FRAC_PI_2),
        UpAxis::Y => (Vector3::x_axis(), FRAC_PI_2),
        UpAxis::Z => (Vector3::z_axis(), 0.0),
    };
    Rotation3::from_axis_angle(&axis, angle)
}

fn oriented(frame: &WorldFrame, to_metres: f64, upright: &Rotation3<f64>) -> WorldFrame {
    WorldFrame {
        positions: frame.positions.map(|p| upright * p * to_metres),
        left: upright * frame.left,
        wrists: frame.wrists.map(|r| r.map(|r| upright * r)),
    }
}

/// Drops the first frame where the body jumps between it and the second one.
fn without_rest_pose(mut clip: Clip) -> Clip {
    let steps: Vec<f32> = clip
        .frames
        .windows(2)
        .take(REST_POSE_CONTEXT + 1)
        .map(|pair| {
            KeyNode::ALL
                .iter()
                .map(|n| (pair[1].position(*n) - pair[0].position(*n)).norm())
                .fold(0.0, f32::max)
        })
        .collect();
    if let [first, following @ ..] = steps.as_slice()
        && !following.is_empty()
        && *first > REST_POSE_JUMP
        && *first > REST_POSE_RATIO * following.iter().copied().fold(0.0, f32::max)
    {
        clip.frames.remove(0);
    }
    clip
}

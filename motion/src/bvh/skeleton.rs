//! Which joints of a BVH tree are the key nodes, and how its hands are built.

use std::path::Path;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::aliases::{ARMS, ArmScheme, HIPS, SIDES, THUMB, WAIST};
use super::parse::Joint;
use crate::{MotionError, Side};

/// Cosine of the largest angle between a T pose's arm and the line through the shoulders.
const T_POSE: f64 = 0.87;
/// A thumb nearer than this to the finger's direction (sine of the angle) says nothing about the hand's roll.
const THUMB_APART: f64 = 0.25;

/// The joints that carry the key nodes, as indices into the tree.
#[derive(Debug)]
pub(super) struct Skeleton {
    pub(super) waist: usize,
    /// The joint where both arms' chains part; `None` where that is the waist itself.
    pub(super) torso: Option<usize>,
    pub(super) arms: [Arm; 2],
    /// Left and right hip joint.
    pub(super) hips: Option<[usize; 2]>,
}

/// One arm's joints.
#[derive(Debug)]
pub(super) struct Arm {
    pub(super) shoulder: usize,
    pub(super) elbow: usize,
    pub(super) wrist: usize,
}

impl Skeleton {
    pub(super) fn find(path: &Path, joints: &[Joint]) -> Result<Self, MotionError> {
        let names = Names::new(joints);
        let arms = [Side::Left, Side::Right].map(|side| find_arm(&names, joints, side));
        let [Some(left), Some(right)] = arms else {
            let side = if arms[0].is_none() { "left" } else { "right" };
            let known: Vec<&str> = joints
                .iter()
                .map(|j| j.name.as_str())
                .filter(|n| !n.is_empty())
                .take(40)
                .collect();
            let reason = format!(
                "no known names for the {side} shoulder and elbow among the joints {}",
                known.join(", ")
            );
            return Err(MotionError::format(path, reason));
        };
        let waist = WAIST.iter().find_map(|name| names.find(name)).unwrap_or(0);
        let torso = common_ancestor(joints, left.shoulder, right.shoulder).filter(|torso| {
            *torso != waist && ancestors(joints, *torso).any(|joint| joint == waist)
        });
        let hips = [Side::Left, Side::Right]
            .map(|side| HIPS.iter().find_map(|name| names.find_sided(name, side)));
        let hips = if let [Some(l), Some(r)] = hips {
            Some([l, r])
        } else {
            None
        };
        Ok(Self {
            waist,
            torso,
            arms: [left, right],
            hips,
        })
    }
}

/// Joint names in the form the alias table has.
struct Names {
    plain: Vec<String>,
    without_prefix: Vec<String>,
}

impl Names {
    fn new(joints: &[Joint]) -> Self {
        let plain: Vec<String> = joints.iter().map(|joint| simplified(&joint.name)).collect();
        let prefix = common_prefix(plain.iter().filter(|name| !name.is_empty()));
        let without_prefix = plain
            .iter()
            .map(|name| name.get(prefix..).unwrap_or("").to_owned())
            .collect();
        Self {
            plain,
            without_prefix,
        }
    }

    fn find(&self, alias: &str) -> Option<usize> {
        let position = |names: &[String]| names.iter().position(|name| name == alias);
        position(&self.plain).or_else(|| position(&self.without_prefix))
    }

    fn find_sided(&self, alias: &str, side: Side) -> Option<usize> {
        let bare = alias.trim_start_matches('@');
        SIDES[side as usize].iter().find_map(|word| {
            self.find(&format!("{word}{bare}"))
                .or_else(|| self.find(&format!("{bare}{word}")))
        })
    }
}

/// Lower case, letters and digits only, without a namespace.
fn simplified(name: &str) -> String {
    let bare = name.rsplit(':').next().unwrap_or(name);
    bare.chars()
        .filter(char::is_ascii_alphanumeric)
        .map(|c| c.to_ascii_lowercase())
        .collect()
}

/// Length of the prefix that all names share; they are ASCII.
fn common_prefix<'a>(mut names: impl Iterator<Item = &'a String>) -> usize {
    let Some(first) = names.next() else { return 0 };
    names.fold(first.len(), |length, name| {
        first
            .bytes()
            .zip(name.bytes())
            .take(length)
            .take_while(|(a, b)| a == b)
            .count()
    })
}

fn find_arm(names: &Names, joints: &[Joint], side: Side) -> Option<Arm> {
    ARMS.iter()
        .find_map(|scheme| match_scheme(names, joints, scheme, side))
}

fn match_scheme(names: &Names, joints: &[Joint], scheme: &ArmScheme, side: Side) -> Option<Arm> {
    let shoulder = names.find_sided(scheme.shoulder, side)?;
    let elbow = names.find_sided(scheme.elbow, side)?;
    let below = |joint: usize, ancestor: usize| ancestors(joints, joint).any(|j| j == ancestor);
    if !below(elbow, shoulder) {
        return None;
    }
    let named = scheme
        .wrist
        .iter()
        .find_map(|name| names.find_sided(name, side));
    let wrist = named
        .filter(|wrist| below(*wrist, elbow))
        .or_else(|| children(joints, elbow).next())?;
    Some(Arm {
        shoulder,
        elbow,
        wrist,
    })
}

/// The joints above `joint`, nearest first.
fn ancestors(joints: &[Joint], joint: usize) -> impl Iterator<Item = usize> {
    std::iter::successors(joints[joint].parent, |joint| joints[*joint].parent)
}

fn children(joints: &[Joint], parent: usize) -> impl Iterator<Item = usize> {
    (0..joints.len()).filter(move |joint| joints[*joint].parent == Some(parent))
}

fn common_ancestor(joints: &[Joint], a: usize, b: usize) -> Option<usize> {
    ancestors(joints, a).find(|joint| ancestors(joints, b).any(|other| other == *joint))
}

/// Position of every joint with all rotations zero, file units, root at the origin.
pub(super) fn rest_positions(joints: &[Joint]) -> Vec<Vector3<f64>> {
    let mut positions: Vec<Vector3<f64>> = Vec::with_capacity(joints.len());
    for joint in joints {
        let parent = joint
            .parent
            .map_or_else(Vector3::zeros, |parent| positions[parent]);
        positions.push(parent + joint.offset);
    }
    positions
}

/// Turns a hand joint's frame into the hand convention (x to the fingers, z to the thumb), by the rest pose: the
/// fingers from the hand's (or forearm's) bone; the thumb from a thumb joint or, where there is none and the arm is
/// stretched sideways as in a T pose, forward. `None` where the wrist has no rotation of its own or the rest pose
/// does not tell.
pub(super) fn hand_frame(
    joints: &[Joint],
    skeleton: &Skeleton,
    rest: &[Vector3<f64>],
    side: Side,
) -> Option<Rotation3<f64>> {
    let arm = &skeleton.arms[side as usize];
    if !joints[arm.wrist].rotates() {
        return None;
    }
    let fingers = finger_direction(joints, rest, arm)?;
    let thumb = thumb_direction(joints, rest, arm, &fingers)
        .or_else(|| t_pose_forward(skeleton, rest, arm, side))?;
    let x = fingers;
    let z = (thumb - x * x.dot(&thumb)).try_normalize(1e-6)?;
    Some(Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
        x,
        z.cross(&x),
        z,
    ])))
}

/// Descendants of `joint`, nearest first along the file's order.
fn descendants(joints: &[Joint], joint: usize) -> impl Iterator<Item = usize> {
    (joint + 1..joints.len()).filter(move |other| ancestors(joints, *other).any(|a| a == joint))
}

fn is_thumb(joints: &[Joint], joint: usize) -> bool {
    let named = |j: usize| simplified(&joints[j].name).contains(THUMB);
    named(joint) || ancestors(joints, joint).any(named)
}

fn finger_direction(joints: &[Joint], rest: &[Vector3<f64>], arm: &Arm) -> Option<Vector3<f64>> {
    let wrist = rest[arm.wrist];
    let forearm = wrist - rest[arm.elbow];
    let apart = 0.02 * forearm.norm();
    descendants(joints, arm.wrist)
        .filter(|joint| !is_thumb(joints, *joint))
        .find_map(|joint| (rest[joint] - wrist).try_normalize(apart))
        .or_else(|| forearm.try_normalize(1e-9))
}

fn thumb_direction(
    joints: &[Joint],
    rest: &[Vector3<f64>],
    arm: &Arm,
    fingers: &Vector3<f64>,
) -> Option<Vector3<f64>> {
    descendants(joints, arm.wrist)
        .filter(|joint| is_thumb(joints, *joint))
        .find_map(|joint| {
            let direction = (rest[joint] - rest[arm.wrist]).try_normalize(1e-9)?;
            (direction.cross(fingers).norm() > THUMB_APART).then_some(direction)
        })
}

fn t_pose_forward(
    skeleton: &Skeleton,
    rest: &[Vector3<f64>],
    arm: &Arm,
    side: Side,
) -> Option<Vector3<f64>> {
    let [left, right] = skeleton.arms.each_ref().map(|a| rest[a.shoulder]);
    let to_left = (left - right).try_normalize(1e-9)?;
    let up = ((left + right) * 0.5 - rest[skeleton.waist]).try_normalize(1e-9)?;
    let outward = if side == Side::Left {
        to_left
    } else {
        -to_left
    };
    let stretched = (rest[arm.wrist] - rest[arm.shoulder]).try_normalize(1e-9)?;
    (stretched.dot(&outward) > T_POSE).then(|| to_left.cross(&up))
}

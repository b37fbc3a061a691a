//! What a tree's rest pose tells of its hands.

use nalgebra::Vector3;

use super::parts::{Arm, NamedTree, Skeleton, Waist};
use crate::Side;
use crate::hands::{HandAxes, Thumb};
use crate::names::Part;

/// Cosine of the largest angle between a T pose's arm and the line through the shoulders.
const T_POSE: f64 = 0.87;
/// A thumb nearer than this to the finger's direction (sine of the angle) says nothing about the hand's roll.
const THUMB_APART: f64 = 0.25;

/// The axes of one hand, in its wrist joint's own axes.
pub(super) fn axes(tree: &NamedTree, skeleton: &Skeleton, side: Side) -> HandAxes {
    let arm = &skeleton.arms[side as usize];
    if !tree.tree.joints[arm.wrist].rotates() {
        return HandAxes::None("the wrist has no rotation of its own");
    }
    let stretched = t_pose_forward(tree, skeleton, side);
    let bone = finger_direction(tree, arm);
    let fingers = bone.or_else(|| stretched.and(forearm(tree, arm)));
    let Some(fingers) = fingers else {
        return HandAxes::Untold;
    };
    let thumb = match (seen_thumb(tree, arm, &fingers), stretched) {
        (Some(thumb), _) => Thumb::Seen(thumb),
        (None, Some(forward)) => Thumb::Forward(forward),
        (None, None) => Thumb::Untold,
    };
    HandAxes::Rest { fingers, thumb }
}

/// How far the thumbs point forward in a rest pose with stretched arms, −1 to 1.
pub(super) fn thumbs_forward(tree: &NamedTree, skeleton: &Skeleton) -> Option<f64> {
    let thumb = |side: Side| {
        let arm = &skeleton.arms[side as usize];
        let forward = t_pose_forward(tree, skeleton, side)?;
        let fingers = finger_direction(tree, arm).or_else(|| forearm(tree, arm))?;
        let thumb = thumb_joint(tree, arm, &fingers)?;
        Some(
            (thumb - fingers * fingers.dot(&thumb))
                .try_normalize(1e-9)?
                .dot(&forward),
        )
    };
    let [left, right] = Side::BOTH.map(thumb);
    Some((left? + right?) * 0.5)
}

fn forearm(tree: &NamedTree, arm: &Arm) -> Option<Vector3<f64>> {
    (tree.tree.rest[arm.wrist] - tree.tree.rest[arm.elbow]).try_normalize(1e-9)
}

fn is_on_thumb(tree: &NamedTree, joint: usize) -> bool {
    let thumb = |j: usize| tree.names[j].part == Some(Part::Thumb);
    thumb(joint) || tree.tree.ancestors(joint).any(thumb)
}

/// From the wrist to the first joint of the hand that is none of the thumb's.
fn finger_direction(tree: &NamedTree, arm: &Arm) -> Option<Vector3<f64>> {
    let rest = &tree.tree.rest;
    let wrist = rest[arm.wrist];
    let apart = 0.02 * (wrist - rest[arm.elbow]).norm();
    tree.tree
        .descendants(arm.wrist)
        .filter(|joint| !is_on_thumb(tree, *joint))
        .find_map(|joint| (rest[joint] - wrist).try_normalize(apart))
}

/// The thumb's side of the hand, by a thumb's joint or by the line from the little finger to the index finger.
fn seen_thumb(tree: &NamedTree, arm: &Arm, fingers: &Vector3<f64>) -> Option<Vector3<f64>> {
    thumb_joint(tree, arm, fingers).or_else(|| {
        let finger = |part: Part| {
            let mut joints = tree.tree.descendants(arm.wrist);
            joints
                .find(|j| tree.names[*j].part == Some(part))
                .map(|j| tree.tree.rest[j])
        };
        let across = finger(Part::Index)? - finger(Part::Little)?;
        let across = across.try_normalize(1e-9)?;
        (across.cross(fingers).norm() > THUMB_APART).then_some(across)
    })
}

fn thumb_joint(tree: &NamedTree, arm: &Arm, fingers: &Vector3<f64>) -> Option<Vector3<f64>> {
    let rest = &tree.tree.rest;
    tree.tree
        .descendants(arm.wrist)
        .filter(|joint| is_on_thumb(tree, *joint))
        .find_map(|joint| {
            let direction = (rest[joint] - rest[arm.wrist]).try_normalize(1e-9)?;
            (direction.cross(fingers).norm() > THUMB_APART).then_some(direction)
        })
}

/// Left × up of a rest pose whose arm is stretched sideways.
fn t_pose_forward(tree: &NamedTree, skeleton: &Skeleton, side: Side) -> Option<Vector3<f64>> {
    let rest = &tree.tree.rest;
    let arm = &skeleton.arms[side as usize];
    let waist = match (skeleton.waist, skeleton.hips) {
        (Waist::BetweenHips, Some([left, right])) => (rest[left] + rest[right]) * 0.5,
        (Waist::Joint(joint), _) => rest[joint],
        (Waist::BetweenHips, None) => return None,
    };
    let [left, right] = skeleton.arms.map(|a| rest[a.shoulder]);
    let to_left = (left - right).try_normalize(1e-9)?;
    let up = ((left + right) * 0.5 - waist).try_normalize(1e-9)?;
    let outward = if side == Side::Left {
        to_left
    } else {
        -to_left
    };
    let stretched = (rest[arm.wrist] - rest[arm.shoulder]).try_normalize(1e-9)?;
    (stretched.dot(&outward) > T_POSE).then(|| to_left.cross(&up))
}

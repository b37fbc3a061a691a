//! BVH files: any joint names, any Euler order, 3- and 6-channel joints.
//!
//! Inner joints' position channels replace a joint's OFFSET or add to it, as the data tell. The waist is the pelvis
//! joint, the torso the joint where both arms' chains part. The first frame is dropped where it is an inserted rest
//! pose, that is where the body jumps between it and the next one. Facing follows from which joints are left and right,
//! so it needs no convention.

mod parse;
mod parts;
mod rest_hand;
mod skeleton;
mod structure;
mod tree;

use std::path::Path;

use nalgebra::{Rotation3, Vector3};

use crate::orientation::{Leg, Probe, bounds};
use crate::source::{self, Heading, Take, node_joint};
use crate::understanding::{NodeJoint, Reading};
use crate::world_frame::WorldFrame;
use crate::{Clip, KEY_NODES, KeyNode, MotionError, ReadOptions, Side, names, text};
use parts::{LegJoints, NamedTree, Skeleton, Waist};
use tree::Tree;

/// Where the arms part at the waist itself, the torso is put at this share of the way to the shoulders.
const TORSO_SHARE: f64 = 0.6;
/// An inserted rest pose moves some node at least this far, metres, …
const REST_POSE_JUMP: f32 = 0.05;
/// … and this many times as far as any of the following frames.
const REST_POSE_RATIO: f32 = 4.0;
/// Number of following frames compared with.
const REST_POSE_CONTEXT: usize = 10;

/// Reads a BVH file.
///
/// # Errors
/// [`MotionError`] with the line for broken text, with the frame for a pose that is no body's.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, MotionError> {
    from_bytes(path, &source::read_file(path)?, options)
}

/// Reads a BVH file's content; `path` names the clip and the errors.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(
    path: &Path,
    bytes: &[u8],
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    let mut warnings = Vec::new();
    let document = parse::parse(path, &text::decode(bytes), options.fps, &mut warnings)?;
    let tree = Tree::new(&document);
    let named = NamedTree::new(&tree);
    let skeleton = Skeleton::find(path, &named, options, &mut warnings)?;
    let body = Body::new(&tree, &skeleton);
    let poses = |index: usize| tree.pose(document.frame(index));
    let joint_names: Vec<&str> = tree
        .joints
        .iter()
        .map(|joint| joint.name.as_str())
        .collect();
    let scheme = names::scheme(&joint_names);
    let take = Take {
        format: "BVH",
        naming: scheme.to_owned(),
        fps: document.fps,
        frames: (0..document.frames)
            .map(|i| body.frame(&poses(i)))
            .collect(),
        probes: source::probed(document.frames)
            .map(|i| body.probe(&poses(i)))
            .collect(),
        rest: Some(body.probe(&(
            tree.rest.clone(),
            vec![Rotation3::identity(); tree.rest.len()],
        ))),
        heading: if skeleton.hips.is_some() {
            Heading::Steady
        } else {
            Heading::Exact
        },
        joints: body.joint_names(),
        unit: None,
        up: None,
        hands: Side::BOTH.map(|side| rest_hand::axes(&named, &skeleton, side)),
        thumbs: rest_hand::thumbs_forward(&named, &skeleton),
        warnings,
    };
    let mut reading = source::finish(path, take, options)?;
    if drop_rest_pose(&mut reading.clip) {
        reading.understanding.frames -= 1;
        reading
            .understanding
            .warnings
            .push("the first frame is an inserted rest pose and is left out".to_owned());
    }
    Ok(reading)
}

/// Positions and orientations of all joints.
type Pose = (Vec<Vector3<f64>>, Vec<Rotation3<f64>>);

/// A skeleton in its tree, ready to be read off poses.
struct Body<'a> {
    tree: &'a Tree<'a>,
    skeleton: &'a Skeleton,
    /// The joints of the person, for the bounds of a pose.
    person: Vec<usize>,
    /// The same without the arms, where the person has legs.
    without_arms: Vec<usize>,
}

impl<'a> Body<'a> {
    fn new(tree: &'a Tree<'a>, skeleton: &'a Skeleton) -> Self {
        let waist = match skeleton.waist {
            Waist::Joint(joint) => joint,
            Waist::BetweenHips => skeleton.root,
        };
        let person: Vec<usize> = std::iter::once(waist)
            .chain(tree.descendants(waist))
            .collect();
        let on_arm = |joint: &usize| {
            let on = |s: usize| *joint == s || tree.is_below(*joint, s);
            skeleton.arms.iter().any(|arm| on(arm.shoulder))
        };
        let without_arms = if skeleton.legs.is_some() {
            person
                .iter()
                .copied()
                .filter(|joint| !on_arm(joint))
                .collect()
        } else {
            Vec::new()
        };
        Self {
            tree,
            skeleton,
            person,
            without_arms,
        }
    }

    /// The pose in the file's units and axes, wrists as their joints are.
    fn frame(&self, (positions, rotations): &Pose) -> WorldFrame {
        let [left, right] = &self.skeleton.arms;
        let shoulders = (positions[left.shoulder] + positions[right.shoulder]) * 0.5;
        let [hip_left, hip_right] = self
            .skeleton
            .hips
            .unwrap_or([left.shoulder, right.shoulder]);
        let waist = match self.skeleton.waist {
            Waist::Joint(joint) => positions[joint],
            Waist::BetweenHips => (positions[hip_left] + positions[hip_right]) * 0.5,
        };
        let torso = self.skeleton.torso.map_or_else(
            || waist.lerp(&shoulders, TORSO_SHARE),
            |torso| positions[torso],
        );
        let mut nodes = [waist; KEY_NODES];
        nodes[KeyNode::Torso as usize] = torso;
        for (side, arm) in Side::BOTH.into_iter().zip(&self.skeleton.arms) {
            let joints = [arm.shoulder, arm.elbow, arm.wrist];
            for (node, joint) in side.arm().into_iter().zip(joints) {
                nodes[node as usize] = positions[joint];
            }
        }
        let wrist = |side: Side| {
            let joint = self.skeleton.arms[side as usize].wrist;
            self.tree.joints[joint].rotates().then(|| rotations[joint])
        };
        WorldFrame {
            positions: nodes,
            left: positions[hip_left] - positions[hip_right],
            wrists: Side::BOTH.map(wrist),
        }
    }

    fn probe(&self, pose: &Pose) -> Probe {
        let frame = self.frame(pose);
        let at = |joint: usize| pose.0[joint];
        let leg = |leg: LegJoints| Leg {
            hip: at(leg.hip),
            knee: at(leg.knee),
            ankle: at(leg.ankle),
            toe: leg.toe.map(at),
        };
        Probe {
            bounds: bounds(self.person.iter().map(|j| at(*j))).unwrap_or_default(),
            height_bounds: bounds(self.without_arms.iter().map(|j| at(*j))),
            legs: self.skeleton.legs.map(|legs| legs.map(leg)),
            positions: frame.positions,
            left: frame.left,
        }
    }

    fn joint_names(&self) -> Vec<NodeJoint> {
        let name = |joint: usize| {
            let joints = self.tree.joints;
            match (joints[joint].name.as_str(), joints[joint].parent) {
                ("", Some(parent)) => format!("end of {}", joints[parent].name),
                (name, _) => name.to_owned(),
            }
        };
        let waist = match self.skeleton.waist {
            Waist::Joint(joint) => name(joint),
            Waist::BetweenHips => "between the hips".to_owned(),
        };
        let torso = self
            .skeleton
            .torso
            .map_or_else(|| "between waist and shoulders".to_owned(), name);
        let mut joints = vec![
            node_joint(KeyNode::Waist, waist),
            node_joint(KeyNode::Torso, torso),
        ];
        for part in 0..3 {
            for side in Side::BOTH {
                let arm = self.skeleton.arms[side as usize];
                let joint = [arm.shoulder, arm.elbow, arm.wrist][part];
                joints.push(node_joint(side.arm()[part], name(joint)));
            }
        }
        joints
    }
}

/// Drops the first frame where the body jumps between it and the second one; answers whether it did.
fn drop_rest_pose(clip: &mut Clip) -> bool {
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
    let inserted = matches!(steps.as_slice(), [first, following @ ..]
        if !following.is_empty()
            && *first > REST_POSE_JUMP
            && *first > REST_POSE_RATIO * following.iter().copied().fold(0.0, f32::max));
    if inserted {
        clip.frames.remove(0);
    }
    inserted
}

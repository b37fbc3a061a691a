//! Which joints of a tree are the key nodes.
//!
//! Names are tried first where a scheme is known, since they tell left from right and a collar from an upper arm; they
//! must describe a body (two arms that part at one joint). Where they do not, the tree's structure tells: two arms
//! branch above a pelvis, legs below. Names given by the caller stand above both.

use std::path::Path;

use super::parts::{Arm, NamedTree, Skeleton, Waist};
use super::structure;
use super::tree::Tree;
use crate::names::{Named, Part};
use crate::source::unknown_mapped;
use crate::{BodyJoint, KeyNode, MotionError, ReadOptions, Side};

/// The pelvis's names, the surest first.
const PELVIS: [&str; 3] = ["hips", "pelvis", "hip"];
/// A pelvis lies within this share of an arm's length from the middle of the hips.
const NEAR_HIPS: f64 = 0.7;
/// A torso nearer to the waist or a shoulder than this share of an arm's length makes no bone with it.
const BONE: f64 = 0.04;
/// The longer of two arms is at most this many times as long as the other.
const ARMS_ALIKE: f64 = 3.0;

impl Skeleton {
    pub(super) fn find(
        path: &Path,
        tree: &NamedTree,
        options: &ReadOptions,
        warnings: &mut Vec<String>,
    ) -> Result<Self, MotionError> {
        let map = Map::new(path, tree.tree, options)?;
        let joints = tree.tree.joints;
        let roots: Vec<usize> = (0..joints.len())
            .filter(|j| joints[*j].parent.is_none())
            .collect();
        let found = roots
            .iter()
            .find_map(|root| Self::in_tree(tree, *root, &map));
        let Some(skeleton) = found else {
            return Err(unknown_skeleton(path, tree));
        };
        if roots.len() > 1 {
            warnings.push(format!(
                "{} roots: {} is read, the others are left out",
                roots.len(),
                joints[skeleton.root].name
            ));
        }
        if skeleton.by_structure {
            warnings.push("the names are of no known scheme: the joints are told by the tree's structure; check them, or use --map".to_owned());
        }
        Ok(skeleton)
    }

    fn in_tree(tree: &NamedTree, root: usize, map: &Map) -> Option<Self> {
        let inside = |joint: usize| joint == root || tree.tree.is_below(joint, root);
        let body = structure::body(tree, root);
        let by_name = Side::BOTH.map(|side| named_arm(tree, root, side));
        let by_structure = body.as_ref().map(|body| body.arms);
        let names_tell = match by_name {
            [Some(left), Some(right)] => arms_make_a_body(tree.tree, &[left, right]),
            _ => false,
        };
        let arms = Side::BOTH.map(|side| {
            let by_structure = by_structure.map(|arms| arms[side as usize]);
            let found = if names_tell {
                by_name[side as usize]
            } else {
                by_structure.or(by_name[side as usize])
            };
            map.arm(tree, side, found)
        });
        let [Some(left), Some(right)] = arms else {
            return None;
        };
        if ![left, right].iter().all(|arm| inside(arm.shoulder)) {
            return None;
        }
        let legs = Side::BOTH.map(|side| {
            let hip = map
                .get(BodyJoint::Hip(side))
                .or_else(|| named_hip(tree, root, side));
            hip.or_else(|| Some(body.as_ref()?.hips?[side as usize]))
        });
        let hips = if let [Some(l), Some(r)] = legs {
            Some([l, r])
        } else {
            None
        };
        let arms = [left, right];
        let waist = map
            .get(BodyJoint::Node(KeyNode::Waist))
            .map(Waist::Joint)
            .unwrap_or_else(|| find_waist(tree, root, &arms, hips));
        let torso = map
            .get(BodyJoint::Node(KeyNode::Torso))
            .or_else(|| find_torso(tree.tree, waist, &arms));
        let joints = hips.map(|hips| hips.map(|hip| structure::leg(tree, hip)));
        Some(Self {
            root,
            waist,
            torso,
            arms,
            hips,
            legs: joints.and_then(|[l, r]| Some([l?, r?])),
            by_structure: !(names_tell || map.has_arms()),
        })
    }
}

/// The joints that the caller names.
struct Map(Vec<(BodyJoint, usize)>);

impl Map {
    fn new(path: &Path, tree: &Tree, options: &ReadOptions) -> Result<Self, MotionError> {
        let names = || tree.joints.iter().map(|joint| joint.name.as_str());
        let find = |(key, name): &(BodyJoint, String)| {
            let index = names().position(|other| other == name.as_str());
            index
                .map(|index| (*key, index))
                .ok_or_else(|| unknown_mapped(path, *key, name, names()))
        };
        options
            .map
            .iter()
            .map(find)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    fn get(&self, joint: BodyJoint) -> Option<usize> {
        let entry = self.0.iter().rev().find(|(key, _)| *key == joint);
        entry.map(|(_, index)| *index)
    }

    fn node(&self, node: KeyNode) -> Option<usize> {
        self.get(BodyJoint::Node(node))
    }

    fn arm(&self, tree: &NamedTree, side: Side, found: Option<Arm>) -> Option<Arm> {
        let [shoulder, mapped, wrist] = side.arm().map(|node| self.node(node));
        let shoulder = shoulder.or(found.map(|arm| arm.shoulder))?;
        let elbow = mapped.or(found.map(|arm| arm.elbow))?;
        // The wrist of another elbow is none of this one's.
        let found = found.map(|arm| arm.wrist).filter(|_| mapped.is_none());
        let wrist = wrist.or(found).or_else(|| wrist_below(tree, elbow, side))?;
        Some(Arm {
            shoulder,
            elbow,
            wrist,
        })
    }

    fn has_arms(&self) -> bool {
        Side::BOTH
            .iter()
            .all(|side| side.arm().iter().all(|node| self.node(*node).is_some()))
    }
}

fn unknown_skeleton(path: &Path, tree: &NamedTree) -> MotionError {
    let missing = Side::BOTH.map(|side| named_arm(tree, 0, side).is_none());
    let side = match missing {
        [true, false] => "left ",
        [false, true] => "right ",
        _ => "",
    };
    let known: Vec<&str> = tree
        .tree
        .joints
        .iter()
        .map(|j| j.name.as_str())
        .filter(|n| !n.is_empty())
        .take(40)
        .collect();
    let reason = format!(
        "neither names nor structure tell the {side}shoulder and elbow among the joints {}; --map left_elbow=NAME gives them",
        known.join(", ")
    );
    MotionError::format(path, reason)
}

/// The joints at and below a root in the file's order.
fn inside<'a>(tree: &'a NamedTree, root: usize) -> impl Iterator<Item = usize> + use<'a> {
    std::iter::once(root).chain(tree.tree.descendants(root))
}

fn named_arm(tree: &NamedTree, root: usize, side: Side) -> Option<Arm> {
    inside(tree, root)
        .filter(|joint| tree.is(*joint, side, &[Part::Elbow]))
        .find_map(|elbow| {
            let above = |part: Part| {
                let line = tree.tree.ancestors(elbow);
                line.filter(move |joint| tree.is(*joint, side, &[part]))
            };
            // An upper arm of several joints begins with the topmost, a shoulder beside a collar is the lower one.
            let shoulder = above(Part::UpperArm)
                .last()
                .or_else(|| above(Part::Shoulder).next())?;
            let wrist = wrist_below(tree, elbow, side)?;
            Some(Arm {
                shoulder,
                elbow,
                wrist,
            })
        })
}

/// The joint called a wrist or a hand, else the end of the longest bone.
fn wrist_below(tree: &NamedTree, elbow: usize, side: Side) -> Option<usize> {
    let mut below = tree.tree.descendants(elbow);
    below
        .find(|joint| tree.is(*joint, side, &[Part::Wrist, Part::Hand]))
        .or_else(|| longest_child(tree.tree, elbow))
}

/// The child at the end of the longest bone; the first of equal ones.
fn longest_child(tree: &Tree, joint: usize) -> Option<usize> {
    tree.children(joint)
        .iter()
        .copied()
        .reduce(|longest, child| {
            let longer = tree.offsets[child].norm() > tree.offsets[longest].norm() * (1.0 + 1e-6);
            if longer { child } else { longest }
        })
}

/// Whether both arms branch from one joint and are about as long.
fn arms_make_a_body(tree: &Tree, arms: &[Arm; 2]) -> bool {
    let [left, right] = arms;
    let apart =
        left.shoulder != right.shoulder && tree.meeting(left.shoulder, right.shoulder).is_some();
    let [a, b] = arms.map(|arm| tree.path(arm.shoulder, arm.wrist));
    apart && a > 0.0 && b > 0.0 && a.max(b) <= ARMS_ALIKE * a.min(b)
}

fn named_hip(tree: &NamedTree, root: usize, side: Side) -> Option<usize> {
    inside(tree, root)
        .find(|joint| tree.is(*joint, side, &[Part::Thigh]))
        .or_else(|| inside(tree, root).find(|joint| tree.is(*joint, side, &[Part::Leg])))
}

fn find_waist(tree: &NamedTree, root: usize, arms: &[Arm; 2], hips: Option<[usize; 2]>) -> Waist {
    let arm = tree.tree.path(arms[0].shoulder, arms[0].wrist);
    let rest = &tree.tree.rest;
    let middle = hips.map(|[l, r]| (rest[l] + rest[r]) * 0.5);
    let at_hips =
        |joint: usize| middle.is_none_or(|middle| (rest[joint] - middle).norm() < NEAR_HIPS * arm);
    let named = PELVIS.iter().find_map(|word| {
        inside(tree, root).find(|joint| {
            let Named { side, part } = tree.names[*joint];
            let name = tree.tree.joints[*joint].name.to_lowercase();
            side.is_none() && part == Some(Part::Pelvis) && name.contains(word) && at_hips(*joint)
        })
    });
    let named = named.or_else(|| {
        inside(tree, root).find(|joint| {
            let Named { side, part } = tree.names[*joint];
            side.is_none() && part == Some(Part::Pelvis) && at_hips(*joint)
        })
    });
    let meeting = || {
        let [l, r] = hips?;
        let legs = tree.tree.meeting(l, r)?;
        let trunk = tree.tree.meeting(arms[0].shoulder, arms[1].shoulder)?;
        let joint = tree.tree.meeting(legs, trunk)?;
        Some(if at_hips(joint) {
            Waist::Joint(joint)
        } else {
            Waist::BetweenHips
        })
    };
    named
        .map(Waist::Joint)
        .or_else(meeting)
        .unwrap_or(Waist::Joint(root))
}

fn find_torso(tree: &Tree, waist: Waist, arms: &[Arm; 2]) -> Option<usize> {
    let [left, right] = arms;
    let torso = tree
        .ancestors(left.shoulder)
        .find(|joint| tree.is_below(right.shoulder, *joint))?;
    let bone = BONE * tree.path(left.shoulder, left.wrist);
    let apart = |joint: usize| (tree.rest[joint] - tree.rest[torso]).norm() > bone;
    let above = match waist {
        Waist::Joint(waist) => tree.is_below(torso, waist) && apart(waist),
        Waist::BetweenHips => true,
    };
    (above && apart(left.shoulder) && apart(right.shoulder)).then_some(torso)
}

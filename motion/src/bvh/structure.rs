//! A body seen in a tree without understanding its names: pairs of long, like limbs that branch from one joint.

use nalgebra::Vector3;

use super::parts::{Arm, LegJoints, NamedTree};
use super::tree::Tree;
use crate::Side;
use crate::names::Part;

/// The bones of a pair's limbs differ by at most this share of a limb's length in all.
const ALIKE: f64 = 0.15;
/// A joint of a body has no more children than this.
const MOST_CHILDREN: usize = 48;
/// A limb has at least this share of the longest paired limb's length: fingers and ears have less.
const LONG: f64 = 0.4;
/// A chain beside two arms of at least this share of their length is neck and head.
const HEAD: f64 = 0.08;
/// A limb has no more joints than this.
const LONGEST_CHAIN: usize = 24;
/// Lengths of a person's bones: upper arm over forearm, collar over upper arm, hand over forearm.
const UPPER_ARM: f64 = 1.1;
const COLLAR: f64 = 0.6;
const HAND: f64 = 0.5;
/// Thigh over shin, and the foot (heel to toe and below) over the shin.
const THIGH: f64 = 1.0;
const FOOT: f64 = 0.5;

/// What a tree's structure tells.
#[derive(Debug)]
pub(super) struct Body {
    pub(super) arms: [Arm; 2],
    pub(super) hips: Option<[usize; 2]>,
}

/// Two like limbs, as the first joints of their chains.
#[derive(Clone, Copy, Debug)]
struct Pair {
    parent: usize,
    limbs: [usize; 2],
    length: f64,
}

/// The body of one tree; `None` where none is seen, or left cannot be told from right.
pub(super) fn body(tree: &NamedTree, root: usize) -> Option<Body> {
    let limbs = Limbs::new(tree.tree);
    let (arms, legs) = arms_and_legs(&limbs, root)?;
    let hip = |limb: usize| {
        let chain = limbs.chain(limb);
        let (hip, ..) = best_triple(tree.tree, legs?.parent, &chain, THIGH, None, FOOT)?;
        Some(hip)
    };
    let hips = legs.and_then(|legs| Some(legs.limbs.map(hip)).and_then(|[a, b]| Some([a?, b?])));
    let arm = |limb: usize| {
        let chain = limbs.chain(limb);
        let (shoulder, elbow, wrist) = best_triple(
            tree.tree,
            arms.parent,
            &chain,
            UPPER_ARM,
            Some(COLLAR),
            HAND,
        )?;
        Some(Arm {
            shoulder,
            elbow,
            wrist,
        })
    };
    let [first, second] = arms.limbs.map(arm);
    let pair = [first?, second?];
    let swapped = second_is_left(tree, &limbs, &arms, legs.as_ref())?;
    let order = |pair: [Arm; 2]| if swapped { [pair[1], pair[0]] } else { pair };
    let hips = hips.zip(legs).map(|(hips, legs)| {
        let swapped = named_sides(tree, &limbs, &legs.limbs).unwrap_or_else(|| {
            let [a, b] = hips.map(|hip| tree.tree.rest[hip]);
            let arms = order(pair).map(|arm| tree.tree.rest[arm.shoulder]);
            (a - b).dot(&(arms[0] - arms[1])) < 0.0
        });
        if swapped { [hips[1], hips[0]] } else { hips }
    });
    Some(Body {
        arms: order(pair),
        hips,
    })
}

/// One leg from its hip down, by names where they tell.
pub(super) fn leg(tree: &NamedTree, hip: usize) -> Option<LegJoints> {
    let limbs = Limbs::new(tree.tree);
    let chain = limbs.chain(hip);
    let side = tree.names[hip].side;
    let named = |parts: &[Part], below: usize| {
        let mut joints = tree.tree.descendants(below);
        joints.find(|j| {
            tree.names[*j].side == side && tree.names[*j].part.is_some_and(|p| parts.contains(&p))
        })
    };
    let by_name = named(&[Part::Knee, Part::Leg], hip)
        .and_then(|knee| Some((knee, named(&[Part::Ankle], knee)?)));
    let (knee, ankle) = by_name.or_else(|| {
        let parent = tree.tree.joints[hip].parent?;
        let (_, knee, ankle) = best_triple(tree.tree, parent, &chain, THIGH, None, FOOT)?;
        Some((knee, ankle))
    })?;
    let thigh = tree.tree.path(hip, knee);
    let long = |joint: &usize| tree.tree.path(ankle, *joint) > 0.1 * thigh;
    let toe = named(&[Part::Toe], ankle)
        .filter(long)
        .or_else(|| limbs.chain(ankle).into_iter().skip(1).find(long));
    (thigh > 0.0).then_some(LegJoints {
        hip,
        knee,
        ankle,
        toe,
    })
}

/// How far every joint's longest chain reaches.
struct Limbs<'a> {
    tree: &'a Tree<'a>,
    /// From the joint itself to the farthest end below it, along the bones.
    reach: Vec<f64>,
}

impl<'a> Limbs<'a> {
    fn new(tree: &'a Tree<'a>) -> Self {
        let mut reach = vec![0.0_f64; tree.joints.len()];
        for joint in (0..tree.joints.len()).rev() {
            if let Some(parent) = tree.joints[joint].parent {
                reach[parent] = reach[parent].max(reach[joint] + tree.offsets[joint].norm());
            }
        }
        Self { tree, reach }
    }

    /// From the parent to the farthest end.
    fn length(&self, joint: usize) -> f64 {
        self.reach[joint] + self.tree.offsets[joint].norm()
    }

    /// The joints of the longest chain from `joint` on, itself first.
    fn chain(&self, joint: usize) -> Vec<usize> {
        let longest = |joint: &usize| {
            let children = self.tree.children(*joint).iter().copied();
            children.max_by(|a, b| self.length(*a).total_cmp(&self.length(*b)))
        };
        let chain = std::iter::successors(Some(joint), longest);
        chain.take(LONGEST_CHAIN).collect()
    }

    /// Like limbs at one joint: its longest pair.
    fn pair(&self, parent: usize) -> Option<Pair> {
        self.pair_of(parent, self.tree.children(parent))
    }

    fn pair_of(&self, parent: usize, children: &[usize]) -> Option<Pair> {
        let mut best: Option<Pair> = None;
        let children = &children[..children.len().min(MOST_CHILDREN)];
        for (i, &a) in children.iter().enumerate() {
            for &b in &children[i + 1..] {
                let length = self.length(a).min(self.length(b));
                if best.is_none_or(|best| length > best.length) && self.alike(a, b) {
                    best = Some(Pair {
                        parent,
                        limbs: [a, b],
                        length,
                    });
                }
            }
        }
        best
    }

    /// Whether two chains have like bones and end in different places.
    fn alike(&self, a: usize, b: usize) -> bool {
        let chains = [self.chain(a), self.chain(b)];
        let bone = |joint: &usize| self.tree.offsets[*joint].norm();
        let length = self.length(a).max(self.length(b));
        let differences = chains[0].iter().zip(&chains[1]);
        let apart: f64 = differences.map(|(a, b)| (bone(a) - bone(b)).abs()).sum();
        let end = |chain: &Vec<usize>| self.tree.rest[*chain.last().unwrap_or(&a)];
        chains[0].len() == chains[1].len()
            && apart <= ALIKE * length
            && (end(&chains[0]) - end(&chains[1])).norm() > 0.02 * length
    }
}

/// The pair of arms, and the pair of legs if there is one.
fn arms_and_legs(limbs: &Limbs, root: usize) -> Option<(Pair, Option<Pair>)> {
    let tree = limbs.tree;
    let inside = std::iter::once(root).chain(tree.descendants(root));
    let pairs: Vec<Pair> = inside.filter_map(|joint| limbs.pair(joint)).collect();
    let longest = pairs.iter().map(|p| p.length).fold(0.0, f64::max);
    let mut long: Vec<Pair> = pairs
        .into_iter()
        .filter(|p| p.length >= LONG * longest)
        .collect();
    // A pair inside another one's limb (fingers of a huge hand) is none of the body's.
    let all = long.clone();
    long.retain(|pair| {
        !all.iter().any(|other| {
            other
                .limbs
                .iter()
                .any(|limb| pair.parent == *limb || tree.is_below(pair.parent, *limb))
        })
    });
    long.sort_by(|a, b| b.length.total_cmp(&a.length));
    match long.as_slice() {
        [] => None,
        [only] => Some(two_pairs_at(limbs, only.parent).unwrap_or((*only, None))),
        [a, b, ..] => {
            let (upper, lower) = if has_head(limbs, a) == has_head(limbs, b) {
                // The root of a body is nearer to its legs.
                if tree.is_below(a.parent, b.parent) {
                    (a, b)
                } else {
                    (b, a)
                }
            } else if has_head(limbs, a) {
                (a, b)
            } else {
                (b, a)
            };
            Some((*upper, Some(*lower)))
        }
    }
}

/// Arms and legs at one joint: the arms are on the head's side.
fn two_pairs_at(limbs: &Limbs, parent: usize) -> Option<(Pair, Option<Pair>)> {
    let tree = limbs.tree;
    let first = limbs.pair(parent)?;
    let others: Vec<usize> = tree
        .children(parent)
        .iter()
        .copied()
        .filter(|child| !first.limbs.contains(child))
        .collect();
    let second = limbs
        .pair_of(parent, &others)
        .filter(|second| second.length >= LONG * first.length)?;
    let head = others
        .into_iter()
        .find(|child| !second.limbs.contains(child));
    let middle = |pair: &Pair| {
        let ends = pair.limbs.map(|limb| tree.rest[limb]);
        (ends[0] + ends[1]) * 0.5 - tree.rest[parent]
    };
    let up: Vector3<f64> = head.map_or_else(
        || middle(&second) - middle(&first),
        |head| {
            limbs
                .chain(head)
                .last()
                .map_or_else(Vector3::zeros, |end| tree.rest[*end])
                - tree.rest[parent]
        },
    );
    let first_above = middle(&first).dot(&up) > middle(&second).dot(&up);
    Some(if first_above {
        (first, Some(second))
    } else {
        (second, Some(first))
    })
}

/// Whether a further chain branches beside the pair that is no trunk with limbs of its own.
fn has_head(limbs: &Limbs, pair: &Pair) -> bool {
    let tree = limbs.tree;
    tree.children(pair.parent).iter().any(|child| {
        let plain = std::iter::once(*child)
            .chain(tree.descendants(*child))
            .all(|joint| {
                limbs
                    .pair(joint)
                    .is_none_or(|inner| inner.length < LONG * pair.length)
            });
        let length = limbs.length(*child);
        !pair.limbs.contains(child) && plain && length > HEAD * pair.length && length < pair.length
    })
}

/// The three joints of a chain whose bones are most like a limb's: (near, middle, far).
fn best_triple(
    tree: &Tree,
    parent: usize,
    chain: &[usize],
    upper_over_lower: f64,
    before_over_upper: Option<f64>,
    after_over_lower: f64,
) -> Option<(usize, usize, usize)> {
    let end = *chain.last()?;
    let miss = |value: f64, expected: f64| (value.max(0.02) / expected).ln().abs();
    let mut best: Option<(f64, (usize, usize, usize))> = None;
    for (i, &near) in chain.iter().enumerate() {
        for (j, &middle) in chain.iter().enumerate().skip(i + 1) {
            for &far in &chain[j + 1..] {
                let upper = tree.path(near, middle);
                let lower = tree.path(middle, far);
                if !(upper > 0.0 && lower > 0.0) {
                    continue;
                }
                let before = before_over_upper.map_or(0.0, |share| {
                    0.5 * miss(tree.path(parent, near) / upper, share)
                });
                let after = 0.5 * miss(tree.path(far, end) / lower, after_over_lower);
                let turns = f64::from(u8::from(!tree.joints[middle].rotates()));
                let cost = miss(upper / lower, upper_over_lower) + before + after + turns;
                if best.is_none_or(|(least, _)| cost < least) {
                    best = Some((cost, (near, middle, far)));
                }
            }
        }
    }
    best.map(|(_, triple)| triple)
}

/// Whether the second limb of the arms is the left one: by any name on it, else by where the feet point.
fn second_is_left(
    tree: &NamedTree,
    limbs: &Limbs,
    arms: &Pair,
    legs: Option<&Pair>,
) -> Option<bool> {
    if let Some(swapped) = named_sides(tree, limbs, &arms.limbs) {
        return Some(swapped);
    }
    let legs = legs?;
    let rest = &tree.tree.rest;
    let feet = legs.limbs.map(|limb| {
        let chain = limbs.chain(limb);
        let (_, _, ankle) = best_triple(tree.tree, legs.parent, &chain, THIGH, None, FOOT)?;
        Some(rest[*chain.last()?] - rest[ankle])
    });
    let [Some(a), Some(b)] = feet else {
        return None;
    };
    let ends = arms
        .limbs
        .map(|limb| limbs.chain(limb).last().map(|j| rest[*j]));
    let [Some(first), Some(second)] = ends else {
        return None;
    };
    let up = rest[arms.parent] - rest[legs.parent];
    let up = if up.norm() > 0.0 { up } else { -(a + b) };
    let left = up.cross(&(a + b));
    let side = (first - second).dot(&left);
    (side.abs() > 1e-6 * (first - second).norm() * left.norm()).then_some(side < 0.0)
}

fn named_sides(tree: &NamedTree, limbs: &Limbs, pair: &[usize; 2]) -> Option<bool> {
    let side = |limb: usize| {
        limbs
            .chain(limb)
            .iter()
            .find_map(|joint| tree.names[*joint].side)
    };
    match pair.map(side) {
        [Some(Side::Left), Some(Side::Right)] => Some(false),
        [Some(Side::Right), Some(Side::Left)] => Some(true),
        _ => None,
    }
}

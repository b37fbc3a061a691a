//! Where the key nodes are among markers on the skin, or among joint centres that a program computed.

use nalgebra::{Rotation3, Vector3};

use super::file::Points;
use crate::hands::frame_of;
use crate::orientation::{Leg, Probe, bounds};
use crate::world_frame::WorldFrame;
use crate::{BodyJoint, KEY_NODES, KeyNode, ReadOptions, Side};

/// From the skin over the shoulder down to the joint, metres, as a share of the upper arm.
const SHOULDER_DEPTH: f64 = 0.17;
/// From the outer side of the elbow to the joint, as a share of the forearm.
const ELBOW_DEPTH: f64 = 0.16;
/// Sine of the elbow's angle above which forearm and upper arm tell the elbow's axis.
const BENT: f64 = 0.25;
/// Steps in which an elbow's place and axis are found together.
const SKIN_STEPS: usize = 4;
/// A marker that is seen in a smaller share of the frames is none.
const SEEN: f64 = 0.5;

/// Labels of a marker on one side, `@` for L or R, without case; the first that is there counts.
const SHOULDER: &[&str] = &[
    "@SHO",
    "@SHOULDER",
    "@ACR",
    "@ACROMION",
    "@AC",
    "@SHOULDERTOP",
    "@SAE",
    "@SHOULD",
];
const ELBOW: &[&str] = &[
    "@ELB",
    "@ELBOW",
    "@LEL",
    "@ELBL",
    "@ELBOWOUT",
    "@LELB",
    "@HLE",
    "@ELBLAT",
];
const INNER_ELBOW: &[&str] = &[
    "@ELBM", "@MEL", "@ELBIN", "@ELBOWIN", "@MELB", "@HME", "@ELBMED", "@ELBW",
];
const THUMB_WRIST: &[&str] = &[
    "@WRA",
    "@WRISTIN",
    "@RSP",
    "@WRT",
    "@RWRIST",
    "@WRISTRAD",
    "@RAD",
];
const LITTLE_WRIST: &[&str] = &[
    "@WRB",
    "@WRISTOUT",
    "@USP",
    "@WRL",
    "@UWRIST",
    "@WRISTULN",
    "@ULN",
];
const WRIST: &[&str] = &["@WRI", "@WRIST", "@WR"];
const HAND: &[&str] = &["@FIN", "@HAND", "@HANDOUT", "@HM2", "@FIN1", "@HAN"];
const FRONT_HIP: &[&str] = &[
    "@ASI",
    "@ASIS",
    "@FWT",
    "@IAS",
    "@WAISTFRONT",
    "WAIST@FRONT",
    "@FRONTWAIST",
];
const BACK_HIP: &[&str] = &[
    "@PSI",
    "@PSIS",
    "@BWT",
    "@IPS",
    "@WAISTBACK",
    "WAIST@BACK",
    "@BACKWAIST",
];
const SACRUM: &[&str] = &["SACR", "SACRUM", "VSAC", "SAC"];
const TRUNK: [&[&str]; 4] = [
    &["C7", "CERV7", "NECKBACK"],
    &["CLAV", "JUG", "CLAVICLE", "SJN", "IJ", "CHESTTOP"],
    &["STRN", "STERNUM", "SXS", "PX", "XYP", "CHEST"],
    &["T10", "T8", "BACKTOP", "MBAK"],
];
/// Joint centres, as models and markerless systems label them.
const CENTRES: [&[&str]; 3] = [
    &["@SJC", "@SHOULDERJC", "@GH"],
    &["@EJC", "@ELBOWJC"],
    &["@WJC", "@WRISTJC"],
];
const HIP: &[&str] = &["@HJC", "@HIPJC", "@HIP"];
const KNEE: &[&str] = &["@KJC", "@KNE", "@KNEE", "@KNEL", "@LFC", "@FLE", "@KNEEOUT"];
const ANKLE: &[&str] = &[
    "@AJC",
    "@ANK",
    "@ANKLE",
    "@ANKL",
    "@LM",
    "@FAL",
    "@ANKLEOUT",
];
const TOE: &[&str] = &["@TOE", "@MT2", "@FM2", "@TOEIN", "@MT1", "@TOETIP"];
const HEAD: &[&str] = &["@FHD", "@BHD"];

/// Which points make which part of the body.
#[derive(Debug)]
pub(super) struct Markers {
    /// Points whose mean is the waist.
    waist: Vec<usize>,
    torso: Vec<usize>,
    /// Points that show which way the pelvis faces: left ones and right ones.
    pelvis: [Vec<usize>; 2],
    arms: [ArmMarkers; 2],
    legs: Option<[LegMarkers; 2]>,
    head: Vec<usize>,
}

/// One arm's points.
#[derive(Debug)]
struct ArmMarkers {
    shoulder: Place,
    elbow: Place,
    wrist: Vec<usize>,
    /// On the thumb's and on the little finger's side of the wrist.
    sides: Option<[usize; 2]>,
    hand: Option<usize>,
}

/// Where a joint is.
#[derive(Debug, Clone, Copy)]
enum Place {
    /// At a point.
    Centre(usize),
    /// Between two points.
    Between(usize, usize),
    /// Under a marker on the skin.
    Under(usize),
}

impl Place {
    fn points(self) -> impl Iterator<Item = usize> {
        let (first, second) = match self {
            Self::Centre(point) | Self::Under(point) => (point, None),
            Self::Between(a, b) => (a, Some(b)),
        };
        std::iter::once(first).chain(second)
    }
}

/// One leg's points: hip (where there is one), knee, ankle, toe.
#[derive(Debug, Clone, Copy)]
struct LegMarkers {
    hip: usize,
    knee: usize,
    ankle: usize,
    toe: Option<usize>,
}

/// Finds points by their labels.
struct Labels<'a> {
    points: &'a Points,
    /// In capitals, without a subject's name and without separators.
    plain: Vec<String>,
    usable: Vec<bool>,
}

impl<'a> Labels<'a> {
    fn new(points: &'a Points) -> Self {
        let plain = |label: &String| {
            let bare = label.rsplit(':').next().unwrap_or(label);
            let letters = bare.chars().filter(char::is_ascii_alphanumeric);
            letters.map(|c| c.to_ascii_uppercase()).collect()
        };
        let seen = |point: usize| {
            let seen = (0..points.frames).filter(|f| points.position(*f, point).is_some());
            seen.count() as f64 >= SEEN * points.frames as f64
        };
        Self {
            points,
            plain: points.labels.iter().map(plain).collect(),
            usable: (0..points.labels.len()).map(seen).collect(),
        }
    }

    fn find(&self, names: &[&str], side: Option<Side>) -> Option<usize> {
        let words: &[&str] = match side {
            Some(Side::Left) => &["L", "LEFT"],
            Some(Side::Right) => &["R", "RIGHT"],
            None => &[""],
        };
        names.iter().find_map(|name| {
            words.iter().find_map(|word| {
                let behind = format!("{}{word}", name.replace('@', ""));
                let spelt = [name.replace('@', word), behind];
                let found = |label: &String| spelt.contains(label);
                (0..self.plain.len()).find(|i| self.usable[*i] && found(&self.plain[*i]))
            })
        })
    }

    fn mapped(&self, options: &ReadOptions, joint: BodyJoint) -> Result<Option<usize>, String> {
        let Some(name) = options.mapped(joint) else {
            return Ok(None);
        };
        let labels = &self.points.labels;
        let found = labels.iter().position(|label| label == name);
        found.map(Some).ok_or_else(|| {
            let there: Vec<&str> = labels.iter().map(String::as_str).take(60).collect();
            format!(
                "no marker is called {name:?}, which is to be {}; there are {}",
                joint.name(),
                there.join(", ")
            )
        })
    }
}

impl Markers {
    /// Finds the body's markers; the error says which are missing.
    pub(super) fn find(points: &Points, options: &ReadOptions) -> Result<Self, String> {
        let labels = Labels::new(points);
        let mut missing = Vec::new();
        let mut arms = Vec::new();
        for side in Side::BOTH {
            arms.extend(ArmMarkers::find(&labels, options, side, &mut missing)?);
        }
        let pelvis = Side::BOTH.map(|side| {
            let found = [FRONT_HIP, BACK_HIP].map(|names| labels.find(names, Some(side)));
            let mut found: Vec<usize> = found.into_iter().flatten().collect();
            if found.is_empty() {
                found.extend(labels.find(HIP, Some(side)));
            }
            found
        });
        let mut waist: Vec<usize> = match labels.mapped(options, BodyJoint::Node(KeyNode::Waist))? {
            Some(point) => vec![point],
            None => pelvis.iter().flatten().copied().collect(),
        };
        for side in Side::BOTH {
            if pelvis[side as usize].is_empty() {
                missing.push(format!(
                    "{} of the pelvis ({})",
                    side.name(),
                    spelt(FRONT_HIP, Some(side))
                ));
            }
        }
        // Front markers alone would put the waist on the belly.
        if labels.find(BACK_HIP, Some(Side::Left)).is_none() {
            waist.extend(
                labels
                    .find(SACRUM, None)
                    .into_iter()
                    .flat_map(|sacrum| [sacrum; 2]),
            );
        }
        let mut torso: Vec<usize> = match labels.mapped(options, BodyJoint::Node(KeyNode::Torso))? {
            Some(point) => vec![point],
            None => TRUNK
                .iter()
                .filter_map(|names| labels.find(names, None))
                .collect(),
        };
        if torso.is_empty() {
            // Between the shoulders.
            torso = arms
                .iter()
                .flat_map(|arm: &ArmMarkers| arm.shoulder.points())
                .collect();
        }
        let legs = Side::BOTH.map(|side| {
            let at = |names: &[&str]| labels.find(names, Some(side));
            Some(LegMarkers {
                hip: at(HIP).or_else(|| pelvis[side as usize].first().copied())?,
                knee: at(KNEE)?,
                ankle: at(ANKLE)?,
                toe: at(TOE),
            })
        });
        if !missing.is_empty() {
            let there: Vec<&str> = points.labels.iter().map(String::as_str).take(60).collect();
            return Err(format!(
                "missing markers: {}; --map left_elbow=LABEL gives one; there are {}",
                missing.join("; "),
                there.join(", ")
            ));
        }
        let [left, right] = legs;
        let arms: [ArmMarkers; 2] = arms
            .try_into()
            .map_err(|_| "an arm is missing".to_owned())?;
        let head = Side::BOTH
            .iter()
            .flat_map(|side| HEAD.iter().map(|name| (*side, *name)));
        Ok(Self {
            waist,
            torso,
            pelvis,
            arms,
            legs: left.zip(right).map(|(l, r)| [l, r]),
            head: head
                .filter_map(|(side, name)| labels.find(&[name], Some(side)))
                .collect(),
        })
    }

    /// Points that every frame needs.
    pub(super) fn needed(&self) -> Vec<usize> {
        let arms = self.arms.iter().flat_map(|arm| {
            arm.shoulder
                .points()
                .chain(arm.elbow.points())
                .chain(arm.wrist.iter().copied())
        });
        let mut needed: Vec<usize> = arms
            .chain(self.waist.iter().copied())
            .chain(self.torso.iter().copied())
            .chain(self.pelvis.iter().flatten().copied())
            .collect();
        needed.sort_unstable();
        needed.dedup();
        needed
    }

    /// All points that are used.
    pub(super) fn used(&self) -> Vec<usize> {
        let hands = self
            .arms
            .iter()
            .flat_map(|arm| arm.sides.iter().flatten().copied().chain(arm.hand));
        let legs = self.legs.iter().flatten();
        let legs = legs.flat_map(|leg| [leg.hip, leg.knee, leg.ankle].into_iter().chain(leg.toe));
        let mut used = self.needed();
        used.extend(hands.chain(legs).chain(self.head.iter().copied()));
        used.sort_unstable();
        used.dedup();
        used
    }

    /// The labels of a node's points.
    pub(super) fn labels_of(&self, points: &Points, node: KeyNode) -> String {
        let side = Side::BOTH
            .into_iter()
            .find(|side| side.arm().contains(&node));
        let found: Vec<usize> = match (side, node) {
            (None, KeyNode::Waist) => self.waist.clone(),
            (None, _) => self.torso.clone(),
            (Some(side), node) => {
                let arm = &self.arms[side as usize];
                match side.arm().iter().position(|n| *n == node) {
                    Some(0) => arm.shoulder.points().collect(),
                    Some(1) => arm.elbow.points().collect(),
                    _ => arm.wrist.clone(),
                }
            }
        };
        let mut labels: Vec<&str> = found.iter().map(|p| points.labels[*p].as_str()).collect();
        labels.dedup();
        labels.join("+")
    }

    /// Whether hands have a direction of their own.
    pub(super) fn hand_is_seen(&self, side: Side) -> bool {
        self.arms[side as usize].sides.is_some()
    }

    /// The pose of one frame whose points are at `at`. `axes` are the elbows' axes of the frame before, and become this one's.
    pub(super) fn frame(
        &self,
        at: &impl Fn(usize) -> Vector3<f64>,
        axes: &mut [Option<Vector3<f64>>; 2],
    ) -> WorldFrame {
        let middle = |points: &[usize]| {
            points.iter().map(|p| at(*p)).sum::<Vector3<f64>>() / points.len() as f64
        };
        let waist = middle(&self.waist);
        let torso = middle(&self.torso);
        let mut positions = [waist; KEY_NODES];
        positions[KeyNode::Torso as usize] = torso;
        let trunk = (torso - waist)
            .try_normalize(1e-9)
            .unwrap_or_else(Vector3::z);
        let mut wrists = [None; 2];
        for side in Side::BOTH {
            let arm = &self.arms[side as usize];
            let [shoulder, elbow, wrist] = arm.joints(at, &trunk, side, &mut axes[side as usize]);
            for (node, position) in side.arm().into_iter().zip([shoulder, elbow, wrist]) {
                positions[node as usize] = position;
            }
            wrists[side as usize] = arm.hand(at, elbow, wrist);
        }
        let [left, right] = self.pelvis.each_ref().map(|points| middle(points));
        WorldFrame {
            positions,
            left: left - right,
            wrists,
        }
    }

    pub(super) fn probe(&self, world: &WorldFrame, at: &impl Fn(usize) -> Vector3<f64>) -> Probe {
        let legs = self.legs.map(|legs| {
            legs.map(|leg| Leg {
                hip: at(leg.hip),
                knee: at(leg.knee),
                ankle: at(leg.ankle),
                toe: leg.toe.map(at),
            })
        });
        let feet = || {
            let legs = legs.iter().flatten();
            legs.flat_map(|leg| std::iter::once(leg.ankle).chain(leg.toe))
        };
        let head = || self.head.iter().map(|p| at(*p));
        let tall = legs.is_some() && !self.head.is_empty();
        Probe {
            positions: world.positions,
            left: world.left,
            bounds: bounds(feet().chain(head()).chain(world.positions)).unwrap_or_default(),
            height_bounds: tall.then(|| bounds(feet().chain(head()))).flatten(),
            legs,
        }
    }
}

impl ArmMarkers {
    fn find(
        labels: &Labels,
        options: &ReadOptions,
        side: Side,
        missing: &mut Vec<String>,
    ) -> Result<Option<Self>, String> {
        let at = |names: &[&str]| labels.find(names, Some(side));
        let [shoulder, elbow, wrist] = side.arm().map(BodyJoint::Node);
        let centre = |joint, names| Ok::<_, String>(labels.mapped(options, joint)?.or(at(names)));
        let shoulder = centre(shoulder, CENTRES[0])?
            .map(Place::Centre)
            .or_else(|| at(SHOULDER).map(Place::Under));
        let outer = at(ELBOW);
        let elbow = centre(elbow, CENTRES[1])?.map(Place::Centre).or_else(|| {
            Some(match (outer?, at(INNER_ELBOW)) {
                (outer, Some(inner)) => Place::Between(outer, inner),
                (outer, None) => Place::Under(outer),
            })
        });
        let sides = at(THUMB_WRIST).zip(at(LITTLE_WRIST)).map(|(a, b)| [a, b]);
        let one = centre(wrist, CENTRES[2])?;
        let wrist: Vec<usize> = match (one, sides) {
            (Some(point), _) => vec![point],
            (None, Some(sides)) => sides.to_vec(),
            (None, None) => [WRIST, THUMB_WRIST, LITTLE_WRIST]
                .iter()
                .find_map(|n| at(n))
                .into_iter()
                .collect(),
        };
        for (what, there, names) in [
            ("shoulder", shoulder.is_some(), SHOULDER),
            ("elbow", elbow.is_some(), ELBOW),
            ("wrist", !wrist.is_empty(), THUMB_WRIST),
        ] {
            if !there {
                missing.push(format!(
                    "{} {what} ({})",
                    side.name(),
                    spelt(names, Some(side))
                ));
            }
        }
        Ok(shoulder
            .zip(elbow)
            .filter(|_| !wrist.is_empty())
            .map(|(shoulder, elbow)| Self {
                shoulder,
                elbow,
                wrist,
                sides,
                hand: at(HAND),
            }))
    }

    /// Shoulder, elbow and wrist joints.
    fn joints(
        &self,
        at: &impl Fn(usize) -> Vector3<f64>,
        trunk: &Vector3<f64>,
        side: Side,
        axis: &mut Option<Vector3<f64>>,
    ) -> [Vector3<f64>; 3] {
        let wrist =
            self.wrist.iter().map(|p| at(*p)).sum::<Vector3<f64>>() / self.wrist.len() as f64;
        let skin = |place: Place| match place {
            Place::Centre(point) | Place::Under(point) => at(point),
            Place::Between(a, b) => (at(a) + at(b)) * 0.5,
        };
        let (mut shoulder, mut elbow) = (skin(self.shoulder), skin(self.elbow));
        let upper = elbow - shoulder;
        if matches!(self.shoulder, Place::Under(_)) {
            shoulder -= trunk * (SHOULDER_DEPTH * upper.norm());
        }
        if matches!(self.elbow, Place::Under(_)) {
            elbow = under_skin(shoulder, elbow, wrist, side, axis);
        }
        [shoulder, elbow, wrist]
    }

    fn hand(
        &self,
        at: &impl Fn(usize) -> Vector3<f64>,
        elbow: Vector3<f64>,
        wrist: Vector3<f64>,
    ) -> Option<Rotation3<f64>> {
        let [thumb, little] = self.sides?;
        let fingers = self.hand.map_or(wrist - elbow, |hand| at(hand) - wrist);
        frame_of(fingers, at(thumb) - at(little))
    }
}

/// The elbow's joint inside of its outer marker, along the axis about which the elbow bends. Where the arm is straight,
/// `axis` is that of the frame before.
fn under_skin(
    shoulder: Vector3<f64>,
    skin: Vector3<f64>,
    wrist: Vector3<f64>,
    side: Side,
    axis: &mut Option<Vector3<f64>>,
) -> Vector3<f64> {
    let inward = if side == Side::Left { 1.0 } else { -1.0 };
    let mut elbow = skin;
    // The axis is at right angles to bones that end at the joint, not at the skin.
    for _ in 0..SKIN_STEPS {
        let (upper, fore) = (elbow - shoulder, wrist - elbow);
        let cross = upper.cross(&fore);
        let bent = cross.norm() > BENT * upper.norm() * fore.norm();
        let told = if bent { Some(cross * inward) } else { *axis };
        let across = told.and_then(|axis| {
            let along = upper.try_normalize(1e-9)?;
            (axis - along * along.dot(&axis)).try_normalize(1e-9)
        });
        let Some(across) = across else { break };
        elbow = skin + across * (ELBOW_DEPTH * fore.norm());
        *axis = Some(across);
    }
    elbow
}

/// The usual spelling of a marker, for messages.
fn spelt(names: &[&str], side: Option<Side>) -> String {
    let letter = match side {
        Some(Side::Left) => "L",
        Some(Side::Right) => "R",
        None => "",
    };
    let names: Vec<String> = names
        .iter()
        .take(3)
        .map(|name| name.replace('@', letter))
        .collect();
    names.join(" or ")
}
